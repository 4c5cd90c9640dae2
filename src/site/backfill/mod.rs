//! Fetches from machines' on-board records what the recording lacks.
//!
//! The books ([`Ledger`]) are kept where messages are written: what the network, a full channel or a dead disk lost
//! on the way there is a gap, however it was lost, and what comes twice is written once. Connected machines are
//! asked what they hold; what the books lack of it is fetched in pieces, one after the other, with the lowest
//! priority and with pauses as long as the pieces took, and goes through the recorder's channel like everything
//! else. A piece that does not come, or is not written, is asked for again. What an answer lacks is lost if the
//! machine, asked once more, does not hold it; the recorder tells so in the next file that it can write to.
//!
//! It is a boot that is asked, not a machine: of two machines with the same id the one that the fleet believes.
//! Gaps of the other one stay open, or are lost as what was never on board.
//!
//! The books are saved every few seconds as far as the disk has what they say. After a restart the files that were
//! written since are read again. As long as one of them cannot be read nothing is fetched, for it may be there.
//!
//! In memory are one piece for each of [`JOBS_MAX`] machines, and the books: so many bytes for each hole in the boots that
//! machines still hold.

#![allow(clippy::disallowed_methods, reason = "what is asked for is waited for, by a clock that nobody sets")]

mod books;
mod job;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};

use super::aggregator::Frame;
use super::clock::SiteClock;
use super::ended;
use super::inlet::Message;
use super::sessions::{Command, Progress, RecordingState};
use crate::fleet::{self, Presence};
use crate::record::GapCounts;
use crate::wire::{BootId, Holdings};

pub(super) use books::{Books, Opened, Saving, open};
use job::{Job, Outcome, PIECE_BYTES};

/// How often machines are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// A machine that lacks nothing is asked again after so long.
const ASK_EVERY: Duration = Duration::from_secs(5);
/// One that lacks something, or has just come, after so long.
const ASK_SOON: Duration = Duration::from_millis(700);
/// After failures each wait is twice as long, up to this.
const ASK_AGAIN_MAX: Duration = Duration::from_secs(30);
/// Messages that a machine held so long ago have come by themselves, or never will.
const SETTLED_AFTER: Duration = Duration::from_secs(2);
/// Machines that are asked at the same time.
const JOBS_MAX: usize = 4;
/// The books are saved so often,
const SAVE_EVERY: Duration = Duration::from_secs(2);
/// and the more rarely, the longer they are: so many bytes at a time. The disk is the recorder's. What a crash costs is
/// the reading of the files since.
const SAVE_BYTES: usize = 64 * 1024;
/// A recording that could not be read is tried again so often.
const READ_EVERY: Duration = Duration::from_secs(10);

/// Where things go.
pub(super) struct Outlets {
    pub session: zenoh::Session,
    pub site: String,
    pub recorder: SyncSender<Command>,
    /// Nothing is fetched while nothing is recorded.
    pub progress: watch::Receiver<Progress>,
    pub messages: mpsc::Sender<Message>,
    pub clock: SiteClock,
}

impl Outlets {
    fn records(&self) -> bool {
        self.progress.borrow().state == RecordingState::Recording
    }
}

/// The fetching task.
pub(super) struct Backfill {
    task: JoinHandle<()>,
    /// Ends the reading of files.
    stopping: Arc<AtomicBool>,
    /// Whether all files were read, so that the books may be saved.
    read: Arc<AtomicBool>,
    books: Books,
    path: PathBuf,
}

impl Backfill {
    /// Starts fetching, once the files that the saved books do not know are read.
    pub fn start(
        opened: Opened,
        outlets: Outlets,
        frames: watch::Receiver<Arc<Frame>>,
        stopped: watch::Receiver<bool>,
    ) -> Self {
        let (books, path) = (opened.books.clone(), opened.path.clone());
        let stopping = Arc::new(AtomicBool::new(false));
        let fetching = Fetching {
            outlets: Arc::new(outlets),
            books: books.clone(),
            path: path.clone(),
            saved: Vec::new(),
            machines: BTreeMap::new(),
            jobs: JoinSet::new(),
            stopping: Arc::clone(&stopping),
        };
        let read = {
            let stopping = Arc::clone(&stopping);
            move || opened.read_files(&stopping)
        };
        let read_all = Arc::new(AtomicBool::new(false));
        let is_read = Arc::clone(&read_all);
        let task = async move {
            if tokio::task::spawn_blocking(read).await.is_ok() {
                is_read.store(true, Ordering::Relaxed);
                fetching.run(frames, stopped).await;
            }
        };
        Self { task: tokio::spawn(task), stopping, read: read_all, books, path }
    }

    /// Ends the fetching. Once the recorder has ended too the books are to be saved, if they are whole.
    pub async fn stop(self) -> Option<Saving> {
        self.stopping.store(true, Ordering::Relaxed);
        self.task.abort();
        // An error says that it was ended.
        let _ = self.task.await;
        let is_whole = self.read.load(Ordering::Relaxed) && self.books.are_whole();
        is_whole.then_some(Saving { books: self.books, path: self.path })
    }
}

/// A job that has an outcome whatever happens in it: after a panic the machine is asked again, as after any failure.
async fn ending(job: impl Future<Output = Outcome> + Send + 'static) -> Outcome {
    // A task of its own, which a panic ends alone; with the set it ends, too.
    let mut task = JoinSet::new();
    task.spawn(job);
    match task.join_next().await {
        Some(Ok(outcome)) => outcome,
        ended => {
            let reason = ended.and_then(Result::err).map_or_else(String::new, |error| error.to_string());
            tracing::error!("a fetching job has ended early: {reason}");
            Outcome::failed(reason)
        }
    }
}

/// In how many turns books of that length are saved again.
fn save_after(bytes: usize) -> u32 {
    u32::try_from(bytes.div_ceil(SAVE_BYTES)).unwrap_or(u32::MAX).clamp(1, 30)
}

/// The task.
struct Fetching {
    outlets: Arc<Outlets>,
    books: Books,
    path: PathBuf,
    /// What was last saved.
    saved: Vec<u8>,
    machines: BTreeMap<String, Asked>,
    jobs: JoinSet<(String, Outcome)>,
    /// Ends the reading of files.
    stopping: Arc<AtomicBool>,
}

/// How far we are with a machine.
struct Asked {
    boot: String,
    connected: bool,
    busy: bool,
    due: Instant,
    failures: u32,
    /// What it held, and some time before.
    newest: Option<(Instant, Holdings)>,
    older: Option<(Instant, Holdings)>,
    piece_bytes: u64,
    /// Messages that the running job, or the last one, has still to fetch.
    left: Arc<AtomicU64>,
    told: GapCounts,
}

impl Asked {
    fn new(now: Instant) -> Self {
        Self {
            boot: String::new(),
            connected: false,
            busy: false,
            due: now,
            failures: 0,
            newest: None,
            older: None,
            piece_bytes: PIECE_BYTES.1,
            left: Arc::default(),
            told: GapCounts::default(),
        }
    }

    /// What the machine held a while ago.
    fn before(&self, now: Instant) -> Option<Holdings> {
        let held = [&self.newest, &self.older].into_iter().flatten();
        held.into_iter().find(|(at, _)| now - *at >= SETTLED_AFTER).map(|(_, holdings)| holdings.clone())
    }

    fn remember(&mut self, at: Instant, holdings: Holdings) {
        if self.newest.as_ref().is_none_or(|(newest, _)| at - *newest >= SETTLED_AFTER) {
            self.older = self.newest.replace((at, holdings));
        }
    }
}

impl Fetching {
    async fn run(mut self, frames: watch::Receiver<Arc<Frame>>, mut stopped: watch::Receiver<bool>) {
        let mut looks = tokio::time::interval(LOOK_EVERY);
        looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut save_at = Instant::now() + SAVE_EVERY;
        let mut read_at = Instant::now() + READ_EVERY;
        loop {
            tokio::select! {
                () = ended(&mut stopped) => return,
                _ = looks.tick() => {}
            }
            let now = Instant::now();
            while let Some(Ok((machine, outcome))) = self.jobs.try_join_next() {
                self.done(&machine, outcome, now);
            }
            let frame = Arc::clone(&frames.borrow());
            self.look(&frame, now);
            self.tell();
            if now >= read_at && !self.books.are_whole() {
                tokio::task::block_in_place(|| self.books.read_again(&self.stopping));
                read_at = Instant::now() + READ_EVERY;
            }
            if now >= save_at && self.books.are_whole() {
                tokio::task::block_in_place(|| self.books.save(&self.path, &mut self.saved));
                save_at = now + SAVE_EVERY * save_after(self.saved.len());
            }
        }
    }

    /// Starts what is due.
    fn look(&mut self, frame: &Frame, now: Instant) {
        let may_fetch = self.outlets.records() && self.books.are_whole();
        for view in &frame.view.machines {
            let asked = self.machines.entry(view.id.clone()).or_insert_with(|| Asked::new(now));
            let connected = view.presence != Presence::Lost;
            if connected && (!asked.connected || asked.boot != view.boot) {
                // Soon, but what was on its way comes by itself.
                asked.due = now + ASK_SOON;
                asked.failures = 0;
            }
            asked.connected = connected;
            asked.boot.clone_from(&view.boot);
            if !may_fetch || !connected || asked.busy || now < asked.due || self.jobs.len() >= JOBS_MAX {
                continue;
            }
            let Ok(boot) = view.boot.parse::<BootId>() else { continue };
            asked.busy = true;
            let job = Job {
                outlets: Arc::clone(&self.outlets),
                books: self.books.clone(),
                machine: view.id.as_str().into(),
                boot,
                before: asked.before(now),
                piece_bytes: asked.piece_bytes,
                left: Arc::clone(&asked.left),
            };
            let id = view.id.clone();
            self.jobs.spawn(async move { (id, ending(job.run()).await) });
        }
    }

    fn done(&mut self, machine: &str, outcome: Outcome, now: Instant) {
        let Some(asked) = self.machines.get_mut(machine) else { return };
        asked.busy = false;
        asked.piece_bytes = outcome.piece_bytes;
        if let Some((at, holdings)) = outcome.holdings {
            asked.remember(at, holdings);
        }
        asked.due = now
            + match outcome.result {
                Err(reason) => {
                    asked.failures += 1;
                    let level = if asked.failures == 1 { "" } else { " again" };
                    tracing::debug!("machine {machine}: nothing could be fetched{level}: {reason}");
                    ASK_SOON.saturating_mul(1 << asked.failures.min(10)).min(ASK_AGAIN_MAX)
                }
                Ok(()) => {
                    asked.failures = 0;
                    if self.books.lock().counts(machine).open > 0 { ASK_SOON } else { ASK_EVERY }
                }
            };
    }

    /// Tells the fleet how much is missing.
    fn tell(&mut self) {
        for (id, asked) in &mut self.machines {
            let mut counts = self.books.lock().counts(id);
            counts.open = counts.open.max(asked.left.load(Ordering::Relaxed));
            if counts == asked.told {
                continue;
            }
            let gaps = fleet::Gaps { open: counts.open, filled: counts.filled, lost: counts.lost };
            let told = Message::Gaps { machine: id.as_str().into(), gaps };
            if self.outlets.messages.try_send(told).is_ok() {
                asked.told = counts;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn job_that_panics_has_failed_and_no_more() {
        let outcome = ending(async { panic!("of a test") }).await;
        assert!(outcome.result.unwrap_err().contains("panicked"));
        assert_eq!(
            ending(async { Outcome::failed("no answer".to_owned()) }).await.result.unwrap_err(),
            "no answer"
        );
    }

    #[test]
    fn long_books_are_saved_more_rarely() {
        assert_eq!([0, 1, SAVE_BYTES, 10 * SAVE_BYTES, usize::MAX].map(save_after), [1, 1, 1, 10, 30]);
    }
}
