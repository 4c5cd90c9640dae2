//! The start: attitude and biases from a standstill, heading from two antennas or from motion.
//!
//! A standstill gives roll, pitch and gyro bias, two antennas give the heading at once. With one antenna, or
//! if the machine never stands, the heading comes from the way it moves (see `alignment`). Until then the
//! machine says what it waits for.

use std::collections::VecDeque;

use super::alignment::{Aligned, Anchor, Guess, align, level_from_mean_force, without_heading};
use super::options::Options;
use super::resumption::{Chassis, Known, Resumed, bridge_by_chassis, bridge_by_lidar, find_by_two_antennas};
use crate::lie::{Mat3, So3, Vec3, hat};
use crate::preintegration::SampleBuffer;
use crate::sensors::{GnssFix, ImuSample, LidarPose, Reading};
use crate::state::{NavState, STATE_DIM, StateMatrix, row};
use crate::time::{Span, Stamp};

/// The start lies so far before the newest sample, so that readings under way still find the window.
const START_DELAY: Span = Span::from_millis(200);
/// Longest stretch of motion that is used to find the heading.
const TRACK: Span = Span::from_millis(8_000);
/// Without a standstill the alignment waits for so much of it.
const TRACK_MIN: Span = Span::from_millis(4_000);
/// The same where the biases are known.
const TRACK_MIN_KNOWN: Span = Span::from_millis(1_000);
/// The heading need only be known so many times worse then: it is in use at once, and grows better.
const HEADING_EASE_KNOWN: f64 = 3.0;
/// A standstill is looked for at every so many samples.
const LOOK_EVERY: u64 = 20;
/// A way to go on from what was known is looked for at every so many samples.
const LOOK_TO_RESUME_EVERY: u64 = 5;
/// The window is cut into so many blocks, whose means must agree.
const BLOCKS: usize = 10;
/// Mean angular rate of a machine at rest: at most its bias, rad/s.
const REST_RATE_MAX: f64 = 0.03;
/// Mean specific force of a machine at rest: g but for bias and scale, m/s².
const REST_FORCE_TOLERANCE: f64 = 0.5;
/// Means of blocks at rest may differ by so much beyond noise: rad/s and m/s² (engine, wind, people).
const REST_WOBBLE: [f64; 2] = [0.004, 0.08];
/// Two antennas' fixes of one epoch are at most so far apart.
const SAME_EPOCH: Span = Span::from_millis(5);
/// Epochs of two antennas that are averaged at least.
const EPOCHS_MIN: usize = 5;
/// Prior of the chassis gyro's bias, rad/s.
const BASE_GYRO_BIAS_SIGMA: f64 = 0.01;

/// Where and how an estimate starts.
pub struct Start {
    /// Of the state; some tenths of a second ago.
    pub stamp: Stamp,
    /// The state.
    pub state: NavState,
    /// Inverse covariance of the state.
    pub information: StateMatrix,
    /// How the heading was found.
    pub heading_from: &'static str,
    /// rad.
    pub heading_sigma: f64,
    /// Whether the start rests on fixes, or agrees with them.
    pub fixes_agree: bool,
    /// IMU samples that reach over the start.
    pub samples: Vec<ImuSample>,
    /// Readings from the start on, by stamp.
    pub readings: Vec<Reading>,
}

/// Roll, pitch and biases, known since a standstill.
#[derive(Clone, Copy, Debug)]
struct Level {
    stamp: Stamp,
    /// Heading zero at the standstill.
    rotation: So3,
    gyro_bias: Vec3,
    /// Along gravity; the rest of it cannot be told from tilt.
    accel_bias: Vec3,
    /// Mean specific force at rest, in the IMU frame, and its sigma, m/s².
    force: Vec3,
    force_sigma: f64,
    gyro_bias_sigma: f64,
}

/// All that was read at rest so far; a longer rest gives better biases.
#[derive(Clone, Copy, Debug)]
struct Rest {
    until: Stamp,
    rate_sum: Vec3,
    force_sum: Vec3,
    count: f64,
    length_s: f64,
}

/// Collects readings until the estimate can start.
pub(super) struct Initializer {
    options: Options,
    samples: SampleBuffer,
    pushed: u64,
    left: VecDeque<GnssFix>,
    right: VecDeque<GnssFix>,
    lidar: VecDeque<LidarPose>,
    level: Option<Level>,
    rest: Option<Rest>,
    /// Whether the newest look found a standstill.
    at_rest: bool,
    /// Before the IMU fell silent.
    known: Option<Known>,
    waits_for: String,
}

impl Initializer {
    /// `known` is what the estimate knew before, if it ran.
    pub fn new(options: Options, known: Option<Known>) -> Self {
        Self {
            options,
            known,
            samples: SampleBuffer::default(),
            pushed: 0,
            left: VecDeque::new(),
            right: VecDeque::new(),
            lidar: VecDeque::new(),
            level: None,
            rest: None,
            at_rest: false,
            waits_for: "the cabin IMU".to_owned(),
        }
    }

    /// What is missing, in words an operator can act on.
    pub fn waits_for(&self) -> &str {
        &self.waits_for
    }

    /// What was known before, for another start anew.
    pub fn take_known(&mut self) -> Option<Known> {
        self.known.take()
    }

    /// Lidar odometry has begun anew: it bridges nothing.
    pub fn note_lidar_restart(&mut self) {
        self.lidar.clear();
        if let Some(known) = &mut self.known {
            known.lidar = None;
        }
    }

    /// Takes a reading that was admitted; returns the start as soon as there is one.
    pub fn push(&mut self, reading: &Reading, chassis: &Chassis) -> Option<Start> {
        match reading {
            Reading::Imu(sample) => {
                self.samples.push(*sample);
                self.pushed += 1;
                self.forget();
                if self.pushed.is_multiple_of(LOOK_TO_RESUME_EVERY)
                    && let Some(start) = self.resume(chassis)
                {
                    return Some(start);
                }
                if !self.pushed.is_multiple_of(LOOK_EVERY) {
                    return None;
                }
                self.look_for_rest();
                return self.try_start();
            }
            Reading::GnssLeft(fix) => self.left.push_back(*fix),
            Reading::GnssRight(fix) => self.right.push_back(*fix),
            Reading::LidarOdometry(pose) => self.lidar.push_back(*pose),
            Reading::BaseImu(_) | Reading::CabinTurn(_) => {}
        }
        None
    }

    fn forget(&mut self) {
        let Some(newest) = self.samples.newest().map(|sample| sample.stamp) else { return };
        let keep = TRACK.as_nanos().max(self.options.initialization.static_window.as_nanos());
        let oldest = newest - Span::from_nanos(keep) - START_DELAY;
        // The level attitude is carried along to the oldest sample that stays.
        if let Some(level) = &mut self.level
            && level.stamp < oldest
            && let Some(steps) = self.samples.steps(level.stamp, oldest)
        {
            for step in steps {
                level.rotation = level.rotation.plus(&((step.angular_rate - level.gyro_bias) * step.span_s));
            }
            level.stamp = oldest;
        }
        self.samples.forget_before(oldest);
        self.left.retain(|fix| fix.stamp >= oldest);
        self.right.retain(|fix| fix.stamp >= oldest);
        self.lidar.retain(|pose| pose.stamp >= oldest);
    }

    /// Whether the window up to [`START_DELAY`] before now was a standstill; if so, takes the level from it.
    fn look_for_rest(&mut self) {
        self.at_rest = false;
        let rest = self.rest.take();
        let Some(newest) = self.samples.newest().map(|sample| sample.stamp) else { return };
        let end = newest - START_DELAY;
        let begin = end - self.options.initialization.static_window;
        let window: Vec<&ImuSample> =
            self.samples.iter().filter(|sample| sample.stamp > begin && sample.stamp <= end).collect();
        let covers = self.samples.oldest().is_some_and(|oldest| oldest.stamp <= begin);
        if !covers || window.len() < 4 * BLOCKS {
            return;
        }
        let mean = |samples: &[&ImuSample]| {
            let count = samples.len() as f64;
            let rate: Vec3 = samples.iter().map(|sample| sample.angular_rate).sum();
            let force: Vec3 = samples.iter().map(|sample| sample.specific_force).sum();
            (rate / count, force / count)
        };
        let (rate, force) = mean(&window);
        let g = self.options.smoother.gravity.norm();
        if rate.norm() > REST_RATE_MAX || (force.norm() - g).abs() > REST_FORCE_TOLERANCE {
            return;
        }
        let window_s = end.seconds_since(begin);
        let noise = &self.options.smoother.noise;
        let block_root_s = (window_s / BLOCKS as f64).sqrt();
        let rate_limit = REST_WOBBLE[0] + 4.0 * noise.gyroscope_noise_density / block_root_s;
        let force_limit = REST_WOBBLE[1] + 4.0 * noise.accelerometer_noise_density / block_root_s;
        let steady = window.chunks(window.len().div_ceil(BLOCKS)).all(|block| {
            let (block_rate, block_force) = mean(block);
            (block_rate - rate).amax() < rate_limit && (block_force - force).amax() < force_limit
        });
        if !steady || !self.fixes_are_still(begin, end) {
            return;
        }
        self.at_rest = true;
        let begun = rest.unwrap_or(Rest {
            until: begin,
            rate_sum: Vec3::zeros(),
            force_sum: Vec3::zeros(),
            count: 0.0,
            length_s: 0.0,
        });
        let rest =
            window.iter().filter(|sample| sample.stamp > begun.until).fold(begun, |rest, sample| Rest {
                rate_sum: rest.rate_sum + sample.angular_rate,
                force_sum: rest.force_sum + sample.specific_force,
                count: rest.count + 1.0,
                ..rest
            });
        let rest = Rest { until: end, length_s: rest.length_s + end.seconds_since(begun.until), ..rest };
        self.rest = Some(rest);
        let (rate, force) = (rest.rate_sum / rest.count, rest.force_sum / rest.count);
        let root_s = rest.length_s.sqrt();
        let up = force.normalize();
        self.level = Some(Level {
            stamp: end,
            rotation: without_heading(&So3::between(&up, &Vec3::z())),
            gyro_bias: rate,
            accel_bias: up * (force.norm() - g),
            force,
            force_sigma: 0.01 + 2.0 * noise.accelerometer_noise_density / root_s,
            // The earth turns at 7e-5 rad/s, which is not told from bias.
            gyro_bias_sigma: 1.0e-4 + 2.0 * noise.gyroscope_noise_density / root_s,
        });
    }

    fn fixes_are_still(&self, begin: Stamp, end: Stamp) -> bool {
        let mut within = self.left.iter().filter(|fix| fix.stamp >= begin && fix.stamp <= end);
        let Some(first) = within.next() else { return true };
        let origin = self.options.site.to_enu(first.position);
        within.all(|fix| {
            let moved = self.options.site.to_enu(fix.position) - origin;
            moved.norm() < 0.03 + 6.0 * fix.sigma_enu_m.norm()
        })
    }

    /// Goes on from what was known before the IMU fell silent, where lidar, two antennas or the chassis tell the
    /// attitude.
    fn resume(&self, chassis: &Chassis) -> Option<Start> {
        let known = self.known.as_ref()?;
        let bridged = bridge_by_lidar(known, &self.samples, &self.lidar, self.usable_left(), &self.options);
        // Bridged against fixes that were trusted: either is wrong, and the fixes alone must do.
        let contradicted = known.fixes_trusted && self.usable_left().next().is_some();
        let resumed = bridged.filter(|bridged| bridged.fixes_agree || !contradicted).or_else(|| {
            let left: Vec<GnssFix> = self.usable_left().copied().collect();
            let right: Vec<GnssFix> = self.right.iter().filter(|fix| self.is_usable(fix)).copied().collect();
            let options = &self.options;
            find_by_two_antennas(known, &self.samples, &left, &right, options)
                .or_else(|| bridge_by_chassis(known, &self.samples, &left, chassis, options))
        })?;
        let Resumed { stamp, state, information, heading_from, heading_sigma, fixes_agree } = resumed;
        let start = self.start(stamp, state, information, heading_from, heading_sigma);
        Some(Start { fixes_agree, ..start })
    }

    fn try_start(&mut self) -> Option<Start> {
        let newest = self.samples.newest()?.stamp;
        if self.usable_left().next().is_none() {
            self.waits_for = match self.left.back() {
                None => "the left GNSS antenna: no fixes arrive".to_owned(),
                Some(fix) => format!(
                    "RTK: the left antenna reports {:.2} m, {:.2} m is the limit",
                    fix.sigma_enu_m.xy().amax(),
                    self.options.gate.sigma_max_m
                ),
            };
            return None;
        }
        if self.at_rest
            && let Some(start) = self.start_at_rest()
        {
            return Some(start);
        }
        if let Some(start) = self.start_in_motion(newest) {
            return Some(start);
        }
        self.waits_for = if self.level.is_none() && self.options.antenna_right.is_some() {
            "a standstill of a few seconds, or some metres of driving".to_owned()
        } else if self.options.antenna_right.is_some() {
            "the right GNSS antenna for the heading, or some metres of driving".to_owned()
        } else {
            "the heading: drive some metres".to_owned()
        };
        None
    }

    fn usable_left(&self) -> impl DoubleEndedIterator<Item = &GnssFix> {
        self.left.iter().filter(|fix| self.is_usable(fix))
    }

    fn is_usable(&self, fix: &GnssFix) -> bool {
        fix.sigma_enu_m.x.max(fix.sigma_enu_m.y).max(0.5 * fix.sigma_enu_m.z) <= self.options.gate.sigma_max_m
    }

    /// At rest with two antennas: the baseline's direction, averaged, is the heading.
    fn start_at_rest(&self) -> Option<Start> {
        let level = self.level?;
        let right_arm = self.options.antenna_right?;
        let begin = level.stamp - self.options.initialization.static_window;
        let baseline = level.rotation * (right_arm - self.options.antenna_left);
        let horizontal_m = baseline.xy().norm();
        let mut sum = nalgebra::Vector2::<f64>::zeros();
        let mut epochs = 0_usize;
        let mut position = Vec3::zeros();
        let mut sigma_m = 0.0_f64;
        for left in self.usable_left().filter(|fix| fix.stamp >= begin && fix.stamp <= level.stamp) {
            let partner = self.right.iter().find(|right| {
                let apart = right.stamp - left.stamp;
                apart <= SAME_EPOCH && SAME_EPOCH.as_nanos() + apart.as_nanos() >= 0 && self.is_usable(right)
            });
            let Some(right) = partner else { continue };
            let [left_enu, right_enu] = [left, right].map(|fix| self.options.site.to_enu(fix.position));
            let seen = right_enu - left_enu;
            if (seen.norm() - baseline.norm()).abs() > 0.03 + 5.0 * left.sigma_enu_m.norm() {
                continue;
            }
            sum.x += baseline.x * seen.x + baseline.y * seen.y;
            sum.y += baseline.x * seen.y - baseline.y * seen.x;
            position += left_enu;
            sigma_m = sigma_m.max(left.sigma_enu_m.amax()).max(right.sigma_enu_m.amax());
            epochs += 1;
        }
        if epochs < EPOCHS_MIN {
            return None;
        }
        let rotation = So3::about(&Vec3::z(), libm::atan2(sum.y, sum.x)) * level.rotation;
        // Errors of one receiver's fixes go together over seconds: averaging is not counted on.
        let heading_sigma = std::f64::consts::SQRT_2 * sigma_m / horizontal_m;
        if heading_sigma > self.options.initialization.heading_sigma {
            return None;
        }
        let state = NavState {
            rotation,
            position: position / epochs as f64 - rotation * self.options.antenna_left,
            velocity: Vec3::zeros(),
            gyro_bias: level.gyro_bias,
            accel_bias: level.accel_bias,
            base_gyro_bias: 0.0,
        };
        let information = self.information_at_rest(&level, &state, heading_sigma, sigma_m);
        Some(self.start(level.stamp, state, information, "two antennas at rest", heading_sigma))
    }

    /// Tilt and accelerometer bias share what the mean specific force f says: r = Rᵀ(−g) + b_a − f, so that
    /// a bias that only looks like a tilt is told apart as soon as the machine turns.
    fn information_at_rest(
        &self,
        level: &Level,
        state: &NavState,
        heading_sigma: f64,
        sigma_m: f64,
    ) -> StateMatrix {
        let rotation_sigma = Vec3::new(0.3, 0.3, heading_sigma);
        let mut information =
            self.information(state, &rotation_sigma, sigma_m + 0.02, 0.02, level.gyro_bias_sigma);
        let force = state.rotation.inverse() * -self.options.smoother.gravity;
        let mut jacobian = nalgebra::SMatrix::<f64, 3, STATE_DIM>::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, row::ROTATION).copy_from(&hat(&force));
        jacobian.fixed_view_mut::<3, 3>(0, row::ACCEL_BIAS).copy_from(&Mat3::identity());
        information += jacobian.transpose() * jacobian / level.force_sigma.powi(2);
        debug_assert!((force + state.accel_bias - level.force).norm() < 1.0, "the level fits its own force");
        information
    }

    /// Independent sigmas: rotation about the world's axes (rad), position (m), velocity (m/s), gyro bias.
    fn information(
        &self,
        state: &NavState,
        rotation_sigma: &Vec3,
        position_m: f64,
        velocity: f64,
        gyro_bias: f64,
    ) -> StateMatrix {
        let mut information = StateMatrix::zeros();
        let rotation = state.rotation.matrix();
        let in_world = Mat3::from_diagonal(&rotation_sigma.map(|sigma| sigma.powi(-2)));
        information
            .fixed_view_mut::<3, 3>(row::ROTATION, row::ROTATION)
            .copy_from(&(rotation.transpose() * in_world * rotation));
        let accel_bias = self.options.initialization.accel_bias_sigma;
        let parts = [
            (row::POSITION, position_m),
            (row::VELOCITY, velocity),
            (row::GYRO_BIAS, gyro_bias),
            (row::ACCEL_BIAS, accel_bias),
        ];
        for (first, sigma) in parts {
            for axis in first..first + 3 {
                information[(axis, axis)] = sigma.powi(-2);
            }
        }
        information[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] = BASE_GYRO_BIAS_SIGMA.powi(-2);
        information
    }

    /// In motion: the alignment over the last seconds, where it is sure enough.
    fn start_in_motion(&self, newest: Stamp) -> Option<Start> {
        let oldest = newest - TRACK;
        let fixes: Vec<Anchor> = self
            .usable_left()
            .filter(|fix| fix.stamp >= oldest && fix.stamp <= newest)
            .filter(|fix| self.samples.oldest().is_some_and(|sample| sample.stamp <= fix.stamp))
            .map(|fix| Anchor {
                stamp: fix.stamp,
                position: self.options.site.to_enu(fix.position),
                sigma_m: fix.sigma_enu_m.xy().amax().max(self.options.gate.sigma_floor_m),
            })
            .collect();
        let (first, last) = (fixes.first()?.stamp, fixes.last()?.stamp);
        let guess = self.guess(first, last)?;
        let gravity = &self.options.smoother.gravity;
        let Aligned { stamp, state, heading_sigma } =
            align(&self.samples, &fixes, &self.options.antenna_left, &guess, gravity)?;
        let ease = if self.known.is_some() { HEADING_EASE_KNOWN } else { 1.0 };
        if heading_sigma > ease * self.options.initialization.heading_sigma {
            return None;
        }
        // The readings since are used again by the smoother, so what they said here counts little.
        let heading_prior = (3.0 * heading_sigma).max(0.05);
        let gyro_bias_sigma = match (&self.level, &self.known) {
            (Some(level), _) => level.gyro_bias_sigma.max(5.0e-4),
            (None, Some(known)) => known.gyro_bias_sigma(stamp, &self.options),
            (None, None) => self.options.initialization.gyro_bias_sigma,
        };
        let base_gyro_bias = self.known.as_ref().map_or(0.0, |known| known.state.base_gyro_bias);
        let state = NavState { base_gyro_bias, ..state };
        let tilt_sigma = if self.level.is_some() { 0.03 } else { 0.1 };
        let rotation_sigma = Vec3::new(tilt_sigma, tilt_sigma, heading_prior);
        let information = self.information(&state, &rotation_sigma, 0.3, 0.5, gyro_bias_sigma);
        Some(self.start(stamp, state, information, "motion", heading_sigma))
    }

    fn guess(&self, first: Stamp, last: Stamp) -> Option<Guess> {
        let init = &self.options.initialization;
        let Some(level) = &self.level else {
            let known = self.known.as_ref();
            if last - first < known.map_or(TRACK_MIN, |_| TRACK_MIN_KNOWN) {
                return None;
            }
            let [gyro_bias, accel_bias] =
                known.map_or([Vec3::zeros(); 2], |known| [known.state.gyro_bias, known.state.accel_bias]);
            return Some(Guess {
                rotation: level_from_mean_force(&self.samples, first, last, &gyro_bias, &accel_bias)?,
                gyro_bias,
                accel_bias,
                acceleration_sigma: 1.0,
                gyro_bias_sigma: known
                    .map_or(init.gyro_bias_sigma, |known| known.gyro_bias_sigma(first, &self.options)),
            });
        };
        let turned = |from: Stamp, to: Stamp| -> Option<So3> {
            let steps = self.samples.steps(from, to)?;
            Some(steps.fold(So3::identity(), |turn, step| {
                turn.plus(&((step.angular_rate - level.gyro_bias) * step.span_s))
            }))
        };
        let rotation = if level.stamp <= first {
            level.rotation * turned(level.stamp, first)?
        } else {
            level.rotation * turned(first, level.stamp)?.inverse()
        };
        Some(Guess {
            rotation: without_heading(&rotation),
            gyro_bias: level.gyro_bias,
            accel_bias: level.accel_bias,
            acceleration_sigma: 0.05 + init.accel_bias_sigma,
            gyro_bias_sigma: level.gyro_bias_sigma,
        })
    }

    fn start(
        &self,
        stamp: Stamp,
        state: NavState,
        information: StateMatrix,
        heading_from: &'static str,
        heading_sigma: f64,
    ) -> Start {
        let mut readings: Vec<Reading> = Vec::new();
        readings.extend(self.left.iter().copied().map(Reading::GnssLeft));
        readings.extend(self.right.iter().copied().map(Reading::GnssRight));
        readings.extend(self.lidar.iter().copied().map(Reading::LidarOdometry));
        readings.retain(|reading| reading.stamp() >= stamp);
        readings.sort_by_key(|reading| (reading.stamp(), reading.sensor()));
        let samples = self.samples.iter().copied().collect();
        Start { stamp, state, information, heading_from, heading_sigma, fixes_agree: true, samples, readings }
    }
}
