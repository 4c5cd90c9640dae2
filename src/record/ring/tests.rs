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
    let ring = Ring::open(folder.options(5, PLENTY), shelf.clone(), at(0)).expect("opens");
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
