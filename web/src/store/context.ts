/** What every component may reach: the store, and what the person at the page has chosen. */

import { type Signal, signal } from "@preact/signals";
import { createContext } from "preact";
import { useContext } from "preact/hooks";

import type { Store } from "./store";

/** The person's choices; they live as long as the page. */
export interface Choices {
  /** Id of the machine whose details are open. */
  selected: Signal<string | null>;
  /** Whether the plan keeps the selected machine in its middle. */
  following: Signal<boolean>;
}

export function noChoices(): Choices {
  return { selected: signal(null), following: signal(false) };
}

export interface Desk {
  store: Store;
  choices: Choices;
}

export const DeskContext = createContext<Desk | null>(null);

export function useDesk(): Desk {
  const desk = useContext(DeskContext);
  if (desk === null) throw new Error("a component stands outside of the page");
  return desk;
}
