//! `holdfast evaluate SESSION`, and `holdfast smooth` of sessions: recordings of machines that ran, without truth.

#[path = "support/command.rs"]
mod command;

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use command::{Ended, empty_folder, holdfast, repository};

fn evaluate(session: &Path, more: &[&str]) -> (Ended, PathBuf) {
    let name = session.file_name().expect("a name").to_string_lossy();
    let out = empty_folder(&format!("session-report-{name}"));
    let [path, folder] = [session, &out].map(|path| path.to_str().expect("UTF-8"));
    let mut arguments = vec!["evaluate", path, "--out", folder];
    arguments.extend(more);
    (holdfast(&arguments), out)
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).expect("written")).expect("JSON")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number: {value}"))
}

/// One machine with an outage of 45 s, simulated into a recording.
fn simulated() -> PathBuf {
    let folder = empty_folder("session-report-simulated-log");
    let file = folder.join("construction.mcap");
    let scenario = repository("config/scenarios/construction.toml");
    let [scenario, path] = [&scenario, &file].map(|path| path.to_str().expect("UTF-8"));
    assert_eq!(holdfast(&["simulate", "--scenario", scenario, "--out", path]).code, 0);
    file
}

#[test]
fn report_tells_coverage_outage_and_how_far_live_was_off() {
    let machine = repository("config/machines/simulated-roof.toml");
    let (ended, out) = evaluate(&simulated(), &["--machine", machine.to_str().expect("UTF-8")]);
    assert_eq!(ended.code, 0, "{ended:?}");
    let report = json(&out.join("report.json"));
    let runs = report["runs"].as_array().expect("runs");
    assert_eq!((runs.len(), runs[0]["machine"].as_str()), (1, Some("walker-1")));
    let run = &runs[0];
    let outages = run["outages"].as_array().expect("outages");
    assert_eq!(outages.len(), 1, "{outages:?}");
    let (start, end) = (number(&outages[0]["start_s"]), number(&outages[0]["end_s"]));
    assert!((start - 105.0).abs() < 3.0 && (150.0..155.0).contains(&end), "{start} {end}");
    let shares = run["coverage"].as_array().expect("coverage");
    let percent = |mode: &str| {
        let share = shares.iter().find(|share| share["mode"] == mode).expect(mode);
        number(&share["percent"])
    };
    assert!((percent("fallback") - 100.0 * (end - start) / 200.0).abs() < 2.0, "{shares:?}");
    let sum: f64 = ["main", "fallback", "imu_only", "initializing"].map(percent).iter().sum();
    assert!((sum - 100.0).abs() < 1e-6, "{sum}");
    let imu = &run["sensors"][0];
    assert_eq!(imu["sensor"], "imu");
    assert!((number(&imu["rate_hz"]) - 100.0).abs() < 1.0 && number(&imu["silences"]) == 0.0, "{imu}");
    assert!(number(&run["consistency_cm"]["median"]) > 0.0);
    // In the outage live is off by centimetres, else by millimetres.
    let parts = run["gain"]["parts"].as_array().expect("parts");
    let rms = |name: &str| {
        let part = parts.iter().find(|part| part["name"] == name).expect(name);
        number(&part["horizontal_m"]["rmse"])
    };
    assert!(rms("fallback") > 3.0 * rms("main"), "{parts:?}");
    let off = number(&outages[0]["live_off_m"]);
    assert!(off >= rms("fallback") && off < 0.3, "{off}");
    assert!(run["seconds"].as_array().expect("seconds").len() > 190);
    let html = fs::read_to_string(out.join("report.html")).expect("written");
    for part in ["<svg", "walker-1: in short", "Satellites were lost once", "@media print", "<desc"] {
        assert!(html.contains(part), "{part}");
    }
    for part in ["NaN", "<script", "http://", "https://"] {
        assert!(!html.contains(part), "{part}");
    }
    assert!(ended.stdout.contains("Satellites were lost once"), "{ended:?}");
}

#[test]
fn sessions_of_machines_that_ran_are_judged_run_by_run() {
    for (session, runs) in [("outage", 2), ("restarts", 3)] {
        let (ended, out) = evaluate(&repository("tests/replay").join(session), &[]);
        assert!([0, 3].contains(&ended.code), "{ended:?}");
        let report = json(&out.join("report.json"));
        let told = report["runs"].as_array().expect("runs");
        assert_eq!(told.len(), runs, "{session}: {}", ended.stdout);
        for run in told {
            let latency = &run["latency"]["stamp_to_sent_us"];
            assert!(number(&latency["p50"]) > 0.0 && number(&latency["p50"]) < 1e6, "{latency}");
            assert!(number(&run["begin_s"]) > 1.7e9, "stamps of machines that ran are since 1970");
        }
        let html = fs::read_to_string(out.join("report.html")).expect("written");
        assert!(html.contains(" UTC, for "), "the page says when");
    }
}

#[test]
fn sessions_are_smoothed_into_a_folder_for_each_run() {
    let session = repository("tests/replay/outage");
    let outs = ["session-smooth-once", "session-smooth-again"].map(empty_folder);
    for out in &outs {
        let [path, folder] = [&session, out].map(|path| path.to_str().expect("UTF-8"));
        let ended = holdfast(&["smooth", path, "--out", folder]);
        assert!([0, 3].contains(&ended.code), "{ended:?}");
        assert!(ended.stdout.contains("yard-1: ") && ended.stdout.contains("yard-2: "), "{ended:?}");
    }
    for id in ["yard-1", "yard-2"] {
        let [once, again] =
            outs.each_ref().map(|out| fs::read(out.join(id).join("smoothed.tum")).expect("written"));
        assert!(once == again && once.len() > 1_000, "{id}");
    }
}

#[test]
fn without_fixes_the_page_says_why_it_cannot_judge() {
    let scenario = repository("config/scenarios/construction.toml");
    let folder = empty_folder("session-report-no-fixes");
    let [path, log] = [&scenario, &folder].map(|path| path.to_str().expect("UTF-8"));
    assert_eq!(holdfast(&["simulate", "--scenario", path, "--out", log]).code, 0);
    let log = folder.join("walker-1");
    for name in ["gnss_left.csv", "gnss_right.csv"] {
        fs::remove_file(log.join(name)).expect("there");
    }
    let machine = repository("config/machines/simulated-roof.toml");
    let (ended, out) = evaluate(&log, &["--machine", machine.to_str().expect("UTF-8")]);
    assert_eq!(ended.code, 0, "{ended:?}");
    let report = json(&out.join("report.json"));
    assert!(report["runs"][0]["gain"].is_null());
    let why = "The session cannot be judged as a whole: it has no GNSS fixes";
    assert!(fs::read_to_string(out.join("report.html")).expect("written").contains(why));
    let ended = holdfast(&["evaluate"]);
    assert_eq!(ended.code, 2, "{ended:?}");
    let ended = holdfast(&["evaluate", "/no/such/session"]);
    assert_eq!((ended.code, ended.stderr.contains("there is no such file")), (2, true), "{ended:?}");
}
