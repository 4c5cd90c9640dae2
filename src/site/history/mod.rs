//! What the site remembers beside its recordings: outages, where they were, alerts, and who is to be told. Kept in
//! SQLite, for itself: unlike the sessions' catalogue it cannot be made anew from files.
//!
//! ```text
//! aggregator ── try_send ─▶ history thread ──▶ archive (database, outages that go on) ◀── API
//! ```
//! An outage is written when it begins and when it ends, and every ten seconds in between; what goes on when the
//! server ends is carried on by its next run.

mod alerts;
mod database;
mod forgetting;
mod outages;
mod shadow;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rusqlite::Result;

use super::clock::SiteClock;
use crate::fleet::{Alert, CellKey, CellTime, Change, Ending, Outage};
use crate::time::{Span, Stamp};
pub(super) use alerts::{AlertFilter, Delivery};
use database::Database;
pub(super) use outages::{Cursor, Filter, Page};
pub(super) use shadow::Area;

/// Changes on their way to the disk: every machine's for some seconds. Full, they are dropped and told; an outage
/// that goes on is told again a second later.
const QUEUE: usize = 4 * crate::fleet::MACHINES_MAX;
/// An outage that goes on is written so often.
const WRITTEN_EVERY: Span = Span::from_millis(10_000);
/// What is too old is looked for so often.
const FORGETS_EVERY: Span = Span::from_millis(600_000);

/// What is to be remembered.
#[derive(Debug)]
pub(super) enum Note {
    Outage(Box<Change>),
    Cells(Vec<(String, CellKey, CellTime)>),
}

/// What is remembered.
#[derive(Debug)]
pub(super) struct Archive {
    database: Mutex<Database>,
    /// Those that go on, by id, as they stand; newer than in the database.
    open: Mutex<BTreeMap<String, Outage>>,
}

/// The thread that writes.
pub(super) struct History {
    archive: Arc<Archive>,
    inbox: Option<SyncSender<Note>>,
    thread: Option<JoinHandle<()>>,
}

/// Where notes are left; does not wait.
#[derive(Clone, Debug)]
pub(super) struct Inlet(SyncSender<Note>);

impl Inlet {
    pub fn leave(&self, note: Note) {
        if self.0.try_send(note).is_err() {
            tracing::error!("the history does not keep up: something is not remembered");
        }
    }
}

impl History {
    /// In `folder`, which is ours; `None` remembers as long as the process lives. What was over `keep` ago is
    /// forgotten; `None` keeps it for ever.
    pub fn start(folder: Option<&Path>, keep: Option<Span>, clock: SiteClock) -> std::io::Result<Self> {
        let archive = Arc::new(Archive::open(folder).map_err(std::io::Error::other)?);
        let (inbox, notes) = sync_channel(QUEUE);
        let for_thread = Arc::clone(&archive);
        let thread = std::thread::Builder::new()
            .name("history".to_owned())
            .spawn(move || run(&for_thread, &notes, keep, clock))?;
        Ok(Self { archive, inbox: Some(inbox), thread: Some(thread) })
    }

    pub fn archive(&self) -> Arc<Archive> {
        Arc::clone(&self.archive)
    }

    /// `None` once it is finished.
    pub fn inlet(&self) -> Option<Inlet> {
        self.inbox.clone().map(Inlet)
    }

    /// Writes what is left. The inlets must be gone.
    pub fn finish(mut self) {
        self.inbox = None;
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the history ended before it was asked to");
        }
    }
}

fn run(archive: &Archive, notes: &Receiver<Note>, keep: Option<Span>, clock: SiteClock) {
    let mut written: BTreeMap<String, Stamp> = BTreeMap::new();
    let mut forgets_at = clock.now();
    loop {
        let note = match notes.recv_timeout(Duration::from_secs(60)) {
            Ok(note) => Some(note),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        let now = clock.now();
        let mut kept = match note {
            Some(Note::Outage(change)) => archive.note_outage(*change, &mut written, now),
            Some(Note::Cells(cells)) => archive.database().add_cells(&cells),
            None => Ok(()),
        };
        if let Some(keep) = keep
            && now >= forgets_at
        {
            // More of it is for the next round: notes are waiting.
            let more = archive.database().forget(now - keep);
            forgets_at = if matches!(more, Ok(true)) { now } else { now + FORGETS_EVERY };
            kept = kept.and(more.map(drop));
        }
        if let Err(error) = kept {
            tracing::error!("the history cannot be written: {error}");
        }
    }
    let open: Vec<Outage> = archive.open_outages().values().cloned().collect();
    for outage in open {
        if let Err(error) = archive.database().put_outage(&outage) {
            tracing::error!("the history cannot be written: {error}");
        }
    }
}

impl Archive {
    fn open(folder: Option<&Path>) -> Result<Self> {
        let on_disk = folder.map(|folder| {
            // A failure shows when the database is opened.
            let _ = std::fs::create_dir_all(folder);
            Database::open(&folder.join("history.sqlite"))
        });
        let mut database = match on_disk {
            Some(Ok(database)) => database,
            Some(Err(error)) => {
                tracing::error!("the history cannot be opened, and is kept in memory: {error}");
                Database::in_memory()?
            }
            None => Database::in_memory()?,
        };
        // The newest first: a machine has one at a time.
        let mut machines = std::collections::BTreeSet::new();
        let mut open = BTreeMap::new();
        for mut outage in database.open_outages()? {
            if machines.insert(outage.machine.clone()) {
                open.insert(outage.id.clone(), outage);
            } else {
                (outage.end, outage.ended_by) = (Some(outage.last_heard), Some(Ending::Unheard));
                database.put_outage(&outage)?;
            }
        }
        Ok(Self { database: Mutex::new(database), open: Mutex::new(open) })
    }

    fn note_outage(&self, change: Change, written: &mut BTreeMap<String, Stamp>, now: Stamp) -> Result<()> {
        let Change { outage, told_late } = change;
        if told_late && self.database().outage(&outage.id)?.is_some_and(|known| known.end.is_some()) {
            return Ok(());
        }
        let (id, has_ended) = (outage.id.clone(), outage.end.is_some());
        let is_due = written.get(&id).is_none_or(|at| now - *at >= WRITTEN_EVERY);
        // Told before it is written: the API asks here first.
        if !has_ended {
            self.open_outages().insert(id.clone(), outage.clone());
        }
        if has_ended || is_due {
            self.database().put_outage(&outage)?;
            written.insert(id.clone(), now);
        }
        if has_ended {
            self.open_outages().remove(&id);
            written.remove(&id);
        }
        Ok(())
    }

    /// Those that go on, by id.
    pub fn open_outages(&self) -> MutexGuard<'_, BTreeMap<String, Outage>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn database(&self) -> MutexGuard<'_, Database> {
        self.database.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Outages, newest first.
    pub fn outages(&self, filter: &Filter, now: Stamp) -> Result<Page> {
        let mut page = self.database().outages(filter, now)?;
        let open = self.open_outages();
        for outage in &mut page.outages {
            if let Some(newer) = open.get(&outage.id) {
                *outage = newer.clone();
            }
        }
        Ok(page)
    }

    /// One outage with its samples.
    pub fn outage(&self, id: &str) -> Result<Option<Outage>> {
        let open = self.open_outages().get(id).cloned();
        match open {
            Some(outage) => Ok(Some(outage)),
            None => self.database().outage(id),
        }
    }

    /// Keeps alerts that changed, and what the channels are to be told.
    pub fn put_alerts(&self, alerts: &[Alert], channels: &[String]) -> Result<()> {
        self.database().put_alerts(alerts, channels)
    }

    /// Those that are not both over and seen.
    pub fn open_alerts(&self) -> Result<Vec<Alert>> {
        self.database().open_alerts()
    }

    /// One alert.
    pub fn alert(&self, id: &str) -> Result<Option<Alert>> {
        self.database().alert(id)
    }

    /// Alerts, newest first, and where the list goes on.
    pub fn alerts(&self, filter: &AlertFilter) -> Result<(Vec<Alert>, Option<Cursor>)> {
        self.database().alerts(filter)
    }

    /// What a channel is to be told next.
    pub fn next_delivery(&self, channel: &str) -> Result<Option<Delivery>> {
        self.database().next_delivery(channel)
    }

    /// It is delivered, or given up.
    pub fn delivered(&self, id: i64) -> Result<()> {
        self.database().delivered(id)
    }

    /// It is to be tried again.
    pub fn not_delivered(&self, id: i64, failures: u32, due: Stamp) -> Result<()> {
        self.database().not_delivered(id, failures, due)
    }

    /// Nothing waits for channels that are not in the site file any more.
    pub fn forget_other_channels(&self, channels: &[String]) -> Result<()> {
        self.database().forget_other_channels(channels)
    }

    /// Time in the cells of a grid.
    pub fn cells(&self, area: &Area) -> Result<Vec<(i64, i64, CellTime)>> {
        self.database().cells(area)
    }

    /// Time that poses came, by machine and quarter of an hour.
    pub fn observed(&self, from: Stamp, to: Stamp) -> Result<Vec<crate::fleet::Observed>> {
        self.database().observed(from, to)
    }
}
