/** The alerts that are open: over but not seen, or not over. The live connection brings them. */

import { computed, type ReadonlySignal, signal } from "@preact/signals";

import type { AlertView } from "../api/alerts";

/** `null` before the site said which there are: that is not the same as none. */
const open = signal<readonly AlertView[] | null>(null);

export const alertsTold: ReadonlySignal<boolean> = computed(() => open.value !== null);

export const openAlerts: ReadonlySignal<readonly AlertView[]> = computed(() => inOrder(open.value ?? []));

/** Those that go on first, of them the gravest, then the newest. */
export function inOrder(alerts: readonly AlertView[]): AlertView[] {
  const rank = { critical: 0, warning: 1, info: 2 };
  return [...alerts].sort(
    (a, b) =>
      Number(a.cleared !== null) - Number(b.cleared !== null) ||
      rank[a.severity] - rank[b.severity] ||
      Date.parse(b.raised) - Date.parse(a.raised),
  );
}

/** Those that nobody has seen. */
export const unseenAlerts = computed(() =>
  openAlerts.value.filter(({ acknowledged }) => acknowledged === null),
);

export function takeAlerts(alerts: readonly AlertView[]): void {
  open.value = alerts;
}

/** One was acknowledged here: it shows before the site tells everybody. */
export function takeAlert(alert: AlertView): void {
  const is_over = alert.state === "cleared";
  open.value =
    open.value?.flatMap((other) => (other.id !== alert.id ? [other] : is_over ? [] : [alert])) ?? null;
}

/** Ids that came since, out of those that nobody has seen. */
export function newAmong(before: ReadonlySet<string>, alerts: readonly AlertView[]): AlertView[] {
  return alerts.filter(({ id }) => !before.has(id));
}
