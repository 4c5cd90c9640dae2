//! The whole site as one value: what every machine last said, whether it is there, how good its link is.
//!
//! Owned by the site server's aggregator. Pure: messages and the time come in, views go out. No decoding
//! (room `wire`), no storage (room `record`), no clock. Times are by the site's clock unless a name says
//! otherwise.
//!
//! # Presence
//! ```text
//!            token, data young                 token, data old
//!   lost ─────────────────────▶ online ◀──────────────────────▶ stale
//!     ▲                            │                               │
//!     └────────────────────────────┴───────── no token ────────────┘
//! ```
//! *Data* is the newest pose, which may be 0.5 s old, or three times the usual time between two poses if that
//! is longer; as long as the estimator has not started (no pose since
//! boot, or the machine reports that it is initializing) it is the newest health, which may be 2.5 s old. A
//! lost machine keeps its last values, and their ages grow. Telling the same thing twice changes nothing.
//!
//! A restart is a new boot id: counting starts anew, and what still arrives from the boot before is refused. The
//! machine is *restarted* from then on until the new boot says its first pose, as long as it is connected and its newest
//! health, or its token, is at most 2.5 s old; with that pose it is online, without it stale or lost by the rule above.
//! The boots before the site's own start are not known: a machine that is met for the first time is not restarted.

mod alerts;
mod last_hour;
mod link;
mod machine;
mod outages;
mod past;
mod trail;
mod view;

use std::collections::BTreeMap;

pub use alerts::{
    Acknowledgement, AcknowledgementView, Alert, AlertRule, AlertSeverity, AlertState, AlertView, Alerts,
    Observation, RuleKind, SiteState, Subject, Unacknowledged, Unrecorded, observations, retry_after,
};
pub use outages::{
    Budget, CELL_M, CauseTally, CellKey, CellTime, Change, CurrentOutage, DayStatistics, Ending,
    FLOAT_SIGMA_M, FixState, GnssView, MachineStatistics, Observed, Outage, OutageDetail, OutageView,
    PlaceView, QUARTER, SAMPLES_MAX, ShadowFeature, ShadowMap, ShadowPolygon, ShadowProperties, SigmaSample,
    SigmaSummary, SigmaView, Statistics, Tally, Thinned, TrackPoint, TrackView,
};
pub use past::{Past, Rates, SensorRate, StatePoint};
pub use trail::{TRAIL_POINTS_MAX, TrailPoint, Trails};
pub use view::{
    Ellipse95, FleetView, HealthView, LinkView, MachineView, PoseView, Presence, SIGMAS_95, Severity,
    SiteView, UtcTime, WorldView, recorded_word,
};

use crate::frames::geodesy::{Geodetic, SiteFrame};
use crate::frames::{Base, Cabin, Imu, Odom, Pose, World};
use crate::lie::Mat6;
use crate::sensors::Sensor;
use crate::state::Health;
use crate::time::{Span, Stamp};
use machine::Machine;

/// More machines than this on one site are refused: keys come from outside, memory does not.
pub const MACHINES_MAX: usize = 1000;
/// A pose older than this is old, unless the machine publishes so slowly that [`POSES_MISSING_MAX`] times the
/// usual time between two poses is longer.
pub const POSE_AGE_MAX: Span = Span::from_millis(500);
/// So many poses in a row may be missing before the newest one is old.
pub const POSES_MISSING_MAX: i64 = 3;
/// However slowly a machine publishes, a pose older than this is old.
pub const POSE_AGE_LIMIT: Span = Span::from_millis(10_000);
/// A machine's origin may be so far from the site's, m: less than its position is good for.
pub const ORIGIN_OFF_MAX_M: f64 = 0.001;
/// A message of an earlier boot is no straggler any more so long after the next one appeared.
pub const RIVAL_AFTER: Span = Span::from_millis(1_000);
/// Two machines with one id are told again after so long.
pub const RIVAL_TOLD_EVERY: Span = Span::from_millis(10_000);
/// And shown for so long after the last message of the one that is not listened to.
pub const RIVAL_SHOWN_FOR: Span = Span::from_millis(3_000);
/// A health message older than this is old.
pub const HEALTH_AGE_MAX: Span = Span::from_millis(2_500);

/// Who the site is.
#[derive(Clone, Debug)]
pub struct SiteDescription {
    /// As in keys.
    pub id: String,
    /// For people.
    pub name: String,
    /// IANA name of its time zone.
    pub time_zone: String,
    /// Where the site frame is tied to the earth.
    pub origin: Geodetic,
    /// Version of the site server.
    pub software: String,
    /// One sigma of a machine's position that the site tolerates, along the worst horizontal direction, m.
    pub tolerance_m: f64,
}

/// What a message is about: the part of its key after the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// Pose in the world.
    Pose,
    /// Pose in the odom frame.
    Odom,
    /// State of the estimator.
    Health,
    /// What happened.
    Event,
    /// What a replay needs.
    Journal,
    /// A reading.
    Sensor(Sensor),
}

/// What every message carries beside its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Publication {
    /// Counts the messages of one topic and boot, from 0.
    pub sequence: u64,
    /// Drawn by the machine at each start.
    pub boot: u64,
    /// When it was measured, by the machine's stamps.
    pub stamp: Stamp,
    /// When it was sent, by the machine's clock.
    pub sent: Stamp,
}

/// The estimate as it was published.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample {
    /// Of the estimate, by the machine's stamps.
    pub stamp: Stamp,
    /// Accurate pose of the cabin IMU.
    pub world_from_imu: Pose<World, Imu>,
    /// Position in the world (m²) first, then rotation about the world's axes (rad²).
    pub covariance: Mat6,
    /// Of the IMU's origin, m/s.
    pub speed_mps: f64,
}

/// What a machine says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct MachineReport {
    /// For people.
    pub name: String,
    /// Where the machine ties its world frame to the earth: must be where the site does.
    pub origin: Geodetic,
    /// Where the cabin IMU sits.
    pub cabin_from_imu: Pose<Cabin, Imu>,
    /// Drift of the odom frame, once known.
    pub world_from_odom: Option<Pose<World, Odom>>,
    /// Version of its software; empty if it does not tell.
    pub software: String,
    /// From its newest estimate to this report, s; `None` before the start.
    pub estimate_age_s: Option<f64>,
    /// From an IMU sample to its estimate, 99 % of them over the last second, µs; `None` if it does not tell.
    pub prediction_p99_us: Option<f64>,
    /// State of the estimator.
    pub health: Health,
}

/// Messages of a machine that the recording lacks, and that it got later.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Gaps {
    /// Missing so far.
    pub open: u64,
    /// Fetched from the machine's own record.
    pub filled: u64,
    /// Missing for good.
    pub lost: u64,
}

/// What became of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Receipt {
    /// Counted; its content is welcome.
    Accepted,
    /// From a boot that was followed by another one.
    OldBoot,
    /// The same, but long ago, and its token still stands: there are two machines with one id. Told at most every
    /// [`RIVAL_TOLD_EVERY`].
    Rival,
    /// There are [`MACHINES_MAX`] machines already.
    TooManyMachines,
}

/// The site's machines.
#[derive(Debug)]
pub struct Fleet {
    site: SiteDescription,
    frame: SiteFrame,
    machines: BTreeMap<String, Machine>,
    /// Outages that went on when the site server ended, by machine, until the machine is heard of.
    carried_on: BTreeMap<String, Outage>,
}

impl Fleet {
    /// A site without machines.
    pub fn new(site: SiteDescription) -> Self {
        let frame = SiteFrame::new(site.origin);
        Self { site, frame, machines: BTreeMap::new(), carried_on: BTreeMap::new() }
    }

    /// An outage that went on when the site server ended: it goes on, or ends, when its machine is heard.
    pub fn carry_on(&mut self, outage: Outage) {
        if self.carried_on.len() < MACHINES_MAX {
            self.carried_on.insert(outage.machine.clone(), outage);
        }
    }

    /// A liveliness token appeared.
    pub fn announce(&mut self, id: &str, boot: u64, now: Stamp) {
        if let Some(machine) = self.machine_mut(id, now) {
            machine.announce(boot, now);
        }
    }

    /// A liveliness token is gone.
    pub fn withdraw(&mut self, id: &str, boot: u64, now: Stamp) {
        if let Some(machine) = self.machines.get_mut(id) {
            machine.withdraw(boot, now);
        }
    }

    /// Counts a message, whatever its content; `now` is when it arrived. To be called before its content is
    /// handed in, and for each message once. Content goes in only if it was accepted.
    pub fn receive(&mut self, id: &str, topic: Topic, publication: &Publication, now: Stamp) -> Receipt {
        match self.machine_mut(id, now) {
            Some(machine) => machine.receive(topic, publication, now),
            None => Receipt::TooManyMachines,
        }
    }

    /// Counts a message that could not be read.
    pub fn refuse(&mut self, id: &str, now: Stamp) {
        if let Some(machine) = self.machine_mut(id, now) {
            machine.refuse();
        }
    }

    /// A pose that [`Fleet::receive`] accepted.
    pub fn pose(&mut self, id: &str, sample: PoseSample, now: Stamp) {
        if let Some(machine) = self.machine_mut(id, now) {
            machine.pose(sample, now);
        }
    }

    /// The chassis in the odom frame, where it is known.
    pub fn chassis(&mut self, id: &str, odom_from_base: Option<Pose<Odom, Base>>, now: Stamp) {
        if let Some(machine) = self.machine_mut(id, now) {
            machine.chassis(odom_from_base);
        }
    }

    /// What the receiver of a machine's left antenna reports of a fix: the larger horizontal sigma, m.
    pub fn fix(&mut self, id: &str, sigma_m: f64, now: Stamp) {
        if let Some(machine) = self.machine_mut(id, now) {
            machine.fix(sigma_m, now);
        }
    }

    /// A report that [`Fleet::receive`] accepted.
    pub fn report(&mut self, id: &str, report: MachineReport, now: Stamp) {
        if let Some(machine) = self.machine_mut(id, now) {
            machine.report(report, now);
        }
    }

    /// How much of a machine's messages the recording lacks.
    pub fn gaps(&mut self, id: &str, gaps: Gaps) {
        if let Some(machine) = self.machines.get_mut(id) {
            machine.recording_gaps(gaps);
        }
    }

    /// Lets time pass: what became old by `now` becomes stale. Returns the machines whose presence changed.
    pub fn advance(&mut self, now: Stamp) -> usize {
        self.machines.values_mut().map(|machine| usize::from(machine.advance(now))).sum()
    }

    /// Outages that began or ended since the last call, and those that go on, once a second.
    pub fn take_outage_changes(&mut self) -> Vec<Change> {
        self.machines.values_mut().flat_map(|machine| machine.monitor.take_changes()).collect()
    }

    /// Time that machines spent in the cells of the site since the last call.
    pub fn take_cells(&mut self) -> Vec<(String, CellKey, CellTime)> {
        let take = |(id, machine): (&String, &mut Machine)| {
            let id = id.clone();
            machine.monitor.take_cells().into_iter().map(move |(key, time)| (id.clone(), key, time))
        };
        self.machines.iter_mut().flat_map(take).collect()
    }

    /// The site frame.
    pub fn frame(&self) -> &SiteFrame {
        &self.frame
    }

    /// How many machines were ever seen.
    pub fn len(&self) -> usize {
        self.machines.len()
    }

    /// Whether no machine was ever seen.
    pub fn is_empty(&self) -> bool {
        self.machines.is_empty()
    }

    /// The site itself.
    pub fn site(&self) -> SiteView {
        SiteView {
            id: self.site.id.clone(),
            name: self.site.name.clone(),
            world: WorldView::from(self.site.origin),
            time_zone: self.site.time_zone.clone(),
            software: self.site.software.clone(),
        }
    }

    /// Everything, in the order of the machines' ids, as it stands at `now`.
    pub fn view(&self, now: Stamp) -> FleetView {
        FleetView {
            site: self.site(),
            time: UtcTime(now),
            machines: self
                .machines
                .iter()
                .map(|(id, machine)| machine.view(id, &self.frame, self.site.tolerance_m, now))
                .collect(),
        }
    }

    fn machine_mut(&mut self, id: &str, now: Stamp) -> Option<&mut Machine> {
        if !self.machines.contains_key(id) {
            if self.machines.len() >= MACHINES_MAX {
                return None;
            }
            let carried_on = self.carried_on.remove(id);
            self.machines.insert(id.to_owned(), Machine::new(id, carried_on, now));
        }
        self.machines.get_mut(id)
    }
}

#[cfg(test)]
mod tests;
