//! The sessions there are: what the files say, and what people wrote to them.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::database::{Database, Entry, Part};
use super::folder::{Folder, Look, Notes, NotesChange, is_id};
use super::retention::Candidate;
use super::running::Progress;
use super::view::{SessionDetail, SessionView};
use crate::record::{self, RecordError, Summary};
use crate::site::SiteError;
use crate::time::Stamp;

/// The folder of all sessions and its database.
#[derive(Debug)]
pub(in crate::site) struct Catalogue {
    folder: Folder,
    database: Mutex<Database>,
    /// The session that is being written: nobody else looks into its files.
    running: Mutex<Option<String>>,
    /// Held by whoever changes what is written to a session, from reading it to the end; before the database.
    writing: Mutex<()>,
    /// Whether others may write there, so that the database may not, and is filled anew each time.
    is_visitor: bool,
}

/// Which files are to be recovered, if they were not closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Recovery {
    /// None: they may be somebody else's.
    Forbidden,
    /// Those that were changed since they were looked at.
    Changed,
    /// Also those that could not be recovered before.
    All,
}

/// Where a session's bytes are.
#[derive(Clone, Debug)]
pub(in crate::site) struct Located {
    /// Files that are closed, by number.
    pub closed: Vec<(u32, PathBuf)>,
    /// The one that is not, and how many bytes of it are whole.
    pub open: Option<(u32, PathBuf, u64)>,
    /// Whether nothing will be added.
    pub finished: bool,
}

impl Catalogue {
    /// Of a folder that is locked for us.
    pub(super) fn open(folder: Folder) -> rusqlite::Result<Self> {
        let database = Database::open(&folder.path().join("catalogue.sqlite")).or_else(|error| {
            tracing::warn!("the sessions' database cannot be used, and is kept in memory: {error}");
            Database::in_memory()
        })?;
        let (database, running, writing) = (Mutex::new(database), Mutex::new(None), Mutex::new(()));
        Ok(Self { folder, database, running, writing, is_visitor: false })
    }

    /// Of a folder in which somebody else may record. Changes nothing in it.
    pub fn visit(folder: PathBuf) -> Result<Self, SiteError> {
        let memory = Database::in_memory();
        let failed = |error: rusqlite::Error| SiteError::Record {
            directory: folder.clone(),
            message: error.to_string(),
        };
        let database = Mutex::new(memory.map_err(failed)?);
        let (running, writing) = (Mutex::new(None), Mutex::new(()));
        Ok(Self { folder: Folder::new(folder), database, running, writing, is_visitor: true })
    }

    pub(super) fn folder(&self) -> &Folder {
        &self.folder
    }

    /// All sessions, newest first.
    pub fn list(&self, current: Option<&Progress>) -> Vec<SessionView> {
        if self.is_visitor {
            self.reconcile(Recovery::Forbidden, &|| false);
        }
        let entries = self.with(|database| database.entries(None));
        let details =
            entries.into_iter().rev().filter_map(|(id, entry)| SessionDetail::of(&id, entry, current));
        details.map(|detail| detail.session).collect()
    }

    /// One session; `None` if there is none of that id.
    pub fn detail(&self, id: &str, current: Option<&Progress>) -> Option<SessionDetail> {
        if !is_id(id) {
            return None;
        }
        if self.is_visitor {
            self.reconcile(Recovery::Forbidden, &|| false);
        }
        let entry = self.with(|database| database.entries(Some(id))).remove(id)?;
        SessionDetail::of(id, entry, current)
    }

    /// Where a session's recording is; `None` if there is no such session.
    pub fn locate(&self, id: &str, current: Option<&Progress>) -> Option<Located> {
        let parts = if is_id(id) { self.folder.parts(id) } else { return None };
        let running = current.filter(|progress| progress.running() == Some(id));
        let mut located = Located { closed: Vec::new(), open: None, finished: running.is_none() };
        for number in parts.into_keys() {
            let path = self.folder.part(id, number);
            match running.filter(|progress| progress.open_file == Some(number)) {
                Some(progress) => located.open = Some((number, path, progress.synced_bytes)),
                None => located.closed.push((number, path)),
            }
        }
        (!located.closed.is_empty() || located.open.is_some()).then_some(located)
    }

    /// Writes to a session what people say of it.
    ///
    /// # Errors
    /// The outer one: it cannot be written. The inner one says what is wrong with the change.
    pub fn edit(&self, id: &str, change: NotesChange) -> std::io::Result<Option<Result<(), String>>> {
        let _writing = lock(&self.writing);
        if !is_id(id) || !self.folder.exists(id) {
            return Ok(None);
        }
        let mut notes = self.notes(id);
        if let Err(wrong) = change.apply(&mut notes) {
            return Ok(Some(Err(wrong)));
        }
        self.folder.write_notes(id, &notes)?;
        self.with(|database| database.put_notes(id, &notes));
        Ok(Some(Ok(())))
    }

    /// Starts a session, which is the running one from now on; returns its id.
    pub(super) fn begin(&self, now: Stamp, notes: &Notes) -> std::io::Result<String> {
        let id = self.folder.create(now, notes)?;
        *lock(&self.running) = Some(id.clone());
        self.with(|database| database.put_notes(&id, notes));
        Ok(id)
    }

    /// Nothing is added to the running session any more.
    pub(super) fn end(&self) {
        *lock(&self.running) = None;
    }

    /// Takes a session back that never had a file.
    pub(super) fn discard(&self, id: &str) {
        self.end();
        self.folder.discard(id);
        self.with(|database| database.remove(id));
    }

    /// A file of the running session was begun, or closed with this content.
    pub(super) fn put(&self, id: &str, number: u32, summary: Option<Summary>) {
        let look = self.folder.parts(id).remove(&number).unwrap_or(Look { bytes: 0, modified_ns: 0 });
        let part = Part { look, summary };
        self.with(|database| database.put_part(id, number, &part));
    }

    /// Brings the database in line with the files, which are right. Looks only into what was changed, and leaves
    /// the running session alone.
    pub(super) fn reconcile(&self, recovery: Recovery, is_ended: &dyn Fn() -> bool) {
        let known = self.with(|database| database.entries(None));
        let ids = self.folder.ids();
        for id in known.keys().filter(|id| ids.binary_search(id).is_err() && !self.is_running(id)) {
            self.with(|database| database.remove(id));
        }
        for id in ids {
            if self.is_running(&id) {
                continue;
            }
            let parts = self.folder.parts(&id);
            let known = known.get(&id);
            let writing = lock(&self.writing);
            let notes = match (self.folder.read_notes(&id), known) {
                (Some(notes), _) => notes,
                // The file is lost, and the database still knows it by heart.
                (None, Some(known)) if !self.is_visitor => {
                    if let Err(error) = self.folder.write_notes(&id, &known.notes) {
                        tracing::warn!("session {id}: what was written to it cannot be kept: {error}");
                    }
                    known.notes.clone()
                }
                (None, _) => Notes::default(),
            };
            if known.is_none_or(|known| known.notes != notes) {
                self.with(|database| database.put_notes(&id, &notes));
            }
            drop(writing);
            let gone = known
                .iter()
                .flat_map(|known| known.parts.keys())
                .filter(|number| !parts.contains_key(number));
            for number in gone {
                self.with(|database| database.remove_part(&id, *number));
            }
            for (number, look) in parts {
                let before = known.and_then(|known| known.parts.get(&number));
                let is_known = before.is_some_and(|part| {
                    part.look == look && (part.summary.is_some() || recovery != Recovery::All)
                });
                if is_known || is_ended() {
                    continue;
                }
                let summary = self.read(&self.folder.part(&id, number), recovery != Recovery::Forbidden);
                let look = self.folder.parts(&id).remove(&number).unwrap_or(look);
                self.with(|database| {
                    database.put_part(&id, number, &Part { look, summary: summary.clone() })
                });
            }
        }
    }

    /// What a file says of itself, after recovery if it may be.
    fn read(&self, path: &std::path::Path, recover: bool) -> Option<Summary> {
        match record::inspect(path) {
            Ok(summary) => Some(summary),
            Err(RecordError::Unfinished { .. }) if recover => match record::recover(path) {
                Ok(summary) => {
                    tracing::info!(
                        "{}: {}, {} messages, {} bytes given up",
                        path.display(),
                        summary.state.name(),
                        summary.messages,
                        summary.lost_bytes
                    );
                    Some(summary)
                }
                Err(error) => {
                    tracing::error!("cannot be recovered: {error}");
                    None
                }
            },
            Err(_) => None,
        }
    }

    /// The sessions that have ended, oldest first, and the bytes of the one that runs.
    pub(super) fn candidates(&self) -> (Vec<Candidate>, u64) {
        let mut candidates = Vec::new();
        let mut running_bytes = 0;
        for (id, entry) in self.with(|database| database.entries(None)) {
            if self.is_running(&id) {
                running_bytes = self.folder.parts(&id).values().map(|look| look.bytes).sum();
                continue;
            }
            let bytes = entry.parts.values().map(|part| part.look.bytes).sum();
            let spans = entry.parts.values().filter_map(|part| part.summary.as_ref()?.span);
            let ended = spans.map(|(_, last)| last).max().or_else(|| super::folder::started(&id));
            // Without any time it is not ours to judge.
            candidates.extend(ended.map(|ended| Candidate { id, ended, bytes }));
        }
        candidates.sort_by_key(|candidate| candidate.ended);
        (candidates, running_bytes)
    }

    /// Deletes a session that has ended.
    pub(super) fn delete(&self, id: &str) -> std::io::Result<()> {
        if self.is_running(id) {
            return Ok(());
        }
        let _writing = lock(&self.writing);
        self.folder.delete(id)?;
        self.with(|database| database.remove(id));
        Ok(())
    }

    fn is_running(&self, id: &str) -> bool {
        lock(&self.running).as_deref() == Some(id)
    }

    fn notes(&self, id: &str) -> Notes {
        let known = || self.with(|database| database.entries(Some(id))).remove(id);
        self.folder.read_notes(id).or_else(|| known().map(|entry: Entry| entry.notes)).unwrap_or_default()
    }

    /// Asks the database. If it fails, such as on a full disk, one in memory takes its place, and is filled by
    /// the next [`Catalogue::reconcile`].
    fn with<T: Default>(&self, ask: impl Fn(&mut Database) -> rusqlite::Result<T>) -> T {
        let mut database = lock(&self.database);
        let error = match ask(&mut database) {
            Ok(answer) => return answer,
            Err(error) => error,
        };
        tracing::error!("the sessions' database fails, and is kept in memory until the next start: {error}");
        let filled = database.entries(None).unwrap_or_default();
        let Ok(mut memory) = Database::in_memory() else { return T::default() };
        let copied = filled.iter().try_for_each(|(id, entry)| {
            memory.put_notes(id, &entry.notes)?;
            entry.parts.iter().try_for_each(|(number, part)| memory.put_part(id, *number, part))
        });
        if let Err(error) = copied {
            tracing::error!("the sessions' database in memory fails: {error}");
        }
        *database = memory;
        ask(&mut database).unwrap_or_default()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Whoever died with the lock left whole values behind: each change is one statement.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
