/**
 * Outlines in metres: the excavator's symbol, the ellipse, the hatch of what is out of date.
 *
 * A body's own axes are x forward and y left; headings are compass headings (0 north, clockwise).
 */

import type { Ellipse95 } from "../api/types";
import type { Metres } from "./geodesy";

export type Outline = Metres[];

const DEGREE = Math.PI / 180.0;

/** Moves body points to the plan: `at` is the body's origin, its x axis points along the heading. */
export function place(points: readonly Metres[], at: Metres, heading_deg: number): Outline {
  const sin = Math.sin(heading_deg * DEGREE);
  const cos = Math.cos(heading_deg * DEGREE);
  return points.map(([forward, left]) => [
    at[0] + sin * forward - cos * left,
    at[1] + cos * forward + sin * left,
  ]);
}

/** The 95 % ellipse around a point, as a closed outline, true to scale. */
export function ellipseOutline(at: Metres, ellipse: Ellipse95, corners = 64): Outline {
  const body: Metres[] = [];
  for (let corner = 0; corner <= corners; corner += 1) {
    const angle = ((corner % corners) / corners) * 2.0 * Math.PI;
    body.push([ellipse.semi_major_m * Math.cos(angle), ellipse.semi_minor_m * Math.sin(angle)]);
  }
  return place(body, at, ellipse.bearing_deg);
}

/** A circle around a point, as a closed outline. */
export function circleOutline(at: Metres, radius_m: number, corners = 48): Outline {
  return ellipseOutline(at, { semi_major_m: radius_m, semi_minor_m: radius_m, bearing_deg: 0 }, corners);
}

/** Diagonal strokes inside a rectangle of the body, `spacing_m` apart along its x axis. */
export function hatchLines(
  [xMin, yMin]: Metres,
  [xMax, yMax]: Metres,
  spacing_m: number,
): [Metres, Metres][] {
  const height = yMax - yMin;
  const lines: [Metres, Metres][] = [];
  for (let x = xMin - height + spacing_m; x < xMax; x += spacing_m) {
    const start = Math.max(x, xMin);
    const end = Math.min(x + height, xMax);
    lines.push([
      [start, yMin + (start - x)],
      [end, yMin + (end - x)],
    ]);
  }
  return lines;
}

function closed(points: Metres[]): Outline {
  const [first] = points;
  return first === undefined ? [] : [...points, first];
}

function rectangle(xMin: number, xMax: number, yMin: number, yMax: number): Outline {
  return closed([
    [xMin, yMin],
    [xMax, yMin],
    [xMax, yMax],
    [xMin, yMax],
  ]);
}

/** Half the length and width of the chassis, m: a machine of the 14 t class. */
const TRACK_HALF_LENGTH_M = 2.0;
const TRACK_HALF_WIDTH_M = 1.3;
const TRACK_WIDTH_M = 0.55;

/** The chassis, origin on the turning axis: two tracks, a frame between them, a blade in front. */
export const CHASSIS = {
  tracks: [
    rectangle(
      -TRACK_HALF_LENGTH_M,
      TRACK_HALF_LENGTH_M,
      TRACK_HALF_WIDTH_M - TRACK_WIDTH_M,
      TRACK_HALF_WIDTH_M,
    ),
    rectangle(
      -TRACK_HALF_LENGTH_M,
      TRACK_HALF_LENGTH_M,
      -TRACK_HALF_WIDTH_M,
      -TRACK_HALF_WIDTH_M + TRACK_WIDTH_M,
    ),
  ],
  frame: rectangle(-1.1, 1.9, -0.75, 0.75),
  blade: rectangle(2.2, 2.45, -1.3, 1.3),
} as const;

/** The upper structure, origin on the turning axis: body with rounded counterweight, operator's cab, boom. */
export const CABIN = {
  body: closed([
    [1.0, -1.2],
    [1.0, 1.2],
    [-1.2, 1.25],
    [-1.75, 1.0],
    [-2.02, 0.5],
    [-2.1, 0.0],
    [-2.02, -0.5],
    [-1.75, -1.0],
    [-1.2, -1.25],
  ]),
  cab: closed([
    [1.05, 0.35],
    [1.05, 1.15],
    [-0.45, 1.15],
    [-0.45, 0.35],
  ]),
  boom: closed([
    [0.1, -0.42],
    [0.1, 0.12],
    [3.7, 0.02],
    [5.6, 0.0],
    [5.6, -0.3],
    [3.7, -0.32],
  ]),
  bucket: closed([
    [5.5, -0.7],
    [5.5, 0.4],
    [6.0, 0.4],
    [6.3, 0.3],
    [6.3, -0.6],
    [6.0, -0.7],
  ]),
} as const;

/** The rectangle that the hatch of an out-of-date machine fills. */
export const HATCH = hatchLines([-2.0, -1.2], [1.0, 1.2], 0.45);
