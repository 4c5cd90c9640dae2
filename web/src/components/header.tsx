/** The bar on top: which site, its views, whether it speaks, what time it has there, who sits here. */

import { signOut } from "../api/accounts";
import { go, paths, type View } from "../route";
import { openAlerts, unseenAlerts } from "../store/alerts";
import { useDesk } from "../store/context";
import { me, setMe } from "../store/people";
import type { State } from "../store/store";
import { LANGUAGES, useSpeech } from "../text";

const NAVIGATION: readonly { view: View; also: readonly View[]; path(): string }[] = [
  { view: "live", also: ["machine"], path: paths.live },
  { view: "outages", also: ["outage"], path: paths.outages },
  { view: "sessions", also: ["replay"], path: paths.sessions },
  { view: "alerts", also: [], path: paths.alerts },
];

export function Header({ view }: { view: View | null }) {
  const { store, choices } = useDesk();
  const { text, format, choose } = useSpeech();
  const state = store.calm.value;
  const words = { connecting: text.link.connecting, open: text.link.open, lost: text.link.lost };
  const unseen = unseenAlerts.value.length;
  return (
    <header class="top">
      <img src="/icon.svg" alt="" width="28" height="28" />
      <p class="top-name" title={`${text.page.product} ${state.site?.software ?? ""}`}>
        {state.site?.name ?? text.page.product}
      </p>
      <nav aria-label={text.page.navigation}>
        {NAVIGATION.map(({ view: target, also, path }) => (
          <a
            key={target}
            href={path()}
            aria-current={view === target || (view !== null && also.includes(view)) ? "page" : undefined}
          >
            {text.views[target]}
            {target === "alerts" && openAlerts.value.length > 0 && (
              <span
                class={`badge${unseen > 0 ? " badge-unseen" : ""}`}
                data-open-alerts={openAlerts.value.length}
              >
                {openAlerts.value.length}
                <span class="visually-hidden"> {text.alerts.openCount(unseen)}</span>
              </span>
            )}
          </a>
        ))}
      </nav>
      <span class={`link link-${state.link.phase}`} role="status" data-link={state.link.phase}>
        <i aria-hidden="true" />
        <span class="link-word">{words[state.link.phase]}</span>
      </span>
      <span class="site-time" title={isoTitle(state)}>
        <span class="site-time-word">{text.page.siteTime}</span>{" "}
        <time class={state.link.phase === "open" ? "" : "stale-text"}>
          {format.timeOfDay(state.siteTime_ms)}
        </time>
      </span>
      <details class="menu">
        <summary title={text.account.menu}>
          {me.value !== null && me.value !== "nobody" && me.value.name !== null
            ? me.value.name
            : text.account.options}
        </summary>
        <div class="menu-body">
          <label>
            <input
              type="checkbox"
              checked={choices.coordinates.value === "wgs84"}
              onChange={(event) =>
                (choices.coordinates.value = event.currentTarget.checked ? "wgs84" : "grid")
              }
            />
            {text.account.wgs84}
          </label>
          <label>
            <input
              type="checkbox"
              checked={choices.utc.value}
              onChange={(event) => (choices.utc.value = event.currentTarget.checked)}
            />
            {text.account.utc}
          </label>
          <label>
            <input
              type="checkbox"
              checked={choices.sound.value}
              onChange={(event) => (choices.sound.value = event.currentTarget.checked)}
            />
            {text.account.sound}
          </label>
          <label>
            {text.account.language}{" "}
            <select value={text.language} onChange={(event) => choose(event.currentTarget.value)}>
              {LANGUAGES.map(({ language, languageName }) => (
                <option key={language} value={language} lang={language}>
                  {languageName}
                </option>
              ))}
            </select>
          </label>
          <Person />
          <p class="menu-about">
            {text.page.product} {state.site?.software} · <a href="/api/docs">API</a>
          </p>
        </div>
      </details>
    </header>
  );
}

function Person() {
  const { text } = useSpeech();
  const known = me.value;
  if (known === null || known === "nobody" || !known.accounts) return null;
  const leave = async () => {
    await signOut();
    setMe("nobody");
    go(paths.signIn());
    // What the page holds of the site is not for the next one.
    window.location.reload();
  };
  return (
    <>
      <p>{text.account.signedIn(known.name ?? "", text.account.roles[known.role])}</p>
      <a href={paths.account()}>{text.views.account}</a>
      <button type="button" class="button" onClick={() => void leave()}>
        {text.account.signOut}
      </button>
    </>
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
        <div class="banner banner-bad" data-banner="link">
          {/* Said once: the seconds beside it are for the eye. */}
          <span role="alert">{site === null ? text.link.neverOpened : text.link.lostBanner}</span>{" "}
          {text.link.silentFor(silence)}{" "}
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
