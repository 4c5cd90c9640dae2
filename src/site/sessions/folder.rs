//! The folder of all sessions: names, files, and what people wrote to them.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};

use super::schedule::timestamp;
use crate::record::sync_folder;
use crate::time::Stamp;

/// Format of a session's id: when it was started, UTC.
const ID_FORMAT: &str = "%Y%m%dT%H%M%SZ";
/// What people wrote.
const NOTES_FILE: &str = "session.json";
/// Before the name of a session that is being deleted: no id begins so.
const DELETING: &str = ".deleting-";

/// What people write to a session.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(in crate::site) struct Notes {
    /// What it is called.
    pub name: String,
    /// Anything.
    pub notes: String,
    /// To find it by.
    pub tags: Vec<String>,
}

/// What is to be written to a session; what is left out stays as it is.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub(in crate::site) struct NotesChange {
    /// What it is called: 200 characters at most.
    name: Option<String>,
    /// Anything: 20 000 characters at most.
    notes: Option<String>,
    /// To find it by: 50 at most, of 1 to 100 characters.
    tags: Option<Vec<String>>,
}

impl NotesChange {
    /// Changes `notes`.
    ///
    /// # Errors
    /// Says what is too long, and how long it may be.
    pub fn apply(self, notes: &mut Notes) -> Result<(), String> {
        let fits = |what: &str, text: &str, most: usize| {
            let length = text.chars().count();
            let message = || format!("{what} has {length} characters, may have {most}");
            (length <= most).then_some(()).ok_or_else(message)
        };
        if let Some(name) = &self.name {
            fits("name", name, 200)?;
        }
        if let Some(notes) = &self.notes {
            fits("notes", notes, 20_000)?;
        }
        for tag in self.tags.iter().flatten() {
            fits("a tag", tag, 100)?;
            if tag.trim().is_empty() {
                return Err("a tag is empty".to_owned());
            }
        }
        if self.tags.as_ref().is_some_and(|tags| tags.len() > 50) {
            return Err("there are more than 50 tags".to_owned());
        }
        notes.name = self.name.unwrap_or_else(|| std::mem::take(&mut notes.name));
        notes.notes = self.notes.unwrap_or_else(|| std::mem::take(&mut notes.notes));
        notes.tags = self.tags.unwrap_or_else(|| std::mem::take(&mut notes.tags));
        Ok(())
    }
}

/// Tells whether a file was changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Look {
    pub bytes: u64,
    pub modified_ns: i64,
}

/// The folder.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
}

impl Folder {
    pub fn new(path: PathBuf) -> Self {
        Self { path }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The lock that one writer holds, so that nobody recovers what another one is writing.
    pub fn lock(&self) -> std::io::Result<File> {
        std::fs::create_dir_all(&self.path)?;
        let lock = File::options().create(true).append(true).open(self.path.join("lock"))?;
        lock.try_lock().map_err(|error| match error {
            std::fs::TryLockError::Error(error) => error,
            std::fs::TryLockError::WouldBlock => {
                std::io::Error::new(ErrorKind::WouldBlock, "another site server records there")
            }
        })?;
        Ok(lock)
    }

    /// Makes the folder of a new session that starts at `now`; returns its id.
    pub fn create(&self, now: Stamp, notes: &Notes) -> std::io::Result<String> {
        let name = timestamp(now).strftime(ID_FORMAT).to_string();
        let mut attempt = 1;
        let id = loop {
            let id = if attempt == 1 { name.clone() } else { format!("{name}-{attempt}") };
            match std::fs::create_dir(self.path.join(&id)) {
                Ok(()) => break id,
                Err(error) if error.kind() == ErrorKind::AlreadyExists => attempt += 1,
                Err(error) => return Err(error),
            }
        };
        let made = self.write_notes(&id, notes).and_then(|()| sync_folder(&self.path));
        if made.is_err() {
            self.discard(&id);
        }
        made.map(|()| id)
    }

    /// Takes a session back that has no messages: else each try on a full disk leaves one behind.
    pub fn discard(&self, id: &str) {
        let folder = self.path.join(id);
        let _ = std::fs::remove_file(folder.join(NOTES_FILE));
        // What is not empty stays.
        let _ = std::fs::remove_dir(folder);
    }

    pub fn exists(&self, id: &str) -> bool {
        self.path.join(id).is_dir()
    }

    /// The ids of all sessions, oldest first.
    pub fn ids(&self) -> Vec<String> {
        let Ok(entries) = std::fs::read_dir(&self.path) else { return Vec::new() };
        let folders = entries.flatten().filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
        let names = folders.filter_map(|entry| entry.file_name().into_string().ok());
        let mut ids: Vec<String> = names.filter(|name| is_id(name)).collect();
        ids.sort();
        ids
    }

    /// The files of a session by their numbers.
    pub fn parts(&self, id: &str) -> BTreeMap<u32, Look> {
        let Ok(entries) = std::fs::read_dir(self.path.join(id)) else { return BTreeMap::new() };
        let parts = entries.flatten().filter_map(|entry| {
            let name = entry.file_name().into_string().ok()?;
            let number = name.strip_prefix(id)?.strip_prefix('-')?.strip_suffix(".mcap")?.parse().ok()?;
            // Only what we would name so ourselves.
            (self.part(id, number).file_name()?.to_str()? == name).then_some(())?;
            Some((number, look(&entry.path())?))
        });
        parts.collect()
    }

    /// Where a file of a session is.
    pub fn part(&self, id: &str, number: u32) -> PathBuf {
        self.path.join(id).join(format!("{id}-{number:04}.mcap"))
    }

    /// What people wrote; `None` if it is lost.
    pub fn read_notes(&self, id: &str) -> Option<Notes> {
        let text = std::fs::read(self.path.join(id).join(NOTES_FILE)).ok()?;
        serde_json::from_slice(&text).ok()
    }

    /// Writes it in one step: whatever happens, the old or the new is there.
    pub fn write_notes(&self, id: &str, notes: &Notes) -> std::io::Result<()> {
        let folder = self.path.join(id);
        let beside = folder.join(".session.json.new");
        let written = || {
            let mut file = File::create(&beside)?;
            file.write_all(&serde_json::to_vec_pretty(notes)?)?;
            file.sync_all()?;
            std::fs::rename(&beside, folder.join(NOTES_FILE))?;
            sync_folder(&folder)
        };
        let result = written();
        if result.is_err() {
            let _ = std::fs::remove_file(&beside);
        }
        result
    }

    /// Deletes a session: out of sight in one step, then file by file.
    pub fn delete(&self, id: &str) -> std::io::Result<()> {
        let away = self.path.join(format!("{DELETING}{id}"));
        std::fs::rename(self.path.join(id), &away)?;
        std::fs::remove_dir_all(away)
    }

    /// Deletes what was left when a deletion was cut short.
    pub fn sweep(&self) {
        let Ok(entries) = std::fs::read_dir(&self.path) else { return };
        for entry in entries.flatten() {
            if entry.file_name().to_str().is_some_and(|name| name.starts_with(DELETING))
                && let Err(error) = std::fs::remove_dir_all(entry.path())
            {
                tracing::warn!("{}: cannot be deleted: {error}", entry.path().display());
            }
        }
    }
}

fn look(path: &Path) -> Option<Look> {
    let about = std::fs::metadata(path).ok().filter(std::fs::Metadata::is_file)?;
    let modified = about.modified().ok()?.duration_since(UNIX_EPOCH).unwrap_or_default();
    let modified_ns = i64::try_from(modified.as_nanos()).unwrap_or(i64::MAX);
    Some(Look { bytes: about.len(), modified_ns })
}

/// Ids come from URLs and become paths: letters, digits and '-' only.
pub(super) fn is_id(id: &str) -> bool {
    (1..=64).contains(&id.len()) && id.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
}

/// When a session was started, as its id says.
pub(super) fn started(id: &str) -> Option<Stamp> {
    let name = id.split('-').next()?;
    let civil = jiff::civil::DateTime::strptime(ID_FORMAT, name).ok()?;
    let timestamp = jiff::tz::Offset::UTC.to_timestamp(civil).ok()?;
    i64::try_from(timestamp.as_nanosecond()).ok().map(Stamp::from_nanos)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_say_when_the_session_was_started() {
        let stamp = Stamp::from_nanos(1_795_410_000_000_000_000);
        assert_eq!(timestamp(stamp).strftime(ID_FORMAT).to_string(), "20261123T050000Z");
        assert_eq!(started("20261123T050000Z"), Some(stamp));
        assert_eq!(started("20261123T050000Z-2"), Some(stamp));
        assert_eq!(started("mine"), None);
    }

    #[test]
    fn ids_cannot_leave_the_folder() {
        for id in ["", "..", ".", "a/b", "../../etc/passwd", "a\\b", "a.b", "%2e"] {
            assert!(!is_id(id), "{id}");
        }
    }

    #[test]
    fn notes_change_only_as_asked_and_not_without_end() {
        let mut notes =
            Notes { name: "old".to_owned(), notes: "text".to_owned(), tags: vec!["a".to_owned()] };
        let change = |text: &str| serde_json::from_str::<NotesChange>(text).expect("a change");
        change("{\"name\":\"new\"}").apply(&mut notes).expect("fits");
        assert_eq!((notes.name.as_str(), notes.notes.as_str(), notes.tags.len()), ("new", "text", 1));
        change("{\"tags\":[]}").apply(&mut notes).expect("fits");
        assert_eq!(notes.tags.len(), 0);
        let long = NotesChange { name: Some("é".repeat(201)), ..NotesChange::default() };
        assert!(long.apply(&mut notes).expect_err("long").contains("201 characters"));
        let empty = NotesChange { tags: Some(vec![" ".to_owned()]), ..NotesChange::default() };
        assert!(empty.apply(&mut notes).is_err());
        assert_eq!(notes.name, "new", "nothing is changed by half");
        assert!(serde_json::from_str::<NotesChange>("{\"nmae\":\"\"}").is_err());
    }
}
