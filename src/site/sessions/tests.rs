//! The recorder's thread, with a clock that tells the time it needs.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use super::*;
use crate::config;
use crate::record::{Checker, Gap, GapCause, RecordWriter};
use crate::site::backfill::Books;
use crate::site::clock::SiteClock;
use crate::site::counters::Counters;
use crate::site::inlet::Inbound;
use crate::time::{Span, Stamp};
use crate::wire::{Attachment, BootId, Topic};

/// A folder that is gone with the test.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-recorder-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&path).expect("temporary folder");
        Self(path)
    }

    fn config(&self, more: &str) -> config::Site {
        let text = format!(
            "id = \"quarry\"\n{more}\n[world]\nlatitude_deg = 47.0\nlongitude_deg = 8.0\naltitude_m = 400.0\n"
        );
        let mut config: config::Site = config::parse(&text, std::path::Path::new("s.toml")).expect("valid");
        config.record.directory = self.0.clone();
        config
    }

    /// All files of all sessions, in order.
    fn files(&self) -> Vec<PathBuf> {
        let mut files = Vec::new();
        for session in
            std::fs::read_dir(&self.0).expect("folder").flatten().filter(|entry| entry.path().is_dir())
        {
            files.extend(
                std::fs::read_dir(session.path()).expect("session").flatten().map(|entry| entry.path()),
            );
        }
        files.retain(|path| path.extension().is_some_and(|ending| ending == "mcap"));
        files.sort();
        files
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn time(text: &str) -> Stamp {
    let timestamp: jiff::Timestamp = text.parse().expect("a time");
    Stamp::from_nanos(i64::try_from(timestamp.as_nanosecond()).expect("in range"))
}

fn message(boot: u64, sequence: u64, stamp: Stamp, received: Stamp) -> Command {
    Command::Write(Inbound {
        machine: "a".into(),
        topic: Topic::Event,
        payload: b"{}"[..].into(),
        attachment: Attachment { sequence, boot: BootId(boot), stamp, sent: stamp },
        received,
    })
}

#[test]
#[allow(clippy::disallowed_methods, reason = "time must pass")]
fn shift_begins_with_a_session_of_its_own_and_late_messages_find_their_place() {
    let scratch = Scratch::new("shift");
    let mut config = scratch.config("time_zone = \"Europe/Zurich\"");
    config.record.rotate = config::Rotate::Shift;
    // Nine in the evening in Zurich, in summer.
    config.record.shifts = vec!["21:00".to_owned(), "05:00".to_owned()];
    let clock = SiteClock::starting_at(time("2026-07-01T18:59:59Z"));
    let recorder =
        Recorder::start(&config, scratch.0.clone(), clock, Arc::new(Counters::default()), Books::default())
            .expect("starts");
    assert_eq!(recorder.progress().borrow().next_session, Some(time("2026-07-01T19:00:00Z")));
    let inbox = recorder.inbox();
    let mut sequence = 0;
    while clock.now() < time("2026-07-01T19:00:00.6Z") {
        // Half of them come late: after a machine's next boot.
        if sequence % 2 == 0 {
            inbox.send(message(1, sequence, clock.now(), clock.now())).expect("room");
        } else {
            inbox.send(message(2, sequence / 2, clock.now(), clock.now())).expect("room");
        }
        sequence += 1;
        std::thread::sleep(Duration::from_millis(2));
    }
    for late in (1..sequence).step_by(2) {
        let stamp = time("2026-07-01T18:59:59Z") + Span::from_millis(late as i64);
        inbox.send(message(1, late, stamp, clock.now())).expect("room");
    }
    assert_eq!(recorder.progress().borrow().next_session, Some(time("2026-07-02T03:00:00Z")));
    recorder.finish();

    let files = scratch.files();
    let names: Vec<_> =
        files.iter().map(|path| path.file_name().expect("name").to_str().expect("text")).collect();
    assert_eq!(names, ["20260701T185959Z-0000.mcap", "20260701T190000Z-0000.mcap"]);
    let mut checker = Checker::default();
    let mut messages = 0;
    for path in &files {
        let checked = checker.check(path, |_| {}).expect("readable");
        assert!(checked.faults.is_empty(), "{:?}", checked.faults);
        assert!(checked.summary.messages > 20);
        messages += checked.summary.messages;
    }
    assert_eq!((checker.missing(), checker.repeated()), (vec![], vec![]));
    assert_eq!(messages, sequence + sequence / 2);
}

#[test]
fn fetched_messages_that_come_after_the_stop_are_still_missing() {
    let scratch = Scratch::new("stop");
    let clock = SiteClock::starting_at(time("2026-07-01T12:00:00Z"));
    let books = Books::default();
    let counters = Arc::new(Counters::default());
    let recorder = Recorder::start(&scratch.config(""), scratch.0.clone(), clock, counters, books.clone())
        .expect("starts");
    let inbox = recorder.inbox();
    let at = clock.now();
    let fetched = |sequence| match message(1, sequence, at, at) {
        Command::Write(inbound) => Command::Fetched(inbound),
        other => other,
    };
    for sequence in [0, 1, 8] {
        inbox.send(message(1, sequence, at, at)).expect("room");
    }
    inbox.send(fetched(2)).expect("room");
    let ask = |command: &dyn Fn(tokio::sync::oneshot::Sender<Answer>) -> Command| {
        let (sender, answer) = tokio::sync::oneshot::channel();
        inbox.send(command(sender)).expect("room");
        answer.blocking_recv().expect("answered").expect("followed")
    };
    let id = recorder.progress().borrow().session.clone().expect("runs");
    ask(&|answer| Command::Stop { id: id.clone(), answer });
    inbox.send(fetched(3)).expect("room");
    // Whoever stops the recording does not want what comes by itself then.
    inbox.send(message(1, 9, at, at)).expect("room");
    ask(&|answer| Command::Start { notes: Notes::default(), answer });
    let missing = |numbers: std::ops::Range<u64>| {
        let numbers = [(Topic::Event, crate::record::Ranges::from(vec![(numbers.start, numbers.end)]))];
        books.lock().count_missing("a", BootId(1), &numbers.into())
    };
    assert_eq!((missing(0..3), missing(3..8), missing(8..10)), (0, 5, 0));
    inbox.send(fetched(3)).expect("room");
    recorder.finish();
    let messages: usize =
        scratch.files().iter().map(|path| crate::record::read_messages(path).expect("opens").count()).sum();
    assert_eq!((messages, missing(3..8)), (5, 4));
}

#[test]
fn what_is_in_the_way_is_not_overwritten_and_torn_files_are_recovered() {
    let scratch = Scratch::new("torn");
    let config = scratch.config("");
    let earlier = scratch.0.join("20260101T000000Z");
    std::fs::create_dir_all(&earlier).expect("created");
    let torn = earlier.join("20260101T000000Z-0002.mcap");
    let mut writer = RecordWriter::create(&torn).expect("created");
    writer.sync().expect("synced");
    std::mem::forget(writer);
    let strange = earlier.join("20260101T000000Z-0003.mcap");
    std::fs::write(&strange, b"notes of a stranger").expect("written");
    let clock = SiteClock::starting_at(time("2026-01-01T00:00:00Z"));
    let recorder =
        Recorder::start(&config, scratch.0.clone(), clock, Arc::new(Counters::default()), Books::default())
            .expect("starts");
    assert_eq!(recorder.progress().borrow().session.as_deref(), Some("20260101T000000Z-2"));
    let deadline = clock.now() + Span::from_millis(20_000);
    while crate::record::inspect(&torn).is_err() {
        assert!(clock.now() < deadline, "not recovered");
    }
    let catalogue = recorder.catalogue();
    let files = || catalogue.detail("20260101T000000Z", None).map_or(0, |detail| detail.files.len());
    while files() < 2 {
        assert!(clock.now() < deadline, "not listed");
    }
    recorder.finish();
    assert_eq!(files(), 2);
    assert_eq!(std::fs::read(&strange).expect("there"), b"notes of a stranger");
}

#[test]
fn people_who_write_to_a_session_at_once_do_not_undo_each_other() {
    let scratch = Scratch::new("edit");
    let clock = SiteClock::starting_at(time("2026-01-01T00:00:00Z"));
    let counters = Arc::new(Counters::default());
    let recorder = Recorder::start(&scratch.config(""), scratch.0.clone(), clock, counters, Books::default())
        .expect("starts");
    let catalogue = recorder.catalogue();
    let id = recorder.progress().borrow().session.clone().expect("runs");
    let change = |text: String| serde_json::from_str::<NotesChange>(&text).expect("a change");
    for round in 0..20 {
        let texts = ["name", "notes"].map(|what| format!("{{\"{what}\":\"{round}\"}}"));
        std::thread::scope(|scope| {
            let edits = texts.map(|text| scope.spawn(|| catalogue.edit(&id, change(text))));
            for edit in edits {
                assert_eq!(edit.join().expect("no panic").expect("written"), Some(Ok(())));
            }
        });
        let session = catalogue.detail(&id, None).expect("there").session;
        assert_eq!((session.name, session.notes), (round.to_string(), round.to_string()));
    }
    recorder.finish();
}

/// What the files tell of gaps: first number and cause.
fn told_gaps(files: &[PathBuf]) -> Vec<(String, String)> {
    let mut told = Vec::new();
    for path in files {
        let bytes = std::fs::read(path).expect("reads");
        let summary = mcap::Summary::read(&bytes).expect("proper").expect("has one");
        for index in summary.metadata_indexes.iter().filter(|index| index.name == Gap::NAME) {
            let entries = mcap::read::metadata(&bytes, index).expect("metadata").metadata;
            told.push((entries["from"].clone(), entries["cause"].clone()));
        }
    }
    told
}

#[test]
fn gaps_are_told_when_a_file_is_open_and_open_ones_at_the_end_of_each_session() {
    let scratch = Scratch::new("gaps");
    let clock = SiteClock::starting_at(time("2026-01-01T00:00:00Z"));
    let (books, counters) = (Books::default(), Arc::new(Counters::default()));
    let recorder = Recorder::start(&scratch.config(""), scratch.0.clone(), clock, counters, books.clone())
        .expect("starts");
    let inbox = recorder.inbox();
    let ask = |command: &dyn Fn(tokio::sync::oneshot::Sender<Answer>) -> Command| {
        let (sender, answer) = tokio::sync::oneshot::channel();
        inbox.send(command(sender)).expect("room");
        answer.blocking_recv().expect("answered").expect("followed")
    };
    for sequence in [0, 1, 8, 20] {
        inbox.send(message(1, sequence, clock.now(), clock.now())).expect("room");
    }
    let id = recorder.progress().borrow().session.clone().expect("runs");
    ask(&|answer| Command::Stop { id: id.clone(), answer });
    let owned = |gaps: &[(&str, &str)]| -> Vec<(String, String)> {
        gaps.iter().map(|(from, cause)| ((*from).to_owned(), (*cause).to_owned())).collect()
    };
    assert_eq!(told_gaps(&scratch.files()), owned(&[("2", "unreachable"), ("9", "unreachable")]));
    // Some of it is lost while nothing is recorded.
    let numbers = crate::record::Ranges::from(vec![(2, 5)]);
    books.lock().lose("a", BootId(1), Topic::Event, &numbers, GapCause::Overwritten);
    ask(&|answer| Command::Start { notes: Notes::default(), answer });
    inbox.send(message(1, 25, clock.now(), clock.now())).expect("room");
    recorder.finish();
    assert!(books.lock().untold().is_empty());
    let files = scratch.files();
    let second = owned(&[("2", "overwritten"), ("21", "unreachable")]);
    assert_eq!((files.len(), told_gaps(&files[1..])), (2, second));
}
