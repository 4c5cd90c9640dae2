import { describe, expect, it } from "vitest";

import { Format } from "../src/format";
import { chooseText } from "../src/text";
import { de } from "../src/text/de";
import { en } from "../src/text/en";

const english = new Format("en", "Europe/Zurich");
const german = new Format("de", "Europe/Zurich");

describe("numbers for people", () => {
  it("give small lengths in the unit people use for them", () => {
    const written = [0.0004, 0.0081, 0.00999, 0.024, 0.99, 0.9996, 3.2, 250].map((metres) =>
      english.smallLength(metres),
    );
    expect(written).toEqual(["0.4 mm", "8 mm", "1.0 cm", "2.4 cm", "99.0 cm", "1.00 m", "3.20 m", "250 m"]);
    expect(german.smallLength(0.024)).toBe("2,4 cm");
    expect(english.smallLength(null)).toBe("–");
  });

  it("never write minus zero", () => {
    expect(english.number(-0.0004, 2)).toBe("0.00");
  });

  it("write bearings with three digits before the point", () => {
    expect([0, 7.46, 99.96, 359.97, -10].map((degrees) => english.bearing(degrees))).toEqual([
      "000.0°",
      "007.5°",
      "100.0°",
      "000.0°",
      "350.0°",
    ]);
  });

  it("write ages finer the younger they are", () => {
    expect([0.04, 9.9, 9.96, 42.4, 59.6, 3723].map((seconds) => english.age(seconds))).toEqual([
      "0.0 s",
      "9.9 s",
      "10 s",
      "42 s",
      "1:00",
      "1:02:03",
    ]);
    expect(english.age(null)).toBe("–");
  });

  it("write scale lengths exactly", () => {
    expect([0.005, 0.02, 0.5, 5, 200, 2000].map((metres) => english.roundLength(metres))).toEqual([
      "5 mm",
      "2 cm",
      "50 cm",
      "5 m",
      "200 m",
      "2 km",
    ]);
  });

  it("write the ticks of an axis with the decimals that their step needs", () => {
    expect(english.axis([0, 2.5, 5, 7.5])).toEqual(["0.0", "2.5", "5.0", "7.5"]);
    expect(english.axis([0, 5, 10])).toEqual(["0", "5", "10"]);
    expect(english.axis([0, 0.1, 0.2, 0.1 + 0.2])).toEqual(["0.0", "0.1", "0.2", "0.3"]);
    expect(english.axis([-0.25, 0, 0.25])).toEqual(["-0.25", "0.00", "0.25"]);
    expect(german.axis([0, 0.00025])).toEqual(["0,00000", "0,00025"]);
    expect(english.axis([])).toEqual([]);
  });

  it("write sizes of files", () => {
    expect([999, 48_312_554, 1_912_554_022, 999_960].map((bytes) => english.bytes(bytes))).toEqual([
      "999 B",
      "48.3 MB",
      "1.9 GB",
      "1.0 MB",
    ]);
  });
});

describe("times for people", () => {
  const time_ms = Date.parse("2026-11-23T05:00:00.123Z");

  it("always name their zone", () => {
    expect(english.timeOfDay(time_ms)).toBe("06:00:00 CET");
    expect(german.timeOfDay(time_ms)).toMatch(/^06:00:00 (MEZ|GMT\+1)$/);
    expect(english.dateTime(time_ms)).toBe("23 Nov 2026, 06:00:00 CET");
  });
});

describe("moments", () => {
  it("have a date when they are not of today, by the day of the zone", () => {
    const now_ms = Date.parse("2026-11-23T05:00:00Z");
    expect(english.moment(Date.parse("2026-11-22T23:30:00Z"), now_ms)).toBe("00:30:00 CET");
    expect(english.moment(Date.parse("2026-11-22T22:30:00Z"), now_ms)).toBe("22 Nov 2026, 23:30:00 CET");
  });
});

describe("languages", () => {
  it("follow the wish, English otherwise", () => {
    expect(chooseText(["fr-CH", "de-CH", "en"])).toBe(de);
    expect(chooseText(["fr"])).toBe(en);
  });

  it("have the same words", () => {
    const keys = (value: object, path = ""): string[] =>
      Object.entries(value).flatMap(([key, child]) =>
        typeof child === "object" && child !== null ? keys(child, `${path}${key}.`) : [`${path}${key}`],
      );
    // What machines say is English already.
    expect(keys({ ...de, told: {} }).sort()).toEqual(keys({ ...en, told: {} }).sort());
  });
});
