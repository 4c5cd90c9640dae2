/** One's own account: password and tokens; for admins also everybody's accounts. */

import { useSignal } from "@preact/signals";
import {
  addToken,
  addUser,
  changePassword,
  changeUser,
  fetchMe,
  fetchTokens,
  fetchUsers,
  type NewToken,
  ROLES,
  type Role,
  removeUser,
  revokeToken,
} from "../api/accounts";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { reasonOf } from "../components/reason";
import { TableHead } from "../components/table-head";
import { mayAdminister, me, setMe } from "../store/people";
import { useSpeech } from "../text";

const PASSWORD_LEAST = 10;

export default function AccountPage(_props: ViewProps) {
  const { text } = useSpeech();
  const known = me.value;
  if (known === null || known === "nobody" || !known.accounts) {
    return (
      <div class="sheet">
        <h1>{text.views.account}</h1>
        <p class="empty">{text.account.noAccounts}</p>
      </div>
    );
  }
  return (
    <div class="sheet">
      <h1>{text.views.account}</h1>
      <p>{text.account.signedIn(known.name ?? "", text.account.roles[known.role])}</p>
      <OwnPassword />
      <Tokens most={known.role} />
      {mayAdminister.value && <Users own={known.name ?? ""} />}
    </div>
  );
}

/** Runs what a form asks for, and keeps why it failed. */
function useSending() {
  const { text } = useSpeech();
  const failure = useSignal<string | null>(null);
  const done = useSignal<string | null>(null);
  const send = async (action: () => Promise<unknown>, said: string | null = null) => {
    failure.value = null;
    done.value = null;
    try {
      await action();
      done.value = said;
      return true;
    } catch (error) {
      failure.value = reasonOf(error, text);
      return false;
    }
  };
  const said = (
    <>
      {failure.value !== null && (
        <p class="failure" role="alert">
          {failure.value}
        </p>
      )}
      {done.value !== null && <p role="status">{done.value}</p>}
    </>
  );
  return { send, said };
}

function OwnPassword() {
  const { text } = useSpeech();
  const { send, said } = useSending();
  return (
    <section aria-labelledby="password-title">
      <h2 id="password-title">{text.account.ownPassword}</h2>
      <form
        class="form form-line"
        onSubmit={(event) => {
          event.preventDefault();
          const fields = new FormData(event.currentTarget);
          const change = () => changePassword(String(fields.get("old")), String(fields.get("new")));
          // All sign-ins of the account have ended: also this one.
          void send(change).then((changed) => changed && setMe("nobody"));
        }}
      >
        <label>
          {text.account.oldPassword}
          <input name="old" type="password" autocomplete="current-password" required />
        </label>
        <label>
          {text.account.newPassword(PASSWORD_LEAST)}
          <input name="new" type="password" autocomplete="new-password" required minLength={PASSWORD_LEAST} />
        </label>
        <button type="submit" class="button">
          {text.account.change}
        </button>
      </form>
      {said}
    </section>
  );
}

function RoleSelect({ name, value, most = "admin" }: { name: string; value: Role; most?: Role }) {
  const { text } = useSpeech();
  return (
    <label>
      {text.account.role}
      <select name={name}>
        {ROLES.slice(0, ROLES.indexOf(most) + 1).map((role) => (
          <option key={role} value={role} selected={role === value}>
            {text.account.roles[role]}
          </option>
        ))}
      </select>
    </label>
  );
}

function Tokens({ most }: { most: Role }) {
  const { text, format } = useSpeech();
  const asked = useAsked("tokens", fetchTokens);
  const { send, said } = useSending();
  const fresh = useSignal<NewToken | null>(null);
  const revoke = async (id: string) => {
    await revokeToken(id);
    // What opens nothing any more need not be copied.
    if (fresh.value?.token.id === id) fresh.value = null;
  };
  return (
    <section aria-labelledby="tokens-title">
      <h2 id="tokens-title">{text.account.tokens}</h2>
      <p class="empty">{text.account.tokensHint}</p>
      <form
        class="form form-line"
        onSubmit={(event) => {
          event.preventDefault();
          const form = event.currentTarget;
          const fields = new FormData(form);
          const make = async () => {
            const made = await addToken(
              String(fields.get("label")),
              fields.get("role") as Role,
              Number(fields.get("days")),
            );
            fresh.value = made;
            form.reset();
          };
          void send(make).then(asked.again);
        }}
      >
        <label>
          {text.account.label}
          <input name="label" required maxLength={100} />
        </label>
        <RoleSelect name="role" value="viewer" most={most} />
        <label>
          {text.account.days}
          <input name="days" type="number" min="1" max="3660" value="90" required />
        </label>
        <button type="submit" class="button">
          {text.account.makeToken}
        </button>
      </form>
      {fresh.value !== null && (
        <p class="secret" role="status">
          {text.account.secret} <code>{fresh.value.secret}</code>
        </p>
      )}
      {said}
      {(asked.value ?? []).length > 0 && (
        <table class="table">
          <TableHead
            names={[
              text.account.label,
              text.account.user,
              text.account.role,
              text.account.expires,
              text.account.lastUsed,
              null,
            ]}
          />
          <tbody>
            {(asked.value ?? []).map((token) => (
              <tr key={token.id}>
                <td>{token.label}</td>
                <td>{token.user}</td>
                <td>{text.account.roles[token.role]}</td>
                <td>{format.dateTime(Date.parse(token.expires))}</td>
                <td>{token.seen === null ? "–" : format.dateTime(Date.parse(token.seen))}</td>
                <td>
                  <button
                    type="button"
                    class="button"
                    aria-label={text.account.revokeLabel(token.label)}
                    onClick={() => void send(() => revoke(token.id)).then(asked.again)}
                  >
                    {text.account.revoke}
                  </button>
                </td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
    </section>
  );
}

function Users({ own }: { own: string }) {
  const { text, format } = useSpeech();
  const asked = useAsked("users", fetchUsers);
  const { send, said } = useSending();
  const change = async (name: string, role: Role) => {
    await changeUser(name, { role });
    // What one may do oneself is offered anew.
    if (name === own) setMe(await fetchMe());
  };
  return (
    <section aria-labelledby="users-title">
      <h2 id="users-title">{text.account.users}</h2>
      <table class="table">
        <TableHead names={[text.account.user, text.account.role, text.account.created, null]} />
        <tbody>
          {(asked.value ?? []).map((user) => (
            <tr key={user.name}>
              <th scope="row">{user.name}</th>
              <td>
                <select
                  aria-label={text.account.roleOf(user.name)}
                  value={user.role}
                  onChange={(event) =>
                    void send(() => change(user.name, event.currentTarget.value as Role)).then(asked.again)
                  }
                >
                  {ROLES.map((role) => (
                    <option key={role} value={role}>
                      {text.account.roles[role]}
                    </option>
                  ))}
                </select>
              </td>
              <td>{format.dateTime(Date.parse(user.created))}</td>
              <td>
                {user.name !== own && (
                  <button
                    type="button"
                    class="button"
                    aria-label={text.account.removeLabel(user.name)}
                    onClick={() => {
                      if (window.confirm(text.account.removeSure(user.name)))
                        void send(() => removeUser(user.name)).then(asked.again);
                    }}
                  >
                    {text.account.remove}
                  </button>
                )}
              </td>
            </tr>
          ))}
        </tbody>
      </table>
      {said}
      <form
        class="form form-line"
        onSubmit={(event) => {
          event.preventDefault();
          const form = event.currentTarget;
          const fields = new FormData(form);
          const make = () =>
            addUser(String(fields.get("name")), fields.get("role") as Role, String(fields.get("password")));
          void send(make).then((made) => {
            if (made) form.reset();
            asked.again();
          });
        }}
      >
        <label>
          {text.account.name}
          <input name="name" required maxLength={64} autocomplete="off" autocapitalize="none" />
        </label>
        <RoleSelect name="role" value="viewer" />
        <label>
          {text.account.newPassword(PASSWORD_LEAST)}
          <input
            name="password"
            type="password"
            required
            minLength={PASSWORD_LEAST}
            autocomplete="new-password"
          />
        </label>
        <button type="submit" class="button">
          {text.account.addUser}
        </button>
      </form>
    </section>
  );
}
