import { describe, expect, it } from "vitest";

import type { AlertView } from "../src/api/alerts";
import { alertWords } from "../src/components/alert-words";
import { Format } from "../src/format";
import { alertsTold, openAlerts, takeAlert, takeAlerts } from "../src/store/alerts";
import { de } from "../src/text/de";
import { en } from "../src/text/en";
import { TIME } from "./views";

function alert(changes: Partial<AlertView> = {}): AlertView {
  return {
    id: "sensor_silent.m1.gnss_right.1",
    rule: "sensor_silent",
    severity: "warning",
    machine: "m1",
    part: "gnss_right",
    message: "m1: gnss_right is silent for 2.0 s",
    value: 2,
    worst: 75,
    state: "active",
    raised: TIME,
    times: 1,
    cleared: null,
    acknowledged: null,
    changed: TIME,
    ...changes,
  };
}

describe("the words of an alert", () => {
  const english = (changes: Partial<AlertView>) => alertWords(alert(changes), "Menzi", en, new Format("en"));
  const german = (changes: Partial<AlertView>) => alertWords(alert(changes), "Menzi", de, new Format("de"));

  it("name machine and part as people do, with the worst since it was raised, in the page's language", () => {
    expect(english({})).toBe("Menzi: GNSS right silent for 1:15");
    expect(german({})).toBe("Menzi: GNSS rechts 1:15 stumm");
    expect(german({ rule: "sigma_over_tolerance", part: null, worst: 2.5 })).toBe(
      "Menzi: Sigma der Position bis zum 2,5-Fachen der Toleranz",
    );
  });

  it("are the page's for every rule", () => {
    const rules = Object.keys(en.alerts.rules) as AlertView["rule"][];
    expect(rules.length).toBe(9);
    for (const rule of rules) expect(english({ rule })).not.toContain("gnss_right is silent");
  });

  it("are the site's where the page has none", () => {
    expect(english({ part: "sonar", message: "m1: sonar is silent for 2.0 s" })).toBe(
      "m1: sonar is silent for 2.0 s",
    );
    expect(english({ rule: "disk_low", machine: null, part: null, worst: 1.25 })).toBe(
      "the recordings' disk was down to 1.3 GB",
    );
    expect(english({ part: "sonar", message: "sonar is silent" })).toBe("Menzi: sonar is silent");
  });
});

describe("the alerts that are open", () => {
  it("are not none before the site has told them", () => {
    expect(alertsTold.value).toBe(false);
    takeAlert(alert({ state: "cleared" }));
    expect(alertsTold.value).toBe(false);
    takeAlerts([]);
    expect([alertsTold.value, openAlerts.value]).toEqual([true, []]);
  });
});
