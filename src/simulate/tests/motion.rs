//! The truth: smooth, consistent with its derivatives, and what the scenario tells.

use super::*;
use crate::lie::So3;

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
fn angles_of_a_turn_about_the_vertical_are_heading() {
    let rotation = So3::from_yaw_pitch_roll(0.3, 0.0, 0.0);
    let jets = [jet::Jet::new(0.3, 0.5, -0.2), jet::Jet::default(), jet::Jet::default()];
    let motion = RigidMotion::new([jet::Jet::default(); 3], jets);
    assert!(motion.pose.rotation.minus(&rotation).norm() < 1e-15);
    assert_eq!(motion.angular_rate, Vec3::z() * 0.5);
    assert_eq!(motion.angular_acceleration, Vec3::z() * -0.2);
}
