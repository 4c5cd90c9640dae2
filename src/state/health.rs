//! What a machine says of itself: at 1 Hz, and at once when something changes.

use serde::{Deserialize, Serialize};

use super::Mode;
use crate::sensors::Sensor;
use crate::time::Stamp;

/// What can be said of the GNSS position from its fixes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum GnssState {
    /// Fixes pass the gate and are used.
    Fixed,
    /// The receiver reports sigmas above the accepted maximum.
    Degraded,
    /// Position does not change while the machine moves.
    Frozen,
    /// Fixes contradict each other or the estimate.
    Jumping,
    /// No fixes arrive.
    Silent,
    /// Fixes are good again, and counted until they are trusted.
    Recovering,
}

impl GnssState {
    /// The name in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            GnssState::Fixed => "fixed",
            GnssState::Degraded => "degraded",
            GnssState::Frozen => "frozen",
            GnssState::Jumping => "jumping",
            GnssState::Silent => "silent",
            GnssState::Recovering => "recovering",
        }
    }
}

/// Which of the two graphs answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Graph {
    /// Main, with fixes.
    Main,
    /// Fallback, without fixes.
    Fallback,
    /// Fallback, while main tries fixes that have come back.
    Trial,
}

/// One sensor, as seen by the estimator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct SensorHealth {
    /// Which one.
    pub sensor: Sensor,
    /// Over the last second or so, Hz.
    pub rate_hz: f64,
    /// From the newest stamp to the health message's stamp, s; `null` if none came yet.
    pub age_s: Option<f64>,
    /// Readings that arrived since the start.
    pub received: u64,
    /// Readings refused since the start.
    pub refused: u64,
    /// Why the last one was refused.
    pub last_refusal: Option<String>,
}

/// A GNSS outage that goes on, or the last one that ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct OutageReport {
    /// Stamp of the last good fix before it, ns.
    pub start_stamp_ns: i64,
    /// Stamp at which fixes were trusted again, ns; `null` while it goes on.
    pub end_stamp_ns: Option<i64>,
    /// What was wrong with the fixes when it began.
    pub cause: GnssState,
    /// Way of the IMU since the start, m.
    pub travelled_m: f64,
    /// How far the position was corrected when it ended, m.
    pub jump_m: Option<f64>,
}

/// State of a machine's estimator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Health {
    /// Of the newest reading, ns.
    pub stamp_ns: i64,
    /// What the estimate rests on.
    pub mode: Mode,
    /// While initializing: what is missing, in words an operator can act on.
    pub waits_for: Option<String>,
    /// State of the fixes.
    pub gnss: GnssState,
    /// What the receiver's sigmas are multiplied by, since innovations showed that it is surer than it should be:
    /// horizontal, vertical; 1 is as reported.
    #[serde(default = "as_reported")]
    pub gnss_inflation: [f64; 2],
    /// Standard deviation of the position along its worst horizontal direction, m; `null` before the start.
    pub position_sigma_m: Option<f64>,
    /// Standard deviation of the heading, degrees.
    pub heading_sigma_deg: Option<f64>,
    /// Largest ratio of innovation to its gate over the last second; over 1 was refused.
    pub worst_test_ratio: f64,
    /// Which sensor that was.
    pub worst_test_sensor: Option<Sensor>,
    /// The sensors that ever spoke.
    pub sensors: Vec<SensorHealth>,
    /// The running or the last outage.
    pub outage: Option<OutageReport>,
    /// Smoother updates since the start.
    pub updates: u64,
    /// Mean time of an update over the last second, µs; zero where no clock was given.
    pub update_us: f64,
    /// Gyro bias, rad/s, in the IMU frame.
    pub gyro_bias: [f64; 3],
    /// Accelerometer bias, m/s², in the IMU frame.
    pub accel_bias: [f64; 3],
}

/// Of health messages from before there was an inflation.
const fn as_reported() -> [f64; 2] {
    [1.0; 2]
}

/// How much an event matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema), schema(as = EventSeverity))]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// For the record.
    Info,
    /// Something works less well.
    Warning,
    /// Something does not work.
    Error,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum EventKind {
    /// The mode changed.
    ModeChanged {
        /// Before.
        from: Mode,
        /// After.
        to: Mode,
    },
    /// Another graph answers, or what main holds has changed.
    GraphChanged {
        /// Before.
        from: Graph,
        /// After.
        to: Graph,
        /// Why.
        reason: String,
    },
    /// The state of the fixes changed.
    GnssChanged {
        /// Before.
        from: GnssState,
        /// After.
        to: GnssState,
    },
    /// The estimate started.
    Initialized {
        /// How the heading was found.
        heading_from: String,
        /// Standard deviation of the heading, degrees.
        heading_sigma_deg: f64,
    },
    /// A reading was refused. Repeated refusals for one reason are told once a second at most, with their count.
    Refused {
        /// Whose reading.
        sensor: Sensor,
        /// Why, with its numbers.
        reason: String,
        /// How many since the last such event of this sensor.
        count: u64,
    },
    /// GNSS was lost.
    OutageBegan {
        /// What was wrong.
        cause: GnssState,
    },
    /// GNSS is back.
    OutageEnded(OutageReport),
    /// The estimate was started anew.
    Restarted {
        /// Why.
        reason: String,
    },
}

/// One event of a machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Event {
    /// When, by the machine's stamps, ns.
    pub stamp_ns: i64,
    /// How much it matters.
    pub severity: Severity,
    /// What.
    #[serde(flatten)]
    pub what: EventKind,
}

impl Event {
    /// An event at `stamp`.
    pub fn new(stamp: Stamp, severity: Severity, what: EventKind) -> Self {
        Self { stamp_ns: stamp.as_nanos(), severity, what }
    }
}
