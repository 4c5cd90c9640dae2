/** Where one says who one is. */

import { useSignal } from "@preact/signals";
import { signIn } from "../api/accounts";
import { ApiError } from "../api/http";
import type { ViewProps } from "../app";
import { focusOnce } from "../components/focus";
import { reasonOf } from "../components/reason";
import { go, parseRoute, paths } from "../route";
import { setMe } from "../store/people";
import { useSpeech } from "../text";

export default function SignInPage({ route }: ViewProps) {
  const { text } = useSpeech();
  const failure = useSignal<string | null>(null);
  const busy = useSignal(false);
  const send = async (form: HTMLFormElement) => {
    const fields = new FormData(form);
    busy.value = true;
    try {
      const me = await signIn(String(fields.get("name") ?? ""), String(fields.get("password") ?? ""));
      setMe(me);
      go(ownPath(route.query.get("next")), { replace: true });
    } catch (error) {
      failure.value =
        error instanceof ApiError && error.status === 401 ? text.account.wrong : reasonOf(error, text);
    } finally {
      busy.value = false;
    }
  };
  return (
    <div class="sheet sign-in">
      <img src="/icon.svg" alt="" width="44" height="44" />
      <h1>{text.views["sign-in"]}</h1>
      <form
        class="form"
        onSubmit={(event) => {
          event.preventDefault();
          void send(event.currentTarget);
        }}
      >
        <label>
          {text.account.name}
          <input name="name" autocomplete="username" required ref={focusOnce} autocapitalize="none" />
        </label>
        <label>
          {text.account.password}
          <input name="password" type="password" autocomplete="current-password" required />
        </label>
        {failure.value !== null && (
          <p class="failure" role="alert">
            {failure.value}
          </p>
        )}
        <button type="submit" class="button button-main" disabled={busy.value}>
          {text.account.signIn}
        </button>
      </form>
    </div>
  );
}

/** Only to a view of this page: the address may come from anybody. */
function ownPath(next: string | null): string {
  if (next === null || !next.startsWith("/") || next.startsWith("//")) return paths.live();
  const url = new URL(next, window.location.origin);
  const known = url.origin === window.location.origin && parseRoute(url.pathname, url.search);
  return known && known.view !== "sign-in" ? `${url.pathname}${url.search}` : paths.live();
}
