/**
 * What the site says, with the site's own names: the views of `/api/v1`.
 *
 * Times are RFC 3339 in UTC; ages are seconds by the site's clock at the moment of sending. `agreement.ts`
 * holds these against the types generated from the server's own description, and does not compile if they differ.
 */

import type { AlertView } from "./alerts";

export const PRESENCES = ["online", "stale", "restarted", "lost"] as const;
export type Presence = (typeof PRESENCES)[number];

export const SEVERITIES = ["good", "warning", "bad", "offline"] as const;
export type Severity = (typeof SEVERITIES)[number];

export const MODES = ["initializing", "main", "fallback", "imu_only"] as const;
export type Mode = (typeof MODES)[number];

export const GNSS_STATES = ["fixed", "degraded", "frozen", "jumping", "silent", "recovering"] as const;
export type GnssState = (typeof GNSS_STATES)[number];

/** What the site makes of a machine's fixes and its link. */
export const FIX_STATES = [
  "fixed",
  "float",
  "degraded",
  "frozen",
  "jumping",
  "silent",
  "link_lost",
  "recovering",
] as const;
export type FixState = (typeof FIX_STATES)[number];

export const SENSORS = [
  "imu",
  "base_imu",
  "gnss_left",
  "gnss_right",
  "lidar_odometry",
  "cabin_turn",
] as const;
export type Sensor = (typeof SENSORS)[number];

export const SESSION_STATES = ["recording", "complete", "recovered", "truncated"] as const;
export type SessionState = (typeof SESSION_STATES)[number];

export const RECORDING_STATES = ["recording", "paused", "stopped", "off"] as const;
export type RecordingState = (typeof RECORDING_STATES)[number];

export type Vector3 = readonly [number, number, number];

/** Origin of the site's east-north-up frame. */
export interface WorldOrigin {
  latitude_deg: number;
  longitude_deg: number;
  altitude_m: number;
}

export interface Site {
  id: string;
  name: string;
  /** IANA name. */
  time_zone: string;
  world: WorldOrigin;
  software: string;
}

/** The 95 % ellipse of the horizontal position. */
export interface Ellipse95 {
  semi_major_m: number;
  semi_minor_m: number;
  /** Of the longer axis, clockwise from north. */
  bearing_deg: number;
}

export interface PoseView {
  stamp: string;
  age_s: number;
  /** Older than this it is old. */
  fresh_s: number;
  /** Of the cabin IMU: the body whose position is estimated; east, north, up. */
  position_m: Vector3;
  latitude_deg: number;
  longitude_deg: number;
  altitude_m: number;
  /** A point of the axis about which the cabin turns: where the machine is drawn. */
  cabin_position_m: Vector3;
  /** Of the cabin's x axis, clockwise from north. */
  heading_deg: number;
  heading_sigma_deg: number;
  chassis_heading_deg: number | null;
  chassis_position_m: Vector3 | null;
  speed_mps: number;
  position_sigma_m: Vector3;
  ellipse95: Ellipse95;
}

export interface SensorHealth {
  sensor: Sensor;
  rate_hz: number;
  age_s: number | null;
  received: number;
  refused: number;
  last_refusal: string | null;
}

export interface OutageReport {
  start_stamp_ns: number;
  end_stamp_ns: number | null;
  cause: GnssState;
  travelled_m: number;
  jump_m: number | null;
}

export interface Health {
  stamp_ns: number;
  mode: Mode;
  waits_for: string | null;
  gnss: GnssState;
  /** Of the reported sigmas, horizontal and vertical; 1 is as reported. */
  gnss_inflation: readonly number[];
  position_sigma_m: number | null;
  heading_sigma_deg: number | null;
  /** Over 1 was refused. */
  worst_test_ratio: number;
  worst_test_sensor: Sensor | null;
  sensors: SensorHealth[];
  outage: OutageReport | null;
  updates: number;
  update_us: number;
  gyro_bias: Vector3;
  accel_bias: Vector3;
}

export interface HealthView {
  age_s: number;
  /** From the newest estimate to the report. */
  estimate_age_s: number | null;
  prediction_p99_us: number | null;
  report: Health;
}

/** What is left until sigma passes the site's tolerance. */
export interface Budget {
  tolerance_m: number;
  time_s: number | null;
  distance_m: number | null;
}

export interface CurrentOutage {
  id: string;
  cause: FixState;
  start: string;
  duration_s: number;
  travelled_m: number | null;
  position_sigma_m: number | null;
  budget: Budget | null;
}

export interface GnssView {
  state: FixState;
  since: string;
  mode: Mode | null;
  outage: CurrentOutage | null;
}

export interface LinkView {
  pose_rate_hz: number;
  received: number;
  missed: number;
  refused: number;
  gaps_open: number;
  gaps_filled: number;
  gaps_lost: number;
  clock_offset_s: number | null;
}

export interface MachineView {
  id: string;
  name: string;
  presence: Presence;
  presence_since: string;
  /** Drawn at each start of the machine's program; empty if not known yet. */
  boot: string;
  /** Version of its software; empty if not known yet. */
  software: string;
  /** One plain word for people, chosen by the site. */
  state_word: string;
  severity: Severity;
  pose: PoseView | null;
  health: HealthView | null;
  gnss: GnssView;
  link: LinkView;
}

export interface FleetView {
  site: Site;
  time: string;
  machines: MachineView[];
}

export interface Snapshot {
  type: "snapshot";
  seq: number;
  fleet: FleetView;
}

export interface Delta {
  type: "delta";
  seq: number;
  time: string;
  machines: MachineView[];
  dropped: number;
}

/** The answer to a request of ours that the site did not understand; everything goes on as before. */
export interface LiveError {
  type: "error";
  detail: string;
}

/** All alerts that are not both over and seen. */
export interface AlertsMessage {
  type: "alerts";
  seq: number;
  alerts: AlertView[];
}

export type LiveMessage = Snapshot | Delta | AlertsMessage | LiveError;

export interface RecordingView {
  state: RecordingState;
  /** Why nothing is recorded. */
  why: string | null;
  session: string | null;
  /** Messages that came while it was paused. */
  missed: number;
  next_session: string | null;
}

export interface SessionView {
  id: string;
  name: string;
  notes: string;
  tags: string[];
  state: SessionState;
  started: string;
  ended: string | null;
  bytes: number;
  messages: number;
  machines: string[];
  files: number;
}

export interface SessionsView {
  recording: RecordingView;
  sessions: SessionView[];
  next: string | null;
}

export interface SensorRate {
  sensor: Sensor;
  rate_hz: number;
}

/** What a machine said of itself at one time: live history, or out of a recording. */
export interface StatePoint {
  /** Since the `start` of the answer. */
  time_s: number;
  state_word: string;
  severity: Severity;
  mode: Mode;
  gnss: GnssState;
  waits_for: string | null;
  position_sigma_m: number | null;
  heading_sigma_deg: number | null;
  speed_mps: number | null;
  worst_test_ratio: number;
  worst_test_sensor: Sensor | null;
  rates: SensorRate[];
  gyro_bias: Vector3;
  accel_bias: Vector3;
  update_us: number;
  estimate_age_s: number | null;
  prediction_p99_us: number | null;
  clock_offset_s: number | null;
  pose_rate_hz: number | null;
}

/** Where a machine was at one time. */
export interface TrailPoint {
  time: string;
  stamp: string;
  position_m: Vector3;
  latitude_deg: number;
  longitude_deg: number;
  cabin_position_m: Vector3;
  heading_deg: number;
  semi_major_m: number;
  mode: Mode | null;
  gnss: GnssState | null;
}

export interface TrajectoryView {
  machine: string;
  points: TrailPoint[];
  next: string | null;
}

/** What runs on a machine, and how it is configured. */
export interface ConfigurationView {
  machine: string;
  boot: string;
  software: string;
  /** TOML, with all defaults. */
  machine_file: string;
}

export interface HistoryView {
  machine: string;
  start: string | null;
  last: string | null;
  states: StatePoint[];
}

/** A list for each value, all of one length. */
export interface PoseColumns {
  time_s: number[];
  position_m: Vector3[];
  cabin_position_m: Vector3[];
  heading_deg: number[];
  heading_sigma_deg: number[];
  chassis_heading_deg: (number | null)[];
  chassis_position_m: (Vector3 | null)[];
  speed_mps: number[];
  position_sigma_m: Vector3[];
  /** Longer and shorter half axis, m; bearing of the longer one, degrees. */
  ellipse95: Vector3[];
}

export interface SilenceView {
  from_s: number;
  to_s: number;
}

export interface MachineTrack {
  id: string;
  name: string;
  software: string;
  clock_shift_s: number;
  poses: PoseColumns;
  states: StatePoint[];
  silences: SilenceView[];
  poses_missing: number;
}

export interface TrackAnswer {
  session: string;
  start: string | null;
  length_s: number;
  step_s: number;
  finished: boolean;
  machines: MachineTrack[];
}

export const EVENT_KINDS = [
  "mode_changed",
  "graph_changed",
  "gnss_changed",
  "initialized",
  "refused",
  "outage_began",
  "outage_ended",
  "restarted",
] as const;
export type EventKind = (typeof EVENT_KINDS)[number];

export const EVENT_SEVERITIES = ["info", "warning", "error"] as const;
export type EventSeverity = (typeof EVENT_SEVERITIES)[number];

/** Which of the two graphs answers. */
export const GRAPHS = ["main", "fallback", "trial"] as const;
export type Graph = (typeof GRAPHS)[number];

/** What happened: the fields depend on the kind. */
export type EventDetail =
  | { kind: "mode_changed"; from: Mode; to: Mode }
  | { kind: "graph_changed"; from: Graph; to: Graph; reason: string }
  | { kind: "gnss_changed"; from: GnssState; to: GnssState }
  | { kind: "initialized"; heading_from: string; heading_sigma_deg: number }
  | { kind: "refused"; sensor: Sensor; count: number; reason: string }
  | { kind: "outage_began"; cause: GnssState }
  | ({ kind: "outage_ended" } & OutageReport)
  | { kind: "restarted"; reason: string };

export type MachineEvent = EventDetail & { stamp_ns: number; severity: EventSeverity };

export interface SessionEvent {
  time: string;
  machine: string;
  event: MachineEvent;
}

export interface EventsAnswer {
  session: string;
  events: SessionEvent[];
  left_out: number;
}
