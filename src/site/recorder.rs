//! The thread that owns the recording: everything that arrives goes to the disk, synced each second.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::watch;

use super::SiteError;
use super::catalogue::Catalogue;
use super::clock::SiteClock;
use super::counters::Counters;
use super::inlet::Inbound;
use crate::config;
use crate::record::{RecordError, RecordWriter, Recorded, recover};
use crate::time::{Span, Stamp};

/// Messages between the callbacks and the thread: some seconds of ten machines while the disk syncs. When it
/// is full, new messages are dropped and counted.
const MESSAGES_QUEUED: usize = 32_768;
/// How often the thread looks at the clock while nothing arrives.
const TURN: Duration = Duration::from_millis(100);
/// After a failure a new session is tried so much later, then after twice as long, and so on.
const RETRY_AFTER: Span = Span::from_millis(5_000);
/// But not later than so much.
const RETRY_AFTER_MAX: Span = Span::from_millis(300_000);

/// What the thread is asked.
#[derive(Debug)]
pub(super) enum Command {
    Write(Inbound),
    Finish,
}

/// How far the recording is.
#[derive(Clone, Debug, Default)]
pub(super) struct Progress {
    pub session: String,
    pub started: Stamp,
    pub messages: u64,
    /// So many bytes are on the disk, in whole chunks.
    pub synced_bytes: u64,
    /// Of all sessions since the start.
    pub total_bytes: u64,
    pub machines: Vec<String>,
    /// When the oldest message was received that may not be on the disk.
    pub unsynced_since: Option<Stamp>,
    /// Why nothing is recorded.
    pub failure: Option<String>,
    pub finished: bool,
}

/// The thread, and the door to it.
pub(super) struct Recorder {
    inbox: SyncSender<Command>,
    progress: watch::Receiver<Progress>,
    thread: JoinHandle<()>,
    /// Held until the end.
    _lock: File,
}

impl Recorder {
    /// Starts a session, and recovers earlier ones that were torn, on a thread of its own.
    pub fn start(
        config: &config::Site,
        catalogue: &Arc<Catalogue>,
        clock: SiteClock,
        counters: Arc<Counters>,
    ) -> Result<Self, SiteError> {
        let failed =
            |message: String| SiteError::Record { directory: config.record.directory.clone(), message };
        let lock = catalogue.lock().map_err(|error| failed(error.to_string()))?;
        let torn = catalogue.unfinished();
        let (progress_sender, progress) = watch::channel(Progress::default());
        let mut session = Session::new(config, Arc::clone(catalogue), clock, progress_sender);
        session.open(clock.now()).map_err(failed)?;
        let (inbox, commands) = sync_channel(MESSAGES_QUEUED);
        let spawn = |name: &str, body: Box<dyn FnOnce() + Send>| {
            std::thread::Builder::new().name(name.to_owned()).spawn(body)
        };
        let thread = spawn("recorder", Box::new(move || session.run(&commands, &counters)))
            .map_err(|error| failed(error.to_string()))?;
        if !torn.is_empty() {
            // Left alone: a recovery that is cut short is done again at the next start.
            spawn("recovery", Box::new(move || torn.iter().for_each(|path| recover_one(path))))
                .map_err(|error| failed(error.to_string()))?;
        }
        Ok(Self { inbox, progress, thread, _lock: lock })
    }

    pub fn inbox(&self) -> SyncSender<Command> {
        self.inbox.clone()
    }

    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.clone()
    }

    /// Writes what is queued, closes the file, and waits for that.
    pub fn finish(self) {
        if self.inbox.send(Command::Finish).is_err() || self.thread.join().is_err() {
            tracing::error!("the recorder ended before it was asked to");
        }
    }
}

fn recover_one(path: &Path) {
    match recover(path) {
        Ok(summary) => tracing::info!(
            "{}: {}, {} messages, {} bytes given up",
            path.display(),
            summary.state.name(),
            summary.messages,
            summary.lost_bytes
        ),
        Err(error) => tracing::error!("cannot be recovered: {error}"),
    }
}

/// The session that is written, and what it needs to start another one after a failure.
struct Session {
    catalogue: Arc<Catalogue>,
    clock: SiteClock,
    about_the_site: BTreeMap<String, String>,
    writer: Option<RecordWriter>,
    retry_at: Stamp,
    retry_after: Span,
    boots: BTreeSet<(Arc<str>, u64)>,
    progress: Progress,
    published: watch::Sender<Progress>,
    publish_at: Stamp,
    bytes_before: u64,
    dropped_told: u64,
}

impl Session {
    fn new(
        config: &config::Site,
        catalogue: Arc<Catalogue>,
        clock: SiteClock,
        published: watch::Sender<Progress>,
    ) -> Self {
        let world = &config.world;
        let about_the_site = [
            ("id", config.id.clone()),
            ("name", config.display_name().to_owned()),
            ("latitude_deg", world.latitude_deg.to_string()),
            ("longitude_deg", world.longitude_deg.to_string()),
            ("altitude_m", world.altitude_m.to_string()),
            ("software", env!("CARGO_PKG_VERSION").to_owned()),
        ];
        Self {
            catalogue,
            clock,
            about_the_site: about_the_site.map(|(key, value)| (key.to_owned(), value)).into(),
            writer: None,
            retry_at: Stamp::default(),
            retry_after: RETRY_AFTER,
            boots: BTreeSet::new(),
            progress: Progress::default(),
            published,
            publish_at: Stamp::default(),
            bytes_before: 0,
            dropped_told: 0,
        }
    }

    /// Starts a new session.
    fn open(&mut self, now: Stamp) -> Result<(), String> {
        let (id, path) = self.catalogue.create(now).map_err(|error| error.to_string())?;
        let mut writer = RecordWriter::create(&path).map_err(|error| {
            // Else each try on a full disk leaves another session behind; what is not empty stays.
            let _ = std::fs::remove_file(&path);
            let _ = path.parent().map(std::fs::remove_dir);
            error.to_string()
        })?;
        writer
            .write_metadata("holdfast.site", self.about_the_site.clone())
            .map_err(|error| error.to_string())?;
        self.bytes_before = self.progress.total_bytes;
        self.progress =
            Progress { session: id, started: now, total_bytes: self.bytes_before, ..Progress::default() };
        self.boots.clear();
        self.writer = Some(writer);
        tracing::info!("recording to {}", path.display());
        self.publish(now);
        Ok(())
    }

    fn run(mut self, commands: &Receiver<Command>, counters: &Counters) {
        loop {
            let outcome = match commands.recv_timeout(TURN) {
                Ok(Command::Write(inbound)) => self.write(&inbound),
                Err(RecvTimeoutError::Timeout) => self.tick(),
                Ok(Command::Finish) | Err(RecvTimeoutError::Disconnected) => break,
            };
            if let Err(error) = outcome {
                self.fail(error.to_string());
            }
            let now = self.clock.now();
            if self.writer.is_none()
                && now >= self.retry_at
                && let Err(message) = self.open(now)
            {
                self.fail(message);
            }
            if now >= self.publish_at {
                self.publish(now);
                self.tell_drops(super::counters::get(&counters.recorder_dropped));
            }
        }
        self.finish();
    }

    fn write(&mut self, inbound: &Inbound) -> Result<(), RecordError> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let boot = inbound.attachment.boot;
        if self.boots.insert((Arc::clone(&inbound.machine), boot.0)) {
            let entries = [("machine", inbound.machine.to_string()), ("boot", boot.to_string())];
            let entries = entries.map(|(key, value)| (key.to_owned(), value)).into();
            writer.write_metadata("holdfast.boot", entries)?;
        }
        writer.write(&Recorded {
            machine: inbound.machine.to_string(),
            topic: inbound.topic,
            boot: Some(boot),
            sequence: inbound.attachment.sequence,
            received: inbound.received,
            sent: inbound.attachment.sent,
            payload: &inbound.payload,
        })
    }

    fn tick(&mut self) -> Result<(), RecordError> {
        match &mut self.writer {
            Some(writer) => writer.tick(self.clock.now()),
            None => Ok(()),
        }
    }

    fn fail(&mut self, message: String) {
        let wait_s = self.retry_after.as_seconds();
        tracing::error!("nothing is recorded: {message}; tried again in {wait_s} s");
        // What reached the disk is recovered at the next start.
        self.writer = None;
        self.progress.failure = Some(message);
        let now = self.clock.now();
        self.retry_at = now + self.retry_after;
        self.retry_after = Span::from_nanos(2 * self.retry_after.as_nanos()).min(RETRY_AFTER_MAX);
        self.publish(now);
    }

    fn publish(&mut self, now: Stamp) {
        if let Some(writer) = &self.writer {
            if writer.messages() > 0 && writer.unsynced_since().is_none() {
                // Something reached the disk: the next failure is another one.
                self.retry_after = RETRY_AFTER;
            }
            self.progress.messages = writer.messages();
            self.progress.unsynced_since = writer.unsynced_since();
            if let Ok(bytes) = writer.bytes() {
                self.progress.synced_bytes = bytes;
                self.progress.total_bytes = self.bytes_before + bytes;
            }
            let machines: BTreeSet<&Arc<str>> = self.boots.iter().map(|(machine, _)| machine).collect();
            self.progress.machines = machines.into_iter().map(|machine| machine.to_string()).collect();
        }
        self.publish_at = now + Span::from_millis(200);
        self.published.send_replace(self.progress.clone());
    }

    fn tell_drops(&mut self, dropped: u64) {
        if dropped > self.dropped_told {
            tracing::warn!(
                "the disk does not keep up: {} messages not recorded",
                dropped - self.dropped_told
            );
            self.dropped_told = dropped;
        }
    }

    fn finish(mut self) {
        if let Some(writer) = self.writer.take() {
            let path = writer.path().to_owned();
            match writer.finish() {
                Ok(summary) => tracing::info!("{}: complete, {} messages", path.display(), summary.messages),
                Err(error) => tracing::error!("not closed, and recovered at the next start: {error}"),
            }
        }
        self.progress.finished = true;
        self.progress.unsynced_since = None;
        self.published.send_replace(self.progress);
    }
}
