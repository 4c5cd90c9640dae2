//! What a real session says of itself, without a truth: coverage, outages, innovations, consistency, latency, and how far
//! the live estimate was from the session solved as a whole. For those who run a site: plain words first, figures after.
//!
//! Takes what a run tells (room `reference`) and what was published, and reads no clock. Which session, and where the
//! page goes, is the caller's business.

mod collect;
mod page;
mod published;
mod words;

use serde::Serialize;

pub use collect::Collector;
pub use page::page;
pub use published::Published;

use crate::evaluate::Statistics;
use crate::reference::Gain;
use crate::replay::Distribution;
use crate::state::{GnssState, Mode};

/// One machine's run in a session.
#[derive(Clone, Debug, Serialize)]
pub struct Review {
    /// The machine, and which of its boots if there are several.
    pub machine: String,
    /// Arrival of its first reading, s.
    pub begin_s: f64,
    /// To its last, s.
    pub span_s: f64,
    /// What to know first, in sentences.
    pub in_short: Vec<String>,
    /// What to look at, in sentences; empty if nothing stood out.
    pub look_at: Vec<String>,
    /// For how long the position rested on what.
    pub coverage: Vec<Share>,
    /// Those that ever spoke.
    pub sensors: Vec<SensorReview>,
    /// Oldest first.
    pub outages: Vec<OutageReview>,
    /// How well measurements fitted what was expected.
    pub innovations: Innovations,
    /// How far each update moved the prediction, cm; `null` without updates.
    pub consistency_cm: Option<Statistics>,
    /// How late things were.
    pub latency: Latency,
    /// Why the estimate was begun anew, each time.
    pub restarts: Vec<Told>,
    /// Live against the whole session; `null` if it cannot be solved.
    pub gain: Option<Gain>,
    /// Why it cannot.
    pub not_smoothed: Option<String>,
    /// Where the whole session has no solution, or none that is final.
    pub unsure: Vec<Unsure>,
    /// What of the recording could not be used.
    pub lost: Vec<String>,
    /// Second by second.
    pub seconds: Vec<Second>,
}

/// A part of the time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Share {
    /// What the position rested on; initializing is before the start, and between two.
    pub mode: Mode,
    /// s.
    pub time_s: f64,
    /// Of the whole.
    pub percent: f64,
}

/// One sensor over a run.
#[derive(Clone, Debug, Serialize)]
pub struct SensorReview {
    /// Its name.
    pub sensor: &'static str,
    /// Readings that arrived.
    pub readings: u64,
    /// Between two of them, as a rate, Hz.
    pub rate_hz: f64,
    /// Time in silences of more than five periods and a fifth of a second, s.
    pub silent_s: f64,
    /// How many of those.
    pub silences: u64,
    /// The longest, s.
    pub longest_silence_s: f64,
    /// Readings that the estimator refused.
    pub refused: u64,
    /// Why the last one was.
    pub last_refusal: Option<String>,
    /// From the stamp to the arrival at the machine; `null` if the log tells no arrivals.
    pub delay_us: Option<Distribution>,
}

/// An outage of GNSS.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct OutageReview {
    /// Since the first reading, s.
    pub start_s: f64,
    /// Since the first reading, s; the end of the run if it went on.
    pub end_s: f64,
    /// Whether fixes came back.
    pub ended: bool,
    /// What was wrong with the fixes.
    pub cause: GnssState,
    /// Way of the machine meanwhile, m.
    pub travelled_m: f64,
    /// How far the position was corrected at its end, m.
    pub jump_m: Option<f64>,
    /// How far live was from the whole session at most, horizontally, m.
    pub live_off_m: Option<f64>,
}

/// How well measurements fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Innovations {
    /// Seconds with a tested fix.
    pub seconds: u64,
    /// Of these, with a worst fix beyond the limit of what is believed.
    pub beyond_percent: f64,
    /// Median of the seconds' worst innovation, as a part of that limit.
    pub median_ratio: f64,
    /// 95 % are smaller.
    pub p95_ratio: f64,
    /// What the receiver's sigmas were multiplied by at most: horizontally, vertically.
    pub inflation: [f64; 2],
    /// Fixes in the whole solution that are so odd that they count less, percent; `null` without one.
    pub weighted_down_percent: Option<f64>,
}

/// How late things were.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Latency {
    /// From a sample's stamp to the sending of its pose.
    pub stamp_to_sent_us: Option<Distribution>,
    /// From there to the recorder; only where the clocks agree.
    pub sent_to_recorded_us: Option<Distribution>,
    /// Messages that were recorded before they were sent: the clocks differ.
    pub recorded_before_sent: u64,
    /// On the machine, from an IMU sample to its estimate, µs: mean, and the largest 99th percentile of a second.
    pub prediction_us: Option<[f64; 2]>,
    /// On the machine, mean and largest time of an update, µs.
    pub update_us: Option<[f64; 2]>,
}

/// Something that happened once.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Told {
    /// Since the first reading, s.
    pub at_s: f64,
    /// In words.
    pub what: String,
}

/// A stretch that cannot be judged by the whole session, or not finally.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Unsure {
    /// Since the first reading, s.
    pub start_s: f64,
    /// Since the first reading, s.
    pub end_s: f64,
    /// Why there is no solution; `null` if there is one that still moved when its steps were used up.
    pub why_unsolved: Option<String>,
}

/// One second of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Second {
    /// Since the first reading, s.
    pub at_s: f64,
    /// One sigma of the position along its worst horizontal direction, m; `null` before the start.
    pub position_sigma_m: Option<f64>,
    /// Worst innovation as a part of the limit of what is believed.
    pub test_ratio: Option<f64>,
    /// Largest move of the prediction by an update, cm.
    pub moved_cm: f64,
}

#[cfg(test)]
mod tests;
