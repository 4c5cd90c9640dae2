/** Position sigma and speed of the last minute. */

import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";

import type { Format } from "../format";
import { HISTORY_SPAN_MS, type Tracing } from "../store/trace";
import { useSpeech } from "../text";

const HEIGHT_PX = 150;

export function HistoryPlot({ name, trace, now_ms }: { name: string; trace: Tracing; now_ms: number }) {
  const { text, format } = useSpeech();
  const place = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);

  useEffect(() => {
    const container = place.current;
    if (container === null) return;
    const open = () => {
      plot.current?.destroy();
      const colours = getComputedStyle(container);
      plot.current = new uPlot(
        options(container.clientWidth, colours, text.plot, format),
        [[], [], []],
        container,
      );
    };
    open();
    const watcher = new ResizeObserver(() =>
      plot.current?.setSize({ width: container.clientWidth, height: HEIGHT_PX }),
    );
    watcher.observe(container);
    const scheme = window.matchMedia("(prefers-color-scheme: dark)");
    scheme.addEventListener("change", open);
    return () => {
      watcher.disconnect();
      scheme.removeEventListener("change", open);
      plot.current?.destroy();
      plot.current = null;
    };
  }, [text, format]);

  useEffect(() => {
    const points = trace.history.filter(({ time_ms }) => now_ms - time_ms <= HISTORY_SPAN_MS);
    plot.current?.setData([
      points.map(({ time_ms }) => (time_ms - now_ms) / 1000),
      points.map(({ sigma_m }) => sigma_m * 100),
      points.map(({ speed_mps }) => speed_mps),
    ]);
  }, [trace, now_ms]);

  return (
    <figure class="history" aria-label={text.details.plotDescription(name)}>
      <figcaption>
        <span class="series series-sigma">{text.plot.sigma} [cm]</span>
        <span class="series series-speed">{text.plot.speed} [m/s]</span>
      </figcaption>
      <div class="history-plot" ref={place} />
    </figure>
  );
}

function options(
  width: number,
  colours: CSSStyleDeclaration,
  words: { sigma: string; speed: string; seconds: string },
  format: Format,
): uPlot.Options {
  const colour = (name: string) => colours.getPropertyValue(name).trim();
  const [sigma, speed, faint, ink] = [
    colour("--sigma"),
    colour("--speed"),
    colour("--line"),
    colour("--ink-soft"),
  ];
  const axis = { stroke: ink, font: "11px sans-serif", ticks: { show: false } };
  const decimals = (_plot: uPlot, values: number[]) => format.axis(values);
  return {
    width,
    height: HEIGHT_PX,
    cursor: { show: false },
    legend: { show: false },
    padding: [8, 4, 0, 0],
    scales: {
      x: { time: false, range: [-HISTORY_SPAN_MS / 1000, 0] },
      sigma: { range: (_plot, _least, most) => [0, Math.max(most * 1.15, 1)] },
      speed: { range: (_plot, _least, most) => [0, Math.max(most * 1.15, 0.5)] },
    },
    axes: [
      {
        ...axis,
        size: 26,
        grid: { stroke: faint, width: 1 },
        values: (_plot, values) =>
          values.map((value) => (value === 0 ? "0 s" : `${format.number(value, 0)} s`)),
      },
      {
        ...axis,
        scale: "sigma",
        size: 40,
        stroke: sigma,
        grid: { stroke: faint, width: 1 },
        values: decimals,
      },
      {
        ...axis,
        scale: "speed",
        side: 1,
        size: 40,
        stroke: speed,
        grid: { show: false },
        values: decimals,
      },
    ],
    series: [
      {},
      { label: words.sigma, scale: "sigma", stroke: sigma, width: 2, points: { show: false } },
      { label: words.speed, scale: "speed", stroke: speed, width: 1.5, points: { show: false } },
    ],
  };
}
