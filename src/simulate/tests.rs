//! Behaviour of the simulator, on the scenarios that are shipped.

use std::path::{Path, PathBuf};

use super::*;
use crate::lie::{So3, Vec3};
use crate::sensors::{GnssFix, ImuSample, Sensor};

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenarios").join(name)
}

fn load(name: &str) -> Scenario {
    Scenario::load(&shipped(name)).expect("a shipped scenario is valid")
}

fn without_noise() -> Sensors {
    let imu = Imu {
        gyroscope_noise_density: 0.0,
        accelerometer_noise_density: 0.0,
        gyroscope_random_walk: 0.0,
        accelerometer_random_walk: 0.0,
        gyroscope_bias: 0.0,
        accelerometer_bias: 0.0,
        vibration_mps2: [0.0, 0.0],
        vibration_radps: 0.0,
        ..Imu::default()
    };
    Sensors {
        imu,
        base_imu: imu,
        gnss: Gnss { sigma_enu_m: [0.0; 3], ..Gnss::default() },
        lidar_odometry: LidarOdometry {
            increment_sigma_m: 0.0,
            increment_sigma_deg: 0.0,
            increment_sigma_scale: 0.0,
            ..LidarOdometry::default()
        },
        cabin_turn: CabinTurn { steps: 0, ..CabinTurn::default() },
    }
}

fn imu_samples(simulation: &mut Simulation, until_s: f64) -> Vec<ImuSample> {
    simulation
        .filter_map(|arrival| match arrival.reading {
            Reading::Imu(sample) => Some(sample),
            _ => None,
        })
        .take_while(|sample| sample.stamp.as_seconds() < until_s)
        .collect()
}

fn left_fixes(scenario: &Scenario, index: usize) -> Vec<GnssFix> {
    Simulation::new(scenario, index)
        .filter_map(|arrival| match arrival.reading {
            Reading::GnssLeft(fix) => Some(fix),
            _ => None,
        })
        .collect()
}

/// Error of a fix against the truth, m.
fn error_of(simulation: &Simulation, fix: &GnssFix) -> Vec3 {
    let machine = simulation.machine();
    let world_from_imu = simulation.truth(fix.stamp).state.world_from_imu();
    let arm = Vec3::from_row_slice(&machine.frames.cabin_from_gnss_left.translation_m);
    let cabin_from_imu: Pose<crate::frames::Cabin, crate::frames::Imu> = machine.frames.cabin_from_imu.pose();
    let antenna = world_from_imu * (cabin_from_imu.inverse() * arm);
    machine.world.site_frame().to_enu(fix.position) - antenna
}

fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (mean, (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt())
}

#[test]
fn derivatives_of_the_truth_agree_with_differences() {
    let step = Span::from_nanos(100_000);
    let step_s = step.as_seconds();
    for name in ["construction.toml", "navigation.toml", "demo.toml"] {
        let scenario = load(name);
        for index in 0..scenario.machines.len() {
            let simulation = Simulation::new(&scenario, index);
            for tick in 0..1500 {
                // Not in step with any action; past the end of what repeats.
                let stamp = Stamp::from_nanos(1 + tick * 292_345_678);
                let [before, now, after] = [stamp - step, stamp, stamp + step].map(|at| simulation.truth(at));
                for body in [|truth: &Truth| truth.imu, |truth: &Truth| truth.base] {
                    let [before, now, after] = [&before, &now, &after].map(body);
                    let what = format!("{name} machine {index} at {stamp}");
                    let velocity = (after.pose.translation - before.pose.translation) / (2.0 * step_s);
                    assert!((velocity - now.velocity).norm() < 1e-6, "velocity, {what}");
                    let acceleration = (after.velocity - before.velocity) / (2.0 * step_s);
                    assert!((acceleration - now.acceleration).norm() < 1e-5, "acceleration, {what}");
                    let rate = after.pose.rotation.minus(&before.pose.rotation) / (2.0 * step_s);
                    assert!((rate - now.angular_rate).norm() < 1e-6, "angular rate, {what}");
                    let angular = (after.angular_rate - before.angular_rate) / (2.0 * step_s);
                    assert!(
                        (angular - now.angular_acceleration).norm() < 1e-5,
                        "angular acceleration, {what}"
                    );
                }
            }
        }
    }
}

#[test]
fn imu_without_noise_integrates_to_the_truth() {
    let mut scenario = load("construction.toml");
    scenario.file.sensors = without_noise();
    scenario.file.sensors.imu.stamp_jitter_s = 0.0;
    for index in 0..2 {
        scenario.machines[index].imu.update_rate = 1000.0;
        let mut simulation = Simulation::new(&scenario, index);
        let samples = imu_samples(&mut simulation, 100.0);
        let gravity = simulation.machine().world.site_frame().gravity();
        let mut state = simulation.truth(samples[0].stamp).state;
        for pair in samples.windows(2) {
            let step_s = pair[1].stamp.seconds_since(pair[0].stamp);
            let rate = (pair[0].angular_rate + pair[1].angular_rate) * 0.5;
            let next = state.rotation.plus(&(rate * step_s));
            let acceleration =
                (state.rotation * pair[0].specific_force + next * pair[1].specific_force) * 0.5 + gravity;
            state.position += state.velocity * step_s + acceleration * (0.5 * step_s * step_s);
            state.velocity += acceleration * step_s;
            state.rotation = next.renormalized();
        }
        let truth = simulation.truth(samples[samples.len() - 1].stamp).state;
        let position = (state.position - truth.position).norm();
        let rotation = state.rotation.minus(&truth.rotation).norm();
        assert!(position < 5e-3 && rotation < 1e-6, "machine {index}: {position} m, {rotation} rad");
        let way = (truth.position - simulation.truth(samples[0].stamp).state.position).norm();
        assert!(way > 1.0, "machine {index} did not move");
    }
}

#[test]
fn imu_noise_has_the_size_that_the_scenario_says() {
    let mut scenario = load("construction.toml");
    // Nothing but white noise and the constant bias.
    scenario.file.sensors.imu.vibration_mps2 = [0.0, 0.0];
    scenario.file.sensors.imu.vibration_radps = 0.0;
    scenario.file.sensors.imu.gyroscope_random_walk = 0.0;
    scenario.file.sensors.imu.accelerometer_random_walk = 0.0;
    let mut simulation = Simulation::new(&scenario, 0);
    let samples = imu_samples(&mut simulation, 100.0);
    let gravity = simulation.machine().world.site_frame().gravity();
    for axis in 0..3 {
        let truths: Vec<Truth> = samples.iter().map(|sample| simulation.truth(sample.stamp)).collect();
        let errors = samples.iter().zip(&truths);
        let gyro: Vec<f64> = errors
            .clone()
            .map(|(sample, truth)| (sample.angular_rate - truth.imu.angular_rate)[axis])
            .collect();
        let accel: Vec<f64> = errors
            .map(|(sample, truth)| (sample.specific_force - truth.imu.specific_force(&gravity))[axis])
            .collect();
        let ((gyro_bias, gyro_sigma), (accel_bias, accel_sigma)) =
            (mean_and_deviation(&gyro), mean_and_deviation(&accel));
        // 10 000 samples know a deviation to 0.7 %.
        assert!((gyro_sigma / 1.6e-3 - 1.0).abs() < 0.03, "gyro {gyro_sigma}");
        assert!((accel_sigma / 1.1e-2 - 1.0).abs() < 0.03, "accelerometer {accel_sigma}");
        assert!((1.4e-3..3.1e-3).contains(&gyro_bias.abs()), "gyro bias {gyro_bias}");
        assert!((0.024..0.051).contains(&accel_bias.abs()), "accelerometer bias {accel_bias}");
        assert!((truths[0].state.gyro_bias[axis] - gyro_bias).abs() < 1e-4, "the truth knows the bias");
    }
}

#[test]
fn biases_walk_as_far_as_the_scenario_says() {
    let mut scenario = load("construction.toml");
    let mut ends = Vec::new();
    for seed in 0..40 {
        scenario.file.seed = seed;
        let mut simulation = Simulation::new(&scenario, 0);
        imu_samples(&mut simulation, 1.0);
        let first = simulation.truth(Stamp::default()).state;
        imu_samples(&mut simulation, 26.0);
        let last = simulation.truth(Stamp::default()).state;
        for axis in 0..3 {
            ends.push((last.gyro_bias - first.gyro_bias)[axis] / (8.0e-6 * 5.0));
            ends.push((last.accel_bias - first.accel_bias)[axis] / (6.0e-5 * 5.0));
        }
    }
    let (mean, sigma) = mean_and_deviation(&ends);
    // 240 numbers know a deviation to 4.6 %.
    assert!(mean.abs() < 0.25 && (sigma - 1.0).abs() < 0.2, "{mean} {sigma}");
}

#[test]
fn engine_shakes_within_its_range() {
    let mut scenario = load("construction.toml");
    scenario.file.sensors = without_noise();
    scenario.file.sensors.imu.vibration_mps2 = [0.3, 0.5];
    let mut simulation = Simulation::new(&scenario, 1);
    let samples = imu_samples(&mut simulation, 9.0);
    let gravity = simulation.machine().world.site_frame().gravity();
    let shake: Vec<Vec3> = samples
        .iter()
        .map(|sample| sample.specific_force - simulation.truth(sample.stamp).imu.specific_force(&gravity))
        .collect();
    let greatest = shake.iter().map(|one| one.norm()).fold(0.0, f64::max);
    let mean_square = shake.iter().map(|one| one.norm_squared()).sum::<f64>() / shake.len() as f64;
    assert!((0.2..=0.5).contains(&greatest), "{greatest}");
    assert!((0.3_f64.powi(2) / 2.0..0.5_f64.powi(2) / 2.0).contains(&mean_square), "{mean_square}");
    // Zero crossings of one axis tell the frequency.
    let crossings = shake.windows(2).filter(|pair| pair[0].x * pair[1].x < 0.0).count();
    let frequency_hz = crossings as f64 / 2.0 / 9.0;
    assert!((21.0..=29.0).contains(&frequency_hz), "{frequency_hz}");
}

#[test]
fn fixes_are_as_good_as_they_say_while_gnss_is_good() {
    let scenario = load("construction.toml");
    let simulation = Simulation::new(&scenario, 1);
    let good = left_fixes(&scenario, 1).into_iter().filter(|fix| fix.stamp.as_seconds() < 105.0);
    let errors: Vec<Vec3> = good
        .map(|fix| {
            assert_eq!(fix.sigma_enu_m, Vec3::new(0.008, 0.008, 0.014));
            error_of(&simulation, &fix)
        })
        .collect();
    assert_eq!(errors.len(), 2100);
    for (axis, expected) in [0.008, 0.008, 0.014].into_iter().enumerate() {
        let values: Vec<f64> = errors.iter().map(|error| error[axis]).collect();
        let (mean, sigma) = mean_and_deviation(&values);
        assert!(mean.abs() < 0.001 && (sigma / expected - 1.0).abs() < 0.06, "{axis}: {mean} {sigma}");
    }
}

#[test]
fn both_antennas_measure_and_arrive_together() {
    let arrivals: Vec<Arrival> = Simulation::new(&load("navigation.toml"), 0).collect();
    let of = |sensor| {
        let own = move |arrival: &&Arrival| arrival.reading.sensor() == sensor;
        arrivals.iter().filter(own).map(|one| (one.arrival, one.reading.stamp())).collect::<Vec<_>>()
    };
    assert_eq!(of(Sensor::GnssLeft), of(Sensor::GnssRight));
}

fn with_condition(kind: GnssConditionKind) -> Scenario {
    let mut scenario = load("navigation.toml");
    let (start_s, end_s, machines) = (100.0, 400.0, Vec::new());
    scenario.file.gnss_condition = vec![GnssCondition { start_s, end_s, kind, machines }];
    scenario
}

#[test]
fn gnss_fails_in_the_ways_that_the_scenario_names() {
    for kind in [
        GnssConditionKind::Blocked,
        GnssConditionKind::Multipath,
        GnssConditionKind::Unreliable,
        GnssConditionKind::Trees,
    ] {
        let scenario = with_condition(kind);
        let simulation = Simulation::new(&scenario, 0);
        let fixes = left_fixes(&scenario, 0);
        let inside = |fix: &&GnssFix| (100.0..400.0).contains(&fix.stamp.as_seconds());
        let seen: Vec<(f64, f64)> = fixes
            .iter()
            .filter(inside)
            .map(|fix| (fix.sigma_enu_m.x, error_of(&simulation, fix).xy().norm()))
            .collect();
        let count = seen.len() as f64 / 6000.0;
        let float: Vec<f64> =
            seen.iter().filter(|one| one.0 >= 0.1).map(|(sigma, error)| error / sigma).collect();
        let scatter = (float.iter().map(|one| one * one).sum::<f64>() / float.len() as f64).sqrt();
        let wrong = seen.iter().filter(|(sigma, error)| *sigma < 0.05 && *error > 0.15).count();
        match kind {
            GnssConditionKind::Blocked => assert!(seen.is_empty()),
            GnssConditionKind::Multipath => {
                assert!(count == 1.0 && wrong == seen.len(), "{count} {wrong}");
                assert!(seen.iter().all(|one| one.1 < 3.0));
            }
            GnssConditionKind::Unreliable => {
                assert!((0.7..0.97).contains(&count), "some epochs are missing: {count}");
                assert!((0.7 * seen.len() as f64) < float.len() as f64);
                assert!(seen.iter().all(|one| one.0 < 0.05 || (0.3..=1.0).contains(&one.0)));
                // Two axes with the reported sigma each; the error wanders, so 300 s tell it coarsely.
                assert!((0.9..2.0).contains(&scatter), "{scatter}");
                assert!(wrong > 500, "{wrong} confident and wrong");
            }
            GnssConditionKind::Trees => {
                assert!((0.6..0.95).contains(&count), "some epochs are missing: {count}");
                let part = float.len() as f64 / seen.len() as f64;
                assert!((0.35..0.8).contains(&part), "now float, now fixed: {part}");
                assert!(seen.iter().all(|one| one.0 < 0.05 || (0.1..=0.6).contains(&one.0)));
                assert!((0.9..2.0).contains(&scatter) && wrong == 0, "{scatter} {wrong}");
            }
        }
        let after = fixes.iter().filter(|fix| fix.stamp.as_seconds() >= 400.0).count();
        assert!(after >= 999, "all fixes come again: {after}");
    }
}

#[test]
fn lidar_increments_are_off_by_what_the_scenario_says() {
    let scenario = load("navigation.toml");
    let simulation = Simulation::new(&scenario, 0);
    let poses: Vec<_> = Simulation::new(&scenario, 0)
        .filter_map(|arrival| match arrival.reading {
            Reading::LidarOdometry(pose) => Some(pose),
            _ => None,
        })
        .collect();
    let machine = simulation.machine();
    let imu_from_lidar = machine.frames.cabin_from_imu.pose::<(), ()>().motion().inverse()
        * *machine.frames.cabin_from_lidar.pose::<(), ()>().motion();
    let true_pose = |stamp| simulation.truth(stamp).imu.pose * imu_from_lidar;
    let (mut shifts, mut turns) = (Vec::new(), Vec::new());
    for pair in poses.windows(2) {
        let truth = true_pose(pair[0].stamp).inverse() * true_pose(pair[1].stamp);
        let seen = *(pair[0].lidarmap_from_lidar.inverse() * pair[1].lidarmap_from_lidar).motion();
        shifts.extend((seen.translation - truth.translation).iter().copied());
        turns.extend(seen.rotation.minus(&truth.rotation).iter().map(|turn| turn.to_degrees()));
    }
    let ((shift, shift_sigma), (turn, turn_sigma)) =
        (mean_and_deviation(&shifts), mean_and_deviation(&turns));
    assert!(shift.abs() < 3e-4 && (shift_sigma / 0.006 - 1.0).abs() < 0.05, "{shift} {shift_sigma}");
    assert!(turn.abs() < 2e-3 && (turn_sigma / 0.05 - 1.0).abs() < 0.05, "{turn} {turn_sigma}");
}

#[test]
fn encoder_reads_the_nearest_step() {
    let scenario = load("construction.toml");
    let simulation = Simulation::new(&scenario, 0);
    let step = std::f64::consts::TAU / 8192.0;
    let mut greatest: f64 = 0.0;
    for arrival in Simulation::new(&scenario, 0) {
        if let Reading::CabinTurn(turn) = arrival.reading {
            let error = turn.angle_rad - simulation.truth(turn.stamp).cabin_turn_rad;
            greatest = greatest.max(error.abs());
        }
    }
    assert!(greatest <= 0.5 * step * (1.0 + 1e-9) && greatest > 0.45 * step, "{greatest}");
}

#[test]
fn same_scenario_gives_the_same_bits_and_another_seed_does_not() {
    let mut scenario = load("construction.toml");
    let bits =
        |scenario: &Scenario| format!("{:?}", Simulation::new(scenario, 0).take(20_000).collect::<Vec<_>>());
    let first = bits(&scenario);
    assert!(first == bits(&load("construction.toml")));
    scenario.file.seed += 1;
    assert!(first != bits(&scenario));
}

#[test]
fn change_of_one_sensor_leaves_the_others_as_they_were() {
    let scenario = load("construction.toml");
    let mut changed = scenario.clone();
    changed.file.sensors.lidar_odometry.rate_hz = 10.0;
    changed.file.sensors.base_imu.gyroscope_noise_density = 1.0;
    let others = |scenario: &Scenario| {
        let untouched = |sensor| !matches!(sensor, Sensor::LidarOdometry | Sensor::BaseImu);
        let arrivals = Simulation::new(scenario, 1).filter(|one| untouched(one.reading.sensor()));
        arrivals.take_while(|one| one.arrival.as_seconds() < 60.0).collect::<Vec<_>>()
    };
    assert!(others(&scenario) == others(&changed));
}

#[test]
fn gnss_condition_changes_nothing_after_it() {
    let fixes_after = |scenario: &Scenario| {
        let after = |fix: &GnssFix| fix.stamp.as_seconds() >= 400.0;
        left_fixes(scenario, 0).into_iter().filter(after).collect::<Vec<_>>()
    };
    let blocked = fixes_after(&with_condition(GnssConditionKind::Blocked));
    assert!(!blocked.is_empty() && blocked == fixes_after(&with_condition(GnssConditionKind::Trees)));
}

#[test]
fn readings_come_without_gaps_in_the_order_of_arrival_and_late_by_their_latency() {
    let scenario = load("demo.toml");
    let expected = [(Sensor::Imu, 100.0, 0.002), (Sensor::BaseImu, 100.0, 0.002)]
        .into_iter()
        .chain([(Sensor::LidarOdometry, 5.0, 0.11), (Sensor::CabinTurn, 100.0, 0.004)])
        .chain([(Sensor::GnssLeft, 20.0, 0.06), (Sensor::GnssRight, 20.0, 0.06)]);
    // Past the first repetition: 177 s for the first machine. Its GNSS is blocked from 60 s to 85 s.
    let end_s = 400.0;
    let arrivals: Vec<Arrival> =
        Simulation::new(&scenario, 0).take_while(|arrival| arrival.arrival.as_seconds() < end_s).collect();
    assert!(arrivals.windows(2).all(|pair| pair[0].arrival <= pair[1].arrival));
    for (sensor, rate_hz, latency_s) in expected {
        let own: Vec<&Arrival> = arrivals.iter().filter(|one| one.reading.sensor() == sensor).collect();
        let late: Vec<f64> = own.iter().map(|one| one.arrival.seconds_since(one.reading.stamp())).collect();
        let (mean, sigma) = mean_and_deviation(&late);
        assert!(
            (mean - latency_s).abs() < 0.1 * latency_s && sigma > 0.05 * latency_s,
            "{sensor} {mean} {sigma}"
        );
        for pair in own.windows(2) {
            let step_s = pair[1].reading.stamp().seconds_since(pair[0].reading.stamp());
            let blocked = latency_s == 0.06 && step_s > 24.9;
            assert!((step_s * rate_hz - 1.0).abs() < 0.01 || blocked, "{sensor}: {step_s} s");
        }
        assert!(own.len() as f64 > 0.85 * rate_hz * end_s, "{sensor}: {}", own.len());
    }
}

#[test]
fn sensors_are_not_in_step() {
    let first = |wanted: Sensor| {
        let mut arrivals = Simulation::new(&load("construction.toml"), 0);
        arrivals.find(|one| one.reading.sensor() == wanted).map(|one| one.reading.stamp().as_nanos())
    };
    let imu = first(Sensor::Imu).expect("imu");
    for sensor in [Sensor::GnssLeft, Sensor::LidarOdometry, Sensor::CabinTurn, Sensor::BaseImu] {
        let phase = (first(sensor).expect("reading") - imu).rem_euclid(10_000_000);
        assert!((100_000..9_900_000).contains(&phase), "{sensor} is {phase} ns off the IMU");
    }
}

#[test]
fn motion_repeats_without_a_step() {
    let scenario = load("demo.toml");
    for index in 0..2 {
        let simulation = Simulation::new(&scenario, index);
        let period = Span::from_seconds(simulation.motion.period_s());
        for round in 1..3 {
            let end = Stamp::from_nanos(period.as_nanos() * round);
            let [before, after] = [end - Span::from_nanos(1), end].map(|at| simulation.truth(at));
            assert!((after.state.position - before.state.position).norm() < 1e-9);
            assert!(after.state.rotation.minus(&before.state.rotation).norm() < 1e-9);
            assert!((after.imu.acceleration - before.imu.acceleration).norm() < 1e-6);
        }
    }
}

#[test]
fn chassis_stands_still_while_the_cabin_digs_and_drives_as_far_as_told() {
    let construction = load("construction.toml");
    for index in 0..2 {
        let simulation = Simulation::new(&construction, index);
        let at = |time_s: f64| simulation.truth(Stamp::from_seconds(time_s));
        let digging = (0..20_000)
            .map(|tick| at(f64::from(tick) * 0.01))
            .filter(|truth| truth.cabin_turn_rate.abs() > 0.2 && truth.base.velocity.norm() == 0.0);
        let digging: Vec<Truth> = digging.collect();
        assert!(digging.len() > 3000, "{}", digging.len());
        assert!(digging.iter().all(|truth| truth.base.angular_rate == Vec3::zeros()));
        assert!(
            (0..950).all(|tick| at(f64::from(tick) * 0.01).imu.velocity == Vec3::zeros()),
            "starts at rest"
        );
    }
    let navigation = load("navigation.toml");
    for index in 0..2 {
        let simulation = Simulation::new(&navigation, index);
        let at = |tick: i32| simulation.truth(Stamp::from_seconds(f64::from(tick) * 0.1));
        let way_m: f64 = (0..4500).map(|tick| at(tick).base.velocity.norm() * 0.1).sum();
        assert!((way_m - 500.0).abs() < 5.0, "{way_m}");
        let tilt = |truth: Truth| (truth.world_from_base.rotation() * Vec3::z()).angle(&Vec3::z());
        let steepest_deg = (0..4500).map(|tick| tilt(at(tick)).to_degrees()).fold(0.0, f64::max);
        assert!((1.5..8.0).contains(&steepest_deg), "{steepest_deg}");
    }
}

#[test]
fn one_imu_is_upright_and_one_upside_down() {
    let scenario = load("construction.toml");
    let up = |index| {
        let truth = Simulation::new(&scenario, index).truth(Stamp::default());
        truth.state.rotation.inverse() * Vec3::z()
    };
    assert!(up(0).z > 0.98 && up(1).z < -0.98);
}

#[test]
fn written_scenario_reads_back_as_it_was_simulated() {
    let mut scenario = load("demo.toml");
    scenario.file.duration_s = 70.0;
    let out = std::env::temp_dir().join(format!("holdfast-simulate-{}", std::process::id()));
    let mut fractions = Vec::new();
    write(&scenario, &out, |progress| fractions.push(progress.fraction)).expect("written");
    assert!(fractions.is_sorted() && fractions.last() == Some(&1.0) && fractions.len() > 100);
    for (index, id) in scenario.machine_ids().into_iter().enumerate() {
        let folder = crate::import::read_log_folder(&out.join(id)).expect("readable");
        let simulation = Simulation::new(&scenario, index).ending_at(Stamp::from_seconds(70.0));
        let simulated: Vec<Arrival> = simulation.collect();
        assert_eq!(folder.arrivals.len(), simulated.len());
        for (read, made) in folder.arrivals.iter().zip(&simulated) {
            match (read.reading, made.reading) {
                // A quaternion is normalized again on reading, which may move its last bit.
                (Reading::LidarOdometry(read), Reading::LidarOdometry(made)) => {
                    assert_eq!(read.stamp, made.stamp);
                    assert!(
                        (read.lidarmap_from_lidar.inverse() * made.lidarmap_from_lidar).motion().log().norm()
                            < 1e-15
                    );
                }
                _ => assert_eq!(read, made),
            }
        }
        let simulation = Simulation::new(&scenario, index);
        let truth = folder.truth.expect("truth_imu.tum");
        assert_eq!(truth.len(), simulated.iter().filter(|one| one.reading.sensor() == Sensor::Imu).count());
        for posed in truth {
            let state = simulation.truth(posed.stamp).state;
            assert_eq!(posed.pose.translation, state.position);
            assert!(posed.pose.rotation.minus(&state.rotation).norm() < 1e-15);
        }
        let intervals =
            crate::import::read_intervals(&out.join(id).join("gnss_truth.csv")).expect("readable");
        let names: Vec<&str> = intervals.iter().map(|one| one.condition.as_str()).collect();
        assert_eq!(names, if index == 0 { vec!["good", "blocked"] } else { vec!["good"] });
        assert_eq!(intervals[names.len() - 1].end, Stamp::from_seconds(70.0));
    }
    std::fs::remove_dir_all(&out).expect("removed");
}

#[test]
fn scenario_that_cannot_be_is_refused_with_its_line() {
    let text = std::fs::read_to_string(shipped("demo.toml")).expect("shipped");
    let error = |from: &str, to: &str| {
        let changed = text.replacen(from, to, 1);
        assert!(changed != text, "{from}");
        crate::config::parse::<ScenarioFile>(&changed, Path::new("s.toml"))
            .expect_err("must be refused")
            .to_string()
    };
    let message = error("distance_m = -18.0", "distance_m = -17.0");
    assert!(message.contains("drives add up to 1"), "{message}");
    let message = error("distance_m = 12.0", "distance_m = 120.0");
    assert!(message.contains("drives from 0 m to 126 m on a way of"), "{message}");
    let message = error("kind = \"blocked\"", "kind = \"sunny\"");
    assert!(message.starts_with("s.toml:11:") && message.contains("sunny"), "{message}");
    let message = error("speed_mps = 0.6", "speed_kmh = 0.6");
    assert!(message.contains("unknown field `speed_kmh`"), "{message}");
    let message = error("repeat = true", "repeat = true\n[sensors.gnss]\nrate_hz = 0.0\n");
    assert!(message.contains("sensors.gnss.rate_hz is 0"), "{message}");
}

#[test]
fn angles_of_a_turn_about_the_vertical_are_heading() {
    let rotation = So3::from_yaw_pitch_roll(0.3, 0.0, 0.0);
    let jets = [jet::Jet::new(0.3, 0.5, -0.2), jet::Jet::default(), jet::Jet::default()];
    let motion = RigidMotion::new([jet::Jet::default(); 3], jets);
    assert!(motion.pose.rotation.minus(&rotation).norm() < 1e-15);
    assert_eq!(motion.angular_rate, Vec3::z() * 0.5);
    assert_eq!(motion.angular_acceleration, Vec3::z() * -0.2);
}
