/** What the site has recorded, to take along. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { fetchSessions, recordingUrl } from "../api/sessions";
import type { SessionsView } from "../api/types";
import { useDesk } from "../store/context";
import { useSpeech } from "../text";

const REFRESH_MS = 10_000;

export function Recordings() {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const found = useSignal<SessionsView | null>(null);
  const failure = useSignal<string | null>(null);
  const connected = store.calm.value.link.phase === "open";

  useEffect(() => {
    if (!connected) return;
    let gone = false;
    const refresh = async () => {
      try {
        const view = await fetchSessions();
        if (gone) return;
        found.value = view;
        failure.value = null;
      } catch (error) {
        if (!gone) failure.value = error instanceof Error ? error.message : String(error);
      }
    };
    void refresh();
    const timer = window.setInterval(refresh, REFRESH_MS);
    return () => {
      gone = true;
      window.clearInterval(timer);
    };
  }, [connected, found, failure]);

  const recording = found.value?.recording;
  const newestFirst = [...(found.value?.sessions ?? [])].sort(
    (a, b) => Date.parse(b.started) - Date.parse(a.started),
  );
  return (
    <section class="recordings" aria-labelledby="recordings-title">
      <h2 id="recordings-title">{text.recordings.title}</h2>
      {failure.value !== null && <p class="empty">{text.recordings.failed(failure.value)}</p>}
      {recording !== undefined && recording.state !== "recording" && (
        <p class={`recording-note recording-${recording.state}`} role="status">
          {text.recordings.notRecording[recording.state]}
          {recording.why !== null && `: ${recording.why}`}
        </p>
      )}
      {found.value?.sessions.length === 0 && <p class="empty">{text.recordings.none}</p>}
      <ul>
        {newestFirst.map((session) => (
          <li key={session.id} data-session={session.id}>
            <span class={`session-state session-${session.state}`}>
              {text.recordings.states[session.state]}
            </span>
            <span class="session-started">
              {session.name !== "" && <b>{session.name} </b>}
              {format.dateTime(Date.parse(session.started))}
            </span>
            <span class="session-size">
              {session.ended !== null &&
                `${format.span((Date.parse(session.ended) - Date.parse(session.started)) / 1000)} · `}
              {format.bytes(session.bytes)} · {session.machines.join(", ")}
            </span>
            <a
              href={recordingUrl(session.id)}
              download={`${session.id}.mcap`}
              aria-label={text.recordings.downloadLabel(session.id)}
            >
              {text.recordings.download}
            </a>
          </li>
        ))}
      </ul>
    </section>
  );
}
