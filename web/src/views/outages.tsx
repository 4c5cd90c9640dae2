/** Where and when GNSS was missing: lanes, list, statistics, shadows. */

import { useSignal } from "@preact/signals";
import { Fragment } from "preact";
import { useEffect } from "preact/hooks";
import { fetchOutages, fetchStatistics, type OutageView } from "../api/outages";
import { fetchShadow, type ShadowCell } from "../api/shadow-map";
import { FIX_STATES, type FixState } from "../api/types";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { type Lane, Lanes } from "../components/lanes";
import { extentOf, useEmptyDesk, useNames } from "../components/past-plan";
import { TableHead } from "../components/table-head";
import type { Metres } from "../geometry/geodesy";
import type { PlanPainter } from "../plan/painter";
import { Plan } from "../plan/plan";
import { note, paths } from "../route";
import { DeskContext, useDesk } from "../store/context";
import { useSpeech } from "../text";
import { useSitePlan } from "./live";

const FIX_COLOURS: Record<FixState, string> = {
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
const LEAST_S = [0, 5, 30, 60, 300] as const;

export default function OutagesPage({ route: { query } }: ViewProps) {
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
                <Fragment key={id}>
                  <tr class="table-strong">
                    <th scope="row">{names.get(id) ?? id}</th>
                    <TallyCells tally={total} />
                  </tr>
                  {days.length > 1 &&
                    days.map((day) => (
                      <tr key={day.day}>
                        <th scope="row" class="table-sub">
                          {day.day}
                        </th>
                        <TallyCells tally={day} />
                      </tr>
                    ))}
                </Fragment>
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

function numberOf(written: string | null, allowed: readonly number[], otherwise: number): number {
  return allowed.find((value) => String(value) === written) ?? otherwise;
}
