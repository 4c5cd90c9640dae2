//! What it costs to solve a whole session at once.
//!
//! `cargo bench --no-default-features --bench batch -- [MINUTES]` runs one machine of the demo's scenario, which has an
//! outage every few minutes, and solves what its estimator built; 10 minutes unless told. All on one thread.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Instant;

use holdfast::reference::{Memory, forward, smooth};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::time::Stamp;

/// Memory the process holds now and held at most, MB, as the system says it; zeros where it does not.
fn memory_mb() -> [f64; 2] {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ["VmRSS:", "VmHWM:"].map(|name| {
        let line = status.lines().find_map(|line| line.strip_prefix(name));
        let kilobytes: Option<f64> = line.and_then(|rest| rest.split_whitespace().next()?.parse().ok());
        kilobytes.unwrap_or(0.0) / 1e3
    })
}

#[allow(clippy::disallowed_methods, reason = "what is measured here is time")]
fn main() {
    let minutes: u32 = std::env::args().filter_map(|argument| argument.parse().ok()).next().unwrap_or(10);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario = Scenario::load(&root.join("config/scenarios/demo.toml")).expect("a valid scenario");
    let simulation = Simulation::new(&scenario, 0);
    let options = simulation.machine().estimator_options();
    let end = Stamp::from_seconds(60.0 * f64::from(minutes));
    let arrivals: Vec<_> = simulation.take_while(|arrival| arrival.arrival < end).collect();
    let [readings_mb, _] = memory_mb();
    let memory = Memory { allowed_mb: usize::MAX, goes_on_without: false };
    let begun = Instant::now();
    let run = forward(&arrivals, &BTreeSet::new(), options, memory, |_, _| {});
    let forward_s = begun.elapsed().as_secs_f64();
    let [forward_mb, _] = memory_mb();
    let begun = Instant::now();
    let smoothed = smooth(&run, |_| {}).expect("the session can be solved");
    let batch_s = begun.elapsed().as_secs_f64();
    let [_, most_mb] = memory_mb();
    let nodes: usize = smoothed.chains.iter().map(|chain| chain.nodes.len()).sum();
    println!("{minutes} min, {} readings ({readings_mb:.0} MB): estimator {forward_s:.2} s", arrivals.len());
    for chain in &smoothed.chains {
        println!(
            "  {} nodes, {:?}, {} steps, converged {}",
            chain.nodes.len(),
            chain.factors,
            chain.iterations,
            chain.converged
        );
    }
    let node_kb = |mb: f64| 1e3 * mb / nodes as f64;
    println!(
        "batch of {nodes} nodes: {batch_s:.2} s; kept {:.1} kB a node, batch {:.1} kB a node, {most_mb:.0} MB at most",
        node_kb(forward_mb - readings_mb),
        node_kb(most_mb - forward_mb)
    );
    let gain = smoothed.gain(&run.live);
    for part in &gain.parts {
        println!(
            "  {}: live is off by {:.1} cm rms, {:.1} cm at most; sigma {:.1} cm live, {:.1} cm smoothed",
            part.name,
            100.0 * part.horizontal_m.rmse,
            100.0 * part.horizontal_m.max,
            100.0 * part.live_sigma_m,
            100.0 * part.smoothed_sigma_m
        );
    }
}
