//! `holdfast verify`: what it says of recordings, and how it ends.

#[path = "support/command.rs"]
mod command;

use std::fs;
use std::path::Path;

use holdfast::record::{ChannelBook, RecordWriter, Recorded, recover};
use holdfast::time::{Span, Stamp};
use holdfast::wire::{BootId, Topic};

use command::{Ended, empty_folder, holdfast};

/// A file of a session with the messages of these numbers.
fn write(path: &Path, sequences: std::ops::Range<u64>) {
    let mut writer = RecordWriter::create_next(path, ChannelBook::default()).expect("created");
    for sequence in sequences {
        let at = Stamp::from_seconds(1.7e9) + Span::from_millis(10 * sequence as i64);
        let machine = "walker-1".to_owned();
        let (topic, boot) = (Topic::Event, Some(BootId(0xab)));
        let payload = format!("{{\"number\":{sequence}}}");
        let message = Recorded { machine, topic, boot, sequence, received: at, sent: at, payload };
        writer.write(&message).expect("written");
    }
    writer.finish().expect("finished");
}

fn verify(path: &Path) -> Ended {
    holdfast(&["verify".as_ref(), path.as_os_str()])
}

#[test]
fn whole_session_is_told_file_by_file() {
    let folder = empty_folder("verify-whole");
    let session = folder.join("s");
    fs::create_dir_all(&session).expect("created");
    write(&session.join("s-0000.mcap"), 5..300);
    write(&session.join("s-0001.mcap"), 300..500);
    for path in [&session, &folder] {
        let ended = verify(path);
        assert_eq!((ended.code, ended.stderr.as_str()), (0, ""), "{ended:?}");
        let lines: Vec<&str> = ended.stdout.lines().collect();
        assert_eq!(lines.len(), 2, "{ended:?}");
        assert!(lines[0].contains("s-0000.mcap: complete, 295 messages of walker-1, "), "{ended:?}");
        assert!(lines[1].contains("s-0001.mcap: complete, 200 messages of walker-1, "), "{ended:?}");
    }
}

#[test]
fn damaged_torn_and_missing_parts_are_told_and_end_with_3() {
    let folder = empty_folder("verify-bad");
    let path = folder.join("s-0000.mcap");
    write(&path, 0..300);
    let whole = fs::read(&path).expect("read");

    let mut damaged = whole.clone();
    damaged[whole.len() / 3] ^= 1;
    fs::write(&path, &damaged).expect("written");
    let ended = verify(&path);
    assert_eq!(ended.code, 3, "{ended:?}");
    assert!(ended.stdout.contains("s-0000.mcap: DAMAGED: the chunk at byte "), "{ended:?}");

    fs::write(&path, &whole[..whole.len() / 3]).expect("written");
    let ended = verify(&path);
    assert_eq!(ended.code, 3, "{ended:?}");
    assert!(ended.stdout.contains("s-0000.mcap: NOT CLOSED"), "{ended:?}");
    recover(&path).expect("recovers");
    let ended = verify(&path);
    assert_eq!(ended.code, 3, "messages were lost: {ended:?}");
    assert!(
        ended.stdout.contains(": truncated, ") && ended.stdout.contains("given up in recovery"),
        "{ended:?}"
    );

    fs::write(&path, &whole).expect("written");
    write(&folder.join("s-0001.mcap"), 310..320);
    let ended = verify(&folder);
    assert_eq!(ended.code, 3, "{ended:?}");
    let expected = "MISSING: event of walker-1, boot 00000000000000ab: 10 messages in 1 gaps\n";
    assert!(ended.stdout.ends_with(expected), "{ended:?}");
    write(&folder.join("s-0002.mcap"), 300..311);
    let ended = verify(&folder);
    assert!(
        ended.stdout.ends_with("TWICE: event of walker-1, boot 00000000000000ab: 1 messages\n"),
        "{ended:?}"
    );

    fs::write(&path, b"notes").expect("written");
    let ended = verify(&path);
    assert_eq!(ended.code, 3);
    assert!(ended.stdout.contains("is not an MCAP file"), "{ended:?}");
}

#[test]
fn what_is_not_there_are_bad_arguments() {
    let folder = empty_folder("verify-none");
    for path in [folder.clone(), folder.join("nothing.mcap")] {
        let ended = verify(&path);
        assert_eq!(ended.code, 2, "{ended:?}");
        assert!(ended.stderr.contains(path.to_str().expect("text")), "{ended:?}");
    }
}
