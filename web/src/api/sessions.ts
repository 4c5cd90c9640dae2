/** Recordings: the list, what people write to them, start and stop, and what machines did in them. */

import { checkEvents, checkSessions, checkTrack, sessionView } from "./check";
import { ask, askFor, LONG_PATIENCE_MS, withQuery } from "./http";
import type { EventsAnswer, SessionsView, SessionView, TrackAnswer } from "./types";

export function fetchSessions(): Promise<SessionsView> {
  return askFor("/api/v1/sessions?limit=1000", checkSessions);
}

export function recordingUrl(id: string): string {
  return `${pathOf(id)}/recording.mcap`;
}

export function fetchTrack(id: string, signal?: AbortSignal): Promise<TrackAnswer> {
  return askFor(`${pathOf(id)}/track`, checkTrack, {
    patience_ms: LONG_PATIENCE_MS,
    ...(signal === undefined ? {} : { signal }),
  });
}

export function fetchEvents(id: string, signal?: AbortSignal): Promise<EventsAnswer> {
  return askFor(`${pathOf(id)}/events`, checkEvents, {
    patience_ms: LONG_PATIENCE_MS,
    ...(signal === undefined ? {} : { signal }),
  });
}

export interface NotesChange {
  name?: string;
  notes?: string;
  tags?: string[];
}

export function editSession(id: string, change: NotesChange): Promise<SessionView> {
  return askFor(pathOf(id), sessionView, { method: "PATCH", body: change });
}

export function startSession(): Promise<SessionView> {
  return askFor("/api/v1/sessions", sessionView, { method: "POST" });
}

export async function stopSession(id: string): Promise<void> {
  await ask(`${pathOf(id)}/stop`, { method: "POST" });
}

/** Where one file of a session is exported to; formats as the command line has them. */
export function exportUrl(id: string, format: string): string {
  return withQuery(`${pathOf(id)}/export`, { format });
}

function pathOf(id: string): string {
  return `/api/v1/sessions/${encodeURIComponent(id)}`;
}
