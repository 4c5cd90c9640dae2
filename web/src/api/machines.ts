/** The last hour of a machine. */

import { checkHistory } from "./check";
import { askFor, withQuery } from "./http";
import type { HistoryView } from "./types";

/** What it said of itself after `since`. */
export function fetchHistory(id: string, since: string | null): Promise<HistoryView> {
  return askFor(withQuery(`/api/v1/machines/${encodeURIComponent(id)}/history`, { since }), checkHistory);
}
