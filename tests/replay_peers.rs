//! `holdfast replay` to a site: what is recorded there is the session again, and comes out again to the bit.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "processes take real time")]

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use holdfast::record::read_messages;
use holdfast::wire::Topic;

#[path = "support/command.rs"]
mod command;

use command::{empty_folder, holdfast, repository};

/// Nothing in here takes so long unless it is broken.
const PATIENCE: Duration = Duration::from_secs(30);

/// The site's process; it does not outlive the test.
struct Site(Child);

impl Site {
    fn start(data: &Path) -> (Self, String) {
        let config = data.join("site.toml");
        let text = std::fs::read_to_string(repository("config/site.toml")).expect("a site file");
        std::fs::write(&config, text.replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0")).expect("written");
        let mut command = Command::new(env!("CARGO_BIN_EXE_holdfast"));
        command.arg("site").arg("--config").arg(config).arg("--data").arg(data);
        command.args(["--listen", "127.0.0.1:0"]).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut site = Self(command.spawn().expect("starts"));
        let mut lines = BufReader::new(site.0.stdout.take().expect("piped")).lines();
        let endpoint = lines.find_map(|line| line.expect("text").strip_prefix("zenoh ").map(str::to_owned));
        (site, endpoint.expect("the site starts"))
    }

    fn end(&mut self) {
        let id = i32::try_from(self.0.id()).expect("a process id");
        // SAFETY: a signal to a process that this test started and has not waited for.
        assert_eq!(unsafe { libc::kill(id, libc::SIGTERM) }, 0);
        let deadline = Instant::now() + PATIENCE;
        while self.0.try_wait().expect("waited").is_none() {
            assert!(Instant::now() < deadline, "does not end");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Payloads in CDR by machine, topic and number: boots are others when they are replayed, but come in order.
type Contents = BTreeMap<(String, Topic, u64), Vec<Vec<u8>>>;

fn contents(folder: &Path) -> Contents {
    let mut contents = Contents::new();
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path()).collect();
    files.sort();
    for path in files.iter().filter(|path| path.extension().is_some_and(|ending| ending == "mcap")) {
        for message in read_messages(path).expect("opens") {
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
        let (mut site, endpoint) = Site::start(&data);
        let session = repository("tests/replay").join(folder);
        let arguments = ["replay", session.to_str().expect("text"), "--speed", "10", "--site", &endpoint];
        let begun = Instant::now();
        let ended = holdfast(&arguments);
        let took = begun.elapsed();
        assert_eq!(ended.code, 0, "{ended:?}");
        assert!(took > Duration::from_secs_f64(2.0), "{took:?}: some 26 s at ten times real time");
        site.end();
        let sessions: Vec<PathBuf> = std::fs::read_dir(data.join("sessions"))
            .expect("sessions")
            .map(|entry| entry.expect("an entry").path())
            .filter(|path| path.is_dir())
            .collect();
        let [recorded] = &sessions[..] else { panic!("{sessions:?}") };
        assert!(contents(recorded) == contents(&session), "{folder}: other messages");
        let ended = holdfast(&["replay", recorded.to_str().expect("text"), "--check"]);
        assert_eq!(ended.code, 0, "{ended:?}");
        let second = ended.stdout.lines().find(|line| line.starts_with("yard-2: ")).expect("yard-2");
        assert!(second.contains(boots) && second.contains("the same to the bit"), "{second}");
    }
}

#[test]
fn nobody_who_listens_is_a_failure() {
    let session = repository("tests/replay/outage");
    // Nothing listens on the port of the discard protocol.
    let ended = holdfast(&["replay", session.to_str().expect("text"), "--site", "tcp/127.0.0.1:9"]);
    assert_eq!(ended.code, 1, "{ended:?}");
    assert!(ended.stderr.contains("nobody at tcp/127.0.0.1:9 listens"), "{}", ended.stderr);
}
