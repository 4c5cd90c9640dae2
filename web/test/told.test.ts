import { readdirSync, readFileSync } from "node:fs";
import { describe, expect, it } from "vitest";

import { Format } from "../src/format";
import { de } from "../src/text/de";
import { en } from "../src/text/en";
import { inWords } from "../src/text/told";

const SOURCES = new URL("../../src/estimator/", import.meta.url);
const sources = readdirSync(SOURCES)
  .filter((name) => name.endsWith(".rs"))
  .map((name) => readFileSync(new URL(name, SOURCES), "utf8"));

describe("what machines say", () => {
  it("is told in the page's words, with its values", () => {
    const german = new Format("de");
    const told = (sentence: string) => inWords(sentence, de.told, german);
    expect(told("the heading: drive some metres")).toBe("die Richtung: einige Meter fahren");
    expect(told("RTK: the left antenna reports 1.25 m, 0.20 m is the limit")).toBe(
      "RTK: die linke Antenne meldet 1,25 m, 0,20 m ist die Grenze",
    );
    expect(told("a sentence of newer software")).toBe("a sentence of newer software");
    expect(inWords("motion", en.told, new Format("en"))).toBe("motion");
  });

  it("is known by the very sentences of their sources", () => {
    for (const sentence of Object.keys(de.told)) {
      expect(
        sources.some((source) => source.includes(`"${sentence}"`)),
        sentence,
      ).toBe(true);
    }
  });

  it("has German words for all that a machine waits for", () => {
    const source = sources.find((text) => text.includes("fn try_start("));
    const asking = /fn try_start\([\s\S]*?\n {4}\}\n/.exec(source ?? "")?.[0] ?? "";
    const sentences = [...asking.matchAll(/"([^"]+)"/g)].map(([, sentence]) => sentence ?? "");
    expect(sentences.length).toBeGreaterThanOrEqual(5);
    for (const sentence of sentences) expect(de.told).toHaveProperty([sentence]);
  });
});
