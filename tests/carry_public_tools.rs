//! Bags that rosbags wrote, imported; exports, read by evo, GDAL and the like. Runs if the environment variable
//! `HOLDFAST_PYTHON` names a Python that has what `tests/record/requirements.txt` lists; says so if not, and fails
//! where every test is required.

#[path = "support/command.rs"]
mod command;
#[path = "carry/recording.rs"]
mod recording;
#[path = "support/required.rs"]
mod required;

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use command::{Ended, empty_folder, estimate, holdfast, repository};

const WHAT: &str = "a Python with the packages of tests/record/requirements.txt";
const SENSORS: [&str; 6] = ["imu", "base_imu", "gnss_left", "gnss_right", "lidar_odometry", "cabin_turn"];
const TOPICS: &str = "
[topics]
imu = \"/cabin/imu\"
base_imu = \"/chassis/imu\"
gnss_left = \"/gnss/left\"
gnss_right = \"/gnss/right\"
lidar_odometry = \"/lidar\"
cabin_turn = \"/joint_states\"
cabin_turn_joint = \"swing\"
";

fn python(python: &OsString, script: &str, arguments: &[&Path]) -> Output {
    Command::new(python).arg(repository(script)).args(arguments).output().expect("python")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// A machine file with the topics of `tests/carry/write_bag.py`, one of them changed.
fn machine_file(folder: &Path, from: &str, to: &str) -> PathBuf {
    let path = folder.join("machine.toml");
    let roof = fs::read_to_string(repository("config/machines/simulated-roof.toml")).expect("machine");
    assert!(TOPICS.contains(from), "{from}");
    fs::write(&path, roof + &TOPICS.replace(from, to)).expect("written");
    path
}

struct Bags {
    python: OsString,
    folder: PathBuf,
    log: PathBuf,
}

impl Bags {
    fn new(name: &str) -> Option<Self> {
        let python = required::variable("HOLDFAST_PYTHON", WHAT)?;
        let folder = empty_folder(name);
        recording::simulate(&folder, 12);
        Some(Self { python, log: folder.join("logs/walker-1"), folder })
    }

    fn write(&self, name: &str, options: &[&str]) -> PathBuf {
        let bag = self.folder.join(name);
        let mut arguments = vec![self.log.as_path(), bag.as_path()];
        arguments.extend(options.iter().map(Path::new));
        let output = python(&self.python, "tests/carry/write_bag.py", &arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        bag
    }

    fn import(&self, bag: &Path, machine: &Path, out: &str) -> Ended {
        let out = self.folder.join(out);
        holdfast(&["import", text(bag), "--machine", text(machine), "--out", text(&out)])
    }
}

#[test]
fn bags_give_the_readings_that_went_into_them_to_the_bit() {
    let Some(bags) = Bags::new("carry-bags") else { return };
    let machine = machine_file(&bags.folder, "swing", "swing");
    for (name, options) in [
        ("plain", vec![]),
        ("zstd", vec!["--compress", "zstd"]),
        ("pose", vec!["--lidar", "pose"]),
        ("covariance", vec!["--lidar", "covariance"]),
    ] {
        let bag = bags.write(name, &options);
        let out = format!("{name}-csv");
        let ended = bags.import(&bag, &machine, &out);
        assert_eq!((ended.code, ended.stderr.as_str()), (0, ""), "{name}");
        for sensor in SENSORS {
            let [left, right] = [&bags.log, &bags.folder.join(&out)]
                .map(|folder| fs::read(folder.join(format!("{sensor}.csv"))).expect("log"));
            assert!(left == right, "{name}: {sensor}.csv");
        }
    }
    // A single file, into a recording, which estimates as the log does.
    let recording = bags.folder.join("a.mcap");
    let ended = bags.import(&bags.folder.join("zstd/zstd.mcap"), &machine, "a.mcap");
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    let [left, right] = [(&bags.log, "of-log"), (&recording, "of-bag")].map(|(log, out)| {
        let out = bags.folder.join(out);
        assert_eq!(estimate(log, &machine, &out).code, 0);
        fs::read(out.join("world.tum")).expect("poses")
    });
    assert!(left == right && !left.is_empty());
    // And which others read: rosbags, mcap, mcap-ros2-support.
    let output = python(&bags.python, "tests/record/read_with_public_tools.py", &[&recording]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn what_is_wrong_with_a_bag_is_told_with_topic_and_message() {
    let Some(bags) = Bags::new("carry-bad-bags") else { return };
    let machine = machine_file(&bags.folder, "swing", "swing");
    for (kind, code, readings, expected) in [
        ("nan", 3, 1200, "imu: readings that cannot be a measurement: 1, first: reading 11 at "),
        ("backward", 3, 1200, "imu: stamps that do not come after the one before: 1, first: reading 21: "),
        ("no-sigma", 3, 1200, "/gnss/left: messages that cannot be used: 1, first: message 5: "),
        (
            "joint",
            3,
            1200,
            "/joint_states: messages that cannot be used: 2, first: message 3: has no joint swing",
        ),
        (
            "late",
            3,
            1200,
            "/cabin/imu: messages that came too late to be put in order: 1, first: message 1200",
        ),
        (
            "short",
            3,
            1199,
            "/cabin/imu: messages that cannot be used: 1, first: message 7: sensor_msgs/msg/Imu: ends",
        ),
        ("no-fix", 0, 1200, ""),
    ] {
        let bag = bags.write(kind, &["--spoil", kind]);
        let out = format!("{kind}-csv");
        let ended = bags.import(&bag, &machine, &out);
        assert_eq!(ended.code, code, "{kind}: {}", ended.stderr);
        assert!(ended.stderr.contains(expected), "{kind}: {}", ended.stderr);
        assert_eq!(ended.stdout.contains("5 say that there is no fix"), kind == "no-fix", "{}", ended.stdout);
        let rows = fs::read_to_string(bags.folder.join(&out).join("imu.csv")).expect("imu").lines().count();
        assert_eq!(rows, readings + 1, "{kind}");
    }
    // Torn in the middle, without metadata.yaml, as when the recorder lost its power.
    let bag = bags.write("torn", &[]);
    let file = bag.join("torn.mcap");
    let bytes = fs::read(&file).expect("bag");
    fs::write(&file, &bytes[..bytes.len() / 2]).expect("written");
    fs::remove_file(bag.join("metadata.yaml")).expect("removed");
    // Within its first chunk of 1 MiB, all is lost; within its second, the rest is there.
    let ended = bags.import(&bag, &machine, "torn-csv");
    assert_eq!(ended.code, 1, "{}", ended.stderr);
    assert!(ended.stderr.contains("it has no topics at all; "), "{}", ended.stderr);
    assert!(ended.stderr.contains(" bytes are torn off or damaged"), "{}", ended.stderr);
    fs::write(&file, &bytes[..bytes.len() - 60_000]).expect("written");
    let ended = bags.import(&bag, &machine, "torn-csv");
    assert_eq!(ended.code, 3, "{}", ended.stderr);
    assert!(ended.stderr.contains("torn.mcap: bytes that are torn off or damaged: "), "{}", ended.stderr);
    assert!(ended.stderr.contains("bags without metadata.yaml: 1"), "{}", ended.stderr);
    // Topics that are not there, or of another type; a bag that is compressed message by message.
    let good = bags.write("good", &[]);
    for (from, to, code, expected) in [
        (
            "/cabin/imu",
            "/roof/imu",
            1,
            "has no topic /roof/imu, which must be that of the cabin IMU; it has /cabin/imu",
        ),
        (
            "/gnss/left",
            "/chatter",
            1,
            "topic /chatter is std_msgs/msg/String in cdr, but gnss_left must be sensor_msgs",
        ),
        (
            "/gnss/left",
            "/gnss/top",
            3,
            "topics of the machine file that are not there: 1, first: /gnss/top of gnss_left",
        ),
    ] {
        let ended = bags.import(&good, &machine_file(&bags.folder, from, to), "wrong.mcap");
        assert_eq!(ended.code, code, "{}", ended.stderr);
        assert!(ended.stderr.contains(expected), "{}", ended.stderr);
        assert_eq!(bags.folder.join("wrong.mcap").exists(), code == 3);
    }
    let ended = bags.import(&bags.write("squeezed", &["--compress", "message"]), &machine, "squeezed-csv");
    assert_eq!(
        (ended.code, ended.stderr.contains("compression_mode is \"message\"")),
        (1, true),
        "{}",
        ended.stderr
    );
}

#[test]
fn exports_open_in_the_tools_of_others_and_agree() {
    let Some(interpreter) = required::variable("HOLDFAST_PYTHON", WHAT) else { return };
    let folder = empty_folder("carry-exports");
    let session = recording::session(&folder);
    let exports = folder.join("exports");
    for format in ["csv", "geojson", "gpx", "kml"] {
        let out = exports.join(format!("all.{format}"));
        // CSV has places only with an origin, which is in the recording.
        let ended = holdfast(&["export", text(&session.folder), "--out", text(&out)]);
        assert_eq!(ended.code, 0, "{}", ended.stderr);
    }
    let one = exports.join("one.tum");
    let ended = holdfast(&["export", text(&session.folder), "--machine", "walker-2", "--out", text(&one)]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    let published = folder.join("published.tum");
    fs::write(&published, &session.tum["walker-2"]).expect("written");
    let poses = |machine: &str| session.tum[machine].lines().count();
    let expected = serde_json::json!({
        "machines": { "walker-1": poses("walker-1"), "walker-2": poses("walker-2") },
        "one": "walker-2",
        "origin": [47.480_140_2, 8.499_753_25, 474.9],
        "outages": { "walker-1": 1, "walker-2": 1 },
        "published": published,
    });
    let path = folder.join("expected.json");
    let read = |expected: &serde_json::Value| {
        fs::write(&path, expected.to_string()).expect("written");
        let output = python(&interpreter, "tests/carry/read_exports.py", &[&exports, &path]);
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, errors) = read(&expected);
    assert_eq!(code, Some(0), "{errors}");
    // The script can fail: an origin 2 mm to the north.
    let mut wrong = expected.clone();
    wrong["origin"][0] = (47.480_140_2 + 2e-8).into();
    let (code, errors) = read(&wrong);
    assert_eq!(code, Some(1));
    assert!(errors.contains("kml: places of walker-1 are off by 0.002"), "{errors}");
    // Nor were these published: one of them 1 mm further to the east.
    let mut lines: Vec<String> = session.tum["walker-2"].lines().map(str::to_owned).collect();
    let mut words: Vec<String> = lines[500].split(' ').map(str::to_owned).collect();
    words[1] = (words[1].parse::<f64>().expect("a number") + 1e-3).to_string();
    lines[500] = words.join(" ");
    fs::write(&published, lines.join("\n")).expect("written");
    let (code, errors) = read(&expected);
    assert_eq!(code, Some(1));
    assert!(errors.contains("tum: translation_part to those published: max 0.001"), "{errors}");
}

#[test]
fn bar_tells_rate_and_time_left_on_a_terminal_and_nothing_elsewhere() {
    let Some(interpreter) = required::variable("HOLDFAST_PYTHON", WHAT) else { return };
    let folder = empty_folder("carry-bar");
    // Longer than two seconds on any computer: two machines for 20 minutes each, and again for longer if not.
    let root = repository("config");
    let demo = fs::read_to_string(root.join("scenarios/demo.toml")).expect("scenario");
    let demo = demo.replace("../machines/", &format!("{}/", root.join("machines").display()));
    let duration = demo.lines().find(|line| line.starts_with("duration_s")).expect("a duration").to_owned();
    let scenario = folder.join("scenario.toml");
    let mut seen = String::new();
    for seconds in [1_200, 4_800, 19_200] {
        fs::write(&scenario, demo.replace(&duration, &format!("duration_s = {seconds}.0"))).expect("written");
        let binary = Path::new(env!("CARGO_BIN_EXE_holdfast"));
        let out = folder.join("out.mcap");
        let command =
            [binary, Path::new("simulate"), Path::new("--scenario"), &scenario, Path::new("--out"), &out];
        let output = python(&interpreter, "tests/carry/watch.py", &command);
        seen = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(seen.starts_with("0\n"), "{seen}");
        if seen.contains("times real time, ") {
            break;
        }
    }
    assert!(
        seen.contains("simulating ") && seen.contains(" times real time, ") && seen.contains(" s left"),
        "{seen}"
    );
    let ended = holdfast(&[
        "simulate".as_ref(),
        "--scenario".as_ref(),
        scenario.as_os_str(),
        "--out".as_ref(),
        folder.join("again.mcap").as_os_str(),
    ]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
}
