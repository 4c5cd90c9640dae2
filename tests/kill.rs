//! Whatever is killed, whenever: what was recorded opens, and at most a second of it is missing.
//!
//! `HOLDFAST_KILL_SEED` repeats a run whose failure printed its seed. `HOLDFAST_PYTHON` names a Python that has `mcap`,
//! which reads all recordings, too; without it that is not done, and said, or fails where every test is required.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "tests kill processes, which take real time")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use holdfast::record::{self, FileState, RecordWriter, Recorded};
use holdfast::time::{Span, Stamp};
use holdfast::wire::Topic;

#[path = "support/process.rs"]
mod process;
#[path = "support/required.rs"]
mod required;

use process::{Dice, PATIENCE, Process};

const HOLDFAST: &str = env!("CARGO_BIN_EXE_holdfast");
/// What a killed site may have lost of each machine.
const LOST_AT_MOST: Span = Span::from_millis(1_000);
/// What a killed machine had handed over, but not sent.
const UNSENT_AT_MOST: Span = Span::from_millis(500);
/// Machines speak, and their first words are on the disk, so long after the start, on a busy computer too.
const QUIET_AT_MOST: Duration = Duration::from_millis(2_800);

fn now() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970");
    Stamp::from_nanos(i64::try_from(since_epoch.as_nanos()).expect("before 2262"))
}

/// A folder that goes with the test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-kill-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).expect("a temporary folder");
        Self(path)
    }

    /// All recordings, oldest first.
    fn recordings(&self) -> Vec<PathBuf> {
        let Ok(sessions) = std::fs::read_dir(self.0.join("sessions")) else { return Vec::new() };
        let files = sessions.flatten().map(|entry| {
            let id = entry.file_name().into_string().expect("ids are text");
            entry.path().join(format!("{id}-0000.mcap"))
        });
        let mut files: Vec<PathBuf> = files.filter(|file| file.is_file()).collect();
        files.sort_by_key(|file| {
            std::fs::metadata(file).and_then(|about| about.created()).expect("a birth time")
        });
        files
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn site(folder: &Folder) -> Process {
    process::site(Path::new(HOLDFAST), &folder.0, &folder.0, Stdio::null())
}

/// Waits until the site listens; returns where.
fn endpoint(site: &mut Process) -> String {
    site.addresses().1
}

fn machine(id: &str, endpoint: &str, folder: &Folder) -> Process {
    process::machine(Path::new(HOLDFAST), id, endpoint, &folder.0.join("on-board"), "1")
}

/// What is in a recording: all of it is read, and must be as many messages as the file says.
struct Content {
    state: FileState,
    messages: u64,
    last_received: BTreeMap<String, Stamp>,
}

fn open(path: &Path) -> Content {
    let summary = record::inspect(path).unwrap_or_else(|error| panic!("{error}"));
    let mut content = Content { state: summary.state, messages: 0, last_received: BTreeMap::new() };
    let mut messages = record::read_messages(path).expect("opens");
    for message in messages.by_ref() {
        let message = message.expect("reads");
        content.messages += 1;
        let last = content.last_received.entry(message.machine).or_insert(message.received);
        *last = (*last).max(message.received);
    }
    assert_eq!(messages.lost_bytes(), 0, "{}", path.display());
    assert_eq!(content.messages, summary.messages, "{}", path.display());
    content
}

/// All recordings below a folder.
fn recordings_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            files.extend(recordings_below(&path));
        } else if path.extension().is_some_and(|ending| ending == "mcap") {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// Everything that was recorded below a folder, at the site and on board, opens with `mcap` from PyPI: no message less
/// than we find ourselves.
fn public_tool_reads(folder: &Path) {
    let files = recordings_below(folder);
    // Those on board are made proper ones by the machine's next start, which the last of them do not see.
    let messages = |file| record::recover(file).unwrap_or_else(|error| panic!("{error}")).messages;
    let ours: Vec<u64> = files.iter().map(|file| messages(file)).collect();
    let Some(python) = required::variable("HOLDFAST_PYTHON", "a Python with mcap") else { return };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/record/read_all.py");
    let read = std::process::Command::new(python).arg(script).args(&files).output().expect("Python starts");
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
    let said = String::from_utf8(read.stdout).expect("text");
    let theirs: Vec<u64> = said.lines().map(|line| line.parse().expect("a number")).collect();
    assert_eq!(theirs, ours, "{files:?}");
    println!("mcap from PyPI reads {} recordings, {} messages", files.len(), theirs.iter().sum::<u64>());
}

/// Waits until somebody has made all these files proper ones.
fn recovered(files: &[PathBuf]) {
    let deadline = Instant::now() + PATIENCE;
    while !files.iter().all(|file| record::inspect(file).is_ok()) {
        assert!(Instant::now() < deadline, "not recovered");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Victim {
    Site,
    Machine,
    Both,
}

const VICTIMS: [Victim; 3] = [Victim::Site, Victim::Machine, Victim::Both];
const MACHINES: [&str; 2] = ["walker-1", "walker-2"];

/// One round, and what must be true of its recording.
struct Killed {
    round: u32,
    victim: Victim,
    path: PathBuf,
    at: Stamp,
    /// Whether the machines had time to speak for longer than what may be missing.
    spoke: bool,
}

impl Killed {
    /// Returns which file it is, and in what state.
    fn check(&self) -> (PathBuf, FileState) {
        let Self { round, victim, path, at, spoke } = self;
        let content = open(path);
        let lacks = |id| content.last_received.get(id).map(|last| (*at - *last).as_seconds());
        println!(
            "round {round}: {victim:?} killed: {}, {} messages, lacks {:?}",
            content.state.name(),
            content.messages,
            MACHINES.map(lacks)
        );
        assert_eq!(*victim == Victim::Machine, content.state == FileState::Complete, "round {round}");
        let limit = if *victim == Victim::Machine { UNSENT_AT_MOST } else { LOST_AT_MOST };
        if *spoke {
            let is_short = |id| lacks(id).is_some_and(|lack_s| lack_s <= limit.as_seconds());
            assert!(MACHINES.into_iter().all(is_short), "round {round}");
        }
        (path.clone(), content.state)
    }
}

#[test]
fn whoever_is_killed_at_whatever_moment_the_recording_opens_and_lacks_a_second_at_most() {
    let mut dice = Dice::seeded("HOLDFAST_KILL_SEED");
    let folder = Folder::new("rounds");
    let mut unrecovered: Option<Killed> = None;
    let mut states: BTreeMap<PathBuf, FileState> = BTreeMap::new();
    for round in 0..8 {
        let earlier = folder.recordings();
        let mut site = site(&folder);
        let endpoint = endpoint(&mut site);
        let mut machines = MACHINES.map(|id| machine(id, &endpoint, &folder));
        // Half of the time while everything starts, half of the time while everything runs.
        let wait = if round % 2 == 0 { dice.millis(50, 1_500) } else { dice.millis(3_000, 4_500) };
        std::thread::sleep(wait);
        let killed = now();
        let victim = VICTIMS[dice.below(3) as usize];
        if victim != Victim::Site {
            machines[0].kill();
        }
        if victim == Victim::Machine {
            // The other machine goes on, and the recording is closed properly.
            std::thread::sleep(Duration::from_millis(300));
            site.end();
        } else {
            site.kill();
        }
        drop(machines);
        recovered(&earlier);
        if let Some(before) = unrecovered.take() {
            states.extend([before.check()]);
        }
        let mut made = folder.recordings();
        made.retain(|file| !earlier.contains(file));
        let [path] = made.as_slice() else { panic!("round {round}: one session a start, not {made:?}") };
        let path = path.clone();
        let this = Killed { round, victim, path, at: killed, spoke: wait > QUIET_AT_MOST };
        // Every other time the next start of the site recovers it.
        if victim == Victim::Machine {
            states.extend([this.check()]);
        } else if dice.below(2) == 0 {
            record::recover(&this.path).expect("recovers");
            states.extend([this.check()]);
        } else {
            unrecovered = Some(this);
        }
    }
    if let Some(last) = unrecovered {
        record::recover(&last.path).expect("recovers");
        states.extend([last.check()]);
    }
    // Later starts have left alone what was proper before.
    assert_eq!(folder.recordings().len(), states.len());
    for file in folder.recordings() {
        assert_eq!(Some(&open(&file).state), states.get(&file), "{}", file.display());
    }
    let on_board = recordings_below(&folder.0.join("on-board"));
    assert!(on_board.len() >= MACHINES.len(), "{on_board:?}");
    public_tool_reads(&folder.0);
}

#[test]
fn site_killed_while_it_starts_leaves_nothing_that_does_not_open() {
    let mut dice = Dice::seeded("HOLDFAST_KILL_SEED");
    let folder = Folder::new("start");
    for _ in 0..8 {
        let mut site = site(&folder);
        std::thread::sleep(dice.millis(0, 120));
        site.kill();
    }
    let torn = folder.recordings();
    let mut site = site(&folder);
    endpoint(&mut site);
    recovered(&torn);
    site.end();
    for file in folder.recordings() {
        assert_eq!(open(&file).messages, 0);
    }
    public_tool_reads(&folder.0);
}

#[test]
fn site_killed_while_it_recovers_has_lost_nothing_and_recovers_at_the_next_start() {
    const MESSAGES: u64 = 30_000;
    let mut dice = Dice::seeded("HOLDFAST_KILL_SEED");
    let folder = Folder::new("recovery");
    let session = folder.0.join("sessions/20260101T000000Z");
    std::fs::create_dir_all(&session).expect("created");
    let torn = session.join("20260101T000000Z-0000.mcap");
    let mut writer = RecordWriter::create(&torn).expect("created");
    let start = Stamp::from_seconds(1_767_225_600.0);
    let mut payload = vec![0; 2_000];
    for sequence in 0..MESSAGES {
        payload.iter_mut().for_each(|byte| *byte = dice.below(256) as u8);
        let at = start + Span::from_millis(sequence as i64);
        let machine = "walker-1".to_owned();
        let message = Recorded {
            machine,
            topic: Topic::Event,
            boot: None,
            sequence,
            received: at,
            sent: at,
            payload: &payload,
        };
        writer.write(&message).expect("written");
    }
    writer.sync().expect("synced");
    let whole = writer.bytes().expect("a length");
    writer.finish().expect("finished");
    // As if the writer had died after its last chunk.
    std::fs::File::options().write(true).open(&torn).and_then(|file| file.set_len(whole)).expect("cut");

    // How long it takes when nobody interrupts it.
    let beside = folder.0.join("torn");
    std::fs::copy(&torn, &beside).expect("copied");
    let begun = Instant::now();
    record::recover(&beside).expect("recovers");
    let takes_ms = u64::try_from(begun.elapsed().as_millis()).expect("short").max(8);

    let mut interrupted = 0;
    for _ in 0..6 {
        let mut site = site(&folder);
        // It has begun when the site listens, or will in a moment.
        endpoint(&mut site);
        std::thread::sleep(dice.millis(0, takes_ms / 2));
        site.kill();
        interrupted += usize::from(record::inspect(&torn).is_err());
    }
    println!("interrupted {interrupted} times; it takes {takes_ms} ms");
    assert!(interrupted > 0, "it was never interrupted");
    let mut site = site(&folder);
    recovered(std::slice::from_ref(&torn));
    site.end();
    let content = open(&torn);
    assert_eq!((content.state, content.messages), (FileState::Recovered, MESSAGES));
    public_tool_reads(&folder.0.join("sessions"));
}
