/** What was the case, and when: a lane for each machine or matter, on the time axis of the plots. */

import type { ReadonlySignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { useSpeech } from "../text";

export interface Segment {
  from_s: number;
  to_s: number;
  /** Custom property of the style. */
  colour: string;
  /** In words: for the pointer, and for those who do not see it. */
  label: string;
  href?: string;
  /** Drawn hatched: nothing is known. */
  unknown?: boolean;
}

export interface Lane {
  name: string;
  href?: string;
  segments: Segment[];
  /** Moments of which something is told. */
  marks?: { time_s: number; label: string; colour: string }[];
}

interface LanesProps {
  lanes: Lane[];
  span: readonly [number, number];
  now?: ReadonlySignal<number | null>;
  onPick?: (time_s: number) => void;
  /** Names beside the lanes instead of above them. */
  wide?: boolean;
}

/** Shorter segments would not be seen. */
const LEAST_PERCENT = 0.35;

export function Lanes({ lanes, span, now, onPick, wide = false }: LanesProps) {
  const [from, to] = span;
  const length = Math.max(1e-3, to - from);
  const percent = (time_s: number) => Math.min(100, Math.max(0, ((time_s - from) / length) * 100));
  const whole = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (now === undefined) return;
    return now.subscribe((time_s) => {
      whole.current?.style.setProperty("--now", time_s === null ? "-1%" : `${percent(time_s)}%`);
    });
  }, [now, from, to]);
  return (
    <div class={`lanes${wide ? " lanes-wide" : ""}`} ref={whole}>
      {lanes.map((lane) => (
        <div key={lane.name} class="lane">
          {lane.href === undefined ? (
            <span class="lane-name">{lane.name}</span>
          ) : (
            <a class="lane-name" href={lane.href}>
              {lane.name}
            </a>
          )}
          {/* biome-ignore lint/a11y/noStaticElementInteractions lint/a11y/useKeyWithClickEvents: a shortcut for the mouse; the scrubber and the lists do the same. */}
          <div
            class="lane-track"
            onClick={(event) => {
              const box = event.currentTarget.getBoundingClientRect();
              onPick?.(from + ((event.clientX - box.left) / box.width) * length);
            }}
          >
            <span class="visually-hidden">
              <LaneWords lane={lane} length={length} />
            </span>
            {lane.segments.map((segment) => {
              const left = Math.min(100 - LEAST_PERCENT, percent(segment.from_s));
              const style = {
                left: `${left}%`,
                width: `${Math.max(LEAST_PERCENT, percent(segment.to_s) - left)}%`,
                "--segment": `var(${segment.colour})`,
              };
              const classes = `segment${segment.unknown ? " segment-unknown" : ""}`;
              const key = `${segment.from_s} ${segment.label}`;
              return segment.href === undefined ? (
                <i key={key} class={classes} style={style} title={segment.label} />
              ) : (
                <a key={key} class={classes} style={style} title={segment.label} href={segment.href}>
                  <span class="visually-hidden">{segment.label}</span>
                </a>
              );
            })}
            {lane.marks?.map(({ time_s, label, colour }) => (
              <i
                key={`${time_s} ${label}`}
                class="lane-mark"
                title={label}
                style={{ left: `${percent(time_s)}%`, "--segment": `var(${colour})` }}
              />
            ))}
            {now !== undefined && <i class="lane-now" />}
          </div>
        </div>
      ))}
      <LaneLegend lanes={lanes} />
    </div>
  );
}

/** What the colours mean, of those that are there. */
function LaneLegend({ lanes }: { lanes: Lane[] }) {
  const found = new Map<string, Segment>();
  for (const { segments } of lanes) {
    for (const segment of segments) found.set(`${segment.colour} ${nameOf(segment)}`, segment);
  }
  if (found.size === 0) return null;
  return (
    <ul class="lane-legend" aria-hidden="true">
      {[...found].map(([key, segment]) => (
        <li key={key}>
          <i
            class={segment.unknown ? "segment-unknown" : ""}
            style={{ "--segment": `var(${segment.colour})` }}
          />
          {nameOf(segment)}
        </li>
      ))}
    </ul>
  );
}

/** What a segment is about; details follow after a comma. */
function nameOf({ label }: Segment): string {
  return label.split(",")[0] ?? label;
}

/** The lane in words: the share of time of each thing. */
function LaneWords({ lane, length }: { lane: Lane; length: number }) {
  const { format } = useSpeech();
  const shares = new Map<string, number>();
  for (const segment of lane.segments) {
    const name = nameOf(segment);
    shares.set(name, (shares.get(name) ?? 0) + (segment.to_s - segment.from_s));
  }
  const words = [...shares]
    .slice(0, 12)
    .map(([name, time_s]) => `${name} ${format.percent(time_s / length)}`);
  return <>{words.join("; ")}</>;
}

/** Neighbours that say the same become one segment, as long as no more than `gap_s` lies between them. */
export function segmentsOf<Item>(
  items: readonly Item[],
  gap_s: number,
  look: (item: Item) => { time_s: number; colour: string; label: string },
): Segment[] {
  const segments: Segment[] = [];
  let last_s = Number.NEGATIVE_INFINITY;
  for (const item of items) {
    const { time_s, colour, label } = look(item);
    const before = segments.at(-1);
    const joins = before !== undefined && time_s - last_s <= gap_s;
    if (joins) before.to_s = time_s;
    if (!joins || before.label !== label) segments.push({ from_s: time_s, to_s: time_s, colour, label });
    last_s = time_s;
  }
  return segments;
}
