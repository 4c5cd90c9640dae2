//! Runs with streams that fail, judged by the truth.

use holdfast::estimator::Estimator;
use holdfast::import::StampedPose;
use holdfast::sensors::{Arrival, Reading, Sensor};
use holdfast::state::{Estimate, Event, EventKind, Health, Mode, SensorHealth, row};
use holdfast::time::{Span, Stamp};

use crate::fixtures::{simulated, true_pose};

/// All of it lies before GNSS becomes unreliable by itself.
pub const END_S: f64 = 100.0;

pub fn at(second: f64) -> Stamp {
    Stamp::from_nanos((second * 1e9) as i64)
}

/// An estimate, how far it is from the truth (m), and the stamp it has by the log's own clock.
pub struct Judged {
    pub stamp: Stamp,
    pub estimate: Estimate,
    pub error_m: f64,
    /// Squared errors over what the covariance says: of the position, a third of it, and of the heading.
    pub nees: [f64; 2],
    /// rad.
    pub heading_error: f64,
}

pub struct Run {
    pub name: String,
    pub judged: Vec<Judged>,
    pub events: Vec<Event>,
    /// At every full second.
    pub health: Vec<Health>,
}

/// Runs one machine of the construction task through `change`, which may drop an arrival or move its clock (by
/// what it returns).
pub fn run(machine: usize, change: impl Fn(&Arrival) -> Option<Span>) -> Run {
    run_changed(machine, |arrival| change(arrival).map(|shift| shifted(arrival, shift)))
}

/// The same with any other arrival in its place; the stamp of the original says where the truth is.
pub fn run_changed(machine: usize, change: impl Fn(&Arrival) -> Option<Arrival>) -> Run {
    let log = &simulated("construction")[machine];
    let truth: Vec<StampedPose> = log.truth();
    let mut estimator = Estimator::new(log.options());
    let mut run = Run { name: log.name.clone(), judged: Vec::new(), events: Vec::new(), health: Vec::new() };
    for arrival in log.arrivals().iter().filter(|arrival| arrival.arrival < at(END_S)) {
        let Some(changed) = change(arrival) else { continue };
        let stamp = arrival.reading.stamp();
        let estimate = estimator.push(&changed);
        run.events.extend(estimator.take_events());
        if arrival.arrival >= at(run.health.len() as f64) {
            run.health.push(estimator.health());
        }
        let Some(estimate) = estimate else { continue };
        assert!(estimate.state.is_finite(), "{}: {estimate:?}", run.name);
        assert!(estimate.covariance.iter().all(|value| value.is_finite()), "{}: {estimate:?}", run.name);
        assert!(estimate.odom_from_imu.translation().iter().all(|value| value.is_finite()));
        assert_eq!(estimate.stamp, changed.reading.stamp());
        let pose = true_pose(&truth, stamp).expect("truth").pose;
        let error = estimate.state.position - pose.translation;
        let heading_error = (estimate.state.rotation * pose.rotation.inverse()).log().z;
        let block = estimate.covariance.fixed_view::<3, 3>(row::POSITION, row::POSITION).into_owned();
        let solved = block.cholesky().expect("positive definite").solve(&error);
        let heading_variance = estimate.state.heading_variance(&estimate.covariance);
        let nees = [error.dot(&solved) / 3.0, heading_error.powi(2) / heading_variance];
        run.judged.push(Judged { stamp, estimate, error_m: error.norm(), nees, heading_error });
    }
    run
}

/// The same arrival by a clock that is off by `shift`.
pub fn shifted(arrival: &Arrival, shift: Span) -> Arrival {
    let mut arrival = *arrival;
    arrival.arrival += shift;
    let stamp = match &mut arrival.reading {
        Reading::Imu(sample) | Reading::BaseImu(sample) => &mut sample.stamp,
        Reading::GnssLeft(fix) | Reading::GnssRight(fix) => &mut fix.stamp,
        Reading::LidarOdometry(pose) => &mut pose.stamp,
        Reading::CabinTurn(turn) => &mut turn.stamp,
    };
    *stamp += shift;
    arrival
}

pub fn within(stamp: Stamp, from_s: f64, to_s: f64) -> bool {
    at(from_s) <= stamp && stamp < at(to_s)
}

impl Run {
    pub fn worst_m(&self, from_s: f64, to_s: f64) -> f64 {
        let mut errors: Vec<f64> =
            self.judged.iter().filter(|one| within(one.stamp, from_s, to_s)).map(|one| one.error_m).collect();
        errors.sort_by(f64::total_cmp);
        *errors.last().unwrap_or_else(|| panic!("{}: no estimate from {from_s} s to {to_s} s", self.name))
    }

    pub fn restarts(&self) -> usize {
        self.events.iter().filter(|event| matches!(event.what, EventKind::Restarted { .. })).count()
    }

    pub fn modes(&self, from_s: f64, to_s: f64) -> Vec<Mode> {
        let mut modes: Vec<Mode> = self
            .judged
            .iter()
            .filter(|one| within(one.stamp, from_s, to_s))
            .map(|one| one.estimate.mode)
            .collect();
        modes.dedup();
        modes
    }

    /// Stamp of the first estimate after, s.
    pub fn first_after(&self, second: f64) -> f64 {
        let first = self.judged.iter().find(|one| one.stamp >= at(second));
        first.unwrap_or_else(|| panic!("{}: no estimate after {second} s", self.name)).stamp.as_seconds()
    }

    /// Mean of a sigma over the estimates of some time.
    pub fn mean(&self, from_s: f64, to_s: f64, sigma: impl Fn(&Estimate) -> f64) -> f64 {
        let inside = self.judged.iter().filter(|one| within(one.stamp, from_s, to_s));
        let sigmas: Vec<f64> = inside.map(|one| sigma(&one.estimate)).collect();
        assert!(!sigmas.is_empty(), "{}: no estimate from {from_s} s to {to_s} s", self.name);
        sigmas.iter().sum::<f64>() / sigmas.len() as f64
    }

    /// What health says of a sensor at a full second.
    pub fn sensor(&self, second: usize, sensor: Sensor) -> &SensorHealth {
        self.health[second].sensors.iter().find(|one| one.sensor == sensor).expect("it has spoken")
    }

    pub fn tell(&self, what: &str, figures: &str) {
        println!("{} {what}: {figures}", self.name);
    }
}

pub fn is_gnss(arrival: &Arrival) -> bool {
    matches!(arrival.reading.sensor(), Sensor::GnssLeft | Sensor::GnssRight)
}

pub fn is_lidar(arrival: &Arrival) -> bool {
    arrival.reading.sensor() == Sensor::LidarOdometry
}

/// Leaves out what `lost` names, by stamp.
pub fn without(lost: impl Fn(&Arrival) -> bool, from_s: f64, to_s: f64) -> impl Fn(&Arrival) -> Option<Span> {
    move |arrival| {
        (!(lost(arrival) && within(arrival.reading.stamp(), from_s, to_s))).then_some(Span::from_nanos(0))
    }
}
