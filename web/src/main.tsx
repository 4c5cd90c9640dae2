/** Puts the page together: the live connection feeds the store, the store feeds the components. */

import { computed, effect, signal } from "@preact/signals";
import { render } from "preact";

import { fetchMe } from "./api/accounts";
import { whenUnknown } from "./api/http";
import { browserSurroundings, Live } from "./api/live";
import { fetchTrajectory } from "./api/machines";
import type { FleetView } from "./api/types";
import { App } from "./app";
import { closeMenus } from "./components/menus";
import { Format } from "./format";
import { followBrowser, go, note, paths, route } from "./route";
import { takeAlerts } from "./store/alerts";
import { DeskContext, keptChoices } from "./store/context";
import { me, setMe } from "./store/people";
import { Store } from "./store/store";
import { TAIL_SPAN_MS } from "./store/trace";
import "./style.css";
import "./views.css";
import "./plan/plan.css";
import { chooseText, SpeechContext } from "./text";

/** Ages grow on the page at this pace also when the site is silent. */
const TICK_MS = 250;

const store = new Store({
  now: () => performance.now(),
  nextFrame: (callback) => requestAnimationFrame(callback),
});

let lastHeard_ms = performance.now();
const live = new Live(
  {
    snapshot(message) {
      lastHeard_ms = performance.now();
      store.takeSnapshot(message);
      store.setLink({ phase: "open", since_ms: lastHeard_ms });
      void recall(message.fleet);
    },
    delta(message) {
      lastHeard_ms = performance.now();
      store.takeDelta(message);
    },
    alerts: takeAlerts,
    unreadable: (reason) => store.refuse(reason),
    lost(pause_ms) {
      store.setLink({ phase: "lost", since_ms: lastHeard_ms, retry_at_ms: performance.now() + pause_ms });
      // A browser is not told why a WebSocket is refused: it may be that one has to sign in again.
      void askWho();
    },
  },
  browserSurroundings(),
);

const choices = keptChoices(window.localStorage);
// An address that names a language is a choice, for this visit alone.
const named = signal(new URLSearchParams(window.location.search).get("lang") ?? "");
const text = computed(() => chooseText([named.value, choices.language.value, ...navigator.languages]));
const choose = (language: string) => {
  choices.language.value = language;
  named.value = "";
  note("lang", null);
};
effect(() => {
  document.documentElement.lang = text.value.language;
});
const zone = computed(() => (choices.utc.value ? "UTC" : store.calm.value.site?.time_zone));
const format = computed(() => new Format(text.value.language, zone.value));

const recalled = new Set<string>();

/** Where machines came from before the page was opened: asked once of each, one after the other. */
async function recall({ machines, time }: FleetView): Promise<void> {
  const since = new Date(Date.parse(time) - TAIL_SPAN_MS).toISOString();
  for (const { id } of machines) {
    if (recalled.has(id)) continue;
    recalled.add(id);
    try {
      const { points } = await fetchTrajectory(id, since);
      if (!store.recall(id, points)) recalled.delete(id);
    } catch {
      // Then its tail begins now.
    }
  }
}

let speaking = false;

/** Asks the site who one is; the live connection is for those who may look. */
async function askWho(): Promise<void> {
  try {
    setMe(await fetchMe());
  } catch {
    // The site does not answer: who one is stays as it was.
    if (me.peek() === null) speak();
  }
}

function speak(): void {
  if (speaking) return;
  speaking = true;
  live.start();
}

whenUnknown(() => setMe("nobody"));
followBrowser();
closeMenus();
effect(() => {
  const known = me.value;
  const at = route.value?.view;
  if (known === null) return;
  if (known !== "nobody") return speak();
  if (at !== "sign-in")
    go(paths.signIn(window.location.pathname + window.location.search), { replace: true });
});

const page = document.getElementById("page");
if (page === null) throw new Error("index.html has no place for the page");
render(
  <SpeechContext.Provider value={{ text, format, choose }}>
    <DeskContext.Provider value={{ store, choices }}>
      <App />
    </DeskContext.Provider>
  </SpeechContext.Provider>,
  page,
);

window.setInterval(() => store.tick(), TICK_MS);
void askWho();
