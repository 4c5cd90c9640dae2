/** Views as the site sends them, for tests; each test changes what it is about. */

import type { Delta, FleetView, MachineView, PoseView, Snapshot } from "../src/api/types";

export const WORLD = { latitude_deg: 47.4801402, longitude_deg: 8.49975325, altitude_m: 474.9 };
export const TIME = "2026-11-23T05:00:00.123456789Z";

export function poseView(changes: Partial<PoseView> = {}): PoseView {
  return {
    stamp: TIME,
    age_s: 0.05,
    fresh_s: 0.5,
    position_m: [10.5, 4.0, 1.5],
    latitude_deg: 47.48,
    longitude_deg: 8.5,
    altitude_m: 476.4,
    cabin_position_m: [10.0, 4.0, 1.0],
    heading_deg: 90,
    heading_sigma_deg: 0.1,
    chassis_heading_deg: 0,
    chassis_position_m: [10.0, 4.0, 0.0],
    speed_mps: 0.4,
    position_sigma_m: [0.008, 0.006, 0.014],
    ellipse95: { semi_major_m: 0.02, semi_minor_m: 0.015, bearing_deg: 90 },
    ...changes,
  };
}

export function machineView(changes: Partial<MachineView> = {}): MachineView {
  return {
    id: "a",
    name: "Machine a",
    presence: "online",
    presence_since: TIME,
    boot: "0123456789abcdef",
    state_word: "RTK FIXED",
    severity: "good",
    pose: poseView(),
    health: {
      age_s: 0.4,
      estimate_age_s: 0.01,
      report: {
        stamp_ns: 1_795_410_000_123_456_000,
        mode: "main",
        waits_for: null,
        gnss: "fixed",
        position_sigma_m: 0.008,
        heading_sigma_deg: 0.1,
        worst_test_ratio: 0.3,
        gnss_inflation: [1, 1],
        worst_test_sensor: "gnss_left",
        sensors: [
          { sensor: "imu", rate_hz: 100, age_s: 0.01, received: 4000, refused: 0, last_refusal: null },
          { sensor: "gnss_left", rate_hz: 20, age_s: null, received: 0, refused: 1, last_refusal: "NaN" },
        ],
        outage: null,
        updates: 800,
        update_us: 700,
        gyro_bias: [1e-3, -2e-3, 0],
        accel_bias: [0.05, 0, -0.02],
      },
    },
    gnss: { state: "fixed", since: TIME, mode: "main", outage: null },
    link: {
      pose_rate_hz: 100,
      received: 4000,
      missed: 2,
      refused: 0,
      gaps_open: 0,
      gaps_filled: 2,
      gaps_lost: 0,
      clock_offset_s: null,
    },
    ...changes,
  };
}

export function fleetView(machines: MachineView[]): FleetView {
  return {
    site: { id: "site", name: "Site", time_zone: "UTC", world: WORLD, software: "0.1.0" },
    time: TIME,
    machines,
  };
}

export function snapshot(machines: MachineView[]): Snapshot {
  return { type: "snapshot", seq: 0, fleet: fleetView(machines) };
}

export function delta(seq: number, machines: MachineView[]): Delta {
  return { type: "delta", seq, time: TIME, machines, dropped: 0 };
}
