//! The session that is being written: its files, one after the other.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::catalogue::Catalogue;
use super::folder::Notes;
use super::space::Ballast;
use super::view::RecordingState;
use crate::record::{
    BOOT_SEEN, ChannelBook, FileState, Gap, RecordError, RecordWriter, Recorded, SESSION, SITE, Summary,
    recover,
};
use crate::site::backfill::Books;
use crate::site::inlet::Inbound;
use crate::time::{Span, Stamp};

/// A recording that was not synced for so long is stuck, s.
const UNSYNCED_MAX_S: f64 = 5.0;

/// How far the recording is: everybody may watch it.
#[derive(Clone, Debug, Default)]
pub(in crate::site) struct Progress {
    pub state: RecordingState,
    /// Why nothing is recorded, in words.
    pub why: Option<String>,
    /// The session that runs, or `None`.
    pub session: Option<String>,
    /// The file of it that is open.
    pub open_file: Option<u32>,
    /// Messages in that file, and when the first and the last were received.
    pub file_messages: u64,
    pub file_span: Option<(Stamp, Stamp)>,
    /// So many bytes of it are on the disk, in whole chunks.
    pub synced_bytes: u64,
    /// Of all sessions since the start.
    pub total_bytes: u64,
    /// Whose messages are in the session.
    pub machines: Vec<String>,
    /// When the oldest message was received that may not be on the disk.
    pub unsynced_since: Option<Stamp>,
    /// Messages that came while the recording was paused.
    pub missed: u64,
    /// When the next session begins by itself.
    pub next_session: Option<Stamp>,
}

impl Progress {
    /// The id of the session that runs.
    pub fn running(&self) -> Option<&str> {
        self.session.as_deref()
    }

    /// Why what should be recorded is not, in words; empty if it is.
    pub fn troubles(&self, now: Stamp) -> Vec<String> {
        let mut troubles = Vec::new();
        if self.state == RecordingState::Paused {
            troubles.push(format!("nothing is recorded: {}", self.why.as_deref().unwrap_or_default()));
        }
        let unsynced_s = self.unsynced_since.map_or(0.0, |since| now.seconds_since(since));
        if unsynced_s > UNSYNCED_MAX_S {
            troubles.push(format!("the recording was not synced for {unsynced_s:.1} s"));
        }
        troubles
    }
}

/// When a session's next file begins.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rolling {
    pub bytes: u64,
    pub age: Span,
}

/// The session.
pub(super) struct Running {
    catalogue: Arc<Catalogue>,
    about_the_site: Arc<BTreeMap<String, String>>,
    pub id: String,
    /// The number of the next file.
    next: u32,
    /// The ids of the channels in all of its files.
    book: ChannelBook,
    file: Option<OpenFile>,
    machines: BTreeSet<Arc<str>>,
    /// Bytes of each file that is closed.
    closed_bytes: BTreeMap<u32, u64>,
    /// What is in the recordings, and what of it is on the disk.
    books: Books,
}

struct OpenFile {
    writer: RecordWriter,
    number: u32,
    opened: Stamp,
    /// Those that the file names.
    boots: BTreeSet<(Arc<str>, u64)>,
}

impl Running {
    /// Starts a session at `now`, with its first file.
    pub fn begin(
        catalogue: &Arc<Catalogue>,
        about_the_site: &Arc<BTreeMap<String, String>>,
        books: &Books,
        notes: &Notes,
        now: Stamp,
    ) -> Result<Self, RecordError> {
        let folder = catalogue.folder().path().to_owned();
        let id = catalogue.begin(now, notes).map_err(|source| RecordError::File {
            path: folder,
            what: "takes no session",
            source,
        })?;
        let mut session = Self {
            catalogue: Arc::clone(catalogue),
            about_the_site: Arc::clone(about_the_site),
            id,
            next: 0,
            book: ChannelBook::default(),
            file: None,
            machines: BTreeSet::new(),
            closed_bytes: BTreeMap::new(),
            books: books.clone(),
        };
        match session.open(now) {
            Ok(()) => Ok(session),
            Err(error) => {
                catalogue.discard(&session.id);
                Err(error)
            }
        }
    }

    /// Opens the next file.
    pub fn open(&mut self, now: Stamp) -> Result<(), RecordError> {
        // What is in the way stays.
        while self.catalogue.folder().part(&self.id, self.next).exists() {
            self.next += 1;
        }
        let number = self.next;
        let path = self.catalogue.folder().part(&self.id, number);
        let opened = RecordWriter::create_next(&path, self.book.clone()).and_then(|mut writer| {
            writer.write_metadata(SITE, (*self.about_the_site).clone())?;
            let entries = [("id", self.id.clone()), ("file", number.to_string())];
            let entries = entries.map(|(key, value)| (key.to_owned(), value)).into();
            writer.write_metadata(SESSION, entries)?;
            writer.sync()?;
            Ok(writer)
        });
        let writer = opened.inspect_err(|_| {
            // Nothing is in it yet.
            let _ = std::fs::remove_file(&path);
        })?;
        tracing::info!("recording to {}", path.display());
        self.catalogue.put(&self.id, number, None);
        self.file = Some(OpenFile { writer, number, opened: now, boots: BTreeSet::new() });
        self.next = number + 1;
        Ok(())
    }

    /// Whether there is a file to write to.
    pub fn is_open(&self) -> bool {
        self.file.is_some()
    }

    /// Whether its folder is still there.
    pub fn exists(&self) -> bool {
        self.catalogue.folder().exists(&self.id)
    }

    /// Whether no more machines fit in, so that another session is due.
    pub fn is_full(&self) -> bool {
        self.file.as_ref().is_some_and(|file| file.writer.book().is_full())
    }

    pub fn write(&mut self, inbound: &Inbound) -> Result<(), RecordError> {
        let Some(OpenFile { writer, boots, .. }) = &mut self.file else { return Ok(()) };
        let boot = inbound.attachment.boot;
        // It may have come before, by itself or fetched from the machine.
        if !self.books.lock().admit(&inbound.machine, boot, inbound.topic, inbound.attachment.sequence) {
            return Ok(());
        }
        if boots.insert((Arc::clone(&inbound.machine), boot.0)) {
            self.machines.insert(Arc::clone(&inbound.machine));
            let entries = [("machine", inbound.machine.to_string()), ("boot", boot.to_string())];
            let entries = entries.map(|(key, value)| (key.to_owned(), value)).into();
            writer.write_metadata(BOOT_SEEN, entries)?;
        }
        writer.write(&Recorded {
            machine: inbound.machine.to_string(),
            topic: inbound.topic,
            boot: Some(boot),
            sequence: inbound.attachment.sequence,
            received: inbound.received,
            sent: inbound.attachment.sent,
            payload: &inbound.payload,
        })?;
        self.tell_synced();
        Ok(())
    }

    /// Says what is lost for good; without an open file it is said another time.
    pub fn tell_lost(&mut self) -> Result<(), RecordError> {
        let Some(OpenFile { writer, .. }) = &mut self.file else { return Ok(()) };
        let untold = self.books.lock().untold().to_vec();
        if untold.is_empty() {
            return Ok(());
        }
        for gap in &untold {
            writer.write_metadata(Gap::NAME, gap.entries())?;
        }
        writer.sync()?;
        let mut ledger = self.books.lock();
        ledger.synced();
        ledger.were_told(untold.len());
        Ok(())
    }

    /// Says what is lost, and what nobody could fetch so far.
    fn tell_open(&mut self) -> Result<(), RecordError> {
        self.tell_lost()?;
        let Some(OpenFile { writer, .. }) = &mut self.file else { return Ok(()) };
        let open = self.books.lock().open_gaps();
        open.iter().try_for_each(|gap| writer.write_metadata(Gap::NAME, gap.entries()))
    }

    fn tell_synced(&self) {
        if self.file.as_ref().is_some_and(|file| file.writer.unsynced_since().is_none()) {
            self.books.lock().synced();
        }
    }

    /// Syncs if it is time.
    pub fn tick(&mut self, now: Stamp) -> Result<(), RecordError> {
        self.file.as_mut().map_or(Ok(()), |file| file.writer.tick(now))?;
        self.tell_synced();
        Ok(())
    }

    /// Goes on in another file if this one is large or old enough.
    pub fn roll(&mut self, rolling: Rolling, now: Stamp) -> Result<(), RecordError> {
        let Some(file) = &self.file else { return Ok(()) };
        if file.writer.bytes()? < rolling.bytes && now - file.opened < rolling.age {
            return Ok(());
        }
        self.close()?;
        self.open(now)
    }

    /// Closes the open file, if there is one. After a failure it is left to recovery.
    pub fn close(&mut self) -> Result<(), RecordError> {
        let Some(OpenFile { writer, number, .. }) = self.file.take() else { return Ok(()) };
        self.book = writer.book().clone();
        let path = writer.path().to_owned();
        let summary = writer.finish()?;
        self.books.lock().synced();
        tracing::info!("{}: complete, {} messages", path.display(), summary.messages);
        self.closed_bytes.insert(number, summary.bytes);
        self.catalogue.put(&self.id, number, Some(summary));
        Ok(())
    }

    /// Gives up the open file after a failure, and makes a proper one of what reached the disk.
    pub fn give_up(&mut self, error: &RecordError, ballast: &Ballast) {
        if let Some(OpenFile { writer, .. }) = self.file.take() {
            self.book = writer.book().clone();
            writer.abandon();
        }
        if error.is_disk_full() {
            ballast.release();
        }
        let number = match self.next.checked_sub(1) {
            Some(last) if self.catalogue.folder().part(&self.id, last).exists() => last,
            _ => return self.books.revoke(None),
        };
        let path = self.catalogue.folder().part(&self.id, number);
        match recover(&path) {
            Ok(summary) => {
                self.books.revoke(Some(&path));
                if summary.state != FileState::Complete {
                    tell_recovered(&self.id, number, &summary);
                }
                self.closed_bytes.insert(number, summary.bytes);
                self.catalogue.put(&self.id, number, Some(summary));
            }
            Err(error) => {
                // What is in it is there all the same.
                self.books.revoke(Some(&path));
                tracing::error!("cannot be recovered now: {error}");
            }
        }
    }

    /// Nothing is added any more. Returns the bytes of its files.
    pub fn end(mut self, ballast: &Ballast) -> u64 {
        let was_open = self.is_open();
        let closed = self.tell_open().and_then(|()| self.close());
        if let Err(error) = closed {
            tracing::error!("session {} is not closed: {error}", self.id);
            self.give_up(&error, ballast);
        } else if was_open {
            self.books.lock().open_gaps_were_told();
        }
        self.catalogue.end();
        self.closed_bytes.values().sum()
    }

    /// Says how far it is.
    pub fn tell(&self, progress: &mut Progress) {
        progress.total_bytes += self.closed_bytes.values().sum::<u64>();
        progress.session = Some(self.id.clone());
        progress.machines = self.machines.iter().map(|machine| machine.to_string()).collect();
        progress.open_file = self.file.as_ref().map(|file| file.number);
        let Some(OpenFile { writer, .. }) = &self.file else { return };
        progress.file_messages = writer.messages();
        progress.file_span = writer.span();
        progress.unsynced_since = writer.unsynced_since();
        if let Ok(bytes) = writer.bytes() {
            progress.synced_bytes = bytes;
            progress.total_bytes += bytes;
        }
    }
}

fn tell_recovered(id: &str, number: u32, summary: &Summary) {
    tracing::warn!(
        "session {id}, file {number}: {}, {} messages, {} bytes given up",
        summary.state.name(),
        summary.messages,
        summary.lost_bytes
    );
}
