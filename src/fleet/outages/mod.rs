//! GNSS outages as the site sees them: state of the fixes, what an outage cost, what is left of the tolerance.
//!
//! Pure like the room: what machines say and the time come in, outages and counts come out. See the room's
//! README for the state machine.

mod budget;
mod monitor;
mod shadow;
mod statistics;
mod thinned;
mod view;

#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

use crate::state::GnssState;
use crate::time::Stamp;

pub use budget::Budget;
pub use monitor::Change;
pub(super) use monitor::Monitor;
pub use shadow::{
    CELL_M, CellKey, CellTime, QUARTER, ShadowFeature, ShadowMap, ShadowPolygon, ShadowProperties,
};
pub use statistics::{CauseTally, DayStatistics, MachineStatistics, Observed, Statistics, Tally};
pub use thinned::{SAMPLES_MAX, Thinned};
pub use view::{
    CurrentOutage, GnssView, OutageDetail, OutageView, PlaceView, SigmaSummary, SigmaView, TrackView,
};

/// What the site knows of a machine's fixes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FixState {
    /// To the centimetre, and used.
    Fixed,
    /// Used, but the receiver reports more than [`FLOAT_SIGMA_M`].
    Float,
    /// The receiver reports sigmas above what the machine accepts.
    Degraded,
    /// The position does not change while the machine moves.
    Frozen,
    /// Fixes contradict each other or the estimate.
    Jumping,
    /// No fixes arrive at the machine.
    Silent,
    /// The machine is not connected, or says nothing.
    LinkLost,
    /// Fixes are good again, and counted until they are trusted.
    Recovering,
}

/// Fixes that report more than this horizontally are no RTK fixes with fixed ambiguities, m.
pub const FLOAT_SIGMA_M: f64 = 0.05;

impl FixState {
    /// All, in the order of their declaration.
    pub const ALL: [FixState; 8] = [
        FixState::Fixed,
        FixState::Float,
        FixState::Degraded,
        FixState::Frozen,
        FixState::Jumping,
        FixState::Silent,
        FixState::LinkLost,
        FixState::Recovering,
    ];

    /// The name in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            FixState::Fixed => "fixed",
            FixState::Float => "float",
            FixState::Degraded => "degraded",
            FixState::Frozen => "frozen",
            FixState::Jumping => "jumping",
            FixState::Silent => "silent",
            FixState::LinkLost => "link_lost",
            FixState::Recovering => "recovering",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.name() == name)
    }

    /// Whether fixes are used.
    pub const fn is_good(self) -> bool {
        matches!(self, FixState::Fixed | FixState::Float)
    }
}

impl From<GnssState> for FixState {
    fn from(state: GnssState) -> Self {
        match state {
            GnssState::Fixed => FixState::Fixed,
            GnssState::Degraded => FixState::Degraded,
            GnssState::Frozen => FixState::Frozen,
            GnssState::Jumping => FixState::Jumping,
            GnssState::Silent => FixState::Silent,
            GnssState::Recovering => FixState::Recovering,
        }
    }
}

/// How an outage ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// The machine trusts its fixes again.
    Recovered,
    /// The link was lost, and is back.
    LinkBack,
    /// The machine's software was started anew; the end is when it was last heard before.
    Restarted,
    /// It ended while the site could not hear; the end is when the machine was last heard in it.
    Unheard,
}

/// One sigma of the position, at a time of an outage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SigmaSample {
    /// Since the outage began, s.
    pub time_s: f64,
    /// Way since the outage began, m.
    pub travelled_m: f64,
    /// Along the worst horizontal direction, m.
    pub sigma_m: f64,
}

/// Where the machine was, at a time of an outage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrackPoint {
    /// Since the outage began, s.
    pub time_s: f64,
    /// Of the cabin IMU in the site frame, m.
    pub position_m: [f64; 3],
}

/// An outage; times are by the site's clock.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outage {
    /// Unique on the site.
    pub id: String,
    /// The machine's id.
    pub machine: String,
    /// Its boot, if known.
    pub boot: Option<u64>,
    /// What was wrong when it began.
    pub cause: FixState,
    /// Since when.
    pub start: Stamp,
    /// The start by the machine's stamps, by which it names the outage, ns.
    pub machine_start_ns: Option<i64>,
    /// Until when; `None` while it goes on.
    pub end: Option<Stamp>,
    /// How it ended.
    pub ended_by: Option<Ending>,
    /// When the machine was last heard in it.
    pub last_heard: Stamp,
    /// Way since the start, m; `None` if nobody knows.
    pub travelled_m: Option<f64>,
    /// By how much `world_from_odom` moved the machine when the outage ended, m.
    pub jump_m: Option<f64>,
    /// Sigma when it began, m.
    pub sigma_start_m: Option<f64>,
    /// Newest sigma, m.
    pub sigma_m: Option<f64>,
    /// Largest sigma, m.
    pub sigma_max_m: Option<f64>,
    /// Where it began, in the site frame, m.
    pub place_m: Option<[f64; 3]>,
    /// Sigma over time.
    pub sigma: Thinned<SigmaSample>,
    /// Where the machine was.
    pub track: Thinned<TrackPoint>,
}

impl Outage {
    /// How long it has lasted by `now`, s.
    pub fn duration_s(&self, now: Stamp) -> f64 {
        self.end.unwrap_or(now).seconds_since(self.start).max(0.0)
    }
}
