//! `holdfast replay` to a site: what is recorded there is the session again, and comes out again to the bit.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "processes take real time")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use holdfast::record::read_messages;
use holdfast::time::Stamp;
use holdfast::wire::Topic;

#[path = "support/command.rs"]
mod command;
#[path = "support/process.rs"]
mod process;

use command::{empty_folder, holdfast};
use process::{repository, site};

/// Payloads in CDR by machine, topic and number: boots are others when they are replayed, but come in order.
type Contents = BTreeMap<(String, Topic, u64), Vec<Vec<u8>>>;

/// The folders of a site's sessions.
fn sessions(data: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(data.join("sessions")).expect("sessions");
    entries.map(|entry| entry.expect("an entry").path()).filter(|path| path.is_dir()).collect()
}

/// The recordings in a folder, in their order.
fn recordings(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    let is_recording = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "mcap");
    let mut files: Vec<PathBuf> = entries.filter(is_recording).collect();
    files.sort();
    files
}

/// Until something has come to the site.
fn wait_until_recorded(data: &Path) {
    let recorded = || {
        let sessions = std::fs::read_dir(data.join("sessions")).into_iter().flatten().flatten();
        let files =
            sessions.flat_map(|entry| std::fs::read_dir(entry.path()).into_iter().flatten().flatten());
        let lengths = files.map(|file| file.metadata().map_or(0, |about| about.len()));
        lengths.max().unwrap_or(0)
    };
    let begun = Instant::now();
    while recorded() < 20_000 {
        assert!(begun.elapsed() < Duration::from_secs(20), "nothing is recorded");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn contents(folder: &Path) -> Contents {
    let mut contents = Contents::new();
    for path in recordings(folder) {
        for message in read_messages(&path).expect("opens") {
            let message = message.expect("reads");
            if !message.topic.is_json() {
                let name = (message.machine, message.topic, message.sequence);
                contents.entry(name).or_default().push(message.payload);
            }
        }
    }
    contents.values_mut().for_each(|payloads| payloads.sort());
    contents
}

#[test]
fn session_replayed_to_a_site_is_recorded_there_again() {
    for (folder, boots) in [("outage", "1 boot,"), ("restarts", "2 boots,")] {
        let data = empty_folder(&format!("replay-peers-{folder}"));
        let mut site = site(Path::new(env!("CARGO_BIN_EXE_holdfast")), &data, &data, Stdio::null());
        let (_, endpoint) = site.addresses();
        let session = repository("tests/replay").join(folder);
        let arguments = ["replay", session.to_str().expect("text"), "--speed", "10", "--site", &endpoint];
        let begun = Instant::now();
        let ended = holdfast(&arguments);
        let took = begun.elapsed();
        assert_eq!(ended.code, 0, "{ended:?}");
        assert!(took > Duration::from_secs_f64(2.0), "{took:?}: some 26 s at ten times real time");
        site.end();
        let sessions = sessions(&data);
        let [recorded] = &sessions[..] else { panic!("{sessions:?}") };
        assert!(contents(recorded) == contents(&session), "{folder}: other messages");
        let ended = holdfast(&["replay", recorded.to_str().expect("text"), "--check"]);
        assert_eq!(ended.code, 0, "{ended:?}");
        let second = ended.stdout.lines().find(|line| line.starts_with("yard-2: ")).expect("yard-2");
        assert!(second.contains(boots) && second.contains("the same to the bit"), "{second}");
    }
}

#[test]
fn session_passes_as_fast_as_was_asked_and_no_faster() {
    const SPEED: f64 = 4.0;
    let data = empty_folder("replay-peers-speed");
    let mut site = site(Path::new(env!("CARGO_BIN_EXE_holdfast")), &data, &data, Stdio::null());
    let (_, endpoint) = site.addresses();
    let session = repository("tests/replay/outage");
    let ended = holdfast(&["replay", session.to_str().expect("text"), "--speed", "4", "--site", &endpoint]);
    assert_eq!(ended.code, 0, "{ended:?}");
    site.end();
    let files: Vec<PathBuf> = sessions(&data).iter().flat_map(|folder| recordings(folder)).collect();
    for machine in ["yard-1", "yard-2"] {
        // When it was said and when it was heard, s since the first.
        let messages = files.iter().flat_map(|file| read_messages(file).expect("opens"));
        let own = messages.map(|message| message.expect("reads")).filter(|one| one.machine == machine);
        let own: Vec<_> = own.filter(|one| one.topic == Topic::Pose).collect();
        let since = |at: Stamp, first: Stamp| at.seconds_since(first);
        let passed =
            own.iter().map(|one| (since(one.sent, own[0].sent), since(one.received, own[0].received)));
        let passed: Vec<(f64, f64)> = passed.collect();
        let length_s = passed.iter().map(|one| one.0).fold(0.0, f64::max);
        assert!(own.len() > 100 && length_s > 10.0, "{} poses in {length_s} s", own.len());
        // A busy computer is late now and then, but catches up: the least that any message of a third is late.
        let least_late_s = |from: f64| {
            let part = passed.iter().filter(|one| (from..from + length_s / 3.0).contains(&one.0));
            part.map(|(said_s, heard_s)| heard_s - said_s / SPEED).fold(f64::INFINITY, f64::min)
        };
        let (first_s, last_s) = (least_late_s(0.0), least_late_s(length_s * 0.66));
        let took = 1.0 + (last_s - first_s) / (length_s / SPEED);
        assert!((0.9..1.1).contains(&took), "{machine}: {took} of the time that it is to take");
    }
}

#[test]
fn who_interrupts_a_replay_is_told_so() {
    let data = empty_folder("replay-peers-interrupted");
    let mut site = site(Path::new(env!("CARGO_BIN_EXE_holdfast")), &data, &data, Stdio::null());
    let (_, endpoint) = site.addresses();
    let session = repository("tests/replay/outage");
    let mut replay = std::process::Command::new(env!("CARGO_BIN_EXE_holdfast"));
    replay.args(["replay", session.to_str().expect("text"), "--site", &endpoint]);
    let replay = replay.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
    wait_until_recorded(&data);
    let id = i32::try_from(replay.id()).expect("a process id");
    // SAFETY: a signal to a process that we started and have not waited for.
    assert_eq!(unsafe { libc::kill(id, libc::SIGINT) }, 0);
    let interrupted = Instant::now();
    let ended = replay.wait_with_output().expect("ends");
    let said = String::from_utf8_lossy(&ended.stdout);
    assert_eq!(ended.status.code(), Some(130), "{said}{}", String::from_utf8_lossy(&ended.stderr));
    assert!(said.contains(" messages, "), "{said}");
    // Of some 26 s at real time most are left.
    assert!(interrupted.elapsed() < Duration::from_secs(10), "{:?} until it ended", interrupted.elapsed());
    // The machines have taken their leave.
    site.end();
}

#[test]
fn nobody_who_listens_is_a_failure() {
    let session = repository("tests/replay/outage");
    // Nothing listens on the port of the discard protocol.
    let ended = holdfast(&["replay", session.to_str().expect("text"), "--site", "tcp/127.0.0.1:9"]);
    assert_eq!(ended.code, 1, "{ended:?}");
    assert!(ended.stderr.contains("nobody at tcp/127.0.0.1:9 listens"), "{}", ended.stderr);
}

#[test]
fn site_that_dies_is_a_failure() {
    let data = empty_folder("replay-peers-dies");
    let mut site = site(Path::new(env!("CARGO_BIN_EXE_holdfast")), &data, &data, Stdio::null());
    let (_, endpoint) = site.addresses();
    let session = repository("tests/replay/outage");
    let replay = std::process::Command::new(env!("CARGO_BIN_EXE_holdfast"))
        .args(["replay", session.to_str().expect("text"), "--speed", "4", "--site", &endpoint])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("starts");
    // Some 26 s at four times real time; it dies in the middle of them.
    wait_until_recorded(&data);
    // Dropped, it is killed.
    drop(site);
    let killed = Instant::now();
    let ended = replay.wait_with_output().expect("ends");
    let said = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(1), "{said}");
    assert!(said.contains(&format!("the site at {endpoint} went away")), "{said}");
    assert!(killed.elapsed() < Duration::from_secs(4), "{:?} until it was seen", killed.elapsed());
}
