/** Requests to the site: JSON in and out, problem details as errors, and who is told that nobody is signed in. */

/** What the site answered instead of what was asked for. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    detail: string,
  ) {
    super(detail);
    this.name = "ApiError";
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
  const response = await fetch(path, init);
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

export function reasonOf(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

async function problemOf(response: Response): Promise<string> {
  try {
    const { detail } = (await response.json()) as { detail?: unknown };
    if (typeof detail === "string") return detail;
  } catch {
    // No JSON: the status has to do.
  }
  return `the site answered ${response.status}`;
}
