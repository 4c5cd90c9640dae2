//! Behaviour of the simulator, on the scenarios that are shipped.

mod gnss;
mod motion;

use std::path::{Path, PathBuf};

use super::*;
use crate::lie::Vec3;
use crate::sensors::{ImuSample, Sensor};

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

fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (mean, (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt())
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
        assert_eq!(names, if index == 0 { vec!["good", "blocked", "good"] } else { vec!["good"] });
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
