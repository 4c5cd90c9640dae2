//! What must hold of recordings, whatever happens to their writer.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::*;
use crate::lie::Vec3;
use crate::sensors::{Arrival, CabinTurn, ImuSample, Reading, Sensor};
use crate::state::Takeover;
use crate::time::Span;
use crate::wire::{BootId, JournalPage, encode_json, encode_reading};

/// A folder that is gone with the test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-record-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&path).expect("temporary folder");
        Self(path)
    }

    fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

const START: Stamp = Stamp::from_nanos(1_790_000_000_000_000_000);

fn imu(index: i64) -> Arrival {
    let stamp = START + Span::from_millis(10 * index);
    let angular_rate = Vec3::new(index as f64, 0.1, -0.2);
    let sample = ImuSample { stamp, angular_rate, specific_force: Vec3::new(0.0, 0.3, 9.81) };
    Arrival { arrival: stamp + Span::from_millis(2), reading: Reading::Imu(sample) }
}

fn recorded(machine: &str, index: u64, arrival: &Arrival) -> Recorded<Vec<u8>> {
    Recorded {
        machine: machine.to_owned(),
        topic: Topic::Sensor(arrival.reading.sensor()),
        boot: None,
        sequence: index,
        received: arrival.arrival + Span::from_millis(1),
        sent: arrival.arrival,
        payload: encode_reading(&arrival.reading),
    }
}

/// So many samples of each of two machines; what is written is in memory and on the disk as it would be live.
fn write(path: &Path, samples: i64) -> RecordWriter {
    let mut writer = RecordWriter::create(path).expect("create");
    let boot = BTreeMap::from([("boot".to_owned(), "00000000000000ab".to_owned())]);
    writer.write_metadata("holdfast.boot", boot).expect("metadata");
    for index in 0..samples {
        for machine in ["a", "b-1"] {
            writer.write(&recorded(machine, index as u64, &imu(index))).expect("write");
        }
        if index % 50 == 0 {
            let payload = format!("{{\"index\":{index}}}").into_bytes();
            let health = recorded("a", (index / 50) as u64, &imu(index));
            writer.write(&Recorded { topic: Topic::Health, payload, ..health }).expect("write");
        }
    }
    writer
}

/// The file of a writer that was killed: what is in memory is lost.
fn killed(name: &str, samples: i64) -> (Folder, PathBuf, Vec<u8>) {
    let folder = Folder::new(name);
    let path = folder.file("s-0000.mcap");
    let writer = write(&path, samples);
    let bytes = std::fs::read(&path).expect("read");
    std::mem::forget(writer);
    (folder, path, bytes)
}

fn arrivals(path: &Path, machine: &str) -> Vec<Arrival> {
    read_arrivals([path], machine, |_| ()).expect("open").map(|arrival| arrival.expect("readable")).collect()
}

#[test]
fn finished_file_gives_back_what_was_written() {
    let folder = Folder::new("finished");
    let path = folder.file("s.mcap");
    let summary = write(&path, 250).finish().expect("finish");
    assert_eq!((summary.state, summary.messages), (FileState::Complete, 505));
    assert_eq!(summary.machines, ["a", "b-1"]);
    assert_eq!(inspect(&path).expect("whole"), summary);
    assert_eq!(recover(&path).expect("whole"), summary);
    assert_eq!(machines(&path).expect("whole"), ["a", "b-1"]);
    let expected: Vec<Arrival> = (0..250).map(imu).collect();
    assert_eq!(arrivals(&path, "b-1"), expected);
    assert!(arrivals(&path, "c").is_empty());
    let health: Vec<_> = read_messages(&path)
        .expect("open")
        .map(|message| message.expect("readable"))
        .filter(|message| message.topic == Topic::Health)
        .collect();
    assert_eq!(health.len(), 5);
    assert_eq!(health[1].payload, b"{\"index\":50}");
    assert_eq!(health[1].sequence, 1);
}

#[test]
fn readings_come_in_order_of_arrival_even_if_they_were_received_otherwise() {
    let folder = Folder::new("order");
    let path = folder.file("s.mcap");
    let mut writer = RecordWriter::create(&path).expect("create");
    let turn = CabinTurn { stamp: START, angle_rad: 0.5 };
    let mut readings: Vec<Arrival> = (0..300).map(imu).collect();
    // Arrived together with the first sample, recorded after it.
    readings.insert(1, Arrival { arrival: readings[0].arrival, reading: Reading::CabinTurn(turn) });
    let received_late: Vec<&Arrival> = readings[150..].iter().chain(&readings[..150]).collect();
    for (index, arrival) in received_late.into_iter().enumerate() {
        let received = START + Span::from_millis(index as i64);
        let message = Recorded { received, ..recorded("a", index as u64, arrival) };
        writer.write(&message).expect("write");
    }
    writer.finish().expect("finish");
    assert_eq!(arrivals(&path, "a"), readings);
}

#[test]
fn readings_of_one_file_and_of_several_go_by_boot_and_number_and_come_once() {
    let folder = Folder::new("once");
    let whole = folder.file("s.mcap");
    let parts = [folder.file("s-0000.mcap"), folder.file("s-0001.mcap")];
    let message = |boot: u64, number: u64, sent: i64| Recorded {
        boot: Some(BootId(boot)),
        sequence: number,
        ..recorded("a", 0, &imu(sent))
    };
    // The clock is set back in the second boot; its third sample was fetched once more.
    let first = [message(7, 0, 0), message(7, 1, 1), message(3, 0, 50), message(3, 2, 30)];
    let second = [message(3, 1, 51), message(3, 2, 30), message(3, 3, 31)];
    let mut all = RecordWriter::create(&whole).expect("create");
    let mut part = RecordWriter::create(&parts[0]).expect("create");
    for message in &first {
        part.write(message).expect("write");
        all.write(message).expect("write");
    }
    let book = part.book().clone();
    part.finish().expect("finish");
    let mut part = RecordWriter::create_next(&parts[1], book).expect("create");
    for message in &second {
        part.write(message).expect("write");
        all.write(message).expect("write");
    }
    part.finish().expect("finish");
    all.finish().expect("finish");
    let expected: Vec<Arrival> = [0, 1, 50, 51, 30, 31].map(imu).into();
    assert_eq!(arrivals(&whole, "a"), expected);
    let parts = read_arrivals(parts.iter().map(PathBuf::as_path), "a", |_| ()).expect("open");
    assert_eq!(parts.map(|arrival| arrival.expect("readable")).collect::<Vec<_>>(), expected);
}

#[test]
fn at_most_the_last_second_is_lost_with_the_writer() {
    let (_folder, path, _) = killed("second", 500);
    let summary = recover(&path).expect("recovery");
    assert_eq!(summary.state, FileState::Recovered);
    assert_eq!(summary.lost_bytes, 0);
    let kept = arrivals(&path, "a").len();
    assert!((400..500).contains(&kept), "{kept}");
}

#[test]
fn file_cut_anywhere_opens_after_recovery_and_loses_its_last_chunk_at_most() {
    let (_folder, path, bytes) = killed("cut", 400);
    // Messages of machine a in the chunks that end at or before each byte.
    let mut whole_before = Vec::new();
    let full = arrivals(&path, "a").len();
    let mut at = MAGIC_BYTES;
    let mut messages = 0;
    while at < bytes.len() {
        let body = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
        let end = at + 9 + body;
        if bytes[at] == 6 {
            std::fs::write(&path, &bytes[..end]).expect("cut");
            messages = arrivals(&path, "a").len();
        }
        whole_before.push((end, messages));
        at = end;
    }
    assert_eq!(messages, full);
    assert!(whole_before.iter().filter(|(end, _)| bytes[*end..].first() == Some(&6)).count() >= 3);
    let mut states = [0; 3];
    for length in 0..=bytes.len() {
        // Every byte where records meet, and a prime step through their insides.
        let near = whole_before.iter().any(|(end, _)| end.abs_diff(length) <= 12);
        if !near && length % 211 != 0 && length > 64 {
            continue;
        }
        std::fs::write(&path, &bytes[..length]).expect("cut");
        let expected = whole_before.iter().rev().find(|(end, _)| *end <= length).map_or(0, |entry| entry.1);
        assert_eq!(arrivals(&path, "a").len(), expected, "reader, cut at {length}");
        let summary = recover(&path).unwrap_or_else(|error| panic!("cut at {length}: {error}"));
        states[summary.state as usize] += 1;
        assert_eq!(arrivals(&path, "a").len(), expected, "recovered, cut at {length}");
        assert_eq!(inspect(&path).expect("proper"), summary, "cut at {length}");
    }
    assert_eq!(states[FileState::Complete as usize], 0);
    assert!(states[FileState::Recovered as usize] > 0 && states[FileState::Truncated as usize] > 0);
    assert!(!path.with_extension("mcap.recovering").exists());
}

const MAGIC_BYTES: usize = mcap::MAGIC.len();

#[test]
fn finished_file_cut_in_its_index_loses_nothing() {
    let folder = Folder::new("index");
    let path = folder.file("s.mcap");
    let summary = write(&path, 200).finish().expect("finish");
    let bytes = std::fs::read(&path).expect("read");
    std::fs::write(&path, &bytes[..bytes.len() - 20]).expect("cut");
    assert!(matches!(inspect(&path), Err(RecordError::Unfinished { .. })));
    let recovered = recover(&path).expect("recovery");
    assert_eq!((recovered.state, recovered.messages), (FileState::Recovered, summary.messages));
    let metadata = std::fs::read(&path).expect("read");
    assert!(metadata.windows(13).any(|window| window == b"holdfast.boot"));
}

#[test]
fn recovery_that_is_cut_short_anywhere_is_done_again() {
    let (_folder, path, torn) = killed("again", 300);
    let recovered = recover(&path).expect("recovery");
    assert_eq!(recovered.state, FileState::Recovered);
    let bytes = std::fs::read(&path).expect("read");
    // What was whole stays where it was, and everything after it is written by the recovery.
    assert_eq!(bytes[..torn.len()], torn);
    for length in torn.len()..=bytes.len() {
        std::fs::write(&path, &bytes[..length]).expect("cut");
        let again = recover(&path).unwrap_or_else(|error| panic!("cut at {length}: {error}"));
        assert_eq!(
            (again.state, again.messages),
            (FileState::Recovered, recovered.messages),
            "cut at {length}"
        );
        assert_eq!(Checker::default().check(&path, |_| {}).expect("proper").faults, Vec::<String>::new());
    }
}

#[test]
fn damaged_chunk_is_passed_over_and_zeros_at_the_end_are_cut_off() {
    let (_folder, path, mut bytes) = killed("damaged", 400);
    let mut at = MAGIC_BYTES;
    let mut chunks = 0;
    while at < bytes.len() {
        let body = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
        if bytes[at] == 6 {
            chunks += 1;
            if chunks == 2 {
                bytes[at + 9 + body / 2] ^= 0x55;
            }
        }
        at += 9 + body;
    }
    let whole = arrivals(&path, "a").len();
    bytes.extend([0; 5000]);
    std::fs::write(&path, &bytes).expect("damage");
    let summary = recover(&path).expect("recovery");
    assert_eq!(summary.state, FileState::Truncated);
    assert!(summary.lost_bytes > 5000);
    let kept = arrivals(&path, "a").len();
    assert!(kept < whole && kept > whole / 2, "{kept} of {whole}");
}

#[test]
fn lengths_that_the_file_does_not_have_are_not_believed() {
    let folder = Folder::new("huge");
    let path = folder.file("s.mcap");
    let mut bytes = mcap::MAGIC.to_vec();
    bytes.push(6);
    bytes.extend(u64::MAX.to_le_bytes());
    bytes.extend([1; 100]);
    std::fs::write(&path, &bytes).expect("write");
    let summary = recover(&path).expect("recovery");
    assert_eq!((summary.state, summary.messages), (FileState::Truncated, 0));
}

#[test]
fn other_files_are_left_alone() {
    let folder = Folder::new("other");
    let path = folder.file("notes.mcap");
    std::fs::write(&path, b"these are notes").expect("write");
    let message = recover(&path).expect_err("not ours").to_string();
    assert!(message.ends_with("notes.mcap: is not an MCAP file"), "{message}");
    assert_eq!(std::fs::read(&path).expect("read"), b"these are notes");
    let message = recover(&folder.file("nothing.mcap")).expect_err("missing").to_string();
    assert!(message.contains("cannot be opened"), "{message}");
}

#[test]
fn unreadable_reading_is_an_error_in_its_place() {
    let folder = Folder::new("unreadable");
    let path = folder.file("s.mcap");
    let mut writer = RecordWriter::create(&path).expect("create");
    for index in 0..3 {
        let mut message = recorded("a", index, &imu(index as i64));
        if index == 1 {
            message.payload.truncate(40);
        }
        writer.write(&message).expect("write");
    }
    writer.finish().expect("finish");
    let readings: Vec<_> = read_arrivals([path.as_path()], "a", |_| ()).expect("open").collect();
    assert_eq!(readings.len(), 3);
    let message = readings[1].as_ref().expect_err("cut").to_string();
    assert!(
        message.contains("sensor/imu of a, message 1: sensor_msgs/msg/Imu: ends at byte 40"),
        "{message}"
    );
}

#[test]
fn time_before_the_epoch_and_a_clock_set_back_do_no_harm() {
    let folder = Folder::new("clock");
    let path = folder.file("s.mcap");
    let mut writer = RecordWriter::create(&path).expect("create");
    let early = Recorded { sent: Stamp::from_nanos(-5), ..recorded("a", 0, &imu(0)) };
    writer.write(&early).expect("write");
    assert!(writer.unsynced_since().is_some());
    writer.tick(Stamp::from_nanos(-1)).expect("tick");
    assert_eq!(writer.unsynced_since(), None);
    assert_eq!(writer.finish().expect("finish").messages, 1);
    assert_eq!(arrivals(&path, "a")[0].arrival, Stamp::from_nanos(0));
}

/// Chunks of a file with ten seconds of messages, each stamped so much later than it should be.
fn chunks(name: &str, late_ms: impl Fn(i64) -> i64) -> usize {
    let folder = Folder::new(name);
    let path = folder.file("s.mcap");
    let mut writer = RecordWriter::create(&path).expect("create");
    for index in 0..1_000 {
        let message = recorded("a", index as u64, &imu(index));
        let received = message.received + Span::from_millis(late_ms(index));
        writer.write(&Recorded { received, ..message }).expect("write");
    }
    writer.finish().expect("finish");
    let bytes = std::fs::read(&path).expect("read");
    mcap::Summary::read(&bytes).expect("readable").expect("a summary").chunk_indexes.len()
}

#[test]
fn stamps_in_some_disorder_are_synced_no_more_often_than_others() {
    let in_order = chunks("ordered", |_| 0);
    assert!((14..=16).contains(&in_order), "{in_order}");
    // Every other message was stamped by a thread that came to the queue late.
    let disordered = chunks("disordered", |index| if index % 2 == 0 { 0 } else { -30 });
    assert!(disordered.abs_diff(in_order) <= 1, "{disordered}, not {in_order}");
    // A clock that is set back by an hour is no disorder: one sync more, and on as before.
    let set_back = chunks("set-back", |index| if index < 500 { 0 } else { -3_600_000 });
    assert!((in_order..=in_order + 2).contains(&set_back), "{set_back}, not {in_order}");
}

/// A boot of machine `a` that took so many samples, with a page and a takeover after every ten; what `keep` does
/// not want is lost on the way.
fn write_boot(writer: &mut RecordWriter, boot: u64, samples: i64, keep: impl Fn(Topic, u64) -> bool) {
    let mut page = JournalPage::new(BootId(boot), 0, 0);
    let mut pages = 0;
    let mut write = |message: Recorded<Vec<u8>>| {
        if keep(message.topic, message.sequence) {
            writer.write(&Recorded { boot: Some(BootId(boot)), ..message }).expect("write");
        }
    };
    for index in 0..samples {
        let reading = imu(1_000 * boot as i64 + index);
        write(recorded("a", index as u64, &reading));
        page.push(Sensor::Imu, index != 5);
        if index % 10 == 9 {
            page.taken_over = Some(index as u64 - 3);
            let payload = encode_json("journal page", &page).expect("JSON");
            let message = recorded("a", pages, &reading);
            write(Recorded { topic: Topic::Journal, payload, ..message });
            pages += 1;
            page = page.next();
        }
    }
}

fn live_runs(name: &str, keep: impl Fn(Topic, u64) -> bool) -> Vec<BootRun> {
    let folder = Folder::new(name);
    let path = folder.file("s-0000.mcap");
    let mut writer = RecordWriter::create(&path).expect("create");
    write_boot(&mut writer, 1, 27, |_, _| true);
    write_boot(&mut writer, 2, 40, keep);
    writer.finish().expect("finish");
    assert_eq!(read_live_runs([path.as_path()], "b").expect("read"), []);
    read_live_runs([path.as_path()], "a").expect("read")
}

#[test]
fn runs_are_read_boot_by_boot_as_far_as_the_journal_tells() {
    let runs = live_runs("journal", |_, _| true);
    let takeover = |before| Takeover { before, solution_of: before - 4 };
    for (run, boot, pages) in [(&runs[0], 1, 2), (&runs[1], 2, 4)] {
        assert_eq!((run.boot, &run.gap), (BootId(boot), &None));
        let expected: Vec<Arrival> = (0..10 * pages).map(|index| imu(1_000 * boot as i64 + index)).collect();
        assert_eq!(run.run.arrivals, expected);
        assert_eq!(run.run.unseen, [5].into());
        assert_eq!(run.run.takeovers, (1..=pages as u64).map(|page| takeover(10 * page)).collect::<Vec<_>>());
    }
    assert_eq!(runs.len(), 2);
}

#[test]
fn run_ends_where_something_is_missing_and_says_what() {
    type Keep = fn(Topic, u64) -> bool;
    let cases: [(&str, Keep, usize, &str); 4] = [
        (
            "reading",
            |topic, sequence| topic == Topic::Journal || sequence != 13,
            13,
            "message 13 of imu is missing",
        ),
        (
            "page",
            |topic, sequence| topic != Topic::Journal || sequence != 1,
            10,
            "goes on at reading 20, not at 10",
        ),
        (
            "start",
            |topic, sequence| topic != Topic::Journal || sequence > 1,
            0,
            "goes on at reading 20, not at 0",
        ),
        (
            "first",
            |topic, sequence| topic == Topic::Journal || sequence > 2,
            0,
            "message 0 of imu is missing",
        ),
    ];
    for (name, keep, readings, expected) in cases {
        let runs = live_runs(&format!("gap-{name}"), keep);
        assert_eq!((runs.len(), &runs[0].gap), (2, &None), "{name}");
        assert_eq!(runs[1].run.arrivals.len(), readings, "{name}");
        let gap = runs[1].gap.as_ref().expect(name);
        assert!(gap.contains(expected), "{name}: {gap}");
    }
}

/// Messages come late, twice, in several files, and far from those of other topics.
#[test]
fn boot_is_read_step_by_step_as_if_all_had_come_in_order() {
    let folder = Folder::new("steps");
    let machine = "a".to_owned();
    let mut messages = Vec::new();
    let mut page = JournalPage::new(BootId(7), 0, 0);
    for index in 0..3_000_u64 {
        let message = Recorded { boot: Some(BootId(7)), ..recorded(&machine, index, &imu(index as i64)) };
        messages.push(Recorded {
            topic: Topic::Pose,
            payload: index.to_le_bytes().to_vec(),
            ..message.clone()
        });
        messages.push(message.clone());
        page.push(Sensor::Imu, true);
        if index % 10 == 9 {
            let payload = encode_json("journal page", &page).expect("JSON");
            messages.push(Recorded { topic: Topic::Journal, sequence: index / 10, payload, ..message });
            page = page.next();
        }
    }
    // The middle comes at the end, topic by topic, the youngest first, every third message of it twice.
    let (middle, mut all): (Vec<_>, Vec<_>) = messages
        .into_iter()
        .partition(|message| (900..2_100).contains(&((message.sent - START).as_nanos() / 10_000_000)));
    assert!(!middle.is_empty());
    for topic in [Topic::Pose, Topic::Journal, Topic::Sensor(Sensor::Imu)] {
        let own = middle.iter().rev().filter(|message| message.topic == topic);
        all.extend(
            own.enumerate().flat_map(|(at, message)| vec![message.clone(); 1 + usize::from(at % 3 == 0)]),
        );
    }
    let mut paths = Vec::new();
    let mut book = ChannelBook::default();
    for (part, messages) in all.chunks(all.len() / 3 + 1).enumerate() {
        let path = folder.file(&format!("s-{part:04}.mcap"));
        let mut writer = RecordWriter::create_next(&path, book).expect("create");
        for (index, message) in messages.iter().enumerate() {
            writer.write(message).expect("write");
            // A chunk now and then.
            if index % 200 == 199 {
                writer.tick(message.received + Span::from_millis(3_600_000)).expect("tick");
            }
        }
        book = writer.book().clone();
        writer.finish().expect("finish");
        paths.push(path);
    }
    let places = Places::of(paths.iter().map(PathBuf::as_path), |_| ()).expect("places");
    assert_eq!(places.machines().collect::<Vec<_>>(), ["a"]);
    let mut boots = places.boots("a").expect("boots");
    let [boot] = &mut boots[..] else { panic!("one boot") };
    for index in 0..3_000_u64 {
        let step = Step::Reading { arrival: imu(index as i64), seen: true };
        assert_eq!(boot.next_step().expect("read"), Some(step), "{index}");
        let published = boot.next_published(Topic::Pose).expect("read").expect("there");
        assert_eq!((published.sequence, published.payload), (index as u32, index.to_le_bytes().to_vec()));
    }
    assert_eq!(boot.next_step().expect("read"), None);
    assert_eq!(boot.next_published(Topic::Pose).expect("read"), None);
    assert_eq!(boot.readings_left().expect("read"), 0);
    assert_eq!(boot.gap(), None);
}

/// Three files of one session, as a writer leaves them that goes on in the next file.
fn rolled(name: &str) -> (Folder, Vec<PathBuf>) {
    let folder = Folder::new(name);
    let mut book = ChannelBook::default();
    let mut paths = Vec::new();
    for part in 0..3_u64 {
        let path = folder.file(&format!("s-{part:04}.mcap"));
        let mut writer = RecordWriter::create_next(&path, book).expect("create");
        writer.write_metadata("holdfast.session", BTreeMap::new()).expect("metadata");
        for index in 300 * part..300 * part + 300 {
            // The first file has one machine, and the second one a machine that comes before it in order.
            for machine in if part == 0 { &["b"][..] } else { &["a", "b"] } {
                let arrival = imu(index as i64);
                let boot = Some(BootId(1));
                writer.write(&Recorded { boot, ..recorded(machine, index, &arrival) }).expect("write");
            }
        }
        book = writer.book().clone();
        writer.finish().expect("finish");
        paths.push(path);
    }
    (folder, paths)
}

#[test]
fn files_of_a_session_are_one_file_whose_index_is_right() {
    let (folder, mut paths) = rolled("merge");
    // One of them was torn in between.
    let bytes = std::fs::read(&paths[1]).expect("read");
    std::fs::write(&paths[1], &bytes[..bytes.len() * 2 / 3]).expect("cut");
    assert_eq!(recover(&paths[1]).expect("recovery").state, FileState::Truncated);
    let merged = folder.file("merged.mcap");
    let pieces = merge(&paths, None).expect("merge");
    let loaded: Vec<Vec<u8>> = pieces.iter().map(|piece| piece.load().expect("load")).collect();
    assert!(pieces.iter().zip(&loaded).all(|(piece, bytes)| piece.bytes() == bytes.len() as u64));
    std::fs::write(&merged, loaded.concat()).expect("write");

    let mut checker = Checker::default();
    let checked = checker.check(&merged, |_| {}).expect("check");
    assert_eq!(checked.faults, Vec::<String>::new());
    assert_eq!(checked.summary.state, FileState::Truncated, "as the worst of them");
    let parts = paths.iter().map(|path| inspect(path).expect("proper"));
    assert_eq!(checked.summary.messages, parts.map(|part| part.messages).sum::<u64>());
    assert_eq!(checked.summary.machines, ["a", "b"]);
    let missing = checker.missing();
    assert_eq!(missing.len(), 2);
    let read = |path: &Path| read_messages(path).expect("open").collect::<Result<Vec<_>, _>>().expect("read");
    let apart: Vec<_> = paths.iter().flat_map(|path| read(path)).collect();
    assert_eq!(read(&merged), apart);

    // A file of somebody else numbers its channels otherwise.
    paths.push(folder.file("other.mcap"));
    write(&paths[3], 10).finish().expect("finish");
    let message = merge(&paths, None).expect_err("apart").to_string();
    assert!(message.contains("other.mcap") && message.contains("other numbers"), "{message}");
}

#[test]
fn session_that_runs_is_one_file_as_far_as_it_is_written() {
    let (folder, paths) = rolled("merge-running");
    let path = folder.file("s-0003.mcap");
    let mut writer = RecordWriter::create_next(&path, ChannelBook::default()).expect("create");
    writer.write(&Recorded { boot: Some(BootId(1)), ..recorded("b", 900, &imu(900)) }).expect("write");
    writer.sync().expect("sync");
    let whole = writer.bytes().expect("length");
    let pieces = merge(&paths, Some((&path, whole))).expect("merge");
    let merged = folder.file("merged.mcap");
    let bytes: Vec<Vec<u8>> = pieces.iter().map(|piece| piece.load().expect("load")).collect();
    std::fs::write(&merged, bytes.concat()).expect("write");
    assert!(matches!(inspect(&merged), Err(RecordError::Unfinished { .. })));
    let messages = read_messages(&merged).expect("open").count();
    assert_eq!(messages, 300 + 600 + 600 + 1);
}

#[test]
fn check_finds_every_damage_and_counts_what_is_missing() {
    let (_folder, paths) = rolled("check");
    let mut checker = Checker::default();
    for path in &paths {
        let checked = checker.check(path, |_| {}).expect("check");
        assert_eq!((checked.faults.len(), checked.summary.state), (0, FileState::Complete));
    }
    assert_eq!((checker.missing(), checker.repeated()), (vec![], vec![]));
    let mut without = Checker::default();
    without.check(&paths[0], |_| {}).expect("check");
    without.check(&paths[2], |_| {}).expect("check");
    let stream =
        Stream { machine: "b".to_owned(), boot: Some(BootId(1)), topic: recorded("b", 0, &imu(0)).topic };
    assert_eq!(without.missing(), [Missing { stream: stream.clone(), messages: 300, gaps: 1 }]);
    without.check(&paths[2], |_| {}).expect("check");
    assert!(without.repeated().contains(&(stream, 300)));

    // Every byte counts, apart from the length of the library's name and the like, which make it another file.
    let path = &paths[0];
    let bytes = std::fs::read(path).expect("read");
    let mut found = 0;
    for at in (0..bytes.len()).step_by(bytes.len() / 400) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x10;
        std::fs::write(path, &damaged).expect("damage");
        let whole = Checker::default().check(path, |_| {}).is_ok_and(|checked| checked.faults.is_empty());
        assert!(!whole, "byte {at} of {}", bytes.len());
        found += 1;
    }
    assert!(found >= 400);
}
