/**
 * How old a value may be before it is drawn as out of date.
 *
 * This is a matter of drawing, field by field; whether a machine is online is the site's word (`presence`).
 */

import type { Severity } from "../api/types";
import { ageNow_s, type Machine, type State } from "./store";

/** Where no pose has come yet, so that nothing can be said of its age. */
const POSE_FRESH_S = 0.5;
/** Health comes once a second. */
export const HEALTH_FRESH_S = 2.5;
/** The site speaks at least once a second. */
export const SITE_FRESH_S = 2.5;

export function poseAge_s(state: State, { view, received_ms }: Machine): number | null {
  return view.pose === null ? null : ageNow_s(view.pose.age_s, received_ms, state.now_ms);
}

/** How old a machine's pose may be: the site says it, by the pace at which the machine sends. */
export function poseFresh_s({ view }: Machine): number {
  return view.pose?.fresh_s ?? POSE_FRESH_S;
}

export function healthAge_s(state: State, { view, received_ms }: Machine): number | null {
  return view.health === null ? null : ageNow_s(view.health.age_s, received_ms, state.now_ms);
}

/** Of what the site itself counts and judges: as old as its last word. */
export function siteAge_s({ told_ms, now_ms }: State): number | null {
  return told_ms === null ? null : ageNow_s(0, told_ms, now_ms);
}

/** Whether what a machine says of itself is of now: it reports, and the site passes that on. */
export function healthIsFresh(state: State, machine: Machine): boolean {
  const age_s = healthAge_s(state, machine);
  return age_s !== null && age_s <= HEALTH_FRESH_S;
}

/** Whether the machine as a whole is drawn as out of date: by the site's word, or because the site is silent. */
export function isStale(state: State, machine: Machine): boolean {
  return machine.view.presence !== "online" || state.link.phase !== "open" || oldPose(state, machine);
}

/** What to draw: the site's word while it speaks; nobody's word is good for a machine once the site is silent. */
export function shownSeverity(state: State, { view }: Machine): Severity {
  return state.link.phase === "open" ? view.severity : "offline";
}

function oldPose(state: State, machine: Machine): boolean {
  // The site says when a pose is stale; the page only steps in when the site says nothing more.
  return (poseAge_s(state, machine) ?? 0) > 4 * poseFresh_s(machine);
}
