/** Something asked of the site: what came, or why not. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { reasonOf } from "../api/http";

export interface Asked<T> {
  value: T | null;
  failure: string | null;
  /** Asks again. */
  again(): void;
}

/** Asks when a key changes, and then every `every_ms`; an answer that is overtaken is dropped. */
export function useAsked<T>(
  key: string,
  question: (signal: AbortSignal) => Promise<T>,
  every_ms: number | null = null,
): Asked<T> {
  const value = useSignal<T | null>(null);
  const failure = useSignal<string | null>(null);
  const turn = useSignal(0);
  useEffect(() => {
    const ending = new AbortController();
    const run = async () => {
      try {
        const found = await question(ending.signal);
        if (ending.signal.aborted) return;
        value.value = found;
        failure.value = null;
      } catch (error) {
        if (!ending.signal.aborted) failure.value = reasonOf(error);
      }
    };
    void run();
    const timer = every_ms === null ? null : window.setInterval(run, every_ms);
    return () => {
      ending.abort();
      if (timer !== null) window.clearInterval(timer);
    };
  }, [key, turn.value, every_ms]);
  return { value: value.value, failure: failure.value, again: () => (turn.value += 1) };
}
