//! A disk that is full: the site records to a small file system of its own, in a mount namespace of its own.
//!
//! Needs `unshare` and `mount` of util-linux, and the right to make a namespace: root's, or anybody's where user
//! namespaces are allowed. Without it the tests fail, and say so.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::io::{Read as _, Write as _};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use holdfast::record::{Checker, FileState};
use holdfast::wire::Topic;
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, Command};

use support::{Folder, Machine, PATIENCE, exchange, get};

const MEGABYTE: u64 = 1_000_000;

/// A site whose disk has so little room.
struct SmallSite {
    process: Child,
    address: SocketAddr,
    endpoint: String,
    /// Its disk, as it can be seen from here.
    disk: PathBuf,
    _folder: Folder,
}

impl SmallSite {
    async fn start(name: &str, disk_megabytes: u32, reserve_megabytes: f64) -> Self {
        let folder = Folder::new(name);
        let disk = folder.0.join("disk");
        std::fs::create_dir_all(&disk).expect("created");
        let mut config = folder.config();
        config.record.directory = disk.clone();
        config.record.reserve_mb = reserve_megabytes;
        let file = folder.0.join("site.toml");
        std::fs::write(&file, toml::to_string(&config).expect("TOML")).expect("written");
        let mut refusals = String::new();
        // As somebody who is root only there; or as root, where that is not allowed.
        for namespaces in [&["-U", "-r", "-m"][..], &["-m"]] {
            let mut command = Command::new("unshare");
            command.args(namespaces).args(["sh", "-c"]);
            command.arg("mount -t tmpfs -o size=\"$1\"m none \"$2\" && exec \"$3\" site --config \"$4\"");
            command.arg("sh").arg(disk_megabytes.to_string()).arg(&disk);
            command.arg(env!("CARGO_BIN_EXE_holdfast")).arg(&file);
            command.stdout(Stdio::piped()).stderr(Stdio::piped()).kill_on_drop(true);
            let mut process = match command.spawn() {
                Ok(process) => process,
                Err(error) => {
                    refusals.push_str(&format!("unshare: {error}\n"));
                    continue;
                }
            };
            let mut lines = BufReader::new(process.stdout.take().expect("piped")).lines();
            let mut said = async |before: &str| {
                let line = tokio::time::timeout(PATIENCE, lines.next_line()).await.expect("in time");
                line.expect("read").and_then(|line| line.strip_prefix(before).map(str::to_owned))
            };
            let stderr = process.stderr.take().expect("piped");
            let mut stderr = BufReader::new(stderr).lines();
            let Some(address) = said("dashboard http://").await else {
                while let Ok(Some(line)) = stderr.next_line().await {
                    refusals.push_str(&format!("unshare {}: {line}\n", namespaces.join(" ")));
                }
                continue;
            };
            let endpoint = said("zenoh ").await.expect("an endpoint");
            // Read on, so that it can write on.
            tokio::spawn(async move {
                while let Ok(Some(line)) = stderr.next_line().await {
                    println!("site: {line}");
                }
            });
            let seen = format!("/proc/{}/root{}", process.id().expect("runs"), disk.display());
            return Self {
                process,
                address: address.trim_end_matches('/').parse().expect("an address"),
                endpoint,
                disk: PathBuf::from(seen),
                _folder: folder,
            };
        }
        panic!(
            "this test needs a small file system in a mount namespace of its own: unshare and mount of util-linux, \
             and root or user namespaces:\n{refusals}"
        );
    }

    async fn recording(&self) -> Value {
        get(self.address, "/api/v1/sessions").await.json()["recording"].clone()
    }

    async fn wait_for(&self, state: &str) -> Value {
        let waited = tokio::time::timeout(PATIENCE, async {
            loop {
                let recording = self.recording().await;
                if recording["state"] == state {
                    return recording;
                }
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        });
        waited.await.unwrap_or_else(|_| panic!("never {state}"))
    }

    /// Waits for the alert of a pause.
    async fn alert(&self, state: &str, message: &str) {
        let waited = tokio::time::timeout(PATIENCE, async {
            loop {
                let told = get(self.address, "/api/v1/alerts?rule=recording_paused").await.json();
                let alert = &told["alerts"][0];
                if alert["state"] == state
                    && alert["message"].as_str().is_some_and(|m| m.starts_with(message))
                {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        });
        waited.await.unwrap_or_else(|_| panic!("no alert that is {state} and says {message}"));
    }

    fn filler(&self) -> PathBuf {
        self.disk.join("filler")
    }

    /// The files of a session; each must be whole.
    fn check(&self, id: &str, checker: &mut Checker) -> Vec<(FileState, u64)> {
        let session = self.disk.join("sessions").join(id);
        let entries = std::fs::read_dir(session).expect("its folder");
        let mut files: Vec<PathBuf> = entries.map(|entry| entry.expect("entry").path()).collect();
        files.retain(|path| path.extension().is_some_and(|ending| ending == "mcap"));
        files.sort();
        files.iter().map(|path| check(path, checker)).collect()
    }

    async fn end(mut self) {
        let id = i32::try_from(self.process.id().expect("runs")).expect("a process id");
        // SAFETY: a signal to a process that this test started and has not waited for.
        assert_eq!(unsafe { libc::kill(id, libc::SIGTERM) }, 0);
        let ended = tokio::time::timeout(PATIENCE, self.process.wait()).await;
        assert!(ended.expect("in time").expect("waited").success());
    }
}

fn check(path: &Path, checker: &mut Checker) -> (FileState, u64) {
    let checked = checker.check(path, |_| {}).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(checked.faults, Vec::<String>::new(), "{}", path.display());
    (checked.summary.state, checked.summary.messages)
}

/// Writes until the disk has no room, or so many bytes; returns how many.
fn fill(path: &Path, megabytes: u64) -> u64 {
    let mut file = std::fs::File::options().create(true).append(true).open(path).expect("created");
    let block = vec![0x55; 100_000];
    let mut written = 0;
    while written < megabytes * MEGABYTE {
        match file.write(&block) {
            Ok(0) | Err(_) => break,
            Ok(bytes) => written += bytes as u64,
        }
    }
    written
}

/// Bytes that cannot be compressed, so that it is known how many go to the disk.
fn noise(bytes: usize) -> Vec<u8> {
    let mut noise = vec![0; bytes];
    let mut random = std::fs::File::open("/dev/urandom").expect("opens");
    random.read_exact(&mut noise).expect("reads");
    noise
}

/// Speaks, loudly, until the recording is as wanted.
async fn speak_until(site: &SmallSite, machine: &mut Machine, noise: &[u8], state: &str) -> Value {
    let spoken = tokio::time::timeout(PATIENCE, async {
        loop {
            machine.put(Topic::Event, noise.to_vec()).await;
            let recording = site.recording().await;
            if recording["state"] == state {
                return recording;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    spoken.await.unwrap_or_else(|_| panic!("never {state}"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn recording_pauses_before_the_disk_is_full_and_goes_on_when_there_is_room() {
    let site = SmallSite::start("reserve", 140, 20.0).await;
    let noise = noise(400_000);
    let mut machine = Machine::connect("a", 1, &site.endpoint).await;
    let filled = fill(&site.filler(), 60);
    assert_eq!(filled, 60 * MEGABYTE);

    let recording = site.recording().await;
    assert_eq!(recording["state"], "recording");
    let id = recording["session"].as_str().expect("runs").to_owned();
    let paused = speak_until(&site, &mut machine, &noise, "paused").await;
    assert!(paused["why"].as_str().is_some_and(|why| why.contains("nearly full")), "{paused}");
    assert_eq!(paused["session"], json!(id), "a pause does not end the session");
    let ready = get(site.address, "/readyz").await;
    assert_eq!(ready.status, 503);
    assert!(String::from_utf8_lossy(&ready.body).contains("nothing is recorded: the disk is nearly full"));
    site.alert("active", "nothing is recorded: the disk is nearly full").await;
    let refused = exchange(site.address, "POST", "/api/v1/sessions", &[]).await;
    assert_eq!((refused.status, refused.header("content-type")), (507, "application/problem+json"));
    // What was recorded is whole already, to the last message.
    let before = site.check(&id, &mut Checker::default());
    assert!(matches!(before[..], [(FileState::Complete, messages)] if messages > 20), "{before:?}");
    for _ in 0..20 {
        machine.put(Topic::Event, noise.clone()).await;
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let missed = site.recording().await;
    assert!(missed["missed"].as_u64() >= Some(10), "{missed}");

    std::fs::remove_file(site.filler()).expect("room is made");
    site.wait_for("recording").await;
    for _ in 0..10 {
        machine.put(Topic::Event, noise.clone()).await;
    }
    assert_eq!(get(site.address, "/readyz").await.status, 200);
    tokio::time::sleep(Duration::from_millis(1_500)).await;
    site.alert("cleared_unacknowledged", "nothing is recorded: the disk is nearly full").await;
    let stopped = exchange(site.address, "POST", &format!("/api/v1/sessions/{id}/stop"), &[]).await;
    assert_eq!((stopped.status, &stopped.json()["state"]), (200, &json!("complete")));
    let mut checker = Checker::default();
    let after = site.check(&id, &mut checker);
    assert_eq!(after.len(), 2);
    assert_eq!(after[0], before[0], "what was recorded before is untouched");
    assert!(after[1].1 >= 10);
    let gaps = checker.missing();
    assert!(gaps.len() == 1 && gaps[0].gaps == 1 && gaps[0].messages >= 10, "{gaps:?}");
    site.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn disk_that_is_full_all_at_once_leaves_whole_files_and_recording_goes_on_by_itself() {
    // No reserve: the disk itself says when it is full.
    let site = SmallSite::start("enospc", 100, 0.0).await;
    let noise = noise(50_000);
    let mut machine = Machine::connect("a", 1, &site.endpoint).await;
    let id = site.recording().await["session"].as_str().expect("runs").to_owned();
    let messages_of = async |id: &str| {
        get(site.address, &format!("/api/v1/sessions/{id}")).await.json()["session"]["messages"].as_u64()
    };
    machine.speak_until(async || messages_of(&id).await > Some(10)).await;
    for round in 0..2 {
        for _ in 0..30 {
            machine.put(Topic::Event, noise.clone()).await;
            tokio::time::sleep(Duration::from_millis(40)).await;
        }
        let recorded_before = messages_of(&id).await.expect("a number");
        fill(&site.filler(), 1_000);
        let paused = speak_until(&site, &mut machine, &noise, "paused").await;
        let why = paused["why"].as_str().expect("words");
        assert!(why.contains("the disk is full"), "{why}");
        site.alert("active", "nothing is recorded: the disk is full").await;
        // While the disk is full, what is on it is whole.
        let files = site.check(&id, &mut Checker::default());
        assert_eq!(files.len(), round + 1, "{files:?}");
        assert!(files[round].0 > FileState::Complete, "{files:?}");
        let kept: u64 = files.iter().map(|(_, messages)| messages).sum();
        // What was not on the disk yet is of the last second.
        assert!(kept + 40 >= recorded_before, "{kept} of {recorded_before}");

        std::fs::remove_file(site.filler()).expect("room is made");
        site.wait_for("recording").await;
        let seen = messages_of(&id).await;
        machine.speak_until(async || messages_of(&id).await > seen.map(|seen| seen + 10)).await;
    }
    let stopped = exchange(site.address, "POST", &format!("/api/v1/sessions/{id}/stop"), &[]).await;
    assert_eq!(stopped.status, 200);
    let mut checker = Checker::default();
    let files = site.check(&id, &mut checker);
    assert_eq!((files.len(), files[2].0), (3, FileState::Complete), "{files:?}");
    assert_eq!(checker.repeated(), []);
    assert!(!checker.missing().is_empty(), "what came while the disk was full is missing, and that shows");
    site.end().await;
}
