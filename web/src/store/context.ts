/** What every component may reach: the picture that is shown, and what the person at the page has chosen. */

import { type ReadonlySignal, type Signal, signal } from "@preact/signals";
import { createContext } from "preact";
import { useContext } from "preact/hooks";

import { LANGUAGES } from "../text";
import type { State } from "./store";

/** In which coordinates places are told. */
export type Coordinates = "grid" | "wgs84";

/** The person's choices; those about the looks are kept by the browser. */
export interface Choices {
  /** Id of the machine whose details are open. */
  selected: Signal<string | null>;
  /** Whether the plan keeps the selected machine in its middle. */
  following: Signal<boolean>;
  coordinates: Signal<Coordinates>;
  /** Whether times are told in UTC instead of the site's zone. */
  utc: Signal<boolean>;
  /** The language that was chosen, by its two letters; empty for the browser's. */
  language: Signal<string>;
  /** Whether alerts are heard. */
  sound: Signal<boolean>;
  /** Whether the plan shows where GNSS was missing in the last week. */
  shadow: Signal<boolean>;
  /** Whether the plan shows the site's basemap, if there is one. */
  basemap: Signal<boolean>;
}

export function noChoices(): Choices {
  return {
    selected: signal(null),
    following: signal(false),
    coordinates: signal("grid"),
    utc: signal(false),
    language: signal(""),
    sound: signal(false),
    shadow: signal(false),
    basemap: signal(true),
  };
}

/** Choices as the browser kept them; they are kept anew at each change. */
export function keptChoices(storage: Pick<Storage, "getItem" | "setItem"> | null): Choices {
  const choices = noChoices();
  const keep = <T extends string | boolean>(name: string, choice: Signal<T>, allowed: readonly T[]) => {
    const key = `holdfast.${name}`;
    const kept = allowed.find((value) => String(value) === read(key));
    if (kept !== undefined) choice.value = kept;
    choice.subscribe((value) => write(key, String(value)));
  };
  const read = (key: string) => {
    try {
      return storage?.getItem(key) ?? null;
    } catch {
      return null;
    }
  };
  const write = (key: string, value: string) => {
    try {
      storage?.setItem(key, value);
    } catch {
      // A browser that keeps nothing: the choice lasts as long as the page.
    }
  };
  keep<Coordinates>("coordinates", choices.coordinates, ["grid", "wgs84"]);
  keep<boolean>("utc", choices.utc, [true, false]);
  keep<string>("language", choices.language, ["", ...LANGUAGES.map(({ language }) => language)]);
  keep<boolean>("sound", choices.sound, [true, false]);
  keep<boolean>("shadow", choices.shadow, [true, false]);
  keep<boolean>("basemap", choices.basemap, [true, false]);
  return choices;
}

/** Where a picture of the fleet comes from: the site, live, or a recording. */
export interface Source {
  /** Every write. */
  readonly state: ReadonlySignal<State>;
  /** The same at a pace to read. */
  readonly calm: ReadonlySignal<State>;
}

export interface Desk {
  store: Source;
  choices: Choices;
  /** Whether the picture is of a recording: nothing of it is now. */
  recorded?: boolean;
}

export const DeskContext = createContext<Desk | null>(null);

export function useDesk(): Desk {
  const desk = useContext(DeskContext);
  if (desk === null) throw new Error("a component stands outside of the page");
  return desk;
}
