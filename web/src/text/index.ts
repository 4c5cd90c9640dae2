/** Chooses the page's language: `?lang=de`, what the person chose before, or the browser's wish; English otherwise. */

import { type ReadonlySignal, signal } from "@preact/signals";
import { createContext } from "preact";
import { useContext } from "preact/hooks";

import { Format } from "../format";
import { de } from "./de";
import { en, type Text } from "./en";

export type { Text };

export const LANGUAGES: readonly Text[] = [en, de];

/** The first language that the page speaks among those wished for. */
export function chooseText(wishes: readonly string[]): Text {
  for (const wish of wishes) {
    const found = LANGUAGES.find((text) => wish.toLowerCase().split("-")[0] === text.language);
    if (found !== undefined) return found;
  }
  return en;
}

export interface Speech {
  text: Text;
  format: Format;
  choose(language: string): void;
}

interface Spoken {
  /** Changes when another language is chosen. */
  text: ReadonlySignal<Text>;
  /** Changes with the zone in which times are told. */
  format: ReadonlySignal<Format>;
  /** Chooses a language, by its two letters, for this browser. */
  choose(language: string): void;
}

export const SpeechContext = createContext<Spoken>({
  text: signal(en),
  format: signal(new Format("en")),
  choose: () => {},
});

/** Words and numbers in the page's language. */
export function useSpeech(): Speech {
  const { text, format, choose } = useContext(SpeechContext);
  return { text: text.value, format: format.value, choose };
}
