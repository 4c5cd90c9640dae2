/** What the plan draws, and what the one who draws it can do. */

import type { Metres } from "../geometry/geodesy";
import type { Extent, GridLine } from "../geometry/grid";
import type { Palette } from "./palette";

/** Drawn in this order: later ones lie above. */
export const LAYERS = ["track", "tail", "chassis", "cabin", "hatch", "ellipse", "ring", "measure"] as const;
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

/** What lies under the machines and seldom changes: kept as paths in metres. */
export interface Underlay {
  path: Path2D;
  fill?: string;
  fillOpacity?: number;
  stroke?: string;
  strokeWidth_px?: number;
}

/** Where the plan is looked at from. */
export interface Camera {
  centre: Metres;
  metresPerPixel: number;
  width_px: number;
  height_px: number;
  /** Pixels of the screen in a pixel of the plan. */
  ratio: number;
}

/** A picture of the ground, under everything else. */
export interface Backdrop {
  /** Draws what there is of it. */
  paint(onto: CanvasRenderingContext2D, camera: Camera): void;
}

/** A word at a place of the site's plan. */
export interface PlanWord {
  at: Metres;
  text: string;
}

export interface PlanView {
  /** Puts the shapes on the plan, in place of those before. */
  draw(shapes: readonly Shape[]): void;
  drawGrid(lines: readonly GridLine[]): void;
  setUnderlays(underlays: readonly Underlay[], words: readonly PlanWord[]): void;
  setPalette(palette: Palette): void;
  /** `null` for the bare ground. */
  setBackdrop(backdrop: Backdrop | null): void;
  /** There is more to draw than before. */
  redraw(): void;
  /** What a click means: the cursor says so. */
  setMeasuring(measuring: boolean): void;
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
  /** A person pressed a place of the plan, without moving it. */
  pressed(at: Metres): void;
  /** The pointer is over a place of the plan, or has left it. */
  over(at: Metres | null): void;
}
