/**
 * A recording as a picture of the fleet: the same shapes as live, for any moment of it.
 *
 * Between two poses the machine is drawn between them; where none came, the last one grows old. Words are those
 * that the site chose for what the machine said then.
 */

import { type ReadonlySignal, type Signal, signal } from "@preact/signals";

import type {
  MachineTrack,
  MachineView,
  PoseView,
  Site,
  StatePoint,
  TrackAnswer,
  Vector3,
} from "../api/types";
import { SiteFrame } from "../geometry/geodesy";
import type { Source } from "./context";
import type { Machine, State } from "./store";
import { TAIL_POINTS_MAX, TAIL_SPAN_MS, type TailPoint } from "./trace";

/** A recording says nothing of links: without a pose for so long, nothing is known. */
const SILENT_S = 2;
const CALM_STEP_MS = 200;

/** The words that the page itself has for a recording. */
export interface ReplayWords {
  silent(since_s: number): string;
  notYet: string;
}

export class ReplayStore implements Source {
  private readonly current: Signal<State>;
  private readonly calmed: Signal<State>;
  private readonly moment: Signal<number>;
  private readonly machines: readonly Recorded[];
  private calmed_ms = Number.NEGATIVE_INFINITY;

  constructor(
    readonly answer: TrackAnswer,
    private readonly site: Site,
    private readonly words: ReplayWords,
    private readonly now: () => number = () => performance.now(),
  ) {
    const frame = new SiteFrame(site.world);
    this.machines = answer.machines.map((track) => new Recorded(track, frame, answer.step_s));
    this.moment = signal(0);
    const first = this.stateAt(0);
    this.current = signal(first);
    this.calmed = signal(first);
  }

  get state(): ReadonlySignal<State> {
    return this.current;
  }

  get calm(): ReadonlySignal<State> {
    return this.calmed;
  }

  /** Since the start of the recording, s. */
  get time_s(): ReadonlySignal<number> {
    return this.moment;
  }

  get start_ms(): number {
    return this.answer.start === null ? 0 : Date.parse(this.answer.start);
  }

  /** Shows a moment; `calmly` says that the next follows at once. */
  seek(time_s: number, calmly = false): void {
    const clamped = Math.min(this.answer.length_s, Math.max(0, time_s));
    this.moment.value = clamped;
    const state = this.stateAt(clamped);
    this.current.value = state;
    const now_ms = this.now();
    if (!calmly || now_ms - this.calmed_ms >= CALM_STEP_MS) {
      this.calmed_ms = now_ms;
      this.calmed.value = state;
    }
  }

  private stateAt(time_s: number): State {
    const now_ms = time_s * 1000;
    return {
      now_ms,
      link: { phase: "open", since_ms: 0 },
      site: this.site,
      siteTime_ms: this.start_ms + now_ms,
      told_ms: now_ms,
      machines: new Map(
        this.machines.map((machine) => [machine.id, machine.at(time_s, this.start_ms, this.words)]),
      ),
      unreadable: { count: 0, last: null },
    };
  }
}

class Recorded {
  readonly id: string;
  private readonly tail: readonly TailPoint[];
  private readonly fresh_s: number;

  constructor(
    private readonly track: MachineTrack,
    private readonly frame: SiteFrame,
    step_s: number,
  ) {
    this.id = track.id;
    this.fresh_s = Math.max(0.5, 2.5 * step_s);
    this.tail = tailOf(track, Math.max(SILENT_S, 3 * step_s));
  }

  at(time_s: number, start_ms: number, words: ReplayWords): Machine {
    const { poses, states } = this.track;
    const index = lastBefore(poses.time_s.length, (at) => (poses.time_s[at] ?? 0) <= time_s);
    const told = states[lastBefore(states.length, (at) => (states[at]?.time_s ?? 0) <= time_s)] ?? null;
    const pose = index < 0 ? null : this.poseAt(index, time_s, start_ms);
    const spoke_s = Math.max(poses.time_s[index] ?? -1, told?.time_s ?? -1);
    const silence_s = time_s - spoke_s;
    const silent = spoke_s < 0 || silence_s > Math.max(SILENT_S, 2 * this.fresh_s);
    const newest = lastBefore(this.tail.length, (at) => (this.tail[at]?.time_ms ?? 0) <= time_s * 1000);
    const oldest = lastBefore(
      this.tail.length,
      (at) => (this.tail[at]?.time_ms ?? 0) < time_s * 1000 - TAIL_SPAN_MS,
    );
    const from = Math.max(oldest + 1, newest + 1 - TAIL_POINTS_MAX);
    const view: MachineView = {
      id: this.id,
      name: this.track.name,
      presence: silent ? "stale" : "online",
      presence_since: new Date(start_ms + Math.max(0, spoke_s) * 1000).toISOString(),
      boot: "",
      software: this.track.software,
      state_word: silent
        ? spoke_s < 0
          ? words.notYet
          : words.silent(silence_s)
        : (told?.state_word ?? words.notYet),
      severity: silent ? "offline" : (told?.severity ?? "warning"),
      pose,
      health: told === null ? null : healthOf(told, time_s, start_ms),
      gnss: {
        state: told?.gnss ?? "silent",
        since: new Date(start_ms).toISOString(),
        mode: told?.mode ?? null,
        outage: null,
      },
      link: {
        pose_rate_hz: told?.pose_rate_hz ?? 0,
        received: poses.time_s.length,
        missed: this.track.poses_missing,
        refused: 0,
        gaps_open: 0,
        gaps_filled: 0,
        gaps_lost: 0,
        clock_offset_s: told?.clock_offset_s ?? null,
      },
    };
    return {
      view,
      received_ms: time_s * 1000,
      trace: { tail: newest < 0 ? [] : this.tail.slice(from, newest + 1), history: [] },
    };
  }

  private poseAt(index: number, time_s: number, start_ms: number): PoseView {
    const { poses } = this.track;
    const at_s = poses.time_s[index] ?? 0;
    const next_s = poses.time_s[index + 1];
    const joins = next_s !== undefined && next_s - at_s <= 2 * this.fresh_s;
    const share = joins ? (time_s - at_s) / (next_s - at_s) : 0;
    const other = joins ? index + 1 : index;
    const shown_s = joins ? time_s : at_s;
    const position_m = between(poses.position_m, index, other, share);
    const [longitude_deg, latitude_deg] = this.frame.toLngLat([position_m[0], position_m[1]]);
    const [semi_major_m, semi_minor_m, bearing_deg] = poses.ellipse95[index] ?? [0, 0, 0];
    return {
      stamp: new Date(start_ms + shown_s * 1000).toISOString(),
      age_s: time_s - shown_s,
      fresh_s: this.fresh_s,
      position_m,
      latitude_deg,
      longitude_deg,
      altitude_m: this.frame.origin.altitude_m + position_m[2],
      cabin_position_m: between(poses.cabin_position_m, index, other, share),
      heading_deg: turned(poses.heading_deg[index] ?? 0, poses.heading_deg[other] ?? 0, share),
      heading_sigma_deg: poses.heading_sigma_deg[index] ?? 0,
      chassis_heading_deg: betweenHeadings(poses.chassis_heading_deg, index, other, share),
      chassis_position_m: betweenPlaces(poses.chassis_position_m, index, other, share),
      speed_mps: poses.speed_mps[index] ?? 0,
      position_sigma_m: poses.position_sigma_m[index] ?? [0, 0, 0],
      ellipse95: { semi_major_m, semi_minor_m, bearing_deg },
    };
  }
}

function healthOf(told: StatePoint, time_s: number, start_ms: number): MachineView["health"] {
  return {
    age_s: Math.max(0, time_s - told.time_s),
    estimate_age_s: told.estimate_age_s,
    prediction_p99_us: told.prediction_p99_us,
    report: {
      stamp_ns: (start_ms + told.time_s * 1000) * 1e6,
      mode: told.mode,
      waits_for: told.waits_for,
      gnss: told.gnss,
      gnss_inflation: [],
      position_sigma_m: told.position_sigma_m,
      heading_sigma_deg: told.heading_sigma_deg,
      worst_test_ratio: told.worst_test_ratio,
      worst_test_sensor: told.worst_test_sensor,
      sensors: told.rates.map(({ sensor, rate_hz }) => ({
        sensor,
        rate_hz,
        age_s: null,
        received: rate_hz > 0 ? 1 : 0,
        refused: 0,
        last_refusal: null,
      })),
      outage: null,
      updates: 0,
      update_us: told.update_us,
      gyro_bias: told.gyro_bias,
      accel_bias: told.accel_bias,
    },
  };
}

function tailOf({ poses, states }: MachineTrack, gap_s: number): TailPoint[] {
  let told = 0;
  let last_s = Number.NEGATIVE_INFINITY;
  return poses.time_s.map((time_s, index) => {
    while (told + 1 < states.length && (states[told + 1]?.time_s ?? Infinity) <= time_s) told += 1;
    const state = states[told];
    const [east = 0, north = 0] = poses.cabin_position_m[index] ?? [];
    const starts = time_s - last_s > gap_s;
    last_s = time_s;
    const gnss = state !== undefined && state.time_s <= time_s ? state.gnss : null;
    return { at: [east, north], time_ms: time_s * 1000, gnss, starts };
  });
}

/** The last index for which it holds, if it holds for all before; -1 if for none. */
export function lastBefore(length: number, holds: (index: number) => boolean): number {
  let low = 0;
  let high = length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (holds(middle)) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

function between(values: readonly Vector3[], index: number, other: number, share: number): Vector3 {
  const one = values[index] ?? [0, 0, 0];
  const two = values[other] ?? one;
  const mix = (axis: 0 | 1 | 2) => one[axis] + (two[axis] - one[axis]) * share;
  return [mix(0), mix(1), mix(2)];
}

function betweenPlaces(
  values: readonly (Vector3 | null)[],
  index: number,
  other: number,
  share: number,
): Vector3 | null {
  const [one, two] = [values[index] ?? null, values[other] ?? null];
  return one === null ? null : between([one, two ?? one], 0, 1, share);
}

function betweenHeadings(
  values: readonly (number | null)[],
  index: number,
  other: number,
  share: number,
): number | null {
  const [one, two] = [values[index] ?? null, values[other] ?? null];
  return one === null ? null : turned(one, two ?? one, share);
}

/** The shorter way round. */
export function turned(from_deg: number, to_deg: number, share: number): number {
  const way = ((to_deg - from_deg + 540) % 360) - 180;
  return (from_deg + way * share + 360) % 360;
}
