/** The plan's grid and scale bar: round numbers of metres at every zoom. */

import type { Metres } from "./geodesy";

/** A part of the plan, m. */
export interface Extent {
  min: Metres;
  max: Metres;
}

/** The smallest of 1, 2, 5 times a power of ten that is not below `least`. */
export function roundStep(least: number): number {
  const power = 10 ** Math.floor(Math.log10(least));
  for (const factor of [1, 2, 5]) {
    // The tolerance keeps 0.2 from becoming 0.5 by rounding alone.
    if (factor * power >= least * (1 - 1e-9)) return factor * power;
  }
  return 10 * power;
}

export interface GridLine {
  /** Whether it runs north (one value of east) or east (one value of north). */
  along: "north" | "east";
  value_m: number;
  from: Metres;
  to: Metres;
  /** Every fifth is stronger. */
  major: boolean;
}

/** Grid lines `step_m` apart that cover the extent. */
export function gridLines(extent: Extent, step_m: number): GridLine[] {
  const lines: GridLine[] = [];
  const [west, south] = extent.min;
  const [east, north] = extent.max;
  for (let index = Math.floor(west / step_m); index * step_m <= east; index += 1) {
    const value_m = index * step_m;
    const major = index % 5 === 0;
    lines.push({ along: "north", value_m, from: [value_m, south], to: [value_m, north], major });
  }
  for (let index = Math.floor(south / step_m); index * step_m <= north; index += 1) {
    const value_m = index * step_m;
    const major = index % 5 === 0;
    lines.push({ along: "east", value_m, from: [west, value_m], to: [east, value_m], major });
  }
  return lines;
}

/** The longest scale bar of a round length that is at most `most_px` wide. */
export function scaleBar(metresPerPixel: number, most_px: number): { length_m: number; width_px: number } {
  const most_m = metresPerPixel * most_px;
  const power = 10 ** Math.floor(Math.log10(most_m));
  const factor = [5, 2].find((candidate) => candidate * power <= most_m * (1 + 1e-9)) ?? 1;
  return { length_m: factor * power, width_px: (factor * power) / metresPerPixel };
}
