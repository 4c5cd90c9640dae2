//! `holdfast replay` in process: the small recordings of `tests/replay/` come out again to the bit, and what differs or
//! is missing is told.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use holdfast::record::{ChannelBook, RecordWriter, Recorded, read_messages};
use holdfast::sensors::Sensor;
use holdfast::time::Stamp;
use holdfast::wire::{Imu, RosMessage as _, Topic, payload_stamp};

#[path = "support/command.rs"]
mod command;

use command::{Ended, empty_folder, holdfast, repository};

type Message = Recorded<Vec<u8>>;

const IMU: Topic = Topic::Sensor(Sensor::Imu);

fn replay(arguments: &[&str], sessions: &[&Path]) -> Ended {
    let mut all = vec!["replay".as_ref()];
    all.extend(sessions.iter().map(|path| path.as_os_str()));
    all.extend(arguments.iter().map(std::ffi::OsStr::new));
    holdfast(&all)
}

fn files(folder: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(repository("tests/replay").join(folder)).expect("a folder");
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.expect("an entry").path()).collect();
    files.sort();
    files
}

/// All messages of the session of that name.
fn messages(folder: &str) -> Vec<Message> {
    let read = |path: &PathBuf| read_messages(path).expect("opens").map(|message| message.expect("reads"));
    files(folder).iter().flat_map(read).collect()
}

/// A session of these messages in so many files, each in a folder of its own.
fn session<'a>(name: &str, parts: impl IntoIterator<Item = &'a [Message]>) -> PathBuf {
    let folder = empty_folder(name);
    let mut book = ChannelBook::default();
    for (index, messages) in parts.into_iter().enumerate() {
        let path = folder.join(format!("s-{index:04}.mcap"));
        let mut writer = RecordWriter::create_next(&path, book).expect("created");
        messages.iter().for_each(|message| writer.write(message).expect("written"));
        book = writer.book().clone();
        writer.finish().expect("finished");
    }
    folder
}

/// The number before `word` in the line of a machine.
fn count(ended: &Ended, machine: &str, word: &str) -> u64 {
    let lines = ended.stdout.lines();
    let line = lines.filter_map(|line| line.strip_prefix(&format!("{machine}: "))).next().expect(machine);
    let words: Vec<&str> = line.split([' ', ';', ',']).filter(|word| !word.is_empty()).collect();
    let at = words.iter().position(|found| *found == word).unwrap_or_else(|| panic!("{word} in {line}"));
    words[at - 1].parse().unwrap_or_else(|_| panic!("a number in {line}"))
}

#[test]
fn small_recordings_come_out_again_to_the_bit() {
    for (folder, boots) in [("outage", 1), ("restarts", 2)] {
        let ended = replay(&["--check"], &[&repository("tests/replay").join(folder)]);
        assert_eq!(ended.code, 0, "{folder}: {ended:?}");
        assert_eq!(ended.stdout.lines().count(), 2, "{}", ended.stdout);
        let second = if boots == 1 { "boot" } else { "boots" };
        assert_eq!(count(&ended, "yard-2", second), boots, "{}", ended.stdout);
        let recorded = messages(folder);
        for machine in ["yard-1", "yard-2"] {
            let own = |topic| {
                let own = recorded.iter().filter(|one| one.machine == machine && one.topic == topic);
                own.map(|one| (one.boot, one.sequence)).collect::<BTreeSet<_>>().len() as u64
            };
            let poses = count(&ended, machine, "poses");
            assert!(poses >= 100, "{}", ended.stdout);
            // All but the end of a boot that was killed, of which the journal does not tell any more.
            assert!(own(Topic::Pose) - poses <= 10 * (boots - 1), "{} of {}", poses, own(Topic::Pose));
            assert!(own(Topic::Odom) - count(&ended, machine, "odoms") <= 10 * (boots - 1));
        }
        assert!(ended.stderr.contains("times real time"), "{}", ended.stderr);
        let ended = replay(&["--speed", "max"], &[&repository("tests/replay").join(folder)]);
        assert_eq!(ended.code, 0, "{folder}: {ended:?}");
        assert!(count(&ended, "yard-1", "estimates") >= 500, "{}", ended.stdout);
    }
}

#[test]
fn flipped_bit_of_a_reading_is_told_with_the_first_sample_that_differs() {
    let mut recorded = messages("outage");
    let of_machine = |message: &Message, topic| message.machine == "yard-1" && message.topic == topic;
    let changed = recorded.iter_mut().find(|one| of_machine(one, IMU) && one.sequence == 300).expect("there");
    let mut imu = Imu::decode(&changed.payload).expect("an IMU sample");
    imu.angular_velocity[2] = f64::from_bits(imu.angular_velocity[2].to_bits() ^ (1 << 30));
    changed.payload = imu.encode();
    let stamp = imu.header.stamp;
    let stamps = recorded.iter().filter(|one| of_machine(one, Topic::Pose));
    let stamps = stamps.filter_map(|one| payload_stamp(one.topic, &one.payload));
    let first: Stamp = stamps.filter(|found| *found >= stamp).min().expect("a pose after it");

    let ended = replay(&["--check"], &[&session("replay-flipped", [&recorded[..]])]);
    assert_eq!(ended.code, 1, "{ended:?}");
    let differs: Vec<&str> = ended.stdout.lines().filter(|line| line.starts_with("DIFFERS")).collect();
    let [differs] = differs[..] else { panic!("{}", ended.stdout) };
    assert!(differs.contains("yard-1, boot ") && differs.contains(" mm and "), "{differs}");
    assert!(differs.contains(&format!("at {first} s: ")), "{differs}, not at {first}");
    assert!(ended.stderr.contains("1 boots came out otherwise"), "{}", ended.stderr);
    assert!(ended.stdout.contains("yard-2: ") && ended.stdout.contains("the same to the bit"));

    // The other machine alone is as it was.
    let ended = replay(&["--check", "--machine", "yard-2"], &[&session("replay-flipped", [&recorded[..]])]);
    assert_eq!((ended.code, ended.stdout.lines().count()), (0, 1), "{ended:?}");
}

#[test]
fn order_in_the_files_does_not_matter() {
    let recorded = messages("outage");
    // Every seventh message was fetched later, the youngest first, and all is in three files; some came twice.
    let (late, live): (Vec<_>, Vec<_>) =
        recorded.iter().cloned().enumerate().partition(|(at, _)| at % 7 == 3);
    let mut all: Vec<Message> = live.into_iter().map(|(_, message)| message).collect();
    all.extend(late.into_iter().rev().map(|(_, message)| message));
    all.extend(recorded[100..150].iter().cloned());
    let session = session("replay-order", all.chunks(all.len() / 3 + 1));
    let ended = replay(&["--check"], &[&session]);
    assert_eq!((ended.code, ended.stdout.lines().count()), (0, 2), "{ended:?}");
    let whole = replay(&["--check"], &[&repository("tests/replay/outage")]);
    for machine in ["yard-1", "yard-2"] {
        assert_eq!(count(&ended, machine, "poses"), count(&whole, machine, "poses"));
    }
}

#[test]
fn what_cannot_be_checked_is_told_with_its_cause() {
    type Keep = fn(&Message) -> bool;
    let cases: [(&str, Keep, &str); 6] = [
        ("reading", |one| one.topic != IMU || one.sequence != 300, "message 300 of imu is missing"),
        ("page", |one| one.topic != Topic::Journal || one.sequence != 50, "the journal goes on at reading"),
        ("journal", |one| one.topic != Topic::Journal, "there is no journal of it"),
        (
            "begun",
            |one| one.topic != Topic::Journal || one.sequence > 20,
            "the beginning of the boot is not recorded",
        ),
        ("end", |one| one.topic != Topic::Journal || one.sequence < 30, "the journal ends"),
        (
            "pose",
            |one| one.topic != Topic::Pose || one.sequence != 40,
            "1 poses and 0 odoms: they are not in",
        ),
    ];
    let recorded = messages("outage");
    for (name, keep, cause) in cases {
        let kept = recorded.iter().filter(|one| one.machine != "yard-1" || keep(one));
        let kept: Vec<Message> = kept.cloned().collect();
        let folder = session(&format!("replay-{name}"), [&kept[..]]);
        let ended = replay(&["--check"], &[&folder]);
        assert_eq!(ended.code, 3, "{name}: {ended:?}");
        let told: Vec<&str> = ended.stdout.lines().filter(|line| line.contains("NOT CHECKED")).collect();
        let [told] = told[..] else { panic!("{name}: {}", ended.stdout) };
        assert!(told.contains("yard-1, boot ") && told.contains(cause), "{name}: {told}");
        assert!(!ended.stdout.contains("DIFFERS"), "{name}: {}", ended.stdout);
        assert!(count(&ended, "yard-2", "poses") >= 100, "{name}");
        // Nor is it kept quiet where nothing is compared, if the run itself is concerned.
        let ended = replay(&["--speed", "max"], &[&folder]);
        let told: Vec<&str> = ended.stdout.lines().filter(|line| line.starts_with("NOT RUN: ")).collect();
        if name == "pose" {
            assert_eq!((ended.code, told.len()), (0, 0), "{name}: {ended:?}");
        } else {
            assert_eq!((ended.code, told.len()), (3, 1), "{name}: {ended:?}");
            assert!(told[0].contains("yard-1, boot ") && told[0].contains(cause), "{name}: {}", told[0]);
        }
    }
}

#[test]
fn options_that_may_come_twice_leave_the_session_to_itself() {
    let session = repository("tests/replay/outage");
    let session = session.to_str().expect("text");
    let ended = holdfast(&["replay", "--check", "--machine", "yard-1", session]);
    assert_eq!((ended.code, ended.stdout.lines().count()), (0, 1), "{ended:?}");
    let ended = holdfast(&["replay", "--machine", "yard-2", "--check", "--machine", "yard-1", session]);
    assert_eq!((ended.code, ended.stdout.lines().count()), (0, 2), "{ended:?}");
    let file = repository("tests/replay/yard-1.toml");
    let ended = holdfast(&["replay", "--check", "--machine-file", file.to_str().expect("text"), session]);
    assert_eq!((ended.code, ended.stdout.lines().count()), (0, 2), "{ended:?}");
}

#[test]
fn machine_file_given_is_used_instead_of_the_recorded_one() {
    let folder = empty_folder("replay-machine-file");
    let text = std::fs::read_to_string(repository("tests/replay/yard-1.toml")).expect("a machine file");
    let other = text.replace("translation_m = [-1.12, 0.82, 2.05]", "translation_m = [-1.13, 0.82, 2.05]");
    assert_ne!(other, text);
    let path = folder.join("yard-1.toml");
    let check = |text: &str| {
        std::fs::write(&path, text).expect("written");
        let file = path.to_str().expect("text");
        replay(&["--check", "--machine-file", file], &[&repository("tests/replay/outage")])
    };
    assert_eq!(check(&text).code, 0);
    let ended = check(&other);
    assert_eq!(ended.code, 1, "{ended:?}");
    assert!(ended.stdout.contains("DIFFERS: yard-1, boot "), "{}", ended.stdout);
    assert_eq!(check("id = \"yard-1\"\n").code, 2);
}

#[test]
fn bad_arguments_are_refused() {
    let session = repository("tests/replay/outage");
    for (arguments, reason) in [
        (&["--check", "--speed", "2"][..], "max only"),
        (&["--check", "--machine", "yard-3"], "no machine yard-3, but: yard-1, yard-2"),
        (&["--speed", "0"], "0.01 to 1000"),
        (&["--check", "--site", "tcp/127.0.0.1:7447"], "cannot be used with"),
        (&["--check", "--site-id", "quarry"], "cannot be used with"),
        (&["--speed", "max", "--site", "tcp/127.0.0.1:7447"], "speaks to no site"),
    ] {
        let ended = replay(arguments, &[&session]);
        assert_eq!(ended.code, 2, "{arguments:?}: {ended:?}");
        assert!(ended.stderr.contains(reason), "{arguments:?}: {}", ended.stderr);
    }
    assert_eq!(replay(&["--check"], &[&session.join("none.mcap")]).code, 2);
    assert_eq!(replay(&["--check"], &[&empty_folder("replay-empty")]).code, 2);
}
