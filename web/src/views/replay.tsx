/** A recording, all machines in sync: on the plan, in lanes and plots, with what happened beside it. */

import { type ReadonlySignal, signal, useComputed, useSignal, useSignalEffect } from "@preact/signals";
import { useEffect, useMemo, useRef } from "preact/hooks";
import { fetchEvents, fetchSessions, fetchTrack } from "../api/sessions";
import type { EventsAnswer, SessionEvent, Site, TrackAnswer } from "../api/types";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { eventColour, eventWords, isMark } from "../components/events";
import { type Lane, Lanes } from "../components/lanes";
import { MachineList } from "../components/machine-list";
import { gnssSegments, StateLanes, StatePlots } from "../components/state-plots";
import type { Format } from "../format";
import { Plan } from "../plan/plan";
import { note, paths } from "../route";
import { type Choices, DeskContext, useDesk } from "../store/context";
import { ReplayStore } from "../store/replay";
import { type Text, useSpeech } from "../text";
import { useSitePlan } from "./live";

const SPEEDS = [0.5, 1, 2, 4, 8, 16, 32] as const;
const STEP_S = 5;
const LONG_STEP_S = 30;
/** A jump to an event goes a little before it: one sees it happen. */
const LEAD_S = 2;
const EVENTS_SHOWN = 400;

export default function ReplayView({ route }: ViewProps) {
  const id = route.id ?? "";
  const { store } = useDesk();
  const { text } = useSpeech();
  const track = useAsked(id, (signal) => fetchTrack(id, signal));
  const events = useAsked(id, (signal) => fetchEvents(id, signal));
  const site = store.calm.value.site;
  if (track.value === null || site === null) {
    return (
      <div class="sheet" aria-busy={track.failure === null}>
        <h1>{text.views.replay}</h1>
        {track.failure === null ? (
          <p class="empty" role="status">
            {text.replay.reading}
          </p>
        ) : (
          <p class="failure" role="alert">
            {text.replay.failed(track.failure)}
          </p>
        )}
        <a href={paths.sessions()}>{text.views.sessions}</a>
      </div>
    );
  }
  if (track.value.start === null) {
    return (
      <div class="sheet">
        <h1>{text.views.replay}</h1>
        <p class="empty">{text.replay.nothing}</p>
        <a href={paths.sessions()}>{text.views.sessions}</a>
      </div>
    );
  }
  return <Player key={id} answer={track.value} events={events.value} site={site} query={route.query} />;
}

interface PlayerProps {
  answer: TrackAnswer;
  events: EventsAnswer | null;
  site: Site;
  query: URLSearchParams;
}

function Player({ answer, events, site, query }: PlayerProps) {
  const live = useDesk();
  const { text, format } = useSpeech();
  const plan = useSitePlan();
  const about = useAsked(answer.session, fetchSessions);
  const replay = useMemo(
    () =>
      new ReplayStore(answer, site, {
        silent: (since_s) => text.replay.silent(format.span(since_s)),
        notYet: text.replay.notYet,
      }),
    [answer, text],
  );
  const playing = useSignal(false);
  const speed = useSignal<number>(1);
  const own = useMemo(
    (): Choices => ({
      ...live.choices,
      selected: signal(query.get("machine")),
      following: signal(false),
    }),
    [],
  );
  const now = useComputed((): number | null => replay.time_s.value);
  const start_ms = replay.start_ms;
  const length_s = answer.length_s;
  const span: [number, number] = [0, Math.max(1, length_s)];

  useEffect(() => {
    const at = query.get("at");
    const wanted = at === null ? Number(query.get("t") ?? 0) : (Date.parse(at) - start_ms) / 1000;
    replay.seek(Number.isFinite(wanted) ? wanted : 0);
  }, [replay]);

  const seek = (time_s: number) => {
    replay.seek(time_s);
    note("at", null);
    note("t", replay.time_s.peek().toFixed(1));
  };

  // One step for each frame that the browser draws.
  useSignalEffect(() => {
    if (!playing.value) return;
    let before_ms: number | null = null;
    let frame = requestAnimationFrame(function step(now_ms) {
      const passed_s = before_ms === null ? 0 : (now_ms - before_ms) / 1000;
      before_ms = now_ms;
      // A page that was in the background does not leap.
      const next_s = replay.time_s.peek() + Math.min(0.5, passed_s) * speed.peek();
      replay.seek(next_s, true);
      if (next_s >= length_s) {
        playing.value = false;
        return;
      }
      frame = requestAnimationFrame(step);
    });
    return () => {
      cancelAnimationFrame(frame);
      note("t", replay.time_s.peek().toFixed(1));
    };
  });

  const marks = useMemo(
    () => marksOf(answer, events?.events ?? [], start_ms, text, format),
    [answer, events, start_ms, text, format],
  );
  const jump = (forward: boolean) => {
    const at_s = replay.time_s.peek() + LEAD_S;
    const target = forward
      ? marks.find(({ time_s }) => time_s > at_s + 0.05)
      : marks.findLast(({ time_s }) => time_s < at_s - 0.05 - (playing.peek() ? 1 : 0));
    if (target === undefined) return;
    own.selected.value = target.machine;
    seek(target.time_s - LEAD_S);
  };
  const faster = (steps: number) => {
    const index = SPEEDS.indexOf(speed.peek() as (typeof SPEEDS)[number]);
    speed.value = SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, index + steps))] ?? 1;
  };
  const keys = useRef<(event: KeyboardEvent) => void>(() => {});
  keys.current = (event) => {
    const target = event.target instanceof HTMLElement ? event.target : null;
    // Fields, buttons and the scrubber have keys of their own.
    const typing = target?.closest("input:not([type=range]), textarea, select") != null;
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const on_button = target?.closest("button, a, summary") != null;
    const step_s = event.shiftKey ? LONG_STEP_S : STEP_S;
    const actions: Record<string, () => void> = {
      ArrowLeft: () => seek(replay.time_s.peek() - step_s),
      ArrowRight: () => seek(replay.time_s.peek() + step_s),
      Home: () => seek(0),
      End: () => seek(length_s),
      n: () => jump(true),
      p: () => jump(false),
      "[": () => faster(-1),
      "]": () => faster(1),
      ...(on_button ? {} : { " ": () => (playing.value = !playing.value) }),
    };
    const action = actions[event.key];
    if (action === undefined) return;
    event.preventDefault();
    action();
  };
  useEffect(() => {
    const hear = (event: KeyboardEvent) => keys.current(event);
    document.addEventListener("keydown", hear);
    return () => document.removeEventListener("keydown", hear);
  }, []);

  const lanes = useMemo(
    (): Lane[] =>
      answer.machines.map((machine) => ({
        name: machine.name,
        segments: [
          ...gnssSegments(machine.states, Math.max(4, 4 * answer.step_s), text.gnss),
          ...machine.silences.map(({ from_s, to_s }) => ({
            from_s,
            to_s,
            colour: "--offline",
            label: text.replay.noData,
            unknown: true,
          })),
        ],
        marks: marks.filter((mark) => mark.machine === machine.id),
      })),
    [answer, marks, text],
  );
  const selected = own.selected.value;
  const machine = answer.machines.find(({ id }) => id === selected) ?? answer.machines[0];
  const session = about.value?.sessions.find(({ id }) => id === answer.session);
  return (
    <DeskContext.Provider value={{ store: replay, choices: own, recorded: true }}>
      <div class="recorded-bar" data-recorded>
        <span class="recorded-word">{text.replay.recorded}</span>
        <h1>{session?.name || format.dateTime(start_ms)}</h1>
        <Clock replay={replay} />
        {!answer.finished && <span class="recorded-note">{text.replay.unfinished}</span>}
        {session !== undefined && session.notes !== "" && <span class="recorded-note">{session.notes}</span>}
        <a class="to-live" href={paths.live()}>
          {text.replay.toLive}
        </a>
      </div>
      <div class="replay-top">
        <Plan features={plan.features} />
        <div class="side">
          <MachineList brief />
          <EventList
            events={marks}
            left_out={events?.left_out ?? 0}
            names={new Map(answer.machines.map(({ id, name }) => [id, name]))}
            now_s={replay.calm.value.now_ms / 1000}
            start_ms={start_ms}
            onPick={(event) => {
              own.selected.value = event.machine;
              seek(event.time_s - LEAD_S);
            }}
          />
        </div>
      </div>
      <section class="controls" aria-label={text.replay.controls}>
        <div class="control-row">
          <button
            type="button"
            class="button button-main play"
            aria-label={playing.value ? text.replay.pause : text.replay.play}
            onClick={() => {
              if (replay.time_s.peek() >= length_s) seek(0);
              playing.value = !playing.value;
            }}
          >
            {playing.value ? "❚❚" : "▶"}
          </button>
          <button type="button" class="button" onClick={() => jump(false)} disabled={marks.length === 0}>
            {text.replay.previous}
          </button>
          <button type="button" class="button" onClick={() => jump(true)} disabled={marks.length === 0}>
            {text.replay.next}
          </button>
          <label class="speed">
            {text.replay.speed}{" "}
            <select
              value={String(speed.value)}
              onChange={(event) => (speed.value = Number(event.currentTarget.value))}
            >
              {SPEEDS.map((times) => (
                <option key={times} value={String(times)}>
                  {format.number(times, times < 1 ? 1 : 0)}×
                </option>
              ))}
            </select>
          </label>
          <span class="keys">{text.replay.keys}</span>
        </div>
        <Scrubber replay={replay} onSeek={seek} />
        <Lanes wide lanes={lanes} span={span} now={now} onPick={seek} />
      </section>
      {machine !== undefined && (
        <section class="replay-plots" aria-labelledby="replay-plots-title">
          <div class="section-head">
            <h2 id="replay-plots-title">{machine.name}</h2>
            {answer.machines.length > 1 && (
              <fieldset class="choice" aria-label={text.replay.whose}>
                {answer.machines.map(({ id, name }) => (
                  <button
                    key={id}
                    type="button"
                    aria-pressed={machine.id === id}
                    onClick={() => (own.selected.value = id)}
                  >
                    {name}
                  </button>
                ))}
              </fieldset>
            )}
            <span class="zone">
              {text.replay.missing(format.count(machine.poses_missing))} ·{" "}
              {text.machine.timesIn(format.zoneName(start_ms))}
            </span>
          </div>
          <AbsolutePlots
            key={machine.id}
            machine={machine}
            start_ms={start_ms}
            length_s={length_s}
            step_s={answer.step_s}
            now={now}
            onSeek={seek}
          />
        </section>
      )}
    </DeskContext.Provider>
  );
}

/** A moment that one would jump to. */
interface Mark {
  /** Since the start of the recording. */
  time_s: number;
  machine: string;
  /** In words. */
  label: string;
  colour: string;
}

/** What machines told, and where nothing was heard of them. */
function marksOf(
  answer: TrackAnswer,
  events: readonly SessionEvent[],
  start_ms: number,
  text: Text,
  format: Format,
): Mark[] {
  const told = events.filter(isMark).map(
    (event): Mark => ({
      time_s: (Date.parse(event.time) - start_ms) / 1000,
      machine: event.machine,
      label: eventWords(event.event, text, format),
      colour: eventColour(event.event),
    }),
  );
  const silent = answer.machines.flatMap(({ id, silences }) =>
    silences.map(
      ({ from_s, to_s }): Mark => ({
        time_s: from_s,
        machine: id,
        label: text.replay.silence(format.span(to_s - from_s)),
        colour: "--offline",
      }),
    ),
  );
  return [...told, ...silent].sort((a, b) => a.time_s - b.time_s);
}

/** The plots by the time of day. */
function AbsolutePlots({
  machine,
  start_ms,
  length_s,
  step_s,
  now,
  onSeek,
}: {
  machine: TrackAnswer["machines"][number];
  start_ms: number;
  length_s: number;
  step_s: number;
  now: ReadonlySignal<number | null>;
  onSeek(time_s: number): void;
}) {
  const start_s = start_ms / 1000;
  const states = useMemo(
    () => machine.states.map((state) => ({ ...state, time_s: start_s + state.time_s })),
    [machine, start_s],
  );
  const at = useComputed(() => (now.value === null ? null : start_s + now.value));
  const common = {
    states,
    span: useMemo((): [number, number] => [start_s, start_s + Math.max(1, length_s)], [start_s, length_s]),
    gap_s: Math.max(4, 4 * step_s),
    now: at,
    onPick: (time_s: number) => onSeek(time_s - start_s),
  };
  return (
    <>
      <StateLanes {...common} />
      <StatePlots {...common} tolerance_m={null} />
    </>
  );
}

function Clock({ replay }: { replay: ReplayStore }) {
  const { text, format } = useSpeech();
  const time_s = replay.calm.value.now_ms / 1000;
  return (
    <span class="recorded-clock">
      <time>{format.dateTime(replay.start_ms + time_s * 1000)}</time>{" "}
      <span class="recorded-note">
        {text.replay.position(format.span(time_s), format.span(replay.answer.length_s))}
      </span>
    </span>
  );
}

function Scrubber({ replay, onSeek }: { replay: ReplayStore; onSeek(time_s: number): void }) {
  const { text, format } = useSpeech();
  const time_s = replay.calm.value.now_ms / 1000;
  return (
    <input
      class="scrubber"
      type="range"
      min="0"
      max={String(replay.answer.length_s)}
      step="0.1"
      value={String(time_s)}
      aria-label={text.replay.moment}
      aria-valuetext={format.timeOfDay(replay.start_ms + time_s * 1000)}
      onInput={(event) => onSeek(Number(event.currentTarget.value))}
    />
  );
}

function EventList({
  events,
  left_out,
  names,
  now_s,
  start_ms,
  onPick,
}: {
  events: Mark[];
  left_out: number;
  names: Map<string, string>;
  now_s: number;
  start_ms: number;
  onPick(event: Mark): void;
}) {
  const { text, format } = useSpeech();
  return (
    <section class="events" aria-labelledby="events-title">
      <h2 id="events-title">
        {text.replay.events} <span class="count">{events.length}</span>
      </h2>
      {events.length === 0 && <p class="empty">{text.replay.noEvents}</p>}
      <ol class="event-list">
        {events.slice(0, EVENTS_SHOWN).map((event) => (
          <li key={`${event.time_s} ${event.machine} ${event.label}`}>
            <button
              type="button"
              class={Math.abs(event.time_s - now_s - LEAD_S) < 1 ? "event event-now" : "event"}
              onClick={() => onPick(event)}
            >
              <i style={{ "--segment": `var(${event.colour})` }} aria-hidden="true" />
              <time>{format.tick(start_ms + event.time_s * 1000, 1)}</time>
              <span>
                <b>{names.get(event.machine) ?? event.machine}</b> {event.label}
              </span>
            </button>
          </li>
        ))}
      </ol>
      {(left_out > 0 || events.length > EVENTS_SHOWN) && (
        <p class="empty">
          {text.replay.leftOut(format.count(left_out + Math.max(0, events.length - EVENTS_SHOWN)))}
        </p>
      )}
    </section>
  );
}
