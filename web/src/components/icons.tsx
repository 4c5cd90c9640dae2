/** The four severities as shapes that differ without colour. */

import type { Severity } from "../api/types";

const PATHS: Record<Severity, { outline: string; mark: string }> = {
  good: { outline: "M8 1a7 7 0 1 0 0 14A7 7 0 0 0 8 1Z", mark: "m4.8 8.2 2.2 2.3 4.2-4.8" },
  warning: { outline: "M8 1.2 15.4 14.4H.6Z", mark: "M8 6v3.8M8 12v.2" },
  bad: { outline: "M5 1h6l4 4v6l-4 4H5l-4-4V5Z", mark: "m5.4 5.4 5.2 5.2m0-5.2-5.2 5.2" },
  offline: { outline: "M8 1a7 7 0 1 0 0 14A7 7 0 0 0 8 1Z", mark: "M4.5 8h7" },
};

export function SeverityIcon({ severity }: { severity: Severity }) {
  const { outline, mark } = PATHS[severity];
  return (
    <svg class={`icon severity-${severity}`} viewBox="0 0 16 16" width="16" height="16" aria-hidden="true">
      <path d={outline} fill="currentColor" />
      <path d={mark} class="icon-mark" />
    </svg>
  );
}
