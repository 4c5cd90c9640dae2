/** Signing in, accounts and tokens. */

import { type Check, flag, list, nullable, object, oneOf, text, time } from "./checking";
import { ApiError, ask, askFor } from "./http";

export const ROLES = ["viewer", "operator", "admin"] as const;
export type Role = (typeof ROLES)[number];

export interface Me {
  /** Whether there are accounts; without any, whoever reaches the site may do everything. */
  accounts: boolean;
  name: string | null;
  role: Role;
  token: string | null;
  expires: string | null;
}

export interface User {
  name: string;
  role: Role;
  created: string;
}

export interface Token {
  id: string;
  user: string;
  label: string;
  role: Role;
  created: string;
  expires: string;
  seen: string | null;
}

export interface NewToken {
  secret: string;
  token: Token;
}

const role = oneOf(ROLES);
const checkMe = object<Me>({
  accounts: flag,
  name: nullable(text),
  role,
  token: nullable(text),
  expires: nullable(time),
});
const user = object<User>({ name: text, role, created: time });
const token = object<Token>({
  id: text,
  user: text,
  label: text,
  role,
  created: time,
  expires: time,
  seen: nullable(time),
});
const users: Check<{ users: User[] }> = object<{ users: User[] }>({ users: list(user) });
const tokens: Check<{ tokens: Token[] }> = object<{ tokens: Token[] }>({ tokens: list(token) });
const newToken = object<NewToken>({ secret: text, token });

/** Who asks. */
export async function fetchMe(): Promise<Me | "nobody"> {
  try {
    return await askFor("/api/v1/me", checkMe);
  } catch (error) {
    if (error instanceof ApiError && error.status === 401) return "nobody";
    throw error;
  }
}

export function signIn(name: string, password: string): Promise<Me> {
  return askFor("/api/v1/sign-in", checkMe, { method: "POST", body: { name, password } });
}

export async function signOut(): Promise<void> {
  await ask("/api/v1/sign-out", { method: "POST" });
}

export async function changePassword(old: string, next: string): Promise<void> {
  await ask("/api/v1/me/password", { method: "PUT", body: { old, new: next } });
}

export async function fetchUsers(): Promise<User[]> {
  return (await askFor("/api/v1/users", users)).users;
}

export function addUser(name: string, itsRole: Role, password: string): Promise<User> {
  return askFor("/api/v1/users", user, { method: "POST", body: { name, role: itsRole, password } });
}

export function changeUser(name: string, change: { role?: Role; password?: string }): Promise<User> {
  return askFor(`/api/v1/users/${encodeURIComponent(name)}`, user, { method: "PATCH", body: change });
}

export async function removeUser(name: string): Promise<void> {
  await ask(`/api/v1/users/${encodeURIComponent(name)}`, { method: "DELETE" });
}

export async function fetchTokens(): Promise<Token[]> {
  return (await askFor("/api/v1/tokens", tokens)).tokens;
}

export function addToken(label: string, itsRole: Role, days: number): Promise<NewToken> {
  return askFor("/api/v1/tokens", newToken, { method: "POST", body: { label, role: itsRole, days } });
}

export async function revokeToken(id: string): Promise<void> {
  await ask(`/api/v1/tokens/${encodeURIComponent(id)}`, { method: "DELETE" });
}
