//! Streams that fail: the output stays finite, says what it rests on, and comes back.

use holdfast::estimator::Estimator;
use holdfast::import::StampedPose;
use holdfast::sensors::{Arrival, Reading, Sensor};
use holdfast::state::{Estimate, Event, EventKind, Mode};
use holdfast::time::{Span, Stamp};

use crate::fixtures::{simulated, true_pose};

/// All of it lies before GNSS becomes unreliable by itself.
const END_S: f64 = 100.0;

fn at(second: f64) -> Stamp {
    Stamp::from_nanos((second * 1e9) as i64)
}

/// An estimate, how far it is from the truth (m), and the stamp it has by the log's own clock.
struct Judged {
    stamp: Stamp,
    estimate: Estimate,
    error_m: f64,
}

struct Run {
    name: String,
    judged: Vec<Judged>,
    events: Vec<Event>,
}

/// Runs one machine of the construction task through `change`, which may drop an arrival or move its clock (by
/// what it returns).
fn run(machine: usize, change: impl Fn(&Arrival) -> Option<Span>) -> Run {
    let log = &simulated("construction")[machine];
    let truth: Vec<StampedPose> = log.truth();
    let mut estimator = Estimator::new(log.options());
    let mut run = Run { name: log.name.clone(), judged: Vec::new(), events: Vec::new() };
    for arrival in log.arrivals().iter().filter(|arrival| arrival.arrival < at(END_S)) {
        let Some(shift) = change(arrival) else { continue };
        let stamp = arrival.reading.stamp();
        let estimate = estimator.push(&shifted(arrival, shift));
        run.events.extend(estimator.take_events());
        let Some(estimate) = estimate else { continue };
        assert!(estimate.state.is_finite(), "{}: {estimate:?}", run.name);
        assert!(estimate.covariance.iter().all(|value| value.is_finite()), "{}: {estimate:?}", run.name);
        assert!(estimate.odom_from_imu.translation().iter().all(|value| value.is_finite()));
        assert_eq!(estimate.stamp, stamp + shift);
        let true_position = true_pose(&truth, stamp).expect("truth").pose.translation;
        let error_m = (estimate.state.position - true_position).norm();
        run.judged.push(Judged { stamp, estimate, error_m });
    }
    run
}

/// The same arrival by a clock that is off by `shift`.
fn shifted(arrival: &Arrival, shift: Span) -> Arrival {
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

fn within(stamp: Stamp, from_s: f64, to_s: f64) -> bool {
    at(from_s) <= stamp && stamp < at(to_s)
}

impl Run {
    fn worst_m(&self, from_s: f64, to_s: f64) -> f64 {
        let mut errors: Vec<f64> =
            self.judged.iter().filter(|one| within(one.stamp, from_s, to_s)).map(|one| one.error_m).collect();
        errors.sort_by(f64::total_cmp);
        *errors.last().unwrap_or_else(|| panic!("{}: no estimate from {from_s} s to {to_s} s", self.name))
    }

    fn restarts(&self) -> usize {
        self.events.iter().filter(|event| matches!(event.what, EventKind::Restarted { .. })).count()
    }

    fn modes(&self, from_s: f64, to_s: f64) -> Vec<Mode> {
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
    fn first_after(&self, second: f64) -> f64 {
        let first = self.judged.iter().find(|one| one.stamp >= at(second));
        first.unwrap_or_else(|| panic!("{}: no estimate after {second} s", self.name)).stamp.as_seconds()
    }

    fn tell(&self, what: &str, figures: &str) {
        println!("{} {what}: {figures}", self.name);
    }
}

fn is_gnss(arrival: &Arrival) -> bool {
    matches!(arrival.reading.sensor(), Sensor::GnssLeft | Sensor::GnssRight)
}

fn is_lidar(arrival: &Arrival) -> bool {
    arrival.reading.sensor() == Sensor::LidarOdometry
}

/// Leaves out what `lost` names, by stamp.
fn without(lost: impl Fn(&Arrival) -> bool, from_s: f64, to_s: f64) -> impl Fn(&Arrival) -> Option<Span> {
    move |arrival| {
        (!(lost(arrival) && within(arrival.reading.stamp(), from_s, to_s))).then_some(Span::from_nanos(0))
    }
}

#[test]
fn short_gap_of_the_imu_is_bridged() {
    for machine in 0..2 {
        let run = run(machine, without(|arrival| arrival.reading.sensor() == Sensor::Imu, 50.0, 50.3));
        run.tell(
            "IMU gap of 0.3 s",
            &format!("at most {:.1} cm off after it", 100.0 * run.worst_m(50.3, 60.0)),
        );
        assert_eq!(run.restarts(), 0, "{:?}", run.events);
        assert!(run.first_after(50.29) < 50.32, "{}", run.first_after(50.29));
        assert!(run.worst_m(50.3, 51.0) < 0.3);
        assert!(run.worst_m(52.0, END_S) < 0.05, "{}", run.worst_m(52.0, END_S));
    }
}

#[test]
fn long_gap_of_the_imu_starts_the_estimate_anew() {
    for machine in 0..2 {
        let run = run(machine, without(|arrival| arrival.reading.sensor() == Sensor::Imu, 50.0, 55.0));
        let again_s = run.first_after(50.1);
        let settled_m = run.worst_m(again_s + 15.0, END_S);
        run.tell(
            "IMU gap of 5 s",
            &format!("again at {again_s:.2} s, then at most {:.1} cm off", 100.0 * settled_m),
        );
        assert_eq!(run.restarts(), 1, "{:?}", run.events);
        assert!((55.0..65.0).contains(&again_s), "{again_s}");
        assert!(settled_m < 0.05, "{settled_m}");
    }
}

#[test]
fn lost_gnss_is_held_by_lidar_and_taken_back() {
    for machine in 0..2 {
        let run = run(machine, without(is_gnss, 50.0, 70.0));
        let (drift_m, settled_m) = (run.worst_m(50.0, 70.5), run.worst_m(75.0, END_S));
        run.tell(
            "GNSS lost for 20 s",
            &format!("{:.1} cm, after it {:.1} cm", 100.0 * drift_m, 100.0 * settled_m),
        );
        assert_eq!(run.restarts(), 0);
        assert_eq!(run.modes(52.0, 70.0), [Mode::Fallback]);
        assert_eq!(run.modes(72.0, END_S), [Mode::Main]);
        assert!(drift_m < 0.3, "{drift_m}");
        assert!(settled_m < 0.05, "{settled_m}");
    }
}

#[test]
fn lost_lidar_does_no_harm_while_gnss_is_good() {
    for machine in 0..2 {
        let run = run(machine, without(is_lidar, 50.0, 70.0));
        run.tell("lidar lost for 20 s", &format!("at most {:.1} cm off", 100.0 * run.worst_m(40.0, END_S)));
        assert_eq!(run.restarts(), 0);
        assert_eq!(run.modes(10.0, END_S), [Mode::Main]);
        assert!(run.worst_m(10.0, END_S) < 0.05);
    }
}

#[test]
fn imu_alone_says_so_and_is_taken_back() {
    for machine in 0..2 {
        let run = run(machine, without(|arrival| is_gnss(arrival) || is_lidar(arrival), 50.0, 70.0));
        let (drift_m, settled_m) = (run.worst_m(50.0, 70.5), run.worst_m(85.0, END_S));
        run.tell("IMU alone for 20 s", &format!("{drift_m:.2} m, after it {:.1} cm", 100.0 * settled_m));
        assert_eq!(run.restarts(), 0);
        assert_eq!(run.modes(53.0, 70.0), [Mode::ImuOnly]);
        assert_eq!(run.modes(85.0, END_S), [Mode::Main]);
        assert!(drift_m < 20.0, "{drift_m}");
        assert!(settled_m < 0.05, "{settled_m}");
    }
}

#[test]
fn clock_that_jumps_by_an_hour_starts_the_estimate_anew() {
    for machine in 0..2 {
        for hours in [1_i64, -1] {
            let jump = Span::from_nanos(hours * 3_600_000_000_000);
            let run = run(machine, |arrival| {
                Some(if arrival.arrival < at(50.0) { Span::from_nanos(0) } else { jump })
            });
            let again_s = run.first_after(50.1);
            let settled_m = run.worst_m(again_s + 15.0, END_S);
            run.tell(
                &format!("clock jump of {hours} h"),
                &format!("again at {again_s:.2} s, then at most {:.1} cm off", 100.0 * settled_m),
            );
            assert_eq!(run.restarts(), 1, "{:?}", run.events);
            // It drives straight on and levels: little tells the heading.
            assert!(again_s < 65.0, "{again_s}");
            assert!(settled_m < 0.05, "{settled_m}");
        }
    }
}

/// With the IMU alone, an error of the tilt of a tenth of a degree would be 13 cm after four seconds.
#[test]
fn standing_machine_without_chassis_sensors_holds_its_position() {
    for machine in 0..2 {
        let run = run(machine, |arrival| {
            let lost = match arrival.reading.sensor() {
                Sensor::BaseImu | Sensor::CabinTurn | Sensor::LidarOdometry => true,
                Sensor::GnssLeft | Sensor::GnssRight => within(arrival.reading.stamp(), 5.0, 9.0),
                Sensor::Imu => false,
            };
            (!lost).then_some(Span::default())
        });
        let worst_m = run.worst_m(5.0, 9.0);
        run.tell("standing with the IMU alone for 4 s", &format!("{:.1} cm", 100.0 * worst_m));
        assert!(run.modes(6.5, 9.0).contains(&Mode::ImuOnly));
        assert!(worst_m < 0.02, "{}: {worst_m} m", run.name);
    }
}
