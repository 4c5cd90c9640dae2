//! Absolute and relative pose errors by the definitions of evo (Michael Grupp, github.com/MichaelGrupp/evo), so that
//! figures can be held against those of others. `tests/evo_public_tools.rs` holds them against evo itself.
//!
//! APE is of pairs of poses (Q true, P estimated), E = P⁻¹ Q; RPE is of pairs of pairs, E = (Qᵢ⁻¹ Qⱼ)⁻¹ (Pᵢ⁻¹ Pⱼ).
//! Unlike [`super::compare`], which interpolates the truth, poses are paired by the nearest stamp.

use std::collections::BTreeMap;

use serde::Serialize;

use super::alignment::{Alignment, Similarity};
use super::{EvaluateError, Pair};
use crate::import::StampedPose;
use crate::lie::{Mat3, Se3, Vec3};

/// What of an error is looked at; evo's names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Relation {
    /// Length of E's translation (APE: distance of the positions), m.
    TranslationPart,
    /// Frobenius norm of E's rotation matrix less the identity.
    RotationPart,
    /// Frobenius norm of E's 4×4 matrix less the identity.
    FullTransformation,
    /// Angle of E's rotation, degrees.
    RotationAngleDeg,
    /// Angle of E's rotation, rad.
    RotationAngleRad,
    /// Difference of the distances that truth and estimate went (APE: distance of the positions), m.
    PointDistance,
    /// The same over the true distance, percent; RPE only, and not of distances of zero.
    PointDistanceErrorRatio,
}

impl Relation {
    /// Those of an absolute error.
    pub const OF_APE: [Relation; 6] = [
        Relation::TranslationPart,
        Relation::RotationPart,
        Relation::FullTransformation,
        Relation::RotationAngleDeg,
        Relation::RotationAngleRad,
        Relation::PointDistance,
    ];
    /// Those of a relative error.
    pub const OF_RPE: [Relation; 7] = [
        Relation::TranslationPart,
        Relation::RotationPart,
        Relation::FullTransformation,
        Relation::RotationAngleDeg,
        Relation::RotationAngleRad,
        Relation::PointDistance,
        Relation::PointDistanceErrorRatio,
    ];
}

/// What a step of RPE is measured in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DeltaUnit {
    /// Poses.
    Frames,
    /// Way, m.
    Meters,
    /// Turn, degrees.
    Degrees,
    /// Turn, rad.
    Radians,
}

/// How evo is asked to compare.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EvoOptions {
    /// Poses further apart in time are no pair, s.
    pub max_diff_s: f64,
    /// What is taken out first.
    pub alignment: Alignment,
    /// Only the first so many pairs are aligned by; `None` is all.
    pub align_first: Option<usize>,
    /// Step of RPE.
    pub delta: f64,
    /// Its unit.
    pub delta_unit: DeltaUnit,
    /// Every pair of poses a step apart, not only one after the other.
    pub all_pairs: bool,
    /// With all pairs, by way or turn: steps may be off by this part.
    pub tolerance: f64,
    /// Steps are those of the truth, not of the estimate.
    pub pairs_from_truth: bool,
}

impl Default for EvoOptions {
    /// evo's own.
    fn default() -> Self {
        Self {
            max_diff_s: 0.01,
            alignment: Alignment::None,
            align_first: None,
            delta: 1.0,
            delta_unit: DeltaUnit::Frames,
            all_pairs: false,
            tolerance: 0.1,
            pairs_from_truth: false,
        }
    }
}

/// evo's statistics of errors.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EvoStatistics {
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// Standard deviation, by the count.
    pub std: f64,
    /// Least.
    pub min: f64,
    /// Greatest.
    pub max: f64,
    /// Sum of squares.
    pub sse: f64,
}

impl EvoStatistics {
    fn of(mut errors: Vec<f64>) -> Option<Self> {
        let count = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / count;
        let sse: f64 = errors.iter().map(|error| error * error).sum();
        let variance = errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>() / count;
        errors.sort_by(f64::total_cmp);
        let half = errors.len() / 2;
        let upper = *errors.get(half)?;
        let median = if errors.len() % 2 == 1 { upper } else { 0.5 * (errors[half - 1] + upper) };
        let (min, max) = (*errors.first()?, *errors.last()?);
        Some(Self { rmse: (sse / count).sqrt(), mean, median, std: variance.sqrt(), min, max, sse })
    }
}

/// What evo would say.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvoReport {
    /// How it was asked.
    pub options: EvoOptions,
    /// Pairs of poses.
    pub pairs: usize,
    /// Steps of RPE.
    pub steps: usize,
    /// Absolute pose errors.
    pub ape: BTreeMap<Relation, EvoStatistics>,
    /// Relative pose errors; empty if no poses are a step apart.
    pub rpe: BTreeMap<Relation, EvoStatistics>,
}

/// Compares as evo does; both trajectories in order of their stamps.
///
/// # Errors
/// [`EvaluateError`] if no stamps are near each other, or positions do not tell how to align.
pub fn evo(
    truth: &[StampedPose],
    estimate: &[StampedPose],
    options: &EvoOptions,
) -> Result<EvoReport, EvaluateError> {
    let mut pairs = associate(truth, estimate, options.max_diff_s);
    let ends = |poses: &[StampedPose], what| match (poses.first(), poses.last()) {
        (Some(first), Some(last)) => Ok([first.stamp, last.stamp]),
        _ => Err(EvaluateError::Empty(what)),
    };
    let (truth, estimate) = (ends(truth, "truth")?, ends(estimate, "estimate")?);
    if pairs.is_empty() {
        return Err(EvaluateError::NothingInCommon { truth, estimate, note: "" });
    }
    let first = options.align_first.map_or(pairs.len(), |first| first.min(pairs.len()));
    let similarity = options.alignment.solve(&pairs[..first]).ok_or(EvaluateError::NoAlignment)?;
    pairs.iter_mut().for_each(|pair| pair.estimate = similarity.apply(&pair.estimate));
    let steps = steps(&pairs, options);
    let ape = Relation::OF_APE.into_iter().filter_map(|relation| {
        let errors = pairs.iter().map(|pair| absolute(pair, relation)).collect();
        Some((relation, EvoStatistics::of(errors)?))
    });
    let rpe = Relation::OF_RPE.into_iter().filter_map(|relation| {
        let errors = steps.iter().filter_map(|(from, to)| relative(&pairs[*from], &pairs[*to], relation));
        Some((relation, EvoStatistics::of(errors.collect())?))
    });
    let (ape, rpe) = (ape.collect(), rpe.collect());
    Ok(EvoReport { options: *options, pairs: pairs.len(), steps: steps.len(), ape, rpe })
}

/// For each pose of the shorter trajectory the nearest one of the longer, if it is near.
fn associate(truth: &[StampedPose], estimate: &[StampedPose], max_diff_s: f64) -> Vec<Pair> {
    let estimate_is_longer = estimate.len() > truth.len();
    let (short, long) = if estimate_is_longer { (truth, estimate) } else { (estimate, truth) };
    let (Some(first), Some(last)) = (long.first(), long.last()) else { return Vec::new() };
    let (first_s, last_s) = (first.stamp.as_seconds(), last.stamp.as_seconds());
    let mut pairs = Vec::new();
    for posed in short {
        let at_s = posed.stamp.as_seconds();
        if at_s < first_s - max_diff_s || at_s > last_s + max_diff_s {
            continue;
        }
        let after = long.partition_point(|other| other.stamp.as_seconds() <= at_s).min(long.len() - 1);
        let above_s = long[after].stamp.as_seconds() - at_s;
        let below = after.checked_sub(1).map(|below| &long[below]);
        let below_s = below.map_or(f64::INFINITY, |below| at_s - below.stamp.as_seconds());
        let nearest = if above_s <= max_diff_s && above_s < below_s {
            &long[after]
        } else if let Some(below) = below.filter(|_| below_s <= max_diff_s && below_s <= above_s) {
            below
        } else {
            continue;
        };
        let (of_truth, of_estimate) = if estimate_is_longer { (posed, nearest) } else { (nearest, posed) };
        pairs.push(Pair { stamp: of_estimate.stamp, truth: of_truth.pose, estimate: of_estimate.pose });
    }
    pairs
}

/// Which pairs of poses are a step apart.
fn steps(pairs: &[Pair], options: &EvoOptions) -> Vec<(usize, usize)> {
    let pose = |index: usize| match options.pairs_from_truth {
        true => &pairs[index].truth,
        false => &pairs[index].estimate,
    };
    let moves =
        || (1..pairs.len()).map(|index| (pose(index).translation - pose(index - 1).translation).norm());
    let turn = |from: usize, to: usize| (pose(from).rotation.inverse() * pose(to).rotation).log().norm();
    let delta = match options.delta_unit {
        DeltaUnit::Degrees => options.delta.to_radians(),
        _ => options.delta,
    };
    let tolerance = delta * options.tolerance;
    match (options.delta_unit, options.all_pairs) {
        (DeltaUnit::Frames, all_pairs) => {
            let delta = (options.delta as usize).max(1);
            let stride = if all_pairs { 1 } else { delta };
            let ends = (0..pairs.len()).step_by(stride).map(|from| (from, from + delta));
            ends.filter(|(_, to)| *to < pairs.len()).collect()
        }
        (DeltaUnit::Meters, false) => one_after_the_other(moves(), delta),
        (DeltaUnit::Degrees | DeltaUnit::Radians, false) => {
            one_after_the_other((1..pairs.len()).map(|index| turn(index - 1, index)), delta)
        }
        (DeltaUnit::Meters, true) => {
            let mut way = vec![0.0];
            moves().for_each(|moved| way.push(way[way.len() - 1] + moved));
            (0..way.len())
                .filter_map(|from| Some((from, nearest_way(&way, from, delta, tolerance)?)))
                .collect()
        }
        (DeltaUnit::Degrees | DeltaUnit::Radians, true) => {
            let near = |from: usize, to: usize| (turn(from, to) - delta).abs() <= tolerance;
            let all = (0..pairs.len()).flat_map(|from| (from + 1..pairs.len()).map(move |to| (from, to)));
            all.filter(|(from, to)| near(*from, *to)).collect()
        }
    }
}

/// A step ends where its parts add up to delta, and the next begins there.
fn one_after_the_other(parts: impl Iterator<Item = f64>, delta: f64) -> Vec<(usize, usize)> {
    let mut steps = Vec::new();
    let (mut begin, mut sum) = (0, 0.0);
    for (index, part) in parts.enumerate() {
        sum += part;
        if sum >= delta {
            steps.push((begin, index + 1));
            (begin, sum) = (index + 1, 0.0);
        }
    }
    steps
}

/// The first pose after `from` whose way from there is nearest to delta.
fn nearest_way(way: &[f64], from: usize, delta: f64, tolerance: f64) -> Option<usize> {
    let later = &way[from + 1..];
    let off = |index: usize| (later[index] - way[from] - delta).abs();
    let after = later.partition_point(|at| at - way[from] < delta);
    let candidates = [after.checked_sub(1), (after < later.len()).then_some(after)];
    let nearest = candidates.into_iter().flatten().min_by(|a, b| off(*a).total_cmp(&off(*b)))?;
    let first = later.partition_point(|at| *at < later[nearest]);
    (off(nearest) <= tolerance).then_some(from + 1 + first)
}

fn absolute(pair: &Pair, relation: Relation) -> f64 {
    match relation {
        Relation::TranslationPart | Relation::PointDistance | Relation::PointDistanceErrorRatio => {
            (pair.estimate.translation - pair.truth.translation).norm()
        }
        _ => of_error(&(pair.estimate.inverse() * pair.truth), relation),
    }
}

fn relative(from: &Pair, to: &Pair, relation: Relation) -> Option<f64> {
    let way = |of: fn(&Pair) -> &Se3| (of(from).translation - of(to).translation).norm();
    let (true_way, estimated_way) = (way(|pair| &pair.truth), way(|pair| &pair.estimate));
    let off = (true_way - estimated_way).abs();
    match relation {
        Relation::PointDistance => Some(off),
        Relation::PointDistanceErrorRatio => (true_way != 0.0).then(|| off / true_way * 100.0),
        _ => {
            let truth = from.truth.inverse() * to.truth;
            let estimate = from.estimate.inverse() * to.estimate;
            Some(of_error(&(truth.inverse() * estimate), relation))
        }
    }
}

fn of_error(error: &Se3, relation: Relation) -> f64 {
    let rotation_squared = || (error.rotation.matrix() - Mat3::identity()).norm_squared();
    match relation {
        Relation::RotationPart => rotation_squared().sqrt(),
        Relation::FullTransformation => (rotation_squared() + error.translation.norm_squared()).sqrt(),
        Relation::RotationAngleDeg => error.rotation.log().norm().to_degrees(),
        Relation::RotationAngleRad => error.rotation.log().norm(),
        _ => error.translation.norm(),
    }
}

impl Similarity {
    /// Positions scaled, then moved; orientations turned.
    pub(super) fn apply(&self, pose: &Se3) -> Se3 {
        let scaled: Vec3 = pose.translation * self.scale;
        self.motion * Se3::new(pose.rotation, scaled)
    }
}
