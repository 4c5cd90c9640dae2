/** Chooses the page's language: `?lang=de` or the browser's wish, English otherwise. */

import { type ReadonlySignal, signal } from "@preact/signals";
import { createContext } from "preact";
import { useContext } from "preact/hooks";

import { Format } from "../format";
import { de } from "./de";
import { en, type Text } from "./en";

export type { Text };

const LANGUAGES: readonly Text[] = [en, de];

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
}

interface Spoken {
  text: Text;
  /** Changes with the zone in which times are told. */
  format: ReadonlySignal<Format>;
}

export const SpeechContext = createContext<Spoken>({ text: en, format: signal(new Format("en")) });

/** Words and numbers in the page's language. */
export function useSpeech(): Speech {
  const { text, format } = useContext(SpeechContext);
  return { text, format: format.value };
}
