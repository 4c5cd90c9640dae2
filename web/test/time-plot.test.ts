import { afterEach, expect, it, vi } from "vitest";

import { options, type TimePlotProps } from "../src/components/time-plot";
import { Format } from "../src/format";

afterEach(() => vi.unstubAllGlobals());

it("a plot that stands follows the span that is chosen later", () => {
  vi.stubGlobal("getComputedStyle", () => ({ getPropertyValue: () => "" }));
  const props: TimePlotProps = {
    title: "sigma",
    unit: "cm",
    times_s: [],
    lines: [],
    span: [700, 1000],
    syncKey: "states",
  };
  const latest = { current: props };
  const { scales } = options({ clientWidth: 400 } as HTMLElement, latest, new Format("en"), {
    cursor: () => {},
    drawn: () => {},
  });
  const ranging = scales?.x?.range;
  if (typeof ranging !== "function") throw new Error("the range is fixed when the plot opens");
  const range = () => (ranging as () => [number, number])();
  expect(range()).toEqual([700, 1000]);
  latest.current = { ...props, span: [-2600, 1000] };
  expect(range()).toEqual([-2600, 1000]);
});
