/**
 * Checks on arrival: turns a parsed message into its type, or says which field is wrong.
 *
 * Fields that the page does not know are passed over, so that a newer site serves an older page.
 */

import { checkAlert } from "./alerts";
import {
  type Check,
  flag,
  list,
  MessageError,
  nullable,
  number,
  object,
  oneOf,
  record,
  text,
  time,
  vector3,
} from "./checking";
import {
  type AlertsMessage,
  type Budget,
  type ConfigurationView,
  type CurrentOutage,
  type Delta,
  type Ellipse95,
  EVENT_KINDS,
  EVENT_SEVERITIES,
  type EventDetail,
  type EventKind,
  type EventSeverity,
  type EventsAnswer,
  FIX_STATES,
  type FleetView,
  GNSS_STATES,
  type GnssView,
  GRAPHS,
  type Health,
  type HealthView,
  type HistoryView,
  type LinkView,
  type LiveError,
  type LiveMessage,
  type MachineEvent,
  type MachineTrack,
  type MachineView,
  MODES,
  type OutageReport,
  type PoseColumns,
  type PoseView,
  PRESENCES,
  RECORDING_STATES,
  type RecordingView,
  SENSORS,
  SESSION_STATES,
  SEVERITIES,
  type SensorHealth,
  type SensorRate,
  type SessionEvent,
  type SessionsView,
  type SessionView,
  type SilenceView,
  type Site,
  type Snapshot,
  type StatePoint,
  type TrackAnswer,
  type TrailPoint,
  type TrajectoryView,
  type WorldOrigin,
} from "./types";

export { MessageError };

export const checkLiveMessage: Check<LiveMessage> = (value, path) => {
  const kind = record(value, path).type;
  if (kind === "snapshot") return checkSnapshot(value, path);
  if (kind === "delta") return checkDelta(value, path);
  if (kind === "alerts") return checkAlerts(value, path);
  if (kind === "error") return checkError(value, path);
  throw new MessageError(`${path}.type`, '"snapshot", "delta", "alerts" or "error"', kind);
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
  prediction_p99_us: nullable(number),
  report: health,
});

const currentOutage = object<CurrentOutage>({
  id: text,
  cause: oneOf(FIX_STATES),
  start: time,
  duration_s: number,
  travelled_m: nullable(number),
  position_sigma_m: nullable(number),
  budget: nullable(
    object<Budget>({ tolerance_m: number, time_s: nullable(number), distance_m: nullable(number) }),
  ),
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
  software: text,
  state_word: text,
  severity: oneOf(SEVERITIES),
  pose: nullable(pose),
  health: nullable(healthView),
  gnss,
  link,
});

export const checkFleet = object<FleetView>({ site, time, machines: list(checkMachine) });

const checkSnapshot = object<Snapshot>({ type: oneOf(["snapshot"]), seq: number, fleet: checkFleet });

const checkAlerts = object<AlertsMessage>({ type: oneOf(["alerts"]), seq: number, alerts: list(checkAlert) });

const checkError = object<LiveError>({ type: oneOf(["error"]), detail: text });

const checkDelta = object<Delta>({
  type: oneOf(["delta"]),
  seq: number,
  time,
  machines: list(checkMachine),
  dropped: number,
});

const recordingView = object<RecordingView>({
  state: oneOf(RECORDING_STATES),
  why: nullable(text),
  session: nullable(text),
  missed: number,
  next_session: nullable(time),
});

export const sessionView = object<SessionView>({
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

export const checkSessions = object<SessionsView>({
  recording: recordingView,
  sessions: list(sessionView),
  next: nullable(text),
});

const statePoint = object<StatePoint>({
  time_s: number,
  state_word: text,
  severity: oneOf(SEVERITIES),
  mode: oneOf(MODES),
  gnss: oneOf(GNSS_STATES),
  waits_for: nullable(text),
  position_sigma_m: nullable(number),
  heading_sigma_deg: nullable(number),
  speed_mps: nullable(number),
  worst_test_ratio: number,
  worst_test_sensor: nullable(oneOf(SENSORS)),
  rates: list(object<SensorRate>({ sensor: oneOf(SENSORS), rate_hz: number })),
  gyro_bias: vector3,
  accel_bias: vector3,
  update_us: number,
  estimate_age_s: nullable(number),
  prediction_p99_us: nullable(number),
  clock_offset_s: nullable(number),
  pose_rate_hz: nullable(number),
});

const trailPoint = object<TrailPoint>({
  time,
  stamp: time,
  position_m: vector3,
  latitude_deg: number,
  longitude_deg: number,
  cabin_position_m: vector3,
  heading_deg: number,
  semi_major_m: number,
  mode: nullable(oneOf(MODES)),
  gnss: nullable(oneOf(GNSS_STATES)),
});

export const checkTrajectory = object<TrajectoryView>({
  machine: text,
  points: list(trailPoint),
  next: nullable(time),
});

export const checkConfiguration = object<ConfigurationView>({
  machine: text,
  boot: text,
  software: text,
  machine_file: text,
});

export const checkHistory = object<HistoryView>({
  machine: text,
  start: nullable(time),
  last: nullable(time),
  states: list(statePoint),
});

const poseColumns: Check<PoseColumns> = (value, path) => {
  const columns = object<PoseColumns>({
    time_s: list(number),
    position_m: list(vector3),
    cabin_position_m: list(vector3),
    heading_deg: list(number),
    heading_sigma_deg: list(number),
    chassis_heading_deg: list(nullable(number)),
    chassis_position_m: list(nullable(vector3)),
    speed_mps: list(number),
    position_sigma_m: list(vector3),
    ellipse95: list(vector3),
  })(value, path);
  for (const [name, column] of Object.entries(columns)) {
    if (column.length !== columns.time_s.length) {
      throw new MessageError(`${path}.${name}`, `${columns.time_s.length} values`, column.length);
    }
  }
  return columns;
};

const machineTrack = object<MachineTrack>({
  id: text,
  name: text,
  software: text,
  clock_shift_s: number,
  poses: poseColumns,
  states: list(statePoint),
  silences: list(object<SilenceView>({ from_s: number, to_s: number })),
  poses_missing: number,
});

export const checkTrack = object<TrackAnswer>({
  session: text,
  start: nullable(time),
  length_s: number,
  step_s: number,
  finished: flag,
  machines: list(machineTrack),
});

/** By its kind, the fields of an event. */
type Detail<Kind extends EventKind> = Omit<Extract<EventDetail, { kind: Kind }>, "kind">;
const eventDetails: { [Kind in EventKind]: Check<Detail<Kind>> } = {
  mode_changed: object<Detail<"mode_changed">>({ from: oneOf(MODES), to: oneOf(MODES) }),
  graph_changed: object<Detail<"graph_changed">>({ from: oneOf(GRAPHS), to: oneOf(GRAPHS), reason: text }),
  gnss_changed: object<Detail<"gnss_changed">>({ from: oneOf(GNSS_STATES), to: oneOf(GNSS_STATES) }),
  initialized: object<Detail<"initialized">>({ heading_from: text, heading_sigma_deg: number }),
  refused: object<Detail<"refused">>({ sensor: oneOf(SENSORS), count: number, reason: text }),
  outage_began: object<Detail<"outage_began">>({ cause: oneOf(GNSS_STATES) }),
  outage_ended: outage,
  restarted: object<Detail<"restarted">>({ reason: text }),
};

const eventHead = object<{ stamp_ns: number; severity: EventSeverity; kind: EventKind }>({
  stamp_ns: number,
  severity: oneOf(EVENT_SEVERITIES),
  kind: oneOf(EVENT_KINDS),
});

const machineEvent: Check<MachineEvent> = (value, path) => {
  const head = eventHead(value, path);
  // Each kind has its fields by the table above; the compiler does not follow that through a union.
  return { ...head, ...eventDetails[head.kind](value, path) } as MachineEvent;
};

const sessionEvent = object<SessionEvent>({ time, machine: text, event: machineEvent });

export const checkEvents = object<EventsAnswer>({
  session: text,
  events: list(sessionEvent),
  left_out: number,
});
