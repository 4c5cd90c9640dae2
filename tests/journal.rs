//! What a machine has published comes out of the site's recording once more, to the bit: readings and journal in,
//! the same poses out.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "processes take real time")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use holdfast::record::{FileState, inspect, read_live_runs, read_messages};
use holdfast::replay::again;
use holdfast::simulate::Scenario;
use holdfast::wire::{RosMessage as _, Topic, odom_message, pose_message};

#[path = "support/process.rs"]
mod process;

use process::{machine, repository, site};

/// How long the machine works, and how fast its time passes.
const WORK: Duration = Duration::from_secs(8);
const SPEED: &str = "3";
const MACHINE: &str = "walker-1";

/// Lets a machine work for a while; returns the recording of its session.
fn session(data: &Path) -> PathBuf {
    let holdfast = Path::new(env!("CARGO_BIN_EXE_holdfast"));
    let mut site = site(holdfast, data, data, Stdio::null());
    let (_, endpoint) = site.addresses();
    let mut machine = machine(holdfast, MACHINE, &endpoint, &data.join("on-board"), SPEED);
    std::thread::sleep(WORK);
    machine.end();
    site.end();
    let sessions = std::fs::read_dir(data.join("sessions")).expect("sessions").flatten();
    let files: Vec<PathBuf> = sessions
        .map(|entry| entry.path().join(format!("{}-0000.mcap", entry.file_name().display())))
        .filter(|path| path.is_file())
        .collect();
    assert_eq!(files.len(), 1, "{files:?}");
    files[0].clone()
}

#[test]
fn published_poses_come_out_of_the_recording_again_to_the_bit() {
    let data = Path::new(env!("CARGO_TARGET_TMPDIR")).join("journal");
    let _ = std::fs::remove_dir_all(&data);
    std::fs::create_dir_all(&data).expect("folder");
    let recording = session(&data);
    assert_eq!(inspect(&recording).expect("a recording").state, FileState::Complete);
    let mut published: BTreeMap<Topic, Vec<Vec<u8>>> = BTreeMap::new();
    let mut readings = 0;
    for message in read_messages(&recording).expect("opens") {
        let message = message.expect("reads");
        readings += usize::from(matches!(message.topic, Topic::Sensor(_)));
        published.entry(message.topic).or_default().push(message.payload);
    }

    let runs = read_live_runs([recording.as_path()], MACHINE).expect("reads");
    let [run] = &runs[..] else { panic!("{} boots", runs.len()) };
    assert_eq!(run.gap, None);
    assert_eq!(run.run.arrivals.len(), readings, "every reading has its place");
    let late = run.run.takeovers.iter().filter(|takeover| takeover.before > takeover.solution_of + 1).count();
    assert!(late > 10, "{late} of {} takeovers", run.run.takeovers.len());

    let scenario = Scenario::load(&repository("config/scenarios/demo.toml")).expect("valid");
    let index = scenario.machine_ids().iter().position(|id| *id == MACHINE).expect("a machine of it");
    let (mut poses, mut odoms) = (Vec::new(), Vec::new());
    again(&run.run, scenario.machines[index].estimator_options(), |estimate| {
        poses.push(pose_message(estimate).encode());
        odoms.push(odom_message(estimate).encode());
    })
    .expect("that run");
    assert!(poses.len() > 500, "{} poses", poses.len());
    assert_eq!(poses.len(), published[&Topic::Pose].len());
    assert!(poses == published[&Topic::Pose], "poses differ");
    assert!(odoms == published[&Topic::Odom], "odom differs");
}
