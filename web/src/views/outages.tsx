/** Where and when GNSS was missing: lanes, list, statistics, and one outage with its way. */

import { signal, useSignal } from "@preact/signals";
import { useEffect, useMemo } from "preact/hooks";
import {
  fetchOutage,
  fetchOutages,
  fetchStatistics,
  type OutageDetail,
  type OutageView,
} from "../api/outages";
import { fetchSessions } from "../api/sessions";
import { fetchShadow, type ShadowCell } from "../api/shadow-map";
import { FIX_STATES, type FixState } from "../api/types";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { type Lane, Lanes } from "../components/lanes";
import { TableHead } from "../components/table-head";
import { TimePlot } from "../components/time-plot";
import type { Metres } from "../geometry/geodesy";
import type { Extent } from "../geometry/grid";
import type { PlanPainter } from "../plan/painter";
import type { Palette } from "../plan/palette";
import { Plan } from "../plan/plan";
import type { Shape } from "../plan/view";
import { note, paths } from "../route";
import { type Choices, DeskContext, type Source, useDesk } from "../store/context";
import type { State } from "../store/store";
import { useSpeech } from "../text";
import { useSitePlan } from "./live";

export const FIX_COLOURS: Record<FixState, string> = {
  fixed: "--gnss-fixed",
  float: "--gnss-float",
  degraded: "--gnss-degraded",
  frozen: "--gnss-frozen",
  jumping: "--gnss-jumping",
  silent: "--gnss-silent",
  link_lost: "--offline",
  recovering: "--gnss-recovering",
};

/** Outages begin so. */
const CAUSES = FIX_STATES.filter((state) => state !== "fixed" && state !== "recovering");
const HOUR_S = 3_600;
const PERIODS_H = [1, 24, 168, 720] as const;
const REFRESH_MS = 10_000;
const SHADOW_CELL_M = 2;
const SHADOW_REFRESH_MS = 60_000;
const NO_CELLS: readonly ShadowCell[] = [];
/** Around what a plan is to show. */
const ROOM_M = 6;
const LEAST_S = [0, 5, 30, 60, 300] as const;

export default function OutagesPage({ route }: ViewProps) {
  return route.view === "outage" ? <Detail id={route.id ?? ""} /> : <Overview query={route.query} />;
}

function Overview({ query }: { query: URLSearchParams }) {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const words = text.outages;
  const hours = useSignal<number>(numberOf(query.get("hours"), PERIODS_H, 24));
  const machine = useSignal<string>(query.get("machine") ?? "");
  const cause = useSignal<FixState | "">(CAUSES.find((known) => known === query.get("cause")) ?? "");
  const open = useSignal<"" | "open" | "ended">(query.get("state") === "open" ? "open" : "");
  const least_s = useSignal<number>(numberOf(query.get("least"), LEAST_S, 0));
  const siteNow_ms = store.calm.value.siteTime_ms ?? Date.now();
  const key = [hours.value, machine.value, cause.value, open.value, least_s.value].join();
  const from = () => new Date((store.calm.peek().siteTime_ms ?? Date.now()) - hours.value * HOUR_S * 1000);
  const asked = useAsked(
    key,
    () =>
      fetchOutages({
        machine: machine.value || null,
        cause: cause.value || null,
        state: open.value || null,
        from: from().toISOString(),
        min_duration_s: least_s.value || null,
      }),
    REFRESH_MS,
  );
  const statistics = useAsked(
    `${hours.value}`,
    () =>
      fetchStatistics(
        from().toISOString(),
        new Date(store.calm.peek().siteTime_ms ?? Date.now()).toISOString(),
      ),
    6 * REFRESH_MS,
  );
  useEffect(() => {
    note("hours", String(hours.value));
    note("machine", machine.value || null);
    note("cause", cause.value || null);
    note("state", open.value || null);
    note("least", least_s.value === 0 ? null : String(least_s.value));
  }, [key]);
  const outages = asked.value?.outages ?? [];
  const names = useNames();
  const ids = [...new Set([...names.keys(), ...outages.map((outage) => outage.machine)])].sort();
  const to_s = siteNow_ms / 1000;
  const span: [number, number] = [to_s - hours.value * HOUR_S, to_s];
  const lanes = ids
    .filter((id) => machine.value === "" || machine.value === id)
    .map(
      (id): Lane => ({
        name: names.get(id) ?? id,
        href: paths.machine(id),
        segments: outages
          .filter((outage) => outage.machine === id)
          .map((outage) => ({
            from_s: Date.parse(outage.start) / 1000,
            to_s: outage.end === null ? to_s : Date.parse(outage.end) / 1000,
            colour: FIX_COLOURS[outage.cause],
            label: `${text.fix[outage.cause]}, ${format.dateTime(Date.parse(outage.start))}, ${format.span(outage.duration_s)}`,
            href: paths.outage(outage.id),
          })),
      }),
    );
  return (
    <div class="sheet sheet-wide outages">
      <div class="section-head">
        <h1>{text.views.outages}</h1>
        <span class="print-only">
          {store.calm.value.site?.name} · {format.dateTime(siteNow_ms)}
        </span>
        <fieldset class="choice" aria-label={words.period}>
          {PERIODS_H.map((choice) => (
            <button
              key={choice}
              type="button"
              aria-pressed={hours.value === choice}
              onClick={() => (hours.value = choice)}
            >
              {words.periods(choice)}
            </button>
          ))}
        </fieldset>
        <label>
          {words.machine}{" "}
          <select value={machine.value} onChange={(event) => (machine.value = event.currentTarget.value)}>
            <option value="">{words.all}</option>
            {ids.map((id) => (
              <option key={id} value={id}>
                {names.get(id) ?? id}
              </option>
            ))}
          </select>
        </label>
        <label>
          {words.cause}{" "}
          <select
            value={cause.value}
            onChange={(event) => (cause.value = event.currentTarget.value as FixState | "")}
          >
            <option value="">{words.all}</option>
            {CAUSES.map((known) => (
              <option key={known} value={known}>
                {text.fix[known]}
              </option>
            ))}
          </select>
        </label>
        <label>
          {words.atLeast}{" "}
          <select
            value={String(least_s.value)}
            onChange={(event) => (least_s.value = Number(event.currentTarget.value))}
          >
            {LEAST_S.map((choice) => (
              <option key={choice} value={String(choice)}>
                {choice === 0 ? words.any : format.span(choice)}
              </option>
            ))}
          </select>
        </label>
        <label class="check">
          <input
            type="checkbox"
            checked={open.value === "open"}
            onChange={(event) => (open.value = event.currentTarget.checked ? "open" : "")}
          />
          {words.onlyOpen}
        </label>
        <button type="button" class="button no-print" onClick={() => window.print()}>
          {words.print}
        </button>
      </div>
      {/* On paper the fields are gone: what they were set to is not. */}
      <p class="print-only print-filter">
        {[
          `${words.period}: ${words.periods(hours.value)}`,
          `${words.machine}: ${machine.value === "" ? words.all : (names.get(machine.value) ?? machine.value)}`,
          `${words.cause}: ${cause.value === "" ? words.all : text.fix[cause.value]}`,
          `${words.atLeast}: ${least_s.value === 0 ? words.any : format.span(least_s.value)}`,
          ...(open.value === "open" ? [words.onlyOpen] : []),
        ].join(" · ")}
      </p>
      {asked.failure !== null && <p class="failure">{asked.failure}</p>}
      <Lanes wide lanes={lanes} span={span} />
      <p class="lane-axis">
        <span>{format.dateTime(span[0] * 1000)}</span>
        <span>{words.now}</span>
      </p>
      <div class="outage-columns">
        <section aria-labelledby="outage-list-title">
          <h2 id="outage-list-title">
            {words.list} <span class="count">{outages.length}</span>
          </h2>
          {asked.value !== null && outages.length === 0 && <p class="empty">{words.none}</p>}
          {outages.length > 0 && <OutageTable outages={outages} names={names} />}
          {asked.value?.more && <p class="empty">{words.more}</p>}
        </section>
        <section aria-labelledby="statistics-title">
          <h2 id="statistics-title">{words.statistics}</h2>
          {statistics.failure !== null && <p class="failure">{statistics.failure}</p>}
          <table class="table">
            <TableHead
              names={[
                words.machine,
                words.count,
                words.total,
                words.longest,
                words.share,
                words.maxSigma,
                words.maxJump,
              ]}
            />
            <tbody>
              {(statistics.value?.machines ?? []).map(({ machine: id, total, days }) => (
                <>
                  <tr key={id} class="table-strong">
                    <th scope="row">{names.get(id) ?? id}</th>
                    <TallyCells tally={total} />
                  </tr>
                  {days.length > 1 &&
                    days.map((day) => (
                      <tr key={`${id} ${day.day}`}>
                        <th scope="row" class="table-sub">
                          {day.day}
                        </th>
                        <TallyCells tally={day} />
                      </tr>
                    ))}
                </>
              ))}
            </tbody>
          </table>
          {/* The site cuts days at its own midnight, whatever zone the page tells times in. */}
          {statistics.value !== null && (
            <p class="zone" data-days-in={statistics.value.time_zone}>
              {words.daysIn(statistics.value.time_zone)}
            </p>
          )}
          <ShadowPlan hours={hours.value} machine={machine.value} />
        </section>
      </div>
    </div>
  );
}

function TallyCells({
  tally,
}: {
  tally: {
    outages: number;
    duration_s: number;
    longest_s: number;
    observed_s: number;
    without_gnss_s: number;
    position_sigma_max_m: number | null;
    jump_max_m: number | null;
  };
}) {
  const { format } = useSpeech();
  return (
    <>
      <td>{format.count(tally.outages)}</td>
      <td>{format.span(tally.duration_s)}</td>
      <td>{format.span(tally.longest_s)}</td>
      <td>{tally.observed_s > 0 ? format.percent(tally.without_gnss_s / tally.observed_s) : "–"}</td>
      <td>{format.smallLength(tally.position_sigma_max_m)}</td>
      <td>{format.smallLength(tally.jump_max_m)}</td>
    </>
  );
}

function OutageTable({ outages, names }: { outages: OutageView[]; names: Map<string, string> }) {
  const { text, format } = useSpeech();
  const words = text.outages;
  return (
    <table class="table">
      <TableHead
        names={[
          words.began,
          words.machine,
          words.cause,
          words.lasted,
          words.travelled,
          words.maxSigma,
          words.jump,
        ]}
      />
      <tbody>
        {outages.map((outage) => (
          <tr key={outage.id} data-outage={outage.id}>
            <td>
              <a href={paths.outage(outage.id)}>{format.dateTime(Date.parse(outage.start))}</a>
            </td>
            <td>{names.get(outage.machine) ?? outage.machine}</td>
            <td>
              <i
                class="dot"
                style={{ "--segment": `var(${FIX_COLOURS[outage.cause]})` }}
                aria-hidden="true"
              />
              {text.fix[outage.cause]}
            </td>
            <td>
              {format.span(outage.duration_s)}
              {outage.end === null && <b> {words.goesOn}</b>}
            </td>
            <td>{format.metres(outage.travelled_m, 1)}</td>
            <td>{format.smallLength(outage.position_sigma.max_m)}</td>
            <td>{format.smallLength(outage.jump_m)}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

/** The plan with the shadows of the period, and without machines. */
function ShadowPlan({ hours, machine }: { hours: number; machine: string }) {
  const desk = useDesk();
  const empty = useEmptyDesk();
  const { text } = useSpeech();
  const plan = useSitePlan();
  const painter = useSignal<PlanPainter | null>(null);
  const from = () =>
    new Date((desk.store.calm.peek().siteTime_ms ?? Date.now()) - hours * HOUR_S * 1000).toISOString();
  const asked = useAsked(
    `${hours} ${machine}`,
    (signal) => fetchShadow({ cell_m: SHADOW_CELL_M, from: from(), machine: machine || null }, signal),
    SHADOW_REFRESH_MS,
  );
  const cells = asked.value ?? NO_CELLS;
  const some = cells.length > 0;
  // The camera goes where something was observed, once; then it is the person's.
  useEffect(() => {
    const extent = extentOf(
      cells.flatMap(({ east_m, north_m, cell_m }): Metres[] => [
        [east_m, north_m],
        [east_m + cell_m, north_m + cell_m],
      ]),
    );
    if (extent !== null) painter.value?.show(extent);
  }, [some, painter.value]);
  return (
    <>
      <h2>{text.outages.shadow}</h2>
      {asked.failure !== null && <p class="failure">{text.plan.shadowFailed(asked.failure)}</p>}
      <DeskContext.Provider value={empty}>
        <div class="inset-plan" data-shadow-cells={cells.length}>
          <Plan
            features={plan.features}
            shadow={cells}
            onReady={(made) => {
              painter.value = made;
            }}
          />
        </div>
      </DeskContext.Provider>
    </>
  );
}

/** What holds all the points, with a little room; `null` without any. */
function extentOf(points: readonly Metres[]): Extent | null {
  if (points.length === 0) return null;
  const most = (sign: 1 | -1, axis: 0 | 1) =>
    points.reduce((found, point) => Math.max(found, sign * point[axis]), Number.NEGATIVE_INFINITY) + ROOM_M;
  return { min: [-most(-1, 0), -most(-1, 1)], max: [most(1, 0), most(1, 1)] };
}

function Detail({ id }: { id: string }) {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const words = text.outages;
  const asked = useAsked(id, () => fetchOutage(id), REFRESH_MS / 2);
  const sessions = useAsked(id, fetchSessions);
  const names = useNames();
  const outage = asked.value;
  if (outage === null) {
    return (
      <div class="sheet" aria-busy={asked.failure === null}>
        <h1>{text.views.outage}</h1>
        {asked.failure !== null && <p class="failure">{asked.failure}</p>}
        <a href={paths.outages()}>{text.views.outages}</a>
      </div>
    );
  }
  const start_ms = Date.parse(outage.start);
  const recorded = sessions.value?.sessions.find(
    ({ started, ended }) =>
      Date.parse(started) <= start_ms && (ended === null || Date.parse(ended) >= start_ms),
  );
  const facts: [string, string][] = [
    [words.cause, text.fix[outage.cause]],
    [words.began, format.dateTime(start_ms)],
    [words.ended, outage.end === null ? words.goesOn : format.dateTime(Date.parse(outage.end))],
    ...(outage.ended_by === null
      ? []
      : [[words.endedBy, words.endings[outage.ended_by]] as [string, string]]),
    [words.lasted, format.span(outage.duration_s)],
    [words.travelled, format.metres(outage.travelled_m, 1)],
    [
      words.sigma,
      `${format.smallLength(outage.position_sigma.start_m)} → ${format.smallLength(outage.position_sigma.last_m)}, ${words.atMost} ${format.smallLength(outage.position_sigma.max_m)}`,
    ],
    [words.jump, format.smallLength(outage.jump_m)],
    ...(outage.place === null
      ? []
      : [
          [
            words.place,
            `${text.plan.east} ${format.number(outage.place.position_m[0], 2)} m, ${text.plan.north} ${format.number(outage.place.position_m[1], 2)} m; ${format.degrees(outage.place.latitude_deg, 7)}, ${format.degrees(outage.place.longitude_deg, 7)}`,
          ] as [string, string],
        ]),
  ];
  return (
    <div class="sheet sheet-wide" data-outage-detail={outage.id}>
      <div class="section-head">
        <h1>
          {names.get(outage.machine) ?? outage.machine}: {text.fix[outage.cause]},{" "}
          {format.span(outage.duration_s)}
        </h1>
        <span class="print-only">{store.calm.value.site?.name}</span>
        <span class="button-row no-print">
          {recorded !== undefined && (
            <a class="button button-main" href={paths.replay(recorded.id, outage.start, outage.machine)}>
              {words.replay}
            </a>
          )}
          <a class="button" href={paths.machine(outage.machine)}>
            {words.toMachine}
          </a>
          <button type="button" class="button" onClick={() => window.print()}>
            {words.print}
          </button>
          <a href={paths.outages()}>{words.back}</a>
        </span>
      </div>
      <div class="outage-columns">
        <section aria-label={words.facts}>
          <dl class="pairs">
            {facts.map(([name, value]) => (
              <>
                <dt key={name}>{name}</dt>
                <dd>{value}</dd>
              </>
            ))}
          </dl>
          <SigmaPlots outage={outage} />
        </section>
        <section aria-label={words.way}>
          <h2>{words.way}</h2>
          <WayPlan outage={outage} />
        </section>
      </div>
    </div>
  );
}

function SigmaPlots({ outage }: { outage: OutageDetail }) {
  const { text, format } = useSpeech();
  const times_s = useMemo(() => outage.sigma.map(({ time_s }) => time_s), [outage]);
  const lines = useMemo(
    () => ({
      sigma: [
        {
          label: text.plot.sigma,
          colour: "--sigma",
          values: outage.sigma.map(({ position_sigma_m }) => position_sigma_m * 100),
        },
      ],
      way: [
        {
          label: text.outages.travelled,
          colour: "--speed",
          values: outage.sigma.map(({ travelled_m }) => travelled_m),
        },
      ],
    }),
    [outage, text],
  );
  const span: [number, number] = [0, Math.max(1, outage.duration_s)];
  const common = {
    times_s,
    span,
    syncKey: "outage",
    tick: (time_s: number) => format.span(time_s),
  };
  return (
    <div class="plots plots-single">
      <TimePlot {...common} title={text.plot.sigma} unit="cm" lines={lines.sigma} />
      <TimePlot {...common} title={text.outages.travelled} unit="m" lines={lines.way} />
    </div>
  );
}

/** A desk whose picture has no machines: the plan of what was. */
function useEmptyDesk() {
  const desk = useDesk();
  return useMemo(() => {
    const empty = signal<State>({ ...desk.store.calm.peek(), machines: new Map() });
    const source: Source = { state: empty, calm: empty };
    const choices: Choices = { ...desk.choices, selected: signal(null), following: signal(false) };
    return { store: source, choices, recorded: true };
  }, [desk.store.calm.value.site === null]);
}

function WayPlan({ outage }: { outage: OutageDetail }) {
  const empty = useEmptyDesk();
  const plan = useSitePlan();
  const points = useMemo(
    () => outage.track.map(({ position_m }): Metres => [position_m[0], position_m[1]]),
    [outage.track.length, outage.id],
  );
  const extra = useMemo(
    () => (palette: Palette) => wayShapes(points, palette.gnss[outage.cause], palette),
    [points, outage.cause],
  );
  return (
    <DeskContext.Provider value={empty}>
      <div class="inset-plan inset-plan-tall">
        <Plan
          features={plan.features}
          extra={extra}
          onReady={(painter) => {
            const extent = extentOf(points);
            if (extent !== null) painter.show(extent);
          }}
        />
      </div>
    </DeskContext.Provider>
  );
}

/** The way, with a ring where it began and a square where it ended. */
function wayShapes(points: readonly Metres[], colour: string, palette: Palette): Shape[] {
  const [first, last] = [points[0], points.at(-1)];
  if (first === undefined || last === undefined) return [];
  const around = ([east, north]: Metres, corners: number): Metres[] =>
    Array.from({ length: corners + 1 }, (_, index) => {
      const angle = ((index + 0.5) / corners) * 2 * Math.PI;
      return [east + 0.6 * Math.cos(angle), north + 0.6 * Math.sin(angle)];
    });
  return [
    { layer: "track", kind: "line", points, stroke: colour, strokeWidth_px: 3 },
    {
      layer: "track",
      kind: "area",
      points: around(first, 20),
      fill: palette.ground,
      stroke: colour,
      strokeWidth_px: 3,
    },
    { layer: "track", kind: "area", points: around(last, 4), fill: colour },
  ];
}

function useNames(): Map<string, string> {
  const { store } = useDesk();
  return new Map([...store.calm.value.machines].map(([id, { view }]) => [id, view.name]));
}

function numberOf(written: string | null, allowed: readonly number[], otherwise: number): number {
  return allowed.find((value) => String(value) === written) ?? otherwise;
}
