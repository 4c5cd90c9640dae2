//! Reads messages out of a ring, by their numbers.

use std::collections::{BTreeMap, VecDeque};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use mcap::records::{Metadata, Record};

use super::{COUNTED_FROM, HeldFile, Numbers, Runs, Shelf};
use crate::record::ranges::widen_from;
use crate::record::scan::{Raw, Scanner, unpack};
use crate::record::{RecordError, file_error, parse_channel_name, stamp_of};
use crate::wire::{Attachment, Batch, BootId, Topic, Wanted, payload_stamp};

/// What is in so many files is remembered; some 300 bytes for each second.
const CONTENTS_KEPT: usize = 3;

/// Reads what a shelf holds. Remembers where it found what, so that one who asks for one piece after the other is
/// answered quickly.
pub struct RingReader {
    shelf: Shelf,
    contents: VecDeque<Contents>,
}

/// Where in a file the messages of each topic are.
pub(super) struct Contents {
    path: PathBuf,
    machine: Option<String>,
    topics: BTreeMap<u16, Topic>,
    /// The number before the next message of a topic, of which the file has the lower half.
    counted: Numbers,
    /// What was counted before the file.
    pub(super) counted_from: Numbers,
    chunks: Vec<ChunkAt>,
    /// So many bytes were looked at, and are whole.
    pub(super) read_to: u64,
}

#[derive(Clone)]
struct ChunkAt {
    at: u64,
    runs: Runs,
}

impl RingReader {
    pub(super) fn new(shelf: Shelf) -> Self {
        Self { shelf, contents: VecDeque::new() }
    }

    /// Messages of a boot, in the order in which they were written; `bytes_max` at most, but one if there is any.
    pub fn batch(&mut self, boot: BootId, wanted: &Wanted, bytes_max: u64) -> Batch {
        let (files, ends) = {
            let shelved = self.shelf.lock();
            let files: Vec<HeldFile> =
                shelved.files.iter().filter(|file| file.boot == boot).cloned().collect();
            // What is not on the disk yet is not missing.
            let is_current = shelved.current == Some(boot);
            let end = |topic: &Topic| match is_current {
                true => shelved.ends.get(topic).copied().unwrap_or(0),
                false => u64::MAX,
            };
            (files, wanted.keys().map(|topic| (*topic, end(topic))).collect::<BTreeMap<_, _>>())
        };
        let mut answer = Answer::new(wanted, bytes_max);
        for file in files {
            if file.is_read && !intersects(wanted, &file.runs) {
                answer.pass(&file.runs);
                continue;
            }
            match self.read_file(&file, boot, &mut answer) {
                Ok(true) => return answer.finish(|passed, topic| passed.get(&topic).copied().unwrap_or(0)),
                Ok(false) => answer.pass(&file.runs),
                Err(error) => {
                    self.contents.retain(|contents| contents.path != file.path);
                    if self.shelf.cannot_be_read(&file, &error) {
                        answer.pass(&file.runs);
                    } else {
                        answer.miss(&file);
                    }
                }
            }
        }
        answer.finish(|_, topic| ends.get(&topic).copied().unwrap_or(0))
    }

    /// Tries again to read what could not be read.
    pub fn look_again(&mut self) {
        let unread = |file: &&HeldFile| !file.is_read;
        let files: Vec<HeldFile> = self.shelf.lock().files.iter().filter(unread).cloned().collect();
        for file in files {
            let mut contents = Contents::new(&file.path, "");
            match contents.read_on(u64::MAX) {
                Ok(()) => self.shelf.was_read(&file, &contents),
                Err(error) => _ = self.shelf.cannot_be_read(&file, &error),
            }
        }
    }

    /// True if no more is to be had.
    fn read_file(
        &mut self,
        file: &HeldFile,
        boot: BootId,
        answer: &mut Answer<'_>,
    ) -> Result<bool, RecordError> {
        let place = match self.contents.iter().position(|contents| contents.path == file.path) {
            Some(place) => place,
            None => {
                if self.contents.len() == CONTENTS_KEPT {
                    self.contents.pop_front();
                }
                self.contents.push_back(Contents::new(&file.path, ""));
                self.contents.len() - 1
            }
        };
        let contents = &mut self.contents[place];
        // How long one is that was never read nobody knows.
        contents.read_on(if file.runs.is_empty() { u64::MAX } else { file.bytes })?;
        if !file.is_read {
            self.shelf.was_read(file, contents);
        }
        let mut scanner = Scanner::open(&file.path)?;
        for chunk in &contents.chunks {
            if intersects(answer.wanted, &chunk.runs) {
                scanner.seek(chunk.at)?;
                let cut = || file_error(&file.path, "has become shorter")(ErrorKind::UnexpectedEof.into());
                let raw = scanner.next_raw()?.ok_or_else(cut)?;
                if answer.take(&raw, chunk, &contents.topics, boot) {
                    return Ok(true);
                }
            }
            answer.pass(&chunk.runs);
        }
        Ok(false)
    }
}

impl Shelf {
    /// What an unread file holds is known now.
    fn was_read(&self, file: &HeldFile, contents: &Contents) {
        let mut shelved = self.lock();
        let Some(held) = shelved.files.iter_mut().find(|held| held.number == file.number) else { return };
        held.is_read = true;
        // Of the file that is being written the writer knows more.
        if held.runs.is_empty() {
            held.runs = contents.runs();
            held.counted_from = contents.counted_from.clone();
            held.bytes = contents.read_to;
        }
    }

    /// True if the file is gone, so that it holds nothing; else it may be read another time.
    fn cannot_be_read(&self, file: &HeldFile, error: &RecordError) -> bool {
        let mut shelved = self.lock();
        let is_gone = error.system().is_some_and(|error| error.kind() == ErrorKind::NotFound);
        match shelved.files.iter().position(|held| held.number == file.number) {
            Some(place) if is_gone => _ = shelved.files.remove(place),
            Some(place) => shelved.files[place].is_read = false,
            None => {}
        }
        is_gone
    }
}

fn intersects(wanted: &Wanted, runs: &Runs) -> bool {
    wanted.iter().any(|(topic, ranges)| {
        runs.get(topic)
            .is_some_and(|(first, last)| ranges.iter().any(|[from, to]| from <= last && to >= first))
    })
}

/// An answer in the making.
struct Answer<'a> {
    wanted: &'a Wanted,
    bytes_max: u64,
    bytes: u64,
    /// Everything below was looked at.
    passed: Numbers,
    /// From here on something could not be looked at.
    missed: Numbers,
    batch: Batch,
}

impl<'a> Answer<'a> {
    fn new(wanted: &'a Wanted, bytes_max: u64) -> Self {
        let (passed, missed) = (Numbers::new(), Numbers::new());
        Self { wanted, bytes_max, bytes: 0, passed, missed, batch: Batch::default() }
    }

    /// Says how far all is in it: up to `end`, but for what was missed.
    fn finish(mut self, end: impl Fn(&Numbers, Topic) -> u64) -> Batch {
        let done = |topic: &Topic| {
            let missed = self.missed.get(topic).copied().unwrap_or(u64::MAX);
            (*topic, end(&self.passed, *topic).min(missed))
        };
        self.batch.done = self.wanted.keys().map(done).collect();
        self.batch
    }

    /// A file cannot be read. Which topics it has is known if it could be read before.
    fn miss(&mut self, file: &HeldFile) {
        for topic in self.wanted.keys().filter(|topic| file.runs.is_empty() || file.runs.contains_key(topic))
        {
            let passed = self.passed.get(topic).copied().unwrap_or(0);
            self.missed.entry(*topic).or_insert(passed);
        }
    }

    fn pass(&mut self, runs: &Runs) {
        self.passed.extend(runs.iter().map(|(topic, (_, last))| (*topic, last + 1)));
    }

    /// Takes what is wanted out of a chunk; true if no more fits.
    fn take(&mut self, raw: &Raw, chunk: &ChunkAt, topics: &BTreeMap<u16, Topic>, boot: BootId) -> bool {
        for (_, record) in unpack(raw).unwrap_or_default() {
            let Record::Message { header, data } = record else { continue };
            let Some(topic) = topics.get(&header.channel_id).copied() else { continue };
            let Some((first, _)) = chunk.runs.get(&topic) else { continue };
            let sequence = widen_from(header.sequence, *first);
            let ranges = self.wanted.get(&topic);
            if ranges.is_some_and(|ranges| ranges.iter().any(|[from, to]| (*from..=*to).contains(&sequence)))
            {
                let bytes = Batch::bytes_of(&data);
                if self.bytes > 0 && self.bytes + bytes > self.bytes_max {
                    // All the others of its topic are after it.
                    self.passed.insert(topic, sequence);
                    return true;
                }
                self.bytes += bytes;
                let sent = stamp_of(header.publish_time);
                let stamp = payload_stamp(topic, &data).unwrap_or(sent);
                let attachment = Attachment { sequence, boot, stamp, sent };
                self.batch.messages.push((topic, attachment, data.into_owned()));
            }
            self.passed.insert(topic, sequence + 1);
        }
        false
    }
}

impl Contents {
    /// Of a machine; of whomever there is, if that is empty.
    pub(super) fn new(path: &Path, machine: &str) -> Self {
        Self {
            path: path.to_owned(),
            machine: (!machine.is_empty()).then(|| machine.to_owned()),
            topics: BTreeMap::new(),
            counted: Numbers::new(),
            counted_from: Numbers::new(),
            chunks: Vec::new(),
            read_to: 0,
        }
    }

    pub(super) fn runs(&self) -> Runs {
        let mut runs = Runs::new();
        for (topic, (first, last)) in self.chunks.iter().flat_map(|chunk| &chunk.runs) {
            runs.entry(*topic).and_modify(|run| run.1 = *last).or_insert((*first, *last));
        }
        runs
    }

    /// Looks at what the file has up to `end` and was not looked at yet.
    pub(super) fn read_on(&mut self, end: u64) -> Result<(), RecordError> {
        if self.read_to >= end {
            return Ok(());
        }
        let mut scanner = Scanner::open(&self.path)?;
        if self.read_to > 0 {
            scanner.seek(self.read_to)?;
        }
        while let Some(raw) = scanner.next_raw()? {
            if raw.end() > end || scanner.damage.data_ended {
                break;
            }
            if raw.opcode == mcap::records::op::CHUNK {
                self.take_chunk(&raw);
            } else if raw.opcode == mcap::records::op::METADATA {
                self.take_metadata(&raw);
            } else if raw.opcode == mcap::records::op::DATA_END {
                break;
            }
            self.read_to = raw.end();
        }
        Ok(())
    }

    fn take_metadata(&mut self, raw: &Raw) {
        let record = mcap::read::parse_record(raw.opcode, &raw.body);
        if let Ok(Record::Metadata(Metadata { name, metadata })) = record
            && name == COUNTED_FROM
        {
            let numbers = metadata.iter();
            self.counted = numbers
                .filter_map(|(topic, number)| Some((Topic::from_name(topic)?, number.parse().ok()?)))
                .collect();
            self.counted_from = self.counted.clone();
        }
    }

    fn take_chunk(&mut self, raw: &Raw) {
        let mut runs = Runs::new();
        for (_, record) in unpack(raw).unwrap_or_default() {
            match record {
                Record::Channel(channel) => {
                    if let Some((machine, topic)) = parse_channel_name(&channel.topic)
                        && self.machine.as_ref().is_none_or(|wanted| wanted == machine)
                    {
                        self.topics.insert(channel.id, topic);
                    }
                }
                Record::Message { header, .. } => {
                    let Some(topic) = self.topics.get(&header.channel_id) else { continue };
                    let next = self.counted.entry(*topic).or_insert(0);
                    let sequence = widen_from(header.sequence, *next);
                    *next = sequence + 1;
                    runs.entry(*topic).and_modify(|run| run.1 = sequence).or_insert((sequence, sequence));
                }
                _ => {}
            }
        }
        self.chunks.push(ChunkAt { at: raw.at, runs });
    }
}
