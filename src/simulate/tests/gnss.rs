//! The GNSS receiver, good and bad.

use super::*;
use crate::sensors::GnssFix;

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

fn with_condition(kind: GnssConditionKind) -> Scenario {
    let mut scenario = load("navigation.toml");
    let (start_s, end_s, machines) = (100.0, 400.0, Vec::new());
    scenario.file.gnss_condition = vec![GnssCondition { start_s, end_s, kind, machines, offset_m: None }];
    scenario
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
fn slow_errors_stay_alike_and_the_receiver_reports_what_it_is_told_to() {
    let mut scenario = load("construction.toml");
    scenario.file.gnss_condition.clear();
    let gnss = &mut scenario.file.sensors.gnss;
    gnss.slow_sigma_enu_m = [0.006; 3];
    gnss.slow_time_s = 2.0;
    gnss.reported_sigma_scale = 0.5;
    let simulation = Simulation::new(&scenario, 0);
    let fixes = left_fixes(&scenario, 0);
    let reported = fixes[0].sigma_enu_m;
    assert!((reported.x - 0.5 * 0.01).abs() < 1e-12, "half of 8 mm and 6 mm together: {reported}");
    let errors: Vec<f64> = fixes.iter().map(|fix| error_of(&simulation, fix).x).collect();
    let (_, sigma) = mean_and_deviation(&errors);
    assert!((sigma / 0.01 - 1.0).abs() < 0.1, "{sigma}");
    // A second apart, at 20 Hz, only the slow part is alike, by exp(-1/2).
    let alike: f64 = errors.iter().zip(&errors[20..]).map(|(before, after)| before * after).sum();
    let alike = alike / (errors.len() - 20) as f64;
    let expected = 0.006_f64.powi(2) * (-0.5_f64).exp();
    assert!((alike / expected - 1.0).abs() < 0.35, "{alike} for {expected}");
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
fn gnss_condition_changes_nothing_after_it() {
    let fixes_after = |scenario: &Scenario| {
        let after = |fix: &GnssFix| fix.stamp.as_seconds() >= 400.0;
        left_fixes(scenario, 0).into_iter().filter(after).collect::<Vec<_>>()
    };
    let blocked = fixes_after(&with_condition(GnssConditionKind::Blocked));
    assert!(!blocked.is_empty() && blocked == fixes_after(&with_condition(GnssConditionKind::Trees)));
}
