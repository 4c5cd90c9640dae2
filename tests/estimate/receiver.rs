//! Receivers that are not as good as they say.

use holdfast::estimator::{Estimator, Options};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::time::Stamp;

use crate::command::repository;

const SEEDS: [u64; 3] = [31, 32, 33];
/// After so long the inflation is learned, s.
const LEARNED_S: f64 = 60.0;
const END_S: f64 = 150.0;

/// Mean over machines and seeds.
#[derive(Debug)]
struct Consistency {
    /// Squared position errors over their variances; 1 is as good as it says.
    nees: [f64; 3],
    rmse_cm: f64,
    /// Horizontal and vertical, at the end.
    inflation: [f64; 2],
}

/// The construction task with the sky open, whose fixes have `sigma_m` up to a factor for the height.
fn consistency(sigma_m: f64, reported_sigma_scale: f64) -> Consistency {
    consistency_of(sigma_m, reported_sigma_scale, |_, _| {})
}

/// The same with the scenario and the estimator's options changed.
fn consistency_of(
    sigma_m: f64,
    reported_sigma_scale: f64,
    change: impl Fn(&mut Scenario, &mut Options),
) -> Consistency {
    let (mut squared, mut normalized, mut inflation) = (0.0, [0.0; 3], [0.0; 2]);
    let (mut count, mut runs) = (0.0, 0.0);
    for seed in SEEDS {
        let mut scenario =
            Scenario::load(&repository("config/scenarios/construction.toml")).expect("scenario");
        scenario.file.seed = seed;
        scenario.file.gnss_condition.clear();
        scenario.file.sensors.gnss.sigma_enu_m = [sigma_m, sigma_m, 1.75 * sigma_m];
        scenario.file.sensors.gnss.reported_sigma_scale = reported_sigma_scale;
        for machine in 0..scenario.machines.len() {
            let mut options = scenario.machines[machine].estimator_options();
            change(&mut scenario, &mut options);
            let mut simulation = Simulation::new(&scenario, machine).ending_at(Stamp::from_seconds(END_S));
            let mut estimator = Estimator::new(options);
            while let Some(arrival) = simulation.next() {
                let Some(estimate) = estimator.push(&arrival) else { continue };
                if estimate.stamp < Stamp::from_seconds(LEARNED_S) {
                    continue;
                }
                let error = estimate.state.position - simulation.truth(estimate.stamp).state.position;
                let sigma = estimate.position_sigma_m();
                (0..3).for_each(|axis| normalized[axis] += (error[axis] / sigma[axis]).powi(2));
                squared += error.norm_squared();
                count += 1.0;
            }
            let learned = estimator.health().gnss_inflation;
            (0..2).for_each(|part| inflation[part] += learned[part]);
            runs += 1.0;
        }
    }
    Consistency {
        nees: normalized.map(|sum| sum / count),
        rmse_cm: 100.0 * f64::sqrt(squared / count),
        inflation: inflation.map(|sum| sum / runs),
    }
}

#[test]
fn honest_receiver_is_taken_at_its_word() {
    let honest = consistency(0.008, 1.0);
    println!("honest receiver: {honest:.3?}");
    assert!(honest.inflation.iter().all(|factor| (factor - 1.0).abs() < 0.03), "{honest:?}");
    assert!(honest.rmse_cm < 0.4, "{honest:?}");
}

#[test]
fn receiver_that_is_too_sure_is_found_out() {
    let honest = consistency(0.02, 1.0);
    for scale in [0.5, 1.0 / 3.0] {
        let told = consistency(0.02, scale);
        println!("receiver that reports {scale:.2} of its sigma: {told:.3?}; honest {honest:.3?}");
        assert!(told.nees.iter().all(|nees| (0.4..1.5).contains(nees)), "{told:?}");
        let right = told.inflation.iter().all(|factor| (factor * scale - 1.0).abs() < 0.15);
        assert!(right, "{told:?}");
        assert!(told.rmse_cm < 1.15 * honest.rmse_cm, "{told:?} for {honest:?}");
    }
}

#[test]
fn slow_errors_that_the_configuration_knows_of_count_once() {
    // Innovations do not show them: the estimate follows.
    let slow = |known: bool| {
        consistency_of(0.008, 1.0, move |scenario, options| {
            scenario.file.sensors.gnss.slow_sigma_enu_m = [0.005, 0.005, 0.009];
            scenario.file.sensors.gnss.slow_time_s = 10.0;
            if known {
                (options.gate.slow_sigma_m, options.gate.slow_time_s) = (0.006, 10.0);
            }
        })
    };
    let (unknown, known) = (slow(false), slow(true));
    println!("slow errors, unknown: {unknown:.3?}; known: {known:.3?}");
    assert!(unknown.nees.iter().any(|nees| *nees > 3.0), "else this test shows nothing: {unknown:?}");
    assert!(known.nees.iter().all(|nees| (0.5..1.6).contains(nees)), "{known:?}");
    // Fixes that count less average less of their white part: that is the price.
    assert!(known.rmse_cm < 1.4 * unknown.rmse_cm, "{known:?} for {unknown:?}");
}
