/** Outages of GNSS and lost links: the list, one with its track, statistics. */

import { type Check, list, nullable, number, object, oneOf, text, time, vector3 } from "./checking";
import { askFor, withQuery } from "./http";
import { FIX_STATES, type FixState, type Vector3 } from "./types";

export const ENDINGS = ["recovered", "link_back", "restarted", "unheard"] as const;
export type Ending = (typeof ENDINGS)[number];

export interface SigmaSummary {
  start_m: number | null;
  last_m: number | null;
  max_m: number | null;
}

export interface PlaceView {
  position_m: Vector3;
  latitude_deg: number;
  longitude_deg: number;
  altitude_m: number;
}

export interface OutageView {
  id: string;
  machine: string;
  cause: FixState;
  start: string;
  end: string | null;
  ended_by: Ending | null;
  duration_s: number;
  travelled_m: number | null;
  jump_m: number | null;
  position_sigma: SigmaSummary;
  place: PlaceView | null;
}

export interface SigmaView {
  time_s: number;
  travelled_m: number;
  position_sigma_m: number;
}

export interface TrackView extends PlaceView {
  time_s: number;
}

export interface OutageDetail extends OutageView {
  sigma: SigmaView[];
  track: TrackView[];
}

export interface OutagesView {
  outages: OutageView[];
  next: string | null;
}

export interface CauseTally {
  cause: FixState;
  outages: number;
  duration_s: number;
}

export interface Tally {
  outages: number;
  duration_s: number;
  longest_s: number;
  travelled_m: number;
  jump_max_m: number | null;
  position_sigma_max_m: number | null;
  by_cause: CauseTally[];
  link_losses: number;
  link_lost_s: number;
  observed_s: number;
  float_s: number;
  without_gnss_s: number;
}

export interface DayStatistics extends Tally {
  day: string;
}

export interface MachineStatistics {
  machine: string;
  total: Tally;
  days: DayStatistics[];
}

export interface Statistics {
  from: string;
  to: string;
  time_zone: string;
  machines: MachineStatistics[];
}

const place = {
  position_m: vector3,
  latitude_deg: number,
  longitude_deg: number,
  altitude_m: number,
};

const outage = {
  id: text,
  machine: text,
  cause: oneOf(FIX_STATES),
  start: time,
  end: nullable(time),
  ended_by: nullable(oneOf(ENDINGS)),
  duration_s: number,
  travelled_m: nullable(number),
  jump_m: nullable(number),
  position_sigma: object<SigmaSummary>({
    start_m: nullable(number),
    last_m: nullable(number),
    max_m: nullable(number),
  }),
  place: nullable(object<PlaceView>(place)),
};

const checkOutages = object<OutagesView>({ outages: list(object<OutageView>(outage)), next: nullable(text) });

const checkOutage = object<OutageDetail>({
  ...outage,
  sigma: list(object<SigmaView>({ time_s: number, travelled_m: number, position_sigma_m: number })),
  track: list(object<TrackView>({ time_s: number, ...place })),
});

const tallyFields = {
  outages: number,
  duration_s: number,
  longest_s: number,
  travelled_m: number,
  jump_max_m: nullable(number),
  position_sigma_max_m: nullable(number),
  by_cause: list(object<CauseTally>({ cause: oneOf(FIX_STATES), outages: number, duration_s: number })),
  link_losses: number,
  link_lost_s: number,
  observed_s: number,
  float_s: number,
  without_gnss_s: number,
};

const checkStatistics: Check<Statistics> = object<Statistics>({
  from: time,
  to: time,
  time_zone: text,
  machines: list(
    object<MachineStatistics>({
      machine: text,
      total: object<Tally>(tallyFields),
      days: list(object<DayStatistics>({ day: text, ...tallyFields })),
    }),
  ),
});

export interface OutageFilter {
  machine?: string | null;
  cause?: FixState | null;
  state?: "open" | "ended" | null;
  from?: string | null;
  to?: string | null;
  min_duration_s?: number | null;
}

/** A page holds so many; a view shows so many pages at most. */
const PAGE = 500;
const PAGES_MAX = 4;

/** Newest first, and whether there are more. */
export async function fetchOutages(filter: OutageFilter): Promise<{ outages: OutageView[]; more: boolean }> {
  const outages: OutageView[] = [];
  let cursor: string | null = null;
  for (let page = 0; page < PAGES_MAX; page += 1) {
    const path: string = withQuery("/api/v1/outages", { ...filter, limit: PAGE, cursor });
    const answer: OutagesView = await askFor(path, checkOutages);
    outages.push(...answer.outages);
    cursor = answer.next;
    if (cursor === null) break;
  }
  return { outages, more: cursor !== null };
}

export function fetchOutage(id: string): Promise<OutageDetail> {
  return askFor(`/api/v1/outages/${encodeURIComponent(id)}`, checkOutage);
}

export function fetchStatistics(from: string, to: string): Promise<Statistics> {
  return askFor(withQuery("/api/v1/outages/statistics", { from, to }), checkStatistics);
}
