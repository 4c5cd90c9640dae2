//! Puts what the machine knows into words, numbers it, and hands it to the on-board record and to the network.
//!
//! Numbers count what the machine said, not what went out: what the network has no room for is in the record.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;

use super::clock::Clock;
use super::configuration;
use super::counters::Counters;
use super::keeper::RecordInlet;
use super::sender::{Packet, Sender};
use crate::config;
use crate::frames::{Cabin, Imu, Odom, Pose, World};
use crate::link::LinkError;
use crate::replay::Times;
use crate::sensors::Arrival;
use crate::state::{Estimate, Event, GnssState, Health, Mode, Takeover};
use crate::time::{Span, Stamp};
use crate::wire::{
    Attachment, BootId, JournalPage, Latency, MachineReport, PAGE_READINGS_MAX, RigidMotion, RosMessage,
    Topic, encode_json, encode_reading, odom_message, pose_message,
};

/// Estimates and readings on the way out: half a minute of them, for they are not in the record yet. What waits
/// takes room, the queue itself does not. Full, it refuses.
const STREAM_QUEUE: usize = 16_384;
/// Events on the way out. Full, it refuses.
const EVENT_QUEUE: usize = 256;
/// Health goes out at least so often.
const HEALTH_PERIOD: Duration = Duration::from_secs(1);

/// The task that puts into words and numbers, and the one that sends.
pub(super) struct Outbox {
    task: JoinHandle<BTreeMap<Topic, u64>>,
    sender: Sender,
}

/// Where the threads leave what is to be published; nothing in here waits. The task ends when the last one is
/// dropped.
#[derive(Clone)]
pub(super) struct Outlets {
    stream: mpsc::Sender<Outgoing>,
    events: mpsc::Sender<Event>,
    health: watch::Sender<Option<Health>>,
    counters: Arc<Counters>,
}

/// In the order in which the predictor met it.
#[expect(clippy::large_enum_variant, reason = "an estimate a sample is moved, not allocated")]
enum Outgoing {
    Estimate(Estimate),
    /// With its number, and whether the updater gets it, too.
    Reading {
        number: u64,
        arrival: Arrival,
        seen: bool,
    },
    /// With its number.
    Takeover {
        number: u64,
        takeover: Takeover,
    },
}

impl Outlets {
    pub(super) fn estimate(&self, estimate: Estimate) {
        self.count(self.stream.try_send(Outgoing::Estimate(estimate)).is_ok());
    }

    pub(super) fn reading(&self, number: u64, arrival: Arrival, seen: bool) {
        self.count(self.stream.try_send(Outgoing::Reading { number, arrival, seen }).is_ok());
    }

    pub(super) fn takeover(&self, number: u64, takeover: Takeover) {
        self.count(self.stream.try_send(Outgoing::Takeover { number, takeover }).is_ok());
    }

    pub(super) fn event(&self, event: Event) {
        self.count(self.events.try_send(event).is_ok());
    }

    /// The newest replaces what was not taken yet.
    pub(super) fn health(&self, health: Health) {
        self.health.send_replace(Some(health));
    }

    fn count(&self, taken: bool) {
        if !taken {
            self.counters.output_dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Outbox {
    /// Declares the publishers and starts the tasks.
    pub(super) async fn start(
        session: &zenoh::Session,
        machine: &config::Machine,
        boot: BootId,
        clock: Clock,
        counters: Arc<Counters>,
        record: RecordInlet,
    ) -> Result<(Self, Outlets), LinkError> {
        let (sender, network) = Sender::start(session, machine).await?;
        let (stream, stream_receiver) = mpsc::channel(STREAM_QUEUE);
        let (events, events_receiver) = mpsc::channel(EVENT_QUEUE);
        let (health, health_receiver) = watch::channel(None);
        let cabin_from_imu: Pose<Cabin, Imu> = machine.frames.cabin_from_imu.pose();
        let task = Publishing {
            numbers: BTreeMap::new(),
            published: Topic::ALL.into_iter().filter(|topic| is_published(machine, *topic)).collect(),
            record,
            network,
            boot,
            clock,
            counters: Arc::clone(&counters),
            pace: Pace::new(machine.publish.pose_rate_hz, machine.imu.update_rate),
            identity: Identity {
                id: machine.id.clone(),
                name: machine.display_name().to_owned(),
                world: machine.world.site_frame().origin(),
                cabin_from_imu: RigidMotion::from(&cabin_from_imu),
            },
            newest: None,
            told: None,
            losses_told: [0; Counters::LOSSES],
            prediction: None,
            predictions_told: Times::default(),
            page: first_page(machine, boot),
        };
        let task = tokio::spawn(task.run(stream_receiver, events_receiver, health_receiver));
        Ok((Self { task, sender }, Outlets { stream, events, health, counters }))
    }

    /// Waits until everything is sent; the outlets must be gone. Says how many messages of each topic were.
    pub(super) async fn stop(self) -> BTreeMap<Topic, u64> {
        let published = match self.task.await {
            Ok(published) => published,
            Err(error) => {
                tracing::error!(%error, "the publishing task has ended early");
                BTreeMap::new()
            }
        };
        self.sender.stop().await;
        published
    }
}

/// Whether the topic goes over the network; on board there are all.
pub(super) fn is_published(machine: &config::Machine, topic: Topic) -> bool {
    // The journal is about readings, and worth nothing without them.
    machine.publish.sensors || !matches!(topic, Topic::Sensor(_) | Topic::Journal)
}

/// The journal begins with what the readings are estimated by, so that a recording can be run again alone.
fn first_page(machine: &config::Machine, boot: BootId) -> JournalPage {
    JournalPage { head: Some(Box::new(configuration::head(machine))), ..JournalPage::new(boot, 0, 0) }
}

/// What every report repeats.
struct Identity {
    id: String,
    name: String,
    world: crate::frames::geodesy::Geodetic,
    cabin_from_imu: RigidMotion,
}

struct Publishing {
    /// Of the next message of each topic.
    numbers: BTreeMap<Topic, u64>,
    published: BTreeSet<Topic>,
    record: RecordInlet,
    network: mpsc::Sender<Packet>,
    boot: BootId,
    clock: Clock,
    counters: Arc<Counters>,
    pace: Pace,
    identity: Identity,
    newest: Option<(Stamp, Pose<World, Odom>)>,
    /// What the last published health said of what must be told at once.
    told: Option<(Mode, GnssState, bool)>,
    losses_told: [u64; Counters::LOSSES],
    prediction: Option<Latency>,
    predictions_told: Times,
    /// The journal's, not yet full.
    page: JournalPage,
}

impl Publishing {
    async fn run(
        mut self,
        mut stream: mpsc::Receiver<Outgoing>,
        mut events: mpsc::Receiver<Event>,
        mut health: watch::Receiver<Option<Health>>,
    ) -> BTreeMap<Topic, u64> {
        let mut second = tokio::time::interval(HEALTH_PERIOD);
        second.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // All senders go together: the stream is the last to be empty.
                outgoing = stream.recv() => match outgoing {
                    Some(outgoing) => self.outgoing(outgoing),
                    None => break,
                },
                Some(event) = events.recv() => self.event(&event),
                Ok(()) = health.changed() => {
                    let health = health.borrow_and_update().clone();
                    if let Some(health) = health && self.told != Some(urgent(&health)) {
                        self.health(health);
                    }
                }
                _ = second.tick() => {
                    self.prediction = self.counters.predict.latency_since(&mut self.predictions_told);
                    let health = health.borrow().clone();
                    if let Some(health) = health {
                        self.health(health);
                    }
                    self.tell_losses();
                }
            }
        }
        while let Ok(event) = events.try_recv() {
            self.event(&event);
        }
        self.turn_page();
        self.numbers.retain(|topic, _| self.published.contains(topic));
        self.numbers
    }

    fn outgoing(&mut self, outgoing: Outgoing) {
        match outgoing {
            Outgoing::Estimate(estimate) => {
                self.newest = Some((estimate.stamp, estimate.world_from_odom));
                if self.pace.is_due(estimate.stamp) {
                    let now = self.clock.now();
                    self.put(Topic::Pose, estimate.stamp, now, pose_message(&estimate).encode());
                    self.put(Topic::Odom, estimate.stamp, now, odom_message(&estimate).encode());
                }
            }
            Outgoing::Reading { number, arrival: Arrival { arrival, reading }, seen } => {
                let topic = Topic::Sensor(reading.sensor());
                self.put(topic, reading.stamp(), arrival, encode_reading(&reading));
                self.open_page_at(number, self.page.takeovers);
                self.page.push(reading.sensor(), seen);
                if self.page.sensors.len() >= PAGE_READINGS_MAX {
                    self.turn_page();
                }
            }
            Outgoing::Takeover { number, takeover } => {
                self.open_page_at(takeover.before, number);
                self.page.taken_over = Some(takeover.solution_of);
                self.turn_page();
            }
        }
    }

    /// Another page if this one does not go on there: something was lost on the way here.
    fn open_page_at(&mut self, end: u64, takeovers: u64) {
        if (self.page.end(), self.page.takeovers) != (end, takeovers) {
            self.turn_page();
            self.page = JournalPage::new(self.boot, end, takeovers);
        }
    }

    fn turn_page(&mut self) {
        if self.page.is_empty() {
            return;
        }
        let next = self.page.next();
        let page = std::mem::replace(&mut self.page, next);
        let now = self.clock.now();
        match encode_json("journal page", &page) {
            Ok(payload) => self.put(Topic::Journal, now, now, payload),
            Err(error) => tracing::error!(%error, "a page of the journal cannot be published"),
        }
    }

    fn event(&mut self, event: &Event) {
        tracing::info!(severity = ?event.severity, what = ?event.what, "event");
        match encode_json("event", event) {
            Ok(payload) => {
                let stamp = Stamp::from_nanos(event.stamp_ns);
                self.put(Topic::Event, stamp, self.clock.now(), payload);
            }
            Err(error) => tracing::error!(%error, "an event cannot be published"),
        }
    }

    fn health(&mut self, health: Health) {
        let now = self.clock.now();
        let stamp = Stamp::from_nanos(health.stamp_ns);
        self.told = Some(urgent(&health));
        let report = MachineReport {
            id: self.identity.id.clone(),
            name: self.identity.name.clone(),
            software: env!("CARGO_PKG_VERSION").to_owned(),
            boot: self.boot,
            world: self.identity.world.into(),
            cabin_from_imu: self.identity.cabin_from_imu,
            world_from_odom: self.newest.as_ref().map(|(_, world_from_odom)| world_from_odom.into()),
            estimate_age_s: self.newest.as_ref().map(|(stamp, _)| now.seconds_since(*stamp)),
            prediction: self.prediction,
            record: Some(self.record.status()),
            health,
        };
        match encode_json("machine report", &report) {
            Ok(payload) => self.put(Topic::Health, stamp, now, payload),
            Err(error) => tracing::error!(%error, "health cannot be published"),
        }
    }

    /// Numbers the message and hands it on. Waits for nobody.
    fn put(&mut self, topic: Topic, stamp: Stamp, sent: Stamp, payload: Vec<u8>) {
        let next = self.numbers.entry(topic).or_insert(0);
        let attachment = Attachment { sequence: *next, boot: self.boot, stamp, sent };
        *next += 1;
        self.record.offer(topic, &attachment, &payload);
        if self.published.contains(&topic)
            && self.network.try_send(Packet { topic, attachment, payload }).is_err()
        {
            self.counters.unsent.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn tell_losses(&mut self) {
        for ((what, count), told) in self.counters.losses().into_iter().zip(&mut self.losses_told) {
            if count > *told {
                tracing::warn!(count = count - *told, total = count, "lost {what}");
                *told = count;
            }
        }
    }
}

fn urgent(health: &Health) -> (Mode, GnssState, bool) {
    (health.mode, health.gnss, health.waits_for.is_some())
}

/// Chooses the estimates that are published.
struct Pace {
    /// `None` publishes all.
    period: Option<Span>,
    /// Half the IMU's period, which stamps may jitter by.
    early: Span,
    due: Option<Stamp>,
}

impl Pace {
    fn new(rate_hz: f64, imu_rate_hz: f64) -> Self {
        let period = (rate_hz < 0.99 * imu_rate_hz).then(|| Span::from_seconds(1.0 / rate_hz));
        Self { period, early: Span::from_seconds(0.5 / imu_rate_hz), due: None }
    }

    fn is_due(&mut self, stamp: Stamp) -> bool {
        let Some(period) = self.period else { return true };
        let due = *self.due.get_or_insert(stamp);
        if stamp + self.early < due {
            return false;
        }
        // On the grid, unless samples are missing.
        let next = due + period;
        self.due = Some(if next > stamp { next } else { stamp + period });
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn published(rate_hz: f64, jitter_ns: i64) -> usize {
        let mut pace = Pace::new(rate_hz, 100.0);
        let stamps = (0..1000).map(|index| Stamp::from_nanos(10_000_000 * index + jitter_ns * (index % 3)));
        stamps.filter(|stamp| pace.is_due(*stamp)).count()
    }

    #[test]
    fn publishing_keeps_its_rate_whatever_the_jitter() {
        assert_eq!(published(100.0, 1_000_000), 1000);
        assert_eq!(published(500.0, 0), 1000);
        assert!(published(50.0, 1_000_000).abs_diff(500) <= 1);
        assert!(published(10.0, 0).abs_diff(100) <= 1);
        assert!(published(30.0, 1_000_000).abs_diff(300) <= 3, "{}", published(30.0, 1_000_000));
    }
}
