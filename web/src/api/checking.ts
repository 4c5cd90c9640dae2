/** Small checks, put together into those of whole messages: a value of the wanted type, or which field is wrong. */

import type { Vector3 } from "./types";

/** What is wrong with a message, and where. */
export class MessageError extends Error {
  /** What is there, cut short. */
  readonly found: string;

  constructor(
    readonly path: string,
    expected: string,
    found: unknown,
  ) {
    super(`${path}: expected ${expected}, found ${describe(found)}`);
    this.name = "MessageError";
    this.found = describe(found);
  }
}

/** Reads a value found at `path`, or throws a {@link MessageError}. */
export type Check<T> = (value: unknown, path: string) => T;
export type Checks<T> = { [Key in keyof T]: Check<T[Key]> };

function describe(value: unknown): string {
  if (value === undefined) return "nothing";
  const text = JSON.stringify(value) ?? typeof value;
  return text.length > 60 ? `${text.slice(0, 60)}…` : text;
}

export function record(value: unknown, path: string): Record<string, unknown> {
  if (typeof value !== "object" || value === null || Array.isArray(value)) {
    throw new MessageError(path, "an object", value);
  }
  return value as Record<string, unknown>;
}

export const number: Check<number> = (value, path) => {
  if (typeof value !== "number" || !Number.isFinite(value)) throw new MessageError(path, "a number", value);
  return value;
};

export const text: Check<string> = (value, path) => {
  if (typeof value !== "string") throw new MessageError(path, "text", value);
  return value;
};

export const time: Check<string> = (value, path) => {
  const written = text(value, path);
  if (Number.isNaN(Date.parse(written))) throw new MessageError(path, "an RFC 3339 time", value);
  return written;
};

/** A missing field is taken for `null`. */
export function nullable<T>(check: Check<T>): Check<T | null> {
  return (value, path) => (value === null || value === undefined ? null : check(value, path));
}

export function oneOf<T extends string>(choices: readonly T[]): Check<T> {
  return (value, path) => {
    const found = choices.find((choice) => choice === value);
    if (found === undefined) throw new MessageError(path, `one of ${choices.join(", ")}`, value);
    return found;
  };
}

export function list<T>(check: Check<T>): Check<T[]> {
  return (value, path) => {
    if (!Array.isArray(value)) throw new MessageError(path, "a list", value);
    return value.map((item, index) => check(item, `${path}[${index}]`));
  };
}

export function object<T extends object>(checks: Checks<T>): Check<T> {
  const names = Object.keys(checks) as (keyof T & string)[];
  return (value, path) => {
    const from = record(value, path);
    const into = {} as T;
    for (const name of names) into[name] = checks[name](from[name], `${path}.${name}`);
    return into;
  };
}

export const flag: Check<boolean> = (value, path) => {
  if (typeof value !== "boolean") throw new MessageError(path, "true or false", value);
  return value;
};

export const vector3: Check<Vector3> = (value, path) => {
  const numbers = list(number)(value, path);
  const [x, y, z] = numbers;
  if (numbers.length !== 3 || x === undefined || y === undefined || z === undefined) {
    throw new MessageError(path, "three numbers", value);
  }
  return [x, y, z];
};
