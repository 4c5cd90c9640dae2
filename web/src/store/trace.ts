/**
 * What the page remembers of a machine while it is open: the tail on the plan and the last minute of numbers.
 *
 * Both are bounded. Times are the page's own monotonic clock, ms, less the age of the value on arrival.
 */

import type { GnssState, MachineView, PoseView } from "../api/types";
import type { Metres } from "../geometry/geodesy";

export const TAIL_SPAN_MS = 300_000;
export const TAIL_POINTS_MAX = 1500;
/** A new point of the tail when the machine has moved this far. */
const TAIL_STEP_M = 0.1;
/** Older than this, the line is broken: nobody knows the way between. */
const TAIL_GAP_MS = 2_000;

export const HISTORY_SPAN_MS = 60_000;
export const HISTORY_POINTS_MAX = 700;
const HISTORY_STEP_MS = 90;

export interface TailPoint {
  at: Metres;
  time_ms: number;
  /** State of the fixes then; `null` where it was not told. */
  gnss: GnssState | null;
  /** The line does not reach back to the point before. */
  starts: boolean;
}

/** Where a machine was before the page was told of it. */
export type Earlier = Omit<TailPoint, "starts">;

export interface HistoryPoint {
  time_ms: number;
  sigma_m: number;
  speed_mps: number;
}

/** What is remembered of a machine, for drawing. */
export interface Tracing {
  readonly tail: readonly TailPoint[];
  readonly history: readonly HistoryPoint[];
}

/** Standard deviation of the position in the worse of east and north, m. */
export function horizontalSigma_m(pose: PoseView): number {
  return Math.max(pose.position_sigma_m[0], pose.position_sigma_m[1]);
}

export class Trace implements Tracing {
  readonly tail: TailPoint[] = [];
  readonly history: HistoryPoint[] = [];
  private breakTail = true;
  private stamp: string | null = null;
  private newest_ms = Number.NEGATIVE_INFINITY;

  constructor(readonly boot: string) {}

  /** The next point does not join: the page was not told what lies between. */
  interrupt(): void {
    this.breakTail = true;
  }

  /** Takes in a view that arrived at `received_ms`; the same pose twice is taken once. */
  add(view: MachineView, received_ms: number): void {
    const pose = view.pose;
    if (pose === null || pose.stamp === this.stamp) return;
    this.stamp = pose.stamp;
    const time_ms = received_ms - pose.age_s * 1000;
    this.addToTail(pose, view.health?.report.gnss ?? null, time_ms);
    this.addToHistory(pose, time_ms);
    this.newest_ms = Math.max(this.newest_ms, time_ms);
  }

  /** Puts before the tail where the machine was earlier, as the site has it: oldest first, a point a second. */
  precede(earlier: readonly Earlier[]): void {
    const [first] = this.tail;
    const points: TailPoint[] = [];
    let before_ms = Number.NEGATIVE_INFINITY;
    for (const { at, time_ms, gnss } of earlier) {
      if (first !== undefined && time_ms >= first.time_ms) break;
      const last = points.at(-1);
      const starts = time_ms - before_ms > TAIL_GAP_MS;
      before_ms = time_ms;
      const moved_m = last === undefined ? 0 : Math.hypot(at[0] - last.at[0], at[1] - last.at[1]);
      if (starts || moved_m >= TAIL_STEP_M || gnss !== last?.gnss) points.push({ at, time_ms, gnss, starts });
    }
    if (first?.starts) first.starts = first.time_ms - before_ms > TAIL_GAP_MS;
    this.tail.unshift(...points);
    dropOld(this.tail, this.newest_ms - TAIL_SPAN_MS, TAIL_POINTS_MAX);
  }

  private addToTail(pose: PoseView, gnss: GnssState | null, time_ms: number): void {
    // The axis of the cabin: the way of the machine, without the swing of the body that carries the IMU.
    const at: Metres = [pose.cabin_position_m[0], pose.cabin_position_m[1]];
    const last = this.tail.at(-1);
    const starts = this.breakTail || last === undefined || time_ms - this.newest_ms > TAIL_GAP_MS;
    const moved_m = last === undefined ? 0 : Math.hypot(at[0] - last.at[0], at[1] - last.at[1]);
    if (starts || moved_m >= TAIL_STEP_M || gnss !== last?.gnss) {
      this.tail.push({ at, time_ms, gnss, starts });
      this.breakTail = false;
    }
    dropOld(this.tail, time_ms - TAIL_SPAN_MS, TAIL_POINTS_MAX);
  }

  private addToHistory(pose: PoseView, time_ms: number): void {
    const last = this.history.at(-1);
    if (last !== undefined && time_ms - last.time_ms < HISTORY_STEP_MS) return;
    this.history.push({ time_ms, sigma_m: horizontalSigma_m(pose), speed_mps: pose.speed_mps });
    dropOld(this.history, time_ms - HISTORY_SPAN_MS, HISTORY_POINTS_MAX);
  }
}

function dropOld(points: { time_ms: number }[], oldest_ms: number, most: number): void {
  let drop = Math.max(0, points.length - most);
  while (drop < points.length && (points[drop]?.time_ms ?? oldest_ms) < oldest_ms) drop += 1;
  if (drop > 0) points.splice(0, drop);
}
