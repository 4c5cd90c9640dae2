/** What the plan's colours and outlines mean. */

import { GNSS_STATES } from "../api/types";
import { useSpeech } from "../text";
import type { Palette } from "./palette";

export function Legend({ palette, shadow }: { palette: Palette; shadow: boolean }) {
  const { text } = useSpeech();
  return (
    <details class="legend">
      <summary>{text.plan.legend}</summary>
      <h3>{text.plan.tail}</h3>
      <ul>
        {GNSS_STATES.map((state) => (
          <li key={state}>
            <i class="legend-line" style={{ background: palette.gnss[state] }} />
            {text.gnss[state]}
          </li>
        ))}
      </ul>
      <ul>
        <li>
          <svg
            viewBox="0 0 22 14"
            width="22"
            height="14"
            aria-hidden="true"
            style={{ color: palette.ellipse }}
          >
            <ellipse cx="11" cy="7" rx="10" ry="5" class="legend-ellipse" />
          </svg>
          {text.plan.ellipse}
        </li>
        <li>
          <svg
            viewBox="0 0 22 14"
            width="22"
            height="14"
            aria-hidden="true"
            style={{ color: palette.ellipse }}
          >
            <circle cx="11" cy="7" r="6" class="legend-ring" />
          </svg>
          {text.plan.ring}
        </li>
      </ul>
      {shadow && (
        <ul>
          <li>
            <i class="legend-line legend-shadow" style={{ background: palette.shadow }} />
            {text.plan.shadowLegend}
          </li>
        </ul>
      )}
      <p>{text.plan.grid}</p>
    </details>
  );
}
