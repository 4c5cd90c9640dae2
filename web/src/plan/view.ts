/** What every way of drawing the plan can do; the map and the plain fallback are two of them. */

import type { Metres } from "../geometry/geodesy";
import type { Extent, GridLine } from "../geometry/grid";
import type { Palette } from "./palette";

/** Drawn in this order: later ones lie above. */
export const LAYERS = ["tail", "chassis", "cabin", "hatch", "ellipse", "ring"] as const;
export type Layer = (typeof LAYERS)[number];

/** One area or line of the plan, in metres; it carries its colours. */
export interface Shape {
  layer: Layer;
  /** An area is closed and filled; a line is not. */
  kind: "area" | "line";
  points: readonly Metres[];
  fill?: string;
  fillOpacity?: number;
  stroke?: string;
  strokeOpacity?: number;
  strokeWidth_px?: number;
}

export interface PlanView {
  /** Puts the shapes on the plan, in place of those before. */
  draw(shapes: readonly Shape[]): void;
  drawGrid(lines: readonly GridLine[]): void;
  setPalette(palette: Palette): void;
  /** The part that is visible. */
  extent(): Extent;
  metresPerPixel(): number;
  /** From the upper left corner of the plan. */
  toPixels(point: Metres): readonly [number, number];
  centreOn(point: Metres): void;
  fit(extent: Extent): void;
  zoomBy(factor: number): void;
  destroy(): void;
}

export interface PlanEvents {
  /** The camera moved, or the plan's size changed. */
  moved(): void;
  /** A person moved the camera. */
  taken(): void;
  /** The view cannot go on, and says why. */
  failed(reason: string): void;
}
