/** Puts the page together: the live connection feeds the store, the store feeds the components. */

import { render } from "preact";

import { browserSurroundings, Live } from "./api/live";
import { App } from "./app";
import { Format } from "./format";
import { DeskContext, noChoices } from "./store/context";
import { Store } from "./store/store";
import "./style.css";
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
    },
    delta(message) {
      lastHeard_ms = performance.now();
      store.takeDelta(message);
    },
    unreadable: (reason) => store.refuse(reason),
    lost: (pause_ms) =>
      store.setLink({ phase: "lost", since_ms: lastHeard_ms, retry_at_ms: performance.now() + pause_ms }),
  },
  browserSurroundings(),
);

const wished = new URLSearchParams(window.location.search).get("lang");
const text = chooseText([...(wished === null ? [] : [wished]), ...navigator.languages]);
document.documentElement.lang = text.language;

const page = document.getElementById("page");
if (page === null) throw new Error("index.html has no place for the page");
render(
  <SpeechContext.Provider value={{ text, format: new Format(text.language) }}>
    <DeskContext.Provider value={{ store, choices: noChoices() }}>
      <App />
    </DeskContext.Provider>
  </SpeechContext.Provider>,
  page,
);

window.setInterval(() => store.tick(), TICK_MS);
live.start();
