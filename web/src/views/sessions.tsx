/** What the site has recorded: to replay, to take along, to write notes to. */

import { useSignal } from "@preact/signals";
import {
  editSession,
  exportUrl,
  fetchSessions,
  recordingUrl,
  startSession,
  stopSession,
} from "../api/sessions";
import type { SessionView } from "../api/types";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { reasonOf } from "../components/reason";
import { paths } from "../route";
import { useDesk } from "../store/context";
import { mayOperate } from "../store/people";
import { useSpeech } from "../text";

const REFRESH_MS = 10_000;
/** What programs of surveyors and offices read; a session of several machines fits in each of them. */
const EXPORTS = ["csv", "geojson", "gpx", "kml"] as const;

export default function SessionsPage(_props: ViewProps) {
  const { text } = useSpeech();
  const asked = useAsked("sessions", fetchSessions, REFRESH_MS);
  const wanted = useSignal("");
  const failure = useSignal<string | null>(null);
  const recording = asked.value?.recording;
  const found = wanted.value.trim().toLowerCase();
  const sessions = (asked.value?.sessions ?? []).filter((session) =>
    [session.id, session.name, session.notes, ...session.tags, ...session.machines]
      .join(" ")
      .toLowerCase()
      .includes(found),
  );
  const act = async (action: () => Promise<unknown>) => {
    try {
      await action();
      failure.value = null;
    } catch (error) {
      failure.value = reasonOf(error, text);
    }
    asked.again();
  };
  return (
    <div class="sheet recordings">
      <div class="section-head">
        <h1>{text.recordings.title}</h1>
        {recording !== undefined && (
          <p class={`recording-note recording-${recording.state}`} role="status">
            {recording.state === "recording"
              ? text.recordings.running
              : text.recordings.notRecording[recording.state]}
            {recording.why !== null && `: ${recording.why}`}
          </p>
        )}
        {mayOperate.value && recording !== undefined && recording.state !== "off" && (
          <span class="button-row">
            <button type="button" class="button" onClick={() => void act(startSession)}>
              {recording.state === "recording" ? text.recordings.startNext : text.recordings.start}
            </button>
            {recording.session !== null && recording.state === "recording" && (
              <button
                type="button"
                class="button"
                onClick={() => void act(() => stopSession(recording.session ?? ""))}
              >
                {text.recordings.stop}
              </button>
            )}
          </span>
        )}
        <label class="search">
          {text.recordings.search}{" "}
          <input
            type="search"
            value={wanted.value}
            onInput={(event) => (wanted.value = event.currentTarget.value)}
          />
        </label>
      </div>
      {asked.failure !== null && <p class="failure">{text.recordings.failed(asked.failure)}</p>}
      {failure.value !== null && (
        <p class="failure" role="alert">
          {failure.value}
        </p>
      )}
      {asked.value !== null && sessions.length === 0 && (
        <p class="empty">{found === "" ? text.recordings.none : text.recordings.noneFound}</p>
      )}
      <ul class="session-list">
        {sessions.map((session) => (
          <SessionRow key={session.id} session={session} changed={asked.again} />
        ))}
      </ul>
    </div>
  );
}

function SessionRow({ session, changed }: { session: SessionView; changed(): void }) {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const editing = useSignal(false);
  const names = session.machines.map((id) => store.calm.value.machines.get(id)?.view.name ?? id);
  const started_ms = Date.parse(session.started);
  return (
    <li class="session" data-session={session.id}>
      <div class="session-main">
        <a class="session-title" href={paths.replay(session.id)}>
          {session.name !== "" ? session.name : format.dateTime(started_ms)}
        </a>
        <span class={`session-state session-${session.state}`}>{text.recordings.states[session.state]}</span>
        <p class="session-facts">
          {session.name !== "" && `${format.dateTime(started_ms)} · `}
          {session.ended !== null && `${format.span((Date.parse(session.ended) - started_ms) / 1000)} · `}
          {format.bytes(session.bytes)} · {names.join(", ")}
        </p>
        {session.tags.length > 0 && (
          <ul class="tags" aria-label={text.recordings.tags}>
            {session.tags.map((tag) => (
              <li key={tag}>{tag}</li>
            ))}
          </ul>
        )}
        {session.notes !== "" && <p class="session-notes">{session.notes}</p>}
        {editing.value && (
          <NotesForm
            session={session}
            done={() => {
              editing.value = false;
              changed();
            }}
          />
        )}
      </div>
      <div class="session-actions">
        <a class="button button-main" href={paths.replay(session.id)}>
          {text.recordings.replay}
        </a>
        {mayOperate.value && (
          <button
            type="button"
            class="button"
            aria-expanded={editing.value}
            onClick={() => (editing.value = !editing.value)}
          >
            {text.recordings.edit}
          </button>
        )}
        <a
          class="button"
          href={recordingUrl(session.id)}
          download={`${session.id}.mcap`}
          aria-label={text.recordings.downloadLabel(session.id)}
        >
          {text.recordings.download}
        </a>
        <details class="menu">
          <summary class="button">{text.recordings.export}</summary>
          <div class="menu-body">
            {EXPORTS.map((kind) => (
              <a key={kind} href={exportUrl(session.id, kind)} download={`${session.id}.${kind}`}>
                {text.recordings.formats[kind]}
              </a>
            ))}
          </div>
        </details>
      </div>
    </li>
  );
}

function NotesForm({ session, done }: { session: SessionView; done(): void }) {
  const { text } = useSpeech();
  const failure = useSignal<string | null>(null);
  const save = async (form: HTMLFormElement) => {
    const fields = new FormData(form);
    const written = (name: string) => String(fields.get(name) ?? "").trim();
    const tags = written("tags")
      .split(",")
      .map((tag) => tag.trim())
      .filter((tag) => tag !== "");
    try {
      await editSession(session.id, { name: written("name"), notes: written("notes"), tags });
      done();
    } catch (error) {
      failure.value = reasonOf(error, text);
    }
  };
  return (
    <form
      class="form"
      onSubmit={(event) => {
        event.preventDefault();
        void save(event.currentTarget);
      }}
    >
      <label>
        {text.recordings.name}
        <input name="name" defaultValue={session.name} />
      </label>
      <label>
        {text.recordings.notes}
        <textarea name="notes" rows={3} defaultValue={session.notes} />
      </label>
      <label>
        {text.recordings.tagsHint}
        <input name="tags" defaultValue={session.tags.join(", ")} />
      </label>
      {failure.value !== null && (
        <p class="failure" role="alert">
          {failure.value}
        </p>
      )}
      <button type="submit" class="button button-main">
        {text.recordings.save}
      </button>
    </form>
  );
}
