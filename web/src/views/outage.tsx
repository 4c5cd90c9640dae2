/** One outage: facts, sigma, way, and where to see more of it. */

import { Fragment } from "preact";
import { useMemo } from "preact/hooks";
import { fetchOutage, type OutageDetail } from "../api/outages";
import { fetchSessions } from "../api/sessions";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { extentOf, useEmptyDesk, useNames } from "../components/past-plan";
import { TimePlot } from "../components/time-plot";
import type { Metres } from "../geometry/geodesy";
import type { Palette } from "../plan/palette";
import { Plan } from "../plan/plan";
import type { Shape } from "../plan/view";
import { paths } from "../route";
import { DeskContext, useDesk } from "../store/context";
import { useSpeech } from "../text";
import { useSitePlan } from "./live";

const REFRESH_MS = 5_000;

export default function OutagePage({ route }: ViewProps) {
  const id = route.id ?? "";
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const words = text.outages;
  const asked = useAsked(id, () => fetchOutage(id), REFRESH_MS);
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
              <Fragment key={name}>
                <dt>{name}</dt>
                <dd>{value}</dd>
              </Fragment>
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
