import { describe, expect, it } from "vitest";

import { SiteFrame } from "../src/geometry/geodesy";
import { gridLines, roundStep, scaleBar } from "../src/geometry/grid";
import { circleOutline, ellipseOutline, hatchLines, place } from "../src/geometry/shapes";
import { WORLD } from "./views";

describe("the site frame", () => {
  const frame = new SiteFrame(WORLD);

  it("puts the origin where the site says it is", () => {
    const [longitude, latitude] = frame.toLngLat([0, 0]);
    expect(longitude).toBeCloseTo(WORLD.longitude_deg, 12);
    expect(latitude).toBeCloseTo(WORLD.latitude_deg, 12);
  });

  it("agrees with the ellipsoid's radii of curvature", () => {
    // At 47.48°: meridian radius 6 370 165 m and normal radius 6 389 780 m, plus 474.9 m of height.
    const sin = Math.sin((WORLD.latitude_deg * Math.PI) / 180);
    const e2 = 0.00669437999014;
    const normal = 6_378_137 / Math.sqrt(1 - e2 * sin * sin) + WORLD.altitude_m;
    const meridian = (6_378_137 * (1 - e2)) / (1 - e2 * sin * sin) ** 1.5 + WORLD.altitude_m;
    const [east] = frame.toLngLat([10, 0]);
    const [, north] = frame.toLngLat([0, 10]);
    const degrees = 180 / Math.PI;
    const cos = Math.cos((WORLD.latitude_deg * Math.PI) / 180);
    expect(east - WORLD.longitude_deg).toBeCloseTo((10 / (normal * cos)) * degrees, 10);
    expect(north - WORLD.latitude_deg).toBeCloseTo((10 / meridian) * degrees, 10);
  });

  it("comes back within a tenth of a millimetre across a site", () => {
    for (const point of [
      [0, 0],
      [12.345, -67.891],
      [800, 800],
      [-1000, 250],
    ] as const) {
      const [east, north] = frame.toMetres(frame.toLngLat(point));
      // The way there leaves the tangent plane's height behind: 5e-5 m sideways at 1 km.
      expect(Math.hypot(east - point[0], north - point[1])).toBeLessThan(1e-4);
    }
  });
});

describe("outlines", () => {
  it("place a body with its x axis along the compass heading and y to its left", () => {
    const [front, left] = place(
      [
        [2, 0],
        [0, 1],
      ],
      [10, 20],
      90,
    );
    expect(front?.[0]).toBeCloseTo(12);
    expect(front?.[1]).toBeCloseTo(20);
    expect(left?.[0]).toBeCloseTo(10);
    expect(left?.[1]).toBeCloseTo(21);
  });

  it("draw the ellipse true to scale with its longer axis along the bearing", () => {
    const outline = ellipseOutline([1, 2], { semi_major_m: 0.3, semi_minor_m: 0.1, bearing_deg: 0 });
    const east = outline.map((point) => point[0] - 1);
    const north = outline.map((point) => point[1] - 2);
    expect(Math.max(...north)).toBeCloseTo(0.3, 9);
    expect(Math.max(...east)).toBeCloseTo(0.1, 9);
    for (let index = 0; index < outline.length; index += 1) {
      const [x, y] = [east[index] ?? 0, north[index] ?? 0];
      expect((x / 0.1) ** 2 + (y / 0.3) ** 2).toBeCloseTo(1, 9);
    }
    expect(outline[0]).toEqual(outline.at(-1));
  });

  it("make circles round", () => {
    for (const [x, y] of circleOutline([0, 0], 2)) expect(Math.hypot(x, y)).toBeCloseTo(2, 12);
  });

  it("keep hatch strokes inside their rectangle", () => {
    const lines = hatchLines([-2, -1], [1, 1], 0.4);
    expect(lines.length).toBeGreaterThan(5);
    for (const [x, y] of lines.flat()) {
      expect(x).toBeGreaterThanOrEqual(-2);
      expect(x).toBeLessThanOrEqual(1);
      expect(y).toBeGreaterThanOrEqual(-1 - 1e-12);
      expect(y).toBeLessThanOrEqual(1 + 1e-12);
    }
  });
});

describe("the grid", () => {
  it("steps in 1, 2, 5", () => {
    expect([0.9, 1, 1.1, 2.1, 5.1, 0.013, 70].map(roundStep)).toEqual([1, 1, 2, 5, 10, 0.02, 100]);
    expect(roundStep(0.2)).toBeCloseTo(0.2, 12);
  });

  it("covers its extent, with every fifth line stronger", () => {
    const lines = gridLines({ min: [-11, -1], max: [11, 1] }, 2);
    const north = lines.filter((line) => line.along === "north").map((line) => line.value_m);
    expect(north[0]).toBeLessThanOrEqual(-11);
    expect(north.at(-1)).toBe(10);
    expect(lines.filter((line) => line.major && line.along === "north").map((line) => line.value_m)).toEqual([
      -10, 0, 10,
    ]);
  });

  it("has a scale bar of a round length that fits", () => {
    for (const metresPerPixel of [0.003, 0.02, 0.0357, 0.14, 1.7, 33]) {
      const { length_m, width_px } = scaleBar(metresPerPixel, 140);
      expect(width_px).toBeLessThanOrEqual(140.001);
      expect(width_px).toBeGreaterThan(50);
      expect(length_m / metresPerPixel).toBeCloseTo(width_px, 9);
    }
  });
});
