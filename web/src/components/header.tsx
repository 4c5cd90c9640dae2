/** The bar on top: which site, whether it speaks, what time it has there. */

import { useDesk } from "../store/context";
import type { State } from "../store/store";
import { useSpeech } from "../text";

export function Header() {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const state = store.calm.value;
  const words = { connecting: text.link.connecting, open: text.link.open, lost: text.link.lost };
  return (
    <header class="top">
      <img src="/icon.svg" alt="" width="28" height="28" />
      <h1>{state.site?.name ?? text.page.product}</h1>
      <span class="top-id">
        {text.page.product} {state.site?.software}
      </span>
      <span class={`link link-${state.link.phase}`} role="status" data-link={state.link.phase}>
        <i aria-hidden="true" />
        {words[state.link.phase]}
      </span>
      <span class="site-time" title={isoTitle(state)}>
        {text.page.siteTime}{" "}
        <time class={state.link.phase === "open" ? "" : "stale-text"}>
          {format.timeOfDay(state.siteTime_ms)}
        </time>
      </span>
    </header>
  );
}

/** Says in full that the connection is lost, or that the site speaks a language the page does not know. */
export function Banners() {
  const { store } = useDesk();
  const { text, format } = useSpeech();
  const { link, now_ms, site, unreadable } = store.calm.value;
  const silence = format.age((now_ms - link.since_ms) / 1000);
  return (
    <>
      {link.phase === "lost" && (
        <div class="banner banner-bad" role="alert" data-banner="link">
          {site === null ? text.link.neverOpened(silence) : text.link.lostBanner(silence)}{" "}
          {link.retry_at_ms > now_ms
            ? text.link.retry(format.age((link.retry_at_ms - now_ms) / 1000))
            : text.link.retryNow}
        </div>
      )}
      {unreadable.count > 0 && (
        <div class="banner banner-warning" role="status">
          {text.link.unreadable(unreadable.count, unreadable.last ?? "")}
        </div>
      )}
    </>
  );
}

function isoTitle({ siteTime_ms }: State): string | undefined {
  return siteTime_ms === null ? undefined : `${new Date(siteTime_ms).toISOString().slice(0, 19)}Z`;
}
