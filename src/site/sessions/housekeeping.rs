//! The thread that looks after sessions that are not running: recovery at the start, then what is kept.

use std::fs::File;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use super::catalogue::{Catalogue, Recovery};
use super::retention::Retention;
use crate::site::clock::SiteClock;

/// How often it looks for sessions that are too old or too many, and for what others changed in the folder.
const EVERY: Duration = Duration::from_secs(60);

/// The thread.
pub(super) struct Housekeeping {
    /// Nothing goes through: dropped to end the thread.
    ended: SyncSender<()>,
    is_ended: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Housekeeping {
    /// The thread has its share of the lock: nobody else recovers while it does.
    pub fn start(
        catalogue: Arc<Catalogue>,
        lock: Arc<File>,
        retention: Retention,
        clock: SiteClock,
    ) -> std::io::Result<Self> {
        let (ended_sender, ended) = sync_channel(0);
        let is_ended = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&is_ended);
        let thread = std::thread::Builder::new().name("housekeeping".to_owned()).spawn(move || {
            run(&catalogue, retention, clock, &ended, &flag);
            drop(lock);
        })?;
        Ok(Self { ended: ended_sender, is_ended, thread })
    }

    /// Waits for the file that is being recovered, if one is. If the process ends before, the next start recovers
    /// it.
    pub fn finish(self) {
        self.is_ended.store(true, Ordering::Relaxed);
        drop(self.ended);
        if self.thread.join().is_err() {
            tracing::error!("housekeeping ended before it was asked to");
        }
    }
}

fn run(
    catalogue: &Catalogue,
    retention: Retention,
    clock: SiteClock,
    ended: &Receiver<()>,
    is_ended: &AtomicBool,
) {
    let is_ended = || is_ended.load(Ordering::Relaxed);
    catalogue.folder().sweep();
    catalogue.reconcile(Recovery::All, &is_ended);
    while !is_ended() {
        let (candidates, running_bytes) = catalogue.candidates();
        for (id, why) in retention.expired(&candidates, running_bytes, clock.now()) {
            match catalogue.delete(&id) {
                Ok(()) => tracing::warn!("session {id} is deleted: {why}"),
                Err(error) => tracing::error!("session {id} cannot be deleted, though {why}: {error}"),
            }
        }
        match ended.recv_timeout(EVERY) {
            Err(RecvTimeoutError::Timeout) => catalogue.reconcile(Recovery::Changed, &is_ended),
            _ => return,
        }
    }
}
