//! What must hold of a ring.

use super::*;
use crate::record::read_messages;
use crate::wire::{Batch, Wanted};

/// A folder that is gone with the test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-ring-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }

    fn files(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(&self.0).expect("folder").flatten().map(|entry| entry.path());
        let mut files: Vec<_> = entries.filter(|path| path.extension().is_some()).collect();
        files.sort();
        files
    }

    fn options(&self, boot: u64, bytes_max: u64) -> RingOptions {
        let about = vec![("holdfast.machine".to_owned(), [("id".to_owned(), "a".to_owned())].into())];
        RingOptions { folder: self.0.clone(), machine: "a".to_owned(), boot: BootId(boot), bytes_max, about }
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

const START: Stamp = Stamp::from_nanos(1_790_000_000_000_000_000);
const PLENTY: u64 = 1 << 30;

fn at(index: u64) -> Stamp {
    START + Span::from_millis(10 * index as i64)
}

/// An event is recorded as it is; every tenth message is one.
fn message(boot: u64, index: u64) -> Recorded<Vec<u8>> {
    let (topic, sequence) =
        if index % 10 == 9 { (Topic::Event, index / 10) } else { (Topic::Journal, index - index / 10) };
    // Bytes that cannot be packed.
    let noise = (0..200).map(|byte| {
        let mixed = (index * 1_000 + byte + boot).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        ((mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40) as u8
    });
    let payload = noise.collect();
    let boot = Some(BootId(boot));
    Recorded { machine: "a".to_owned(), topic, boot, sequence, received: at(index), sent: at(index), payload }
}

fn fill(ring: &mut Ring, boot: u64, indexes: std::ops::Range<u64>) {
    indexes.for_each(|index| ring.write(&message(boot, index)).expect("written"));
}

/// All that is wanted, piece by piece.
fn fetch(reader: &mut RingReader, boot: u64, wanted: &Wanted, bytes: u64) -> (Vec<(Topic, u64)>, Batch) {
    let mut wanted = wanted.clone();
    let mut fetched = Vec::new();
    for _ in 0..10_000 {
        let batch = reader.batch(BootId(boot), &wanted, bytes);
        assert!(batch.messages.iter().map(|m| Batch::bytes_of(&m.2)).sum::<u64>() <= bytes.max(300));
        for (topic, attachment, payload) in &batch.messages {
            let index = match topic {
                Topic::Event => attachment.sequence * 10 + 9,
                _ => attachment.sequence + attachment.sequence / 9,
            };
            let original = message(boot, index);
            assert_eq!(
                (attachment.boot, attachment.sent, payload),
                (BootId(boot), at(index), &original.payload)
            );
            fetched.push((*topic, attachment.sequence));
        }
        for (topic, done) in &batch.done {
            let ranges = wanted.get_mut(topic).expect("asked for");
            ranges.retain(|[_, last]| last >= done);
            ranges.iter_mut().for_each(|[first, _]| *first = (*first).max(*done));
        }
        wanted.retain(|_, ranges| !ranges.is_empty());
        if wanted.is_empty() || batch.messages.is_empty() {
            return (fetched, batch);
        }
    }
    panic!("no end of it");
}

#[test]
fn whatever_is_asked_for_comes_in_order_and_once() {
    let folder = Folder::new("fetch");
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(1, PLENTY), shelf.clone(), at(0)).expect("opens");
    fill(&mut ring, 1, 0..10_000);
    assert_eq!(folder.files().len(), 2, "one a minute");
    let mut reader = shelf.reader();
    let held = shelf.holdings(|_| true).boots;
    assert_eq!((held.len(), held[0].boot, held[0].current), (1, BootId(1), true));
    let [first, last] = held[0].topics[&Topic::Journal];
    assert!(first == 0 && (8_880..9_000).contains(&last), "a second may be missing: {last}");
    for bytes in [1, 5_000, 256 * 1024] {
        let wanted = [(Topic::Journal, vec![[10, 20], [5_395, 5_410]]), (Topic::Event, vec![[1, 3]])].into();
        let (fetched, _) = fetch(&mut reader, 1, &wanted, bytes);
        let mut expected: Vec<(Topic, u64)> = Vec::new();
        for index in 0..10_000 {
            let message = message(1, index);
            let ranges: &Vec<[u64; 2]> = &wanted[&message.topic];
            if ranges.iter().any(|[from, to]| (*from..=*to).contains(&message.sequence)) {
                expected.push((message.topic, message.sequence));
            }
        }
        assert_eq!(fetched, expected);
    }
    // What is not on the disk yet is not said to be missing.
    let wanted: Wanted = [(Topic::Journal, vec![[8_700, 8_999]])].into();
    let (fetched, batch) = fetch(&mut reader, 1, &wanted, PLENTY);
    assert_eq!((fetched.len() as u64, batch.done[&Topic::Journal]), (last - 8_699, last + 1));
    ring.finish().expect("closed");
    let (fetched, batch) = fetch(&mut reader, 1, &wanted, PLENTY);
    assert_eq!((fetched.len(), batch.done[&Topic::Journal]), (300, 9_000));
    assert_eq!(
        shelf.holdings(|topic| topic == Topic::Event).boots[0].topics,
        [(Topic::Event, [0, 999])].into()
    );
}

#[test]
fn ring_keeps_its_bound_and_forgets_the_oldest() {
    let folder = Folder::new("bound");
    let shelf = Shelf::default();
    let bytes_max = 1_000_000;
    let mut ring = Ring::open(folder.options(1, bytes_max), shelf.clone(), at(0)).expect("opens");
    for index in 0..20_000 {
        ring.write(&message(1, index)).expect("written");
        assert!(shelf.bytes() <= bytes_max);
    }
    let on_disk: u64 = folder.files().iter().map(|path| path.metadata().expect("length").len()).sum();
    assert!(on_disk <= bytes_max + 30_000 && on_disk > bytes_max / 2, "{on_disk}");
    let [first, last] = shelf.holdings(|_| true).boots[0].topics[&Topic::Journal];
    assert!(first > 12_000 && last > 17_800, "{first} {last}");
    let wanted = [(Topic::Journal, vec![[0, 17_000]])].into();
    let (fetched, batch) = fetch(&mut shelf.reader(), 1, &wanted, 1 << 18);
    assert_eq!(fetched.len() as u64, 17_001 - first);
    assert!(batch.done[&Topic::Journal] > 17_000);
}

#[test]
fn earlier_boots_are_served_also_if_they_were_killed() {
    let folder = Folder::new("boots");
    for boot in 1..5_u64 {
        let shelf = Shelf::default();
        let mut ring = Ring::open(folder.options(boot, PLENTY), shelf.clone(), at(0)).expect("opens");
        let second = Ring::open(folder.options(9, PLENTY), Shelf::default(), at(0));
        assert!(second.err().expect("locked").to_string().contains("lock"));
        fill(&mut ring, boot, 0..1_000);
        if boot % 2 == 0 {
            ring.finish().expect("closed");
        } else {
            // As if killed: the library closes a file that is dropped, so it is cut where it was synced.
            let (path, bytes) =
                shelf.lock().files.back().map(|file| (file.path.clone(), file.bytes)).expect("file");
            drop(ring);
            File::options().write(true).open(&path).and_then(|file| file.set_len(bytes)).expect("cut");
        }
    }
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(5, PLENTY), shelf.clone(), at(0)).expect("opens");
    let holdings = shelf.holdings(|_| true);
    let boots: Vec<_> = holdings.boots.iter().map(|held| (held.boot.0, held.current)).collect();
    assert_eq!(boots, [(1, false), (2, false), (3, false), (4, false), (5, true)]);
    let mut reader = shelf.reader();
    for held in &holdings.boots[..4] {
        let [first, last] = held.topics[&Topic::Journal];
        let killed = held.boot.0 % 2 == 1;
        assert!(first == 0 && if killed { (810..900).contains(&last) } else { last == 899 }, "{last}");
        let wanted = [(Topic::Journal, vec![[0, 899]])].into();
        let (fetched, batch) = fetch(&mut reader, held.boot.0, &wanted, 1 << 14);
        assert_eq!((fetched.len() as u64, batch.done[&Topic::Journal]), (last + 1, u64::MAX));
    }
    ring.finish().expect("closed");
    let count: usize = folder.files().iter().map(|path| read_messages(path).expect("opens").count()).sum();
    assert!(count > 3_600);
}

#[test]
fn numbers_go_on_past_32_bits() {
    let folder = Folder::new("far");
    let far = u64::from(u32::MAX) - 50;
    {
        let mut ring = Ring::open(folder.options(1, PLENTY), Shelf::default(), at(0)).expect("opens");
        for index in 0..100 {
            let message = Recorded { topic: Topic::Journal, sequence: far + index, ..message(1, index) };
            ring.write(&message).expect("written");
        }
        ring.finish().expect("closed");
    }
    let shelf = Shelf::default();
    let ring = Ring::open(folder.options(2, PLENTY), shelf.clone(), at(0)).expect("opens");
    assert_eq!(shelf.holdings(|_| true).boots[0].topics[&Topic::Journal], [far, far + 99]);
    let wanted = [(Topic::Journal, vec![[far + 40, far + 60]])].into();
    let batch = shelf.reader().batch(BootId(1), &wanted, PLENTY);
    let numbers: Vec<u64> = batch.messages.iter().map(|(_, attachment, _)| attachment.sequence).collect();
    assert_eq!(numbers, (far + 40..=far + 60).collect::<Vec<_>>());
    drop(ring);
}

/// What a failure leaves: the file as far as it was synced.
fn tear(ring: Ring, shelf: &Shelf) -> PathBuf {
    let (path, bytes) = shelf.lock().files.back().map(|file| (file.path.clone(), file.bytes)).expect("file");
    ring.abandon();
    File::options().write(true).open(&path).and_then(|file| file.set_len(bytes)).expect("cut");
    path
}

/// Something that opens, but does not read, in a file's place.
struct Hidden(PathBuf);

impl Hidden {
    fn hide(path: &std::path::Path) -> Self {
        std::fs::rename(path, path.with_extension("away")).expect("away");
        std::fs::create_dir(path).expect("in the way");
        Self(path.to_owned())
    }

    fn show(self) {
        std::fs::remove_dir(&self.0).expect("out of the way");
        std::fs::rename(self.0.with_extension("away"), &self.0).expect("back");
    }
}

#[test]
fn ring_that_is_opened_again_writes_over_nothing() {
    let folder = Folder::new("again");
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(1, PLENTY), shelf.clone(), at(0)).expect("opens");
    fill(&mut ring, 1, 0..1_000);
    let path = tear(ring, &shelf);
    // As on a disk that does not let it be recovered, and a stranger's file that is the newest.
    let bytes = std::fs::read(&path).expect("reads");
    let hidden = Hidden::hide(&path);
    std::fs::write(folder.0.join("00000007-notes.txt"), b"kept").expect("written");
    let mut ring = Ring::open(folder.options(1, PLENTY), shelf.clone(), at(1_000)).expect("opens");
    fill(&mut ring, 1, 1_000..2_000);
    ring.finish().expect("closed");
    drop(ring);
    hidden.show();
    assert_eq!(std::fs::read(&path).expect("there"), bytes);
    assert_eq!(std::fs::read(folder.0.join("00000007-notes.txt")).expect("there"), b"kept");
    let newest = folder.files().pop().expect("some");
    assert!(newest.ends_with("00000008-0000000000000001.mcap"), "{newest:?}");
    assert!(RecordWriter::create_next(&path, ChannelBook::default()).is_err());
    assert_eq!(std::fs::read(&path).expect("there"), bytes);
}

#[test]
fn what_cannot_be_read_now_is_not_said_to_be_missing() {
    let folder = Folder::new("unread");
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(1, PLENTY), shelf.clone(), at(0)).expect("opens");
    fill(&mut ring, 1, 0..15_000);
    ring.finish().expect("closed");
    let [first, second, third] = &folder.files()[..] else { panic!("one a minute") };
    let wanted: Wanted = [(Topic::Journal, vec![[0, 13_000]])].into();
    let mut reader = shelf.reader();
    let (all, _) = fetch(&mut reader, 1, &wanted, PLENTY);
    assert_eq!(all.len(), 13_001);
    let [end, next] = [1, 2].map(|place| shelf.lock().files[place].runs[&Topic::Journal].0);
    // The one in the middle: what is before and after is there, and no more is said than that.
    let hidden = Hidden::hide(second);
    let mut reader = shelf.reader();
    let batch = reader.batch(BootId(1), &wanted, PLENTY);
    let numbers: Vec<u64> = batch.messages.iter().map(|(_, about, _)| about.sequence).collect();
    assert_eq!(numbers, (0..end).chain(next..=13_000).collect::<Vec<_>>());
    assert_eq!(batch.done[&Topic::Journal], end);
    assert!(shelf.holdings(|_| true).boots[0].unread);
    reader.look_again();
    assert!(shelf.holdings(|_| true).boots[0].unread);
    hidden.show();
    reader.look_again();
    assert!(!shelf.holdings(|_| true).boots[0].unread);
    let batch = reader.batch(BootId(1), &wanted, PLENTY);
    assert_eq!((batch.messages.len(), batch.done[&Topic::Journal]), (13_001, 13_500));
    // The same when the ring is opened: then nobody knows what is in it.
    drop((ring, shelf));
    let hidden = Hidden::hide(first);
    let shelf = Shelf::default();
    let ring = Ring::open(folder.options(2, PLENTY), shelf.clone(), at(0)).expect("opens");
    let mut reader = shelf.reader();
    let batch = reader.batch(BootId(1), &wanted, PLENTY);
    assert_eq!((batch.messages.len() as u64, batch.done[&Topic::Journal]), (13_001 - end, 0));
    hidden.show();
    reader.look_again();
    let held = shelf.holdings(|_| true).boots[0].clone();
    assert_eq!((held.unread, held.topics[&Topic::Journal]), (false, [0, 13_499]));
    // One that somebody has deleted holds nothing.
    std::fs::remove_file(third).expect("deleted");
    let batch = reader.batch(BootId(1), &wanted, PLENTY);
    assert_eq!((batch.messages.len() as u64, batch.done[&Topic::Journal]), (next, u64::MAX));
    assert!(!shelf.holdings(|_| true).boots[0].unread);
    drop(ring);
}

#[test]
fn ring_says_what_is_overwritten_and_finds_it_in_its_files() {
    let folder = Folder::new("counted");
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(1, 1_000_000), shelf.clone(), at(0)).expect("opens");
    fill(&mut ring, 1, 0..3_000);
    assert_eq!(shelf.holdings(|_| true).boots[0].overwritten, BTreeMap::new());
    fill(&mut ring, 1, 3_000..12_000);
    let held = shelf.holdings(|_| true).boots[0].clone();
    let [first, _] = held.topics[&Topic::Journal];
    assert!(first > 4_000 && held.overwritten[&Topic::Journal] == first, "{held:?}");
    assert_eq!(shelf.holdings(|topic| topic == Topic::Event).boots[0].overwritten.len(), 1);
    // Messages that are dropped before they come here are not overwritten.
    ring.finish().expect("closed");
    drop(ring);
    let again = Shelf::default();
    let mut ring = Ring::open(folder.options(2, 10_000_000), again.clone(), at(0)).expect("opens");
    fill(&mut ring, 2, 500..1_000);
    ring.finish().expect("closed");
    let boots = again.holdings(|_| true).boots;
    assert_eq!((&boots[0].overwritten, &boots[0].topics[&Topic::Journal][0]), (&held.overwritten, &first));
    assert_eq!((boots[1].overwritten.len(), boots[1].topics[&Topic::Journal]), (0, [450, 899]));
}

#[test]
fn what_cannot_be_deleted_is_told_and_tried_again() {
    let folder = Folder::new("stuck");
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(1, 1_000_000), shelf.clone(), at(0)).expect("opens");
    fill(&mut ring, 1, 0..2_000);
    assert!(ring.take_trouble().is_none());
    let oldest = folder.files()[0].clone();
    let hidden = Hidden::hide(&oldest);
    fill(&mut ring, 1, 2_000..8_000);
    let trouble = ring.take_trouble().expect("told").to_string();
    assert!(trouble.contains("cannot be deleted") && ring.take_trouble().is_none(), "{trouble}");
    assert_eq!(shelf.lock().stuck.len(), 1);
    let [first, _] = shelf.holdings(|_| true).boots[0].topics[&Topic::Journal];
    assert!(first > 0 && shelf.bytes() <= 1_000_000);
    hidden.show();
    fill(&mut ring, 1, 8_000..8_200);
    assert!(shelf.lock().stuck.is_empty() && !oldest.exists());
}

#[test]
fn ring_counts_what_a_failure_may_have_lost_and_can_be_made_smaller() {
    let folder = Folder::new("count");
    let shelf = Shelf::default();
    let mut ring = Ring::open(folder.options(1, PLENTY), shelf.clone(), at(0)).expect("opens");
    fill(&mut ring, 1, 0..7_000);
    let bytes = shelf.bytes();
    ring.set_bytes_max(bytes / 4);
    fill(&mut ring, 1, 7_000..7_230);
    assert!(shelf.bytes() < bytes / 2, "{} of {bytes}", shelf.bytes());
    let held: u64 = shelf.holdings(|_| true).boots[0].topics.values().map(|[_, last]| last + 1).sum();
    assert_eq!(ring.abandon(), 7_230 - held);
}
