//! What others read of the site with their own programs: Foxglove's client packages, a client with playback control,
//! the AEMP fleet view, Prometheus' metrics. Runs if `HOLDFAST_PYTHON` names a Python that has what
//! `tests/record/requirements.txt` lists, and `HOLDFAST_FOXGLOVE` a folder with what `tests/feeds/package.json` lists;
//! says so if not, and fails where every test is required.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/process.rs"]
mod process;
#[path = "support/required.rs"]
mod required;
#[path = "support/site.rs"]
mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use holdfast::record::{files_of, read_messages};
use holdfast::site::Site;
use serde_json::{Value, json};

use process::repository;
use support::{Folder, Machine, get};

const HOLDFAST: &str = env!("CARGO_BIN_EXE_holdfast");
const SESSION: &str = "20261123T103927Z";

fn python() -> Option<OsString> {
    required::variable("HOLDFAST_PYTHON", "a Python with the packages of tests/record/requirements.txt")
}

fn node() -> Option<PathBuf> {
    let what = "a folder with node_modules by tests/feeds/package.json";
    required::variable("HOLDFAST_FOXGLOVE", what).map(PathBuf::from)
}

/// Runs a program to its end; what it says is shown if it fails.
async fn run(mut command: Command) -> String {
    let run = move || command.stdin(Stdio::null()).output().expect("starts");
    let output = tokio::task::spawn_blocking(run).await.expect("ran");
    let (said, complained) =
        (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}{complained}");
    said.into_owned()
}

fn watch(tools: &Path, url: &str, seconds: &str, out: &Path, steps: &Value) -> Command {
    let mut command = Command::new("node");
    command.env("NODE_PATH", tools.join("node_modules")).arg(repository("tests/feeds/watch.cjs"));
    command.args([url, seconds]).arg(out).arg(steps.to_string());
    command
}

fn seen(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out).expect("written")).expect("JSON")
}

fn nanos(stamp: &Value) -> i64 {
    stamp["sec"].as_i64().expect("seconds") * 1_000_000_000 + stamp["nanosec"].as_i64().expect("nanoseconds")
}

/// A site without a recorder whose only session is a recording of the repository.
async fn with_session(folder: &Folder, recording: &str) -> (Site, Vec<PathBuf>) {
    let mut config = folder.config();
    config.record.enabled = false;
    let into = folder.0.join("sessions").join(SESSION);
    std::fs::create_dir_all(&into).expect("made");
    let files = files_of(&repository(recording)).expect("files");
    for (number, file) in files.iter().enumerate() {
        std::fs::copy(file, into.join(format!("{SESSION}-{number:04}.mcap"))).expect("copied");
    }
    (Site::start(&config).await.expect("starts"), files)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foxglove_sees_what_the_api_says_and_what_is_recorded() {
    let Some(tools) = node() else { return };
    let folder = Folder::new("foxglove-live");
    let data = folder.0.join("data");
    let mut site = process::site(Path::new(HOLDFAST), &folder.0, &data, Stdio::null());
    let (address, endpoint) = site.addresses();
    let address: SocketAddr = address.parse().expect("an address");
    let mut machine =
        process::machine(Path::new(HOLDFAST), "walker-1", &endpoint, &folder.0.join("on-board"), "1");
    let pose = async || {
        let fleet = get(address, "/api/v1/fleet").await.json();
        fleet["machines"][0]["pose"].clone()
    };
    let patience = tokio::time::Instant::now() + process::PATIENCE;
    while pose().await.is_null() {
        assert!(tokio::time::Instant::now() < patience, "the machine does not start");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let out = folder.0.join("seen.json");
    let url = format!("ws://{address}/foxglove");
    let watching = tokio::spawn(run(watch(&tools, &url, "6", &out, &json!([]))));
    let mut poses = Vec::new();
    while !watching.is_finished() {
        poses.push(pose().await);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    watching.await.expect("watched");
    machine.end();
    site.end();
    let seen = seen(&out);
    assert_eq!(seen["serverInfo"]["capabilities"], json!(["time"]));
    assert_eq!(seen["status"], json!([]), "{}", seen["status"]);
    assert!(seen["times"].as_array().map_or(0, Vec::len) > 30);

    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    let mut by_stamp: BTreeMap<(&str, i64), &Value> = BTreeMap::new();
    for message in seen["messages"].as_array().expect("messages") {
        let (topic, value) = (message["topic"].as_str().expect("topic"), &message["value"]);
        *counts.entry(topic).or_default() += 1;
        let of_child = |transform: &Value| transform["child_frame_id"] == "walker-1/imu";
        if topic == "/walker-1/tf" && value["transforms"].as_array().is_some_and(|all| of_child(&all[0])) {
            let transform = &value["transforms"][0];
            assert_eq!(transform["header"]["frame_id"], "world");
            by_stamp.insert((topic, nanos(&transform["header"]["stamp"])), transform);
        } else if value["header"]["stamp"].is_object() {
            by_stamp.insert((topic, nanos(&value["header"]["stamp"])), value);
        }
    }
    for (topic, at_least) in [
        ("pose", 400),
        ("odom", 400),
        ("health", 4),
        ("tf", 800),
        ("location", 400),
        ("sensor/imu", 400),
        ("sensor/base_imu", 100),
        ("sensor/gnss_left", 10),
        ("sensor/lidar_odometry", 10),
        ("sensor/cabin_turn", 10),
    ] {
        let count = counts.get(format!("/walker-1/{topic}").as_str()).copied().unwrap_or(0);
        assert!(count >= at_least, "{topic}: {count} of {counts:?}");
    }

    // The API's poses are among Foxglove's, with the same numbers.
    let mut compared = 0;
    for pose in &poses {
        let stamp: jiff::Timestamp = pose["stamp"].as_str().expect("stamp").parse().expect("a time");
        let stamp = i64::try_from(stamp.as_nanosecond()).expect("before 2262");
        let Some(message) = by_stamp.get(&("/walker-1/pose", stamp)) else { continue };
        let location = by_stamp.get(&("/walker-1/location", stamp)).expect("a location for each pose");
        let transform = by_stamp.get(&("/walker-1/tf", stamp)).expect("a transform for each pose");
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            assert_eq!(message["pose"]["pose"]["position"][name], pose["position_m"][axis]);
            assert_eq!(transform["transform"]["translation"][name], pose["position_m"][axis]);
            let variance = location["position_covariance"][4 * axis].as_f64().expect("a number");
            let sigma_m = pose["position_sigma_m"][axis].as_f64().expect("a number");
            assert!((variance.sqrt() - sigma_m).abs() < 1e-9, "{variance} and {sigma_m}");
        }
        assert_eq!(transform["transform"]["rotation"], message["pose"]["pose"]["orientation"]);
        for (ours, theirs) in
            [("latitude_deg", "latitude"), ("longitude_deg", "longitude"), ("altitude_m", "altitude")]
        {
            assert_eq!(location[theirs], pose[ours], "{theirs}");
        }
        compared += 1;
    }
    assert!(compared > 30, "{compared} of {} poses", poses.len());

    // Everything that a machine sent is in the recording, with the same time and the same bytes.
    let session = std::fs::read_dir(data.join("sessions")).expect("sessions");
    let session = session.map(|entry| entry.expect("entry").path()).find(|path| path.is_dir());
    let mut recorded = BTreeSet::new();
    for file in files_of(&session.expect("a session")).expect("files") {
        for message in read_messages(&file).expect("opens") {
            let message = message.expect("reads");
            let topic = format!("/{}/{}", message.machine, message.topic);
            recorded.insert((topic, message.received.as_nanos().to_string(), base64(&message.payload)));
        }
    }
    for message in seen["messages"].as_array().expect("messages") {
        let text = |key: &str| message[key].as_str().expect("text").to_owned();
        if !["/tf", "/location", "/log"].iter().any(|made| text("topic").ends_with(made)) {
            let key = (text("topic"), text("time"), text("bytes"));
            assert!(recorded.contains(&key), "not recorded: {} at {}", key.0, key.1);
        }
    }
}

/// As `Buffer.toString("base64")` writes it.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for three in bytes.chunks(3) {
        let word = (0..3).fold(0_u32, |word, at| (word << 8) | u32::from(*three.get(at).unwrap_or(&0)));
        for digit in 0..4 {
            match digit <= three.len() {
                true => text.push(char::from(DIGITS[(word >> (18 - 6 * digit)) as usize & 63])),
                false => text.push('='),
            }
        }
    }
    text
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_plays_with_playback_control() {
    let Some(python) = python() else { return };
    for recording in ["tests/replay/restarts", "tests/replay/outage"] {
        let folder = Folder::new("foxglove-playback");
        let (site, files) = with_session(&folder, recording).await;
        let mut command = Command::new(&python);
        command.arg(repository("tests/feeds/playback.py"));
        command.arg(format!("ws://{}/foxglove?session={SESSION}", site.address())).args(files);
        let said = run(command).await;
        assert!(said.contains(" messages of "), "{said}");
        site.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_plays_by_parameters_where_there_is_no_playback_control() {
    let Some(tools) = node() else { return };
    let folder = Folder::new("foxglove-parameters");
    let (site, files) = with_session(&folder, "tests/replay/outage").await;
    let begin = read_messages(&files[0]).expect("opens").next().expect("a message").expect("reads").received;
    let out = folder.0.join("seen.json");
    let url = format!("ws://{}/foxglove?session={SESSION}&speed=2", site.address());
    let set = |name: &str, value: Value| json!({"name": format!("/playback/{name}"), "value": value});
    let steps = json!([
        [1.0, [set("playing", json!(false))]],
        [2.0, [set("position_s", json!(10.0)), set("speed", json!(4))]],
        [3.0, [set("playing", json!(true)), set("speed", json!(1e9)), set("volume", json!(1))]],
    ]);
    run(watch(&tools, &url, "4", &out, &steps)).await;
    site.stop().await;
    let seen = seen(&out);
    assert_eq!(seen["serverInfo"]["capabilities"], json!(["time", "parameters", "parametersSubscribe"]));
    let seconds = |time: &Value| {
        let nanos: i64 = time.as_str().expect("text").parse().expect("a number");
        (nanos - begin.as_nanos()) as f64 * 1e-9
    };
    let times: Vec<f64> = seen["times"].as_array().expect("times").iter().map(seconds).collect();
    let messages: Vec<f64> =
        seen["messages"].as_array().expect("messages").iter().map(|one| seconds(&one["time"])).collect();
    // Some 2 s of it, a pause, then from the tenth second some 4 s.
    let jump = messages.windows(2).position(|two| two[0] < 5.0 && two[1] >= 10.0).expect("a jump");
    assert!((1.0..4.0).contains(&messages[jump]), "{}", messages[jump]);
    assert!(messages[jump + 1..].iter().all(|time| *time >= 10.0));
    let last = messages.last().copied().unwrap_or_default();
    assert!((12.0..15.0).contains(&last), "{last}");
    assert!(times.windows(2).all(|two| two[1] >= two[0]), "time goes back");
    assert!(times.iter().any(|time| (*time - 10.0).abs() < 1e-6), "the place that was asked for is not told");
    let parameters = seen["parameters"].as_array().expect("parameters");
    assert_eq!(parameters[0], json!([{"name": "/playback/playing", "value": false}]));
    let status: Vec<&str> = seen["status"]
        .as_array()
        .expect("status")
        .iter()
        .map(|status| status["message"].as_str().expect("text"))
        .collect();
    assert!(
        status.len() == 2 && status[0].contains("1000000000") && status[1].contains("volume"),
        "{status:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn aemp_fleet_is_read_by_others_and_says_what_the_api_says() {
    let Some(python) = python() else { return };
    let folder = Folder::new("aemp");
    let site = Site::start(&folder.config()).await.expect("starts");
    const MACHINES: usize = 130;
    let ids: Vec<&'static str> = (0..MACHINES).map(|n| &*format!("digger-{n:03}").leak()).collect();
    let mut machine = Machine::connect(ids[0], 1, &site.endpoints()[0]).await;
    let heard = async || {
        let fleet = get(site.address(), "/api/v1/fleet").await.json();
        let machines = fleet["machines"].as_array().map_or(&[][..], Vec::as_slice);
        // The last one has not said where it is.
        machines.len() == MACHINES && machines.iter().filter(|one| one["pose"].is_null()).count() == 1
    };
    for _ in 0..100 {
        for (number, id) in ids.iter().enumerate() {
            machine.id = id;
            machine.sequences.clear();
            machine.health().await;
            if number + 1 < MACHINES {
                machine.pose().await;
            }
        }
        if heard().await {
            break;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(heard().await);
    // Until nobody speaks any more, so that two answers say the same.
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let mut command = Command::new(python);
    command.arg(repository("tests/feeds/check.py"));
    command.args(["aemp", &format!("http://{}", site.address()), &MACHINES.to_string()]);
    let said = run(command).await;
    assert_eq!(said, "130 machines on 2 pages, 129 with a location\n");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn metrics_are_by_the_conventions_and_those_that_compose_names_are_there() {
    let Some(python) = python() else { return };
    let folder = Folder::new("metrics");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let is_online = async || {
        let fleet = get(site.address(), "/api/v1/fleet").await.json();
        fleet["machines"][0]["presence"] == "online"
    };
    machine.speak_until(is_online).await;
    let mut command = Command::new(python);
    command.arg(repository("tests/feeds/check.py"));
    command.args(["metrics", &format!("http://{}", site.address())]).arg(repository("compose"));
    let said = run(command).await;
    assert!(said.contains(" metrics, of which compose/ names "), "{said}");
    site.stop().await;
}
