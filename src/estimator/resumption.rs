//! The start after the IMU was silent: what the estimate knew goes on.
//!
//! Biases outlast the silence. Where the machine came to meanwhile is told by the lidar odometry, if it went on
//! (it bridges position and attitude), else by fixes and an attitude: by two antennas tilt comes from the mean specific
//! force and heading from the baseline; by the chassis IMU and the encoder, which did not fall silent, the attitude of
//! before is turned on. With none of it, the biases still make the alignment of `initialization` shorter.

use std::collections::VecDeque;

use super::alignment::{fit_line, level_from_mean_force};
use super::chassis_turn::ChassisTurn;
use super::options::Options;
use super::standstill::{Standstill, imu_from_base};
use crate::frames::{Imu, Pose, World};
use crate::lie::{So3, Vec3};
use crate::preintegration::{Preintegration, SampleBuffer};
use crate::sensors::{GnssFix, LidarPose};
use crate::state::{NavState, STATE_DIM, StateMatrix, row};
use crate::time::{Span, Stamp};

/// Lidar poses further apart than this do not bridge a silence: its odometry lost much, or has begun anew.
const LIDAR_GAP_MAX_S: f64 = 1.1;
/// Two consecutive lidar poses further apart than the machine's speed explains: m, and rad beside rad/s.
const LIDAR_JUMP_M: f64 = 0.5;
const LIDAR_TURN: [f64; 2] = [0.2, 2.0];
/// A silence longer than this is not bridged by lidar, s.
const BRIDGE_MAX_S: f64 = 60.0;
/// Least sigma of what lidar bridges: rad, m; its errors are not white.
const BRIDGED_SIGMA_MIN: [f64; 2] = [0.01, 0.02];
/// A bridged position and a fix differ by so much, m, beside their sigmas.
const FIX_APART_MAX_M: f64 = 0.3;
/// The fix that is compared is at most so far from the lidar pose, s.
const FIX_AWAY_MAX_S: f64 = 0.12;
/// Attitude by the chassis: one sigma, rad, and rad/s of the bias of its gyroscope.
const CHASSIS_SIGMA: [f64; 2] = [0.01, 0.004];
/// Fixes are watched for so long at least, for the velocity, s, and in so many epochs.
const WATCH_S: f64 = 0.3;
const EPOCHS_MIN: usize = 3;
/// Tilt by the mean specific force of a moving machine, rad: it accelerates by less than 1 m/s².
const TILT_SIGMA: f64 = 0.1;
/// Velocity by some fixes or two lidar poses, m/s.
const VELOCITY_SIGMA: f64 = 0.3;
/// Two antennas' fixes of one epoch are at most so far apart, s.
const SAME_EPOCH_S: f64 = 0.005;

/// What the estimate knew when the IMU fell silent.
#[derive(Clone, Debug)]
pub(super) struct Known {
    pub stamp: Stamp,
    pub state: NavState,
    pub covariance: StateMatrix,
    /// The newest lidar pose and the state at its stamp, if its clock still counts.
    pub lidar: Option<(LidarPose, NavState)>,
    /// Whether fixes were trusted.
    pub fixes_trusted: bool,
    /// Whether `stamp` is by the clock that still counts.
    pub same_clock: bool,
}

/// A state to go on from.
#[derive(Clone, Debug)]
pub(super) struct Resumed {
    pub stamp: Stamp,
    pub state: NavState,
    /// Inverse covariance.
    pub information: StateMatrix,
    pub heading_from: &'static str,
    /// rad.
    pub heading_sigma: f64,
    /// Whether fixes agree with it.
    pub fixes_agree: bool,
}

/// Watches whether lidar odometry goes on.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct LidarTrail {
    newest: Option<LidarPose>,
    /// Of the first pose that counts from the same origin.
    since: Option<Stamp>,
}

impl LidarTrail {
    /// Whether the pose goes on from the one before, at a possible speed (m/s).
    pub fn follow(&mut self, pose: &LidarPose, speed_max: f64) -> bool {
        let before = self.newest.replace(*pose);
        let goes_on = before.is_some_and(|before| goes_on(&before, pose, speed_max));
        if !goes_on {
            self.since = Some(pose.stamp);
        }
        goes_on
    }

    /// Whether a pose of that stamp counts from the same origin as the newest.
    pub fn holds(&self, stamp: Stamp) -> bool {
        self.since.is_some_and(|since| stamp >= since)
    }
}

fn goes_on(before: &LidarPose, pose: &LidarPose, speed_max: f64) -> bool {
    let elapsed_s = pose.stamp.seconds_since(before.stamp);
    let moved = before.lidarmap_from_lidar.inverse() * pose.lidarmap_from_lidar;
    elapsed_s <= LIDAR_GAP_MAX_S
        && moved.translation().norm() <= LIDAR_JUMP_M + speed_max * elapsed_s
        && moved.rotation().log().norm() <= LIDAR_TURN[0] + LIDAR_TURN[1] * elapsed_s
}

/// What the chassis carries, which does not fall silent with the cabin's IMU.
pub(super) struct Chassis<'a> {
    pub gyroscope: &'a ChassisTurn,
    pub encoder: &'a Standstill,
}

impl Chassis<'_> {
    /// How the cabin IMU has turned between two stamps: its attitude at the later one in that at the earlier.
    fn turned(&self, from: Stamp, to: Stamp, base_gyro_bias: f64, options: &Options) -> Option<So3> {
        let [at_from, at_to] = [from, to].map(|stamp| self.encoder.turn_at(stamp));
        let [from_base, to_base] = [at_from?, at_to?].map(|angle| imu_from_base(options, angle).rotation());
        Some(from_base * self.gyroscope.turned(from, to, base_gyro_bias)? * to_base.inverse())
    }
}

impl Known {
    /// What remains of it once stamps are by another clock.
    pub fn by_another_clock(self) -> Self {
        Self { lidar: None, same_clock: false, ..self }
    }

    /// One sigma of the gyro bias now, rad/s: its worst axis.
    pub fn gyro_bias_sigma(&self, now: Stamp, options: &Options) -> f64 {
        let walk = self.walk(now, options.smoother.noise.gyroscope_random_walk);
        let variance = (row::GYRO_BIAS..row::GYRO_BIAS + 3)
            .map(|axis| self.covariance[(axis, axis)])
            .fold(0.0, f64::max);
        (variance + walk).sqrt()
    }

    /// Variance of a random walk (per √Hz) since then; a clock that was set back counts as well.
    fn walk(&self, now: Stamp, density: f64) -> f64 {
        density * density * now.seconds_since(self.stamp).abs()
    }

    /// Information on a state that starts at `stamp`: what is known of the biases, walked, and independent sigmas
    /// for the rest (rotation about the world's axes).
    fn information(
        &self,
        stamp: Stamp,
        state: &NavState,
        rotation_sigma: &Vec3,
        position_sigma: f64,
        options: &Options,
    ) -> Option<StateMatrix> {
        let mut covariance = StateMatrix::zeros();
        let size = STATE_DIM - row::GYRO_BIAS;
        let biases = self.covariance.view((row::GYRO_BIAS, row::GYRO_BIAS), (size, size));
        covariance.view_mut((row::GYRO_BIAS, row::GYRO_BIAS), (size, size)).copy_from(&biases);
        let rotation = state.rotation.matrix();
        let in_world = crate::lie::Mat3::from_diagonal(&rotation_sigma.component_mul(rotation_sigma));
        covariance
            .fixed_view_mut::<3, 3>(row::ROTATION, row::ROTATION)
            .copy_from(&(rotation.transpose() * in_world * rotation));
        let noise = &options.smoother.noise;
        let added = [
            (row::POSITION, position_sigma.powi(2)),
            (row::VELOCITY, VELOCITY_SIGMA.powi(2)),
            (row::GYRO_BIAS, self.walk(stamp, noise.gyroscope_random_walk)),
            (row::ACCEL_BIAS, self.walk(stamp, noise.accelerometer_random_walk)),
        ];
        for (first, variance) in added {
            (first..first + 3).for_each(|axis| covariance[(axis, axis)] += variance);
        }
        covariance[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] +=
            self.walk(stamp, noise.base_gyroscope_random_walk);
        covariance.try_inverse()
    }
}

/// By lidar odometry that went on through the silence: from its last pose before to the first after it that the IMU
/// covers; the next one gives the velocity. `fixes` are usable ones of the left antenna.
pub(super) fn bridge_by_lidar<'a>(
    known: &Known,
    samples: &SampleBuffer,
    lidar: &VecDeque<LidarPose>,
    fixes: impl Iterator<Item = &'a GnssFix>,
    options: &Options,
) -> Option<Resumed> {
    let (before, state_before) = known.lidar.as_ref()?;
    let begin = samples.oldest()?.stamp;
    let mut after = lidar.iter().filter(|pose| pose.stamp >= begin);
    let (first, second) = (after.next()?, after.next()?);
    let silence_s = first.stamp.seconds_since(before.stamp);
    let between_s = second.stamp.seconds_since(first.stamp);
    if silence_s > BRIDGE_MAX_S || between_s > LIDAR_GAP_MAX_S {
        return None;
    }
    let world_from_lidarmap =
        state_before.world_from_imu() * options.imu_from_lidar * before.lidarmap_from_lidar.inverse();
    let at = |pose: &LidarPose| -> Pose<World, Imu> {
        world_from_lidarmap * pose.lidarmap_from_lidar * options.imu_from_lidar.inverse()
    };
    let (at_first, at_second) = (at(first), at(second));
    let mut state = NavState {
        rotation: at_first.rotation().renormalized(),
        position: at_first.translation(),
        velocity: Vec3::zeros(),
        ..known.state
    };
    let steps = samples.steps(first.stamp, second.stamp)?;
    let noise = &options.smoother.noise;
    let motion = Preintegration::of_steps(steps, state.gyro_bias, state.accel_bias, noise);
    let fallen = motion.predict(&state, &options.smoother.gravity).position;
    state.velocity = (at_second.translation() - fallen) / between_s;

    // As many increments as there were, each with its sigma; heading errors turn the way.
    let increments = (silence_s / between_s).max(1.0);
    let sigma = |part: usize, first: usize| -> f64 {
        let known_variance =
            (first..first + 3).map(|axis| known.covariance[(axis, axis)]).fold(0.0, f64::max);
        (known_variance + options.lidar_sigma[part].powi(2) * increments).sqrt().max(BRIDGED_SIGMA_MIN[part])
    };
    let rotation_sigma = sigma(0, row::ROTATION);
    let travelled_m = (state.position - state_before.position).norm();
    let position_sigma = libm::hypot(sigma(1, row::POSITION), rotation_sigma * travelled_m);

    let nearest = fixes.min_by_key(|fix| (fix.stamp - first.stamp).as_nanos().abs());
    let nearest = nearest.filter(|fix| fix.stamp.seconds_since(first.stamp).abs() <= FIX_AWAY_MAX_S);
    let apart_m = nearest.map(|fix| {
        let moved = state.velocity * fix.stamp.seconds_since(first.stamp);
        let expected = state.position + moved + state.rotation * options.antenna_left;
        (options.site.to_enu(fix.position) - expected).norm()
    });
    let limit_m = FIX_APART_MAX_M + 5.0 * position_sigma;
    let information =
        known.information(first.stamp, &state, &Vec3::repeat(rotation_sigma), position_sigma, options)?;
    Some(Resumed {
        stamp: first.stamp,
        state,
        information,
        heading_from: "lidar odometry through the silence",
        heading_sigma: rotation_sigma,
        fixes_agree: known.fixes_trusted && apart_m.is_some_and(|apart_m| apart_m <= limit_m),
    })
}

/// Fixes of the left antenna at the end of what the IMU covers, enough of them for a velocity; oldest first.
fn watched<'a>(samples: &SampleBuffer, left: &'a [GnssFix]) -> Option<Vec<&'a GnssFix>> {
    let (begin, newest) = (samples.oldest()?.stamp, samples.newest()?.stamp);
    let covered = |fix: &&GnssFix| fix.stamp >= begin && fix.stamp <= newest;
    let last = left.iter().rev().find(covered)?.stamp;
    let from = last - Span::from_seconds(2.0 * WATCH_S);
    let watched: Vec<&GnssFix> = left.iter().filter(covered).filter(|fix| fix.stamp >= from).collect();
    let long = last.seconds_since(watched.first()?.stamp) >= WATCH_S;
    (long && watched.len() >= EPOCHS_MIN).then_some(watched)
}

/// The state at the first of some fixes, given the attitude there.
fn at_fixes(
    known: &Known,
    samples: &SampleBuffer,
    watched: &[&GnssFix],
    rotation: So3,
    rotation_sigma: &Vec3,
    options: &Options,
) -> Option<Resumed> {
    let start = watched.first()?.stamp;
    let line = |axis: usize| {
        fit_line(
            watched
                .iter()
                .map(|fix| (fix.stamp.seconds_since(start), options.site.to_enu(fix.position)[axis])),
        )
    };
    let [(x, vx), (y, vy), (z, vz)] = [line(0)?, line(1)?, line(2)?];
    let rate = samples.at(start)?.angular_rate - known.state.gyro_bias;
    let state = NavState {
        rotation: rotation.renormalized(),
        position: Vec3::new(x, y, z) - rotation * options.antenna_left,
        velocity: Vec3::new(vx, vy, vz) - rotation * rate.cross(&options.antenna_left),
        ..known.state
    };
    let sigma_m = watched.iter().map(|fix| fix.sigma_enu_m.amax()).fold(0.0, f64::max);
    let position_sigma = 0.05 + sigma_m + rotation_sigma.amax() * options.antenna_left.norm();
    let information = known.information(start, &state, rotation_sigma, position_sigma, options)?;
    Some(Resumed {
        stamp: start,
        state,
        information,
        heading_from: "",
        heading_sigma: rotation_sigma.z,
        fixes_agree: known.fixes_trusted,
    })
}

/// By the chassis IMU and the encoder, which saw how the cabin turned meanwhile, and fixes.
pub(super) fn bridge_by_chassis(
    known: &Known,
    samples: &SampleBuffer,
    left: &[GnssFix],
    chassis: &Chassis,
    options: &Options,
) -> Option<Resumed> {
    if !known.same_clock {
        return None;
    }
    let watched = watched(samples, left)?;
    let start = watched.first()?.stamp;
    let turned = chassis.turned(known.stamp, start, known.state.base_gyro_bias, options)?;
    let rotation = known.state.rotation * turned;
    let variance =
        (row::ROTATION..row::ROTATION + 3).map(|axis| known.covariance[(axis, axis)]).fold(0.0, f64::max);
    let drift = CHASSIS_SIGMA[0] + CHASSIS_SIGMA[1] * start.seconds_since(known.stamp);
    let sigma = libm::hypot(variance.sqrt(), drift);
    let resumed = at_fixes(known, samples, &watched, rotation, &Vec3::repeat(sigma), options)?;
    Some(Resumed { heading_from: "the chassis through the silence", ..resumed })
}

/// By two antennas of a machine that may move. `left` and `right` are usable fixes, oldest first.
pub(super) fn find_by_two_antennas(
    known: &Known,
    samples: &SampleBuffer,
    left: &[GnssFix],
    right: &[GnssFix],
    options: &Options,
) -> Option<Resumed> {
    let arm = options.antenna_right? - options.antenna_left;
    let watched = watched(samples, left)?;
    let (start, last) = (watched.first()?.stamp, watched.last()?.stamp);
    let (gyro_bias, accel_bias) = (known.state.gyro_bias, known.state.accel_bias);
    let level = level_from_mean_force(samples, start, last, &gyro_bias, &accel_bias)?;
    let mut sum = nalgebra::Vector2::<f64>::zeros();
    let (mut epochs, mut sigma_m) = (0, 0.0_f64);
    for left in &watched {
        let same = |right: &&GnssFix| right.stamp.seconds_since(left.stamp).abs() <= SAME_EPOCH_S;
        let Some(right) = right.iter().find(same) else { continue };
        let seen = options.site.to_enu(right.position) - options.site.to_enu(left.position);
        if (seen.norm() - arm.norm()).abs() > 0.03 + 5.0 * left.sigma_enu_m.norm() {
            continue;
        }
        let turned = samples
            .steps(start, left.stamp)?
            .fold(So3::identity(), |turn, step| turn.plus(&((step.angular_rate - gyro_bias) * step.span_s)));
        let baseline = level * turned * arm;
        sum.x += baseline.x * seen.x + baseline.y * seen.y;
        sum.y += baseline.x * seen.y - baseline.y * seen.x;
        sigma_m = sigma_m.max(left.sigma_enu_m.amax()).max(right.sigma_enu_m.amax());
        epochs += 1;
    }
    if epochs < EPOCHS_MIN {
        return None;
    }
    let rotation = So3::about(&Vec3::z(), libm::atan2(sum.y, sum.x)) * level;
    let baseline = rotation * arm;
    let horizontal_m = baseline.xy().norm();
    // A tilt moves the baseline's vertical part sideways.
    let heading_sigma =
        (std::f64::consts::SQRT_2 * sigma_m + TILT_SIGMA * baseline.z.abs()) / horizontal_m.max(1.0e-3);
    if heading_sigma > 3.0 * options.initialization.heading_sigma {
        return None;
    }
    let rotation_sigma = Vec3::new(TILT_SIGMA, TILT_SIGMA, heading_sigma);
    let resumed = at_fixes(known, samples, &watched, rotation, &rotation_sigma, options)?;
    Some(Resumed { heading_from: "two antennas in motion", ..resumed })
}
