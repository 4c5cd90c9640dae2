/** The list of recordings. */

import { checkSessions } from "./check";
import type { SessionsView } from "./types";

export async function fetchSessions(): Promise<SessionsView> {
  const response = await fetch("/api/v1/sessions?limit=1000", {
    headers: { accept: "application/json" },
    cache: "no-store",
    signal: AbortSignal.timeout(10_000),
  });
  if (!response.ok) throw new Error(`the site answered ${response.status}`);
  return checkSessions(await response.json());
}

export function recordingUrl(id: string): string {
  return `/api/v1/sessions/${encodeURIComponent(id)}/recording.mcap`;
}
