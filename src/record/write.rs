//! Writes one recording.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Compression, WriteOptions};

use super::{BOOT, FileState, RecordError, Recorded, Summary};
use super::{channel_name, file_error, mcap_error, sync_folder_of};
use crate::time::{Span, Stamp};
use crate::wire::{BootId, Topic, schema_of};

/// What was written is synced after so long, if the caller ticks: with the sync itself, and a tick that comes late,
/// a message is on the disk within a second.
pub const SYNC_EVERY: Span = Span::from_millis(700);
/// Messages are stamped by several threads before they queue up here, so that their stamps may be so much out of order.
/// Only what is further back says that the clock was set back.
const DISORDER_MAX: Span = Span::from_millis(250);
/// A chunk that holds more is finished before its time.
const CHUNK_BYTES: u64 = 4 * 1024 * 1024;

/// The writer of the MCAP library over a file. Chunks are built in memory and written whole: a seek back
/// into a chunk's header would leave it wrong on the disk until then.
pub(super) type FileWriter = mcap::Writer<NoSeek<BufWriter<File>>>;

/// Which id each channel has: the same in all files of a session, so that they can be put one after the other.
#[derive(Clone, Debug, Default)]
pub struct ChannelBook {
    channels: BTreeMap<String, BTreeMap<(Topic, Option<BootId>), u16>>,
    schemas: BTreeMap<&'static str, u16>,
    count: u16,
}

impl ChannelBook {
    /// So many channels at most; the format's own limit is not far.
    const CHANNELS_MAX: u16 = 60_000;

    /// Whether another session is due, with a new book.
    pub fn is_full(&self) -> bool {
        self.count >= Self::CHANNELS_MAX
    }

    fn channel(&mut self, machine: &str, topic: Topic, boot: Option<BootId>) -> u16 {
        let count = &mut self.count;
        let of_machine = self.channels.entry(machine.to_owned()).or_default();
        *of_machine.entry((topic, boot)).or_insert_with(|| {
            *count = count.saturating_add(1);
            *count
        })
    }

    fn schema(&mut self, name: &'static str) -> u16 {
        let next = self.schemas.len() as u16 + 1;
        *self.schemas.entry(name).or_insert(next)
    }
}

/// A recording that is being written. Dropped without [`RecordWriter::finish`] it is closed as well as it
/// goes, without saying so if that fails.
pub struct RecordWriter {
    path: PathBuf,
    writer: FileWriter,
    file: File,
    book: ChannelBook,
    /// Those that are defined in this file.
    channels: BTreeMap<String, BTreeMap<(Topic, Option<BootId>), u16>>,
    unsynced_since: Option<Stamp>,
    /// The newest stamp, unless the clock was set back.
    now: Option<Stamp>,
    span: Option<(Stamp, Stamp)>,
    messages: u64,
}

/// Creates the file and its writer; the header is on the disk when this returns.
pub(super) fn create(path: &Path) -> Result<(FileWriter, File), RecordError> {
    begin(File::create(path), path)
}

fn begin(file: std::io::Result<File>, path: &Path) -> Result<(FileWriter, File), RecordError> {
    let file = file.map_err(file_error(path, "cannot be created"))?;
    let handle = file.try_clone().map_err(file_error(path, "cannot be opened twice"))?;
    let mut writer = WriteOptions::new()
        .profile("ros2")
        .library(concat!("holdfast ", env!("CARGO_PKG_VERSION")))
        .compression(Some(Compression::Lz4))
        .chunk_size(Some(CHUNK_BYTES))
        .disable_seeking(true)
        .create(NoSeek::new(BufWriter::new(file)))
        .map_err(mcap_error(path, "cannot be written"))?;
    writer.flush().map_err(mcap_error(path, "cannot be written"))?;
    handle.sync_all().map_err(file_error(path, "cannot be synced"))?;
    sync_folder_of(path)?;
    Ok((writer, handle))
}

impl RecordWriter {
    /// Creates the file, whose folder must exist; what was at `path` is gone.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be created and synced.
    pub fn create(path: &Path) -> Result<Self, RecordError> {
        create(path).map(|begun| Self::of(begun, path, ChannelBook::default()))
    }

    /// Creates a file that goes on where another one ended, whose book is given. Nothing may be at `path`.
    ///
    /// # Errors
    /// [`RecordError`] if something is there, or the file cannot be created and synced.
    pub fn create_next(path: &Path, book: ChannelBook) -> Result<Self, RecordError> {
        begin(File::create_new(path), path).map(|begun| Self::of(begun, path, book))
    }

    fn of((writer, file): (FileWriter, File), path: &Path, book: ChannelBook) -> Self {
        Self {
            path: path.to_owned(),
            writer,
            file,
            book,
            channels: BTreeMap::new(),
            unsynced_since: None,
            now: None,
            span: None,
            messages: 0,
        }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The ids of the channels so far.
    pub fn book(&self) -> &ChannelBook {
        &self.book
    }

    /// When the first and the last message so far were received.
    pub fn span(&self) -> Option<(Stamp, Stamp)> {
        self.span
    }

    /// Messages written so far.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// When the oldest message was received that may not have reached the disk; `None` if all have.
    pub fn unsynced_since(&self) -> Option<Stamp> {
        self.unsynced_since
    }

    /// Length of the file on the disk, without the chunk in memory.
    ///
    /// # Errors
    /// [`RecordError::File`] if the system does not tell.
    pub fn bytes(&self) -> Result<u64, RecordError> {
        Ok(self.file.metadata().map_err(file_error(&self.path, "has no length"))?.len())
    }

    /// Adds a message, and syncs if it is time; `message.received` is taken for now. Stamps before the epoch
    /// are written as the epoch, for the format knows none.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be written. After that every call fails: start another file.
    pub fn write<P: AsRef<[u8]>>(&mut self, message: &Recorded<P>) -> Result<(), RecordError> {
        let channel_id = self.channel(&message.machine, message.topic, message.boot)?;
        let header = MessageHeader {
            channel_id,
            sequence: message.sequence as u32,
            log_time: nanos(message.received),
            publish_time: nanos(message.sent),
        };
        self.writer
            .write_to_known_channel(&header, message.payload.as_ref())
            .map_err(mcap_error(&self.path, "cannot be written"))?;
        self.messages += 1;
        let received = stamp_after_clamp(message.received);
        self.span = Some(match self.span {
            None => (received, received),
            Some((first, last)) => (first.min(received), last.max(received)),
        });
        self.unsynced_since.get_or_insert(message.received);
        self.tick(message.received)
    }

    /// Adds a metadata record, such as a machine's boot or its configuration.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be written.
    pub fn write_metadata(
        &mut self,
        name: &str,
        entries: BTreeMap<String, String>,
    ) -> Result<(), RecordError> {
        let metadata = Metadata { name: name.to_owned(), metadata: entries };
        self.writer.write_metadata(&metadata).map_err(mcap_error(&self.path, "cannot be written"))
    }

    /// Finishes the chunk and syncs it if the last time was [`SYNC_EVERY`] ago. To be called some times a
    /// second, also while no messages come.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be written or synced.
    pub fn tick(&mut self, now: Stamp) -> Result<(), RecordError> {
        // When the clock is set back nobody knows how old is what waits: it is synced as well.
        let clock_went_back = self.now.is_some_and(|newest| newest - now > DISORDER_MAX);
        let now = self.now.filter(|_| !clock_went_back).map_or(now, |newest| newest.max(now));
        self.now = Some(now);
        match self.unsynced_since {
            Some(since) if clock_went_back || now - since >= SYNC_EVERY => self.sync(),
            _ => Ok(()),
        }
    }

    /// Finishes the chunk and waits until everything is on the disk.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be written or synced.
    pub fn sync(&mut self) -> Result<(), RecordError> {
        self.writer.flush().map_err(mcap_error(&self.path, "cannot be written"))?;
        self.file.sync_data().map_err(file_error(&self.path, "cannot be synced"))?;
        self.unsynced_since = None;
        Ok(())
    }

    /// Writes the index and closes the file.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be written or synced.
    pub fn finish(mut self) -> Result<Summary, RecordError> {
        finish(&mut self.writer, &self.file, &self.path)?;
        let bytes = self.file.metadata().map_err(file_error(&self.path, "has no length"))?.len();
        Ok(Summary {
            state: FileState::Complete,
            messages: self.messages,
            bytes,
            span: self.span,
            machines: self.channels.into_keys().collect(),
            lost_bytes: 0,
        })
    }

    /// Gives the file up after a failure: what was not written is forgotten, and the file is left to recovery.
    pub fn abandon(self) {
        let (_, unwritten) = self.writer.into_inner().into_inner().into_parts();
        drop(unwritten);
    }

    fn channel(&mut self, machine: &str, topic: Topic, boot: Option<BootId>) -> Result<u16, RecordError> {
        if let Some(id) = self.channels.get(machine).and_then(|topics| topics.get(&(topic, boot))) {
            return Ok(*id);
        }
        let failed = mcap_error(&self.path, "cannot be written");
        let (schema, encoding) = match schema_of(topic) {
            Some(schema) => {
                let (name, definition) = (schema.name, schema.definition.as_bytes());
                let id = self.book.schema(name);
                (self.writer.add_schema_with_id(id, name, "ros2msg", definition).map_err(&failed)?, "cdr")
            }
            None => (0, "json"),
        };
        let id = self.book.channel(machine, topic, boot);
        let name = channel_name(machine, topic);
        let about = boot.map(|boot| (BOOT.to_owned(), boot.to_string())).into_iter().collect();
        self.writer.add_channel_with_id(id, schema, &name, encoding, &about).map_err(failed)?;
        self.channels.entry(machine.to_owned()).or_default().insert((topic, boot), id);
        Ok(id)
    }
}

pub(super) fn finish(writer: &mut FileWriter, file: &File, path: &Path) -> Result<(), RecordError> {
    writer.finish().map_err(mcap_error(path, "cannot be closed"))?;
    file.sync_all().map_err(file_error(path, "cannot be synced"))
}

fn nanos(stamp: Stamp) -> u64 {
    u64::try_from(stamp.as_nanos()).unwrap_or(0)
}

fn stamp_after_clamp(stamp: Stamp) -> Stamp {
    stamp.max(Stamp::from_nanos(0))
}
