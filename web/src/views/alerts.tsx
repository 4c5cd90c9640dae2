/** Alerts: those that are open, to be acknowledged, and those that were. */

import { useSignal } from "@preact/signals";
import { type AlertView, acknowledge, fetchAlerts, fetchOpenAlerts } from "../api/alerts";
import type { ViewProps } from "../app";
import { alertWords } from "../components/alert-words";
import { useAsked } from "../components/async";
import { focusOnce } from "../components/focus";
import { reasonOf } from "../components/reason";
import { paths } from "../route";
import { alertsTold, inOrder, openAlerts, takeAlert } from "../store/alerts";
import { useDesk } from "../store/context";
import { mayOperate } from "../store/people";
import { useSpeech } from "../text";

const REFRESH_MS = 15_000;

export default function AlertsPage(_props: ViewProps) {
  const { store, choices } = useDesk();
  const { text } = useSpeech();
  const pages = useSignal(1);
  // The live connection brings those that are open, at once; without it they are asked for.
  const live = alertsTold.value && store.calm.value.link.phase === "open";
  const liveIds = live ? openAlerts.value.map(({ id }) => id).join() : "";
  const asked = useAsked(
    live ? "" : "open",
    async (signal) => (live ? null : inOrder(await fetchOpenAlerts(signal))),
    live ? null : REFRESH_MS,
  );
  // One that is over moves from the one list to the other.
  const history = useAsked(
    `${pages.value} ${liveIds}`,
    (signal) => fetchAlerts("cleared", pages.value, signal),
    REFRESH_MS,
  );
  const open = live ? openAlerts.value : asked.value;
  const before = history.value?.alerts ?? [];
  const changed = () => {
    asked.again();
    history.again();
  };
  return (
    <div class="sheet">
      <div class="section-head">
        <h1>{text.views.alerts}</h1>
        <label class="check">
          <input
            type="checkbox"
            checked={choices.sound.value}
            onChange={(event) => (choices.sound.value = event.currentTarget.checked)}
          />
          {text.account.sound}
        </label>
      </div>
      <section aria-labelledby="open-alerts">
        <h2 id="open-alerts">
          {text.alerts.open} {open !== null && <span class="count">{open.length}</span>}
        </h2>
        {asked.failure !== null && <p class="failure">{asked.failure}</p>}
        {open === null && asked.failure === null && <p class="empty">{text.alerts.waiting}</p>}
        {open?.length === 0 && <p class="empty">{text.alerts.none}</p>}
        <ul class="alert-list">
          {open?.map((alert) => (
            <AlertRow key={alert.id} alert={alert} changed={changed} />
          ))}
        </ul>
      </section>
      <section aria-labelledby="past-alerts">
        <h2 id="past-alerts">{text.alerts.history}</h2>
        {history.failure !== null && <p class="failure">{history.failure}</p>}
        {history.value !== null && before.length === 0 && <p class="empty">{text.alerts.noHistory}</p>}
        <ul class="alert-list">
          {before.map((alert) => (
            <AlertRow key={alert.id} alert={alert} changed={changed} />
          ))}
        </ul>
        {history.value?.more && (
          <button type="button" class="button" onClick={() => (pages.value += 1)}>
            {text.alerts.showMore}
          </button>
        )}
      </section>
    </div>
  );
}

function AlertRow({ alert, changed }: { alert: AlertView; changed(): void }) {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const writing = useSignal(false);
  const failure = useSignal<string | null>(null);
  const name = alert.machine === null ? undefined : store.calm.value.machines.get(alert.machine)?.view.name;
  const words = alertWords(alert, name, text, format);
  const when = (time: string) => format.dateTime(Date.parse(time));
  const send = async (note: string) => {
    try {
      takeAlert(await acknowledge(alert.id, note));
      writing.value = false;
      failure.value = null;
    } catch (error) {
      failure.value = reasonOf(error, text);
    }
    changed();
  };
  return (
    <li class={`alert alert-${alert.severity} alert-state-${alert.state}`} data-alert={alert.id}>
      <span class="alert-severity">{text.alerts.severities[alert.severity]}</span>
      <div class="alert-main">
        <p class="alert-message">
          {alert.machine === null ? words : <a href={paths.machine(alert.machine)}>{words}</a>}
        </p>
        <p class="alert-facts">
          {text.alerts.states[alert.state]} · {text.alerts.rules[alert.rule]} ·{" "}
          {text.alerts.raised(when(alert.raised))}
          {alert.times > 1 && ` · ${text.alerts.times(format.count(alert.times))}`}
          {alert.cleared !== null && ` · ${text.alerts.cleared(when(alert.cleared))}`}
        </p>
        {alert.acknowledged !== null && (
          <p class="alert-facts">
            {text.alerts.seenBy(alert.acknowledged.by, when(alert.acknowledged.at))}
            {alert.acknowledged.note !== "" && `: “${alert.acknowledged.note}”`}
          </p>
        )}
        {writing.value && (
          <form
            class="form form-line"
            onSubmit={(event) => {
              event.preventDefault();
              void send(String(new FormData(event.currentTarget).get("note") ?? ""));
            }}
          >
            <label>
              {text.alerts.note}
              <input name="note" maxLength={2000} ref={focusOnce} />
            </label>
            <button type="submit" class="button button-main">
              {text.alerts.acknowledge}
            </button>
          </form>
        )}
        {failure.value !== null && (
          <p class="failure" role="alert">
            {failure.value}
          </p>
        )}
      </div>
      {alert.acknowledged === null && mayOperate.value && !writing.value && (
        <button type="button" class="button button-main" onClick={() => (writing.value = true)}>
          {text.alerts.acknowledge}
        </button>
      )}
    </li>
  );
}
