/**
 * The one store: what the site said last, and since when the page has not heard from it.
 *
 * Messages only wait in `pending` (newest wins, so it is bounded by the number of machines); once per animation
 * frame they become one write of `state`. The store judges nothing: words and severities are the site's.
 */

import { type ReadonlySignal, type Signal, signal } from "@preact/signals";

import type { Delta, MachineView, Site, Snapshot, TrailPoint } from "../api/types";
import type { Source } from "./context";
import { Trace, type Tracing } from "./trace";

/** The connection to the site. */
export type Link =
  | { phase: "connecting"; since_ms: number }
  | { phase: "open"; since_ms: number }
  /** `since_ms` is when the site was last heard. */
  | { phase: "lost"; since_ms: number; retry_at_ms: number };

export interface Machine {
  view: MachineView;
  /** When `view` arrived, by the page's monotonic clock. */
  received_ms: number;
  trace: Tracing;
}

export interface State {
  /** The page's monotonic clock at this write: ages are told for this moment. */
  now_ms: number;
  link: Link;
  site: Site | null;
  /** The site's clock, ms since 1970, for `now_ms`; `null` before it spoke. */
  siteTime_ms: number | null;
  /** When the site told its views last, by the page's monotonic clock; `null` before it spoke. */
  told_ms: number | null;
  machines: ReadonlyMap<string, Machine>;
  /** Messages that could not be read, and what was wrong with the last. */
  unreadable: { count: number; last: string | null };
}

/** What the store needs from the world. */
export interface Surroundings {
  /** A monotonic clock, ms. */
  now(): number;
  /** Calls back before the next frame is drawn. */
  nextFrame(callback: () => void): void;
}

/** People read numbers at this pace: the list follows in steps of it, the plan follows every write. */
const CALM_STEP_MS = 250;

interface Pending {
  snapshot: { site: Site; received_ms: number } | null;
  views: Map<string, { view: MachineView; received_ms: number }>;
  siteTime: { time_ms: number; received_ms: number } | null;
}

export class Store implements Source {
  private readonly current: Signal<State>;
  private readonly calmed: Signal<State>;
  private pending: Pending = nothingPending();
  private link: Link;
  private unreadable: State["unreadable"] = { count: 0, last: null };
  private frameAsked = false;
  private lastSiteTime: { time_ms: number; received_ms: number } | null = null;

  constructor(private readonly surroundings: Surroundings) {
    const now_ms = surroundings.now();
    this.link = { phase: "connecting", since_ms: now_ms };
    const first: State = {
      now_ms,
      link: this.link,
      site: null,
      siteTime_ms: null,
      told_ms: null,
      machines: new Map(),
      unreadable: this.unreadable,
    };
    this.current = signal(first);
    this.calmed = signal(first);
  }

  /** Every write. */
  get state(): ReadonlySignal<State> {
    return this.current;
  }

  /** The same at a pace to read: at once when a state word, a presence or the link changes. */
  get calm(): ReadonlySignal<State> {
    return this.calmed;
  }

  /** A whole new picture: nothing from before is kept, but for the tails of machines that are still there. */
  takeSnapshot(message: Snapshot): void {
    const received_ms = this.surroundings.now();
    this.pending = nothingPending();
    this.pending.snapshot = { site: message.fleet.site, received_ms };
    this.takeViews(message.fleet.machines, message.fleet.time, received_ms);
  }

  takeDelta(message: Delta): void {
    this.takeViews(message.machines, message.time, this.surroundings.now());
  }

  /** Where a machine was before the page was opened, oldest first; `false` if the page does not know it yet. */
  recall(id: string, points: readonly TrailPoint[]): boolean {
    const trace = this.current.value.machines.get(id)?.trace;
    if (!(trace instanceof Trace) || this.lastSiteTime === null) return false;
    const begins_ms = this.lastSiteTime.received_ms - this.lastSiteTime.time_ms;
    trace.precede(
      points.map(({ time, cabin_position_m, gnss }) => ({
        at: [cabin_position_m[0], cabin_position_m[1]],
        time_ms: begins_ms + Date.parse(time),
        gnss,
      })),
    );
    this.askFrame();
    return true;
  }

  setLink(link: Link): void {
    this.link = link;
    this.askFrame();
  }

  /** Counts a message that could not be read. */
  refuse(reason: string): void {
    this.unreadable = { count: this.unreadable.count + 1, last: reason };
    this.askFrame();
  }

  /** Time passes: ages grow also when nobody speaks. */
  tick(): void {
    this.askFrame();
  }

  private takeViews(views: MachineView[], time: string, received_ms: number): void {
    for (const view of views) this.pending.views.set(view.id, { view, received_ms });
    this.pending.siteTime = { time_ms: Date.parse(time), received_ms };
    this.askFrame();
  }

  private askFrame(): void {
    if (this.frameAsked) return;
    this.frameAsked = true;
    this.surroundings.nextFrame(() => {
      this.frameAsked = false;
      this.write();
    });
  }

  private write(): void {
    const before = this.current.value;
    const { snapshot, views, siteTime } = this.pending;
    this.pending = nothingPending();
    this.lastSiteTime = siteTime ?? this.lastSiteTime;
    const now_ms = this.surroundings.now();
    const state: State = {
      now_ms,
      link: this.link,
      site: snapshot?.site ?? before.site,
      siteTime_ms:
        this.lastSiteTime === null
          ? null
          : this.lastSiteTime.time_ms + (now_ms - this.lastSiteTime.received_ms),
      told_ms: this.lastSiteTime?.received_ms ?? null,
      machines:
        snapshot === null && views.size === 0
          ? before.machines
          : mergeMachines(before.machines, views, snapshot !== null),
      unreadable: this.unreadable,
    };
    this.current.value = state;
    const calm = this.calmed.value;
    if (now_ms - calm.now_ms >= CALM_STEP_MS || speaksAnew(calm, state)) this.calmed.value = state;
  }
}

/** Seconds since a value was measured, told `age_s` old in a message that arrived at `received_ms`. */
export function ageNow_s(age_s: number, received_ms: number, now_ms: number): number {
  return age_s + Math.max(0, now_ms - received_ms) / 1000;
}

function nothingPending(): Pending {
  return { snapshot: null, views: new Map(), siteTime: null };
}

function mergeMachines(
  before: ReadonlyMap<string, Machine>,
  views: Pending["views"],
  anew: boolean,
): ReadonlyMap<string, Machine> {
  const merged = new Map<string, Machine>(anew ? [] : before);
  for (const [id, { view, received_ms }] of views) {
    const known = before.get(id)?.trace;
    const trace = known instanceof Trace && known.boot === view.boot ? known : new Trace(view.boot);
    if (anew) trace.interrupt();
    trace.add(view, received_ms);
    merged.set(id, { view, received_ms, trace });
  }
  return new Map([...merged].sort(([a], [b]) => (a < b ? -1 : 1)));
}

/** Whether something changed that nobody should wait a quarter of a second for. */
function speaksAnew(before: State, after: State): boolean {
  if (before.link.phase !== after.link.phase || before.site !== after.site) return true;
  if (before.machines.size !== after.machines.size) return true;
  for (const [id, { view }] of after.machines) {
    const old = before.machines.get(id)?.view;
    if (old?.presence !== view.presence || old.severity !== view.severity) return true;
  }
  return false;
}
