import { describe, expect, it } from "vitest";

import { segmentsOf } from "../src/components/lanes";

describe("lanes", () => {
  const lane = (items: [number, string][]) =>
    segmentsOf(items, 4, ([time_s, label]) => ({ time_s, label, colour: "--x" })).map(
      ({ from_s, to_s, label }) => [from_s, to_s, label],
    );

  it("join neighbours that say the same, and reach to where another begins", () => {
    expect(
      lane([
        [0, "fixed"],
        [1, "fixed"],
        [2, "silent"],
        [3, "silent"],
      ]),
    ).toEqual([
      [0, 2, "fixed"],
      [2, 3, "silent"],
    ]);
  });

  it("leave open what was not told", () => {
    expect(
      lane([
        [0, "fixed"],
        [1, "fixed"],
        [9, "fixed"],
      ]),
    ).toEqual([
      [0, 1, "fixed"],
      [9, 9, "fixed"],
    ]);
  });
});
