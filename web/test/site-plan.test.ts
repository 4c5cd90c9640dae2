import { describe, expect, it } from "vitest";

import { SiteFrame } from "../src/geometry/geodesy";
import { readPlan } from "../src/plan/site-plan";

const frame = new SiteFrame({ latitude_deg: 47.48, longitude_deg: 8.5, altitude_m: 475 });
const feature = (type: string, coordinates: unknown, properties: unknown = {}) => ({
  type: "Feature",
  properties,
  geometry: { type, coordinates },
});

describe("the site's plan", () => {
  it("stands where it was surveyed, in metres of the site", () => {
    const corner = frame.toLngLat([12, -7]);
    const [read] = readPlan({ features: [feature("Point", corner, { name: "Peg 4" })] }, frame);
    expect(read?.lines[0]?.[0]?.[0]).toBeCloseTo(12, 6);
    expect(read?.lines[0]?.[0]?.[1]).toBeCloseTo(-7, 6);
    expect(read?.name).toBe("Peg 4");
  });

  it("takes all kinds of geometry, and passes over what has none", () => {
    const line = [
      [8.5, 47.48],
      [8.501, 47.48],
    ];
    const features = [
      feature("LineString", line),
      feature("MultiPolygon", [[line], [line]]),
      { type: "Feature", properties: null, geometry: null },
    ];
    expect(readPlan({ features }, frame).map(({ kind }) => kind)).toEqual(["line", "area", "area"]);
  });

  it("believes a file's colours only if they are colours", () => {
    const looks = { stroke: "#ff0000", fill: "url(https://elsewhere)" };
    const [read] = readPlan({ features: [feature("Point", [8.5, 47.48], looks)] }, frame);
    expect(read).toMatchObject({ stroke: "#ff0000", fill: null });
  });

  it("says what is wrong with a file that is no plan", () => {
    expect(() => readPlan({}, frame)).toThrow("plan.features: expected a list");
    expect(() => readPlan({ features: [feature("Point", ["8", 47])] }, frame)).toThrow(
      "longitude and latitude",
    );
  });
});
