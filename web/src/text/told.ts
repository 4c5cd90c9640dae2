/**
 * What machines say in sentences of their own, in the page's words.
 *
 * A language has a table from the sentence, as it stands in the machine's sources with `{...}` where a value comes, to
 * its own with `{}` in the same places. What has no entry, such as a sentence of newer software, stays as it came.
 */

import type { Format } from "../format";

export type Sentences = Readonly<Record<string, string>>;

const VALUE = /\{[^}]*\}/g;

export function inWords(told: string, sentences: Sentences, format: Format): string {
  for (const [theirs, ours] of Object.entries(sentences)) {
    const values = pattern(theirs).exec(told)?.slice(1);
    if (values === undefined) continue;
    let next = 0;
    return ours.replace(VALUE, () => valueWords(values[next++] ?? "", format));
  }
  return told;
}

function pattern(sentence: string): RegExp {
  const fixed = sentence.split(VALUE).map((part) => part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&"));
  return new RegExp(`^${fixed.join("(.+?)")}$`);
}

/** A number with the decimal sign of the language. */
function valueWords(value: string, format: Format): string {
  const number = /^-?\d+(?:\.(\d{1,7}))?$/.exec(value);
  return number === null ? value : format.number(Number(value), number[1]?.length ?? 0);
}
