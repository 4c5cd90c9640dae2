/** What an alert says, in the page's language, with the worst that was seen since it was raised. */

import type { AlertView } from "../api/alerts";
import { SENSORS } from "../api/types";
import type { Format } from "../format";
import type { Text } from "../text";

/** `name` is the machine's, if it is known. */
export function alertWords(alert: AlertView, name: string | undefined, text: Text, format: Format): string {
  const words = wordsOf(alert, text, format);
  if (alert.machine === null) return words ?? alert.message;
  if (words !== null) return `${name ?? alert.machine}: ${words}`;
  // The site's own words mostly say whose it is.
  const says_whose = alert.message.includes(alert.machine);
  return says_whose ? alert.message : `${name ?? alert.machine}: ${alert.message}`;
}

/** `null` where the site's words have to do. */
function wordsOf({ rule, part, worst }: AlertView, text: Text, format: Format): string | null {
  const words = text.alerts.words;
  switch (rule) {
    case "outage_longer":
      return words.outageLonger(format.span(worst));
    case "sigma_over_tolerance":
      return words.sigmaOverTolerance(format.number(worst, 1));
    case "machine_lost":
      return words.machineLost(format.span(worst));
    case "clock_off":
      return words.clockOff(format.number(worst, 3));
    case "disk_low":
      return words.diskLow(format.number(worst, 1));
    case "estimator_late":
      return words.estimatorLate(format.number(worst, 2));
    case "sensor_silent": {
      const sensor = SENSORS.find((known) => known === part);
      return sensor === undefined ? null : words.sensorSilent(text.sensor[sensor], format.span(worst));
    }
    case "id_conflict":
      return words.idConflict(format.span(worst));
    case "recording_paused":
      return words.recordingPaused(format.span(worst));
  }
}
