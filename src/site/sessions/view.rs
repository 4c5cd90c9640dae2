//! What the API says of sessions.

use serde::Serialize;

use super::database::{Entry, Part};
use super::folder::started;
use super::running::Progress;
use crate::fleet::UtcTime;
use crate::record::FileState;

/// How whole a session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub(in crate::site) enum SessionState {
    /// Being written.
    Recording,
    /// Closed by its writer.
    Complete,
    /// Its writer died; everything that had reached the disk is there.
    Recovered,
    /// Its writer died within a chunk: those messages are lost; or it still waits for recovery.
    Truncated,
}

impl SessionState {
    fn of_file(part: &Part) -> Self {
        match part.summary.as_ref().map(|summary| summary.state) {
            Some(FileState::Complete) => SessionState::Complete,
            Some(FileState::Recovered) => SessionState::Recovered,
            Some(FileState::Truncated) | None => SessionState::Truncated,
        }
    }

    fn rank(self) -> u8 {
        match self {
            SessionState::Complete => 0,
            SessionState::Recovered => 1,
            SessionState::Truncated => 2,
            SessionState::Recording => 3,
        }
    }
}

/// A time span of the whole site, recorded.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub(in crate::site) struct SessionView {
    /// Also the name of its folder.
    pub id: String,
    /// What people call it; empty if it has no name.
    pub name: String,
    /// What people wrote to it.
    pub notes: String,
    /// To find it by.
    pub tags: Vec<String>,
    /// How whole it is: as its worst file.
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

/// A session and its files.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub(in crate::site) struct SessionDetail {
    /// The session.
    pub session: SessionView,
    /// Its files, in order of their numbers.
    pub files: Vec<FileView>,
}

/// One of the files of a session.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub(in crate::site) struct FileView {
    /// What `?file=` names it by.
    pub number: u32,
    /// How whole it is.
    pub state: SessionState,
    /// When its first message was received; `null` without messages, or if that is not known.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub started: Option<UtcTime>,
    /// When its last message was received; `null` without messages, or if that is not known.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub ended: Option<UtcTime>,
    /// Its length.
    pub bytes: u64,
    /// Messages in it.
    pub messages: u64,
    /// Bytes that were given up in recovery.
    pub lost_bytes: u64,
}

/// Whether what arrives is recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub(in crate::site) enum RecordingState {
    /// It is.
    Recording,
    /// It should be, but cannot: goes on by itself as soon as it can.
    Paused,
    /// Somebody asked to stop.
    #[default]
    Stopped,
    /// The site file says that nothing is recorded.
    Off,
}

/// What the recorder does.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub(in crate::site) struct RecordingView {
    /// Whether what arrives is recorded.
    pub state: RecordingState,
    /// Why it is not, in words; `null` if it is.
    pub why: Option<String>,
    /// The session that runs, if one does.
    pub session: Option<String>,
    /// Messages that arrived since the start, but were not recorded because the recording was paused.
    pub missed: u64,
    /// When the next session begins by itself; `null` if none does.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub next_session: Option<UtcTime>,
}

impl RecordingView {
    /// Of a recorder; of none if the site file wants none.
    pub fn of(progress: Option<&Progress>) -> Self {
        match progress {
            None => Self {
                state: RecordingState::Off,
                why: Some("the site file has record.enabled = false".to_owned()),
                session: None,
                missed: 0,
                next_session: None,
            },
            Some(progress) => Self {
                state: progress.state,
                why: progress.why.clone(),
                session: progress.running().map(str::to_owned),
                missed: progress.missed,
                next_session: progress.next_session.map(UtcTime),
            },
        }
    }
}

impl SessionDetail {
    /// Of what is known of a session, and of the one that runs; `None` if there are no files yet.
    pub(super) fn of(id: &str, entry: Entry, current: Option<&Progress>) -> Option<Self> {
        let running = current.filter(|progress| progress.running() == Some(id));
        let open = running.and_then(|progress| progress.open_file);
        let mut files = Vec::new();
        let mut machines = Vec::new();
        for (number, part) in entry.parts {
            let state = SessionState::of_file(&part);
            if open == Some(number) {
                continue;
            }
            let summary = part.summary;
            let span = summary.as_ref().and_then(|summary| summary.span);
            files.push(FileView {
                number,
                state,
                started: span.map(|(first, _)| UtcTime(first)),
                ended: span.map(|(_, last)| UtcTime(last)),
                bytes: part.look.bytes,
                messages: summary.as_ref().map_or(0, |summary| summary.messages),
                lost_bytes: summary.as_ref().map_or(0, |summary| summary.lost_bytes),
            });
            machines.extend(summary.map(|summary| summary.machines).unwrap_or_default());
        }
        if let (Some(progress), Some(number)) = (running, open) {
            files.push(FileView {
                number,
                state: SessionState::Recording,
                started: progress.file_span.map(|(first, _)| UtcTime(first)),
                ended: progress.file_span.map(|(_, last)| UtcTime(last)),
                bytes: progress.synced_bytes,
                messages: progress.file_messages,
                lost_bytes: 0,
            });
        }
        machines.extend(running.map(|progress| progress.machines.clone()).unwrap_or_default());
        machines.sort();
        machines.dedup();
        if files.is_empty() && running.is_none() {
            return None;
        }
        let worst = files.iter().map(|file| file.state).max_by_key(|state| state.rank());
        let state = if running.is_some() { SessionState::Recording } else { worst? };
        let begin = files.iter().find_map(|file| file.started);
        let ended = files.iter().filter_map(|file| file.ended).max_by_key(|ended| ended.0);
        let session = SessionView {
            name: entry.notes.name,
            notes: entry.notes.notes,
            tags: entry.notes.tags,
            state,
            started: started(id).map(UtcTime).or(begin).unwrap_or(UtcTime(Default::default())),
            ended: if running.is_some() { None } else { ended },
            bytes: files.iter().map(|file| file.bytes).sum(),
            messages: files.iter().map(|file| file.messages).sum(),
            machines,
            files: files.len() as u32,
            id: id.to_owned(),
        };
        Some(Self { session, files })
    }
}
