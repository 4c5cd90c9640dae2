/** From the store's state to shapes on the plan: pure, the same for the map and for the plain fallback. */

import type { PoseView } from "../api/types";
import type { Metres } from "../geometry/geodesy";
import { CABIN, CHASSIS, circleOutline, ellipseOutline, HATCH, place } from "../geometry/shapes";
import { isStale } from "../store/freshness";
import type { Machine, State } from "../store/store";
import type { Tracing } from "../store/trace";
import type { Palette } from "./palette";
import type { Shape } from "./view";

/** Around every machine at least this is drawn, so that it is found also where its ellipse is a millimetre. */
export const RING_RADIUS_PX = 12;
/** A machine out of date fades to this. */
const FADED = 0.45;
/** Below this size of a pixel, m, the symbol itself shows the heading; above, a stroke on the ring does. */
const HEADING_STROKE_FROM_M = 0.08;

export interface SceneOptions {
  palette: Palette;
  metresPerPixel: number;
  selected: string | null;
}

export function buildShapes(state: State, options: SceneOptions): Shape[] {
  const shapes: Shape[] = [];
  for (const [id, machine] of state.machines) {
    const pose = machine.view.pose;
    if (pose === null) continue;
    const stale = isStale(state, machine);
    const opacity = stale ? FADED : 1;
    tail(shapes, machine.trace, axisOf(pose), options.palette, opacity);
    ellipse(shapes, pose, options, opacity);
    excavator(shapes, pose, options.palette, { opacity, stale, selected: id === options.selected });
  }
  return shapes;
}

/** The axis about which the cabin turns: the middle of the symbol. */
export function axisOf(pose: PoseView): Metres {
  return [pose.cabin_position_m[0], pose.cabin_position_m[1]];
}

/** Where the machines are, with room for their symbols; `null` while none is known. */
export function machinesExtent(machines: Iterable<Machine>): { min: Metres; max: Metres } | null {
  const points = [...machines].flatMap(({ view }) => (view.pose === null ? [] : [axisOf(view.pose)]));
  if (points.length === 0) return null;
  const room_m = 9;
  const east = points.map((point) => point[0]);
  const north = points.map((point) => point[1]);
  return {
    min: [Math.min(...east) - room_m, Math.min(...north) - room_m],
    max: [Math.max(...east) + room_m, Math.max(...north) + room_m],
  };
}

function positionOf(pose: PoseView): Metres {
  return [pose.position_m[0], pose.position_m[1]];
}

/** One line for each stretch of one GNSS state; the last reaches to where the machine is now. */
function tail(shapes: Shape[], trace: Tracing, now: Metres, palette: Palette, opacity: number): void {
  let points: Metres[] = [];
  let colour = palette.gnss.unknown;
  const finish = () => {
    if (points.length > 1) {
      const strokeOpacity = 0.85 * opacity;
      shapes.push({
        layer: "tail",
        kind: "line",
        points,
        stroke: colour,
        strokeOpacity,
        strokeWidth_px: 2.5,
      });
    }
  };
  for (const point of trace.tail) {
    const itsColour = palette.gnss[point.gnss ?? "unknown"];
    if (point.starts) {
      finish();
      points = [];
    } else if (itsColour !== colour) {
      points.push(point.at);
      finish();
      points = [];
    }
    colour = itsColour;
    points.push(point.at);
  }
  if (trace.tail.length > 0) points.push(now);
  finish();
}

function ellipse(shapes: Shape[], pose: PoseView, options: SceneOptions, opacity: number): void {
  const { palette, metresPerPixel } = options;
  const at = positionOf(pose);
  shapes.push({
    layer: "ellipse",
    kind: "area",
    points: ellipseOutline(at, pose.ellipse95),
    fill: palette.ellipse,
    fillOpacity: 0.28 * opacity,
    stroke: palette.ellipse,
    strokeOpacity: opacity,
    strokeWidth_px: 1.5,
  });
  const ring_m = RING_RADIUS_PX * metresPerPixel;
  if (pose.ellipse95.semi_major_m >= ring_m) return;
  const stroke = palette.ellipse;
  const points = circleOutline(at, ring_m);
  shapes.push({ layer: "ring", kind: "line", points, stroke, strokeOpacity: opacity, strokeWidth_px: 1.5 });
  if (metresPerPixel > HEADING_STROKE_FROM_M) {
    const stroke_m: Metres[] = [
      [ring_m, 0],
      [ring_m * 1.9, 0],
    ];
    const ends = place(stroke_m, at, pose.heading_deg);
    shapes.push({
      layer: "ring",
      kind: "line",
      points: ends,
      stroke,
      strokeOpacity: opacity,
      strokeWidth_px: 3,
    });
  }
}

interface Looks {
  opacity: number;
  stale: boolean;
  selected: boolean;
}

function excavator(shapes: Shape[], pose: PoseView, palette: Palette, looks: Looks): void {
  const { opacity, stale, selected } = looks;
  const axis = axisOf(pose);
  const chassisAt: Metres =
    pose.chassis_position_m === null ? axis : [pose.chassis_position_m[0], pose.chassis_position_m[1]];
  const area = (layer: "chassis" | "cabin", outline: readonly Metres[], heading_deg: number, fill: string) =>
    shapes.push({
      layer,
      kind: "area",
      points: place(outline, layer === "chassis" ? chassisAt : axis, heading_deg),
      fill,
      fillOpacity: opacity,
      stroke: selected ? palette.selection : palette.outline,
      strokeOpacity: opacity,
      strokeWidth_px: selected ? 2.5 : 1,
    });
  const chassis_deg = pose.chassis_heading_deg;
  if (chassis_deg !== null) {
    area("chassis", CHASSIS.frame, chassis_deg, palette.chassis);
    area("chassis", CHASSIS.blade, chassis_deg, palette.chassis);
    for (const track of CHASSIS.tracks) area("chassis", track, chassis_deg, palette.track);
  }
  area("cabin", CABIN.body, pose.heading_deg, palette.cabin);
  area("cabin", CABIN.boom, pose.heading_deg, palette.boom);
  area("cabin", CABIN.bucket, pose.heading_deg, palette.track);
  area("cabin", CABIN.cab, pose.heading_deg, palette.glass);
  if (!stale) return;
  for (const line of HATCH) {
    shapes.push({
      layer: "hatch",
      kind: "line",
      points: place(line, axis, pose.heading_deg),
      stroke: palette.hatch,
      strokeOpacity: 0.6,
      strokeWidth_px: 1.2,
    });
  }
}

/** The line that is being measured: its corners, and crosses where they are. */
export function measureShapes(points: readonly Metres[], palette: Palette, metresPerPixel: number): Shape[] {
  const stroke = palette.measure;
  const shapes: Shape[] = points.map((at) => ({
    layer: "measure",
    kind: "area",
    points: circleOutline(at, 4 * metresPerPixel, 12),
    fill: stroke,
  }));
  if (points.length > 1) shapes.push({ layer: "measure", kind: "line", points, stroke, strokeWidth_px: 2 });
  return shapes;
}
