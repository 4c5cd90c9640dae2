//! Reads recordings: messages in the order of the file, one machine's readings in the order of arrival.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use mcap::records::Record;

use super::order::{Rank, Ranked, sorted};
use super::scan::Scanner;
use super::{BOOT, MACHINE, RecordError, Recorded, parse_channel_name, stamp_of};
use crate::sensors::{Arrival, Reading};
use crate::wire::{BootId, JournalHead, Topic, decode_reading};

/// Messages between two calls of `progress`.
pub(super) const PROGRESS_EVERY: u64 = 1_024;

/// The messages of a file in the order in which they were received. What is torn or damaged is passed over.
pub struct Messages {
    scanner: Scanner,
    channels: BTreeMap<u16, (String, Topic, Option<BootId>)>,
    /// What metadata say of boots.
    about: BTreeMap<(String, BootId), JournalHead>,
    ready: VecDeque<Recorded<Vec<u8>>>,
}

/// Opens a recording.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn read_messages(path: &Path) -> Result<Messages, RecordError> {
    Ok(Messages {
        scanner: Scanner::open(path)?,
        channels: BTreeMap::new(),
        about: BTreeMap::new(),
        ready: VecDeque::new(),
    })
}

impl Messages {
    /// Bytes that could not be read so far: of damaged chunks, and of the torn end once it was reached.
    pub fn lost_bytes(&self) -> u64 {
        self.scanner.damage.torn_bytes + self.scanner.damage.damaged_bytes
    }

    /// How far the file was read.
    pub fn read_bytes(&self) -> u64 {
        self.scanner.at()
    }

    /// What on-board records say of the boots in them, as far as the file was read.
    pub(super) fn about(&self) -> &BTreeMap<(String, BootId), JournalHead> {
        &self.about
    }

    /// The messages of the next chunk, or of the next record that stands alone, perhaps none; `None` at the end.
    pub(super) fn next_block(&mut self) -> Result<Option<VecDeque<Recorded<Vec<u8>>>>, RecordError> {
        let Some(records) = self.scanner.next_block()? else { return Ok(None) };
        self.take_block(records);
        Ok(Some(std::mem::take(&mut self.ready)))
    }

    /// Whose messages each channel has, of those that were met.
    pub(super) fn into_channels(self) -> BTreeMap<u16, (String, Topic, Option<BootId>)> {
        self.channels
    }

    fn take_block(&mut self, records: Vec<Record<'static>>) {
        for record in records {
            match record {
                Record::Channel(channel) => {
                    if let Some((machine, topic)) = parse_channel_name(&channel.topic) {
                        let boot = channel.metadata.get(BOOT).and_then(|boot| boot.parse().ok());
                        self.channels.insert(channel.id, (machine.to_owned(), topic, boot));
                    }
                }
                Record::Message { header, data } => {
                    // Other people's topics in the file are not ours to read.
                    if let Some((machine, topic, boot)) = self.channels.get(&header.channel_id) {
                        self.ready.push_back(Recorded {
                            machine: machine.clone(),
                            topic: *topic,
                            boot: *boot,
                            sequence: u64::from(header.sequence),
                            received: stamp_of(header.log_time),
                            sent: stamp_of(header.publish_time),
                            payload: data.into_owned(),
                        });
                    }
                }
                Record::Metadata(metadata) if metadata.name == MACHINE => {
                    let told = |key: &str| metadata.metadata.get(key).cloned();
                    let boot = told("boot").and_then(|boot| boot.parse().ok());
                    if let (Some(machine), Some(boot), Some(machine_file)) =
                        (told("machine"), boot, told("config"))
                    {
                        let software = told("software").unwrap_or_default();
                        self.about.insert((machine, boot), JournalHead { software, machine_file });
                    }
                }
                _ => {}
            }
        }
    }
}

impl Iterator for Messages {
    type Item = Result<Recorded<Vec<u8>>, RecordError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(message) = self.ready.pop_front() {
                return Some(Ok(message));
            }
            match self.scanner.next_block() {
                Ok(Some(records)) => self.take_block(records),
                Ok(None) => return None,
                Err(error) => return Some(Err(error)),
            }
        }
    }
}

/// The machines whose topics are in a file, sorted.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn machines(path: &Path) -> Result<Vec<String>, RecordError> {
    let mut messages = read_messages(path)?;
    let mut machines = BTreeSet::new();
    while let Some(block) = messages.scanner.next_block()? {
        messages.take_block(block);
        messages.ready.clear();
    }
    machines.extend(messages.channels.into_values().map(|(machine, ..)| machine));
    Ok(machines.into_iter().collect())
}

/// The readings of one machine in the order in which they arrived at it.
///
/// A file is in the order of the recorder; a message that came late to it may belong anywhere before. So all
/// files are read first: some 150 bytes are held for each reading, and nothing else.
#[derive(Debug)]
pub struct Arrivals {
    arrivals: std::vec::IntoIter<Told>,
    lost_bytes: u64,
}

/// A reading, or why it is none, and where it belongs.
#[derive(Debug)]
struct Told {
    rank: Rank,
    reading: Result<Reading, RecordError>,
}

impl Ranked for Told {
    fn rank(&self) -> Rank {
        self.rank
    }
}

/// Reads the readings of `machine` from the files of a session, in the order of [`super::read_in_order`]: what is
/// there twice comes once. A reading that cannot be decoded is an error in its place. `tell` hears, some times a
/// chunk, how many bytes are behind.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_arrivals<'a>(
    paths: impl IntoIterator<Item = &'a Path>,
    machine: &str,
    mut tell: impl FnMut(u64),
) -> Result<Arrivals, RecordError> {
    let mut found = Vec::new();
    let (mut bytes_before, mut lost_bytes, mut read) = (0, 0, 0_u64);
    for path in paths {
        let mut messages = read_messages(path)?;
        while let Some(message) = messages.next() {
            let message = message?;
            read += 1;
            if read.is_multiple_of(PROGRESS_EVERY) {
                tell(bytes_before + messages.read_bytes());
            }
            let rank = message.rank();
            let Topic::Sensor(sensor) = rank.topic else { continue };
            if message.machine != machine {
                continue;
            }
            let reading = decode_reading(sensor, &message.payload)
                .map_err(|source| unreadable(path.to_owned(), message, source));
            found.push(Told { rank, reading });
        }
        bytes_before += messages.read_bytes();
        lost_bytes += messages.lost_bytes();
    }
    Ok(Arrivals { arrivals: sorted(found).into_iter(), lost_bytes })
}

impl Arrivals {
    /// Bytes of the files that could not be read: damaged chunks and torn ends.
    pub fn lost_bytes(&self) -> u64 {
        self.lost_bytes
    }
}

impl Iterator for Arrivals {
    type Item = Result<Arrival, RecordError>;

    fn next(&mut self) -> Option<Self::Item> {
        let Told { rank, reading } = self.arrivals.next()?;
        Some(reading.map(|reading| Arrival { arrival: rank.sent, reading }))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.arrivals.size_hint()
    }
}

fn unreadable(path: PathBuf, message: Recorded<Vec<u8>>, source: crate::wire::WireError) -> RecordError {
    let Recorded { machine, topic, sequence, .. } = message;
    RecordError::Message { path, machine, topic, sequence, source }
}
