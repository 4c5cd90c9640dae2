/** What happened to a machine, in words and colours. */

import type { MachineEvent, SessionEvent } from "../api/types";
import type { Format } from "../format";
import type { Text } from "../text";
import { inWords } from "../text/told";

/** Whether one would jump to it: refused readings and changes within the estimator are for its makers. */
export function isMark({ event }: SessionEvent): boolean {
  return event.kind !== "refused" && event.kind !== "graph_changed";
}

export function eventColour(event: MachineEvent): string {
  if (event.kind === "outage_ended" || event.kind === "initialized") return "--good";
  if (event.kind === "outage_began") return "--bad";
  return { info: "--accent", warning: "--warning", error: "--bad" }[event.severity];
}

export function eventWords(event: MachineEvent, text: Text, format: Format): string {
  const words = text.events;
  switch (event.kind) {
    case "mode_changed":
      return words.mode(text.mode[event.from], text.mode[event.to]);
    case "gnss_changed":
      return words.gnss(text.gnss[event.from], text.gnss[event.to]);
    case "graph_changed":
      return words.graph(event.from, event.to, event.reason);
    case "initialized":
      return words.initialized(inWords(event.heading_from, text.told, format));
    case "refused":
      return words.refused(format.count(event.count), text.sensor[event.sensor], event.reason);
    case "outage_began":
      return words.outageBegan(text.gnss[event.cause]);
    case "outage_ended": {
      const { start_stamp_ns: start, end_stamp_ns: end } = event;
      return words.outageEnded(
        format.span(end === null ? null : (end - start) / 1e9),
        format.metres(event.travelled_m, 1),
        format.smallLength(event.jump_m),
      );
    }
    case "restarted":
      return words.restarted(inWords(event.reason, text.told, format));
  }
}
