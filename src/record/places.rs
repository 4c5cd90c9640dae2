//! Where the messages of a session are, so that they can be had in their order without holding them all.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use mcap::records::Record;

use super::scan::Scanner;
use super::{RecordError, read_messages, stamp_of};
use crate::time::Stamp;
use crate::wire::{BootId, JournalHead, Topic};

/// Chunks of which one reader holds messages at most. Topics are read side by side, so the same few are asked for
/// again; after a lost link, those of different topics lie further apart.
const CHUNKS_HELD: usize = 8;

/// Of every message of a session, in which chunk it is: some 100 bytes for each topic and chunk.
#[derive(Default)]
pub struct Places {
    files: Vec<File>,
    chunks: Vec<Chunk>,
    machines: BTreeMap<String, BTreeMap<Option<BootId>, BootPlaces>>,
    lost_bytes: u64,
}

/// Whose messages a channel has.
type Whose = (String, Topic, Option<BootId>);

struct File {
    path: PathBuf,
    channels: BTreeMap<u16, Whose>,
}

/// Records that are read together, one after the other or out of a chunk.
struct Chunk {
    file: usize,
    at: u64,
}

/// Where the messages of a boot are.
#[derive(Default)]
pub(super) struct BootPlaces {
    /// When the first of them was sent.
    pub(super) begin: Option<Stamp>,
    /// What on-board records say of it.
    pub(super) head: Option<JournalHead>,
    topics: BTreeMap<Topic, Vec<Stretch>>,
}

/// Messages of one topic in one chunk whose numbers rise.
#[derive(Clone, Debug)]
struct Stretch {
    chunk: usize,
    numbers: RangeInclusive<u32>,
    count: u64,
}

impl BootPlaces {
    pub(super) fn has(&self, topic: Topic) -> bool {
        self.topics.contains_key(&topic)
    }

    /// Messages of a topic; those that are there twice count twice.
    pub(super) fn count(&self, topic: Topic) -> u64 {
        self.topics.get(&topic).map_or(0, |stretches| stretches.iter().map(|stretch| stretch.count).sum())
    }

    fn note(&mut self, topic: Topic, chunk: usize, sequence: u32, sent: Stamp) {
        self.begin = Some(self.begin.map_or(sent, |begin| begin.min(sent)));
        let stretches = self.topics.entry(topic).or_default();
        match stretches.last_mut() {
            Some(last) if last.chunk == chunk && *last.numbers.end() < sequence => {
                last.numbers = *last.numbers.start()..=sequence;
                last.count += 1;
            }
            _ => stretches.push(Stretch { chunk, numbers: sequence..=sequence, count: 1 }),
        }
    }
}

impl Places {
    /// Reads the files of one or more sessions; `tell` hears how many bytes were read.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read or is no MCAP file.
    pub fn of<'a>(
        paths: impl IntoIterator<Item = &'a Path>,
        mut tell: impl FnMut(u64),
    ) -> Result<Self, RecordError> {
        let mut places = Self::default();
        let mut bytes_before = 0;
        for (file, path) in paths.into_iter().enumerate() {
            let mut messages = read_messages(path)?;
            loop {
                let at = messages.read_bytes();
                let Some(found) = messages.next_block()? else { break };
                if !found.is_empty() {
                    let chunk = places.chunks.len();
                    places.chunks.push(Chunk { file, at });
                    for message in found {
                        let boots = places.machines.entry(message.machine).or_default();
                        let boot = boots.entry(message.boot).or_default();
                        boot.note(message.topic, chunk, message.sequence as u32, message.sent);
                    }
                }
                tell(bytes_before + at);
            }
            bytes_before += messages.read_bytes();
            places.lost_bytes += messages.lost_bytes();
            for ((machine, boot), head) in messages.about() {
                let boots = places.machines.entry(machine.clone()).or_default();
                boots.entry(Some(*boot)).or_default().head.get_or_insert_with(|| head.clone());
            }
            let channels = messages.into_channels();
            for (machine, ..) in channels.values() {
                places.machines.entry(machine.clone()).or_default();
            }
            places.files.push(File { path: path.to_owned(), channels });
        }
        Ok(places)
    }

    /// The machines that have any topic in the files, sorted.
    pub fn machines(&self) -> impl Iterator<Item = &str> {
        self.machines.keys().map(String::as_str)
    }

    /// Bytes of the files that could not be read: damaged chunks and torn ends.
    pub fn lost_bytes(&self) -> u64 {
        self.lost_bytes
    }

    /// The boots of a machine, oldest first.
    pub(super) fn boots_of(&self, machine: &str) -> Vec<(Option<BootId>, &BootPlaces)> {
        let boots = self.machines.get(machine).into_iter().flatten();
        let mut boots: Vec<_> = boots.map(|(boot, places)| (*boot, places)).collect();
        boots.sort_by_key(|(_, places)| places.begin);
        boots
    }
}

/// A message out of a session.
pub(super) struct Found {
    pub(super) sequence: u32,
    pub(super) sent: Stamp,
    pub(super) payload: Vec<u8>,
}

/// Gives the messages of one boot, each topic in the order of its numbers; what is there twice comes once.
pub(super) struct InOrder<'a> {
    places: &'a Places,
    machine: String,
    boot: Option<BootId>,
    topics: BTreeMap<Topic, Queue>,
    scanners: BTreeMap<usize, Scanner>,
    /// Of some chunks, the messages of the boot that were not taken yet; the chunk read last is at the end.
    held: VecDeque<(usize, BTreeMap<Topic, Vec<Found>>)>,
}

/// What is to come of one topic.
struct Queue {
    /// By the first number.
    stretches: VecDeque<Stretch>,
    /// Read, and next in turn or after that.
    ready: BTreeMap<u32, Found>,
    last: Option<u32>,
}

impl<'a> InOrder<'a> {
    pub(super) fn new(places: &'a Places, machine: &str, boot: Option<BootId>, of: &BootPlaces) -> Self {
        let queue = |(topic, stretches): (&Topic, &Vec<Stretch>)| {
            let mut stretches = stretches.clone();
            stretches.sort_by_key(|stretch| *stretch.numbers.start());
            (*topic, Queue { stretches: stretches.into(), ready: BTreeMap::new(), last: None })
        };
        Self {
            places,
            machine: machine.to_owned(),
            boot,
            topics: of.topics.iter().map(queue).collect(),
            scanners: BTreeMap::new(),
            held: VecDeque::new(),
        }
    }

    /// The next message of a topic.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read any more.
    pub(super) fn next(&mut self, topic: Topic) -> Result<Option<Found>, RecordError> {
        let Some(mut queue) = self.topics.remove(&topic) else { return Ok(None) };
        // What may come before all that is ready is read first.
        while let Some(stretch) = queue.stretches.pop_front_if(|next| {
            queue.ready.first_key_value().is_none_or(|(sequence, _)| next.numbers.start() <= sequence)
        }) {
            for found in self.take(topic, &stretch)? {
                if queue.last.is_none_or(|last| found.sequence > last) {
                    queue.ready.entry(found.sequence).or_insert(found);
                }
            }
        }
        let found = queue.ready.pop_first().map(|(_, found)| found);
        queue.last = found.as_ref().map(|found| found.sequence).or(queue.last);
        self.topics.insert(topic, queue);
        Ok(found)
    }

    /// The messages of a stretch.
    fn take(&mut self, topic: Topic, stretch: &Stretch) -> Result<Vec<Found>, RecordError> {
        if !self.held.iter().any(|(chunk, _)| *chunk == stretch.chunk) {
            let read = self.read(stretch.chunk)?;
            if self.held.len() >= CHUNKS_HELD {
                self.held.pop_front();
            }
            self.held.push_back((stretch.chunk, read));
        }
        let held = self.held.iter_mut().find(|(chunk, _)| *chunk == stretch.chunk);
        let Some(left) = held.and_then(|(_, topics)| topics.get_mut(&topic)) else { return Ok(Vec::new()) };
        Ok(left.extract_if(.., |found| stretch.numbers.contains(&found.sequence)).collect())
    }

    fn read(&mut self, chunk: usize) -> Result<BTreeMap<Topic, Vec<Found>>, RecordError> {
        let Chunk { file, at } = self.places.chunks[chunk];
        let File { path, channels } = &self.places.files[file];
        let scanner = match self.scanners.entry(file) {
            std::collections::btree_map::Entry::Occupied(open) => open.into_mut(),
            std::collections::btree_map::Entry::Vacant(none) => none.insert(Scanner::open(path)?),
        };
        scanner.seek(at)?;
        let mut topics: BTreeMap<Topic, Vec<Found>> = BTreeMap::new();
        // Channels that carry this boot.
        let own: BTreeSet<u16> = channels
            .iter()
            .filter(|(_, (machine, _, boot))| *machine == self.machine && *boot == self.boot)
            .map(|(id, _)| *id)
            .collect();
        for record in scanner.next_block()?.unwrap_or_default() {
            if let Record::Message { header, data } = record
                && own.contains(&header.channel_id)
                && let Some((_, topic, _)) = channels.get(&header.channel_id)
            {
                topics.entry(*topic).or_default().push(Found {
                    sequence: header.sequence,
                    sent: stamp_of(header.publish_time),
                    payload: data.into_owned(),
                });
            }
        }
        Ok(topics)
    }
}
