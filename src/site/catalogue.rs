//! The sessions on the disk. The files say themselves what they are; nothing is kept beside them.

use std::fs::File;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::recorder::Progress;
use crate::fleet::UtcTime;
use crate::record::{self, FileState, RecordError};
use crate::time::Stamp;

/// Format of a session's id: when it was started, UTC.
const ID_FORMAT: &str = "%Y%m%dT%H%M%SZ";

/// How whole a session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum SessionState {
    /// Being written.
    Recording,
    /// Closed by its writer.
    Complete,
    /// Its writer died; everything that had reached the disk is there.
    Recovered,
    /// Its writer died within a chunk: those messages are lost; or it still waits for recovery.
    Truncated,
}

/// A time span of the whole site, recorded.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub(super) struct SessionView {
    /// Also the name of its folder.
    pub id: String,
    /// How whole it is.
    pub state: SessionState,
    /// When it was started.
    #[schema(value_type = String, format = DateTime)]
    pub started: UtcTime,
    /// When its last message was received; `null` while it is recorded, or not known.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub ended: Option<UtcTime>,
    /// Length of its files.
    pub bytes: u64,
    /// Messages in it.
    pub messages: u64,
    /// Whose messages are in it, sorted.
    pub machines: Vec<String>,
    /// Number of its files.
    pub files: u32,
}

/// Where a session's bytes are.
#[derive(Clone, Debug)]
pub(super) struct SessionFile {
    pub path: PathBuf,
    /// So many bytes are finished.
    pub bytes: u64,
    /// Whether nothing will be added.
    pub finished: bool,
}

/// The folder of all sessions.
#[derive(Debug)]
pub(super) struct Catalogue {
    folder: PathBuf,
}

impl Catalogue {
    pub fn new(folder: PathBuf) -> Self {
        Self { folder }
    }

    /// The lock that one writer holds, so that nobody recovers what another one is writing.
    pub fn lock(&self) -> std::io::Result<File> {
        std::fs::create_dir_all(&self.folder)?;
        let lock = File::options().create(true).append(true).open(self.folder.join("lock"))?;
        lock.try_lock().map_err(|error| match error {
            std::fs::TryLockError::Error(error) => error,
            std::fs::TryLockError::WouldBlock => {
                std::io::Error::new(std::io::ErrorKind::WouldBlock, "another site server records there")
            }
        })?;
        Ok(lock)
    }

    /// Makes the folder of a new session that starts at `now`; returns its id and its first file.
    pub fn create(&self, now: Stamp) -> std::io::Result<(String, PathBuf)> {
        let name = timestamp(now).strftime(ID_FORMAT).to_string();
        for attempt in 1.. {
            let id = if attempt == 1 { name.clone() } else { format!("{name}-{attempt}") };
            match std::fs::create_dir(self.folder.join(&id)) {
                Ok(()) => {
                    // The new folder's entry must survive a power cut as its content does.
                    File::open(&self.folder)?.sync_all()?;
                    return Ok((id.clone(), self.file(&id)));
                }
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        }
        unreachable!("some number is free")
    }

    /// The sessions that were not closed by their writer, oldest first.
    pub fn unfinished(&self) -> Vec<PathBuf> {
        let files = self.ids().into_iter().map(|id| self.file(&id));
        files.filter(|path| matches!(record::inspect(path), Err(RecordError::Unfinished { .. }))).collect()
    }

    /// All sessions, newest first. Reads the disk.
    pub fn list(&self, current: Option<&Progress>) -> Vec<SessionView> {
        let ids = self.ids();
        ids.iter().rev().filter_map(|id| self.session(id, current)).collect()
    }

    /// Where a session's recording is; `None` if there is no such session. Reads the disk.
    pub fn locate(&self, id: &str, current: Option<&Progress>) -> Option<SessionFile> {
        if !is_id(id) {
            return None;
        }
        let path = self.file(id);
        if let Some(progress) = current.filter(|progress| progress.session == id && !progress.finished) {
            return Some(SessionFile { path, bytes: progress.synced_bytes, finished: false });
        }
        let bytes = std::fs::metadata(&path).ok()?.len();
        Some(SessionFile { path, bytes, finished: true })
    }

    fn session(&self, id: &str, current: Option<&Progress>) -> Option<SessionView> {
        if let Some(progress) = current.filter(|progress| progress.session == id && !progress.finished) {
            return Some(SessionView {
                id: id.to_owned(),
                state: SessionState::Recording,
                started: UtcTime(progress.started),
                ended: None,
                bytes: progress.synced_bytes,
                messages: progress.messages,
                machines: progress.machines.clone(),
                files: 1,
            });
        }
        let path = self.file(id);
        let bytes = std::fs::metadata(&path).ok()?.len();
        let summary = record::inspect(&path).ok();
        let span = summary.as_ref().and_then(|summary| summary.span);
        let started = started(id).or(span.map(|(first, _)| first)).unwrap_or_default();
        Some(SessionView {
            id: id.to_owned(),
            state: match summary.as_ref().map(|summary| summary.state) {
                Some(FileState::Complete) => SessionState::Complete,
                Some(FileState::Recovered) => SessionState::Recovered,
                Some(FileState::Truncated) | None => SessionState::Truncated,
            },
            started: UtcTime(started),
            ended: span.map(|(_, last)| UtcTime(last)),
            bytes,
            messages: summary.as_ref().map_or(0, |summary| summary.messages),
            machines: summary.map_or_else(Vec::new, |summary| summary.machines),
            files: 1,
        })
    }

    fn ids(&self) -> Vec<String> {
        let Ok(entries) = std::fs::read_dir(&self.folder) else { return Vec::new() };
        let names = entries.flatten().filter_map(|entry| entry.file_name().into_string().ok());
        let mut ids: Vec<String> = names.filter(|name| is_id(name) && self.file(name).is_file()).collect();
        ids.sort();
        ids
    }

    fn file(&self, id: &str) -> PathBuf {
        self.folder.join(id).join(Path::new(&format!("{id}-0000.mcap")))
    }
}

/// Ids come from URLs and become paths: letters, digits and '-' only.
fn is_id(id: &str) -> bool {
    (1..=64).contains(&id.len()) && id.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
}

fn timestamp(stamp: Stamp) -> jiff::Timestamp {
    jiff::Timestamp::from_nanosecond(i128::from(stamp.as_nanos()))
        .expect("every stamp is in jiff's range, which reaches from year -9999 to 9999")
}

fn started(id: &str) -> Option<Stamp> {
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
}
