import { describe, expect, it } from "vitest";

import type { Site, StatePoint, TrackAnswer } from "../src/api/types";
import { lastBefore, ReplayStore, turned } from "../src/store/replay";

const SITE: Site = {
  id: "site",
  name: "Site",
  time_zone: "UTC",
  world: { latitude_deg: 47, longitude_deg: 8, altitude_m: 400 },
  software: "0.1.0",
};

function told(time_s: number, changes: Partial<StatePoint> = {}): StatePoint {
  return {
    time_s,
    state_word: "RTK FIXED",
    severity: "good",
    mode: "main",
    gnss: "fixed",
    waits_for: null,
    position_sigma_m: 0.01,
    heading_sigma_deg: 0.1,
    speed_mps: 1,
    worst_test_ratio: 0.2,
    worst_test_sensor: null,
    rates: [],
    gyro_bias: [0, 0, 0],
    accel_bias: [0, 0, 0],
    update_us: 100,
    estimate_age_s: null,
    prediction_p99_us: null,
    clock_offset_s: null,
    pose_rate_hz: null,
    ...changes,
  };
}

/** A machine that drives north with 1 m/s, is silent from 10 s to 20 s, and turns through north. */
function answer(): TrackAnswer {
  const time_s = [...Array(51).keys()].map((index) => index * 0.2).concat([20, 20.2, 20.4]);
  const all = <T>(value: (time: number) => T) => time_s.map(value);
  return {
    session: "s",
    start: "2026-11-23T05:00:00Z",
    length_s: 20.4,
    step_s: 0.2,
    finished: true,
    machines: [
      {
        id: "a",
        name: "Machine a",
        software: "0.1.0",
        clock_shift_s: 0,
        poses: {
          time_s,
          position_m: all((time) => [0, time, 1] as const),
          cabin_position_m: all((time) => [0, time, 1] as const),
          heading_deg: all((time) => (359 + 10 * time) % 360),
          heading_sigma_deg: all(() => 0.1),
          chassis_heading_deg: all(() => null),
          chassis_position_m: all(() => null),
          speed_mps: all(() => 1),
          position_sigma_m: all(() => [0.01, 0.01, 0.02] as const),
          ellipse95: all(() => [0.03, 0.02, 10] as const),
        },
        states: [
          told(0.1),
          told(5, { state_word: "HOLDING 0:00, 0.0 m, 1.0 cm", severity: "warning", gnss: "silent" }),
          told(20.1),
        ],
        silences: [{ from_s: 10, to_s: 20 }],
        poses_missing: 0,
      },
    ],
  };
}

function replay(): ReplayStore {
  return new ReplayStore(
    answer(),
    SITE,
    { silent: (since) => `NO DATA ${since.toFixed(0)}`, notYet: "NOT YET" },
    () => 0,
  );
}

function at(time_s: number) {
  const store = replay();
  store.seek(time_s);
  const machine = store.state.value.machines.get("a");
  if (machine === undefined) throw new Error("the machine is gone");
  return machine;
}

describe("a recording", () => {
  it("shows machines between two of their poses", () => {
    const { view } = at(1.1);
    expect(view.pose?.position_m[1]).toBeCloseTo(1.1, 9);
    expect(view.pose?.heading_deg).toBeCloseTo(10, 6);
    expect(view.pose?.age_s).toBe(0);
    expect(view.presence).toBe("online");
  });

  it("says what the site said then, not before and not after", () => {
    expect(at(4.9).view.state_word).toBe("RTK FIXED");
    expect(at(5.1).view).toMatchObject({ severity: "warning", state_word: "HOLDING 0:00, 0.0 m, 1.0 cm" });
  });

  it("does not invent a way through a silence: the last pose grows old", () => {
    const { view } = at(15);
    expect(view.pose?.position_m[1]).toBeCloseTo(10, 9);
    expect(view.pose?.age_s).toBeCloseTo(5, 9);
    expect(view).toMatchObject({ presence: "stale", severity: "offline", state_word: "NO DATA 5" });
  });

  it("colours the tail by the fixes of the time, up to the moment, and breaks it where nothing is known", () => {
    const { tail } = at(20.3).trace;
    expect(tail.at(-1)?.time_ms).toBe(20_200);
    expect(tail.filter(({ starts }) => starts).map(({ time_ms }) => time_ms)).toEqual([0, 20_000]);
    expect(tail.find(({ time_ms }) => time_ms === 4_000)?.gnss).toBe("fixed");
    expect(tail.find(({ time_ms }) => time_ms === 6_000)?.gnss).toBe("silent");
  });

  it("stays within its bounds", () => {
    const store = replay();
    store.seek(1e9);
    expect(store.time_s.value).toBe(20.4);
    store.seek(-5);
    expect(store.time_s.value).toBe(0);
    expect(store.state.value.siteTime_ms).toBe(Date.parse("2026-11-23T05:00:00Z"));
  });
});

describe("small things of it", () => {
  it("turns the shorter way round", () => {
    expect(turned(350, 10, 0.5)).toBeCloseTo(0, 9);
    expect(turned(10, 350, 0.25)).toBeCloseTo(5, 9);
  });

  it("finds the last of which something holds", () => {
    const values = [1, 2, 2, 5];
    const last = (limit: number) => lastBefore(values.length, (index) => (values[index] ?? 0) <= limit);
    expect([0, 1, 2, 4, 9].map(last)).toEqual([-1, 0, 2, 2, 3]);
  });
});
