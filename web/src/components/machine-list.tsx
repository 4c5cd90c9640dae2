/** All machines with one plain state word each; the accessible twin of the plan. */

import type { Health } from "../api/types";
import { useDesk } from "../store/context";
import {
  HEALTH_FRESH_S,
  healthAge_s,
  isStale,
  poseAge_s,
  poseFresh_s,
  shownSeverity,
} from "../store/freshness";
import type { Machine, State } from "../store/store";
import { horizontalSigma_m } from "../store/trace";
import { type Text, useSpeech } from "../text";
import { Field } from "./field";
import { SeverityIcon } from "./icons";
import { MachineDetails } from "./machine-details";

export function MachineList() {
  const { store } = useDesk();
  const { text } = useSpeech();
  const state = store.calm.value;
  return (
    <section class="machines" id="machines" aria-labelledby="machines-title" tabIndex={-1}>
      <h2 id="machines-title">
        {text.machines.title} <span class="count">{state.machines.size}</span>
      </h2>
      {state.machines.size === 0 && (
        <p class="empty">{state.site === null ? text.machines.waiting : text.machines.none}</p>
      )}
      <ul class="machine-list">
        {[...state.machines].map(([id, machine]) => (
          <MachineCard key={id} id={id} machine={machine} state={state} />
        ))}
      </ul>
    </section>
  );
}

interface CardProps {
  id: string;
  machine: Machine;
  state: State;
}

/** What the estimate rests on; a machine without a lidar does not claim one. */
function restsOn({ mode, sensors }: Health, text: Text): string {
  const lidar = sensors.some(({ sensor, received }) => sensor === "lidar_odometry" && received > 0);
  return mode === "main" && !lidar ? text.mainWithoutLidar : text.mode[mode];
}

function MachineCard({ id, machine, state }: CardProps) {
  const { choices } = useDesk();
  const { text, format } = useSpeech();
  const { view } = machine;
  const { pose, health } = view;
  const selected = choices.selected.value === id;
  const poseAge = { age_s: poseAge_s(state, machine), fresh_s: poseFresh_s(machine) };
  const healthAge = { age_s: healthAge_s(state, machine), fresh_s: HEALTH_FRESH_S };
  const severity = shownSeverity(state, machine);
  const classes = ["card", `card-${severity}`];
  if (isStale(state, machine)) classes.push("stale-card");
  if (selected) classes.push("selected");
  const toggle = () => {
    choices.selected.value = selected ? null : id;
    if (selected) choices.following.value = false;
  };
  return (
    <li class={classes.join(" ")} data-machine={id} data-presence={view.presence}>
      <button
        type="button"
        class="card-head"
        aria-expanded={selected}
        title={selected ? text.machines.unselect(view.name) : text.machines.select(view.name)}
        onClick={toggle}
      >
        <SeverityIcon severity={severity} />
        <span class="card-name">{view.name}</span>
        <span class={`severity-word severity-${severity}`}>
          {state.link.phase === "open" ? text.severity[severity] : text.lastKnown}
        </span>
        <span class="state-word">{view.state_word}</span>
        {view.presence !== "online" && (
          <span class="presence">
            {text.presence[view.presence]}, {text.fields.since.toLowerCase()}{" "}
            {format.timeOfDay(Date.parse(view.presence_since))}
          </span>
        )}
      </button>
      <dl class="fields">
        <Field name={text.fields.positionSigma} {...poseAge}>
          {pose === null ? text.fields.unknown : format.smallLength(horizontalSigma_m(pose))}
        </Field>
        <Field name={text.fields.headingSigma} {...poseAge}>
          {format.degrees(pose?.heading_sigma_deg ?? null, 2)}
        </Field>
        <Field name={text.fields.speed} {...poseAge}>
          {format.speed(pose?.speed_mps ?? null)}
        </Field>
        <Field name={text.fields.gnss} {...healthAge}>
          {health === null ? text.fields.unknown : text.gnss[health.report.gnss]}
        </Field>
        <Field name={text.fields.mode} {...healthAge}>
          {health === null ? text.fields.unknown : restsOn(health.report, text)}
        </Field>
        <Field name={text.fields.heading} {...poseAge}>
          {format.bearing(pose?.heading_deg ?? null)}
        </Field>
      </dl>
      {health?.report.waits_for != null && (
        <p class="waits">
          {text.fields.waitsFor}: {health.report.waits_for}
        </p>
      )}
      {selected && <MachineDetails machine={machine} state={state} />}
    </li>
  );
}
