/** The page: the bar on top, and under it the view that the address names. */

import { useSignal } from "@preact/signals";
import type { ComponentType } from "preact";
import { useEffect, useRef } from "preact/hooks";

import { AlertBar } from "./components/alert-bar";
import { Banners, Header } from "./components/header";
import { type Route, route, type View } from "./route";
import { useDesk } from "./store/context";
import { me } from "./store/people";
import { useSpeech } from "./text";

/** What a view is given. A view is loaded when it is first shown. */
export interface ViewProps {
  route: Route;
}

type Loader = () => Promise<{ default: ComponentType<ViewProps> }>;

const LOADERS: Record<View, Loader> = {
  live: () => import("./views/live"),
  machine: () => import("./views/machine"),
  outages: () => import("./views/outages"),
  outage: () => import("./views/outage"),
  sessions: () => import("./views/sessions"),
  replay: () => import("./views/replay"),
  alerts: () => import("./views/alerts"),
  account: () => import("./views/account"),
  "sign-in": () => import("./views/sign-in"),
};

/** The first view is on its way before the page is put together. */
const firstView = route.peek();
if (firstView !== null) void LOADERS[firstView.view]().catch(() => {});

export function App() {
  const { store } = useDesk();
  const { text } = useSpeech();
  const shown = route.value;
  const main = useRef<HTMLElement>(null);
  const said = useSignal("");
  const first = useRef(true);
  const title = shown === null ? text.page.nowhere : titleOf(shown, text.views, store);
  const key = shown === null ? "nowhere" : `${shown.view} ${shown.id ?? ""}`;

  useEffect(() => {
    document.title = `${title} · ${store.calm.value.site?.name ?? text.page.product}`;
  }, [title, store.calm.value.site?.name, text]);

  // A new view is a new page for those who do not see it: it is said, and the keyboard begins at its top.
  useEffect(() => {
    if (first.current) {
      first.current = false;
      return;
    }
    said.value = title;
    main.current?.focus({ preventScroll: true });
    window.scrollTo(0, 0);
  }, [key]);

  const signingIn = shown?.view === "sign-in" || me.value === "nobody";
  return (
    <>
      <a class="skip" href="#main">
        {text.page.skip}
      </a>
      {!signingIn && <Header view={shown?.view ?? null} />}
      {!signingIn && <Banners />}
      {!signingIn && <AlertBar />}
      <main id="main" class={`view view-${shown?.view ?? "nowhere"}`} tabIndex={-1} ref={main}>
        {shown === null ? (
          <div class="sheet">
            <h1>{text.page.nowhere}</h1>
            <p>
              <a href="/">{text.views.live}</a>
            </p>
          </div>
        ) : (
          <Loaded key={key} route={shown} />
        )}
      </main>
      <p class="visually-hidden" aria-live="polite" role="status" data-announcer>
        {said.value}
      </p>
    </>
  );
}

function Loaded({ route: shown }: ViewProps) {
  const { text } = useSpeech();
  const loaded = useSignal<ComponentType<ViewProps> | null>(null);
  const failed = useSignal(false);
  useEffect(() => {
    let gone = false;
    LOADERS[shown.view]().then(
      (module) => {
        if (!gone) loaded.value = module.default;
      },
      () => {
        failed.value = true;
      },
    );
    return () => {
      gone = true;
    };
  }, [shown.view]);
  const Shown = loaded.value;
  if (Shown !== null) return <Shown route={shown} />;
  // After an update of the site, its earlier chunks are gone: the page has to be fetched anew.
  if (failed.value) {
    return (
      <div class="sheet" role="alert">
        <p>{text.page.reload}</p>
        <button type="button" class="button" onClick={() => window.location.reload()}>
          {text.page.reloadButton}
        </button>
      </div>
    );
  }
  return <div class="sheet" aria-busy="true" />;
}

function titleOf(
  shown: Route,
  titles: Record<View, string>,
  store: ReturnType<typeof useDesk>["store"],
): string {
  if (shown.view === "machine") {
    return store.calm.value.machines.get(shown.id ?? "")?.view.name ?? shown.id ?? titles.machine;
  }
  return titles[shown.view];
}
