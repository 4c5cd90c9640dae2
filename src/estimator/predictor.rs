//! The fast half: every IMU sample becomes an estimate, in microseconds.
//!
//! The newest solution is carried along by the IMU. When a new one comes, the samples since its stamp are
//! integrated anew from it. The odom frame takes only the increments of the motion, so a new solution moves
//! `world_from_odom` and never steps `odom_from_imu`. In the steady state nothing is allocated and nothing is
//! freed here: a solution stays its owner's, who can use its memory again.

use std::hint::black_box;

use super::inbox::{Admission, Inbox};
use super::options::Options;
use super::{Correction, IMU_GAP_MAX, Solution};
use crate::frames::{Base, Cabin, Imu, Odom, Pose};
use crate::lie::{Se3, So3, Vec3};
use crate::preintegration::{Preintegration, SampleBuffer, Step, propagate};
use crate::sensors::{Arrival, CabinTurn, ImuSample, Reading, Sensor};
use crate::smoother::predict_covariance;
use crate::state::{BaseState, Estimate, NavState, StateMatrix};
use crate::time::{Span, Stamp};

/// Without solutions, samples are kept this long at most.
const SAMPLES_KEPT: Span = Span::from_millis(10_000);
/// Odom's roll and pitch follow the world's at most so fast, rad/s: 0.5°/s, 0.005° a sample at 100 Hz.
const LEVELLING_RATE: f64 = 0.0087;
/// Length of the step that is rehearsed; any will do.
const REHEARSED_STEP: Span = Span::from_millis(10);
/// A corrected velocity reaches odom at most so fast, m/s²: 5 mm/s a sample at 100 Hz, far below what the machine
/// does itself.
const BLENDING_RATE: f64 = 0.5;
/// The covariance is brought forward every so many samples.
const COVARIANCE_EVERY: u32 = 10;
/// The cabin turn is extrapolated so far at most.
const TURN_AGE_MAX: Span = Span::from_millis(500);
/// The turn's rate is the mean over this long.
const TURN_RATE_SPAN: Span = Span::from_millis(100);

/// The fast half of the estimator; see [`super::split`].
pub struct Predictor {
    options: Options,
    inbox: Inbox,
    samples: SampleBuffer,
    track: Option<Track>,
    /// Solutions are of no use until the updater has started anew.
    waits_for_restart: bool,
    odom_from_imu: Option<Pose<Odom, Imu>>,
    /// Velocity of odom less that of the solution, in the IMU frame, m/s.
    unblended: Vec3,
    turn: Option<Turn>,
    base_rate: Option<(Stamp, Vec3)>,
}

/// The solution and where the IMU has carried it.
struct Track {
    solution: Solution,
    state: NavState,
    covariance: StateMatrix,
    /// Since `solution`, for the covariance.
    motion: Preintegration,
    unsettled: Unsettled,
    samples_since_covariance: u32,
}

/// What is not in a track's motion yet: nobody needs it before the next estimate.
enum Unsettled {
    Nothing,
    /// The newest step.
    Step(Step),
    /// All steps since the solution, which has just been taken over: of several that follow each other between two
    /// samples, only the last is settled.
    Takeover,
}

/// The cabin turn and its rate.
#[derive(Clone, Copy, Debug)]
struct Turn {
    newest: CabinTurn,
    reference: CabinTurn,
    rate: f64,
}

impl Predictor {
    pub(super) fn new(options: Options) -> Self {
        Self {
            options,
            inbox: Inbox::default(),
            samples: SampleBuffer::default(),
            track: None,
            waits_for_restart: true,
            odom_from_imu: None,
            unblended: Vec3::zeros(),
            turn: None,
            base_rate: None,
        }
    }

    /// Takes any reading, in order of arrival. An IMU sample gives an estimate once there is a solution.
    pub fn push(&mut self, arrival: &Arrival) -> Option<Estimate> {
        let previous_imu = self.inbox.newest(Sensor::Imu);
        match self.inbox.admit(arrival) {
            Admission::Accepted => {}
            Admission::Refused(_) => return None,
            Admission::ClockReset(_) => {
                if arrival.reading.sensor() == Sensor::Imu {
                    self.forget();
                }
                return None;
            }
        }
        match &arrival.reading {
            Reading::Imu(sample) => {
                if previous_imu.is_some_and(|previous| sample.stamp - previous > IMU_GAP_MAX) {
                    self.forget();
                }
                self.push_sample(sample)
            }
            Reading::CabinTurn(turn) => {
                self.turn = Some(Turn::follow(self.turn, *turn));
                None
            }
            Reading::BaseImu(sample) => {
                let rate = self.options.base_from_base_imu.rotation() * sample.angular_rate;
                self.base_rate = Some((sample.stamp, rate));
                None
            }
            Reading::GnssLeft(_) | Reading::GnssRight(_) | Reading::LidarOdometry(_) => None,
        }
    }

    /// The clock or the IMU has jumped: no estimate until the next solution. Odom stays where it is.
    fn forget(&mut self) {
        self.waits_for_restart = true;
        self.samples.clear();
        self.track = None;
        self.turn = None;
        self.base_rate = None;
    }

    fn push_sample(&mut self, sample: &ImuSample) -> Option<Estimate> {
        self.settle();
        let previous = self.samples.newest().copied();
        self.samples.push(*sample);
        self.samples.forget_before(sample.stamp - SAMPLES_KEPT);
        self.track.as_ref()?;
        let step = Step::between(&previous?, sample);
        let estimate = self.step(&step, sample);
        if let (Some(estimate), Some(track)) = (&estimate, &mut self.track) {
            track.state = estimate.state;
            track.unsettled = Unsettled::Step(step);
            self.odom_from_imu = Some(estimate.odom_from_imu);
            self.unblended = blended(&self.unblended, step.span_s);
        }
        estimate
    }

    /// The estimate that a step leads to; nothing is changed. Not inlined, so that [`Predictor::rehearse`] runs
    /// the very code that the next sample will.
    #[inline(never)]
    fn step(&self, step: &Step, sample: &ImuSample) -> Option<Estimate> {
        let track = self.track.as_ref()?;
        let before = &track.state;
        let state = propagate(before, step, &self.options.smoother.gravity);
        let mut increment = relative(before, &state);
        increment.translation += blended(&self.unblended, step.span_s) * step.span_s;
        let odom = self.odom_from_imu.unwrap_or_else(|| first_odom(before));
        let odom_from_imu = levelled(&Pose::assume(*odom.motion() * increment), &state, step.span_s);
        Some(Estimate {
            stamp: sample.stamp,
            state,
            angular_rate_in_imu: sample.angular_rate - state.gyro_bias,
            odom_from_imu,
            world_from_odom: state.world_from_imu() * odom_from_imu.inverse(),
            base: self.base(sample, &state, &odom_from_imu),
            covariance: track.covariance,
            mode: track.solution.mode,
        })
    }

    /// Works out an estimate as if the newest sample came again, and forgets it: code and data that the next
    /// sample needs are then in the caches, from which ten milliseconds of other work drive them out. For shells,
    /// shortly before a sample is due. Changes nothing.
    pub fn rehearse(&self) {
        let Some(newest) = self.samples.newest() else { return };
        let sample = ImuSample { stamp: newest.stamp + REHEARSED_STEP, ..*newest };
        let arrived = self.inbox.newest_arrival(Sensor::Imu).unwrap_or_default() + REHEARSED_STEP;
        let arrival = Arrival { arrival: arrived, reading: Reading::Imu(sample) };
        black_box(self.inbox.judge(black_box(&arrival)).is_ok());
        let step = Step::between(newest, &sample);
        black_box(self.step(black_box(&step), &sample));
    }

    /// Does what can wait until an estimate is out or a solution is taken over: brings the covariance forward.
    /// [`Predictor::push`] does it first if nobody has; the estimates are the same to the bit.
    pub fn settle(&mut self) {
        if let Some(track) = &mut self.track {
            track.settle(&self.samples, &self.options);
        }
    }

    /// Takes over a solution, between two samples: integrates the samples since its stamp from it. What this
    /// makes of its covariance is worked out by [`Predictor::settle`].
    pub fn adopt(&mut self, solution: &Solution) {
        if self.waits_for_restart && !solution.restart {
            // Of before a jump of the clock or a gap: the updater will start anew.
            return;
        }
        // Also if it comes too late to be carried on: one of those that follow will not.
        self.waits_for_restart = false;
        let Some(newest) = self.samples.newest().map(|sample| sample.stamp) else { return };
        let Some(steps) = self.samples.steps(solution.stamp, newest) else { return };
        let start = &solution.state;
        let state =
            steps.fold(*start, |state, step| propagate(&state, &step, &self.options.smoother.gravity));
        self.samples.forget_before(solution.stamp);
        if let Some(before) = self.track.as_ref().filter(|_| !solution.restart) {
            self.unblended += velocity_in_imu(&before.state) - velocity_in_imu(&state);
        } else {
            self.unblended = Vec3::zeros();
        }
        self.track = Some(Track {
            solution: solution.clone(),
            state,
            covariance: solution.covariance,
            motion: Preintegration::new(start.gyro_bias, start.accel_bias),
            unsettled: Unsettled::Takeover,
            samples_since_covariance: 0,
        });
    }

    /// [`Predictor::adopt`], and how far it moved the position.
    pub fn adopt_measured(&mut self, solution: &Solution) -> Correction {
        let restart = solution.restart;
        let position = |predictor: &Self| predictor.track.as_ref().map(|track| track.state.position);
        let before = position(self);
        self.adopt(solution);
        let correction_m = match (before, position(self)) {
            (Some(before), Some(after)) if !restart => Some((after - before).norm()),
            _ => None,
        };
        Correction { correction_m }
    }

    /// The chassis, by the cabin turn at the sample's stamp.
    fn base(
        &self,
        sample: &ImuSample,
        state: &NavState,
        odom_from_imu: &Pose<Odom, Imu>,
    ) -> Option<BaseState> {
        let turn = self.turn.as_ref()?;
        let angle = turn.at(sample.stamp)?;
        let turned: Pose<Base, Base> = Pose::assume(Se3::new(So3::about(&Vec3::z(), angle), Vec3::zeros()));
        let base_from_cabin: Pose<Base, Cabin> = turned * self.options.base_from_cabin;
        let imu_from_base: Pose<Imu, Base> = self.options.imu_from_cabin * base_from_cabin.inverse();
        let base_from_imu = imu_from_base.inverse().rotation();
        let imu_rate = sample.angular_rate - state.gyro_bias;
        let fresh = |stamp: Stamp| sample.stamp - stamp <= TURN_AGE_MAX;
        // The chassis' own gyroscope where it is fresh; else the cabin's less the turn.
        let angular_rate_in_base = match self.base_rate {
            Some((stamp, rate)) if fresh(stamp) => rate,
            _ => base_from_imu * imu_rate - Vec3::z() * turn.rate,
        };
        // The chassis' origin lies on the turn's axis: as a point of the cabin it moves like one of the chassis.
        let velocity_in_imu =
            state.rotation.inverse() * state.velocity + imu_rate.cross(&imu_from_base.translation());
        Some(BaseState {
            odom_from_base: *odom_from_imu * imu_from_base,
            velocity_in_base: base_from_imu * velocity_in_imu,
            angular_rate_in_base,
        })
    }
}

impl Track {
    fn settle(&mut self, samples: &SampleBuffer, options: &Options) {
        let noise = &options.smoother.noise;
        match std::mem::replace(&mut self.unsettled, Unsettled::Nothing) {
            Unsettled::Nothing => return,
            Unsettled::Step(step) => {
                self.motion.add(&step, noise);
                self.samples_since_covariance += 1;
                if self.samples_since_covariance < COVARIANCE_EVERY {
                    return;
                }
            }
            Unsettled::Takeover => {
                let steps =
                    samples.newest().and_then(|newest| samples.steps(self.solution.stamp, newest.stamp));
                steps.into_iter().flatten().for_each(|step| self.motion.add(&step, noise));
            }
        }
        self.samples_since_covariance = 0;
        let Solution { state, covariance, .. } = &self.solution;
        self.covariance = predict_covariance(&self.motion, state, covariance, noise);
    }
}

impl Turn {
    fn follow(before: Option<Turn>, newest: CabinTurn) -> Self {
        let Some(before) = before else { return Self { newest, reference: newest, rate: 0.0 } };
        let span = newest.stamp - before.reference.stamp;
        if span < TURN_RATE_SPAN {
            return Self { newest, ..before };
        }
        let rate = (newest.angle_rad - before.reference.angle_rad) / span.as_seconds();
        Self { newest, reference: newest, rate }
    }

    fn at(&self, stamp: Stamp) -> Option<f64> {
        let age = stamp - self.newest.stamp;
        (age <= TURN_AGE_MAX).then(|| self.newest.angle_rad + self.rate * age.as_seconds())
    }
}

fn relative(before: &NavState, after: &NavState) -> Se3 {
    Se3::new(before.rotation, before.position).inverse() * Se3::new(after.rotation, after.position)
}

fn velocity_in_imu(state: &NavState) -> Vec3 {
    state.rotation.inverse() * state.velocity
}

/// What is left of a difference of velocities after a step of `span_s`.
fn blended(unblended: &Vec3, span_s: f64) -> Vec3 {
    let (size, limit) = (unblended.norm(), BLENDING_RATE * span_s);
    if size > limit { unblended * (1.0 - limit / size) } else { Vec3::zeros() }
}

/// Odom begins where the estimate does, with the world's directions.
fn first_odom(state: &NavState) -> Pose<Odom, Imu> {
    Pose::assume(Se3::new(state.rotation, Vec3::zeros()))
}

/// Turns odom's attitude about the IMU so that its up goes towards the world's, at a bounded rate; heading
/// and position stay.
fn levelled(odom_from_imu: &Pose<Odom, Imu>, state: &NavState, span_s: f64) -> Pose<Odom, Imu> {
    let up_in_imu = state.rotation.inverse() * Vec3::z();
    let up_in_odom = odom_from_imu.rotation() * up_in_imu;
    let error = up_in_odom.cross(&Vec3::z());
    let (angle, limit) = (error.norm(), LEVELLING_RATE * span_s);
    let turn = if angle > limit { error * (limit / angle) } else { error };
    let rotation = (So3::exp(&turn) * odom_from_imu.rotation()).renormalized();
    Pose::assume(Se3::new(rotation, odom_from_imu.translation()))
}
