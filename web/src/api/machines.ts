/** One machine: its last hour, and how it is configured. */

import { checkConfiguration, checkHistory, checkTrajectory } from "./check";
import { askFor, withQuery } from "./http";
import type { ConfigurationView, HistoryView, TrajectoryView } from "./types";

/** What it said of itself after `since`. */
export function fetchHistory(id: string, since: string | null, signal: AbortSignal): Promise<HistoryView> {
  const path = `/api/v1/machines/${encodeURIComponent(id)}/history`;
  return askFor(withQuery(path, { since }), checkHistory, { signal });
}

/** The machine itself is asked: one that is away does not answer. */
export function fetchConfiguration(id: string, signal: AbortSignal): Promise<ConfigurationView> {
  const path = `/api/v1/machines/${encodeURIComponent(id)}/configuration`;
  return askFor(path, checkConfiguration, { signal });
}

/** Where it was after `since`, in the last hour. */
export function fetchTrajectory(id: string, since: string): Promise<TrajectoryView> {
  const path = `/api/v1/machines/${encodeURIComponent(id)}/trajectory`;
  return askFor(withQuery(path, { since }), checkTrajectory);
}
