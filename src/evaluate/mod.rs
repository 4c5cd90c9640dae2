//! How far an estimated trajectory is from the true one.
//!
//! Poses are compared at the estimate's stamps with the truth interpolated in between; what is outside
//! the truth or in a gap of it is counted and left out. Errors of rotation are taken in the world frame,
//! so that heading means the same for an IMU that is mounted in whatever way.

mod alignment;
mod chi_square;
pub mod comparison;
mod evo;
pub mod monte_carlo;
pub mod paper;
pub mod report;
mod statistics;
pub mod tasks;
pub mod trial;

#[cfg(test)]
mod tests;

use serde::Serialize;

use crate::import::{Interval, StampedPose};
use crate::lie::{Se3, So3, Vec3};
use crate::time::Stamp;

pub use alignment::Alignment;
pub use chi_square::{chi_square_below, chi_square_quantile, mean_bounds};
pub use evo::{DeltaUnit, EvoOptions, EvoReport, EvoStatistics, Relation, evo};
pub use statistics::Statistics;

/// How to compare.
#[derive(Clone, Debug)]
pub struct Options {
    /// What is taken out of the difference before errors are measured.
    pub alignment: Alignment,
    /// Errors are also told for each of these, and for all of the same condition together.
    pub intervals: Vec<Interval>,
    /// Only estimates inside intervals of this condition count at all.
    pub only: Option<String>,
    /// The truth is not interpolated over longer gaps, s.
    pub gap_max_s: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self { alignment: Alignment::None, intervals: Vec::new(), only: None, gap_max_s: 1.0 }
    }
}

impl Options {
    /// Whether an estimate of that stamp counts.
    fn counts(&self, stamp: Stamp) -> bool {
        match &self.only {
            None => true,
            Some(condition) => {
                self.intervals.iter().any(|one| one.condition == *condition && one.holds(stamp))
            }
        }
    }
}

/// Why there is nothing to tell.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EvaluateError {
    /// One of the two has no poses.
    #[error("the {0} has no poses")]
    Empty(&'static str),
    /// Positions do not tell how to align.
    #[error(
        "cannot be aligned: all positions lie on one line or in one point, which leaves the rotation open"
    )]
    NoAlignment,
    /// No estimate is where there is truth.
    #[error("nothing to compare: the truth is from {} s to {} s, the estimate from {} s to {} s{note}",
            truth[0], truth[1], estimate[0], estimate[1])]
    NothingInCommon {
        /// First and last stamp.
        truth: [Stamp; 2],
        /// First and last stamp.
        estimate: [Stamp; 2],
        /// What else could be the reason.
        note: &'static str,
    },
}

/// Errors of one estimate.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Poses of the estimate that were compared.
    pub compared: usize,
    /// Poses of the estimate with no truth at their stamp.
    pub without_truth: usize,
    /// Poses of the estimate outside the intervals asked for.
    pub outside_intervals: usize,
    /// Stamp of the first compared pose, s.
    pub start_s: f64,
    /// Stamp of the last compared pose, s.
    pub end_s: f64,
    /// What was taken out.
    pub alignment: Alignment,
    /// The motion that was taken out: it maps the estimate onto the truth; translation (m).
    pub aligned_by_translation_m: [f64; 3],
    /// Its rotation vector, degrees.
    pub aligned_by_rotation_deg: [f64; 3],
    /// What the estimate's positions were multiplied by before.
    pub aligned_by_scale: f64,
    /// Over all that was compared.
    pub errors: Errors,
    /// All intervals of the same condition together, by name.
    pub conditions: Vec<ConditionErrors>,
    /// Each interval with poses in it.
    pub intervals: Vec<IntervalErrors>,
}

/// Errors in all intervals of one condition.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConditionErrors {
    /// Such as `good`.
    pub condition: String,
    /// In these intervals.
    pub errors: Errors,
}

/// Errors in one interval.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct IntervalErrors {
    /// Such as `good`.
    pub condition: String,
    /// s.
    pub start_s: f64,
    /// s.
    pub end_s: f64,
    /// In this interval.
    pub errors: Errors,
}

/// How the errors of some poses spread.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Errors {
    /// How many poses.
    pub poses: usize,
    /// Distance in space, m.
    pub position_m: Statistics,
    /// Distance in the horizontal plane, m.
    pub horizontal_m: Statistics,
    /// Size of the difference in height, m.
    pub vertical_m: Statistics,
    /// Size of the turn about the vertical, degrees.
    pub heading_deg: Statistics,
    /// Size of the tilt: the turn about horizontal axes, degrees.
    pub tilt_deg: Statistics,
}

/// One compared pose.
#[derive(Clone, Copy, Debug)]
struct Pair {
    stamp: Stamp,
    truth: Se3,
    estimate: Se3,
}

/// Compares an estimated trajectory with the true one; both in order of their stamps.
///
/// # Errors
/// [`EvaluateError`] if nothing can be compared.
pub fn compare(
    truth: &[StampedPose],
    estimate: &[StampedPose],
    options: &Options,
) -> Result<Report, EvaluateError> {
    let ends = |poses: &[StampedPose], what| match poses {
        [] => Err(EvaluateError::Empty(what)),
        [first, .., last] => Ok([first.stamp, last.stamp]),
        [only] => Ok([only.stamp; 2]),
    };
    let (truth_ends, estimate_ends) = (ends(truth, "truth")?, ends(estimate, "estimate")?);
    let mut pairs = Vec::new();
    let mut without_truth = 0;
    let mut outside_intervals = 0;
    for posed in estimate {
        if !options.counts(posed.stamp) {
            outside_intervals += 1;
        } else if let Some(at) = interpolate(truth, posed.stamp, options.gap_max_s) {
            pairs.push(Pair { stamp: posed.stamp, truth: at, estimate: posed.pose });
        } else {
            without_truth += 1;
        }
    }
    let note = if outside_intervals > 0 { ", partly outside the intervals asked for" } else { "" };
    let nothing = EvaluateError::NothingInCommon { truth: truth_ends, estimate: estimate_ends, note };
    let (Some(first), Some(last)) = (pairs.first(), pairs.last()) else { return Err(nothing) };
    let (start_s, end_s) = (first.stamp.as_seconds(), last.stamp.as_seconds());

    let truth_from_estimate = options.alignment.solve(&pairs).ok_or(EvaluateError::NoAlignment)?;
    pairs.iter_mut().for_each(|pair| pair.estimate = truth_from_estimate.apply(&pair.estimate));
    let within = |interval: &Interval| errors(pairs.iter().filter(|pair| interval.holds(pair.stamp)));
    let mut names: Vec<&str> = options.intervals.iter().map(|one| one.condition.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    let condition = |name: &str| {
        let named =
            |pair: &&Pair| options.intervals.iter().any(|one| one.condition == name && one.holds(pair.stamp));
        Some(ConditionErrors { condition: name.to_owned(), errors: errors(pairs.iter().filter(named))? })
    };
    let interval = |one: &Interval| {
        Some(IntervalErrors {
            condition: one.condition.clone(),
            start_s: one.start.as_seconds(),
            end_s: one.end.as_seconds(),
            errors: within(one)?,
        })
    };
    let Some(all) = errors(pairs.iter()) else { return Err(nothing) };
    Ok(Report {
        compared: pairs.len(),
        without_truth,
        outside_intervals,
        start_s,
        end_s,
        alignment: options.alignment,
        aligned_by_translation_m: truth_from_estimate.motion.translation.into(),
        aligned_by_rotation_deg: truth_from_estimate.motion.rotation.log().map(f64::to_degrees).into(),
        aligned_by_scale: truth_from_estimate.scale,
        errors: all,
        conditions: names.into_iter().filter_map(condition).collect(),
        intervals: options.intervals.iter().filter_map(interval).collect(),
    })
}

/// What a report says was taken out.
fn motion_of(report: &Report) -> alignment::Similarity {
    let turn = Vec3::from(report.aligned_by_rotation_deg).map(f64::to_radians);
    let motion = Se3::new(So3::exp(&turn), Vec3::from(report.aligned_by_translation_m));
    alignment::Similarity { scale: report.aligned_by_scale, motion }
}

/// The true pose at `stamp`: positions on a straight line, rotations at an even rate (slerp).
fn interpolate(truth: &[StampedPose], stamp: Stamp, gap_max_s: f64) -> Option<Se3> {
    let after = truth.partition_point(|posed| posed.stamp < stamp);
    let next = truth.get(after)?;
    if next.stamp == stamp {
        return Some(next.pose);
    }
    let last = truth.get(after.checked_sub(1)?)?;
    let gap_s = next.stamp.seconds_since(last.stamp);
    if gap_s > gap_max_s {
        return None;
    }
    let part = stamp.seconds_since(last.stamp) / gap_s;
    let turn = next.pose.rotation.minus(&last.pose.rotation);
    Some(Se3::new(
        last.pose.rotation.plus(&(turn * part)),
        last.pose.translation.lerp(&next.pose.translation, part),
    ))
}

fn errors<'a>(pairs: impl Iterator<Item = &'a Pair>) -> Option<Errors> {
    let differences: Vec<(Vec3, Vec3)> = pairs
        .map(|Pair { truth, estimate, .. }| {
            let turn = (estimate.rotation * truth.rotation.inverse()).log().map(f64::to_degrees);
            (estimate.translation - truth.translation, turn)
        })
        .collect();
    let statistics = |size: fn(&(Vec3, Vec3)) -> f64| Statistics::of(differences.iter().map(size).collect());
    Some(Errors {
        poses: differences.len(),
        position_m: statistics(|(shift, _)| shift.norm())?,
        horizontal_m: statistics(|(shift, _)| shift.xy().norm())?,
        vertical_m: statistics(|(shift, _)| shift.z.abs())?,
        heading_deg: statistics(|(_, turn)| turn.z.abs())?,
        tilt_deg: statistics(|(_, turn)| turn.xy().norm())?,
    })
}
