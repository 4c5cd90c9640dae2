//! Bad input: one clear error with file and line and the right exit code, or a counted refusal and the rest
//! goes on.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::command::{Ended, empty_folder, estimate, holdfast};
use crate::fixtures::simulated;

/// A copy of the first 30 s of the construction task, to be broken.
struct Bench {
    log: PathBuf,
    machine: PathBuf,
    out: PathBuf,
}

impl Bench {
    fn new(name: &str) -> Self {
        let folder = empty_folder(&format!("bad-input-{name}"));
        let log = &simulated("construction")[0];
        let bench =
            Self { log: folder.join("log"), machine: folder.join("machine.toml"), out: folder.join("out") };
        fs::create_dir(&bench.log).expect("folder");
        log.cut(&bench.log, 0.0, 30.0);
        fs::copy(&log.machine, &bench.machine).expect("copy");
        bench
    }

    fn edit(&self, file: &str, change: impl FnOnce(&mut Vec<String>)) {
        let path = self.log.join(file);
        let text = fs::read_to_string(&path).expect("log file");
        let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
        change(&mut lines);
        fs::write(path, lines.join("\n") + "\n").expect("write");
    }

    fn run(&self) -> Ended {
        estimate(&self.log, &self.machine, &self.out)
    }

    /// Poses written, readings counted as unfit.
    fn counts(&self) -> (usize, u64) {
        let world = fs::read_to_string(self.out.join("world.tum")).expect("world.tum");
        let summary = fs::read_to_string(self.out.join("summary.json")).expect("summary.json");
        let summary: Value = serde_json::from_str(&summary).expect("JSON");
        (world.lines().count(), summary["unfit_readings"].as_u64().expect("a count"))
    }

    fn refusals(&self) -> String {
        let events = fs::read_to_string(self.out.join("events.jsonl")).expect("events.jsonl");
        events.lines().filter(|line| line.contains("\"refused\"")).collect::<Vec<_>>().join("\n")
    }
}

fn field(line: &str, index: usize) -> &str {
    line.split(',').nth(index).expect("field")
}

fn with_field(line: &str, index: usize, value: &str) -> String {
    let mut fields: Vec<&str> = line.split(',').collect();
    fields[index] = value;
    fields.join(",")
}

/// Exit code, and one line of talk that has all of these.
fn assert_one_error(ended: &Ended, code: i32, parts: &[&str]) {
    assert_eq!(ended.code, code, "{ended:?}");
    let errors: Vec<&str> = ended.stderr.lines().filter(|line| !line.trim().is_empty()).collect();
    assert_eq!(errors.len(), 1, "one error: {ended:?}");
    for part in parts {
        assert!(errors[0].contains(part), "{part:?} is not in {:?}", errors[0]);
    }
}

#[test]
fn unbroken_log_is_done_with_nothing_refused() {
    let bench = Bench::new("none");
    let ended = bench.run();
    assert_eq!(ended.code, 0, "{ended:?}");
    let (poses, unfit) = bench.counts();
    assert_eq!(unfit, 0);
    assert!(poses > 2_500, "{poses}");
}

#[test]
fn numbers_that_are_none_are_refused_and_the_rest_goes_on() {
    let bench = Bench::new("nan");
    bench.edit("imu.csv", |lines| {
        lines[1_500] = with_field(&lines[1_500], 3, "NaN");
        lines[1_600] = with_field(&lines[1_600], 6, "inf");
    });
    bench.edit("gnss_left.csv", |lines| lines[300] = with_field(&lines[300], 2, "nan"));
    bench.edit("gnss_right.csv", |lines| lines[320] = with_field(&lines[320], 5, "NaN"));
    bench.edit("lidar_odometry.csv", |lines| lines[80] = with_field(&lines[80], 8, "NaN"));
    bench.edit("cabin_turn.csv", |lines| lines[700] = with_field(&lines[700], 2, "-inf"));
    let unbroken = Bench::new("nan-compared");
    assert_eq!(unbroken.run().code, 0);

    let ended = bench.run();

    assert_eq!(ended.code, 3, "{ended:?}");
    assert!(ended.stdout.contains("6 readings were refused"), "{}", ended.stdout);
    let (poses, unfit) = bench.counts();
    assert_eq!(unfit, 6);
    assert_eq!(poses, unbroken.counts().0 - 2, "all samples but the two refused ones");
    let refusals = bench.refusals();
    for sensor in ["imu", "gnss_left", "gnss_right", "lidar_odometry", "cabin_turn"] {
        assert!(refusals.contains(&format!("\"sensor\":\"{sensor}\"")), "{sensor}: {refusals}");
    }
    assert!(refusals.contains("angular rate NaN"), "{refusals}");
}

#[test]
fn repeated_and_backward_stamps_are_refused_and_the_rest_goes_on() {
    let bench = Bench::new("stamps");
    bench.edit("imu.csv", |lines| {
        let repeated = field(&lines[1_500], 1).to_owned();
        lines[1_501] = with_field(&lines[1_501], 1, &repeated);
        // Refusals of one sensor are told once a second.
        let backward = field(&lines[1_690], 1).to_owned();
        lines[1_700] = with_field(&lines[1_700], 1, &backward);
    });
    bench.edit("gnss_left.csv", |lines| lines.insert(300, lines[300].clone()));
    let ended = bench.run();
    assert_eq!(ended.code, 3, "{ended:?}");
    assert_eq!(bench.counts().1, 3);
    let refusals = bench.refusals();
    assert!(refusals.contains("has the stamp of the reading before"), "{refusals}");
    assert!(refusals.contains("before the reading before"), "{refusals}");
    assert!(bench.counts().0 > 2_500);
}

#[test]
fn missing_imu_file_is_one_error() {
    let bench = Bench::new("no-imu");
    fs::remove_file(bench.log.join("imu.csv")).expect("remove");
    assert_one_error(&bench.run(), 1, &["imu.csv", "cannot be read"]);
}

#[test]
fn log_that_is_not_there_is_one_error() {
    let bench = Bench::new("no-log");
    let ended = estimate(Path::new("no/such/log"), &bench.machine, &bench.out);
    assert_one_error(&ended, 2, &["no/such/log"]);
}

#[test]
fn wrong_column_is_one_error_with_file_and_line() {
    let bench = Bench::new("column");
    bench.edit("gnss_left.csv", |lines| lines[0] = lines[0].replace("sd_u", "sigma_up"));
    assert_one_error(&bench.run(), 1, &["gnss_left.csv:1:", "\"sigma_up\"", "sd_u"]);
}

#[test]
fn text_in_place_of_a_number_is_one_error_with_file_and_line() {
    let bench = Bench::new("number");
    bench.edit("imu.csv", |lines| lines[1_233] = with_field(&lines[1_233], 4, "0,5x"));
    assert_one_error(&bench.run(), 1, &["imu.csv:1234:", "9 fields, expected 8"]);
    bench.edit("imu.csv", |lines| lines[1_233] = with_field(&lines[1_232], 4, "0.5x"));
    assert_one_error(&bench.run(), 1, &["imu.csv:1234:", "\"0.5x\" is not a number"]);
    bench.edit("imu.csv", |lines| lines[1_233] = with_field(&lines[1_232], 1, "noon"));
    assert_one_error(&bench.run(), 1, &["imu.csv:1234:", "\"noon\" is not a time"]);
}

#[test]
fn line_cut_off_at_the_end_is_one_error_with_file_and_line() {
    let bench = Bench::new("cut-line");
    let path = bench.log.join("gnss_left.csv");
    let text = fs::read_to_string(&path).expect("file");
    let lines = text.lines().count();
    let last = text.trim_end().rfind('\n').expect("lines") + 1;
    fs::write(&path, &text[..last + 30]).expect("write");
    assert_one_error(&bench.run(), 1, &[&format!("gnss_left.csv:{lines}:"), "fields, expected 8"]);
}

#[test]
fn bad_machine_file_is_one_error_with_file_and_line() {
    let bench = Bench::new("machine");
    let good = fs::read_to_string(&bench.machine).expect("machine file");
    let line = good.lines().position(|line| line == "[frames]").expect("frames") + 2;
    fs::write(&bench.machine, good.replace("[frames]\n", "[frames]\ncabin_from_bucket = {}\n"))
        .expect("write");
    assert_one_error(&bench.run(), 2, &[&format!("machine.toml:{line}:"), "cabin_from_bucket"]);
    let check = holdfast(&["check".as_ref(), bench.machine.as_os_str()]);
    assert_one_error(&check, 2, &[&format!("machine.toml:{line}:"), "cabin_from_bucket"]);

    fs::write(&bench.machine, good + "\n[gnss]\nsigma_max_m = -0.2\n").expect("write");
    assert_one_error(&bench.run(), 2, &["machine.toml:", "sigma_max_m"]);

    fs::remove_file(&bench.machine).expect("remove");
    assert_one_error(&bench.run(), 2, &["machine.toml", "cannot be read"]);
}

#[test]
fn wrong_arguments_end_with_2() {
    let cases: [&[&str]; 5] = [
        &["estimate"],
        &["estimate", "log", "--out", "out"],
        &["estimate", "log", "--machine", "m.toml", "--out", "out", "--method", "guess"],
        &["estimate", "log", "--machine", "m.toml", "--out", "out", "--sped", "3"],
        &["excavate"],
    ];
    for arguments in cases {
        let ended = holdfast(arguments);
        assert_eq!(ended.code, 2, "{arguments:?}: {ended:?}");
        assert!(ended.stderr.contains("--help"), "{arguments:?}: {ended:?}");
        assert!(ended.stdout.is_empty(), "{arguments:?}: {ended:?}");
    }
}

#[test]
fn estimate_that_never_starts_says_what_it_waits_for() {
    let bench = Bench::new("no-gnss");
    for file in ["gnss_left.csv", "gnss_right.csv"] {
        fs::remove_file(bench.log.join(file)).expect("remove");
    }
    assert_one_error(&bench.run(), 1, &["never started", "the left GNSS antenna: no fixes arrive"]);

    let bench = Bench::new("no-rtk");
    bench.edit("gnss_left.csv", |lines| {
        for line in &mut lines[1..] {
            *line = with_field(&with_field(line, 5, "1.5"), 6, "1.5");
        }
    });
    assert_one_error(&bench.run(), 1, &["never started", "the left antenna reports 1.50 m"]);
}
