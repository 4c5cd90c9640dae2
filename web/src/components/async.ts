/** Something asked of the site: what came, or why not. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { useSpeech } from "../text";
import { reasonOf } from "./reason";

export interface Asked<T> {
  value: T | null;
  failure: string | null;
  /** Asks again. */
  again(): void;
}

/**
 * Takes a step, and the next `every_ms` after it is done: a slow site is not asked twice at once, so no answer is
 * overtaken by a later one. Returns how to end it; the step under way sees that by its signal.
 */
export function poll(
  step: (signal: AbortSignal) => Promise<void>,
  every_ms: number | null = null,
): () => void {
  const ending = new AbortController();
  let timer: ReturnType<typeof setTimeout> | null = null;
  const run = async () => {
    await step(ending.signal);
    if (every_ms !== null && !ending.signal.aborted) timer = setTimeout(run, every_ms);
  };
  void run();
  return () => {
    ending.abort();
    if (timer !== null) clearTimeout(timer);
  };
}

/** Asks when a key changes, and then every `every_ms`; an answer to an earlier key is dropped. */
export function useAsked<T>(
  key: string,
  question: (signal: AbortSignal) => Promise<T>,
  every_ms: number | null = null,
): Asked<T> {
  const { text } = useSpeech();
  const value = useSignal<T | null>(null);
  const failure = useSignal<string | null>(null);
  const turn = useSignal(0);
  useEffect(
    () =>
      poll(async (signal) => {
        try {
          const found = await question(signal);
          if (signal.aborted) return;
          value.value = found;
          failure.value = null;
        } catch (error) {
          if (!signal.aborted) failure.value = reasonOf(error, text);
        }
      }, every_ms),
    [key, turn.value, every_ms],
  );
  return { value: value.value, failure: failure.value, again: () => (turn.value += 1) };
}
