/** All machines with one plain state word each; the accessible twin of the plan. */

import { useSignal } from "@preact/signals";
import { useMemo } from "preact/hooks";
import type { Health } from "../api/types";
import { SiteFrame } from "../geometry/geodesy";
import { placeText } from "../plan/plan";
import { paths } from "../route";
import { useDesk } from "../store/context";
import {
  HEALTH_FRESH_S,
  healthAge_s,
  healthIsFresh,
  isStale,
  poseAge_s,
  poseFresh_s,
  shownSeverity,
} from "../store/freshness";
import type { Machine, State } from "../store/store";
import { horizontalSigma_m } from "../store/trace";
import { type Text, useSpeech } from "../text";
import { inWords } from "../text/told";
import { BudgetLine } from "./budget";
import { Field } from "./field";
import { SeverityIcon } from "./icons";
import { MachineDetails } from "./machine-details";
import { TableHead } from "./table-head";

/** With more machines, a line each is easier to read than a card each. */
const CARDS_MAX = 8;

/** `brief` leaves out what only the live page knows. */
export function MachineList({ brief = false }: { brief?: boolean }) {
  const { store } = useDesk();
  const { text } = useSpeech();
  const state = store.calm.value;
  const wish = useSignal<boolean | null>(null);
  const table = wish.value ?? (!brief && state.machines.size > CARDS_MAX);
  return (
    <section class="machines" id="machines" aria-labelledby="machines-title" tabIndex={-1}>
      <div class="machines-head">
        <h2 id="machines-title">
          {text.machines.title} <span class="count">{state.machines.size}</span>
        </h2>
        {!brief && (
          <button type="button" class="button" aria-pressed={table} onClick={() => (wish.value = !table)}>
            {text.machines.table}
          </button>
        )}
      </div>
      {state.machines.size === 0 && (
        <p class="empty">{state.site === null ? text.machines.waiting : text.machines.none}</p>
      )}
      {table && state.machines.size > 0 ? (
        <MachineTable state={state} />
      ) : (
        <ul class="machine-list">
          {[...state.machines].map(([id, machine]) => (
            <MachineCard key={id} id={id} machine={machine} state={state} brief={brief} />
          ))}
        </ul>
      )}
    </section>
  );
}

/** A line for each machine: the plan in words, also for those who do not see it. */
function MachineTable({ state }: { state: State }) {
  const { choices } = useDesk();
  const { text, format } = useSpeech();
  const world = state.site?.world;
  const frame = useMemo(
    () => (world === undefined ? null : new SiteFrame(world)),
    [world?.latitude_deg, world?.longitude_deg, world?.altitude_m],
  );
  return (
    <div class="table-scroll">
      <table class="table machine-table">
        <TableHead
          names={[
            text.views.machine,
            text.machines.state,
            text.fields.positionSigma,
            text.fields.headingSigma,
            text.fields.worstTest,
            text.machines.place,
            text.details.ageColumn,
          ]}
        />
        <tbody>
          {[...state.machines].map(([id, machine]) => {
            const { pose, health, name, state_word } = machine.view;
            const severity = shownSeverity(state, machine);
            const age_s = poseAge_s(state, machine);
            // A line that is old as a whole is drawn so already.
            const old = (is_old: boolean) => (is_old && !isStale(state, machine) ? "stale" : "");
            const oldPose = old(age_s !== null && age_s > poseFresh_s(machine));
            const oldHealth = old(health !== null && !healthIsFresh(state, machine));
            return (
              <tr
                key={id}
                data-machine={id}
                data-presence={machine.view.presence}
                class={`${isStale(state, machine) ? "stale" : ""}${choices.selected.value === id ? " selected" : ""}`}
              >
                <th scope="row">
                  <button type="button" class="row-button" onClick={() => (choices.selected.value = id)}>
                    <SeverityIcon severity={severity} />
                    {name}
                  </button>
                </th>
                <td class={`severity-${severity}`}>
                  <a href={paths.machine(id)}>{state_word}</a>
                </td>
                <td class={oldPose}>{pose === null ? "–" : format.smallLength(horizontalSigma_m(pose))}</td>
                <td class={oldPose}>{format.degrees(pose?.heading_sigma_deg ?? null, 2)}</td>
                <td class={oldHealth}>{format.number(health?.report.worst_test_ratio ?? null, 2)}</td>
                <td class={oldPose}>
                  {pose === null || frame === null
                    ? "–"
                    : placeText(
                        [pose.cabin_position_m[0], pose.cabin_position_m[1]],
                        choices.coordinates.value,
                        frame,
                        format,
                        text.plan,
                      )}
                </td>
                <td class={oldPose}>{format.age(age_s)}</td>
              </tr>
            );
          })}
        </tbody>
      </table>
    </div>
  );
}

interface CardProps {
  id: string;
  machine: Machine;
  state: State;
  brief: boolean;
}

/** What the estimate rests on; a machine without a lidar does not claim one. */
function restsOn({ mode, sensors }: Health, text: Text): string {
  const lidar = sensors.some(({ sensor, received }) => sensor === "lidar_odometry" && received > 0);
  return mode === "main" && !lidar ? text.mainWithoutLidar : text.mode[mode];
}

function MachineCard({ id, machine, state, brief }: CardProps) {
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
            {format.moment(Date.parse(view.presence_since), state.siteTime_ms ?? Date.now())}
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
          {text.fields.waitsFor}: {inWords(health.report.waits_for, text.told, format)}
        </p>
      )}
      {!brief && <BudgetLine machine={machine} state={state} />}
      {selected && !brief && <MachineDetails machine={machine} state={state} />}
    </li>
  );
}
