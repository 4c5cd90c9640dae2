/** The alerts that are open, on every view: the gravest in words, and how many more there are. */

import { effect } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { paths } from "../route";
import { newAmong, unseenAlerts } from "../store/alerts";
import { useDesk } from "../store/context";
import { useSpeech } from "../text";
import { alertWords } from "./alert-words";
import { Chime } from "./chime";

const chime = new Chime(() => new AudioContext());

export function AlertBar() {
  const { store, choices } = useDesk();
  const { text, format } = useSpeech();
  useEffect(() => hear(choices.sound), [choices]);
  const [first, ...more] = unseenAlerts.value;
  const state = store.calm.value;
  const name = state.machines.get(first?.machine ?? "")?.view.name;
  const when = (time: string) => format.moment(Date.parse(time), state.siteTime_ms ?? Date.now());
  return (
    <>
      {/* Said once an alert: its numbers change with every second, and stand outside. */}
      <p class="visually-hidden" role="status">
        {first !== undefined &&
          [text.alerts.severities[first.severity], name ?? first.machine ?? "", text.alerts.rules[first.rule]]
            .filter((word) => word !== "")
            .join(": ")}
      </p>
      {first !== undefined && (
        <div class={`banner alert-bar alert-${first.severity}`} data-alert-bar>
          <span class="alert-severity">{text.alerts.severities[first.severity]}</span>
          <a class="alert-link" href={paths.alerts()}>
            {alertWords(first, name, text, format)}
          </a>
          <span class="alert-when">
            {first.cleared === null
              ? text.alerts.since(when(first.raised))
              : text.alerts.cleared(when(first.cleared))}
            {more.length > 0 && ` · ${text.alerts.more(more.length)}`}
          </span>
        </div>
      )}
      {chime.blocked.value && (
        <div class="banner banner-warning" role="status" data-banner="sound">
          {text.alerts.soundBlocked}
        </div>
      )}
    </>
  );
}

/** Two short tones when an alert comes that was not there before, if a person wanted that. */
function hear(wanted: { readonly value: boolean; peek(): boolean }): () => void {
  let before = new Set(unseenAlerts.peek().map(({ id }) => id));
  const stopListening = effect(() => {
    const alerts = unseenAlerts.value;
    const fresh = newAmong(before, alerts);
    before = new Set(alerts.map(({ id }) => id));
    if (fresh.length > 0 && wanted.peek()) chime.ring();
  });
  const pressed = () => {
    if (chime.blocked.peek()) chime.wake();
  };
  const stopWaking = effect(() => (wanted.value ? chime.wake() : chime.rest()));
  document.addEventListener("pointerdown", pressed);
  document.addEventListener("keydown", pressed);
  return () => {
    stopListening();
    stopWaking();
    document.removeEventListener("pointerdown", pressed);
    document.removeEventListener("keydown", pressed);
  };
}
