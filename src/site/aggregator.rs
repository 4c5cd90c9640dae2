//! The one owner of the fleet: takes in what the callbacks hand over, and gives out a frame ten times a second.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::MissedTickBehavior;

use super::clock::SiteClock;
use super::ended;
use super::foxglove::Feed;
use super::history::{self, Note};
use super::inlet::{Inbound, Message, Token};
use crate::fleet::{
    self, FixState, Fleet, FleetView, MachineView, PoseSample, Presence, Publication, Receipt,
};
use crate::frames::{self, Base, Frame as _, Imu, Odom, Pose, World};
use crate::lie::{Mat6, Se3, So3, Vec3};
use crate::sensors::{Reading, Sensor};
use crate::time::Stamp;
use crate::wire::{self, Odometry, RosMessage, Topic, WireError};

/// Frames in a second: the highest rate of a live client.
pub(super) const FRAME_RATE_HZ: u32 = 10;
/// Messages that are taken in at once, between two looks at the clock.
const BATCH: usize = 256;

/// Time in the cells of the site is handed over so often: frames.
const CELLS_EVERY: u64 = 10 * FRAME_RATE_HZ as u64;

/// Where the aggregator hands over to.
pub(super) struct Outlets {
    pub frames: watch::Sender<Arc<Frame>>,
    pub history: Option<history::Inlet>,
}

impl Outlets {
    fn remember(&self, fleet: &mut Fleet, with_cells: bool) {
        let Some(history) = &self.history else { return };
        fleet
            .take_outage_changes()
            .into_iter()
            .for_each(|change| history.leave(Note::Outage(Box::new(change))));
        if with_cells {
            let cells = fleet.take_cells();
            if !cells.is_empty() {
                history.leave(Note::Cells(cells));
            }
        }
    }
}

/// The whole site at one time. Everybody who shows something reads the newest one.
#[derive(Debug)]
pub(super) struct Frame {
    /// Counts the frames.
    pub number: u64,
    pub view: FleetView,
    /// One for each machine of `view`, in the same order.
    encoded: Vec<OnceLock<Arc<str>>>,
}

/// What tells whether a machine's view is worth sending again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Revision {
    received: u64,
    refused: u64,
    presence: Presence,
    since: Stamp,
    fixes: (FixState, Stamp),
    /// Ages grow all the time; people see seconds.
    whole_seconds: i64,
}

impl Frame {
    pub fn of(fleet: &Fleet, number: u64, now: Stamp) -> Self {
        let view = fleet.view(now);
        let encoded = view.machines.iter().map(|_| OnceLock::new()).collect();
        Self { number, view, encoded }
    }

    pub fn machine(&self, id: &str) -> Option<&MachineView> {
        self.view.machines.iter().find(|machine| machine.id == id)
    }

    /// The machine's view as JSON: encoded by the first who asks, for all.
    pub fn json(&self, index: usize) -> Arc<str> {
        let encode = || match serde_json::to_string(&self.view.machines[index]) {
            Ok(json) => json.into(),
            Err(error) => {
                tracing::error!("a machine's view has no JSON form: {error}");
                "null".into()
            }
        };
        Arc::clone(self.encoded[index].get_or_init(encode))
    }

    pub fn revision(&self, index: usize) -> Revision {
        let machine = &self.view.machines[index];
        let since = machine.presence_since.0;
        Revision {
            received: machine.link.received,
            refused: machine.link.refused,
            presence: machine.presence,
            since,
            fixes: (machine.gnss.state, machine.gnss.since.0),
            whole_seconds: (self.view.time.0 - since).as_nanos() / 1_000_000_000,
        }
    }
}

/// Runs until `stopped` says so, or everybody who could send is gone.
pub(super) async fn run(
    mut fleet: Fleet,
    mut messages: mpsc::Receiver<Message>,
    mut tokens: mpsc::Receiver<Token>,
    outlets: Outlets,
    mut feed: Feed,
    clock: SiteClock,
    mut stopped: watch::Receiver<bool>,
) {
    let mut number = 0;
    let mut batch = Vec::with_capacity(BATCH);
    let mut ticks = tokio::time::interval(Duration::from_secs(1) / FRAME_RATE_HZ);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        // In this order: presence and frames must not wait behind a flood of messages.
        tokio::select! {
            biased;
            () = ended(&mut stopped) => return outlets.remember(&mut fleet, true),
            Some(token) = tokens.recv() => on_token(&mut fleet, &token),
            _ = ticks.tick() => {
                number += 1;
                let now = clock.now();
                fleet.advance(now);
                outlets.remember(&mut fleet, number % CELLS_EVERY == 0);
                outlets.frames.send_replace(Arc::new(Frame::of(&fleet, number, now)));
            }
            count = messages.recv_many(&mut batch, BATCH) => {
                batch.drain(..).for_each(|message| on_message(&mut fleet, &mut feed, &message));
                if count == 0 {
                    // No more senders; frames go on, so that ages do.
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
            }
        }
    }
}

fn on_token(fleet: &mut Fleet, token: &Token) {
    let Token { machine, boot, alive, at } = token;
    match alive {
        true => fleet.announce(machine, *boot, *at),
        false => fleet.withdraw(machine, *boot, *at),
    }
    tracing::info!("machine {machine}, boot {boot:016x}: {}", if *alive { "connected" } else { "gone" });
}

fn on_message(fleet: &mut Fleet, feed: &mut Feed, message: &Message) {
    let (machine, error, received) = match message {
        Message::Gaps { machine, gaps } => return fleet.gaps(machine, *gaps),
        Message::Unusable { machine, error, received } => (machine, error.to_string(), *received),
        Message::Publication(inbound) => match on_publication(fleet, inbound) {
            Ok(Use::Taken) => return feed.tell(inbound),
            Ok(Use::Left) => return,
            Err(error) => (&inbound.machine, format!("{}: {error}", inbound.topic), inbound.received),
        },
    };
    fleet.refuse(machine, received);
    tracing::debug!("machine {machine}: refused: {error}");
}

/// What became of a message.
enum Use {
    Taken,
    /// It is not for this fleet: from another machine of the same id, or from before a restart.
    Left,
}

fn on_publication(fleet: &mut Fleet, inbound: &Inbound) -> Result<Use, WireError> {
    let Inbound { machine, topic, payload, attachment, received } = inbound;
    let publication = Publication {
        sequence: attachment.sequence,
        boot: attachment.boot.0,
        stamp: attachment.stamp,
        sent: attachment.sent,
    };
    match fleet.receive(machine, fleet_topic(*topic), &publication, *received) {
        Receipt::Accepted => {}
        Receipt::Rival => {
            let boot = attachment.boot;
            tracing::warn!(
                "two machines have the id {machine}: what the one of boot {boot} says is not used"
            );
            return Ok(Use::Left);
        }
        Receipt::OldBoot | Receipt::TooManyMachines => return Ok(Use::Left),
    }
    match topic {
        Topic::Pose => fleet.pose(machine, pose_sample(&Odometry::decode(payload)?)?, *received),
        Topic::Odom => fleet.chassis(machine, odom_from_base(&Odometry::decode(payload)?)?, *received),
        Topic::Health => fleet.report(machine, report(wire::decode_report(payload)?)?, *received),
        Topic::Sensor(Sensor::GnssLeft) => {
            if let Reading::GnssLeft(fix) = wire::decode_reading(Sensor::GnssLeft, payload)? {
                fleet.fix(machine, fix.sigma_enu_m.x.max(fix.sigma_enu_m.y), *received);
            }
        }
        // For the record only.
        Topic::Event | Topic::Journal | Topic::Sensor(_) => {}
    }
    Ok(Use::Taken)
}

fn fleet_topic(topic: Topic) -> fleet::Topic {
    match topic {
        Topic::Pose => fleet::Topic::Pose,
        Topic::Odom => fleet::Topic::Odom,
        Topic::Health => fleet::Topic::Health,
        Topic::Event => fleet::Topic::Event,
        Topic::Journal => fleet::Topic::Journal,
        Topic::Sensor(sensor) => fleet::Topic::Sensor(sensor),
    }
}

fn unusable(reason: String) -> WireError {
    WireError::Unusable { message: Odometry::TYPE, reason }
}

fn motion(message: &Odometry) -> Result<Se3, WireError> {
    let [x, y, z, w] = message.orientation;
    let rotation = So3::from_xyzw(x, y, z, w).ok_or_else(|| unusable("no rotation".to_owned()))?;
    Ok(Se3::new(rotation, Vec3::from(message.position)))
}

pub(super) fn pose_sample(message: &Odometry) -> Result<PoseSample, WireError> {
    let frames = (message.header.frame_id.as_str(), message.child_frame_id.as_str());
    if frames != (World::NAME, Imu::NAME) {
        return Err(unusable(format!("frames are {frames:.80?}, must be world and imu")));
    }
    Ok(PoseSample {
        stamp: message.header.stamp,
        world_from_imu: Pose::assume(motion(message)?),
        covariance: Mat6::from_row_slice(&message.pose_covariance),
        speed_mps: Vec3::from(message.linear).norm(),
    })
}

pub(super) fn odom_from_base(message: &Odometry) -> Result<Option<Pose<Odom, Base>>, WireError> {
    if message.header.frame_id != frames::Odom::NAME {
        return Err(unusable(format!("frame is {:.80?}, must be odom", message.header.frame_id)));
    }
    match message.child_frame_id == Base::NAME {
        true => Ok(Some(Pose::assume(motion(message)?))),
        false => Ok(None),
    }
}

pub(super) fn report(report: wire::MachineReport) -> Result<fleet::MachineReport, WireError> {
    let no_motion = |what: &str| WireError::Unusable {
        message: "machine report",
        reason: format!("{what} is no rigid motion"),
    };
    let world_from_odom = match report.world_from_odom {
        Some(motion) => Some(motion.pose().ok_or_else(|| no_motion("world_from_odom"))?),
        None => None,
    };
    Ok(fleet::MachineReport {
        name: report.name,
        origin: report.world.into(),
        cabin_from_imu: report.cabin_from_imu.pose().ok_or_else(|| no_motion("cabin_from_imu"))?,
        world_from_odom,
        software: report.software,
        estimate_age_s: report.estimate_age_s,
        prediction_p99_us: report.prediction.map(|latency| latency.p99_us),
        health: report.health,
    })
}
