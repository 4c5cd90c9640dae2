/** Which view is shown: the path of the address, kept with the browser's history. */

import { type ReadonlySignal, signal } from "@preact/signals";

export type View =
  | "live"
  | "machine"
  | "outages"
  | "outage"
  | "sessions"
  | "replay"
  | "alerts"
  | "account"
  | "sign-in";

export interface Route {
  view: View;
  /** Of the machine, outage or session. */
  id: string | null;
  query: URLSearchParams;
}

export function parseRoute(path: string, search: string): Route | null {
  const query = new URLSearchParams(search);
  const [head = "", tail, ...more] = path.replace(/^\/+|\/+$/g, "").split("/");
  if (more.length > 0) return null;
  const id = tail === undefined ? null : safeDecode(tail);
  if (head === "" && id === null) return { view: "live", id, query };
  if (head === "machines" && id !== null) return { view: "machine", id, query };
  if (head === "outages") return { view: id === null ? "outages" : "outage", id, query };
  if (head === "sessions") return { view: id === null ? "sessions" : "replay", id, query };
  if ((head === "alerts" || head === "account" || head === "sign-in") && id === null) {
    return { view: head, id, query };
  }
  return null;
}

function safeDecode(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

export const paths = {
  live: () => keepLanguage("/"),
  machine: (id: string) => keepLanguage(`/machines/${encodeURIComponent(id)}`),
  outages: () => keepLanguage("/outages"),
  outage: (id: string) => keepLanguage(`/outages/${encodeURIComponent(id)}`),
  sessions: () => keepLanguage("/sessions"),
  /** `at` is the moment, RFC 3339. */
  replay: (id: string, at?: string, machine?: string) =>
    keepLanguage(`/sessions/${encodeURIComponent(id)}`, {
      ...(at === undefined ? {} : { at }),
      ...(machine === undefined ? {} : { machine }),
    }),
  alerts: () => keepLanguage("/alerts"),
  account: () => keepLanguage("/account"),
  signIn: (next?: string) => keepLanguage("/sign-in", next === undefined ? {} : { next }),
};

/** The language that a person chose in the address goes along to the next view. */
function keepLanguage(path: string, query: Record<string, string> = {}): string {
  const next = new URLSearchParams(query);
  const language = new URLSearchParams(window.location.search).get("lang");
  if (language !== null) next.set("lang", language);
  return next.size === 0 ? path : `${path}?${next}`;
}

const current = signal<Route | null>(here());

export const route: ReadonlySignal<Route | null> = current;

function here(): Route | null {
  return parseRoute(window.location.pathname, window.location.search);
}

/** Goes to a path of the page. */
export function go(path: string, { replace = false } = {}): void {
  if (replace) window.history.replaceState(null, "", path);
  else window.history.pushState(null, "", path);
  current.value = here();
}

/** Writes into the address what is shown, without a step in the history and without another view. */
export function note(name: string, value: string | null): void {
  const address = new URL(window.location.href);
  if (value === null) address.searchParams.delete(name);
  else address.searchParams.set(name, value);
  window.history.replaceState(null, "", `${address.pathname}${address.search}`);
}

/** Follows the browser's buttons, and turns clicks on links of the page into steps of the page. */
export function followBrowser(): void {
  window.addEventListener("popstate", () => {
    current.value = here();
  });
  document.addEventListener("click", (event) => {
    if (event.defaultPrevented || event.button !== 0) return;
    if (event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    const link = event.target instanceof Element ? event.target.closest("a") : null;
    if (link === null || link.target !== "" || link.hasAttribute("download")) return;
    const url = new URL(link.href, window.location.href);
    if (url.origin !== window.location.origin || parseRoute(url.pathname, url.search) === null) return;
    if (url.hash !== "") return;
    event.preventDefault();
    go(`${url.pathname}${url.search}`);
  });
}
