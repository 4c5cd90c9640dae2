//! `holdfast estimate --realtime`: two threads, the same files, and takeovers with which they come out again to
//! the bit.

#[path = "support/command.rs"]
mod command;

use std::fs;
use std::path::{Path, PathBuf};

use holdfast::config::{self, Machine};
use holdfast::export::LogFolderWriter;
use holdfast::import::{StampedPose, read_log_folder, read_tum};
use holdfast::replay::{Outputs, again};
use holdfast::sensors::Reading;
use holdfast::simulate::{Scenario, Simulation};
use holdfast::state::{LiveRun, Takeover};
use holdfast::time::Stamp;
use serde_json::Value;

use command::{Ended, empty_folder, estimate, holdfast, repository};

/// How fast the log is played: updates overlap with the samples that follow.
const SPEED: &str = "20";
/// Files that hold one line for each estimate.
const ESTIMATES: [&str; 4] = ["world.tum", "odom.tum", "base_odom.tum", "estimate.csv"];
/// How far an estimate on two threads may be from the one that had its solutions at once: the way of the
/// correction that came a few samples later, once it is settled.
const APART_MAX_M: f64 = 0.03;
const APART_RMS_MAX_M: f64 = 0.005;

fn machine_file() -> PathBuf {
    repository("config/machines/simulated-roof.toml")
}

/// A log of so many seconds, changed on the way.
fn log(folder: &Path, seconds: f64, mut change: impl FnMut(usize, &mut Reading)) {
    let scenario = Scenario::load(&repository("config/scenarios/construction.toml")).expect("valid");
    let mut writer = LogFolderWriter::create(folder).expect("log folder");
    let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(seconds));
    for (index, mut arrival) in simulation.enumerate() {
        change(index, &mut arrival.reading);
        writer.write(&arrival).expect("write");
    }
    writer.finish().expect("finish");
}

fn realtime(log: &Path, out: &Path, speed: &str) -> Ended {
    let machine = machine_file();
    let [log, machine, out] = [log, machine.as_path(), out].map(|path| path.to_str().expect("text"));
    holdfast(&["estimate", log, "--machine", machine, "--out", out, "--realtime", "--speed", speed])
}

fn takeovers(path: &Path) -> Vec<Takeover> {
    let text = fs::read_to_string(path).expect("takeovers");
    let (header, rows) = text.split_once('\n').expect("header");
    assert_eq!(header, "before,solution_of");
    let number = |field: &str| field.parse().expect("number");
    rows.lines()
        .map(|row| row.split_once(',').expect("two fields"))
        .map(|(before, of)| Takeover { before: number(before), solution_of: number(of) })
        .collect()
}

fn summary(out: &Path) -> Value {
    let text = fs::read_to_string(out.join("summary.json")).expect("summary");
    serde_json::from_str(&text).expect("JSON")
}

/// Largest and root mean square distance of two trajectories at common stamps, in the second half.
fn apart(left: &[StampedPose], right: &[StampedPose]) -> (f64, f64) {
    let settled = &left[left.len() / 2..];
    let distances: Vec<f64> = settled
        .iter()
        .filter_map(|pose| {
            let same = right.binary_search_by_key(&pose.stamp, |other| other.stamp).ok()?;
            Some((pose.pose.translation - right[same].pose.translation).norm())
        })
        .collect();
    assert_eq!(distances.len(), settled.len(), "both have every sample");
    let squares: f64 = distances.iter().map(|distance| distance * distance).sum();
    (distances.iter().copied().fold(0.0, f64::max), (squares / distances.len() as f64).sqrt())
}

#[test]
fn realtime_run_is_complete_and_comes_out_again_to_the_bit() {
    let folder = empty_folder("realtime");
    let [log_folder, live, offline, repeated] =
        ["log", "live", "offline", "again"].map(|name| folder.join(name));
    log(&log_folder, 60.0, |_, _| {});
    let ended = realtime(&log_folder, &live, SPEED);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""), "{ended:?}");
    let told = summary(&live);
    let wall_s = told["wall_s"].as_f64().expect("number");
    assert!(wall_s > 2.9, "60 s at {SPEED} times real time took {wall_s} s");
    assert_eq!(estimate(&log_folder, &machine_file(), &offline).code, 0);
    assert!(!offline.join("takeovers.csv").exists());

    // The updater had the same readings in the same order: what happened is the same.
    let read = |folder: &Path, name: &str| fs::read_to_string(folder.join(name)).expect("file");
    assert_eq!(read(&live, "events.jsonl"), read(&offline, "events.jsonl"));
    let known = summary(&offline);
    for same in ["imu_samples", "updates", "data_s", "unfit_readings", "outages"] {
        assert_eq!(told[same], known[same], "{same}");
    }
    let (live_world, offline_world) = (
        read_tum(&live.join("world.tum")).expect("poses"),
        read_tum(&offline.join("world.tum")).expect("poses"),
    );
    assert_eq!(told["estimates"], live_world.len());
    let late_start = offline_world.len() as i64 - live_world.len() as i64;
    assert!((0..100).contains(&late_start), "starts {late_start} samples later");
    for name in ESTIMATES {
        assert_eq!(read(&live, name).lines().count(), live_world.len() + usize::from(name == "estimate.csv"));
    }
    let (largest_m, rms_m) = apart(&live_world, &offline_world);
    println!("two threads against one: at most {largest_m:.4} m, RMS {rms_m:.4} m");
    assert!(largest_m < APART_MAX_M && rms_m < APART_RMS_MAX_M, "{largest_m} m, {rms_m} m");
    assert!(read(&live, "world.tum") != read(&offline, "world.tum"), "no solution came late");

    let takeovers = takeovers(&live.join("takeovers.csv"));
    let updates = told["updates"].as_u64().expect("number");
    assert!(takeovers.len() > 1_000 && takeovers.len() as u64 <= updates, "{} of {updates}", takeovers.len());
    let arrivals = read_log_folder(&log_folder).expect("log").arrivals;
    let run = LiveRun { arrivals, takeovers, ..LiveRun::default() };
    let machine: Machine = config::load(&machine_file()).expect("valid");
    let mut outputs = Outputs::create(&repeated).expect("folder");
    again(&run, machine.estimator_options(), |estimate| outputs.write_estimate(estimate).expect("written"))
        .expect("that run");
    drop(outputs);
    for name in ESTIMATES {
        assert!(read(&repeated, name) == read(&live, name), "{name} differs");
    }
}

#[test]
fn exit_codes_are_those_of_the_other_runs() {
    let folder = empty_folder("realtime-exits");
    let [bad, short, out] = ["bad", "short", "out"].map(|name| folder.join(name));
    // Two samples that are none: done, but data was bad.
    log(&bad, 20.0, |index, reading| {
        if let (Reading::Imu(sample), 4_000..4_009) = (reading, index) {
            sample.angular_rate.x = f64::NAN;
        }
    });
    let ended = realtime(&bad, &out, "100");
    assert_eq!(ended.code, 3, "{ended:?}");
    assert!(ended.stdout.contains("refused as bad data"), "{}", ended.stdout);
    // Too short to start: failed, and the files are there.
    log(&short, 0.5, |_, _| {});
    let ended = realtime(&short, &out, "10");
    assert_eq!(ended.code, 1, "{ended:?}");
    assert!(ended.stderr.contains("never started"), "{}", ended.stderr);
    assert_eq!(summary(&out)["estimates"], 0);
    assert_eq!(fs::read_to_string(out.join("takeovers.csv")).expect("file"), "before,solution_of\n");
    // What cannot be is said at once.
    for (speed, reason) in [("0", "0.01 to 1000"), ("fast", "not a number")] {
        let ended = realtime(&short, &out, speed);
        assert_eq!(ended.code, 2, "{ended:?}");
        assert!(ended.stderr.contains(reason), "{}", ended.stderr);
    }
    let machine = machine_file();
    let [log, machine, out] = [&short, &machine, &out].map(|path| path.to_str().expect("text"));
    let ended = holdfast(&["estimate", log, "--machine", machine, "--out", out, "--speed", "2"]);
    assert_eq!(ended.code, 2, "{ended:?}");
    assert!(ended.stderr.contains("--realtime"), "{}", ended.stderr);
}
