//! The demo as a person runs it: real processes, ended in every way that processes end.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "tests watch processes, which take real time")]

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Nothing in here takes so long unless it is broken.
const PATIENCE: Duration = Duration::from_secs(30);

struct Demo {
    process: Child,
    data: PathBuf,
    address: String,
}

impl Demo {
    fn start(name: &str, arguments: &[&str]) -> Self {
        let data = std::env::temp_dir().join(format!("holdfast-demo-{name}-{}", std::process::id()));
        let started = Instant::now();
        let mut process =
            command(&data, "127.0.0.1:0", arguments).stdout(Stdio::piped()).spawn().expect("starts");
        let mut lines = BufReader::new(process.stdout.take().expect("piped")).lines();
        let mut said = |prefix: &str| {
            let line = lines.next().expect("a line").expect("read");
            line.strip_prefix(prefix).expect("as documented").to_owned()
        };
        let dashboard = said("dashboard ");
        assert!(said("zenoh ").starts_with("tcp/127.0.0.1:"));
        assert!(started.elapsed() < Duration::from_secs(5), "addresses within 5 s");
        let address = dashboard.trim_start_matches("http://").trim_end_matches('/').to_owned();
        Self { process, data, address }
    }

    fn get(&self, path: &str) -> Value {
        let mut stream = TcpStream::connect(&self.address).expect("connects");
        let host = &self.address;
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").expect("sent");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("read");
        let (_, body) = answer.split_once("\r\n\r\n").expect("a head");
        serde_json::from_str(body).expect("JSON")
    }

    fn machine(&self, id: &str) -> Value {
        self.get(&format!("/api/v1/machines/{id}"))
    }

    /// The process with these arguments, of this demo.
    fn child(&self, wanted: &[&str]) -> i32 {
        let children = children(self.process.id());
        let found = children.into_iter().find(|(_, line)| wanted.iter().all(|part| line.contains(part)));
        found.expect("a child of the demo").0
    }

    fn signal(&self, signal: i32) {
        kill(i32::try_from(self.process.id()).expect("a process id"), signal);
    }

    fn wait(&mut self) -> ExitStatus {
        let mut status = None;
        eventually("the demo ends", || {
            status = self.process.try_wait().expect("waited");
            status.is_some()
        });
        status.expect("ended")
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
        let _ = std::fs::remove_dir_all(&self.data);
    }
}

fn command(data: &Path, listen: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_holdfast"));
    // From any folder: nothing beside the binary is needed.
    command.current_dir("/").arg("demo").arg("--data").arg(data).args(["--listen", listen]).args(arguments);
    command
}

fn kill(process: i32, signal: i32) {
    // SAFETY: a signal to a process that this test started, or that a process did which it started.
    assert_eq!(unsafe { libc::kill(process, signal) }, 0);
}

/// Processes whose parent is `parent`, with their command lines.
fn children(parent: u32) -> Vec<(i32, String)> {
    let processes = std::fs::read_dir("/proc").expect("Linux").flatten();
    let ids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    let of_parent = |id: &i32| {
        let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
        // After the name, which is in parentheses: state, parent.
        let parent_of = stat.rsplit_once(") ").and_then(|(_, rest)| rest.split(' ').nth(1)?.parse().ok());
        parent_of == Some(parent)
    };
    let line = |id: i32| {
        let bytes = std::fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
        (id, String::from_utf8_lossy(&bytes).replace('\0', " "))
    };
    ids.filter(of_parent).map(line).collect()
}

fn is_gone(process: i32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    // A zombie has ended; who should wait for it is not our concern.
    stat.rsplit_once(") ").is_none_or(|(_, rest)| rest.starts_with('Z'))
}

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn killed_machine_is_lost_within_two_seconds_and_ctrl_c_ends_everything() {
    let mut demo = Demo::start("kill", &[]);
    for id in ["walker-1", "walker-2"] {
        eventually("both machines are online", || demo.machine(id)["presence"] == "online");
    }
    eventually("both machines have a pose", || {
        ["walker-1", "walker-2"].iter().all(|id| demo.machine(id)["pose"]["position_m"].is_array())
    });
    let killed = demo.child(&[" machine ", "walker-1"]);
    kill(killed, libc::SIGKILL);
    let since = Instant::now();
    eventually("it is lost", || demo.machine("walker-1")["presence"] == "lost");
    assert!(since.elapsed() < Duration::from_secs(2), "{:?}", since.elapsed());
    eventually("the other one goes on", || demo.machine("walker-2")["presence"] == "online");

    // Ctrl-C reaches the whole process group.
    let children: Vec<i32> = children(demo.process.id()).into_iter().map(|(id, _)| id).collect();
    demo.signal(libc::SIGINT);
    for child in &children {
        if !is_gone(*child) {
            kill(*child, libc::SIGINT);
        }
    }
    assert_eq!(demo.wait().code(), Some(0));
    assert!(children.into_iter().all(is_gone));
    let sessions = demo.data.join("sessions");
    let session =
        std::fs::read_dir(&sessions).expect("sessions").flatten().find(|entry| entry.path().is_dir());
    let id = session.expect("a session").file_name().into_string().expect("text");
    let summary =
        holdfast::record::inspect(&sessions.join(&id).join(format!("{id}-0000.mcap"))).expect("closed");
    assert_eq!(summary.state, holdfast::record::FileState::Complete);
    assert_eq!(summary.machines, ["walker-1", "walker-2"]);
}

#[test]
fn demo_ends_by_itself_and_by_sigterm() {
    let mut by_itself = Demo::start("duration", &["--duration", "1"]);
    assert_eq!(by_itself.wait().code(), Some(0));
    let mut by_signal = Demo::start("term", &["--speed", "2"]);
    by_signal.signal(libc::SIGTERM);
    assert_eq!(by_signal.wait().code(), Some(0));
}

#[test]
fn children_end_when_the_demo_is_killed() {
    let demo = Demo::start("orphans", &[]);
    eventually("both machines run", || children(demo.process.id()).len() == 3);
    let children: Vec<i32> = children(demo.process.id()).into_iter().map(|(id, _)| id).collect();
    demo.signal(libc::SIGKILL);
    eventually("nobody is left", || children.iter().all(|child| is_gone(*child)));
}

#[test]
fn port_that_is_taken_and_address_that_others_reach_are_refused_in_words() {
    let taken = TcpListener::bind("127.0.0.1:0").expect("binds");
    let address = taken.local_addr().expect("an address").to_string();
    let data = std::env::temp_dir().join(format!("holdfast-demo-taken-{}", std::process::id()));
    for (listen, code, words) in
        [(address.as_str(), 1, "--listen 127.0.0.1:PORT"), ("0.0.0.0:8080", 2, "loopback")]
    {
        let output = command(&data, listen, &[]).output().expect("runs");
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert!(said.contains(words), "{said}");
        assert!(output.stdout.is_empty());
    }
    let _ = std::fs::remove_dir_all(data);
}
