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

export interface AlertFilter {
  machine?: string | null;
  rule?: AlertRule | null;
  state?: AlertState | null;
  cursor?: string | null;
}

export function fetchAlerts(filter: AlertFilter): Promise<AlertsView> {
  return askFor(withQuery("/api/v1/alerts", { ...filter, limit: 200 }), checkAlerts);
}

export function acknowledge(id: string, note: string): Promise<AlertView> {
  const path = `/api/v1/alerts/${encodeURIComponent(id)}/acknowledge`;
  return askFor(path, checkAlert, { method: "POST", body: { note } });
}
