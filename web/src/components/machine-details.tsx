/** Everything the site says about one machine: numbers, the last minute, sensors, the outage. */

import type { PoseView } from "../api/types";
import { paths } from "../route";
import {
  HEALTH_FRESH_S,
  healthAge_s,
  healthIsFresh,
  poseAge_s,
  poseFresh_s,
  SITE_FRESH_S,
  siteAge_s,
} from "../store/freshness";
import type { Machine, State } from "../store/store";
import { useSpeech } from "../text";
import { Field } from "./field";
import { HistoryPlot } from "./history-plot";
import { SensorTable } from "./sensor-table";

interface DetailsProps {
  machine: Machine;
  state: State;
}

export function MachineDetails({ machine, state }: DetailsProps) {
  const { text } = useSpeech();
  const { view } = machine;
  const healthAge = healthAge_s(state, machine);
  return (
    <section class="details" aria-label={text.details.title(view.name)}>
      <p>
        <a href={paths.machine(view.id)}>{text.machine.page}</a>
      </p>
      <h3>{text.details.lastMinute}</h3>
      <HistoryPlot name={view.name} trace={machine.trace} now_ms={state.now_ms} />
      <h3>{text.details.numbers}</h3>
      <Numbers machine={machine} state={state} />
      <h3>{text.details.sensors}</h3>
      <SensorTable
        sensors={view.health?.report.sensors ?? []}
        extraAge_s={healthAge}
        stale={!healthIsFresh(state, machine)}
      />
      <h3>{text.details.outage}</h3>
      <Outage machine={machine} state={state} />
    </section>
  );
}

export function Numbers({ machine, state }: DetailsProps) {
  const { text, format } = useSpeech();
  const { pose, health, link, boot } = machine.view;
  const poseAge = { age_s: poseAge_s(state, machine), fresh_s: poseFresh_s(machine) };
  const healthAge = { age_s: healthAge_s(state, machine), fresh_s: HEALTH_FRESH_S };
  const siteAge = { age_s: siteAge_s(state), fresh_s: SITE_FRESH_S };
  const worst = health?.report ?? null;
  return (
    <dl class="fields fields-wide">
      {pose !== null && <PoseNumbers pose={pose} age={poseAge} />}
      {worst !== null && (
        <Field name={text.fields.worstTest} hint={text.fields.worstTestHint} {...healthAge}>
          {format.number(worst.worst_test_ratio, 2)}
          {worst.worst_test_sensor !== null && ` (${text.sensor[worst.worst_test_sensor]})`}
        </Field>
      )}
      <Field name={text.fields.poseRate} {...siteAge}>
        {format.rate(link.pose_rate_hz)}
      </Field>
      <Field name={text.fields.missed} {...siteAge}>
        {text.fields.missedValue(format.count(link.missed), format.count(link.received + link.missed))}
      </Field>
      <Field name={text.fields.gaps} {...siteAge}>
        {text.fields.gapsValue(
          format.count(link.gaps_open),
          format.count(link.gaps_filled),
          format.count(link.gaps_lost),
        )}
      </Field>
      <Field name={text.fields.refused} {...siteAge}>
        {format.count(link.refused)}
      </Field>
      <Field name={text.fields.clockOffset} {...(link.clock_offset_s === null ? siteAge : healthAge)}>
        {link.clock_offset_s === null
          ? text.fields.unknown
          : `${format.number(link.clock_offset_s * 1000, 1)} ms`}
      </Field>
      <Field name={text.fields.boot}>{boot === "" ? text.fields.unknown : boot}</Field>
    </dl>
  );
}

function PoseNumbers({ pose, age }: { pose: PoseView; age: { age_s: number | null; fresh_s: number } }) {
  const { text, format } = useSpeech();
  const { semi_major_m, semi_minor_m, bearing_deg } = pose.ellipse95;
  return (
    <>
      <Field name={text.fields.position} {...age}>
        {pose.position_m.map((metres) => format.number(metres, 3)).join(" / ")} m
      </Field>
      <Field name={text.fields.geodetic} {...age}>
        {format.degrees(pose.latitude_deg, 7)}, {format.degrees(pose.longitude_deg, 7)}
      </Field>
      <Field name={text.fields.altitude} {...age}>
        {format.metres(pose.altitude_m, 3)}
      </Field>
      <Field name={text.fields.ellipse} {...age}>
        {text.fields.ellipseValue(
          format.smallLength(semi_major_m),
          format.smallLength(semi_minor_m),
          format.bearing(bearing_deg),
        )}
      </Field>
      <Field name={text.fields.chassisHeading} {...age}>
        {format.bearing(pose.chassis_heading_deg)}
      </Field>
    </>
  );
}

/** The last outage, as the machine tells it. */
export function Outage({ machine, state }: DetailsProps) {
  const { text, format } = useSpeech();
  const report = machine.view.health?.report;
  if (report?.outage == null) return <p class="empty">{text.details.outageNone}</p>;
  const { outage } = report;
  const lasted_s = ((outage.end_stamp_ns ?? report.stamp_ns) - outage.start_stamp_ns) / 1e9;
  // What is over stays as it was; what runs is as old as the report.
  const age =
    outage.end_stamp_ns === null ? { age_s: healthAge_s(state, machine), fresh_s: HEALTH_FRESH_S } : {};
  const now_ms = state.siteTime_ms ?? Date.now();
  return (
    <dl class="fields fields-wide">
      <Field
        name={outage.end_stamp_ns === null ? text.details.outageRunning : text.details.outageLast}
        {...age}
      >
        {format.span(lasted_s)}
      </Field>
      <Field name={text.details.outageCause}>{text.gnss[outage.cause]}</Field>
      <Field name={text.details.outageBegan}>{format.moment(outage.start_stamp_ns / 1e6, now_ms)}</Field>
      <Field name={text.details.outageTravelled} {...age}>
        {format.metres(outage.travelled_m, 1)}
      </Field>
      {outage.jump_m !== null && (
        <Field name={text.details.outageJump}>{format.smallLength(outage.jump_m)}</Field>
      )}
    </dl>
  );
}
