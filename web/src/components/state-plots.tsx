/** The plots of what a machine says of itself: sigma, tests, rates, biases, latency. Live and out of recordings. */

import type { ReadonlySignal } from "@preact/signals";
import { useMemo } from "preact/hooks";

import { type GnssState, type Mode, SENSORS, type StatePoint } from "../api/types";
import { useSpeech } from "../text";
import { type Lane, Lanes, segmentsOf } from "./lanes";
import { type PlotLine, TimePlot } from "./time-plot";

/** Reports come once a second; a longer gap is a gap. */
const GAP_S = 4;
const MILLI = 1e3;

export const GNSS_COLOURS: Record<GnssState, string> = {
  fixed: "--gnss-fixed",
  degraded: "--gnss-degraded",
  frozen: "--gnss-frozen",
  jumping: "--gnss-jumping",
  silent: "--gnss-silent",
  recovering: "--gnss-recovering",
};

const MODE_COLOURS: Record<Mode, string> = {
  initializing: "--offline",
  main: "--gnss-fixed",
  fallback: "--gnss-degraded",
  imu_only: "--gnss-silent",
};

interface StatePlotsProps {
  /** Times in `time_s` as the span has them. */
  states: readonly StatePoint[];
  span: readonly [number, number];
  tolerance_m: number | null;
  gap_s?: number;
  now?: ReadonlySignal<number | null>;
  onPick?: (time_s: number) => void;
}

export function StatePlots({ states, span, tolerance_m, gap_s = GAP_S, now, onPick }: StatePlotsProps) {
  const { text } = useSpeech();
  const words = text.plot;
  const { times_s, at } = useMemo(() => withGaps(states, gap_s), [states, gap_s]);
  const lines = useMemo(() => {
    const of = (value: (state: StatePoint) => number | null) =>
      at.map((state) => (state === null ? null : value(state)));
    const xyz = (pick: (state: StatePoint) => readonly number[], scale: number): PlotLine[] =>
      ["x", "y", "z"].map((label, axis) => ({
        label,
        colour: `--axis-${label}`,
        values: of((state) => (pick(state)[axis] ?? 0) * scale),
      }));
    const usual = usualRates(states);
    return {
      sigma: [
        { label: words.sigma, colour: "--sigma", values: of((state) => scaled(state.position_sigma_m, 100)) },
      ],
      heading: [
        { label: words.headingSigma, colour: "--sigma", values: of((state) => state.heading_sigma_deg) },
      ],
      speed: [{ label: words.speed, colour: "--speed", values: of((state) => state.speed_mps) }],
      test: [{ label: words.test, colour: "--speed", values: of((state) => state.worst_test_ratio) }],
      rates: SENSORS.filter((sensor) => usual.has(sensor)).map((sensor, index) => ({
        label: text.sensor[sensor],
        colour: `--line-${index}`,
        values: of((state) => {
          const rate = state.rates.find((told) => told.sensor === sensor)?.rate_hz;
          return rate === undefined ? null : (rate / (usual.get(sensor) ?? 1)) * 100;
        }),
      })),
      gyro: xyz((state) => state.gyro_bias, MILLI),
      accel: xyz((state) => state.accel_bias, MILLI),
      clock: [
        {
          label: words.clock,
          colour: "--line-0",
          values: of((state) => scaled(state.clock_offset_s, MILLI)),
        },
      ],
      latency: [
        { label: words.update, colour: "--line-1", values: of((state) => state.update_us / MILLI) },
        {
          label: words.prediction,
          colour: "--line-2",
          values: of((state) => scaled(state.prediction_p99_us, 1 / MILLI)),
        },
        {
          label: words.estimateAge,
          colour: "--line-3",
          values: of((state) => scaled(state.estimate_age_s, MILLI)),
        },
      ],
    };
  }, [at, states, text]);
  const common = {
    times_s,
    span,
    syncKey: "states",
    ...(now === undefined ? {} : { now }),
    ...(onPick === undefined ? {} : { onPick }),
  };
  return (
    <div class="plots">
      <TimePlot
        {...common}
        title={words.sigma}
        unit="cm"
        lines={lines.sigma}
        digits={2}
        limit={scaled(tolerance_m, 100)}
      />
      <TimePlot {...common} title={words.test} unit="–" lines={lines.test} limit={1} />
      <TimePlot {...common} title={words.headingSigma} unit="°" lines={lines.heading} />
      <TimePlot {...common} title={words.speed} unit="m/s" lines={lines.speed} />
      <TimePlot {...common} title={words.rates} unit="%" lines={lines.rates} digits={0} />
      <TimePlot {...common} title={words.latency} unit="ms" lines={lines.latency} digits={2} />
      <TimePlot {...common} title={words.gyroBias} unit="mrad/s" lines={lines.gyro} digits={3} />
      <TimePlot {...common} title={words.accelBias} unit="mm/s²" lines={lines.accel} digits={1} />
      <TimePlot {...common} title={words.clock} unit="ms" lines={lines.clock} digits={1} />
    </div>
  );
}

/** The lanes of one machine: what its position rests on, and its fixes. */
export function StateLanes({
  states,
  span,
  gap_s = GAP_S,
  now,
  onPick,
}: Omit<StatePlotsProps, "tolerance_m">) {
  const { text } = useSpeech();
  const lanes = useMemo(
    (): Lane[] => [
      {
        name: text.plot.modeLane,
        segments: segmentsOf(states, gap_s, ({ time_s, mode }) => ({
          time_s,
          colour: MODE_COLOURS[mode],
          label: text.mode[mode],
        })),
      },
      { name: text.plot.gnssLane, segments: gnssSegments(states, gap_s, text.gnss) },
    ],
    [states, gap_s, text],
  );
  return (
    <Lanes
      lanes={lanes}
      span={span}
      {...(now === undefined ? {} : { now })}
      {...(onPick === undefined ? {} : { onPick })}
    />
  );
}

export function gnssSegments(
  states: readonly StatePoint[],
  gap_s: number,
  words: Record<GnssState, string>,
): ReturnType<typeof segmentsOf> {
  return segmentsOf(states, gap_s, ({ time_s, gnss }) => ({
    time_s,
    colour: GNSS_COLOURS[gnss],
    label: words[gnss],
  }));
}

function scaled(value: number | null, scale: number): number | null {
  return value === null ? null : value * scale;
}

/** Times with a break where nothing was said: a line must not bridge it. */
function withGaps(states: readonly StatePoint[], gap_s: number) {
  const times_s: number[] = [];
  const at: (StatePoint | null)[] = [];
  for (const state of states) {
    const last_s = times_s.at(-1);
    if (last_s !== undefined && state.time_s - last_s > gap_s) {
      times_s.push(last_s + gap_s / 2);
      at.push(null);
    }
    if (last_s !== undefined && state.time_s <= last_s) continue;
    times_s.push(state.time_s);
    at.push(state);
  }
  return { times_s, at };
}

/** The middle of each sensor's rates: what is usual for it. */
function usualRates(states: readonly StatePoint[]): Map<string, number> {
  const rates = new Map<string, number[]>();
  for (const state of states) {
    for (const { sensor, rate_hz } of state.rates) {
      const known = rates.get(sensor) ?? [];
      known.push(rate_hz);
      rates.set(sensor, known);
    }
  }
  const middle = (values: number[]) => values.sort((a, b) => a - b)[Math.floor(values.length / 2)] ?? 0;
  return new Map([...rates].map(([sensor, values]) => [sensor, Math.max(0.1, middle(values))]));
}
