//! `holdfast evaluate`: of files, of the paper's tasks, of many seeds.

#[path = "support/command.rs"]
mod command;
#[path = "evaluate/log.rs"]
mod log;

use std::fs;
use std::path::Path;

use command::{empty_folder, holdfast, repository};
use serde_json::Value;

fn json(folder: &Path) -> Value {
    let text = fs::read_to_string(folder.join("report.json")).expect("report.json");
    serde_json::from_str(&text).expect("JSON")
}

/// What every page must have.
fn check_page(folder: &Path, parts: &[&str]) {
    let html = fs::read_to_string(folder.join("report.html")).expect("report.html");
    assert!(html.starts_with("<!doctype html>") && html.trim_end().ends_with("</html>"));
    for part in parts {
        assert!(html.contains(part), "{part}");
    }
    for part in ["<script", "http://", "https://", "NaN", "inf "] {
        assert!(!html.contains(part), "{part}");
    }
    let plots = html.matches("<figure>").count();
    assert_eq!(html.matches("role=\"img\"").count(), plots, "a role for each plot");
    assert_eq!(
        html.matches("<summary>Values of this plot</summary>").count(),
        plots,
        "a table beside each plot"
    );
}

#[test]
fn estimates_are_judged_side_by_side_with_all_that_lies_beside_them() {
    let folder = empty_folder("evaluate-files");
    let log = log::simulate(&folder, 60, [40, 50]);
    let outs = ["dual", "msf", "tsif", "lidar", "dead-reckoning"].map(|method| folder.join(method));
    for (out, method) in outs.iter().zip(["dual", "msf", "tsif", "lidar", "dead-reckoning"]) {
        log::estimate(&log, method, out);
    }
    let (truth, intervals) = (log.join("truth_imu.tum"), log.join("gnss_truth.csv"));
    let machine = repository("config/machines/simulated-roof.toml");
    let report = folder.join("report");
    let arguments: Vec<&str> = [
        "evaluate",
        "--truth",
        truth.to_str().expect("UTF-8"),
        "--intervals",
        intervals.to_str().expect("UTF-8"),
        "--log",
        log.to_str().expect("UTF-8"),
        "--machine",
        machine.to_str().expect("UTF-8"),
        "--out",
        report.to_str().expect("UTF-8"),
        "--only",
        "good",
        "--estimate",
    ]
    .into_iter()
    .chain(outs.iter().map(|out| out.to_str().expect("UTF-8")))
    .collect();
    let ended = holdfast(&arguments);
    assert_eq!(ended.code, 0, "{ended:?}");
    let report_json = json(&report);
    let estimates = report_json["estimates"].as_array().expect("estimates");
    assert_eq!(estimates.len(), outs.len());
    let ours = &estimates[0];
    let rmse = |estimate: &Value| estimate["errors"]["position_m"]["rmse"].as_f64().expect("RMSE");
    assert!(rmse(ours) < 0.03, "{}", rmse(ours));
    for other in &estimates[1..] {
        assert!(rmse(ours) < rmse(other), "{}: {}", other["name"], rmse(other));
    }
    let within = |value: &Value, low: f64, high: f64, what: &str| {
        let value = value.as_f64().unwrap_or_else(|| panic!("{what}: {value}"));
        assert!(value > low && value < high, "{what}: {value}");
    };
    within(&ours["relative_to_rtk_cm"]["sd"], 1.2, 1.7, "relative to RTK");
    within(&ours["odom_step_mm"], 0.0, 1.0, "odom");
    within(&ours["nees"]["mean"], 0.2, 3.0, "NEES");
    within(&ours["nis"]["mean"], 0.5, 2.0, "NIS, over all fixes");
    within(&ours["run"]["consistency_cm"]["mean"], 0.0, 0.5, "consistency");
    assert_eq!(ours["run"]["outages"].as_array().map(Vec::len), Some(1));
    assert_eq!(ours["evo"]["ape"].as_object().map(serde_json::Map::len), Some(6));
    assert_eq!(ours["evo"]["rpe"].as_object().map(serde_json::Map::len), Some(7));
    check_page(
        &report,
        &[
            "NEES of the position",
            "Outages of GNSS",
            "Consistency of prediction and update over time",
            "unreliable",
        ],
    );
    // The same files give the same report but for the times that the runs measured, which are theirs.
    let again = folder.join("again");
    let mut arguments = arguments;
    arguments[10] = again.to_str().expect("UTF-8");
    assert_eq!(holdfast(&arguments).code, 0);
    for name in ["report.html", "report.json"] {
        let [one, two] = [&report, &again].map(|folder| fs::read(folder.join(name)).expect(name));
        assert!(one == two, "{name}");
    }
}

#[test]
fn what_cannot_be_asked_is_refused_with_a_reason() {
    let folder = empty_folder("evaluate-wrong");
    let missing = folder.join("missing.tum");
    let missing = missing.to_str().expect("UTF-8");
    let existing = repository("Cargo.toml");
    let existing = existing.to_str().expect("UTF-8");
    for (arguments, code, expected) in [
        (vec!["evaluate"], 2, "--truth"),
        (vec!["evaluate", "--truth", existing], 2, "--estimate"),
        (vec!["evaluate", "--paper", "--monte-carlo", "2"], 2, "cannot be used with"),
        (vec!["evaluate", "--monte-carlo", "0"], 2, "1..=100000"),
        (vec!["evaluate", "--paper", "--until-s", "3"], 2, "must be 20 at least"),
        (vec!["evaluate", "--truth", missing, "--estimate", missing], 2, "there is no such file"),
        (
            vec!["evaluate", "--truth", existing, "--estimate", existing, "--delta", "1.5"],
            2,
            "must be whole in frames",
        ),
        (vec!["evaluate", "--truth", existing, "--estimate", existing, "--delta=-1"], 2, "must be above 0"),
        (vec!["evaluate", "--truth", existing, "--estimate", existing], 1, "Cargo.toml:1:"),
    ] {
        let ended = holdfast(&arguments);
        assert_eq!(ended.code, code, "{arguments:?}: {}", ended.stderr);
        assert!(ended.stderr.contains(expected), "{arguments:?}: {}", ended.stderr);
    }
}

/// `--paper`, and its figures without the latencies, which are never the same.
fn paper(folder: &Path, more: &[&str]) -> (String, Value) {
    let mut arguments = vec!["evaluate", "--paper", "--out", folder.to_str().expect("UTF-8")];
    arguments.extend(more);
    let ended = holdfast(&arguments);
    assert_eq!(ended.code, 0, "{ended:?}");
    let mut report = json(folder);
    let figures = report.as_object_mut().expect("an object");
    figures.remove("latency").expect("latencies");
    let tables = figures["tables"].as_array_mut().expect("tables");
    tables.retain(|table| !table["caption"].as_str().is_some_and(|caption| caption.starts_with("Table II")));
    let rows = tables[0]["rows"].as_array_mut().expect("rows");
    rows.retain(|row| !row["name"].as_str().is_some_and(|name| name.contains("live")));
    (ended.stdout, report)
}

#[test]
fn paper_is_the_same_on_one_thread_and_on_three() {
    let folder = empty_folder("evaluate-paper-threads");
    let [one, three] = ["1", "3"].map(|threads| {
        let out = folder.join(threads);
        paper(&out, &["--until-s", "30", "--threads", threads]).1
    });
    assert_eq!(one["simulated"], true);
    assert!(one == three, "{one:#} {three:#}");
    let other = paper(&folder.join("seed"), &["--until-s", "30", "--seed", "5"]).1;
    assert!(other["tables"] != one["tables"], "another seed");
}

/// Where ours may be behind, of whom, and the least that their figure may be of ours. Seeds are fixed: what else falls behind
/// is news.
const BEHIND: &[(&str, &str, &str, f64)] = &[
    // What nothing corrects turns only by its gyroscope's noise.
    ("digging task, both", "largest turn", "dead reckoning", 0.35),
    ("navigation task, both", "largest turn", "dead reckoning", 0.4),
    ("Consistency of prediction and update in the navigation", "99 %", "TSIF", 0.8),
    ("Consistency of prediction and update in the navigation", "99 %", "MSF", 0.85),
    // One run's distance of a ratio from 1, by its logarithm: what is within bounds is as good as 1.
    ("covariance in the digging", "good: position NEES", "MSF", 0.6),
    ("covariance in the digging", "good: heading NEES", "MSF", 0.1),
    ("covariance in the digging", "outage: heading NEES", "MSF", 0.5),
    ("covariance in the digging", "fixes: NIS", "MSF", 0.05),
    ("covariance in the navigation", "good: heading NEES", "TSIF", 0.9),
    ("covariance in the navigation", "good: heading NEES", "MSF", 0.8),
    ("covariance in the navigation", "outage: heading NEES", "TSIF", 0.7),
    ("covariance in the navigation", "outage: heading NEES", "MSF", 0.35),
    ("covariance in the navigation", "outage: heading NEES", "lidar odometry", 0.9),
];

/// Whether a row of the methods' figures holds ours where it was.
fn check_row(caption: &str, row: &Value) {
    let name = row["name"].as_str().expect("name");
    let verdict = row["verdict"].as_str().expect("verdict");
    let cells = row["cells"].as_array().expect("cells");
    let value = |cell: &Value| cell["value"].as_f64();
    let ours = value(&cells[0]).unwrap_or_else(|| panic!("{caption}, {name}: ours has no figure"));
    let methods = ["TSIF", "MSF", "lidar odometry", "dead reckoning"];
    let mut is_behind = false;
    for (method, other) in methods.into_iter().zip(&cells[1..]) {
        let Some(other) = value(other).filter(|other| *other <= ours) else { continue };
        is_behind = true;
        let ratio = other / ours;
        let known = BEHIND
            .iter()
            .find(|(of, part, who, _)| caption.contains(of) && name.contains(part) && *who == method);
        let least = known.map_or(f64::INFINITY, |(.., least)| *least);
        assert!(ratio >= least, "{caption}, {name}: {method} has {ratio:.3} of ours");
        assert!(verdict.contains(&format!("{method} ({ratio:.2} of ours)")), "{name}: {verdict}");
    }
    assert_eq!(verdict == "ahead", !is_behind, "{name}: {verdict}");
    assert!(!is_behind || verdict.contains("): "), "it says why: {name}: {verdict}");
}

#[test]
fn ours_is_ahead_on_the_papers_tasks_or_the_row_says_by_how_much_not_and_why() {
    let folder = empty_folder("evaluate-paper");
    let (stdout, report) = paper(&folder, &[]);
    for part in ["0.18 ± 1.28", "41 ± 15", "0.58 ± 3.16", "Table I", "Table II", "TSIF", "MSF", "ahead"] {
        assert!(stdout.contains(part), "{part}");
    }
    let mut rows = 0;
    for table in report["tables"].as_array().expect("tables") {
        let caption = table["caption"].as_str().expect("a caption");
        if caption.contains("figures of its own") {
            continue;
        }
        for row in table["rows"].as_array().expect("rows") {
            check_row(caption, row);
            rows += 1;
        }
    }
    assert_eq!(rows, 6 + 2 * (10 + 2 + 5), "rows");
    check_page(
        &folder,
        &[
            "paper's Fig. 3",
            "paper's Fig. 4",
            "paper's Fig. 6",
            "Z axis during the outage",
            "simulated",
            "real machine",
        ],
    );
}

/// `--monte-carlo 1` on so many threads.
fn one_seed(out: &Path, until_s: &str, threads: &str) -> Value {
    let out_text = out.to_str().expect("UTF-8");
    let arguments =
        ["evaluate", "--monte-carlo", "1", "--until-s", until_s, "--threads", threads, "--out", out_text];
    let ended = holdfast(&arguments);
    assert_eq!(ended.code, 0, "{ended:?}");
    assert!(ended.stdout.contains("median (95 %, largest)"), "{}", ended.stdout);
    json(out)
}

#[test]
fn a_seed_is_the_same_on_one_thread_and_on_three() {
    let folder = empty_folder("evaluate-monte-carlo");
    let outs = ["1", "3"].map(|threads| (folder.join(threads), threads));
    let [one, three] = outs.each_ref().map(|(out, threads)| one_seed(out, "20", threads));
    assert!(one == three, "{one:#} {three:#}");
    assert_eq!(one["methods"]["digging"]["dual"]["GNSS good: position RMSE, cm"]["runs"], 2);
    let [one, three] = outs.map(|(out, _)| fs::read(out.join("report.html")).expect("report.html"));
    assert!(one == three, "report.html");
}

#[test]
fn a_seed_tells_what_lidar_is_worth_in_an_outage() {
    let folder = empty_folder("evaluate-monte-carlo-outage");
    let report = one_seed(&folder, "66", "2");
    for task in ["digging", "navigation"] {
        let rmse = |lidar: &str| report["outages"][task][lidar][5][1]["median"].as_f64().expect("a figure");
        assert!(rmse("half the error") > 0.0, "{report:#}");
        assert!(rmse("half the error") < rmse("no lidar"), "{task}: {report:#}");
    }
    check_page(&folder, &["Accuracy against the length of an outage", "no lidar", "four times"]);
}
