/** One machine: what it says now, and the last hour of it. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { fetchConfiguration, fetchHistory } from "../api/machines";
import { fetchOutages } from "../api/outages";
import type { StatePoint } from "../api/types";
import type { ViewProps } from "../app";
import { poll, useAsked } from "../components/async";
import { BudgetLine } from "../components/budget";
import { SeverityIcon } from "../components/icons";
import { Numbers, Outage } from "../components/machine-details";
import { SensorTable } from "../components/sensor-table";
import { StateLanes, StatePlots } from "../components/state-plots";
import { paths } from "../route";
import { useDesk } from "../store/context";
import { healthAge_s, healthIsFresh, isStale, shownSeverity } from "../store/freshness";
import type { Machine, State } from "../store/store";
import { useSpeech } from "../text";

const REFRESH_MS = 2_000;
const SPANS_MIN = [5, 15, 60] as const;
/** The server keeps an hour. */
const KEPT_S = 3_600;

export default function MachineView({ route }: ViewProps) {
  const id = route.id ?? "";
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const state = store.calm.value;
  const machine = state.machines.get(id);
  const minutes = useSignal<number>(5);
  const past = usePast(id);
  const recent = useAsked(id, () => fetchOutages({ machine: id }), 30_000);
  if (machine === undefined) {
    return (
      <div class="sheet">
        <h1>{id}</h1>
        <p class="empty">{state.site === null ? text.machines.waiting : text.machine.unknown}</p>
      </div>
    );
  }
  const { view } = machine;
  const severity = shownSeverity(state, machine);
  const fresh = healthIsFresh(state, machine);
  const to_s = (state.siteTime_ms ?? Date.now()) / 1000;
  const span: [number, number] = [to_s - minutes.value * 60, to_s];
  const tolerance_m = view.gnss.outage?.budget?.tolerance_m ?? null;
  return (
    <div class="sheet sheet-wide">
      <div class={`machine-head card-${severity}${isStale(state, machine) ? " stale-card" : ""}`}>
        <SeverityIcon severity={severity} />
        <h1>{view.name}</h1>
        <span class="state-word">{view.state_word}</span>
        <span class="machine-links">
          <a href={paths.live()}>{text.machine.onPlan}</a>
          <a
            href={`${paths.outages()}${paths.outages().includes("?") ? "&" : "?"}machine=${encodeURIComponent(id)}`}
          >
            {text.views.outages}
          </a>
        </span>
      </div>
      <BudgetLine machine={machine} state={state} />
      <div class="machine-columns">
        <section aria-labelledby="plots-title">
          <div class="section-head">
            <h2 id="plots-title">{text.machine.past}</h2>
            <fieldset class="choice" aria-label={text.machine.span}>
              {SPANS_MIN.map((choice) => (
                <button
                  key={choice}
                  type="button"
                  aria-pressed={minutes.value === choice}
                  onClick={() => (minutes.value = choice)}
                >
                  {text.machine.minutes(choice)}
                </button>
              ))}
            </fieldset>
            <span class="zone">{text.machine.timesIn(format.zoneName(to_s * 1000))}</span>
          </div>
          {past.length === 0 && <p class="empty">{text.machine.noPast}</p>}
          <StateLanes states={past} span={span} />
          <StatePlots states={past} span={span} tolerance_m={tolerance_m} />
        </section>
        <div class="machine-facts">
          <section aria-labelledby="numbers-title">
            <h2 id="numbers-title">{text.details.numbers}</h2>
            <Numbers machine={machine} state={state} />
          </section>
          <section aria-labelledby="sensors-title">
            <h2 id="sensors-title">{text.details.sensors}</h2>
            <p class={`takes-part${fresh ? "" : " stale"}`}>
              <TakesPart machine={machine} state={state} />
            </p>
            <SensorTable
              sensors={view.health?.report.sensors ?? []}
              extraAge_s={healthAge_s(state, machine)}
              stale={!fresh}
            />
          </section>
          <section aria-labelledby="outage-title">
            <h2 id="outage-title">{text.details.outage}</h2>
            <Outage machine={machine} state={state} />
            <ul class="plain-list">
              {(recent.value?.outages ?? []).slice(0, 8).map((outage) => (
                <li key={outage.id}>
                  <a href={paths.outage(outage.id)}>{format.dateTime(Date.parse(outage.start))}</a>{" "}
                  {text.fix[outage.cause]}, {format.span(outage.duration_s)}
                </li>
              ))}
            </ul>
          </section>
          <section aria-labelledby="about-title">
            <h2 id="about-title">{text.machine.about}</h2>
            <dl class="pairs">
              <dt>{text.machine.id}</dt>
              <dd>{view.id}</dd>
              <dt>{text.machine.software}</dt>
              <dd>{view.software === "" ? text.fields.unknown : `holdfast ${view.software}`}</dd>
              <dt>{text.fields.boot}</dt>
              <dd>{view.boot === "" ? text.fields.unknown : view.boot}</dd>
              {view.health !== null && (
                <>
                  <dt>{text.machine.inflation}</dt>
                  <dd>
                    {view.health.report.gnss_inflation.map((times) => format.number(times, 2)).join(" / ")}
                  </dd>
                  <dt>{text.machine.updates}</dt>
                  <dd>{format.count(view.health.report.updates)}</dd>
                </>
              )}
            </dl>
            {/* Another start of its program may have another one. */}
            <Configuration key={view.boot} id={id} />
          </section>
        </div>
      </div>
    </div>
  );
}

/** The machine file, asked of the machine when somebody wants to see it. */
function Configuration({ id }: { id: string }) {
  const { text } = useSpeech();
  const wanted = useSignal(false);
  return (
    <details
      class="configuration"
      onToggle={(event) => {
        wanted.value = event.currentTarget.open;
      }}
    >
      <summary>{text.machine.configuration}</summary>
      {wanted.value && <MachineFile id={id} />}
    </details>
  );
}

function MachineFile({ id }: { id: string }) {
  const { text } = useSpeech();
  const asked = useAsked(id, (signal) => fetchConfiguration(id, signal));
  if (asked.failure !== null) {
    return <p class="failure">{text.machine.configurationFailed(asked.failure)}</p>;
  }
  if (asked.value === null) {
    return (
      <p class="empty" role="status">
        {text.machine.configurationAsked}
      </p>
    );
  }
  return (
    <>
      <p class="empty">{text.machine.configurationHint}</p>
      {/* biome-ignore lint/a11y/noNoninteractiveTabindex: what scrolls has to be reached by the keyboard. */}
      <pre tabIndex={0}>{asked.value.machine_file}</pre>
    </>
  );
}

/** Which sensors the estimate is made of; of a machine that is not heard, which they were. */
function TakesPart({ machine, state }: { machine: Machine; state: State }) {
  const { text, format } = useSpeech();
  const age_s = healthAge_s(state, machine);
  if (age_s === null) return <>{text.machine.nothingTold}</>;
  const sensors = machine.view.health?.report.sensors ?? [];
  const names = sensors.filter(({ rate_hz }) => rate_hz > 0).map(({ sensor }) => text.sensor[sensor]);
  const words = text.machine;
  if (!healthIsFresh(state, machine)) return <>{words.tookPart(names.join(", "), format.age(age_s))}</>;
  return <>{names.length === 0 ? words.noSensorNow : words.takesPart(names.join(", "))}</>;
}

/** The last hour, with the site's clock as time; asks only for what is new. */
function usePast(id: string): readonly StatePoint[] {
  const states = useSignal<readonly StatePoint[]>([]);
  useEffect(() => {
    let since: string | null = null;
    states.value = [];
    return poll(async (signal) => {
      try {
        const answer = await fetchHistory(id, since, signal);
        if (signal.aborted || answer.start === null) return;
        const start_s = Date.parse(answer.start) / 1000;
        since = answer.last;
        const fresh = answer.states.map((state) => ({ ...state, time_s: start_s + state.time_s }));
        const oldest_s = (fresh.at(-1)?.time_s ?? start_s) - KEPT_S;
        states.value = [...states.value.filter(({ time_s }) => time_s >= oldest_s), ...fresh];
      } catch {
        // What is there stays; the banner says if the site is gone.
      }
    }, REFRESH_MS);
  }, [id]);
  return states.value;
}
