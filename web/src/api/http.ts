/** Requests to the site: JSON in and out, problem details as errors, and who is told that nobody is signed in. */

/** What the site answered instead of what was asked for; `detail` is in its own words, if it has any. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    readonly detail: string | null,
  ) {
    super(detail ?? String(status));
    this.name = "ApiError";
  }
}

/** Nothing came back: the site was not reached, or took too long. */
export class NoAnswer extends Error {
  constructor(
    readonly why: "unreachable" | "late",
    cause: unknown,
  ) {
    super(why, { cause });
    this.name = "NoAnswer";
  }
}

const PATIENCE_MS = 15_000;
/** Recordings are read whole before the answer begins. */
export const LONG_PATIENCE_MS = 180_000;

let onUnknown: () => void = () => {};

/** Calls back whenever the site asks to sign in first. */
export function whenUnknown(callback: () => void): void {
  onUnknown = callback;
}

interface Options {
  method?: string;
  body?: unknown;
  headers?: Record<string, string>;
  patience_ms?: number;
  signal?: AbortSignal;
}

/** The answer, if it is a good one. */
export async function ask(path: string, options: Options = {}): Promise<Response> {
  const headers: Record<string, string> = {
    accept: "application/json, application/geo+json",
    ...options.headers,
  };
  const init: RequestInit = { method: options.method ?? "GET", headers };
  if (options.body !== undefined) {
    headers["content-type"] ??= "application/json";
    init.body = typeof options.body === "string" ? options.body : JSON.stringify(options.body);
  }
  const patience = AbortSignal.timeout(options.patience_ms ?? PATIENCE_MS);
  init.signal = options.signal === undefined ? patience : AbortSignal.any([patience, options.signal]);
  const response = await fetch(path, init).catch((cause: unknown) => {
    if (options.signal?.aborted) throw cause;
    throw new NoAnswer(patience.aborted ? "late" : "unreachable", cause);
  });
  if (response.ok) return response;
  if (response.status === 401) onUnknown();
  throw new ApiError(response.status, await problemOf(response));
}

/** The answer as a checked value. */
export async function askFor<T>(
  path: string,
  check: (value: unknown, path: string) => T,
  options: Options = {},
): Promise<T> {
  return check(await (await ask(path, options)).json(), "answer");
}

/** A path with what stands after the `?`; what is empty is left out. */
export function withQuery(path: string, query: Record<string, string | number | null | undefined>): string {
  const wanted = Object.entries(query).filter(([, value]) => value != null && value !== "");
  if (wanted.length === 0) return path;
  return `${path}?${new URLSearchParams(wanted.map(([name, value]) => [name, String(value)]))}`;
}

async function problemOf(response: Response): Promise<string | null> {
  try {
    const { detail } = (await response.json()) as { detail?: unknown };
    if (typeof detail === "string") return detail;
  } catch {
    // No JSON: the status has to do.
  }
  return null;
}
