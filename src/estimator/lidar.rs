//! What lidar odometry says: relative between two poses, and pseudo-global after it was blind.
//!
//! Lidar odometry gives poses in a map of its own, and its error walks. As long as its poses follow each other, two
//! of them say how the lidar moved in between, and nothing more: a relative factor, in either graph.
//!
//! The paper's fallback graph instead fixes the map to the world at the loss of the fixes, at t_j, and then takes
//! every pose as a global one (Nubert et al. 2022, section IV-C),
//!
//!   world_from_lidar_tk = world_from_lidar_tj (lidarmap_from_lidar_tj)⁻¹ lidarmap_from_lidar_tk,            (1)
//!
//! with noise that is independent from pose to pose, which that of a walk is not: the covariance comes out far too
//! small, the heading is the lidar's, and every standstill fights the walk. [`InOutage::PseudoGlobal`] is that form.
//! By default t_j moves along with the newest pose that was used. While its node is in the window, (1) is then the
//! relative factor, which is exact for a walk; so in an outage the window is held open at t_j. Should the lidar be
//! blind for longer than a window can be held, (1) is what brings the position back: a pose factor. Its error is that
//! of the estimate at t_j, so it cannot make the estimate surer than that: [`super::place`].

use super::graphs::Graphs;
use super::options::{InOutage, Options};
use super::place::{self, PlaceMatrix};
use crate::factors::{BetweenFactor, PoseFactor};
use crate::frames::{Lidar, LidarMap, Pose, World};
use crate::lie::{Mat6, Vec6};
use crate::sensors::LidarPose;
use crate::smoother::{Smoother, SmootherError};
use crate::state::row;
use crate::time::{Span, Stamp};

/// A lidar increment that differs so much from the prediction is wrong: rad, m.
const MISFIT_MAX: [f64; 2] = [0.2, 0.5];
/// Where the estimate is surer than that, so little beside this many sigmas: an odometry that begins anew near its
/// old origin jumps by little, and would be taken for motion.
const MISFIT_MIN: [f64; 2] = [0.03, 0.08];
const MISFIT_SIGMAS: f64 = 8.0;
/// So many refusals in a row, and the estimate may be the one that is wrong: back to the wider limit.
const REFUSALS_MAX: u32 = 2;
/// Squared misfit over its variance of a pose after a gap, summed over heading and position (4 degrees of
/// freedom): beyond it, the lidar has begun a new map.
const RETURN_LIMIT: f64 = 30.0;
/// Poses further apart than this are not tied as one increment: some were lost in between.
const GAP_MAX: Span = Span::from_millis(1_100);
/// A pose factor that shares its error with the estimate is given so many times its variance.
const SHARED: f64 = 2.0;
/// Roll and pitch of a pseudo-global pose are weighted down to this, rad: gravity knows them better.
const TILT_SIGMA: f64 = 0.05;

/// The newest pose that was used, and the estimate there.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    pose: LidarPose,
    world_from_lidar: Pose<World, Lidar>,
    /// Of the lidar's heading and position there.
    covariance: PlaceMatrix,
}

/// Follows the lidar's poses.
#[derive(Clone, Debug, Default)]
pub(super) struct LidarTrack {
    last: Option<LidarPose>,
    anchor: Option<Anchor>,
    /// Between two poses, s.
    period_s: f64,
    /// In a row.
    refusals: u32,
}

/// What became of a pose.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Taken {
    /// It is in the graphs.
    Used,
    /// There was nothing to compare it with.
    First,
    /// It contradicts the estimate.
    Refused(String),
}

impl LidarTrack {
    /// The estimate was seated anew: what the lidar said before has no place in it.
    pub fn forget(&mut self) {
        *self = Self { period_s: self.period_s, ..Self::default() };
    }

    /// The newest pose.
    pub fn newest(&self) -> Option<LidarPose> {
        self.last
    }

    /// Puts a pose into both graphs.
    ///
    /// # Errors
    /// The window cannot take its stamp; the track then goes on from the pose before.
    pub fn take(
        &mut self,
        graphs: &mut Graphs,
        options: &Options,
        pose: &LidarPose,
    ) -> Result<Taken, SmootherError> {
        let lost = graphs.passive_mut().is_some();
        let Some(last) = self.last else {
            self.last = Some(*pose);
            return Ok(Taken::First);
        };
        let gap = pose.stamp - last.stamp;
        let taken = if lost && options.lidar_in_outage == InOutage::PseudoGlobal {
            self.take_pseudo_global(graphs, options, &last, pose)?
        } else if lost && gap > GAP_MAX {
            self.return_from_gap(graphs, options, &last, pose)?
        } else if graphs.active().oldest_stamp().is_some_and(|oldest| last.stamp >= oldest) {
            let missed = self.increments(gap);
            let limit = misfit_limit(graphs.active(), options, gap.as_seconds(), self.refusals);
            let taken = tie(graphs.active_mut(), options, &last, pose, missed, limit)?;
            if let (Taken::Used, Some(main)) = (&taken, graphs.passive_mut()) {
                // Main is made anew from fallback or from fixes, should it not fit.
                let _ = tie(main, options, &last, pose, missed, MISFIT_MAX);
            }
            taken
        } else {
            Taken::First
        };
        if gap <= GAP_MAX {
            self.period_s = if self.period_s == 0.0 { gap.as_seconds() } else { self.period_s };
            self.period_s += 0.1 * (gap.as_seconds() - self.period_s);
        }
        self.last = Some(*pose);
        self.refusals = if matches!(taken, Taken::Refused(_)) { self.refusals + 1 } else { 0 };
        if taken != Taken::Used {
            self.anchor = None;
        }
        Ok(taken)
    }

    /// After an update: where the newest pose is now in the answering graph. With [`InOutage::PseudoGlobal`] the map
    /// stays where it was at the loss.
    pub fn anchor(&mut self, graphs: &mut Graphs, options: &Options) {
        let lost = graphs.passive_mut().is_some();
        if lost && options.lidar_in_outage == InOutage::PseudoGlobal && self.anchor.is_some() {
            return;
        }
        let Some(pose) = self.last else { return };
        self.hold(graphs, options);
        let smoother = graphs.active_mut();
        let Some(state) = smoother.state_at(pose.stamp) else { return };
        let world_from_lidar = state.world_from_imu() * options.imu_from_lidar;
        let there = PoseFactor {
            measured: *world_from_lidar.motion(),
            imu_from_sensor: *options.imu_from_lidar.motion(),
            whiten: Mat6::identity(),
        };
        let covariance = place::covariance(&there, &state, smoother.newest_covariance());
        self.anchor = Some(Anchor { pose, world_from_lidar, covariance });
    }

    /// While fixes are lost, both windows reach back to the newest pose: its node is what the next one is relative to.
    /// With [`InOutage::PseudoGlobal`] it is not.
    pub fn hold(&self, graphs: &mut Graphs, options: &Options) {
        if let (InOutage::Relative, Some(pose)) = (options.lidar_in_outage, self.last) {
            graphs.hold(pose.stamp);
        }
    }

    /// How many increments lie between two poses.
    fn increments(&self, gap: Span) -> f64 {
        if gap <= GAP_MAX || self.period_s == 0.0 { 1.0 } else { gap.as_seconds() / self.period_s }
    }

    /// Equation (1) with t_j at the loss, as the paper has it; relative in main.
    fn take_pseudo_global(
        &self,
        graphs: &mut Graphs,
        options: &Options,
        last: &LidarPose,
        pose: &LidarPose,
    ) -> Result<Taken, SmootherError> {
        if let Some(main) = graphs.passive_mut() {
            // As above: main does without what it cannot take.
            let _ = tie(main, options, last, pose, 1.0, MISFIT_MAX);
        }
        let Some(anchor) = &self.anchor else { return Ok(Taken::First) };
        let [turn, shift] = options.lidar_sigma;
        let sigma = Vec6::new(TILT_SIGMA, TILT_SIGMA, turn, shift, shift, shift);
        let factor = pose_factor(options, anchor, pose, PoseFactor::whiten(&sigma));
        add_pose(graphs.active_mut(), options, factor, pose)
    }

    /// Equation (1) after the lidar was blind for a while.
    fn return_from_gap(
        &self,
        graphs: &mut Graphs,
        options: &Options,
        last: &LidarPose,
        pose: &LidarPose,
    ) -> Result<Taken, SmootherError> {
        let Some(anchor) = &self.anchor else { return Ok(Taken::First) };
        let increments = self.increments(pose.stamp - last.stamp);
        let walked = options.lidar_sigma.map(|sigma| sigma * sigma * increments);
        let smoother = graphs.active_mut();
        let Some((state, covariance)) = smoother.predict(pose.stamp) else { return Ok(Taken::First) };
        let mut factor = pose_factor(options, anchor, pose, Mat6::identity());
        let moved = factor.measured.translation - anchor.world_from_lidar.translation();
        let [carried, walk] = place::carried(&anchor.covariance, &moved, walked);
        let predicted = place::covariance(&factor, &state, &covariance);
        let misfit = factor.error(&state);
        let difference = misfit.fixed_rows::<4>(2).into_owned();
        let Some(squared) = place::squared_misfit(&difference, &predicted, &[carried, walk]) else {
            return Err(SmootherError::NotDetermined);
        };
        if squared > RETURN_LIMIT {
            let off = misfit.fixed_rows::<3>(row::POSITION).norm();
            return Ok(Taken::Refused(format!(
                "came back {off:.2} m and {:.1}° from where it is expected: a new map",
                misfit[2].to_degrees().abs()
            )));
        }
        if smoother.oldest_stamp().is_some_and(|oldest| last.stamp >= oldest) {
            const ANY: [f64; 2] = [f64::INFINITY; 2];
            let taken = tie(smoother, options, last, pose, increments, ANY)?;
            if let Some(main) = graphs.passive_mut() {
                // Main is made anew from fallback or from fixes, should it not fit.
                let _ = tie(main, options, last, pose, increments, ANY);
            }
            return Ok(taken);
        }
        // What is learned later of the way in between would bring the estimate below the anchor's covariance.
        let reached = carried * SHARED + walk;
        let brought_down = place::bring_down(&predicted, &reached).ok_or(SmootherError::NotDetermined)?;
        factor.whiten = PoseFactor::whiten(&Vec6::repeat(TILT_SIGMA));
        factor.whiten.fixed_view_mut::<4, 4>(2, 2).copy_from(&brought_down);
        add_pose(smoother, options, factor, pose)
    }
}

fn pseudo_global(anchor: &Anchor, pose: &LidarPose) -> Pose<World, Lidar> {
    let world_from_map: Pose<World, LidarMap> =
        anchor.world_from_lidar * anchor.pose.lidarmap_from_lidar.inverse();
    world_from_map * pose.lidarmap_from_lidar
}

fn pose_factor(options: &Options, anchor: &Anchor, pose: &LidarPose, whiten: Mat6) -> PoseFactor {
    PoseFactor {
        measured: *pseudo_global(anchor, pose).motion(),
        imu_from_sensor: *options.imu_from_lidar.motion(),
        whiten,
    }
}

fn add_pose(
    smoother: &mut Smoother,
    options: &Options,
    mut factor: PoseFactor,
    pose: &LidarPose,
) -> Result<Taken, SmootherError> {
    let node = smoother.node_at(pose.stamp)?;
    if node != pose.stamp {
        // From the stamp of the pose to that of the node, by the motion in between.
        let (Some(at_pose), Some(at_node)) = (smoother.state_at(pose.stamp), smoother.state_at(node)) else {
            return Err(SmootherError::NotStarted);
        };
        let [from, to] = [at_pose, at_node].map(|state| state.world_from_imu() * options.imu_from_lidar);
        factor.measured = factor.measured * *(from.inverse() * to).motion();
    }
    smoother.add_pose(node, factor)?;
    Ok(Taken::Used)
}

/// How far an increment over so long may be from the prediction, after so many refusals in a row: rad, m.
fn misfit_limit(smoother: &Smoother, options: &Options, span_s: f64, refusals: u32) -> [f64; 2] {
    if refusals >= REFUSALS_MAX {
        return MISFIT_MAX;
    }
    let covariance = smoother.newest_covariance();
    let limit = |part: usize, rate_row: usize| -> f64 {
        let rate_variance = (rate_row..rate_row + 3).map(|axis| covariance[(axis, axis)]).fold(0.0, f64::max);
        let sigma = libm::hypot(options.lidar_sigma[part], rate_variance.sqrt() * span_s);
        (MISFIT_MIN[part] + MISFIT_SIGMAS * sigma).min(MISFIT_MAX[part])
    };
    [limit(0, row::GYRO_BIAS), limit(1, row::VELOCITY)]
}

/// Ties the nodes of two poses that lie so many increments apart, if they fit the prediction: rad, m.
fn tie(
    smoother: &mut Smoother,
    options: &Options,
    from: &LidarPose,
    to: &LidarPose,
    increments: f64,
    limit: [f64; 2],
) -> Result<Taken, SmootherError> {
    let seen = from.lidarmap_from_lidar.inverse() * to.lidarmap_from_lidar;
    let mut lidar_at = |stamp: Stamp| -> Option<Pose<World, Lidar>> {
        Some(smoother.state_at(stamp)?.world_from_imu() * options.imu_from_lidar)
    };
    // A pose that is refused must not leave nodes behind: nobody would solve them.
    if let (Some(at_from), Some(at_to)) = (lidar_at(from.stamp), lidar_at(to.stamp)) {
        let misfit = (at_from.inverse() * at_to).inverse() * seen;
        let (shift_m, turn) = (misfit.translation().norm(), misfit.rotation().log().norm());
        if turn > limit[0] || shift_m > limit[1] {
            return Ok(Taken::Refused(format!(
                "its increment is {shift_m:.2} m and {:.1}° from the predicted one",
                turn.to_degrees()
            )));
        }
    }
    // Says what is wrong with a stamp that the window does not reach.
    let earlier = smoother.node_at(from.stamp)?;
    let later = smoother.node_at(to.stamp)?;
    if later <= earlier {
        return Ok(Taken::Used);
    }
    let mut lidar_at = |stamp: Stamp| -> Option<Pose<World, Lidar>> {
        Some(smoother.state_at(stamp)?.world_from_imu() * options.imu_from_lidar)
    };
    let states = (lidar_at(earlier), lidar_at(from.stamp), lidar_at(to.stamp), lidar_at(later));
    let (Some(at_earlier), Some(at_from), Some(at_to), Some(at_later)) = states else {
        return Err(SmootherError::NotStarted);
    };
    // From the stamps of the poses to those of the nodes, by the motion in between.
    let measured = (at_earlier.inverse() * at_from) * seen * (at_to.inverse() * at_later);
    let factor = BetweenFactor {
        measured: *measured.motion(),
        imu_from_sensor: *options.imu_from_lidar.motion(),
        sigma: options.lidar_sigma.map(|sigma| sigma * increments.sqrt()),
    };
    smoother.add_between(earlier, later, factor)?;
    Ok(Taken::Used)
}
