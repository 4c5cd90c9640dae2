//! Simulated logs, and a session as a site would have recorded it: two machines with their poses, events and an
//! outage, in two files, with a part that came late.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use holdfast::estimator::Estimator;
use holdfast::import::read_log_folder;
use holdfast::record::{RecordWriter, Recorded, SITE};
use holdfast::simulate::{self, Scenario};
use holdfast::time::{Span, Stamp};
use holdfast::wire::{RosMessage, Topic, encode_json, odom_message, pose_message};

/// What the session must give.
#[allow(dead_code, reason = "not every test that has this file uses all of it")]
pub struct Session {
    pub folder: PathBuf,
    pub files: Vec<PathBuf>,
    /// Of each machine, its poses as TUM.
    pub tum: BTreeMap<String, String>,
}

/// Writes FOLDER/logs/MACHINE of `seconds`, without GNSS from 20 s to 26 s.
pub fn simulate(folder: &Path, seconds: u32) -> Scenario {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = fs::read_to_string(root.join("config/scenarios/construction.toml")).expect("scenario");
    let machines = root.join("config/machines/");
    let text = text
        .replace("duration_s = 200.0", &format!("duration_s = {seconds}.0"))
        .replace("start_s = 105.0", "start_s = 20.0")
        .replace("end_s = 150.0", "end_s = 26.0")
        .replace("../machines/", &format!("{}/", machines.display()).replace("//", "/"));
    let path = folder.join("scenario.toml");
    fs::write(&path, text).expect("written");
    let scenario = Scenario::load(&path).expect("scenario");
    simulate::write(&scenario, &folder.join("logs"), |_| ()).expect("logs");
    scenario
}

/// Writes FOLDER/session/s-0000.mcap and s-0001.mcap: 40 s of estimates of both machines. The second 10 to 15 of
/// walker-1 came at the end, as after a lost link, and 100 of its poses twice.
#[allow(dead_code, reason = "not every test that has this file uses all of it")]
pub fn session(folder: &Path) -> Session {
    let scenario = simulate(folder, 40);
    let mut messages: Vec<(Stamp, Recorded<Vec<u8>>)> = Vec::new();
    let mut tum = BTreeMap::new();
    for machine in &scenario.machines {
        let log = read_log_folder(&folder.join("logs").join(&machine.id)).expect("log");
        let mut estimator = Estimator::new(machine.estimator_options());
        let mut sequence = 0;
        let mut text = Vec::new();
        let late = Stamp::from_seconds(10.0)..Stamp::from_seconds(15.0);
        for arrival in &log.arrivals {
            let now = arrival.arrival;
            let mut put = |topic: Topic, payload: Vec<u8>, received: Stamp| {
                let machine = machine.id.clone();
                messages.push((
                    received,
                    Recorded { machine, topic, boot: None, sequence, received, sent: now, payload },
                ));
                sequence += 1;
            };
            let estimate = estimator.predict(arrival);
            estimator.update(arrival);
            for event in estimator.take_events() {
                put(Topic::Event, encode_json("event", &event).expect("JSON"), now);
            }
            let Some(estimate) = estimate else { continue };
            let message = pose_message(&estimate);
            let [x, y, z, w] = message.orientation;
            let [e, n, u] = message.position;
            text.push(format!("{} {e} {n} {u} {x} {y} {z} {w}\n", message.header.stamp));
            let is_late = machine.id == "walker-1" && late.contains(&now);
            let received = if is_late { now + Span::from_millis(30_000) } else { now };
            put(Topic::Pose, message.encode(), received);
            if machine.id == "walker-1" && (3_000..3_100).contains(&text.len()) {
                put(Topic::Pose, message.encode(), received + Span::from_millis(2_000));
            }
            put(Topic::Odom, odom_message(&estimate).encode(), now);
        }
        tum.insert(machine.id.clone(), text.concat());
    }
    messages.sort_by_key(|(received, _)| *received);
    let into = folder.join("session");
    fs::create_dir_all(&into).expect("made");
    let world = scenario.machines[0].world;
    let site = [
        ("id", "site".to_owned()),
        ("latitude_deg", world.latitude_deg.to_string()),
        ("longitude_deg", world.longitude_deg.to_string()),
        ("altitude_m", world.altitude_m.to_string()),
    ];
    let site: BTreeMap<String, String> = site.map(|(key, value)| (key.to_owned(), value)).into();
    let half = messages.len() / 2;
    let files: Vec<PathBuf> = (0..2).map(|index| into.join(format!("s-000{index}.mcap"))).collect();
    for (path, part) in files.iter().zip([&messages[..half], &messages[half..]]) {
        let mut writer = RecordWriter::create(path).expect("created");
        writer.write_metadata(SITE, site.clone()).expect("told");
        part.iter().for_each(|(_, message)| writer.write(message).expect("written"));
        writer.finish().expect("finished");
    }
    Session { folder: into, files, tum }
}
