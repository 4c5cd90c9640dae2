//! The thread that owns the recording: everything that arrives goes to the disk, synced each second.
//!
//! ```text
//!                 start, next day or shift
//!      stopped ──────────────────────────▶ recording ──────▶ paused
//!         ▲                                 │     ▲   no room, │
//!         └──────────── stop ───────────────┘     │   failure  │
//!         └──────────────────────── stop ─────────┼────────────┤
//!                                                 └────────────┘  room again, tried again
//! ```
//! A pause does not end the session: it goes on in another file. Nothing is deleted to make room.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::{oneshot, watch};

use super::catalogue::Catalogue;
use super::folder::{Folder, Notes};
use super::housekeeping::Housekeeping;
use super::retention::Retention;
use super::running::{Progress, Rolling, Running};
use super::schedule::Schedule;
use super::space::{Ballast, Reserve, disk_free_bytes};
use super::view::RecordingState;
use crate::config;
use crate::record::{RecordError, says_full};
use crate::site::SiteError;
use crate::site::backfill::Books;
use crate::site::clock::SiteClock;
use crate::site::counters::{Counters, get};
use crate::site::inlet::Inbound;
use crate::time::{Span, Stamp};
use crate::wire::Attachment;

/// Messages between the callbacks and the thread: five seconds of twenty machines with everything, while the
/// disk syncs. When it is full, new messages are dropped and counted.
const MESSAGES_QUEUED: usize = 65_536;
/// How often the thread looks at the clock while nothing arrives.
const TURN: Duration = Duration::from_millis(100);
/// How often it looks at the file, the calendar and the disk.
const LOOK_EVERY: Span = Span::from_millis(200);
/// After a failure it tries again so much later, then after twice as long, and so on,
const RETRY_AFTER: Span = Span::from_millis(5_000);
/// but not later than so much.
const RETRY_AFTER_MAX: Span = Span::from_millis(300_000);

/// What came of a command: the id of the session that it was about.
pub(in crate::site) type Answer = Result<String, Refusal>;

/// Why a command is not followed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::site) enum Refusal {
    /// It does not fit what the recorder does.
    NotNow(String),
    /// There is no room on the disk.
    NoRoom(String),
    /// The disk does not let us.
    Failed(String),
}

/// What the thread is asked.
#[derive(Debug)]
pub(in crate::site) enum Command {
    /// A message that came by itself.
    Write(Inbound),
    /// A message that was fetched because a recording lacks it. It still does if nothing is recorded now.
    Fetched(Inbound),
    /// Another session, now; the one that runs ends with the last message before.
    Start {
        notes: Notes,
        answer: oneshot::Sender<Answer>,
    },
    /// The session of that id ends, and nothing is recorded until the next one begins.
    Stop {
        id: String,
        answer: oneshot::Sender<Answer>,
    },
    Finish,
}

/// The threads, and the door to them.
pub(in crate::site) struct Recorder {
    inbox: SyncSender<Command>,
    progress: watch::Receiver<Progress>,
    catalogue: Arc<Catalogue>,
    thread: JoinHandle<()>,
    housekeeping: Housekeeping,
    /// Held until the end, by housekeeping too.
    _lock: Arc<File>,
}

impl Recorder {
    /// Starts a session, and recovers earlier ones that were torn, on threads of their own.
    pub fn start(
        config: &config::Site,
        folder: PathBuf,
        clock: SiteClock,
        counters: Arc<Counters>,
        books: Books,
    ) -> Result<Self, SiteError> {
        let failed =
            |message: String| SiteError::Record { directory: config.record.directory.clone(), message };
        let folder = Folder::new(folder);
        let lock = Arc::new(folder.lock().map_err(|error| failed(error.to_string()))?);
        let catalogue = Arc::new(Catalogue::open(folder).map_err(|error| failed(error.to_string()))?);
        let (progress_sender, progress) = watch::channel(Progress::default());
        let mut desk = Desk::new(config, Arc::clone(&catalogue), clock, progress_sender, books)?;
        let now = clock.now();
        if let Err(error) = desk.begin(&Notes::default(), now) {
            // A full disk may have room again; what else is wrong now is wrong with the site file.
            if !error.is_disk_full() {
                return Err(failed(error.to_string()));
            }
            desk.pause(&error);
        }
        desk.look(now);
        let (inbox, commands) = sync_channel(MESSAGES_QUEUED);
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || desk.run(&commands, &counters))
            .map_err(|error| failed(error.to_string()))?;
        let housekeeping = Housekeeping::start(
            Arc::clone(&catalogue),
            Arc::clone(&lock),
            Retention::of(&config.record),
            clock,
        )
        .map_err(|error| failed(error.to_string()))?;
        Ok(Self { inbox, progress, catalogue, thread, housekeeping, _lock: lock })
    }

    /// Where messages and wishes go in.
    pub fn inbox(&self) -> SyncSender<Command> {
        self.inbox.clone()
    }

    /// How far it is, and whether it is paused: to be watched.
    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.clone()
    }

    /// What there is.
    pub fn catalogue(&self) -> Arc<Catalogue> {
        Arc::clone(&self.catalogue)
    }

    /// Writes what is queued, closes the file, and waits for that.
    pub fn finish(self) {
        if self.inbox.send(Command::Finish).is_err() || self.thread.join().is_err() {
            tracing::error!("the recorder ended before it was asked to");
        }
        self.housekeeping.finish();
    }
}

/// What the thread has before it.
struct Desk {
    catalogue: Arc<Catalogue>,
    clock: SiteClock,
    about_the_site: Arc<BTreeMap<String, String>>,
    rolling: Rolling,
    reserve: Reserve,
    ballast: Ballast,
    schedule: Schedule,
    session: Option<Running>,
    /// As far as it does not change with each message.
    progress: Progress,
    published: watch::Sender<Progress>,
    /// What is in the recordings.
    books: Books,
    look_at: Stamp,
    retry_at: Stamp,
    retry_after: Span,
    /// Whether it is paused for want of room, so that the disk says when to go on.
    wants_room: bool,
    /// Of the sessions that have ended since the start.
    ended_bytes: u64,
    dropped_told: u64,
}

impl Desk {
    fn new(
        config: &config::Site,
        catalogue: Arc<Catalogue>,
        clock: SiteClock,
        published: watch::Sender<Progress>,
        books: Books,
    ) -> Result<Self, SiteError> {
        let world = &config.world;
        let about_the_site = [
            ("id", config.id.clone()),
            ("name", config.display_name().to_owned()),
            ("time_zone", config.time_zone.clone()),
            ("latitude_deg", world.latitude_deg.to_string()),
            ("longitude_deg", world.longitude_deg.to_string()),
            ("altitude_m", world.altitude_m.to_string()),
            ("software", env!("CARGO_PKG_VERSION").to_owned()),
        ];
        let record = &config.record;
        let ballast = Ballast::new(catalogue.folder().path());
        Ok(Self {
            catalogue,
            clock,
            about_the_site: Arc::new(about_the_site.map(|(key, value)| (key.to_owned(), value)).into()),
            rolling: Rolling {
                bytes: (record.file_max_mb * 1e6) as u64,
                age: Span::from_seconds(record.file_max_min * 60.0),
            },
            reserve: Reserve::of_megabytes(record.reserve_mb),
            ballast,
            schedule: Schedule::of(config)?,
            session: None,
            progress: Progress::default(),
            published,
            books,
            look_at: Stamp::default(),
            retry_at: Stamp::default(),
            retry_after: RETRY_AFTER,
            wants_room: false,
            ended_bytes: 0,
            dropped_told: 0,
        })
    }

    fn run(mut self, commands: &Receiver<Command>, counters: &Counters) {
        loop {
            match commands.recv_timeout(TURN) {
                Ok(Command::Write(inbound)) => {
                    if !self.write(&inbound) {
                        self.do_without(&inbound);
                    }
                }
                Ok(Command::Fetched(inbound)) => {
                    self.write(&inbound);
                }
                Ok(Command::Start { notes, answer }) => {
                    let started = self.start(&notes);
                    // Whoever asked may be gone.
                    let _ = answer.send(started);
                }
                Ok(Command::Stop { id, answer }) => {
                    let stopped = self.stop(&id);
                    let _ = answer.send(stopped);
                }
                Err(RecvTimeoutError::Timeout) => self.tick(),
                Ok(Command::Finish) | Err(RecvTimeoutError::Disconnected) => break,
            }
            let now = self.clock.now();
            if now >= self.look_at {
                self.look(now);
                self.tell_drops(get(&counters.recorder_dropped));
            }
        }
        self.end_session();
        self.ballast.release();
        self.progress.state = RecordingState::Stopped;
        self.progress.why = Some("the server ends".to_owned());
        self.publish();
    }

    /// False if nothing is recorded now.
    fn write(&mut self, inbound: &Inbound) -> bool {
        let Some(session) = self.session.as_mut().filter(|session| session.is_open()) else { return false };
        if let Err(error) = session.write(inbound) {
            self.pause(&error);
        }
        true
    }

    fn do_without(&mut self, inbound: &Inbound) {
        if self.progress.state == RecordingState::Paused {
            // It is fetched from the machine when the recording goes on.
            self.progress.missed += 1;
        } else {
            // Nobody wants it, later neither.
            let Attachment { boot, sequence, .. } = inbound.attachment;
            self.books.lock().pass(&inbound.machine, boot, inbound.topic, sequence);
        }
    }

    fn tick(&mut self) {
        let now = self.clock.now();
        if let Some(Err(error)) = self.session.as_mut().map(|session| session.tick(now)) {
            self.pause(&error);
        }
    }

    /// What is to be done some times a second.
    fn look(&mut self, now: Stamp) {
        self.look_at = now + LOOK_EVERY;
        if self.progress.next_session.is_some_and(|next| now >= next) {
            self.next_session(now);
        }
        if let Some(Err(error)) = self.session.as_mut().map(|session| session.roll(self.rolling, now)) {
            self.pause(&error);
        }
        if let Some(Err(error)) = self.session.as_mut().map(Running::tell_lost) {
            self.pause(&error);
        }
        if self.session.as_ref().is_some_and(Running::is_full) {
            tracing::warn!("the session has as many channels as a recording can have: another one begins");
            self.next_session(now);
        }
        let free_bytes = disk_free_bytes(self.catalogue.folder().path());
        let is_touched = free_bytes.is_some_and(|free| self.reserve.is_touched(free));
        let is_restored = free_bytes.is_none_or(|free| self.reserve.is_restored(free));
        match self.progress.state {
            RecordingState::Recording if is_touched => self.pause_for_room(free_bytes.unwrap_or(0)),
            RecordingState::Paused if now >= self.retry_at && (is_restored || !self.wants_room) => {
                self.go_on(now);
            }
            _ => {}
        }
        self.publish();
    }

    /// A day or a shift begins: so does a session, whatever was before.
    fn next_session(&mut self, now: Stamp) {
        let was_paused = self.progress.state == RecordingState::Paused;
        self.end_session();
        self.progress.next_session = self.schedule.next(now);
        if was_paused {
            // It begins when it can.
            return;
        }
        if let Err(error) = self.begin(&Notes::default(), now) {
            self.pause(&error);
        }
    }

    /// Begins a session.
    fn begin(&mut self, notes: &Notes, now: Stamp) -> Result<(), RecordError> {
        self.progress.next_session = self.schedule.next(now);
        self.take_room()?;
        self.session = Some(Running::begin(&self.catalogue, &self.about_the_site, &self.books, notes, now)?);
        self.recording();
        Ok(())
    }

    /// Whether there is room enough for another file.
    fn take_room(&self) -> Result<(), RecordError> {
        let path = self.catalogue.folder().path();
        let no_room = |source| RecordError::File { path: path.to_owned(), what: "has no room", source };
        if disk_free_bytes(path).is_some_and(|free| self.reserve.is_touched(free)) {
            return Err(no_room(ErrorKind::StorageFull.into()));
        }
        if let Err(error) = self.ballast.take()
            && says_full(&error)
        {
            return Err(no_room(error));
        }
        Ok(())
    }

    fn recording(&mut self) {
        self.progress.state = RecordingState::Recording;
        self.progress.why = None;
        self.wants_room = false;
    }

    fn end_session(&mut self) {
        if let Some(session) = self.session.take() {
            self.ended_bytes += session.end(&self.ballast);
        }
    }

    /// After a failure: makes a proper file of what is on the disk, and tries again later.
    fn pause(&mut self, error: &RecordError) {
        if let Some(session) = &mut self.session {
            session.give_up(error, &self.ballast);
        }
        self.wants_room = error.is_disk_full();
        let why = match self.wants_room {
            true => format!("the disk is full: {error}"),
            false => error.to_string(),
        };
        let now = self.clock.now();
        self.retry_at = now + self.retry_after;
        tracing::error!("recording is paused: {why}; tried again in {} s", self.retry_after.as_seconds());
        self.retry_after = Span::from_nanos(2 * self.retry_after.as_nanos()).min(RETRY_AFTER_MAX);
        self.progress.state = RecordingState::Paused;
        self.progress.why = Some(why);
        self.publish();
    }

    /// While there still is enough to close the file.
    fn pause_for_room(&mut self, free_bytes: u64) {
        let closed = self.session.as_mut().map_or(Ok(()), Running::close);
        if let Err(error) = closed {
            return self.pause(&error);
        }
        let why = format!("the disk is nearly full: {} MB are left", free_bytes / 1_000_000);
        tracing::error!("recording is paused: {why}");
        self.progress.state = RecordingState::Paused;
        self.progress.why = Some(why);
        self.wants_room = true;
        self.retry_at = Stamp::default();
    }

    /// Goes on after a pause: in the same session, unless somebody took it away.
    fn go_on(&mut self, now: Stamp) {
        if self.session.as_ref().is_some_and(|session| !session.exists()) {
            self.end_session();
        }
        let begun = self.take_room().and_then(|()| match &mut self.session {
            None => self.begin(&Notes::default(), now),
            Some(session) => session.open(now),
        });
        match begun {
            Err(error) => self.pause(&error),
            Ok(()) => {
                self.recording();
                tracing::info!("recording goes on");
            }
        }
    }

    fn start(&mut self, notes: &Notes) -> Answer {
        let now = self.clock.now();
        if self.progress.state == RecordingState::Paused {
            let why = self.progress.why.clone().unwrap_or_default();
            let refusal = if self.wants_room { Refusal::NoRoom } else { Refusal::Failed };
            return Err(refusal(format!("recording is paused: {why}")));
        }
        self.end_session();
        match self.begin(notes, now) {
            Ok(()) => {
                self.publish();
                Ok(self.progress.session.clone().unwrap_or_default())
            }
            Err(error) => {
                self.pause(&error);
                let refusal = if self.wants_room { Refusal::NoRoom } else { Refusal::Failed };
                Err(refusal(error.to_string()))
            }
        }
    }

    fn stop(&mut self, id: &str) -> Answer {
        if self.session.as_ref().is_none_or(|session| session.id != id) {
            return Err(Refusal::NotNow(format!("the session \"{id}\" does not run")));
        }
        self.end_session();
        self.progress.state = RecordingState::Stopped;
        self.progress.why = Some("somebody stopped it".to_owned());
        tracing::info!("recording is stopped");
        self.publish();
        Ok(id.to_owned())
    }

    fn publish(&mut self) {
        let progress = &mut self.progress;
        (progress.session, progress.open_file, progress.unsynced_since) = (None, None, None);
        (progress.file_messages, progress.file_span, progress.synced_bytes) = (0, None, 0);
        progress.machines.clear();
        progress.total_bytes = self.ended_bytes;
        if let Some(session) = &self.session {
            session.tell(progress);
            if progress.file_messages > 0 && progress.unsynced_since.is_none() {
                // Something reached the disk: the next failure is another one.
                self.retry_after = RETRY_AFTER;
            }
        }
        self.published.send_replace(progress.clone());
    }

    fn tell_drops(&mut self, dropped: u64) {
        if dropped > self.dropped_told {
            let more = dropped - self.dropped_told;
            tracing::warn!("the disk does not keep up: {more} messages not recorded");
            self.dropped_told = dropped;
        }
    }
}
