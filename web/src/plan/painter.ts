/**
 * Keeps a plan view true to the store: one repaint per frame, and the camera's two wishes, fit and follow.
 *
 * Until a person takes the camera, it keeps all machines in sight.
 */

import { effect, type ReadonlySignal, type Signal, signal } from "@preact/signals";

import type { Severity } from "../api/types";
import type { Metres } from "../geometry/geodesy";
import { type Extent, type GridLine, gridLines, roundStep, scaleBar } from "../geometry/grid";
import type { Desk } from "../store/context";
import { isStale, shownSeverity } from "../store/freshness";
import type { State } from "../store/store";
import { onceAFrame } from "./once-a-frame";
import type { Palette } from "./palette";
import { axisOf, buildShapes, machinesExtent, measureShapes } from "./scene";
import type { PlanView, Shape } from "./view";

const GRID_STEP_PX = 90;
const SCALE_BAR_PX = 140;
/** A press so near to a machine is one on it. */
const PICK_M = 2.5;
const PICK_PX = 14;
/** With more machines, those that are well do not say so on the plan. */
const WORDY_MACHINES_MAX = 12;
/** A label stands above its machine's body, but not off it by more than this when zoomed in. */
const LABEL_LIFT_M = 2.6;
const LABEL_LIFT_MIN_PX = 26;
const LABEL_LIFT_MAX_PX = 110;
/** With a little room. */
const LABEL_HEIGHT_PX = 30;
/** Machines further from the edge have no label. */
const OUTSIDE_PX = 120;

export interface Label {
  id: string;
  name: string;
  word: string;
  severity: Severity;
  stale: boolean;
  selected: boolean;
  x: number;
  y: number;
}

export interface GridLabel {
  along: GridLine["along"];
  value_m: number;
  offset_px: number;
}

/** What a plan shows beside the machines. */
export interface Extras {
  /** Corners of the line that is measured; `null` while nothing is. */
  measure: ReadonlySignal<readonly Metres[] | null>;
  /** Such as the way of a machine in an outage. */
  shapes: ReadonlySignal<readonly Shape[]>;
}

/** What lies over the plan as HTML. */
export interface Furniture {
  labels: Label[];
  grid: GridLabel[];
  gridStep_m: number;
  scale: { length_m: number; width_px: number };
}

const BARE: Furniture = { labels: [], grid: [], gridStep_m: 1, scale: { length_m: 0, width_px: 0 } };

export class PlanPainter {
  private readonly laid: Signal<Furniture> = signal(BARE);
  private readonly stopWatching: () => void;
  private readonly repaint = onceAFrame(() => this.paint());
  private keepAllInSight = true;
  private moving = false;
  /** How many machines the last fit was for. */
  private fitted = 0;
  /** What was drawn last: nothing is drawn again while all of it stays. */
  private drawn: readonly unknown[] = [];
  private covered: { extent: Extent; step_m: number } | null = null;

  constructor(
    private readonly desk: Desk,
    private readonly view: PlanView,
    private palette: Palette,
    private readonly extras: Extras,
  ) {
    this.stopWatching = effect(() => {
      // Reading them is what makes this run again.
      void desk.store.state.value;
      void desk.choices.selected.value;
      void desk.choices.following.value;
      void extras.measure.value;
      void extras.shapes.value;
      this.ask();
    });
  }

  get furniture(): ReadonlySignal<Furniture> {
    return this.laid;
  }

  setPalette(palette: Palette): void {
    this.palette = palette;
    this.view.setPalette(palette);
    this.ask();
  }

  /** Shows all machines, and keeps them in sight from now on. */
  fit(): void {
    this.keepAllInSight = true;
    this.desk.choices.following.value = false;
    this.fitNow(this.desk.store.state.value);
    this.ask();
  }

  /** Shows a part of the plan. */
  show(extent: Extent): void {
    this.taken();
    this.view.fit(extent);
  }

  /** The machine whose symbol is at that place. */
  machineAt(at: Metres): string | null {
    const reach_m = Math.max(PICK_M, PICK_PX * this.view.metresPerPixel());
    let found: { id: string; distance_m: number } | null = null;
    for (const [id, { view }] of this.desk.store.state.value.machines) {
      if (view.pose === null) continue;
      const [east, north] = axisOf(view.pose);
      const distance_m = Math.hypot(east - at[0], north - at[1]);
      if (distance_m <= reach_m && distance_m < (found?.distance_m ?? Infinity)) found = { id, distance_m };
    }
    return found?.id ?? null;
  }

  zoomBy(factor: number): void {
    this.keepAllInSight = false;
    this.view.zoomBy(factor);
  }

  /** A person moved the camera: it is theirs now. */
  taken(): void {
    this.keepAllInSight = false;
    this.desk.choices.following.value = false;
  }

  /** The camera moved: what lies over the plan moves in the same frame. */
  moved(): void {
    if (this.moving) return;
    this.layFurniture(this.desk.store.state.value);
    this.ask();
  }

  destroy(): void {
    this.stopWatching();
    this.repaint.cancel();
  }

  private ask(): void {
    this.repaint.ask();
  }

  private paint(): void {
    const state = this.desk.store.state.value;
    this.moving = true;
    const moved = this.moveCamera(state);
    this.moving = false;
    const selected = this.desk.choices.selected.value;
    const metresPerPixel = this.view.metresPerPixel();
    const stale = [...state.machines.values()].map((machine) => isStale(state, machine)).join();
    const measure = this.extras.measure.value;
    const extra = this.extras.shapes.value;
    const { palette } = this;
    const wanted = [
      state.machines,
      state.link.phase,
      selected,
      palette,
      metresPerPixel,
      stale,
      measure,
      extra,
    ];
    // Time passes more often than anything changes.
    if (!moved && wanted.every((value, index) => value === this.drawn[index])) return;
    this.drawn = wanted;
    this.view.draw([
      ...extra,
      ...buildShapes(state, { palette, metresPerPixel, selected }),
      ...(measure === null ? [] : measureShapes(measure, palette, metresPerPixel)),
    ]);
    this.layFurniture(state);
  }

  /** Whether the camera was moved. */
  private moveCamera(state: State): boolean {
    const { selected, following } = this.desk.choices;
    const pose = state.machines.get(selected.value ?? "")?.view.pose ?? null;
    if (following.value && pose !== null) {
      this.keepAllInSight = false;
      this.view.centreOn(axisOf(pose));
      return true;
    }
    if (this.keepAllInSight && !this.allInSight(state)) {
      this.fitNow(state);
      return true;
    }
    return false;
  }

  private allInSight(state: State): boolean {
    const poses = [...state.machines.values()].flatMap(({ view }) => (view.pose === null ? [] : [view.pose]));
    const extent = this.view.extent();
    return poses.length === this.fitted && poses.every((pose) => contains(extent, around(axisOf(pose), 4)));
  }

  private fitNow(state: State): void {
    const extent = machinesExtent(state.machines.values());
    if (extent === null) return;
    this.fitted = [...state.machines.values()].filter(({ view }) => view.pose !== null).length;
    this.view.fit(extent);
  }

  private layFurniture(state: State): void {
    const extent = this.view.extent();
    const metresPerPixel = this.view.metresPerPixel();
    const step_m = roundStep(metresPerPixel * GRID_STEP_PX);
    this.coverWithGrid(extent, step_m);
    this.laid.value = {
      labels: this.labels(state),
      grid: this.gridLabels(extent, step_m),
      gridStep_m: step_m,
      scale: scaleBar(metresPerPixel, SCALE_BAR_PX),
    };
  }

  private labels(state: State): Label[] {
    const { min, max } = this.view.extent();
    const width_px = this.view.toPixels(max)[0];
    const height_px = this.view.toPixels(min)[1];
    const body_px = LABEL_LIFT_M / this.view.metresPerPixel();
    const lift_px = Math.min(LABEL_LIFT_MAX_PX, Math.max(LABEL_LIFT_MIN_PX, body_px));
    const placed: (Label & { half_px: number })[] = [];
    // Who needs attention has the first choice of places.
    const rank = { bad: 0, warning: 1, offline: 2, good: 3 };
    const inOrder = [...state.machines].sort(
      ([, a], [, b]) => rank[shownSeverity(state, a)] - rank[shownSeverity(state, b)],
    );
    for (const [id, machine] of inOrder) {
      const { pose, name, state_word } = machine.view;
      if (pose === null) continue;
      const [x, y] = this.view.toPixels(axisOf(pose));
      if (x < -OUTSIDE_PX || y < -OUTSIDE_PX || x > width_px + OUTSIDE_PX || y > height_px + OUTSIDE_PX)
        continue;
      const stale = isStale(state, machine);
      const severity = shownSeverity(state, machine);
      const crowded = state.machines.size > WORDY_MACHINES_MAX && severity === "good";
      const word = crowded ? "" : state_word;
      // About as wide as its words: kept from being cut off at the sides.
      const half_px = 30 + 3.4 * (name.length + word.length);
      const inside_px = Math.max(Math.min(x, width_px - half_px), half_px);
      const selected = id === this.desk.choices.selected.value;
      const label = { id, name, word, severity, stale, selected, x: inside_px, y: y - lift_px, half_px };
      // Machines that stand close together: one label above the other.
      let below = placed.find((other) => overlap(label, other));
      // In a crowd, those that are well can do without a label: their symbols are there, and the list.
      if (below !== undefined && crowded && !selected) continue;
      for (let step = 0; below !== undefined && step < placed.length; step += 1) {
        label.y = below.y - LABEL_HEIGHT_PX;
        below = placed.find((other) => overlap(label, other));
      }
      placed.push(label);
    }
    return placed;
  }

  private gridLabels(extent: Extent, step_m: number): GridLabel[] {
    const height_px = this.view.toPixels(extent.min)[1];
    const labels = gridLines(extent, step_m).map(({ along, value_m, from }): GridLabel => {
      const at: Metres = along === "north" ? [value_m, extent.min[1]] : [from[0], value_m];
      const [x, y] = this.view.toPixels(at);
      return { along, value_m, offset_px: along === "north" ? x : y };
    });
    // The corners belong to the buttons, the legend, and one of the two rows of labels.
    return labels.filter(({ along, offset_px }) =>
      along === "north" ? offset_px > 40 : offset_px > 52 && offset_px < height_px - 76,
    );
  }

  /** The lines reach a screen further than what is seen, and are drawn anew when that is used up. */
  private coverWithGrid(extent: Extent, step_m: number): void {
    const done = this.covered;
    if (done !== null && done.step_m === step_m && contains(done.extent, extent)) return;
    const width = extent.max[0] - extent.min[0];
    const height = extent.max[1] - extent.min[1];
    const wide: Extent = {
      min: [extent.min[0] - width, extent.min[1] - height],
      max: [extent.max[0] + width, extent.max[1] + height],
    };
    this.covered = { extent: wide, step_m };
    this.view.drawGrid(gridLines(wide, step_m));
  }
}

interface Placed {
  x: number;
  y: number;
  half_px: number;
}

function overlap(one: Placed, other: Placed): boolean {
  return (
    Math.abs(one.x - other.x) < one.half_px + other.half_px && Math.abs(one.y - other.y) < LABEL_HEIGHT_PX
  );
}

function around([east, north]: Metres, room_m: number): Extent {
  return { min: [east - room_m, north - room_m], max: [east + room_m, north + room_m] };
}

function contains(outer: Extent, inner: Extent): boolean {
  return (
    outer.min[0] <= inner.min[0] &&
    outer.min[1] <= inner.min[1] &&
    outer.max[0] >= inner.max[0] &&
    outer.max[1] >= inner.max[1]
  );
}
