//! APE and RPE against evo itself, on the same files. Runs if the environment variable `HOLDFAST_PYTHON` names a Python
//! that has what `tests/record/requirements.txt` lists; says so if not, and fails where every test is required.

#[path = "support/command.rs"]
mod command;
#[path = "evaluate/log.rs"]
mod log;
#[path = "support/required.rs"]
mod required;

use std::fs;
use std::path::Path;
use std::process::Command;

use command::{empty_folder, holdfast, repository};
use serde_json::{Value, json};

const TOLERANCE: f64 = 1e-9;

/// align, align_first, delta, unit, all pairs, pairs from the truth.
fn cases() -> Vec<Value> {
    let case = |align: &str, first: Option<u32>, delta: f64, unit: &str, all: bool, from_truth: bool| {
        json!({
            "align": align, "align_first": first, "delta": delta, "delta_unit": unit, "all_pairs": all,
            "pairs_from_truth": from_truth,
        })
    };
    vec![
        case("none", None, 1.0, "frames", false, false),
        case("se3", None, 7.0, "frames", false, false),
        case("sim3", None, 1.0, "frames", true, false),
        case("scale", None, 25.0, "frames", true, true),
        case("origin", None, 0.5, "meters", false, false),
        case("se3", Some(400), 0.5, "meters", true, false),
        case("sim3", Some(500), 4.0, "degrees", false, true),
        case("none", None, 10.0, "degrees", true, false),
        case("none", None, 0.2, "radians", false, false),
    ]
}

/// Every sixth pose of an estimate, seen a few milliseconds late, moved, turned and stretched a little.
fn spoil(world: &Path, to: &Path) {
    let text = fs::read_to_string(world).expect("poses");
    let mut spoilt = String::from("# t x y z qx qy qz qw\n");
    for (index, line) in text.lines().filter(|line| !line.starts_with('#')).enumerate() {
        if !index.is_multiple_of(6) {
            continue;
        }
        let fields: Vec<f64> = line.split(' ').map(|field| field.parse().expect("number")).collect();
        let late_s = 0.001 * (index % 11) as f64;
        let [x, y, z] = [1, 2, 3].map(|field| fields[field]);
        let moved = [1.01 * x + 0.02 * y, 1.01 * y - 0.02 * x + 0.3, 1.01 * z - 0.1];
        spoilt += &format!(
            "{:.6} {} {} {} {} {} {} {}\n",
            fields[0] + late_s,
            moved[0],
            moved[1],
            moved[2],
            fields[4],
            fields[5],
            fields[6],
            fields[7]
        );
    }
    fs::write(to, spoilt).expect("written");
}

/// Faults of one case's figures.
fn compare(case: &Value, ours: &Value, theirs: &Value) -> Vec<String> {
    let mut faults = Vec::new();
    if ours["pairs"] != theirs["pairs"] {
        faults.push(format!("{case}: {} pairs, evo has {}", ours["pairs"], theirs["pairs"]));
    }
    let mut count = 0;
    for metric in ["ape", "rpe"] {
        for (relation, statistics) in theirs[metric].as_object().expect("relations") {
            for (name, value) in statistics.as_object().expect("statistics") {
                let expected = value.as_f64().expect("a number");
                let found = ours[metric][relation][name].as_f64().unwrap_or(f64::NAN);
                count += 1;
                if (found - expected).abs() <= TOLERANCE * expected.abs().max(1.0) {
                    continue;
                }
                faults.push(format!("{case}: {metric} {relation} {name}: {found}, evo has {expected}"));
            }
        }
    }
    assert_eq!(count, (6 + 7) * 7, "{case}: all relations and statistics of evo");
    faults
}

#[test]
fn errors_equal_those_of_evo() {
    let what = "a Python with the packages of tests/record/requirements.txt";
    let Some(python) = required::variable("HOLDFAST_PYTHON", what) else { return };
    let folder = empty_folder("evo");
    let log = log::simulate(&folder, 45, [30, 40]);
    let out = folder.join("out");
    log::estimate(&log, "msf", &out);
    let (truth, estimate) = (log.join("truth_imu.tum"), folder.join("spoilt.tum"));
    spoil(&out.join("world.tum"), &estimate);
    let cases = cases();
    let path = folder.join("cases.json");
    fs::write(&path, serde_json::to_string(&cases).expect("JSON")).expect("written");
    let script = repository("tests/evaluate/compare_with_evo.py");
    let output = Command::new(&python).arg(script).args([&truth, &estimate, &path]).output().expect("python");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let theirs: Vec<Value> = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(theirs.len(), cases.len());
    for (index, (case, theirs)) in cases.iter().zip(&theirs).enumerate() {
        let report = folder.join(format!("report-{index}"));
        let text = |path: &Path| path.to_str().expect("UTF-8").to_owned();
        let word = |key: &str| case[key].as_str().expect("a word").to_owned();
        let mut arguments = vec![
            "evaluate".to_owned(),
            "--truth".to_owned(),
            text(&truth),
            "--estimate".to_owned(),
            text(&estimate),
            "--out".to_owned(),
            text(&report),
            "--align".to_owned(),
            word("align"),
            "--delta".to_owned(),
            case["delta"].to_string(),
            "--delta-unit".to_owned(),
            word("delta_unit"),
        ];
        if let Some(first) = case["align_first"].as_u64() {
            arguments.extend(["--align-first".to_owned(), first.to_string()]);
        }
        for (key, option) in [("all_pairs", "--all-pairs"), ("pairs_from_truth", "--pairs-from-truth")] {
            if case[key] == true {
                arguments.push(option.to_owned());
            }
        }
        let ended = holdfast(&arguments);
        assert_eq!(ended.code, 0, "{ended:?}");
        let text = fs::read_to_string(report.join("report.json")).expect("report.json");
        let ours: Value = serde_json::from_str(&text).expect("JSON");
        let ours = &ours["estimates"][0]["evo"];
        assert_eq!(compare(case, ours, theirs), Vec::<String>::new());
        // The comparison can fail.
        let mut wrong = theirs.clone();
        wrong["rpe"]["translation_part"]["mean"] =
            json!(theirs["rpe"]["translation_part"]["mean"].as_f64().expect("a number") + 1e-8);
        assert_eq!(compare(case, ours, &wrong).len(), 1);
    }
}
