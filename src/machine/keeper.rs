//! The on-board record: a thread that writes the ring, and one that answers the site's questions about it.
//!
//! ```text
//! outbox ──messages──▶ keeper (owns the ring) ──▶ disk
//!                                                   │
//! site ──questions──▶ answerer ◀────────────────────┘
//! ```
//! The outbox never waits for the disk, and the machine works without a record if the disk refuses: it says so in
//! its health, and tries again.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use zenoh::Wait;
use zenoh::query::{Query, Queryable};

use super::MachineError;
use super::clock;
use super::counters::Counters;
use super::outbox::is_published;
use crate::config;
use crate::link::{self, LinkError};
use crate::record::{RecordError, Recorded, Ring, RingOptions, Shelf};
use crate::time::{Span, Stamp};
use crate::wire::{
    Attachment, BATCH_BYTES_MAX, BootId, Holdings, Kept, OnBoardRecord, RecordRequest, Topic, encode_json,
    record_key,
};

/// Messages on the way to the disk: half a minute of them, for a disk that thinks. Full, new ones are dropped and
/// counted.
const MESSAGES_QUEUED: usize = 16_384;
/// Questions that wait. Full, the asker is told to ask again.
const QUESTIONS_QUEUED: usize = 4;
/// How often the thread looks at the clock while nothing comes.
const TURN: Duration = Duration::from_millis(100);
/// However full the disk, a ring is not made smaller than this.
const BYTES_MIN: u64 = 1_000_000;
/// One that was made smaller grows again by an eighth each time that the disk took everything for so long.
const GROW_EVERY: Duration = Duration::from_secs(60);
/// A disk that refused is tried again after so long.
const RETRY_AFTER: Duration = Duration::from_secs(5);

/// The threads.
pub(super) struct Keeper {
    thread: Option<JoinHandle<()>>,
    stopping: Arc<AtomicBool>,
    queryable: Queryable<()>,
    answerer: JoinHandle<()>,
}

/// Where messages go in.
pub(super) struct RecordInlet {
    machine: String,
    /// `None` if there is no record.
    messages: Option<SyncSender<Recorded<Vec<u8>>>>,
    state: Arc<State>,
    counters: Arc<Counters>,
}

/// What others see of the record.
struct State {
    shelf: Shelf,
    kept: Mutex<(Kept, Option<String>)>,
}

impl State {
    fn set(&self, kept: Kept, failure: Option<String>) {
        *self.kept.lock().unwrap_or_else(PoisonError::into_inner) = (kept, failure);
    }

    fn get(&self) -> (Kept, Option<String>) {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl RecordInlet {
    /// Hands a message over, or counts that there was no room for it; never waits.
    pub(super) fn offer(&self, topic: Topic, attachment: &Attachment, payload: &[u8]) {
        let Some(messages) = &self.messages else { return };
        let message = Recorded {
            machine: self.machine.clone(),
            topic,
            boot: Some(attachment.boot),
            sequence: attachment.sequence,
            // The thread's own time.
            received: Stamp::default(),
            sent: attachment.sent,
            payload: payload.to_vec(),
        };
        if messages.try_send(message).is_err() {
            self.counters.record_dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// What health says of the record.
    pub(super) fn status(&self) -> OnBoardRecord {
        let (kept, failure) = self.state.get();
        OnBoardRecord {
            kept: kept == Kept::Yes,
            bytes: self.state.shelf.bytes(),
            dropped: self.counters.record_dropped.load(Ordering::Relaxed),
            failure,
        }
    }
}

impl Keeper {
    /// Starts the threads and declares the queryable. `about` goes into every file, as metadata.
    pub(super) async fn start(
        session: &zenoh::Session,
        machine: &config::Machine,
        boot: BootId,
        about: Vec<(String, BTreeMap<String, String>)>,
        counters: Arc<Counters>,
    ) -> Result<(Self, RecordInlet), MachineError> {
        let enabled = machine.record.enabled;
        let kept = if enabled { Kept::NotNow } else { Kept::No };
        let state = Arc::new(State { shelf: Shelf::default(), kept: Mutex::new((kept, None)) });
        let stopping = Arc::new(AtomicBool::new(false));
        let (messages, thread) = match enabled {
            false => (None, None),
            true => {
                let (sender, messages) = sync_channel(MESSAGES_QUEUED);
                let options = RingOptions {
                    folder: machine.record.directory.join(&machine.id),
                    machine: machine.id.clone(),
                    boot,
                    bytes_max: machine.record.size_max_mb.saturating_mul(1_000_000),
                    about,
                };
                let (state, counters) = (Arc::clone(&state), Arc::clone(&counters));
                let keeping = Keeping { options, state, counters, stopping: Arc::clone(&stopping) };
                let thread = spawn("keeper", move || keeping.run(&messages))?;
                (Some(sender), Some(thread))
            }
        };
        let (sender, questions) = sync_channel(QUESTIONS_QUEUED);
        let published = Topic::ALL.into_iter().filter(|topic| is_published(machine, *topic)).collect();
        let for_answers = Arc::clone(&state);
        let answerer = spawn("answerer", move || answer_all(&questions, &for_answers, published))?;
        let key = record_key(&machine.link.site, &machine.id, boot);
        let declared = session
            .declare_queryable(key.clone())
            .callback(move |query| {
                if let Err(full) = sender.try_send(query) {
                    let (std::sync::mpsc::TrySendError::Full(query)
                    | std::sync::mpsc::TrySendError::Disconnected(query)) = full;
                    refuse(&query, "busy");
                }
            })
            .await;
        let queryable = declared.map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })?;
        let machine = machine.id.clone();
        Ok((
            Self { thread, stopping, queryable, answerer },
            RecordInlet { machine, messages, state, counters },
        ))
    }

    /// Writes what is queued, closes the file, and ends; the inlet must be gone.
    pub(super) async fn stop(self) {
        let Self { thread, stopping, queryable, answerer } = self;
        if let Err(error) = queryable.undeclare().await {
            tracing::warn!(%error, "the queryable of the record could not be taken back");
        }
        stopping.store(true, Ordering::Release);
        let joined = tokio::task::spawn_blocking(move || {
            let kept = thread.is_none_or(|thread| thread.join().is_ok());
            answerer.join().is_ok() && kept
        });
        if !matches!(joined.await, Ok(true)) {
            tracing::error!("a thread of the on-board record has panicked");
        }
    }
}

fn spawn(name: &'static str, body: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, MachineError> {
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(body);
    thread.map_err(|source| MachineError::Thread { name, source })
}

/// The thread that writes.
struct Keeping {
    options: RingOptions,
    state: Arc<State>,
    counters: Arc<Counters>,
    stopping: Arc<AtomicBool>,
}

/// How large the ring may be: as configured, less where others need the room, and then by and by more again.
struct Bound {
    configured: u64,
    now: u64,
    /// Since when nothing has failed, or the last step was made.
    calm_since: Instant,
}

impl Bound {
    fn new(configured: u64, now: Instant) -> Self {
        Self { configured, now: configured, calm_since: now }
    }

    /// The disk is full while so much is held: an eighth of it goes.
    fn shrink(&mut self, held: u64, now: Instant) {
        self.now = (held - held / 8).max(BYTES_MIN).min(self.configured);
        self.calm_since = now;
    }

    /// True if the ring may be larger from now on.
    fn grow(&mut self, now: Instant) -> bool {
        let grows = self.now < self.configured && now.duration_since(self.calm_since) >= GROW_EVERY;
        if grows {
            self.now = (self.now + (self.now / 8).max(BYTES_MIN)).min(self.configured);
            self.calm_since = now;
        }
        grows
    }
}

impl Keeping {
    fn run(mut self, messages: &Receiver<Recorded<Vec<u8>>>) {
        // Not the system's clock, which somebody may set.
        let (origin, start) = (clock::wall(), Instant::now());
        let now = || origin + Span::from_nanos(i64::try_from(start.elapsed().as_nanos()).unwrap_or(i64::MAX));
        let mut bound = Bound::new(self.options.bytes_max, start);
        loop {
            self.options.bytes_max = bound.now;
            let outcome = Ring::open(self.options.clone(), self.state.shelf.clone(), now());
            let outcome = outcome.and_then(|ring| {
                tracing::info!(folder = %self.options.folder.display(), "on-board record");
                self.state.set(Kept::Yes, None);
                self.keep(ring, messages, &mut bound, now)
            });
            let Err(error) = outcome else { return };
            tracing::error!(%error, "no on-board record; tried again in {} s", RETRY_AFTER.as_secs());
            self.state.set(Kept::NotNow, Some(error.to_string()));
            let failed_at = Instant::now();
            if error.is_disk_full() {
                bound.shrink(self.state.shelf.bytes(), failed_at);
            }
            let retry_at = failed_at + RETRY_AFTER;
            // What comes meanwhile waits in the queue, as much as there is room for.
            while Instant::now() < retry_at {
                if self.stopping.load(Ordering::Acquire) {
                    return self.drop_messages(messages.try_iter().count() as u64);
                }
                std::thread::sleep(TURN);
            }
        }
    }

    /// Writes until nobody can send any more.
    fn keep(
        &self,
        mut ring: Ring,
        messages: &Receiver<Recorded<Vec<u8>>>,
        bound: &mut Bound,
        now: impl Fn() -> Stamp,
    ) -> Result<(), RecordError> {
        loop {
            let (done, is_last) = match messages.recv_timeout(TURN) {
                Ok(message) => (ring.write(&Recorded { received: now(), ..message }), false),
                Err(RecvTimeoutError::Timeout) => (ring.tick(now()), false),
                Err(RecvTimeoutError::Disconnected) => (ring.finish(), true),
            };
            if let Err(error) = done {
                self.drop_messages(ring.abandon());
                return Err(error);
            }
            if let Some(error) = ring.take_trouble() {
                tracing::error!(%error, "the on-board record is larger than it should be");
            }
            if is_last {
                return Ok(());
            }
            if bound.grow(Instant::now()) {
                ring.set_bytes_max(bound.now);
            }
        }
    }

    fn drop_messages(&self, count: u64) {
        self.counters.record_dropped.fetch_add(count, Ordering::Relaxed);
    }
}

fn answer_all(questions: &Receiver<Query>, state: &State, published: Vec<Topic>) {
    let mut reader = state.shelf.reader();
    while let Ok(query) = questions.recv() {
        let payload = query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
        let answer = match RecordRequest::decode(&payload) {
            Err(error) => Err(error.to_string()),
            Ok(RecordRequest::Holdings) => {
                let holdings = match state.get().0 {
                    Kept::Yes => {
                        reader.look_again();
                        state.shelf.holdings(|topic| published.contains(&topic))
                    }
                    kept => Holdings { kept, boots: vec![] },
                };
                encode_json("holdings", &holdings).map_err(|error| error.to_string())
            }
            Ok(RecordRequest::Messages { boot, mut wanted, bytes }) => {
                wanted.retain(|topic, _| published.contains(topic));
                match state.get().0 {
                    Kept::Yes => Ok(reader.batch(boot, &wanted, bytes.min(BATCH_BYTES_MAX)).encode()),
                    _ => Err("there is no on-board record now".to_owned()),
                }
            }
        };
        match answer {
            // With the question's priority, and dropped rather than waited for if the question says so.
            Ok(bytes) => {
                if let Err(error) = query.reply(query.key_expr().clone(), bytes).wait() {
                    tracing::debug!(%error, "a question about the record could not be answered");
                }
            }
            Err(reason) => refuse(&query, &reason),
        }
    }
}

fn refuse(query: &Query, reason: &str) {
    if let Err(error) = query.reply_err(reason).wait() {
        tracing::debug!(%error, "a question about the record could not be refused");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ring_that_a_full_disk_made_smaller_grows_again() {
        let begun = Instant::now();
        let mut bound = Bound::new(800_000_000, begun);
        let mut at = begun;
        assert!(!bound.grow(at + 2 * GROW_EVERY), "as large as it may be");
        // Full for as long as others write.
        let mut held = 800_000_000;
        for _ in 0..100 {
            at += RETRY_AFTER;
            bound.shrink(held, at);
            held = bound.now;
        }
        assert_eq!(bound.now, BYTES_MIN);
        assert!(!bound.grow(at + GROW_EVERY / 2));
        let mut steps = 0;
        while bound.now < bound.configured {
            at += GROW_EVERY;
            assert!(bound.grow(at));
            steps += 1;
        }
        assert!(bound.now == bound.configured && !bound.grow(at + GROW_EVERY) && steps < 100, "{steps}");
        // A disk that is full while little is held.
        bound.shrink(0, at);
        assert_eq!(bound.now, BYTES_MIN);
        let mut small = Bound::new(500_000, begun);
        small.shrink(500_000, begun);
        assert_eq!(small.now, 500_000);
    }
}
