//! One method on one simulated machine, and everything that is measured of it.
//!
//! Estimates are judged as they are published, at their stamps, against the exact truth. From the first moment without
//! good GNSS to the last is the outage; the first seconds after the start and after an outage are left out of the
//! figures with good GNSS. The yardstick of an outage is the sum of the lidar's increments with the true heading and the
//! true standstill: what lidar odometry could do at best, alone.

mod antenna;
mod errors;
mod standing;

use antenna::Antenna;
pub use errors::{Errors, Series, bounds_of};
use standing::{Standing, Yardstick};

use crate::baselines::Kind;
use crate::estimator::Method;
use crate::lie::Vec3;
use crate::replay::Times;
use crate::sensors::{Reading, Sensor};
use crate::simulate::{Scenario, Simulation, Truth};
use crate::state::{Estimate, Mode};
use crate::time::Stamp;

/// The estimate has settled after its start, s.
const STARTED_S: f64 = 12.0;
/// Trust comes back half a second after the last bad fix; after so long it must have, s.
const RETURNED_S: f64 = 1.0;
/// A correction within so long after an outage is its end, s.
const END_OF_OUTAGE_S: f64 = 12.0;
/// Between two points of a trace, s.
const TRACE_STEP_S: f64 = 0.1;

/// What to run.
#[derive(Clone, Copy, Debug)]
pub struct Setup {
    /// The method.
    pub kind: Kind,
    /// The machine's place in the scenario.
    pub machine: usize,
    /// The method gets no lidar.
    pub without_lidar: bool,
    /// It gets nothing of the chassis' IMU.
    pub without_base_imu: bool,
    /// Keep traces and series over time.
    pub traced: bool,
    /// Readings after it are not taken, s.
    pub end_s: Option<f64>,
}

impl Setup {
    /// The whole scenario, without traces.
    pub fn new(kind: Kind, machine: usize) -> Self {
        Self { kind, machine, without_lidar: false, without_base_imu: false, traced: false, end_s: None }
    }
}

/// One point of a trace.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// s.
    pub time_s: f64,
    /// The IMU in the world, m.
    pub estimate: Vec3,
    /// The same in truth, m.
    pub truth: Vec3,
    /// Turn about the vertical, degrees.
    pub heading_error_deg: f64,
}

/// What one run amounts to.
#[derive(Clone, Debug, Default)]
pub struct Trial {
    /// With good GNSS.
    pub good: Errors,
    /// Without.
    pub outage: Errors,
    /// Chassis at rest, inside the outage, since its last motion.
    pub standing_drift_m: f64,
    /// The same from two seconds after its last motion on.
    pub settled_drift_m: f64,
    /// Of each rest of the chassis inside the outage: distance from the truth when it began and when it ended, m.
    pub rests_m: Vec<[f64; 2]>,
    /// RMSE of the yardstick in the outage.
    pub yardstick_m: f64,
    /// The same, but with the estimate's heading in place of the true one.
    pub yardstick_own_heading_m: f64,
    /// Of odom beyond the true motion, between two estimates.
    pub largest_odom_step_m: f64,
    /// Of odom beyond the true motion, between two estimates, rad.
    pub largest_odom_turn: f64,
    /// How far the newest position was moved by each update, cm.
    pub correction_cm: Vec<f64>,
    /// The largest of them when fixes came back after the outage.
    pub return_jump_m: f64,
    /// GNSS good: how far the antenna's motion from one fix to the next is off the true one, cm.
    pub motion_cm: Vec<f64>,
    /// And off the motion that the fixes themselves show, along each axis, cm.
    pub motion_to_fixes_cm: Vec<f64>,
    /// GNSS good: squared innovations of the left antenna's fixes over their covariances, by their degrees of freedom.
    pub innovation: Series,
    /// From a reading to its estimate, by the caller's clock; of those that led to one.
    pub predict: Times,
    /// From a reading to the update that it led to.
    pub update: Times,
    /// Ten points a second, if traced.
    pub trace: Vec<Point>,
    /// Time (s) and size (cm) of each correction, if traced.
    pub corrections: Vec<(f64, f64)>,
}

/// First and last moment without good GNSS, s; nothing if it is good all the time.
pub fn outage_of(scenario: &Scenario) -> Option<[f64; 2]> {
    let conditions = &scenario.file.gnss_condition;
    let first = conditions.iter().map(|condition| condition.start_s).fold(f64::INFINITY, f64::min);
    let last = conditions.iter().map(|condition| condition.end_s).fold(f64::NEG_INFINITY, f64::max);
    (first <= last).then_some([first, last])
}

/// Runs a method; `clock` gives nanoseconds from any epoch.
///
/// # Panics
/// If the scenario has no machine at that place.
pub fn run(scenario: &Scenario, setup: Setup, mut clock: impl FnMut() -> u64) -> Trial {
    let mut simulation = Simulation::new(scenario, setup.machine);
    if let Some(end_s) = setup.end_s {
        simulation = simulation.ending_at(Stamp::from_seconds(end_s));
    }
    let options = simulation.machine().estimator_options();
    let lever_arm = options.antenna_left;
    let site = options.site;
    let imu_from_lidar = *options.imu_from_lidar.motion();
    let mut method = setup.kind.estimator(options);
    let mut judge = Judge::new(scenario, setup);
    while let Some(arrival) = simulation.next() {
        if let Reading::LidarOdometry(pose) = arrival.reading {
            judge
                .yardstick
                .note(&pose, &imu_from_lidar, judge.heading_error, |stamp| simulation.truth(stamp));
            if setup.without_lidar {
                continue;
            }
        }
        if setup.without_base_imu && arrival.reading.sensor() == Sensor::BaseImu {
            continue;
        }
        let before = clock();
        let estimate = method.predict(&arrival);
        let predicted = clock();
        let correction = method.update(&arrival);
        let updated = clock();
        if estimate.is_some() {
            judge.trial.predict.note(predicted.saturating_sub(before));
        }
        if let Some(correction) = correction {
            judge.trial.update.note(updated.saturating_sub(predicted));
            judge.note_correction(arrival.arrival, correction.correction_m);
        }
        if let Reading::GnssLeft(fix) = &arrival.reading {
            judge.antenna.note_fix(fix, site.to_enu(fix.position));
        }
        if let Some(estimate) = estimate {
            let truth = simulation.truth(estimate.stamp);
            judge.antenna.note(&estimate, &truth, &lever_arm);
            judge.note(&estimate, &truth);
        }
        judge.take_motions();
        method.take_events();
    }
    judge.finish()
}

/// Looks at the estimates of a run.
struct Judge {
    trial: Trial,
    traced: bool,
    /// First and last moment without good GNSS.
    outage: Option<[Stamp; 2]>,
    antenna: Antenna,
    standing: Standing,
    yardstick: Yardstick,
    /// Of the newest estimate, rad.
    heading_error: f64,
    previous: Option<(Estimate, Truth)>,
    traced_until_s: f64,
}

impl Judge {
    fn new(scenario: &Scenario, setup: Setup) -> Self {
        let outage = outage_of(scenario).map(|ends| ends.map(Stamp::from_seconds));
        Self {
            trial: Trial::default(),
            traced: setup.traced,
            outage,
            antenna: Antenna::default(),
            standing: Standing::default(),
            yardstick: Yardstick::new(outage),
            heading_error: 0.0,
            previous: None,
            traced_until_s: f64::NEG_INFINITY,
        }
    }

    /// Fixes are good, and the estimate has had time to settle on them.
    fn is_good(&self, stamp: Stamp) -> bool {
        let settled = |end: Stamp| stamp.seconds_since(end) > RETURNED_S;
        let outside = self.outage.is_none_or(|[begin, end]| stamp < begin || settled(end));
        stamp > Stamp::from_seconds(STARTED_S) && outside
    }

    fn note(&mut self, estimate: &Estimate, truth: &Truth) {
        let error = estimate.state.position - truth.state.position;
        self.heading_error = (estimate.state.rotation * truth.state.rotation.inverse()).log().z;
        let within = |[begin, end]: [Stamp; 2]| estimate.stamp > begin && estimate.stamp < end;
        if self.outage.is_some_and(within) {
            self.trial.outage.note(estimate, truth);
            if truth.base.velocity.norm() > 1e-6 {
                let rest = std::mem::take(&mut self.standing).distances_m();
                self.trial.rests_m.extend(rest);
            } else if estimate.mode != Mode::Main {
                let [drift_m, settled_m] = self.standing.drift_m(estimate.stamp, &error);
                self.trial.standing_drift_m = self.trial.standing_drift_m.max(drift_m);
                self.trial.settled_drift_m = self.trial.settled_drift_m.max(settled_m);
            }
        } else if self.is_good(estimate.stamp) {
            self.trial.good.note(estimate, truth);
        }
        if let Some((before, truth_before)) = &self.previous {
            let seen = before.odom_from_imu.motion().inverse() * *estimate.odom_from_imu.motion();
            let real = truth_before.imu.pose.inverse() * truth.imu.pose;
            let step = real.inverse() * seen;
            let trial = &mut self.trial;
            trial.largest_odom_step_m = trial.largest_odom_step_m.max(step.translation.norm());
            trial.largest_odom_turn = trial.largest_odom_turn.max(step.rotation.log().norm());
        }
        self.trace(estimate, truth);
        self.previous = Some((*estimate, *truth));
    }

    fn trace(&mut self, estimate: &Estimate, truth: &Truth) {
        let time_s = estimate.stamp.as_seconds();
        if !self.traced || time_s < self.traced_until_s {
            return;
        }
        self.traced_until_s = time_s + TRACE_STEP_S - 1e-3;
        let turn = (estimate.state.rotation * truth.state.rotation.inverse()).log();
        self.trial.trace.push(Point {
            time_s,
            estimate: estimate.state.position,
            truth: truth.state.position,
            heading_error_deg: turn.z.to_degrees(),
        });
    }

    fn note_correction(&mut self, now: Stamp, correction_m: Option<f64>) {
        let Some(correction_m) = correction_m else { return };
        self.trial.correction_cm.push(100.0 * correction_m);
        if self.traced {
            self.trial.corrections.push((now.as_seconds(), 100.0 * correction_m));
        }
        let returns = |[_, end]: [Stamp; 2]| now > end && now.seconds_since(end) < END_OF_OUTAGE_S;
        if self.outage.is_some_and(returns) {
            self.trial.return_jump_m = self.trial.return_jump_m.max(correction_m);
        }
    }

    /// The motions between fixes that the estimates have come past.
    fn take_motions(&mut self) {
        while let Some(passed) = self.antenna.next() {
            if !self.is_good(passed.stamp) {
                continue;
            }
            self.trial.innovation.note(passed.stamp, passed.squared_innovation / 3.0);
            let Some([moved, truly, seen]) = passed.moved else { continue };
            self.trial.motion_cm.push(100.0 * (moved - truly).norm());
            self.trial.motion_to_fixes_cm.extend((moved - seen).iter().map(|off_m| 100.0 * off_m));
        }
    }

    fn finish(mut self) -> Trial {
        self.trial.rests_m.extend(self.standing.distances_m());
        [self.trial.yardstick_m, self.trial.yardstick_own_heading_m] = self.yardstick.rmse_m();
        self.trial
    }
}
