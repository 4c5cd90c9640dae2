//! Whether memory and the time of an update stay what they are, for as long as a machine works.
//!
//! `cargo bench --no-default-features --bench endurance -- [HOURS]` runs one machine of the demo's scenario, which has an
//! outage every few minutes, and prints a line for each hour of data.

use std::path::Path;
use std::time::Instant;

use holdfast::estimator::Estimator;
use holdfast::replay::Times;
use holdfast::sensors::Reading;
use holdfast::simulate::{Scenario, Simulation};
use holdfast::time::Stamp;

/// Memory the process holds now, kB, as the system says it; 0 where it does not.
fn resident_kb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|rest| rest.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

#[allow(clippy::disallowed_methods, reason = "what is measured here is time")]
fn main() {
    let hours: u32 = std::env::args().filter_map(|argument| argument.parse().ok()).next().unwrap_or(2);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario = Scenario::load(&root.join("config/scenarios/demo.toml")).expect("a valid scenario");
    let mut simulation = Simulation::new(&scenario, 0);
    let mut estimator = Estimator::new(simulation.machine().estimator_options());
    println!("  hour   memory kB   update µs: mean   99 %   predict µs: mean   farthest from the origin m");
    for hour in 1..=hours {
        let end = Stamp::from_seconds(3600.0 * f64::from(hour));
        let (mut update, mut predict) = (Times::default(), Times::default());
        let mut farthest_m = 0.0_f64;
        for arrival in simulation.by_ref().take_while(|arrival| arrival.arrival < end) {
            let before = Instant::now();
            let estimate = estimator.predict(&arrival);
            let predicted = Instant::now();
            let updated = estimator.update(&arrival).is_some();
            let after = predicted.elapsed();
            estimator.take_events();
            if updated {
                update.note(after.as_nanos() as u64);
            }
            if matches!(arrival.reading, Reading::Imu(_)) {
                predict.note((predicted - before).as_nanos() as u64);
            }
            if let Some(estimate) = estimate {
                farthest_m = farthest_m.max(estimate.state.position.norm());
            }
        }
        assert!(farthest_m.is_finite(), "the estimate stays finite");
        let (update, predict) = (update.distribution(), predict.distribution());
        println!(
            "  {hour:>4} {:>11} {:>17.1} {:>6.0} {:>18.2} {:>28.1}",
            resident_kb(),
            update.mean,
            update.p99,
            predict.mean,
            farthest_m
        );
    }
}
