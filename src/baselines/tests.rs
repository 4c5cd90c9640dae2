//! The filters' own mathematics: Jacobians, covariances, delayed measurements.

use std::path::Path;

use nalgebra::{Matrix2, SVector, Vector2};

use super::filter::{Core, Took};
use super::fix_gate::Fix;
use super::msf::Belief;
use super::transition::transition;
use super::tsif::{TwoState, residuals};
use super::*;
use crate::estimator::Start;
use crate::frames::{Imu, Lidar, LidarMap, Pose};
use crate::lie::{Se3, So3, Vec3};
use crate::preintegration::{Preintegration, SampleBuffer, Step};
use crate::sensors::{GnssFix, ImuSample, LidarPose, Reading, Sensor};
use crate::simulate::{Scenario, Simulation};
use crate::state::{NavState, STATE_DIM, StateMatrix, StateVector, row};
use crate::time::{Span, Stamp};

fn scenario(name: &str) -> Scenario {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenarios");
    Scenario::load(&root.join(name)).expect("a valid scenario")
}

fn options() -> Options {
    scenario("construction.toml").machines[0].estimator_options()
}

fn states() -> Vec<NavState> {
    (0..4)
        .map(|index| {
            let k = f64::from(index);
            NavState {
                rotation: So3::from_yaw_pitch_roll(2.0 - k, 0.3 * k - 0.4, 0.2 + 0.1 * k),
                position: Vec3::new(3.0 + 0.7 * k, -4.0, 1.0 + 0.1 * k),
                velocity: Vec3::new(1.0, -0.5 * k, 0.2),
                gyro_bias: Vec3::new(3e-3, -2e-3, 1e-3 * k),
                accel_bias: Vec3::new(0.05, -0.04, 0.02 * k),
                base_gyro_bias: 0.0,
            }
        })
        .collect()
}

fn step(span_s: f64) -> Step {
    Step {
        span_s,
        angular_rate: Vec3::new(0.4, -0.3, 0.8),
        specific_force: Vec3::new(0.5, -0.8, 9.7),
        change: [Vec3::zeros(); 2],
    }
}

#[test]
fn transition_agrees_with_differences() {
    let gravity = Vec3::new(0.0, 0.0, -9.81);
    for start in states() {
        let (gyro_bias, accel_bias) = (start.gyro_bias, start.accel_bias);
        let steps = (0..30).map(|_| step(0.01));
        let motion = Preintegration::of_steps(steps, gyro_bias, accel_bias, &options().smoother.noise);
        let analytic = transition(&motion, &start);
        for column in 0..STATE_DIM {
            let nudged = |size: f64| {
                let mut nudge = StateVector::zeros();
                nudge[column] = size;
                motion.predict(&start.plus(&nudge), &gravity)
            };
            let difference = nudged(1e-6).minus(&nudged(-1e-6)) / 2e-6;
            assert!((difference - analytic.column(column)).norm() < 1e-7, "column {column}");
        }
    }
}

#[test]
fn jacobians_of_the_two_state_residuals_agree_with_differences() {
    let gravity = Vec3::new(0.0, 0.0, -9.81);
    let states = states();
    let step = step(0.02);
    for pair in states.windows(2) {
        let before = TwoState { nav: pair[0], rate: Vec3::new(0.3, -0.2, 0.7) };
        let now = TwoState { nav: pair[1], rate: Vec3::new(0.45, -0.35, 0.9) };
        let linear = residuals(&before, &now, &step, &gravity);
        for column in 0..18 {
            let mut nudge = SVector::<f64, 18>::zeros();
            nudge[column] = 1e-6;
            let of = |before: &TwoState, now: &TwoState| residuals(before, now, &step, &gravity).residual;
            let by_now = (of(&before, &now.plus(&nudge)) - of(&before, &now.plus(&-nudge))) / 2e-6;
            let by_before = (of(&before.plus(&nudge), &now) - of(&before.plus(&-nudge), &now)) / 2e-6;
            assert!((by_now - linear.by_now.column(column)).norm() < 1e-7, "now, column {column}");
            assert!((by_before - linear.by_before.column(column)).norm() < 1e-7, "before, column {column}");
        }
    }
}

/// Position and velocity east of a machine that is level, does not turn, and whose attitude and biases are known: a
/// linear filter of two dimensions.
struct Line {
    mean: Vector2<f64>,
    covariance: Matrix2<f64>,
}

impl Line {
    fn predict(&mut self, acceleration: f64, noise_density: f64, dt: f64) {
        let transition = Matrix2::new(1.0, dt, 0.0, 1.0);
        self.mean = transition * self.mean + Vector2::new(0.5 * dt * dt, dt) * acceleration;
        let spread = Matrix2::new(dt.powi(3) / 3.0, dt * dt / 2.0, dt * dt / 2.0, dt);
        self.covariance =
            transition * self.covariance * transition.transpose() + spread * noise_density.powi(2);
    }

    fn correct(&mut self, measured: f64, sigma: f64) {
        let gain = self.covariance.column(0) / (self.covariance[(0, 0)] + sigma * sigma);
        self.mean += gain * (measured - self.mean.x);
        self.covariance -= gain * self.covariance.row(0);
    }
}

/// Attitude and biases known, position and velocity not.
fn known_but_for_the_way() -> StateMatrix {
    let mut information = StateMatrix::identity() * 1e16;
    for axis in 0..3 {
        information[(row::POSITION + axis, row::POSITION + axis)] = 1.0;
        information[(row::VELOCITY + axis, row::VELOCITY + axis)] = 4.0;
    }
    information
}

fn line_options() -> Options {
    let mut options = options();
    options.antenna_left = Vec3::zeros();
    options.antenna_right = None;
    options.smoother.noise.missed_part = [0.0; 2];
    options.smoother.noise.gyroscope_noise_density = 1e-9;
    options.smoother.noise.gyroscope_random_walk = 1e-9;
    options.smoother.noise.accelerometer_random_walk = 1e-9;
    options.smoother.noise.accelerometer_noise_density = 0.02;
    options
}

fn still(stamp: Stamp, options: &Options, acceleration: f64) -> ImuSample {
    let specific_force = Vec3::x() * acceleration - options.smoother.gravity;
    ImuSample { stamp, angular_rate: Vec3::zeros(), specific_force }
}

fn start(stamp: Stamp, samples: Vec<ImuSample>) -> Start {
    Start {
        stamp,
        state: NavState::identity(),
        information: known_but_for_the_way(),
        heading_from: "the test",
        heading_sigma: 0.0,
        fixes_agree: true,
        samples,
        readings: Vec::new(),
    }
}

fn fix(stamp: Stamp, east_m: f64, options: &Options) -> GnssFix {
    let position = options.site.to_geodetic(&Vec3::new(east_m, 0.0, 0.0));
    GnssFix { stamp, position, sigma_enu_m: Vec3::repeat(0.02) }
}

fn agrees_with_the_linear_filter<C: Core>(tolerance: f64) {
    let options = line_options();
    let at = |index: i64| Stamp::from_nanos(index * 10_000_000);
    let mut samples = SampleBuffer::default();
    samples.push(still(at(0), &options, 0.3));
    let mut core = C::begin(&options, &start(at(0), vec![still(at(0), &options, 0.3)]));
    let mut line = Line { mean: Vector2::zeros(), covariance: Matrix2::new(1.0, 0.0, 0.0, 0.25) };
    for index in 1..=200_i64 {
        samples.push(still(at(index), &options, 0.3));
        line.predict(0.3, 0.02, 0.01);
        if index % 10 == 0 {
            let measured = 0.4 + 0.01 * (index as f64 * 0.7).sin();
            line.correct(measured, 0.02);
            core.take(&options, &Reading::GnssLeft(fix(at(index), measured, &options)), &samples);
        }
    }
    let (stamp, state, covariance) = core.newest();
    assert_eq!(stamp, at(200));
    assert!((state.position.x - line.mean.x).abs() < tolerance, "{} {}", state.position.x, line.mean.x);
    assert!((state.velocity.x - line.mean.y).abs() < 10.0 * tolerance);
    let mut seen = Matrix2::zeros();
    for (index, at) in [row::POSITION, row::VELOCITY].into_iter().enumerate() {
        for (column, other) in [row::POSITION, row::VELOCITY].into_iter().enumerate() {
            seen[(index, column)] = covariance[(at, other)];
        }
    }
    let off = (seen - line.covariance).norm() / line.covariance.norm();
    assert!(off < 100.0 * tolerance, "{off}: {seen} {}", line.covariance);
}

#[test]
fn msf_is_the_kalman_filter_on_a_linear_case() {
    agrees_with_the_linear_filter::<Msf>(1e-7);
}

#[test]
fn tsif_is_the_kalman_filter_on_a_linear_case() {
    // But for what its kinematics may be off in a step, and for the noise being whole at the end of each.
    agrees_with_the_linear_filter::<Tsif>(1e-4);
}

fn lidar(stamp: Stamp, x_m: f64) -> LidarPose {
    let lidarmap_from_lidar: Pose<LidarMap, Lidar> = Pose::assume(Se3::new(So3::identity(), Vec3::x() * x_m));
    LidarPose { stamp, lidarmap_from_lidar }
}

#[test]
fn variance_of_lidar_increments_adds_up_through_the_clone() {
    let mut options = line_options();
    options.imu_from_lidar = Pose::<Imu, Lidar>::identity();
    options.lidar_sigma = [1e-3, 0.01];
    // The IMU says next to nothing.
    options.smoother.noise.accelerometer_noise_density = 100.0;
    let covariance = StateMatrix::identity() * 1e-12;
    let mut belief = Belief::new(NavState::identity(), &covariance);
    let at = |index: i64| Stamp::from_nanos(index * 200_000_000);
    belief.take_lidar(&lidar(at(0), 0.0), &options).expect("the first");
    for index in 1..=10_i64 {
        let steps = (0..20).map(|_| Step {
            span_s: 0.01,
            angular_rate: Vec3::zeros(),
            specific_force: -options.smoother.gravity,
            change: [Vec3::zeros(); 2],
        });
        let noise = &options.smoother.noise;
        let motion = Preintegration::of_steps(steps, Vec3::zeros(), Vec3::zeros(), noise);
        belief.predict(&motion, &options);
        belief.take_lidar(&lidar(at(index), 0.1 * index as f64), &options).expect("possible");
        let variance = belief.state_covariance()[(row::POSITION, row::POSITION)];
        let expected = index as f64 * 0.01_f64.powi(2);
        assert!((variance / expected - 1.0).abs() < 0.01, "{index}: {variance} against {expected}");
        assert!((belief.state.position.x - 0.1 * index as f64).abs() < 1e-3);
    }
}

#[test]
fn increments_that_were_lost_count_as_much_as_those_that_came() {
    let mut options = line_options();
    options.imu_from_lidar = Pose::<Imu, Lidar>::identity();
    options.lidar_sigma = [1e-3, 0.01];
    options.smoother.noise.accelerometer_noise_density = 100.0;
    let mut belief = Belief::new(NavState::identity(), &(StateMatrix::identity() * 1e-12));
    let at = |index: i64| Stamp::from_nanos(index * 200_000_000);
    let mut before = 0;
    for index in [0, 1, 2, 3, 12, 13] {
        let steps = (0..20 * (index - before)).map(|_| Step {
            span_s: 0.01,
            angular_rate: Vec3::zeros(),
            specific_force: -options.smoother.gravity,
            change: [Vec3::zeros(); 2],
        });
        let noise = &options.smoother.noise;
        belief.predict(&Preintegration::of_steps(steps, Vec3::zeros(), Vec3::zeros(), noise), &options);
        belief.take_lidar(&lidar(at(index), 0.1 * index as f64), &options).expect("possible");
        before = index;
    }
    let variance = belief.state_covariance()[(row::POSITION, row::POSITION)];
    let expected = 13.0 * 0.01_f64.powi(2);
    assert!((variance / expected - 1.0).abs() < 0.01, "{variance} against {expected}");
}

#[test]
fn lidar_alone_is_no_surer_for_poses_that_were_lost() {
    let sigma = |gap: [f64; 2]| {
        let end = Stamp::from_seconds(60.0);
        let simulation = Simulation::new(&scenario("construction.toml"), 0).ending_at(end);
        let mut method = Kind::Lidar.estimator(simulation.machine().estimator_options());
        let lost = |stamp: Stamp| (gap[0]..gap[1]).contains(&stamp.as_seconds());
        let mut last = None;
        for arrival in simulation {
            if matches!(arrival.reading, Reading::LidarOdometry(_)) && lost(arrival.reading.stamp()) {
                continue;
            }
            last = method.predict(&arrival).or(last);
            method.update(&arrival);
        }
        let last = last.expect("it started");
        [last.position_sigma_m()[2], last.state.heading_variance(&last.covariance).sqrt()]
    };
    let (whole, with_gap) = (sigma([0.0; 2]), sigma([20.0, 55.0]));
    for (whole, with_gap) in whole.into_iter().zip(with_gap) {
        assert!((with_gap / whole - 1.0).abs() < 0.1, "{with_gap} beside {whole}");
    }
}

#[test]
fn readings_of_a_clock_that_is_ahead_are_refused_in_their_own_book() {
    for kind in [Kind::Tsif, Kind::Msf] {
        let simulation =
            Simulation::new(&scenario("construction.toml"), 0).ending_at(Stamp::from_seconds(15.0));
        let mut method = kind.estimator(simulation.machine().estimator_options());
        let mut ahead = 0;
        for mut arrival in simulation {
            // The right receiver's clock is an hour ahead from the start.
            if let Reading::GnssRight(fix) = &mut arrival.reading {
                fix.stamp += Span::from_millis(3_600_000);
                ahead += u64::from(method.health().waits_for.is_none());
            }
            method.predict(&arrival);
            method.update(&arrival);
        }
        let health = method.health();
        let of =
            |sensor: Sensor| health.sensors.iter().find(|health| health.sensor == sensor).expect("heard");
        let right = of(Sensor::GnssRight);
        assert!(ahead > 50 && right.refused >= ahead, "{}: {} of {ahead}", kind.name(), right.refused);
        let why = right.last_refusal.as_deref().unwrap_or_default();
        assert!(why.contains("ahead of the cabin IMU"), "{why}");
        assert_eq!((of(Sensor::Imu).refused, of(Sensor::GnssLeft).refused), (0, 0));
    }
}

#[test]
fn covariance_stays_symmetric_and_positive_under_corrections() {
    let options = options();
    let mut belief = Belief::new(states()[1], &(StateMatrix::identity() * 1e-2));
    for index in 0..200 {
        let motion = Preintegration::of_steps(
            (0..5).map(|_| step(0.01)),
            belief.state.gyro_bias,
            belief.state.accel_bias,
            &options.smoother.noise,
        );
        belief.predict(&motion, &options);
        let lever_arm = options.antenna_left;
        let measured = belief.state.position + belief.state.rotation * lever_arm;
        let stamp = Stamp::from_nanos(index * 50_000_000);
        let sigma = Vec3::repeat(0.01);
        belief.take_fix(&Fix { stamp, measured, lever_arm, sigma }).expect("where it is expected");
        let covariance = belief.state_covariance();
        assert!((covariance - covariance.transpose()).norm() == 0.0);
        assert!(covariance.cholesky().is_some(), "{index}");
    }
}

/// Samples and measurements of the first seconds of the construction task, in order of their stamps.
fn readings(seconds: f64) -> (Options, Vec<ImuSample>, Vec<Reading>, Simulation) {
    let mut scenario = scenario("construction.toml");
    scenario.file.seed = 7;
    let end = Stamp::from_seconds(seconds);
    let simulation = Simulation::new(&scenario, 0).ending_at(end);
    let options = simulation.machine().estimator_options();
    let mut samples = Vec::new();
    let mut others = Vec::new();
    for arrival in simulation {
        match arrival.reading {
            Reading::Imu(sample) => samples.push(sample),
            Reading::BaseImu(_) | Reading::CabinTurn(_) => {}
            other => others.push(other),
        }
    }
    others.sort_by_key(Reading::stamp);
    (options, samples, others, Simulation::new(&scenario, 0))
}

fn begin_at_truth<C: Core>(options: &Options, simulation: &Simulation, stamp: Stamp) -> C {
    let mut start = start(stamp, Vec::new());
    start.state =
        NavState { gyro_bias: Vec3::zeros(), accel_bias: Vec3::zeros(), ..simulation.truth(stamp).state };
    start.information = StateMatrix::identity() * 1e4;
    C::begin(options, &start)
}

/// The newest state when each measurement comes so many measurements late, and how many came too late.
fn run_delayed<C: Core>(late_by: &[usize]) -> ((Stamp, NavState, StateMatrix), usize) {
    let (options, samples, measurements, simulation) = readings(6.0);
    let begin = samples[0].stamp;
    let mut buffer = SampleBuffer::default();
    samples.iter().for_each(|sample| buffer.push(*sample));
    let mut order: Vec<(usize, usize)> =
        (0..measurements.len()).map(|index| (index + late_by[index % late_by.len()], index)).collect();
    order.sort();
    let mut core: C = begin_at_truth(&options, &simulation, begin);
    let mut too_late = 0;
    for (_, index) in order {
        let reading = &measurements[index];
        if reading.stamp() > begin && reading.stamp() < samples[samples.len() - 1].stamp {
            let took = core.take(&options, reading, &buffer);
            too_late += usize::from(matches!(took, Took::Refused(reason) if reason.contains("older than")));
        }
    }
    (core.newest(), too_late)
}

#[test]
fn msf_takes_delayed_measurements_as_if_they_came_in_order() {
    let (in_order, too_late) = run_delayed::<Msf>(&[0]);
    assert_eq!(too_late, 0);
    for late_by in [&[0, 3, 1][..], &[5, 0, 9, 2, 7], &[12, 0]] {
        let (delayed, too_late) = run_delayed::<Msf>(late_by);
        assert_eq!(too_late, 0);
        assert!(delayed == in_order, "late by {late_by:?}: {:?} {:?}", delayed.1, in_order.1);
    }
}

#[test]
fn msf_refuses_what_is_later_than_its_buffer() {
    let (_, too_late) = run_delayed::<Msf>(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 200]);
    assert!(too_late > 0, "measurements two seconds late");
}

/// Errors over sigmas of a method on the construction task with good GNSS, squared and averaged: x, y, z and rotations.
fn nees(kind: Kind, seeds: u64, seconds: f64) -> ([f64; 6], f64) {
    let mut sums = [0.0; 6];
    let (mut count, mut squares) = (0.0, 0.0);
    for seed in 0..seeds {
        let mut scenario = scenario("construction.toml");
        scenario.file.seed = 300 + seed;
        scenario.file.gnss_condition.clear();
        let mut simulation =
            Simulation::new(&scenario, (seed % 2) as usize).ending_at(Stamp::from_seconds(seconds));
        let mut method = kind.estimator(simulation.machine().estimator_options());
        while let Some(arrival) = simulation.next() {
            let estimate = method.predict(&arrival);
            method.update(&arrival);
            let Some(estimate) = estimate.filter(|estimate| estimate.stamp.as_seconds() > 12.0) else {
                continue;
            };
            let truth = simulation.truth(estimate.stamp).state;
            let position = estimate.state.position - truth.position;
            let rotation = (estimate.state.rotation * truth.rotation.inverse()).log();
            let sigma = [estimate.position_sigma_m(), estimate.rotation_sigma()].concat();
            for (axis, error) in position.iter().chain(rotation.iter()).enumerate() {
                sums[axis] += (error / sigma[axis]).powi(2);
            }
            squares += position.norm_squared();
            count += 1.0;
        }
    }
    (sums.map(|sum| sum / count), (squares / count).sqrt())
}

#[test]
fn errors_of_the_filters_are_as_large_as_their_covariances_say() {
    for (kind, rmse_max_m) in [(Kind::Tsif, 0.008), (Kind::Msf, 0.008)] {
        let (nees, rmse_m) = nees(kind, 4, 60.0);
        println!("{}: NEES {nees:.2?}, RMSE {:.2} cm", kind.name(), 100.0 * rmse_m);
        assert!(nees.iter().all(|value| (0.4..2.5).contains(value)), "{}: {nees:?}", kind.name());
        assert!(rmse_m < rmse_max_m, "{}: {rmse_m} m", kind.name());
    }
}

#[test]
fn drift_of_lidar_alone_is_as_large_as_its_covariance_says() {
    let (nees, rmse_m) = nees(Kind::Lidar, 24, 60.0);
    println!("lidar: NEES {nees:.2?}, RMSE {:.2} cm", 100.0 * rmse_m);
    assert!(nees.iter().all(|value| (0.3..2.5).contains(value)), "{nees:?}");
}

/// Straight ahead by a perfect IMU, every method is where the truth is.
#[test]
fn perfect_sensors_give_the_truth() {
    let mut scenario = scenario("construction.toml");
    scenario.file.gnss_condition.clear();
    let sensors = &mut scenario.file.sensors;
    for imu in [&mut sensors.imu, &mut sensors.base_imu] {
        imu.gyroscope_noise_density = 0.0;
        imu.accelerometer_noise_density = 0.0;
        imu.gyroscope_random_walk = 0.0;
        imu.accelerometer_random_walk = 0.0;
        imu.gyroscope_bias = 0.0;
        imu.accelerometer_bias = 0.0;
        imu.vibration_mps2 = [0.0; 2];
        imu.vibration_radps = 0.0;
    }
    sensors.gnss.sigma_enu_m = [1e-4; 3];
    sensors.gnss.reported_sigma_scale = 1.0;
    sensors.lidar_odometry.increment_sigma_m = 0.0;
    sensors.lidar_odometry.increment_sigma_deg = 0.0;
    sensors.lidar_odometry.increment_sigma_scale = 0.0;
    for (kind, error_max_m) in
        [(Kind::Tsif, 0.002), (Kind::Msf, 0.002), (Kind::Lidar, 0.005), (Kind::DeadReckoning, 0.5)]
    {
        let mut simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(50.0));
        let mut method = kind.estimator(simulation.machine().estimator_options());
        let mut worst_m = 0.0_f64;
        while let Some(arrival) = simulation.next() {
            let estimate = method.predict(&arrival);
            method.update(&arrival);
            if let Some(estimate) = estimate {
                let truth = simulation.truth(estimate.stamp).state;
                worst_m = worst_m.max((estimate.state.position - truth.position).norm());
            }
        }
        println!("{}: {worst_m:.6} m", kind.name());
        assert!(worst_m > 0.0 && worst_m < error_max_m, "{}: {worst_m} m", kind.name());
    }
}

#[test]
fn an_imu_gap_starts_every_filter_anew() {
    for kind in [Kind::Tsif, Kind::Msf, Kind::DeadReckoning] {
        let scenario = scenario("construction.toml");
        let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(9.0));
        let mut method = kind.estimator(simulation.machine().estimator_options());
        let gap = |stamp: Stamp| (4.0..5.0).contains(&stamp.as_seconds());
        let mut last = None;
        for arrival in simulation {
            if matches!(arrival.reading, Reading::Imu(_)) && gap(arrival.reading.stamp()) {
                continue;
            }
            last = method.predict(&arrival).or(last);
            method.update(&arrival);
        }
        let restarts = method
            .take_events()
            .into_iter()
            .filter(|event| matches!(event.what, crate::state::EventKind::Restarted { .. }));
        assert_eq!(restarts.count(), 1, "{}", kind.name());
        let end = last.expect("it started again").stamp;
        assert!(Stamp::from_seconds(9.0) - end < Span::from_millis(50), "{}", kind.name());
    }
}
