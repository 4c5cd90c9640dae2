/** A plot over time. Plots with the same key share their cursor, and all can mark one moment. */

import { type ReadonlySignal, useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";

import type { Format } from "../format";
import { useSpeech } from "../text";

const HEIGHT_PX = 128;
/** Finer than this an axis has no words for. */
const LEAST_RANGE = 1e-3;
/** Lanes have the same margins, so that moments stand above each other. */
export const PLOT_LEFT_PX = 52;
export const PLOT_RIGHT_PX = 14;

export interface PlotLine {
  label: string;
  /** A custom property of the page's style, such as `--sigma`. */
  colour: string;
  values: (number | null)[];
}

export interface TimePlotProps {
  title: string;
  unit: string;
  /** Unix time, or since a start, s. */
  times_s: number[];
  lines: PlotLine[];
  span: readonly [number, number];
  /** A line across: more than this is too much. */
  limit?: number | null;
  digits?: number;
  syncKey: string;
  /** The moment that is shown elsewhere. */
  now?: ReadonlySignal<number | null>;
  onPick?: (time_s: number) => void;
  /** How a moment is told on the axis; by default as a time of day. */
  tick?: (time_s: number, step_s: number) => string;
  height?: number;
}

export function TimePlot(props: TimePlotProps) {
  const { title, unit, times_s, lines, span, limit = null, digits = 2, now, height = HEIGHT_PX } = props;
  const { text, format } = useSpeech();
  const place = useRef<HTMLDivElement>(null);
  const mark = useRef<HTMLElement>(null);
  const plot = useRef<uPlot | null>(null);
  const moment = useRef<number | null>(null);
  const cursor = useSignal<number | null>(null);
  const latest = useRef(props);
  latest.current = props;
  const shape = lines.map(({ label, colour }) => `${label} ${colour}`).join();

  const placeMark = (drawn: uPlot) => {
    if (mark.current === null) return;
    const [from, to] = latest.current.span;
    const time_s = moment.current;
    const seen = time_s !== null && time_s >= from && time_s <= to;
    mark.current.hidden = !seen;
    if (seen) mark.current.style.transform = `translateX(${PLOT_LEFT_PX + drawn.valToPos(time_s, "x")}px)`;
  };

  useEffect(() => {
    const container = place.current;
    if (container === null) return;
    const open = () => {
      plot.current?.destroy();
      plot.current = new uPlot(
        options(container, latest, format, {
          cursor: (index) => {
            cursor.value = index;
          },
          // Before it is drawn a plot does not know where a moment is.
          drawn: placeMark,
        }),
        dataOf(latest.current),
        container,
      );
    };
    open();
    const watcher = new ResizeObserver(() => plot.current?.setSize({ width: container.clientWidth, height }));
    watcher.observe(container);
    const scheme = window.matchMedia("(prefers-color-scheme: dark)");
    scheme.addEventListener("change", open);
    const pick = () => {
      const over = plot.current;
      const left = over?.cursor.left ?? -1;
      if (over !== null && left >= 0) latest.current.onPick?.(over.posToVal(left, "x"));
    };
    container.addEventListener("click", pick);
    return () => {
      watcher.disconnect();
      scheme.removeEventListener("change", open);
      container.removeEventListener("click", pick);
      plot.current?.destroy();
      plot.current = null;
    };
  }, [shape, limit, format, height]);

  useEffect(() => plot.current?.setData(dataOf(latest.current)), [times_s, lines, span[0], span[1]]);

  useEffect(() => {
    if (now === undefined) return;
    return now.subscribe((time_s) => {
      moment.current = time_s;
      if (plot.current !== null) placeMark(plot.current);
    });
  }, [now, span[0], span[1]]);

  const index = cursor.value;
  return (
    <figure class="plot" aria-label={text.plot.describe(title, lines.map(({ label }) => label).join(", "))}>
      <figcaption>
        <b>{title}</b> <span class="plot-unit">[{unit}]</span>
        {lines.map((line) => (
          <span key={line.label} class="series" style={{ "--series": `var(${line.colour})` }}>
            {lines.length > 1 && line.label}
            {index !== null && ` ${format.number(line.values[index] ?? null, digits)}`}
          </span>
        ))}
      </figcaption>
      <div class="plot-place" ref={place}>
        <i class="plot-now" ref={mark} hidden />
      </div>
    </figure>
  );
}

function dataOf({ times_s, lines }: TimePlotProps): uPlot.AlignedData {
  return [times_s, ...lines.map(({ values }) => values)];
}

/** What changes while the plot stands, such as the span, is read out of `latest` at each drawing. */
export function options(
  container: HTMLElement,
  latest: { readonly current: TimePlotProps },
  format: Format,
  on: { cursor(index: number | null): void; drawn(plot: uPlot): void },
): uPlot.Options {
  const { lines, limit = null, syncKey, height = HEIGHT_PX } = latest.current;
  const style = getComputedStyle(container);
  const colour = (name: string) => style.getPropertyValue(name).trim();
  const axis = {
    stroke: colour("--ink-soft"),
    font: "11px sans-serif",
    ticks: { show: false },
    grid: { stroke: colour("--line"), width: 1 },
  };
  const tick = (time_s: number, step_s: number): string =>
    latest.current.tick?.(time_s, step_s) ?? format.tick(time_s * 1000, step_s);
  return {
    width: Math.max(120, container.clientWidth),
    height,
    legend: { show: false },
    padding: [8, PLOT_RIGHT_PX, 0, 0],
    cursor: {
      sync: { key: syncKey },
      drag: { x: false, y: false },
      y: false,
      points: { size: 6 },
    },
    scales: {
      x: {
        time: false,
        range: () => {
          const [from, to] = latest.current.span;
          return [from, Math.max(to, from + 1)];
        },
      },
      y: { range: (_plot, least, most) => rangeOf(least, most, limit) },
    },
    axes: [
      {
        ...axis,
        size: 24,
        space: 64,
        incrs: [1, 2, 5, 10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14_400, 43_200, 86_400],
        values: (_plot, ticks, _index, _space, step) => ticks.map((time_s) => tick(time_s, step)),
      },
      {
        ...axis,
        size: PLOT_LEFT_PX,
        space: 26,
        values: (_plot, ticks) => format.axis(ticks),
      },
    ],
    series: [
      {},
      ...lines.map((line) => ({
        label: line.label,
        stroke: colour(line.colour),
        width: 1.5,
        spanGaps: false,
        points: { show: false },
      })),
    ],
    hooks: {
      setCursor: [(drawn) => on.cursor(drawn.cursor.idx ?? null)],
      draw: [
        on.drawn,
        (drawn) => {
          if (limit === null) return;
          const { ctx, bbox } = drawn;
          const y = drawn.valToPos(limit, "y", true);
          if (y < bbox.top || y > bbox.top + bbox.height) return;
          ctx.save();
          ctx.strokeStyle = colour("--bad");
          ctx.setLineDash([6, 4]);
          ctx.lineWidth = 1;
          ctx.beginPath();
          ctx.moveTo(bbox.left, y);
          ctx.lineTo(bbox.left + bbox.width, y);
          ctx.stroke();
          ctx.restore();
        },
      ],
    },
  };
}

function rangeOf(least: number | null, most: number | null, limit: number | null): [number, number] {
  const low = Math.min(0, least ?? 0);
  const high = Math.max(most ?? 0, limit ?? 0, low + LEAST_RANGE);
  // The range may not follow every tremble of a value around zero.
  const room = (high - low) * 0.12;
  return [low < 0 ? low - room : 0, high + room];
}
