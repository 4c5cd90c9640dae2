//! Predictor and updater as on a machine whose updater falls behind.

use std::path::Path;

use holdfast::config;
use holdfast::estimator::split;
use holdfast::simulate::{Scenario, Simulation};
use holdfast::time::Stamp;

#[test]
fn estimate_starts_though_the_first_solution_comes_too_late_to_be_carried_on() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario = Scenario::load(&root.join("config/scenarios/construction.toml")).expect("valid");
    let machine: config::Machine =
        config::load(&root.join("config/machines/simulated-roof.toml")).expect("valid");
    let (mut predictor, mut updater) = split(machine.estimator_options());
    let end = Stamp::from_seconds(25.0);
    let arrivals: Vec<_> = Simulation::new(&scenario, 0).ending_at(end).collect();
    // The updater's thread sleeps for twenty seconds, then catches up within one.
    let begin = arrivals.partition_point(|arrival| arrival.arrival < Stamp::from_seconds(20.0));
    let mut waiting = arrivals.iter();
    let mut last = None;
    for (index, arrival) in arrivals.iter().enumerate() {
        last = predictor.push(arrival).or(last);
        let work = if index < begin { 0 } else { 100 };
        for late in waiting.by_ref().take(work.min(index)) {
            if let Some(solution) = updater.push(late) {
                predictor.adopt(&solution);
            }
        }
    }
    let last = last.expect("the estimate has started");
    assert!(end - last.stamp < holdfast::time::Span::from_millis(50), "{:?}", last.stamp);
}
