//! A run on a machine, as the record keeps it: what is needed to get the same bits again.

use std::collections::BTreeSet;

use crate::sensors::Arrival;

/// The predictor took over a solution between two readings.
///
/// Readings are counted from 0 in the order in which the predictor took them, since it was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Takeover {
    /// The reading before which it happened: the predictor had taken so many.
    pub before: u64,
    /// The reading that led the updater to the solution.
    pub solution_of: u64,
}

/// What the estimator of one boot took, and when its predictor took over which solution.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LiveRun {
    /// From the boot on, in the order in which the predictor took them.
    pub arrivals: Vec<Arrival>,
    /// Those that the updater had no room for: only the predictor took them.
    pub unseen: BTreeSet<u64>,
    /// In the order in which they happened.
    pub takeovers: Vec<Takeover>,
}
