//! How good the estimate is on the shipped scenarios, and what the files of a run hold.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use holdfast::import::{Interval, StampedPose, read_tum};
use serde_json::Value;

use crate::command::{empty_folder, estimate, holdfast, repository};
use crate::fixtures::{Log, simulated, true_pose};

/// Of `estimate.csv`, as the contract says it.
const ESTIMATE_HEADER: &str =
    "t,x,y,z,qx,qy,qz,qw,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz,sd_x,sd_y,sd_z,sd_roll,sd_pitch,sd_yaw,mode";
/// Files that a run writes, `summary.json` apart.
const SAME_BITS: [&str; 5] = ["world.tum", "odom.tum", "base_odom.tum", "estimate.csv", "events.jsonl"];
/// Position while GNSS is good, over all its epochs.
const GOOD_POSITION_RMSE_MAX_M: f64 = 0.02;
const GOOD_HEADING_RMSE_MAX_DEG: f64 = 0.1;
/// What odom may add to the true motion between two samples.
const ODOM_STEP_MAX_M: f64 = 0.002;

fn first_fields(path: &Path, separator: char) -> Vec<String> {
    let text = fs::read_to_string(path).expect("file");
    text.lines().map(|line| line.split(separator).next().expect("field").to_owned()).collect()
}

/// Everything the contract says of the files of one run.
fn check_files(log: &Log, out: &Path) {
    let stamps = first_fields(&out.join("world.tum"), ' ');
    let imu = fs::read_to_string(log.folder.join("imu.csv")).expect("imu.csv");
    let sampled: Vec<&str> = imu.lines().skip(1).map(|row| row.split(',').nth(1).expect("stamp")).collect();
    let begin = sampled.iter().position(|stamp| *stamp == stamps[0]).expect("starts at a sample");
    assert!(begin < 500, "{}: starts only after {begin} samples", log.name);
    assert_eq!(stamps, sampled[begin..], "{}: one pose for every sample since the start", log.name);
    for name in ["odom.tum", "base_odom.tum"] {
        assert_eq!(first_fields(&out.join(name), ' '), stamps, "{}: {name}", log.name);
    }
    let estimates = fs::read_to_string(out.join("estimate.csv")).expect("estimate.csv");
    assert_eq!(estimates.lines().next(), Some(ESTIMATE_HEADER));
    assert_eq!(first_fields(&out.join("estimate.csv"), ',')[1..], stamps);
    let columns = ESTIMATE_HEADER.split(',').count();
    let modes = ["main", "fallback", "imu_only"];
    for (line, row) in estimates.lines().enumerate().skip(1) {
        let fields: Vec<&str> = row.split(',').collect();
        assert_eq!(fields.len(), columns, "estimate.csv:{}", line + 1);
        let numbers = fields[..columns - 1].iter().map(|field| field.parse::<f64>().expect("number"));
        assert!(numbers.into_iter().all(f64::is_finite), "estimate.csv:{}: {row}", line + 1);
        assert!(modes.contains(&fields[columns - 1]), "estimate.csv:{}: {row}", line + 1);
    }
    let events = fs::read_to_string(out.join("events.jsonl")).expect("events.jsonl");
    for line in events.lines() {
        let event: Value = serde_json::from_str(line).expect("an event is a line of JSON");
        assert!(event["kind"].is_string() && event["stamp_ns"].is_i64(), "{line}");
    }
    check_summary(log, &out.join("summary.json"), sampled.len(), stamps.len());
}

fn check_summary(log: &Log, path: &Path, samples: usize, estimates: usize) {
    let summary: Value = serde_json::from_str(&fs::read_to_string(path).expect("summary")).expect("JSON");
    for key in ["imu_samples", "updates", "data_s", "wall_s", "peak_rss_bytes"] {
        assert!(summary[key].as_f64().is_some_and(|value| value > 0.0), "{}: {key}: {summary}", log.name);
    }
    assert_eq!(summary["imu_samples"], samples);
    assert_eq!(summary["estimates"], estimates);
    for (part, keys) in [
        ("predict_us", &["mean", "sd", "p50", "p99", "p999", "max"][..]),
        ("update_us", &["mean", "sd", "p50", "p99", "p999", "max"]),
        ("consistency_cm", &["mean", "sd"]),
    ] {
        for key in keys {
            assert!(summary[part][key].is_f64(), "{}: {part}.{key}: {summary}", log.name);
        }
    }
    let outages = summary["outages"].as_array().expect("outages");
    assert!(!outages.is_empty(), "{}: GNSS has let go, and nothing is told", log.name);
    for outage in outages {
        let keys: BTreeSet<&str> =
            outage.as_object().expect("an object").keys().map(String::as_str).collect();
        for key in ["start_s", "end_s", "cause", "travelled_m", "jump_m"] {
            assert!(keys.contains(key), "{}: {key}: {outage}", log.name);
        }
    }
}

/// `holdfast evaluate` on `world.tum`: RMSE of position (m) and heading (degrees) while GNSS is good.
fn errors_while_good(log: &Log, out: &Path) -> (f64, f64) {
    let paths = [
        ("--truth", log.folder.join("truth_imu.tum")),
        ("--estimate", out.join("world.tum")),
        ("--intervals", log.folder.join("gnss_truth.csv")),
        ("--out", out.join("evaluation")),
    ];
    let mut arguments = vec!["evaluate".into(), "--only".into(), "good".into()];
    arguments.extend(paths.into_iter().flat_map(|(name, path)| [name.into(), path.into_os_string()]));
    let ended = holdfast(&arguments);
    assert_eq!(ended.code, 0, "{ended:?}");
    let report = fs::read_to_string(out.join("evaluation/report.json")).expect("report.json");
    let report: Value = serde_json::from_str(&report).expect("JSON");
    let errors = &report["estimates"][0]["errors"];
    let rmse = |part: &str| errors[part]["rmse"].as_f64().expect("a figure");
    (rmse("position_m"), rmse("heading_deg"))
}

/// The largest difference (m) between the motion of odom and the true one from one sample to the next: over all
/// samples, and from the first moment without good GNSS to 10 s after the last.
fn largest_odom_steps(odom: &[StampedPose], truth: &[StampedPose], intervals: &[Interval]) -> [f64; 2] {
    let bad = || intervals.iter().filter(|interval| interval.condition != "good");
    let (from, to) = (bad().map(|one| one.start).min(), bad().map(|one| one.end).max());
    let mut largest = [0.0_f64; 2];
    for pair in odom.windows(2) {
        let [before, after] = pair else { continue };
        let true_pose =
            |pose: &StampedPose| true_pose(truth, pose.stamp).expect("truth at every sample").pose;
        let seen = before.pose.inverse() * after.pose;
        let real = true_pose(before).inverse() * true_pose(after);
        let step_m = (seen.translation - real.translation).norm();
        largest[0] = largest[0].max(step_m);
        if from.is_some_and(|from| from <= before.stamp)
            && to.is_some_and(|to| after.stamp.seconds_since(to) < 10.0)
        {
            largest[1] = largest[1].max(step_m);
        }
    }
    largest
}

fn is_as_good_as_it_must_be(scenario: &'static str) {
    for log in simulated(scenario) {
        let out = empty_folder(&format!("estimate-{}", log.name.replace(' ', "-")));
        let ended = estimate(&log.folder, &log.machine, &out);
        assert_eq!(ended.code, 0, "{}: {ended:?}", log.name);
        assert!(ended.stdout.contains("estimates from"), "{}", ended.stdout);
        check_files(log, &out);

        let (position_m, heading_deg) = errors_while_good(log, &out);
        let odom = read_tum(&out.join("odom.tum")).expect("odom.tum");
        let [step_m, step_in_outage_m] = largest_odom_steps(&odom, &log.truth(), &log.intervals());
        println!(
            "{}: RMSE with good GNSS {:.1} mm, {heading_deg:.3}°; odom's largest step {:.2} mm, through outage and recovery {:.2} mm",
            log.name,
            1e3 * position_m,
            1e3 * step_m,
            1e3 * step_in_outage_m,
        );
        assert!(position_m <= GOOD_POSITION_RMSE_MAX_M, "{}: RMSE {position_m} m", log.name);
        assert!(heading_deg <= GOOD_HEADING_RMSE_MAX_DEG, "{}: RMSE {heading_deg}°", log.name);
        assert!(step_m <= ODOM_STEP_MAX_M, "{}: odom steps by {step_m} m", log.name);
    }
}

#[test]
fn construction_task_is_as_good_as_it_must_be() {
    is_as_good_as_it_must_be("construction");
}

#[test]
fn navigation_task_is_as_good_as_it_must_be() {
    is_as_good_as_it_must_be("navigation");
}

#[test]
fn two_runs_give_the_same_bits() {
    let log = &simulated("construction")[0];
    let [first, second] = ["same-bits-1", "same-bits-2"].map(empty_folder);
    for out in [&first, &second] {
        let ended = estimate(&log.folder, &log.machine, out);
        assert_eq!(ended.code, 0, "{ended:?}");
    }
    for name in SAME_BITS {
        let [one, two] = [&first, &second].map(|out| fs::read(out.join(name)).expect(name));
        assert!(!one.is_empty(), "{name}");
        assert!(one == two, "{name} differs between two runs");
    }
}

#[test]
fn every_shipped_machine_file_is_valid() {
    let mut files: Vec<_> = fs::read_dir(repository("config/machines"))
        .expect("config/machines")
        .map(|entry| entry.expect("entry").path())
        .collect();
    files.sort();
    assert!(files.len() >= 4, "{files:?}");
    let arguments: Vec<_> = std::iter::once("check".into())
        .chain(files.iter().map(|file| file.clone().into_os_string()))
        .collect();
    let ended = holdfast(&arguments);
    assert_eq!(ended.code, 0, "{ended:?}");
    assert_eq!(ended.stdout.lines().count(), files.len());
    assert!(ended.stdout.lines().all(|line| line.contains(": ok, ")), "{}", ended.stdout);
}
