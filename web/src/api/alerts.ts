/** Alerts: those that are open, the history, and saying that one was seen. */

import { type Check, list, nullable, number, object, oneOf, text, time } from "./checking";
import { askFor, withQuery } from "./http";

export const ALERT_RULES = [
  "outage_longer",
  "sigma_over_tolerance",
  "machine_lost",
  "clock_off",
  "disk_low",
  "estimator_late",
  "sensor_silent",
  "id_conflict",
  "recording_paused",
] as const;
export type AlertRule = (typeof ALERT_RULES)[number];

export const ALERT_SEVERITIES = ["info", "warning", "critical"] as const;
export type AlertSeverity = (typeof ALERT_SEVERITIES)[number];

export const ALERT_STATES = ["active", "acknowledged", "cleared_unacknowledged", "cleared"] as const;
export type AlertState = (typeof ALERT_STATES)[number];

export interface Acknowledgement {
  by: string;
  at: string;
  note: string;
}

export interface AlertView {
  id: string;
  rule: AlertRule;
  severity: AlertSeverity;
  machine: string | null;
  part: string | null;
  /** In words, chosen by the site. */
  message: string;
  value: number;
  worst: number;
  state: AlertState;
  raised: string;
  times: number;
  cleared: string | null;
  acknowledged: Acknowledgement | null;
  changed: string;
}

export interface AlertsView {
  alerts: AlertView[];
  next: string | null;
}

export const checkAlert: Check<AlertView> = object<AlertView>({
  id: text,
  rule: oneOf(ALERT_RULES),
  severity: oneOf(ALERT_SEVERITIES),
  machine: nullable(text),
  part: nullable(text),
  message: text,
  value: number,
  worst: number,
  state: oneOf(ALERT_STATES),
  raised: time,
  times: number,
  cleared: nullable(time),
  acknowledged: nullable(object<Acknowledgement>({ by: text, at: time, note: text })),
  changed: time,
});

const checkAlerts = object<AlertsView>({ alerts: list(checkAlert), next: nullable(text) });

const PAGE = 200;
const OPEN_PAGES_MAX = 5;
/** Of these somebody should still know. */
const OPEN_STATES = ALERT_STATES.filter((state) => state !== "cleared");

/** So many pages of those that are in a state, newest first, and whether there are more. */
export async function fetchAlerts(
  state: AlertState | null,
  pages: number,
  signal: AbortSignal,
): Promise<{ alerts: AlertView[]; more: boolean }> {
  const alerts: AlertView[] = [];
  let cursor: string | null = null;
  for (let page = 0; page < pages; page += 1) {
    const path: string = withQuery("/api/v1/alerts", { state, limit: PAGE, cursor });
    const answer: AlertsView = await askFor(path, checkAlerts, { signal });
    alerts.push(...answer.alerts);
    cursor = answer.next;
    if (cursor === null) break;
  }
  return { alerts, more: cursor !== null };
}

/** Those that are open, for a page that has no live connection to hear of them. */
export async function fetchOpenAlerts(signal: AbortSignal): Promise<AlertView[]> {
  const answers = await Promise.all(OPEN_STATES.map((state) => fetchAlerts(state, OPEN_PAGES_MAX, signal)));
  return answers.flatMap(({ alerts }) => alerts);
}

export function acknowledge(id: string, note: string): Promise<AlertView> {
  const path = `/api/v1/alerts/${encodeURIComponent(id)}/acknowledge`;
  return askFor(path, checkAlert, { method: "POST", body: { note } });
}
