//! The books of what the recordings have, shared, saved, and read again from the recordings.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use crate::record::{Ledger, RecordError, read_messages, sync_folder};

/// Files that are so much older than the saved books are all in them.
const SAVE_MARGIN: Duration = Duration::from_secs(60);
/// Messages of a file that are put into the books at once.
const FOUND_AT_ONCE: usize = 1_000;
/// After so many tries a file that cannot be read is given up: what is in it is fetched once more.
const TRIES_MAX: u32 = 30;

/// The books, shared between the recorder, who fills them, and the fetcher.
#[derive(Clone, Default)]
pub(in crate::site) struct Books {
    ledger: Arc<Mutex<Ledger>>,
    unread: Arc<Mutex<Vec<Unread>>>,
}

/// A file that the books do not know, or a folder of such.
struct Unread {
    path: PathBuf,
    tries: u32,
}

/// Books that were opened, before anybody writes.
pub(in crate::site) struct Opened {
    pub books: Books,
    pub(super) path: PathBuf,
    saved: Option<SystemTime>,
    sessions: PathBuf,
}

/// The last thing to do, once the recorder has ended.
pub(in crate::site) struct Saving {
    pub(super) books: Books,
    pub(super) path: PathBuf,
}

/// Reads the books that are saved in `directory` about the recordings in `sessions`.
pub(in crate::site) fn open(directory: &Path, sessions: &Path) -> Opened {
    let path = directory.join("backfill.json");
    let (books, saved) = Books::load(&path).unzip();
    Opened { books: books.unwrap_or_default(), saved, path, sessions: sessions.to_owned() }
}

impl Opened {
    /// Reads what was recorded since the books were saved; everything, if they were not.
    pub(super) fn read_files(self, stopping: &AtomicBool) {
        let Self { books, saved, sessions, .. } = self;
        let known_before = saved.and_then(|saved| saved.checked_sub(SAVE_MARGIN));
        let mut files = books.list(&sessions, known_before, 0);
        files.sort();
        for (_, path) in files {
            books.read(&path, 0, stopping);
        }
    }
}

impl Saving {
    pub fn save(self) {
        self.books.save(&self.path, &mut Vec::new());
    }
}

impl Books {
    /// For a few steps at a time.
    pub fn lock(&self) -> MutexGuard<'_, Ledger> {
        self.ledger.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn unread(&self) -> MutexGuard<'_, Vec<Unread>> {
        self.unread.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// False while there is a file that they do not know. What they lack may be in it.
    pub(super) fn are_whole(&self) -> bool {
        self.unread().is_empty()
    }

    /// As they were saved; `None` if there are none that can be read.
    fn load(path: &Path) -> Option<(Self, SystemTime)> {
        let saved = std::fs::metadata(path).and_then(|about| about.modified()).ok()?;
        let text = std::fs::read(path).ok()?;
        match serde_json::from_slice(&text) {
            Ok(ledger) => Some((Self { ledger: Arc::new(Mutex::new(ledger)), ..Self::default() }, saved)),
            Err(error) => {
                tracing::warn!("{}: {error}; the recordings are read instead", path.display());
                None
            }
        }
    }

    /// Saves them if they have changed since `last`, which they become; in one step, so that there are always some.
    pub(super) fn save(&self, path: &Path, last: &mut Vec<u8>) {
        // The recorder waits for a copy only.
        let ledger = self.lock().clone();
        let text = serde_json::to_vec(&ledger);
        let Ok(text) = text.inspect_err(|error| tracing::error!("the books have no JSON form: {error}"))
        else {
            return;
        };
        if text == *last {
            return;
        }
        let beside = path.with_extension("json.new");
        let written = std::fs::write(&beside, &text)
            .and_then(|()| std::fs::File::open(&beside)?.sync_all())
            .and_then(|()| std::fs::rename(&beside, path))
            .and_then(|()| path.parent().map_or(Ok(()), sync_folder));
        match written {
            Ok(()) => *last = text,
            // The recordings say the same, only slower.
            Err(error) => tracing::warn!("{}: cannot be saved: {error}", path.display()),
        }
    }

    /// What was written since the last sync is lost, but for what is found in the file.
    pub fn revoke(&self, file: Option<&Path>) {
        self.lock().revoke();
        if let Some(path) = file {
            self.read(path, 0, &AtomicBool::new(false));
        }
    }

    /// Tries what could not be read once more.
    pub(super) fn read_again(&self, stopping: &AtomicBool) {
        // They stay there until they are read: nobody may think that all are.
        let tried: Vec<(PathBuf, u32)> =
            self.unread().iter().map(|unread| (unread.path.clone(), unread.tries)).collect();
        for (path, tries) in &tried {
            if path.is_dir() && path.extension().is_none() {
                let files = self.list(path, None, *tries);
                files.iter().for_each(|(_, file)| self.read(file, *tries, stopping));
            } else {
                self.read(path, *tries, stopping);
            }
        }
        self.unread().drain(..tried.len());
    }

    /// Takes in what a file has; one that cannot be read, or not to its end, is remembered.
    fn read(&self, path: &Path, tries: u32, stopping: &AtomicBool) {
        match self.take_in(path, stopping) {
            Ok(true) => {}
            // Nobody may save books that lack the rest of it: the next run reads it from its beginning.
            Ok(false) => self.unread().push(Unread { path: path.to_owned(), tries }),
            Err(error) => self.cannot_read(path, tries, &error.to_string()),
        }
    }

    fn cannot_read(&self, path: &Path, tries: u32, error: &str) {
        if tries == TRIES_MAX {
            tracing::error!(
                "{error}; given up: what is in it is fetched once more, if machines still have it"
            );
            return;
        }
        if tries == 0 {
            tracing::warn!("{error}; nothing is fetched from machines until it is read");
        }
        self.unread().push(Unread { path: path.to_owned(), tries: tries + 1 });
    }

    /// False if it was interrupted.
    fn take_in(&self, path: &Path, stopping: &AtomicBool) -> Result<bool, RecordError> {
        let is_gone = |error: &std::io::Error| error.kind() == ErrorKind::NotFound;
        let mut messages = match read_messages(path) {
            // There is nothing of ours in it.
            Err(RecordError::NotMcap { .. }) => return Ok(true),
            Err(error) if error.system().is_some_and(is_gone) => return Ok(true),
            opened => opened?,
        };
        loop {
            if stopping.load(Ordering::Relaxed) {
                return Ok(false);
            }
            let some: Vec<_> = messages.by_ref().take(FOUND_AT_ONCE).collect::<Result<_, _>>()?;
            if some.is_empty() {
                return Ok(true);
            }
            let mut ledger = self.lock();
            for message in some {
                if let Some(boot) = message.boot {
                    ledger.found(&message.machine, boot, message.topic, message.sequence as u32);
                }
            }
        }
    }

    /// The recordings below a folder that were changed since then, and when.
    fn list(&self, folder: &Path, since: Option<SystemTime>, tries: u32) -> Vec<(SystemTime, PathBuf)> {
        let mut files = Vec::new();
        let entries = match std::fs::read_dir(folder) {
            Err(error) if error.kind() == ErrorKind::NotFound => return files,
            entries => entries.and_then(Iterator::collect::<std::io::Result<Vec<_>>>),
        };
        let entries = match entries {
            Ok(entries) => entries,
            Err(error) => {
                self.cannot_read(folder, tries, &format!("{}: {error}", folder.display()));
                return files;
            }
        };
        for entry in entries {
            let path = entry.path();
            if path.extension().is_some_and(|name| name == "mcap") {
                // Without a time it is read.
                let modified = entry.metadata().and_then(|about| about.modified()).ok();
                if since.is_none_or(|since| modified.is_none_or(|modified| modified >= since)) {
                    files.push((modified.unwrap_or(SystemTime::UNIX_EPOCH), path));
                }
            } else if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                files.extend(self.list(&path, since, tries));
            }
        }
        files
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::{RecordWriter, Recorded};
    use crate::time::Stamp;
    use crate::wire::{BootId, Topic};

    /// A folder that is gone with the test.
    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("holdfast-books-{}-{name}", std::process::id()));
            std::fs::create_dir_all(&path).expect("folder");
            Self(path)
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn books_are_saved_and_read_and_what_is_none_is_not() {
        let folder = Folder::new("saved");
        let path = folder.0.join("backfill.json");
        let open = || super::open(&folder.0, &folder.0);
        let opened = open();
        assert!(opened.saved.is_none());
        opened.books.lock().admit("a", BootId(1), Topic::Pose, 5);
        opened.books.save(&path, &mut Vec::new());
        assert!(open().books.lock().admit("a", BootId(1), Topic::Pose, 5), "not on the disk");
        opened.books.lock().synced();
        opened.books.save(&path, &mut Vec::new());
        let again = open();
        assert!(again.saved.is_some() && !again.books.lock().admit("a", BootId(1), Topic::Pose, 5));
        std::fs::write(&path, b"{").expect("damage");
        assert!(open().saved.is_none());
    }

    #[test]
    fn recording_that_cannot_be_read_is_not_taken_for_an_empty_one() {
        let folder = Folder::new("unread");
        let session = folder.0.join("20260101T000000Z");
        std::fs::create_dir_all(&session).expect("folder");
        std::fs::write(session.join("stranger.mcap"), b"notes of a stranger").expect("written");
        let (recording, away) = (session.join("20260101T000000Z-0000.mcap"), folder.0.join("away"));
        let mut writer = RecordWriter::create(&away).expect("created");
        for sequence in 0..3_000 {
            let (machine, at) = ("a".to_owned(), Stamp::from_nanos(5));
            let (topic, boot) = (Topic::Event, Some(BootId(1)));
            let message = Recorded { machine, topic, boot, sequence, received: at, sent: at, payload: b"{}" };
            writer.write(&message).expect("written");
        }
        writer.finish().expect("closed");
        // A folder opens, but does not read.
        std::fs::create_dir(&recording).expect("in the way");
        let opened = open(&folder.0, &folder.0);
        let (books, never) = (opened.books.clone(), AtomicBool::new(false));
        opened.read_files(&never);
        let had = |books: &Books| !books.clone().lock().admit("a", BootId(1), Topic::Event, 2_999);
        assert!(!books.are_whole());
        books.lock().revoke();
        std::fs::remove_dir(&recording).expect("removed");
        std::fs::rename(&away, &recording).expect("back");
        books.read_again(&never);
        assert!(books.are_whole() && had(&books));
        // What the recorder has given up is read, too, when it can be.
        std::fs::rename(&recording, &away).expect("away");
        std::fs::create_dir(&recording).expect("in the way");
        let books = Books::default();
        for _ in 0..2 {
            books.revoke(Some(&recording));
            assert!(!books.are_whole());
        }
        std::fs::remove_dir(&recording).expect("removed");
        std::fs::rename(&away, &recording).expect("back");
        books.read_again(&never);
        assert!(books.are_whole() && had(&books));
    }

    #[test]
    fn recording_whose_reading_was_interrupted_is_not_taken_for_a_read_one() {
        let folder = Folder::new("interrupted");
        let path = folder.0.join("20260101T000000Z-0000.mcap");
        let mut writer = RecordWriter::create(&path).expect("created");
        let at = Stamp::from_nanos(5);
        for sequence in 0..3_000 {
            let (machine, topic, boot) = ("a".to_owned(), Topic::Event, Some(BootId(1)));
            let message = Recorded { machine, topic, boot, sequence, received: at, sent: at, payload: b"{}" };
            writer.write(&message).expect("written");
        }
        writer.finish().expect("closed");
        let opened = open(&folder.0, &folder.0);
        let (books, never) = (opened.books.clone(), AtomicBool::new(false));
        let stopping = AtomicBool::new(true);
        opened.read_files(&stopping);
        assert!(!books.are_whole(), "or they would be saved");
        books.read_again(&stopping);
        assert!(!books.are_whole());
        books.read_again(&never);
        assert!(books.are_whole() && !books.lock().admit("a", BootId(1), Topic::Event, 2_999));
    }

    #[test]
    fn recording_that_can_never_be_read_does_not_keep_the_others_from_being_completed() {
        let folder = Folder::new("never");
        let books = Books::default();
        let path = folder.0.join("20260101T000000Z-0000.mcap");
        std::fs::create_dir(&path).expect("in the way");
        books.revoke(Some(&path));
        let mut tries = 0;
        while !books.are_whole() {
            books.read_again(&AtomicBool::new(false));
            tries += 1;
        }
        assert_eq!(tries, TRIES_MAX);
    }
}
