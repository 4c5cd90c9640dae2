//! How the estimate starts without two antennas or without a standstill.

use std::fs;

use holdfast::evaluate::{Options, compare};
use holdfast::import::read_tum;
use holdfast::time::Stamp;

use crate::command::{empty_folder, estimate};
use crate::fixtures::{simulated, without_right_antenna};

/// After so long the start is forgotten, s.
const SETTLED_S: f64 = 30.0;
const POSITION_RMSE_MAX_M: f64 = 0.02;

/// Runs the log from `from_s` on with one antenna; the heading must come from motion.
fn starts_from_motion(name: &str, scenario: &'static str, from_s: f64) {
    for log in simulated(scenario) {
        let folder = empty_folder(&format!("start-{name}-{}", log.name.replace(' ', "-")));
        let (cut, machine, out) = (folder.join("log"), folder.join("machine.toml"), folder.join("out"));
        fs::create_dir(&cut).expect("folder");
        log.cut(&cut, from_s, f64::INFINITY);
        fs::remove_file(cut.join("gnss_right.csv")).expect("remove");
        without_right_antenna(&log.machine, &machine);

        let ended = estimate(&cut, &machine, &out);

        assert_eq!(ended.code, 0, "{}: {ended:?}", log.name);
        let events = fs::read_to_string(out.join("events.jsonl")).expect("events");
        let starts: Vec<&str> = events.lines().filter(|line| line.contains("\"initialized\"")).collect();
        assert_eq!(starts.len(), 1, "{}: {starts:?}", log.name);
        assert!(starts[0].contains("\"heading_from\":\"motion\""), "{}: {}", log.name, starts[0]);

        let estimates = read_tum(&out.join("world.tum")).expect("world.tum");
        let start = estimates[0].stamp;
        let settled: Vec<_> =
            estimates.into_iter().filter(|pose| pose.stamp.seconds_since(start) >= SETTLED_S).collect();
        let mut intervals = log.intervals();
        // What comes back after an outage is judged elsewhere; here it is the start.
        intervals.truncate(1);
        assert_eq!(intervals[0].start, Stamp::from_nanos(0));
        let only = Some("good".to_owned());
        let report = compare(&log.truth(), &settled, &Options { intervals, only, ..Options::default() });
        let errors = report.expect("something to compare").errors;
        println!(
            "{} {name}: starts at {start} s; from {SETTLED_S} s after on RMSE {:.1} mm, {:.3}°",
            log.name,
            1e3 * errors.position_m.rmse,
            errors.heading_deg.rmse
        );
        assert!(errors.position_m.rmse <= POSITION_RMSE_MAX_M, "{}: {errors:?}", log.name);
    }
}

#[test]
fn one_antenna_and_no_standstill_starts_from_motion_in_the_construction_task() {
    starts_from_motion("in-motion", "construction", 12.0);
}

#[test]
fn one_antenna_and_no_standstill_starts_from_motion_in_the_navigation_task() {
    starts_from_motion("in-motion", "navigation", 12.0);
}

#[test]
fn one_antenna_and_a_standstill_starts_with_the_first_motion() {
    starts_from_motion("from-rest", "construction", 0.0);
}
