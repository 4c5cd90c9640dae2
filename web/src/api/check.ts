/**
 * Checks on arrival: turns a parsed message into its type, or says which field is wrong.
 *
 * Fields that the page does not know are passed over, so that a newer site serves an older page.
 */

import {
  type Acknowledgement,
  ALERT_SEVERITIES,
  ALERT_STATES,
  type Alerts,
  type AlertView,
  type Budget,
  type CurrentOutage,
  type Delta,
  type Ellipse95,
  FIX_STATES,
  type FleetView,
  GNSS_STATES,
  type GnssView,
  type Health,
  type HealthView,
  type LinkView,
  type LiveError,
  type LiveMessage,
  type MachineView,
  MODES,
  type OutageReport,
  type PoseView,
  PRESENCES,
  RECORDING_STATES,
  type RecordingView,
  RULES,
  SENSORS,
  SESSION_STATES,
  SEVERITIES,
  type SensorHealth,
  type SessionsView,
  type SessionView,
  type Site,
  type Snapshot,
  type Vector3,
  type WorldOrigin,
} from "./types";

/** What is wrong with a message, and where. */
export class MessageError extends Error {
  constructor(
    readonly path: string,
    expected: string,
    found: unknown,
  ) {
    super(`${path}: expected ${expected}, found ${describe(found)}`);
    this.name = "MessageError";
  }
}

/** Reads a value found at `path`, or throws a {@link MessageError}. */
type Check<T> = (value: unknown, path: string) => T;
type Checks<T> = { [Key in keyof T]: Check<T[Key]> };

export const checkLiveMessage: Check<LiveMessage> = (value, path) => {
  const kind = record(value, path).type;
  if (kind === "snapshot") return checkSnapshot(value, path);
  if (kind === "delta") return checkDelta(value, path);
  if (kind === "alerts") return checkAlerts(value, path);
  if (kind === "error") return checkError(value, path);
  throw new MessageError(`${path}.type`, '"snapshot", "delta", "alerts" or "error"', kind);
};

export function checkSessions(value: unknown): SessionsView {
  return object<SessionsView>({ recording, sessions: list(session), next: nullable(text) })(
    value,
    "sessions",
  );
}

function describe(value: unknown): string {
  if (value === undefined) return "nothing";
  const text = JSON.stringify(value) ?? typeof value;
  return text.length > 60 ? `${text.slice(0, 60)}…` : text;
}

function record(value: unknown, path: string): Record<string, unknown> {
  if (typeof value !== "object" || value === null || Array.isArray(value)) {
    throw new MessageError(path, "an object", value);
  }
  return value as Record<string, unknown>;
}

const number: Check<number> = (value, path) => {
  if (typeof value !== "number" || !Number.isFinite(value)) throw new MessageError(path, "a number", value);
  return value;
};

const text: Check<string> = (value, path) => {
  if (typeof value !== "string") throw new MessageError(path, "text", value);
  return value;
};

const time: Check<string> = (value, path) => {
  const written = text(value, path);
  if (Number.isNaN(Date.parse(written))) throw new MessageError(path, "an RFC 3339 time", value);
  return written;
};

/** A missing field is taken for `null`. */
function nullable<T>(check: Check<T>): Check<T | null> {
  return (value, path) => (value === null || value === undefined ? null : check(value, path));
}

function oneOf<T extends string>(choices: readonly T[]): Check<T> {
  return (value, path) => {
    const found = choices.find((choice) => choice === value);
    if (found === undefined) throw new MessageError(path, `one of ${choices.join(", ")}`, value);
    return found;
  };
}

function list<T>(check: Check<T>): Check<T[]> {
  return (value, path) => {
    if (!Array.isArray(value)) throw new MessageError(path, "a list", value);
    return value.map((item, index) => check(item, `${path}[${index}]`));
  };
}

function object<T extends object>(checks: Checks<T>): Check<T> {
  const names = Object.keys(checks) as (keyof T & string)[];
  return (value, path) => {
    const from = record(value, path);
    const into = {} as T;
    for (const name of names) into[name] = checks[name](from[name], `${path}.${name}`);
    return into;
  };
}

const vector3: Check<Vector3> = (value, path) => {
  const numbers = list(number)(value, path);
  const [x, y, z] = numbers;
  if (numbers.length !== 3 || x === undefined || y === undefined || z === undefined) {
    throw new MessageError(path, "three numbers", value);
  }
  return [x, y, z];
};

const worldOrigin = object<WorldOrigin>({ latitude_deg: number, longitude_deg: number, altitude_m: number });

const site = object<Site>({ id: text, name: text, time_zone: text, world: worldOrigin, software: text });

const ellipse95 = object<Ellipse95>({ semi_major_m: number, semi_minor_m: number, bearing_deg: number });

const pose = object<PoseView>({
  stamp: time,
  age_s: number,
  fresh_s: number,
  position_m: vector3,
  latitude_deg: number,
  longitude_deg: number,
  altitude_m: number,
  cabin_position_m: vector3,
  heading_deg: number,
  heading_sigma_deg: number,
  chassis_heading_deg: nullable(number),
  chassis_position_m: nullable(vector3),
  speed_mps: number,
  position_sigma_m: vector3,
  ellipse95,
});

const sensorHealth = object<SensorHealth>({
  sensor: oneOf(SENSORS),
  rate_hz: number,
  age_s: nullable(number),
  received: number,
  refused: number,
  last_refusal: nullable(text),
});

const outage = object<OutageReport>({
  start_stamp_ns: number,
  end_stamp_ns: nullable(number),
  cause: oneOf(GNSS_STATES),
  travelled_m: number,
  jump_m: nullable(number),
});

const health = object<Health>({
  stamp_ns: number,
  mode: oneOf(MODES),
  waits_for: nullable(text),
  gnss: oneOf(GNSS_STATES),
  gnss_inflation: list(number),
  position_sigma_m: nullable(number),
  heading_sigma_deg: nullable(number),
  worst_test_ratio: number,
  worst_test_sensor: nullable(oneOf(SENSORS)),
  sensors: list(sensorHealth),
  outage: nullable(outage),
  updates: number,
  update_us: number,
  gyro_bias: vector3,
  accel_bias: vector3,
});

const healthView = object<HealthView>({
  age_s: number,
  estimate_age_s: nullable(number),
  report: health,
});

const budget = object<Budget>({
  tolerance_m: number,
  time_s: nullable(number),
  distance_m: nullable(number),
});

const currentOutage = object<CurrentOutage>({
  id: text,
  cause: oneOf(FIX_STATES),
  start: time,
  duration_s: number,
  travelled_m: nullable(number),
  position_sigma_m: nullable(number),
  budget: nullable(budget),
});

const gnss = object<GnssView>({
  state: oneOf(FIX_STATES),
  since: time,
  mode: nullable(oneOf(MODES)),
  outage: nullable(currentOutage),
});

const link = object<LinkView>({
  pose_rate_hz: number,
  received: number,
  missed: number,
  refused: number,
  gaps_open: number,
  gaps_filled: number,
  gaps_lost: number,
  clock_offset_s: nullable(number),
});

export const checkMachine = object<MachineView>({
  id: text,
  name: text,
  presence: oneOf(PRESENCES),
  presence_since: time,
  boot: text,
  state_word: text,
  severity: oneOf(SEVERITIES),
  pose: nullable(pose),
  health: nullable(healthView),
  gnss,
  link,
});

export const checkFleet = object<FleetView>({ site, time, machines: list(checkMachine) });

const checkSnapshot = object<Snapshot>({ type: oneOf(["snapshot"]), seq: number, fleet: checkFleet });

const acknowledgement = object<Acknowledgement>({ by: text, at: time, note: text });

const alert = object<AlertView>({
  id: text,
  rule: oneOf(RULES),
  severity: oneOf(ALERT_SEVERITIES),
  machine: nullable(text),
  part: nullable(text),
  message: text,
  value: number,
  worst: number,
  state: oneOf(ALERT_STATES),
  raised: time,
  times: number,
  cleared: nullable(time),
  acknowledged: nullable(acknowledgement),
  changed: time,
});

const checkAlerts = object<Alerts>({ type: oneOf(["alerts"]), seq: number, alerts: list(alert) });

const checkError = object<LiveError>({ type: oneOf(["error"]), detail: text });

const checkDelta = object<Delta>({
  type: oneOf(["delta"]),
  seq: number,
  time,
  machines: list(checkMachine),
  dropped: number,
});

const recording = object<RecordingView>({
  state: oneOf(RECORDING_STATES),
  why: nullable(text),
  session: nullable(text),
  missed: number,
  next_session: nullable(time),
});

const session = object<SessionView>({
  id: text,
  name: text,
  notes: text,
  tags: list(text),
  state: oneOf(SESSION_STATES),
  started: time,
  ended: nullable(time),
  bytes: number,
  messages: number,
  machines: list(text),
  files: number,
});
