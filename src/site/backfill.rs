//! Fetches from machines' on-board records what the recording lacks.
//!
//! The books ([`Ledger`]) are kept where messages are written: what the network, a full channel or a dead disk lost
//! on the way there is a gap, however it was lost, and what comes twice is written once. Connected machines are
//! asked what they hold; what the books lack of it is fetched in pieces, one after the other, with the lowest
//! priority and with pauses as long as the pieces took, and goes through the recorder's channel like everything
//! else. A piece that does not come, or is not written, is asked for again.
//!
//! The books are saved every few seconds as far as the disk has what they say. After a restart the files that were
//! written since are read again.

#![allow(clippy::disallowed_methods, reason = "what is asked for is waited for, by a clock that nobody sets")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::ConsolidationMode;

use super::aggregator::Frame;
use super::clock::SiteClock;
use super::ended;
use super::inlet::{Inbound, Message};
use super::sessions::{Command, Progress, RecordingState};
use crate::fleet::{self, Presence};
use crate::record::{Gap, GapCause, GapCounts, Ledger, Ranges, files_of, read_messages};
use crate::wire::{Batch, BootId, Holdings, RecordRequest, Topic, Wanted, encode_json, record_key};

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
/// An answer that takes longer is lost: dropped for want of room on the link.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);
/// A piece should take no longer: the next is smaller.
const PIECE_TIME: Duration = Duration::from_millis(400);
/// Size of the smallest piece, and of the first; the largest is what Zenoh queues at one priority, two batches, so
/// that it need not be dropped on a link that is busy for a moment.
const PIECE_BYTES: (u64, u64) = (8 * 1024, 64 * 1024);
const PIECE_BYTES_MAX: u64 = 128 * 1024;
/// Pauses between pieces are as long as the pieces took, within these.
const PAUSE: (Duration, Duration) = (Duration::from_millis(5), Duration::from_millis(500));
/// The recorder writes a piece in less, or does not write.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);
/// Machines that are asked at the same time.
const JOBS_MAX: usize = 4;
/// Ranges of a topic in one question.
const RANGES_ASKED: usize = 100;
/// The books are saved so often.
const SAVE_EVERY: Duration = Duration::from_secs(2);
/// Files that are so much older than the saved books are all in them.
const SAVE_MARGIN: Duration = Duration::from_secs(60);
/// Messages of a file that are put into the books at once.
const FOUND_AT_ONCE: usize = 1_000;

/// The books, shared between the recorder, who fills them, and the fetcher.
#[derive(Clone, Default)]
pub(super) struct Books(Arc<Mutex<Ledger>>);

impl Books {
    /// For a few steps at a time.
    pub fn lock(&self) -> MutexGuard<'_, Ledger> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// As they were saved; `None` if there are none that can be read.
    fn load(path: &Path) -> Option<(Self, SystemTime)> {
        let saved = std::fs::metadata(path).and_then(|about| about.modified()).ok()?;
        let text = std::fs::read(path).ok()?;
        match serde_json::from_slice(&text) {
            Ok(ledger) => Some((Self(Arc::new(Mutex::new(ledger))), saved)),
            Err(error) => {
                tracing::warn!("{}: {error}; the recordings are read instead", path.display());
                None
            }
        }
    }

    /// Takes in what a file has.
    fn read(&self, path: &Path, stopping: &AtomicBool) {
        let Ok(messages) = read_messages(path) else { return };
        let mut found = messages.map_while(Result::ok).filter_map(|message| {
            Some((message.machine, message.boot?, message.topic, message.sequence as u32))
        });
        loop {
            let some: Vec<_> = found.by_ref().take(FOUND_AT_ONCE).collect();
            if some.is_empty() || stopping.load(Ordering::Relaxed) {
                return;
            }
            let mut ledger = self.lock();
            for (machine, boot, topic, lower) in some {
                ledger.found(&machine, boot, topic, lower);
            }
        }
    }

    /// What was written since the last sync is lost, but for what was found in the file after its recovery.
    pub fn revoke(&self, recovered: Option<&Path>) {
        self.lock().revoke();
        if let Some(path) = recovered {
            self.read(path, &AtomicBool::new(false));
        }
    }
}

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

/// Books that were opened, before anybody writes.
pub(super) struct Opened {
    pub books: Books,
    saved: Option<SystemTime>,
    path: PathBuf,
    sessions: PathBuf,
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

/// Reads the books that are saved in `directory` about the recordings in `sessions`.
pub(super) fn open(directory: &Path, sessions: &Path) -> Opened {
    let path = directory.join("backfill.json");
    let (books, saved) = Books::load(&path).unzip();
    Opened { books: books.unwrap_or_default(), saved, path, sessions: sessions.to_owned() }
}

impl Backfill {
    /// Starts fetching, once the files that the saved books do not know are read.
    pub fn start(
        opened: Opened,
        outlets: Outlets,
        frames: watch::Receiver<Arc<Frame>>,
        stopped: watch::Receiver<bool>,
    ) -> Self {
        let Opened { books, saved, path, sessions } = opened;
        let fetching = Fetching {
            outlets: Arc::new(outlets),
            books: books.clone(),
            path: path.clone(),
            saved: Vec::new(),
            machines: BTreeMap::new(),
            jobs: JoinSet::new(),
        };
        let stopping = Arc::new(AtomicBool::new(false));
        let read = {
            let (books, stopping) = (books.clone(), Arc::clone(&stopping));
            move || read_files(&sessions, saved, &books, &stopping)
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

    /// Ends the fetching, and returns what was never fetched, for the recording to say so.
    pub async fn stop(self) -> (Vec<Gap>, Option<Saving>) {
        self.stopping.store(true, Ordering::Relaxed);
        self.task.abort();
        // An error says that it was ended.
        let _ = self.task.await;
        let gaps = self.books.lock().open_gaps();
        let saving = Saving { books: self.books, path: self.path };
        (gaps, self.read.load(Ordering::Relaxed).then_some(saving))
    }
}

/// The last thing to do, once the recorder has ended.
pub(super) struct Saving {
    books: Books,
    path: PathBuf,
}

impl Saving {
    pub fn save(self) {
        save(&self.books, &self.path, &mut Vec::new());
    }
}

/// Reads what was recorded since the books were saved; everything, if they were not.
fn read_files(sessions: &Path, saved: Option<SystemTime>, books: &Books, stopping: &AtomicBool) {
    let known_before = saved.and_then(|saved| saved.checked_sub(SAVE_MARGIN));
    let mut files: Vec<(SystemTime, PathBuf)> = Vec::new();
    let folders = std::fs::read_dir(sessions).into_iter().flatten().flatten().map(|entry| entry.path());
    for folder in folders.filter(|path| path.is_dir()) {
        for path in files_of(&folder).unwrap_or_default() {
            let modified = std::fs::metadata(&path).and_then(|about| about.modified());
            if let Ok(modified) = modified
                && known_before.is_none_or(|before| modified >= before)
            {
                files.push((modified, path));
            }
        }
    }
    files.sort();
    for (_, path) in files {
        books.read(&path, stopping);
    }
}

/// Saves the books if they have changed since `last`; in one step, so that there are always some.
fn save(books: &Books, path: &Path, last: &mut Vec<u8>) {
    let text = serde_json::to_vec(&*books.lock());
    let Ok(text) = text.inspect_err(|error| tracing::error!("the books have no JSON form: {error}")) else {
        return;
    };
    if text == *last {
        return;
    }
    let beside = path.with_extension("json.new");
    let written = std::fs::write(&beside, &text)
        .and_then(|()| std::fs::File::open(&beside)?.sync_all())
        .and_then(|()| std::fs::rename(&beside, path));
    match written {
        Ok(()) => *last = text,
        // The recordings say the same, only slower.
        Err(error) => tracing::warn!("{}: cannot be saved: {error}", path.display()),
    }
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

/// What became of a job.
struct Outcome {
    holdings: Option<(Instant, Holdings)>,
    piece_bytes: u64,
    result: Result<(), String>,
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
        loop {
            tokio::select! {
                () = ended(&mut stopped) => return,
                _ = looks.tick() => {}
            }
            let now = Instant::now();
            while let Some(done) = self.jobs.try_join_next() {
                match done {
                    Ok((machine, outcome)) => self.done(&machine, outcome, now),
                    Err(error) => tracing::error!("a fetching job has ended early: {error}"),
                }
            }
            let frame = Arc::clone(&frames.borrow());
            self.look(&frame, now);
            self.tell();
            if now >= save_at {
                save_at = now + SAVE_EVERY;
                // Some kilobytes; the disk is the recorder's, so that it must be quick anyway.
                tokio::task::block_in_place(|| save(&self.books, &self.path, &mut self.saved));
            }
        }
    }

    /// Starts what is due.
    fn look(&mut self, frame: &Frame, now: Instant) {
        let records = self.outlets.records();
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
            if !records || !connected || asked.busy || now < asked.due || self.jobs.len() >= JOBS_MAX {
                continue;
            }
            asked.busy = true;
            let job = Job {
                outlets: Arc::clone(&self.outlets),
                books: self.books.clone(),
                machine: view.id.as_str().into(),
                before: asked.before(now),
                piece_bytes: asked.piece_bytes,
                left: Arc::clone(&asked.left),
            };
            let id = view.id.clone();
            self.jobs.spawn(async move { (id, job.run().await) });
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
        let ledger = self.books.lock();
        for (id, asked) in &mut self.machines {
            let mut counts = ledger.counts(id);
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

/// One machine is asked what it holds, and for what is missing.
struct Job {
    outlets: Arc<Outlets>,
    books: Books,
    machine: Arc<str>,
    before: Option<Holdings>,
    piece_bytes: u64,
    left: Arc<AtomicU64>,
}

impl Job {
    async fn run(mut self) -> Outcome {
        let at = Instant::now();
        let mut holdings = None;
        let result = match self.ask(&RecordRequest::Holdings).await {
            Err(reason) => Err(reason),
            Ok(bytes) => match Holdings::decode(&bytes) {
                Err(error) => Err(error.to_string()),
                Ok(held) => {
                    let fetched = self.fetch(&held).await;
                    holdings = Some((at, held));
                    fetched
                }
            },
        };
        Outcome { holdings, piece_bytes: self.piece_bytes, result }
    }

    async fn fetch(&mut self, holdings: &Holdings) -> Result<(), String> {
        let plan = self.books.lock().plan(&self.machine, holdings, self.before.as_ref());
        let mut left = plan.count();
        self.left.store(left, Ordering::Relaxed);
        self.note(&plan.lost);
        // What is young is missed most.
        for (boot, mut wanted) in plan.wanted.into_iter().rev() {
            while !wanted.is_empty() {
                let begun = Instant::now();
                let Some(count) = self.piece(boot, &mut wanted, begun).await? else { break };
                left = left.saturating_sub(count);
                self.left.store(left, Ordering::Relaxed);
            }
        }
        self.left.store(0, Ordering::Relaxed);
        Ok(())
    }

    /// Fetches a piece and takes it off `wanted`; says how many messages that were, `None` if there are none now.
    async fn piece(
        &mut self,
        boot: BootId,
        wanted: &mut Wanted,
        begun: Instant,
    ) -> Result<Option<u64>, String> {
        self.must_record()?;
        let some =
            |(topic, ranges): (&Topic, &Vec<_>)| (*topic, ranges[..ranges.len().min(RANGES_ASKED)].to_vec());
        let asked: Wanted = wanted.iter().map(some).collect();
        let request = RecordRequest::Messages { boot, wanted: asked.clone(), bytes: self.piece_bytes };
        let answer = self.ask(&request).await;
        let took = begun.elapsed();
        self.piece_bytes = match (&answer, took <= PIECE_TIME) {
            (Ok(_), true) => (self.piece_bytes * 2).min(PIECE_BYTES_MAX),
            _ => (self.piece_bytes / 2).max(PIECE_BYTES.0),
        };
        let mut batch = Batch::decode(&answer?).map_err(|error| error.to_string())?;
        batch.messages.retain(|(topic, attachment, _)| {
            let ranges = asked.get(topic).map_or(&[][..], Vec::as_slice);
            attachment.boot == boot
                && ranges.iter().any(|[first, last]| (*first..=*last).contains(&attachment.sequence))
        });
        let mut numbers: BTreeMap<Topic, Ranges> = BTreeMap::new();
        for (topic, attachment, _) in &batch.messages {
            numbers.entry(*topic).or_default().insert(attachment.sequence);
        }
        let count = batch.messages.len() as u64;
        let missing = self.books.lock().count_missing(&self.machine, boot, &numbers);
        for (topic, attachment, payload) in batch.messages {
            let machine = Arc::clone(&self.machine);
            let received = self.outlets.clock.now();
            let inbound = Inbound { machine, topic, payload: payload.into(), attachment, received };
            self.hand_over(Command::Fetched(inbound)).await?;
        }
        self.written(boot, &numbers).await?;
        let mut moved = count > 0;
        {
            let mut ledger = self.books.lock();
            ledger.filled(&self.machine, missing);
            let mut gaps = Vec::new();
            for (topic, ranges) in &asked {
                let done = batch.done.get(topic).copied().unwrap_or(0);
                let mut answered = Ranges::default();
                for [first, last] in ranges {
                    answered.insert_range(*first..(last + 1).min(done.max(*first)));
                }
                moved |= !answered.is_empty();
                let lost = ledger.lose(&self.machine, boot, *topic, &answered, GapCause::NotOnBoard);
                gaps.extend(lost);
                take_off(wanted, *topic, done, numbers.get(topic));
            }
            drop(ledger);
            self.note(&gaps);
        }
        if !moved {
            return Ok(None);
        }
        tokio::time::sleep(took.clamp(PAUSE.0, PAUSE.1)).await;
        Ok(Some(count))
    }

    /// What nobody writes need not be fetched.
    fn must_record(&self) -> Result<(), String> {
        if self.outlets.records() { Ok(()) } else { Err("nothing is recorded now".to_owned()) }
    }

    /// Waits until the recorder has written a piece, so that never more than one is in its channel.
    async fn written(&self, boot: BootId, numbers: &BTreeMap<Topic, Ranges>) -> Result<(), String> {
        let begun = Instant::now();
        while self.books.lock().count_missing(&self.machine, boot, numbers) > 0 {
            self.must_record()?;
            if begun.elapsed() > WRITE_TIMEOUT {
                return Err("the recorder does not write".to_owned());
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        Ok(())
    }

    async fn hand_over(&self, mut command: Command) -> Result<(), String> {
        let begun = Instant::now();
        loop {
            command = match self.outlets.recorder.try_send(command) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Disconnected(_)) => return Err("the recorder has ended".to_owned()),
                Err(TrySendError::Full(command)) => command,
            };
            if begun.elapsed() > WRITE_TIMEOUT {
                return Err("the recorder does not keep up".to_owned());
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Tells the recording what will never be in it.
    fn note(&self, gaps: &[Gap]) {
        for gap in gaps {
            tracing::warn!(
                "machine {}, boot {}: {} {} to {} are lost: {}",
                gap.machine,
                gap.boot,
                gap.topic,
                gap.range.start,
                gap.range.end.saturating_sub(1),
                gap.cause.name()
            );
            if self.outlets.recorder.try_send(note(gap)).is_err() {
                tracing::warn!("the recording does not tell of it: its channel is full");
            }
        }
    }

    async fn ask(&self, request: &RecordRequest) -> Result<Vec<u8>, String> {
        let payload = encode_json("question", request).map_err(|error| error.to_string())?;
        let key = record_key(&self.outlets.site, &self.machine);
        let answers = self
            .outlets
            .session
            .get(key)
            .payload(payload)
            // The answer comes as the question goes: last of all, and dropped rather than in the way.
            .priority(Priority::Background)
            .congestion_control(CongestionControl::Drop)
            .consolidation(ConsolidationMode::None)
            .timeout(ANSWER_TIMEOUT)
            .await
            .map_err(|error| error.to_string())?;
        match answers.recv_async().await {
            Err(_) => Err("no answer".to_owned()),
            Ok(answer) => match answer.into_result() {
                Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
                Err(refused) => Err(String::from_utf8_lossy(&refused.payload().to_bytes()).into_owned()),
            },
        }
    }
}

/// The recorder is to say of a gap what it is.
pub(super) fn note(gap: &Gap) -> Command {
    Command::Note { name: Gap::NAME, entries: gap.entries() }
}

/// Takes off what is below `done`, and what has come.
fn take_off(wanted: &mut Wanted, topic: Topic, done: u64, come: Option<&Ranges>) {
    let Some(ranges) = wanted.get_mut(&topic) else { return };
    let mut left = Ranges::default();
    ranges.iter().for_each(|[first, last]| left.insert_range((*first).max(done)..last + 1));
    if let Some(come) = come {
        left = left.without(come);
    }
    *ranges = left.iter().map(|range| [range.start, range.end - 1]).collect();
    if ranges.is_empty() {
        wanted.remove(&topic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_answered_is_taken_off() {
        let mut wanted: Wanted = [(Topic::Pose, vec![[3, 9], [20, 30]]), (Topic::Odom, vec![[0, 1]])].into();
        let come = Ranges::from(vec![(25, 27)]);
        take_off(&mut wanted, Topic::Pose, 8, Some(&come));
        assert_eq!(wanted[&Topic::Pose], [[8, 9], [20, 24], [27, 30]]);
        take_off(&mut wanted, Topic::Pose, 31, None);
        take_off(&mut wanted, Topic::Event, 31, None);
        assert_eq!(wanted, [(Topic::Odom, vec![[0, 1]])].into());
    }

    #[test]
    fn books_are_saved_and_read_and_what_is_none_is_not() {
        let folder = std::env::temp_dir().join(format!("holdfast-books-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("folder");
        let path = folder.join("backfill.json");
        let open = || super::open(&folder, &folder);
        let opened = open();
        assert!(opened.saved.is_none());
        opened.books.lock().admit("a", BootId(1), Topic::Pose, 5);
        save(&opened.books, &path, &mut Vec::new());
        assert!(open().books.lock().admit("a", BootId(1), Topic::Pose, 5), "not on the disk");
        opened.books.lock().synced();
        save(&opened.books, &path, &mut Vec::new());
        let again = open();
        assert!(again.saved.is_some() && !again.books.lock().admit("a", BootId(1), Topic::Pose, 5));
        std::fs::write(&path, b"{").expect("damage");
        assert!(open().saved.is_none());
        std::fs::remove_dir_all(folder).expect("removed");
    }
}
