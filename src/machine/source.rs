//! Where a machine's readings come from: drivers over Zenoh, the simulator, or a recording played again.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::{oneshot, watch};
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Locality, Sample};

use super::MachineError;
use super::clock::Clock;
use super::counters::Counters;
use super::outbox::Outlets;
use super::pipeline::Inlet;
use crate::config;
use crate::import::{self, ImportError};
use crate::link::{self, LinkError};
use crate::record::{self, RecordError};
use crate::sensors::{Arrival, Reading, Sensor};
use crate::simulate::{Scenario, Simulation};
use crate::state::{Event, EventKind, Severity};
use crate::time::{Span, Stamp};
use crate::wire::{Key, Topic, decode_reading, topic_key};

/// A played source begins so long after somebody listens: all sensors' subscriptions are known by then.
const LEAD: Span = Span::from_millis(200);
/// And waits so long for somebody who listens, so that nothing of it is missing in the site's recording.
const AUDIENCE_TIMEOUT: Duration = Duration::from_secs(5);
/// How often it looks for them.
const AUDIENCE_EVERY: Duration = Duration::from_millis(20);
/// A driver's useless messages are told at most so often.
const COMPLAIN_EVERY: Span = Span::from_millis(1000);

/// Where readings come from.
///
/// What is played or simulated is moved in time: its first reading arrives now, and all stamps and arrivals
/// keep their distances from there. So the fleet sees a machine that lives now.
pub enum Source {
    /// Drivers publish on the machine's own `sensor/...` keys.
    Zenoh,
    /// One machine of a scenario.
    Simulation {
        /// The scenario.
        scenario: Box<Scenario>,
        /// Which of its machines.
        index: usize,
    },
    /// A log folder, or an MCAP recording of ours.
    Play {
        /// Folder or file.
        path: PathBuf,
        /// Whose readings of a recording; the machine's own, or the only ones there are, if `None`.
        recorded_machine: Option<String>,
    },
}

/// Why a source cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The log folder.
    #[error(transparent)]
    Folder(#[from] ImportError),
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordError),
    /// The recording holds other machines only.
    #[error("{}: holds no readings of {wanted}, but of: {}", path.display(), found.join(", "))]
    NotRecorded {
        /// The recording.
        path: PathBuf,
        /// Whose readings were wanted.
        wanted: String,
        /// Whose there are.
        found: Vec<String>,
    },
    /// There is nothing to play.
    #[error("{}: holds no readings", path.display())]
    Empty {
        /// Folder or file.
        path: PathBuf,
    },
}

/// A source whose files have been read.
pub(super) enum Prepared {
    Zenoh,
    Played(Box<dyn Iterator<Item = Arrival> + Send>),
}

/// What a source shares with the rest of the peer.
pub(super) struct Surroundings {
    pub(super) outlets: Outlets,
    pub(super) clock: Clock,
    pub(super) counters: Arc<Counters>,
}

/// A source at work.
pub(super) enum Feed {
    Zenoh(Subscriber<()>),
    Played { thread: JoinHandle<()>, stop: SyncSender<()>, ended: oneshot::Receiver<()> },
}

impl Source {
    /// What all randomness of a simulation comes from.
    pub(super) fn seed(&self) -> Option<u64> {
        match self {
            Source::Simulation { scenario, .. } => Some(scenario.file.seed),
            Source::Zenoh | Source::Play { .. } => None,
        }
    }

    /// Reads what is to be played.
    pub(super) fn prepare(self, machine: &config::Machine) -> Result<Prepared, SourceError> {
        match self {
            Source::Zenoh => Ok(Prepared::Zenoh),
            Source::Simulation { scenario, index } => {
                Ok(Prepared::Played(Box::new(Simulation::new(&scenario, index))))
            }
            Source::Play { path, recorded_machine } => {
                let arrivals = if path.is_dir() {
                    import::read_log_folder(&path)?.arrivals
                } else {
                    recorded(&path, recorded_machine.as_deref(), &machine.id)?
                };
                if arrivals.is_empty() {
                    return Err(SourceError::Empty { path });
                }
                Ok(Prepared::Played(Box::new(arrivals.into_iter())))
            }
        }
    }
}

/// The readings of a recording; those that cannot be decoded are passed over with a word.
fn recorded(path: &Path, wanted: Option<&str>, own: &str) -> Result<Vec<Arrival>, SourceError> {
    let found = record::machines(path)?;
    let wanted = match (wanted, found.as_slice()) {
        (None, [only]) => only.as_str(),
        (wanted, _) => wanted.unwrap_or(own),
    };
    if !found.iter().any(|id| id == wanted) {
        let (path, wanted) = (path.to_owned(), wanted.to_owned());
        return Err(SourceError::NotRecorded { path, wanted, found });
    }
    let readings = record::read_arrivals([path], wanted, |_| ())?;
    if readings.lost_bytes() > 0 {
        tracing::warn!(path = %path.display(), bytes = readings.lost_bytes(), "a part of the recording is lost");
    }
    let mut unreadable = 0_u64;
    let arrivals = readings
        .filter_map(|arrival| {
            arrival
                .inspect_err(|error| {
                    unreadable += 1;
                    if unreadable == 1 {
                        tracing::warn!(%error, "a recorded reading is passed over");
                    }
                })
                .ok()
        })
        .collect();
    if unreadable > 1 {
        tracing::warn!(unreadable, "recorded readings were passed over");
    }
    Ok(arrivals)
}

impl Prepared {
    /// Whether its readings come by our own clock.
    pub(super) fn is_played(&self) -> bool {
        matches!(self, Prepared::Played(_))
    }

    /// Lets the readings flow.
    pub(super) async fn start(
        self,
        session: &zenoh::Session,
        machine: &config::Machine,
        inlet: Inlet,
        surroundings: Surroundings,
        audience: watch::Receiver<bool>,
    ) -> Result<Feed, MachineError> {
        let Surroundings { outlets, clock, counters } = surroundings;
        match self {
            Prepared::Zenoh => {
                let drivers = Drivers { inlet, outlets, clock, counters, complaints: Mutex::default() };
                Ok(Feed::Zenoh(subscribe(session, machine, drivers).await?))
            }
            Prepared::Played(arrivals) => {
                let (stop, stopped) = sync_channel(1);
                let (end, ended) = oneshot::channel();
                let play = move || {
                    if wait_for(&audience, &stopped) {
                        play(arrivals, &inlet, &clock, &stopped);
                    }
                    // Nobody need wait for the end.
                    let _ = end.send(());
                };
                let thread = std::thread::Builder::new().name("player".to_owned()).spawn(play);
                let thread = thread.map_err(|source| MachineError::Thread { name: "player", source })?;
                Ok(Feed::Played { thread, stop, ended })
            }
        }
    }
}

/// Waits until somebody listens, though not for ever: a machine works without its site. False if told to stop.
fn wait_for(audience: &watch::Receiver<bool>, stopped: &Receiver<()>) -> bool {
    let mut waited = Duration::ZERO;
    while !*audience.borrow() && waited < AUDIENCE_TIMEOUT {
        match stopped.recv_timeout(AUDIENCE_EVERY) {
            Err(RecvTimeoutError::Timeout) => waited += AUDIENCE_EVERY,
            Ok(()) | Err(RecvTimeoutError::Disconnected) => return false,
        }
    }
    true
}

/// Hands readings over when their time has come, until told to stop or the pipeline has ended.
fn play(arrivals: impl Iterator<Item = Arrival>, inlet: &Inlet, clock: &Clock, stopped: &Receiver<()>) {
    let start = clock.now() + LEAD;
    let mut shift = None;
    for arrival in arrivals {
        let shift = *shift.get_or_insert_with(|| start - arrival.arrival);
        let arrival = moved(&arrival, shift);
        match stopped.recv_timeout(clock.until(arrival.arrival)) {
            Err(RecvTimeoutError::Timeout) => {}
            Ok(()) | Err(RecvTimeoutError::Disconnected) => return,
        }
        if !inlet.hand_over(arrival) {
            return;
        }
    }
}

/// The reading as if everything had happened `shift` later.
fn moved(arrival: &Arrival, shift: Span) -> Arrival {
    let mut reading = arrival.reading;
    let stamp: &mut Stamp = match &mut reading {
        Reading::Imu(sample) | Reading::BaseImu(sample) => &mut sample.stamp,
        Reading::GnssLeft(fix) | Reading::GnssRight(fix) => &mut fix.stamp,
        Reading::LidarOdometry(pose) => &mut pose.stamp,
        Reading::CabinTurn(turn) => &mut turn.stamp,
    };
    *stamp += shift;
    Arrival { arrival: arrival.arrival + shift, reading }
}

/// Takes what drivers publish; called on Zenoh's threads, so it decodes, hands over, and never waits.
struct Drivers {
    inlet: Inlet,
    outlets: Outlets,
    clock: Clock,
    counters: Arc<Counters>,
    complaints: Mutex<BTreeMap<Sensor, Complaint>>,
}

/// When a sensor's useless messages were told last, and how many there were since.
#[derive(Default)]
struct Complaint {
    told: Option<Stamp>,
    count: u64,
}

async fn subscribe(
    session: &zenoh::Session,
    machine: &config::Machine,
    drivers: Drivers,
) -> Result<Subscriber<()>, LinkError> {
    let imu = topic_key(&machine.link.site, &machine.id, Topic::Sensor(Sensor::Imu));
    let key = imu.replace("/sensor/imu", "/sensor/*");
    let declared = session
        .declare_subscriber(key.clone())
        // What we publish ourselves under these keys must not come back.
        .allowed_origin(Locality::Remote)
        .callback(move |sample| drivers.take(&sample))
        .await;
    declared.map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })
}

impl Drivers {
    fn take(&self, sample: &Sample) {
        let now = self.clock.now();
        let Ok(Key::Topic { topic: Topic::Sensor(sensor), .. }) = Key::parse(sample.key_expr().as_str())
        else {
            self.counters.undecodable.fetch_add(1, Ordering::Relaxed);
            return;
        };
        match decode_reading(sensor, &sample.payload().to_bytes()) {
            Ok(reading) => self.inlet.offer(Arrival { arrival: now, reading }),
            Err(error) => {
                self.counters.undecodable.fetch_add(1, Ordering::Relaxed);
                self.complain(sensor, now, error.to_string());
            }
        }
    }

    fn complain(&self, sensor: Sensor, now: Stamp, reason: String) {
        let mut complaints = self.complaints.lock().unwrap_or_else(PoisonError::into_inner);
        let complaint = complaints.entry(sensor).or_default();
        complaint.count += 1;
        if complaint.told.is_none_or(|told| now - told >= COMPLAIN_EVERY) {
            let count = std::mem::take(&mut complaint.count);
            complaint.told = Some(now);
            let what = EventKind::Refused { sensor, reason, count };
            self.outlets.event(Event::new(now, Severity::Warning, what));
        }
    }
}

impl Feed {
    /// Waits until everything was played; for ever if readings are live.
    pub(super) async fn ended(&mut self) {
        match self {
            Feed::Zenoh(_) => std::future::pending().await,
            Feed::Played { ended, .. } => {
                // An error says that the thread is gone, which is an end as well.
                if !ended.is_terminated() {
                    let _ = ended.await;
                }
            }
        }
    }

    /// Ends the flow, and with it the inlet.
    pub(super) async fn stop(self) {
        match self {
            Feed::Zenoh(subscriber) => {
                if let Err(error) = subscriber.undeclare().await {
                    tracing::warn!(%error, "the subscription to the sensors could not be taken back");
                }
            }
            Feed::Played { thread, stop, .. } => {
                // Full or gone: it was told, or has ended by itself.
                let _ = stop.try_send(());
                if !matches!(tokio::task::spawn_blocking(move || thread.join()).await, Ok(Ok(()))) {
                    tracing::error!("the player's thread has panicked");
                }
            }
        }
    }
}
