//! Chassis standstill: while the tracks stand, the chassis stays where it is, however the cabin turns.
//!
//! Found from the chassis IMU: it is quiet, and its accelerometer, integrated against its own mean, gains no speed;
//! confirmed by the estimate, whose chassis does not move.
//! From time to time two nodes of one standstill are tied: world_from_base is the same at both, so
//! imu_i_from_imu_j = X(θ_i) X(θ_j)⁻¹ with X(θ) = `imu_from_base` at the encoder's angle θ. An offset of the
//! encoder cancels, its noise does not add up from tie to tie, and during an outage neither position nor heading
//! drifts while the chassis stands.
//!
//! A machine without chassis IMU is watched by its cabin IMU, which stands only if all of it does: then X = 1, and
//! the ties are what others call zero-velocity updates, without the drift that those leave.

use std::collections::VecDeque;

use super::chassis_turn;
use super::options::Options;
use crate::frames::{Base, Cabin, Imu, Pose};
use crate::lie::{Se3, So3, Vec3};
use crate::sensors::{CabinTurn, ImuSample};
use crate::state::NavState;
use crate::time::{Span, Stamp};

/// The chassis IMU is looked at over this window, cut into blocks.
const WINDOW: Span = Span::from_millis(600);
const BLOCKS: usize = 3;
/// And at every so many samples.
const LOOK_EVERY: u64 = 10;
/// Mean angular rate of a chassis at rest: at most the bias of its gyroscope, rad/s.
const RATE_MAX: f64 = 0.015;
/// Means of the blocks differ by so little at rest: rad/s, m/s².
const WOBBLE: [f64; 2] = [0.003, 0.08];
/// A chassis whose gyroscope at rest is known turns if it reads so much else: rad/s. That is how legs that level it
/// show, which start more gently than an accelerometer tells.
const TURNING_MIN: f64 = 0.0015;
/// What it reads at rest is followed over so long, s, and forgotten after so long.
const REST_FOLLOWS_S: f64 = 5.0;
const REST_FORGOTTEN: Span = Span::from_millis(600_000);
/// The accelerometer's mean at rest is taken over so long, before it is integrated against.
const REFERENCE_S: f64 = 1.0;
/// After so long of it a stop is believed.
const BELIEVED_S: f64 = 0.4;
/// Speed against that mean at which the chassis moves, m/s: above the engine's 0.5 m/s² at 25 Hz, integrated.
const SPEED_GAINED_MAX: f64 = 0.02;
/// The integral forgets, and the mean follows the truth, with these time constants, s.
const SPEED_FORGETS_S: f64 = 4.0;
const REFERENCE_FOLLOWS_S: f64 = 20.0;
/// A motion that begins slowly shows only after so long.
const CERTAIN_AFTER: Span = Span::from_millis(400);
/// The estimate's chassis moves slower than this at rest, m/s.
const SPEED_MAX: f64 = 0.04;
/// Between encoder readings further apart, nobody knows the turn, s.
const READINGS_APART_MAX_S: f64 = 0.25;
/// Between two ties.
pub(super) const TIE_EVERY: Span = Span::from_millis(1_000);
/// The first tie of a standstill spans so much: until it is there, the machine drifts as if it were driving.
pub(super) const FIRST_TIE: Span = Span::from_millis(300);
/// One sigma of a standstill's first tie: rad (the encoder's steps and play), m (rocking of the chassis).
const TIE_SIGMA: [f64; 2] = [3.0e-4, 1.0e-3];
/// The errors of a chain of ties telescope: however long it is, only those of its ends remain. Independent factors
/// add up, so the n-th tie has the first one's sigma over n, down to that over this: what adds up from there on is
/// 0.125 mm and 0.002° in a second, a millimetre and 0.02° in a minute, and stands for a chassis that settles.
const TIES_COUNTED_MAX: u32 = 8;

/// How still a machine's IMU is at rest.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stillness {
    /// Blocks' means differ by so little: rad/s, m/s².
    wobble: [f64; 2],
    /// rad/s.
    turning_min: f64,
    /// m/s.
    speed_gained_max: f64,
}

impl Stillness {
    /// For an IMU of these white-noise densities (rad/s/√Hz, m/s²/√Hz).
    pub fn of(gyroscope_density: f64, accelerometer_density: f64) -> Self {
        let block_root_s = (WINDOW.as_seconds() / BLOCKS as f64).sqrt();
        Self {
            wobble: [
                WOBBLE[0] + 4.0 * gyroscope_density / block_root_s,
                WOBBLE[1] + 4.0 * accelerometer_density / block_root_s,
            ],
            turning_min: TURNING_MIN + 4.0 * gyroscope_density / WINDOW.as_seconds().sqrt(),
            speed_gained_max: SPEED_GAINED_MAX + 4.0 * accelerometer_density * (0.5 * SPEED_FORGETS_S).sqrt(),
        }
    }
}

/// Watches the chassis.
#[derive(Debug)]
pub(super) struct Standstill {
    stillness: Stillness,
    samples: VecDeque<ImuSample>,
    pushed: u64,
    /// The chassis has been quiet since and until.
    quiet: Option<(Stamp, Stamp)>,
    /// Since the chassis has been quiet.
    speed: Option<Speed>,
    /// What the gyroscope reads at rest, and when that was.
    rest_rate: Option<(Stamp, Vec3)>,
    turns: VecDeque<CabinTurn>,
    /// The newer node of the newest tie of this standstill.
    pub tied: Option<Stamp>,
    /// Ties of this standstill.
    ties: u32,
}

/// The speed that the chassis IMU says it has gained.
#[derive(Clone, Copy, Debug)]
struct Speed {
    stamp: Stamp,
    learned_s: f64,
    reference: Vec3,
    gained: Vec3,
}

impl Speed {
    /// Follows a sample; whether the chassis can still be at rest.
    fn follow(&mut self, sample: &ImuSample, speed_gained_max: f64) -> bool {
        let dt = sample.stamp.seconds_since(self.stamp);
        self.stamp = sample.stamp;
        let off = sample.specific_force - self.reference;
        if self.learned_s < REFERENCE_S {
            self.learned_s += dt;
            self.reference += off * (dt / self.learned_s).min(1.0);
            return true;
        }
        self.gained += off * dt - self.gained * (dt / SPEED_FORGETS_S);
        self.reference += off * (dt / REFERENCE_FOLLOWS_S);
        self.gained.norm() < speed_gained_max
    }
}

impl Standstill {
    pub fn new(stillness: Stillness) -> Self {
        Self {
            stillness,
            samples: VecDeque::new(),
            pushed: 0,
            quiet: None,
            speed: None,
            rest_rate: None,
            turns: VecDeque::new(),
            tied: None,
            ties: 0,
        }
    }

    pub fn push_turn(&mut self, turn: CabinTurn) {
        if self.turns.back().is_some_and(|newest| newest.stamp >= turn.stamp) {
            self.turns.clear();
        }
        self.turns.push_back(turn);
        while self.turns.front().is_some_and(|oldest| turn.stamp - oldest.stamp > chassis_turn::KEPT) {
            self.turns.pop_front();
        }
    }

    pub fn push_sample(&mut self, sample: ImuSample) {
        let follows =
            |newest: &ImuSample| sample.stamp > newest.stamp && sample.stamp - newest.stamp <= WINDOW;
        if self.samples.back().is_some_and(|newest| !follows(newest)) {
            self.samples.clear();
            self.end();
        }
        self.samples.push_back(sample);
        while self.samples.front().is_some_and(|oldest| sample.stamp - oldest.stamp > WINDOW) {
            self.samples.pop_front();
        }
        let limit = self.stillness.speed_gained_max;
        if self.speed.as_mut().is_some_and(|speed| !speed.follow(&sample, limit)) {
            self.end();
        }
        self.pushed += 1;
        if self.pushed.is_multiple_of(LOOK_EVERY) {
            self.look(sample.stamp);
        }
    }

    /// The standstill is over, or was none.
    pub fn end(&mut self) {
        self.quiet = None;
        self.speed = None;
        self.tied = None;
        self.ties = 0;
    }

    fn look(&mut self, now: Stamp) {
        let rest_rate = self.rest_rate.filter(|(stamp, _)| now - *stamp < REST_FORGOTTEN);
        let turning_min = self.stillness.turning_min;
        let turns = |rate: &Vec3| rest_rate.is_some_and(|(_, rest)| (rate - rest).norm() > turning_min);
        let Some(rate) = self.quiet_rate().filter(|rate| !turns(rate)) else {
            self.end();
            return;
        };
        if self.tied.is_some() {
            let elapsed_s = rest_rate.map_or(0.0, |(stamp, _)| now.seconds_since(stamp).min(1.0));
            let rest =
                rest_rate.map_or(rate, |(_, rest)| rest + (rate - rest) * (elapsed_s / REST_FOLLOWS_S));
            self.rest_rate = Some((now, rest));
        }
        let begin = self.samples.front().map_or(now, |sample| sample.stamp);
        let since = self.quiet.map_or(begin, |(since, _)| since);
        self.quiet = Some((since, now));
        self.speed.get_or_insert(Speed {
            stamp: now,
            learned_s: 0.0,
            reference: Vec3::zeros(),
            gained: Vec3::zeros(),
        });
    }

    /// Mean angular rate of a window that is quiet.
    fn quiet_rate(&self) -> Option<Vec3> {
        let covers = match (self.samples.front(), self.samples.back()) {
            (Some(oldest), Some(newest)) => {
                (newest.stamp - oldest.stamp).as_seconds() > 0.9 * WINDOW.as_seconds()
            }
            _ => false,
        };
        if !covers || self.samples.len() < 6 * BLOCKS {
            return None;
        }
        let size = self.samples.len() / BLOCKS;
        let means: [(Vec3, Vec3); BLOCKS] = std::array::from_fn(|block| {
            let samples = self.samples.range(block * size..(block + 1) * size);
            let sum = samples.fold((Vec3::zeros(), Vec3::zeros()), |(rate, force), sample| {
                (rate + sample.angular_rate, force + sample.specific_force)
            });
            (sum.0 / size as f64, sum.1 / size as f64)
        });
        let rate = means.iter().map(|(rate, _)| rate).sum::<Vec3>() / BLOCKS as f64;
        let force = means.iter().map(|(_, force)| force).sum::<Vec3>() / BLOCKS as f64;
        let wobble = self.stillness.wobble;
        let quiet = rate.norm() < RATE_MAX
            && means.iter().all(|(block_rate, block_force)| {
                (block_rate - rate).amax() < wobble[0] && (block_force - force).amax() < wobble[1]
            });
        quiet.then_some(rate)
    }

    /// Since when and until when the chassis has certainly been quiet.
    pub fn certain(&self) -> Option<(Stamp, Stamp)> {
        let (since, until) = self.quiet?;
        if self.speed.is_none_or(|speed| speed.learned_s < BELIEVED_S) {
            return None;
        }
        let (since, until) = (since + CERTAIN_AFTER, until - CERTAIN_AFTER);
        (until > since).then_some((since, until))
    }

    /// A tie was made up to this node.
    pub fn note_tie(&mut self, to: Stamp) {
        self.tied = Some(to);
        self.ties += 1;
    }

    /// One sigma of the next tie: rad, m.
    pub fn tie_sigma(&self) -> [f64; 2] {
        TIE_SIGMA.map(|sigma| sigma / f64::from((self.ties + 1).min(TIES_COUNTED_MAX)))
    }

    /// Stamp of the newest reading of the encoder.
    pub fn newest_turn(&self) -> Option<Stamp> {
        self.turns.back().map(|turn| turn.stamp)
    }

    /// Cabin turn (rad) at a stamp between two readings of the encoder.
    pub fn turn_at(&self, stamp: Stamp) -> Option<f64> {
        let after = self.turns.partition_point(|turn| turn.stamp < stamp);
        let (left, right) = (self.turns.get(after.checked_sub(1)?)?, self.turns.get(after)?);
        let span = right.stamp.seconds_since(left.stamp);
        let weight = stamp.seconds_since(left.stamp) / span;
        (span <= READINGS_APART_MAX_S).then_some(left.angle_rad + weight * (right.angle_rad - left.angle_rad))
    }
}

/// X(θ): the chassis seen from the IMU at a cabin turn (rad).
pub(super) fn imu_from_base(options: &Options, angle: f64) -> Pose<Imu, Base> {
    let turned: Pose<Base, Base> = Pose::assume(Se3::new(So3::about(&Vec3::z(), angle), Vec3::zeros()));
    let base_from_cabin: Pose<Base, Cabin> = turned * options.base_from_cabin;
    options.imu_from_cabin * base_from_cabin.inverse()
}

/// Whether the estimate has the chassis at rest: its origin by the cabin's motion, as a point of the cabin.
pub(super) fn stands(state: &NavState, imu_rate: &Vec3, imu_from_base: &Pose<Imu, Base>) -> bool {
    let velocity = state.velocity + state.rotation * imu_rate.cross(&imu_from_base.translation());
    velocity.norm() < SPEED_MAX
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A chassis IMU with the engine running, tilted, biased; `speed` is the chassis' own over time.
    fn run(seconds: f64, speed: impl Fn(f64) -> f64) -> Vec<(f64, bool)> {
        let mut standstill = Standstill::new(Stillness::of(1.6e-4, 1.1e-3));
        (0..(seconds * 100.0) as i64)
            .map(|index| {
                let t = index as f64 * 0.01;
                let acceleration = (speed(t + 0.005) - speed(t - 0.005)) / 0.01;
                let engine = 0.4 * libm::sin(std::f64::consts::TAU * 24.3 * t);
                standstill.push_sample(ImuSample {
                    stamp: Stamp::from_nanos(index * 10_000_000),
                    angular_rate: Vec3::new(0.002, -0.003, 0.001),
                    specific_force: Vec3::new(0.21 + acceleration, 0.3 * engine, 9.78 + engine),
                });
                (t, standstill.certain().is_some())
            })
            .collect()
    }

    #[test]
    fn standing_chassis_is_found_with_the_engine_running() {
        let found = run(20.0, |_| 0.0);
        assert!(found.iter().filter(|(t, _)| *t > 3.0).all(|(_, standing)| *standing));
    }

    #[test]
    fn creeping_away_is_noticed_before_it_is_a_way() {
        // From rest to 5 cm/s within two seconds: 0.025 m/s².
        let speed = |t: f64| 0.05 * ((t - 8.0) / 2.0).clamp(0.0, 1.0);
        let found = run(12.0, speed);
        let noticed = found.iter().find(|(t, standing)| *t > 8.0 && !standing).expect("noticed").0;
        // Ties end 0.4 s before: up to there it has gone less than 1 cm.
        assert!(noticed < 9.3, "{noticed}");
    }

    #[test]
    fn clock_that_is_set_back_costs_a_second_and_no_more() {
        let mut standstill = Standstill::new(Stillness::of(1.6e-4, 1.1e-3));
        let mut rest = |from_s: i64, seconds: i64| {
            for index in 0..100 * seconds {
                standstill.push_sample(ImuSample {
                    stamp: Stamp::from_nanos(from_s * 1_000_000_000 + index * 10_000_000),
                    angular_rate: Vec3::zeros(),
                    specific_force: Vec3::new(0.0, 0.0, 9.81),
                });
            }
            (standstill.certain().is_some(), standstill.samples.len())
        };
        assert!(rest(3_600, 4).0);
        let (stands, kept) = rest(0, 4);
        assert!(stands && kept < 100, "{kept} samples");
    }

    #[test]
    fn turn_is_interpolated_between_readings_only() {
        let mut standstill = Standstill::new(Stillness::of(1.6e-4, 1.1e-3));
        for index in 0..20_i32 {
            let stamp = Stamp::from_nanos(i64::from(index) * 10_000_000);
            standstill.push_turn(CabinTurn { stamp, angle_rad: 0.5 * f64::from(index) * 0.01 });
        }
        let angle = standstill.turn_at(Stamp::from_nanos(104_000_000)).expect("between readings");
        assert!((angle - 0.052).abs() < 1e-12);
        assert!(standstill.turn_at(Stamp::from_nanos(191_000_000)).is_none());
    }
}
