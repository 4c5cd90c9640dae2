//! A machine's own record: small files, of which the oldest go when there are too many, and what they hold.
//!
//! ```text
//!   keeper's thread ──▶ Ring ──files──▶ disk
//!                        │                ▲
//!                        └──▶ Shelf ◀── RingReader ──▶ answers
//! ```
//! Each file is of one boot, `{number}-{boot}.mcap`, and stands for itself: it says what is configured, and from
//! which number on each topic is counted. What the shelf says is held is on the disk.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::{ChannelBook, RecordError, RecordWriter, Recorded, file_error};
use crate::time::{Span, Stamp};
use crate::wire::{BootId, HeldBoot, Holdings, Kept, Topic};

mod files;
mod reader;

pub use reader::RingReader;

/// A file that is longer is followed by another one.
pub const FILE_BYTES: u64 = 32 * 1024 * 1024;
/// And one that is older.
const FILE_AGE: Span = Span::from_millis(60_000);
/// A ring has so many files at least, so that not too much goes at once.
const FILES_MIN: u64 = 8;
/// Holdings tell of so many boots at most, the newest.
const BOOTS_TOLD: usize = 256;
/// Metadata at the start of a file: from which number on each topic is counted.
const COUNTED_FROM: &str = "holdfast.counted_from";
/// Metadata at the end of a file: first and last number of each topic.
const HELD: &str = "holdfast.held";

/// First and last number of each topic in a file.
type Runs = BTreeMap<Topic, (u64, u64)>;
/// A number of each topic.
type Numbers = BTreeMap<Topic, u64>;

/// Where a ring is, whose, and how large.
#[derive(Clone, Debug)]
pub struct RingOptions {
    /// Its files; nothing else is in there.
    pub folder: PathBuf,
    /// Whose messages.
    pub machine: String,
    /// The run that writes.
    pub boot: BootId,
    /// All files together.
    pub bytes_max: u64,
    /// Metadata of every file: name and entries.
    pub about: Vec<(String, BTreeMap<String, String>)>,
}

/// The ring that is being written. Dropped without [`Ring::finish`] its file is recovered at the next start.
pub struct Ring {
    options: RingOptions,
    shelf: Shelf,
    writer: Option<RecordWriter>,
    opened: Stamp,
    /// Written since the last sync, and how many messages that are.
    unsynced: Runs,
    unsynced_messages: u64,
    next: Numbers,
    number: u64,
    trouble: Option<RecordError>,
    /// Held as long as the ring is written.
    _lock: File,
}

/// What a ring holds; shared between who writes and who reads.
#[derive(Clone, Debug, Default)]
pub struct Shelf(Arc<Mutex<Shelved>>);

#[derive(Debug, Default)]
struct Shelved {
    /// Oldest first.
    files: VecDeque<HeldFile>,
    /// Those that are overwritten, but could not be deleted so far: nobody is told of them, but they take room.
    stuck: Vec<HeldFile>,
    /// The boot that is being written.
    current: Option<BootId>,
    /// Of the current boot: the number after the last one on the disk.
    ends: Numbers,
}

#[derive(Clone, Debug)]
struct HeldFile {
    number: u64,
    path: PathBuf,
    boot: BootId,
    runs: Runs,
    /// What was counted before it.
    counted_from: Numbers,
    /// False if it cannot be read now: there may be more in it than is known.
    is_read: bool,
    /// So much of it is on the disk.
    bytes: u64,
}

impl Shelf {
    fn lock(&self) -> MutexGuard<'_, Shelved> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is held of the topics that `told` wants.
    pub fn holdings(&self, told: impl Fn(Topic) -> bool) -> Holdings {
        let shelved = self.lock();
        let mut boots: Vec<HeldBoot> = Vec::new();
        for file in &shelved.files {
            if boots.last().is_none_or(|last| last.boot != file.boot) {
                let current = shelved.current == Some(file.boot);
                let counted = file.counted_from.iter().filter(|(topic, count)| told(**topic) && **count > 0);
                boots.push(HeldBoot {
                    boot: file.boot,
                    current,
                    topics: BTreeMap::new(),
                    overwritten: counted.map(|(topic, count)| (*topic, *count)).collect(),
                    unread: false,
                });
            }
            let Some(held) = boots.last_mut() else { continue };
            held.unread |= !file.is_read;
            for (topic, (first, last)) in file.runs.iter().filter(|(topic, _)| told(**topic)) {
                held.topics.entry(*topic).and_modify(|run| run[1] = *last).or_insert([*first, *last]);
            }
        }
        boots.retain(|held| held.current || held.unread || !held.topics.is_empty());
        if let Some(held) = boots.last_mut().filter(|held| held.current) {
            // All that was of a topic may have been overwritten: nothing is held up to its end.
            for (topic, end) in shelved.ends.iter().filter(|(topic, end)| told(**topic) && **end > 0) {
                held.topics.entry(*topic).or_insert([*end, *end - 1]);
            }
        }
        let spare = boots.len().saturating_sub(BOOTS_TOLD);
        boots.drain(..spare);
        Holdings { kept: Kept::Yes, boots }
    }

    /// Bytes on the disk.
    pub fn bytes(&self) -> u64 {
        self.lock().bytes()
    }

    /// Someone who reads what is held.
    pub fn reader(&self) -> RingReader {
        RingReader::new(self.clone())
    }
}

impl Shelved {
    fn bytes(&self) -> u64 {
        self.files.iter().chain(&self.stuck).map(|file| file.bytes).sum()
    }
}

impl Ring {
    /// Opens the ring, makes its folder, recovers what an earlier run left, and starts a file.
    ///
    /// # Errors
    /// [`RecordError`] if the folder cannot be used, or another process writes there.
    pub fn open(options: RingOptions, shelf: Shelf, now: Stamp) -> Result<Self, RecordError> {
        let folder = &options.folder;
        std::fs::create_dir_all(folder).map_err(file_error(folder, "cannot be created"))?;
        let lock_path = folder.join("lock");
        let in_use = file_error(&lock_path, "cannot be locked");
        let lock = File::options().create(true).append(true).open(&lock_path).map_err(&in_use)?;
        lock.try_lock().map_err(|error| in_use(error.into()))?;
        let (files, number) = files::read(&options)?;
        let next = {
            let mut shelved = shelf.lock();
            if shelved.current != Some(options.boot) {
                shelved.ends.clear();
            }
            // What this run has written itself it knows, whether it can be read now or not.
            for (topic, (_, last)) in
                files.iter().filter(|file| file.boot == options.boot).flat_map(|file| &file.runs)
            {
                let end = shelved.ends.entry(*topic).or_insert(0);
                *end = (*end).max(last + 1);
            }
            shelved.files = files.into();
            shelved.stuck.clear();
            shelved.current = Some(options.boot);
            shelved.ends.clone()
        };
        let mut ring = Self {
            options,
            shelf,
            writer: None,
            opened: now,
            unsynced: Runs::new(),
            unsynced_messages: 0,
            next,
            number,
            trouble: None,
            _lock: lock,
        };
        // Before anything is written: the disk may be full.
        ring.delete_oldest();
        ring.start_file(now)?;
        Ok(ring)
    }

    /// Adds a message of the options' boot; `message.received` is taken for now.
    ///
    /// # Errors
    /// [`RecordError`] if the disk refuses. After that the ring is of no use: abandon it, and open it again.
    pub fn write<P: AsRef<[u8]>>(&mut self, message: &Recorded<P>) -> Result<(), RecordError> {
        let now = message.received;
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let run = self.unsynced.entry(message.topic).or_insert((message.sequence, message.sequence));
        run.1 = message.sequence;
        self.unsynced_messages += 1;
        self.next.insert(message.topic, message.sequence + 1);
        writer.write(message)?;
        self.settle(now)
    }

    /// Syncs if it is time; to be called some times a second.
    ///
    /// # Errors
    /// As [`Ring::write`].
    pub fn tick(&mut self, now: Stamp) -> Result<(), RecordError> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        writer.tick(now)?;
        self.settle(now)
    }

    /// Closes the file; after that nothing is written any more.
    ///
    /// # Errors
    /// [`RecordError`] if it cannot be written; it is recovered at the next start then.
    pub fn finish(&mut self) -> Result<(), RecordError> {
        self.close_file()?;
        self.delete_oldest();
        Ok(())
    }

    /// Gives up after a failure. Says how many messages were written, and may not be on the disk.
    pub fn abandon(self) -> u64 {
        if let Some(writer) = self.writer {
            writer.abandon();
        }
        self.unsynced_messages
    }

    /// Bounds the files to so many bytes from now on.
    pub fn set_bytes_max(&mut self, bytes_max: u64) {
        self.options.bytes_max = bytes_max;
    }

    /// What went wrong beside the writing, if something did since the last time.
    pub fn take_trouble(&mut self) -> Option<RecordError> {
        self.trouble.take()
    }

    /// After each step: tells what has reached the disk, goes on to the next file, and deletes the oldest.
    fn settle(&mut self, now: Stamp) -> Result<(), RecordError> {
        let Some(writer) = &self.writer else { return Ok(()) };
        if self.unsynced.is_empty() || writer.unsynced_since().is_some() {
            return Ok(());
        }
        self.shelve(writer.bytes()?);
        let file_bytes = FILE_BYTES.min(self.options.bytes_max / FILES_MIN);
        let is_long =
            self.writer.as_ref().is_some_and(|writer| writer.bytes().is_ok_and(|b| b >= file_bytes));
        // The clock may be set back, too.
        if is_long || now - self.opened >= FILE_AGE || now < self.opened {
            self.close_file()?;
            self.start_file(now)?;
        }
        self.delete_oldest();
        Ok(())
    }

    /// What was written so far is on the disk.
    fn shelve(&mut self, bytes: u64) {
        let mut shelved = self.shelf.lock();
        let unsynced = std::mem::take(&mut self.unsynced);
        self.unsynced_messages = 0;
        shelved.ends.extend(unsynced.iter().map(|(topic, run)| (*topic, run.1 + 1)));
        if let Some(file) = shelved.files.back_mut() {
            file.bytes = bytes;
            for (topic, (first, last)) in unsynced {
                file.runs.entry(topic).and_modify(|run| run.1 = last).or_insert((first, last));
            }
        }
    }

    fn start_file(&mut self, now: Stamp) -> Result<(), RecordError> {
        let boot = self.options.boot;
        let path = self.options.folder.join(format!("{:08}-{boot}.mcap", self.number));
        let mut writer = RecordWriter::create_next(&path, ChannelBook::default())?;
        for (name, entries) in &self.options.about {
            writer.write_metadata(name, entries.clone())?;
        }
        let numbers = self.next.iter().map(|(topic, next)| (topic.name().to_owned(), next.to_string()));
        writer.write_metadata(COUNTED_FROM, numbers.collect())?;
        let bytes = writer.bytes()?;
        let counted_from = self.next.clone();
        let (number, runs) = (self.number, Runs::new());
        let file = HeldFile { number, path, boot, runs, counted_from, is_read: true, bytes };
        self.shelf.lock().files.push_back(file);
        self.writer = Some(writer);
        self.opened = now;
        self.number += 1;
        Ok(())
    }

    fn close_file(&mut self) -> Result<(), RecordError> {
        let Some(mut writer) = self.writer.take() else { return Ok(()) };
        if let Err(error) = writer.sync() {
            writer.abandon();
            return Err(error);
        }
        self.shelve(writer.bytes()?);
        let runs = self.shelf.lock().files.back().map(|file| file.runs.clone()).unwrap_or_default();
        let told =
            runs.iter().map(|(topic, (first, last))| (topic.name().to_owned(), format!("{first} {last}")));
        writer.write_metadata(HELD, told.collect())?;
        let summary = writer.finish()?;
        if let Some(file) = self.shelf.lock().files.back_mut() {
            file.bytes = summary.bytes;
        }
        Ok(())
    }

    /// Keeps the bound; the file that is written stays. What cannot be deleted is tried again each time.
    fn delete_oldest(&mut self) {
        let mut stuck = std::mem::take(&mut self.shelf.lock().stuck);
        stuck.retain(|file| delete(file).is_err());
        self.shelf.lock().stuck = stuck;
        loop {
            let mut shelved = self.shelf.lock();
            let kept = usize::from(self.writer.is_some());
            if shelved.bytes() <= self.options.bytes_max || shelved.files.len() <= kept {
                return;
            }
            let Some(oldest) = shelved.files.pop_front() else { return };
            drop(shelved);
            if let Err(error) = delete(&oldest) {
                self.trouble = Some(error);
                self.shelf.lock().stuck.push(oldest);
            }
        }
    }
}

fn delete(file: &HeldFile) -> Result<(), RecordError> {
    match std::fs::remove_file(&file.path) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(file_error(&file.path, "cannot be deleted")(error))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
