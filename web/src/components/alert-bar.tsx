/** The alerts that are open, on every view: the gravest in words, and how many more there are. */

import { effect } from "@preact/signals";
import { useEffect } from "preact/hooks";

import type { AlertView } from "../api/alerts";
import { paths } from "../route";
import { newAmong, unseenAlerts } from "../store/alerts";
import { useDesk } from "../store/context";
import { useSpeech } from "../text";

export function AlertBar() {
  const { store, choices } = useDesk();
  const { text, format } = useSpeech();
  useEffect(() => hear(choices.sound), [choices]);
  const [first, ...more] = unseenAlerts.value;
  if (first === undefined) return null;
  return (
    <div class={`banner alert-bar alert-${first.severity}`} role="status" data-alert-bar>
      <span class="alert-severity">{text.alerts.severities[first.severity]}</span>
      <a class="alert-link" href={paths.alerts()}>
        {alertWords(first, store.calm.value.machines.get(first.machine ?? "")?.view.name)}
      </a>
      <span class="alert-when">
        {first.cleared === null
          ? text.alerts.since(format.timeOfDay(Date.parse(first.raised)))
          : text.alerts.cleared(format.timeOfDay(Date.parse(first.cleared)))}
        {more.length > 0 && ` · ${text.alerts.more(more.length)}`}
      </span>
    </div>
  );
}

/** What the site says of an alert, and whose it is. */
export function alertWords(alert: AlertView, name: string | undefined): string {
  if (alert.machine === null) return alert.message;
  return alert.message.includes(alert.machine) || (name !== undefined && alert.message.includes(name))
    ? alert.message
    : `${name ?? alert.machine}: ${alert.message}`;
}

/** Two short tones when an alert comes that was not there before, if a person wanted that. */
function hear(wanted: { readonly value: boolean; peek(): boolean }): () => void {
  let before = new Set(unseenAlerts.peek().map(({ id }) => id));
  return effect(() => {
    const alerts = unseenAlerts.value;
    const fresh = newAmong(before, alerts);
    before = new Set(alerts.map(({ id }) => id));
    if (fresh.length > 0 && wanted.peek()) beep();
  });
}

function beep(): void {
  const audio = new AudioContext();
  for (const [index, hertz] of [660, 880].entries()) {
    const tone = audio.createOscillator();
    const level = audio.createGain();
    tone.frequency.value = hertz;
    level.gain.value = 0.08;
    tone.connect(level).connect(audio.destination);
    tone.start(audio.currentTime + index * 0.2);
    tone.stop(audio.currentTime + index * 0.2 + 0.16);
    if (index === 1) tone.onended = () => void audio.close();
  }
}
