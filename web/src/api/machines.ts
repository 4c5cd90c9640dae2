/** The last hour of a machine. */

import { checkHistory } from "./check";
import { askFor, withQuery } from "./http";
import type { HistoryView } from "./types";

/** What it said of itself after `since`. */
export function fetchHistory(id: string, since: string | null, signal: AbortSignal): Promise<HistoryView> {
  const path = `/api/v1/machines/${encodeURIComponent(id)}/history`;
  return askFor(withQuery(path, { since }), checkHistory, { signal });
}
