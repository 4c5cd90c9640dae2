//! One machine as the site knows it.

use std::collections::{BTreeSet, VecDeque};

use super::link::{self, ClockOffset, Interval, Rate};
use super::outages::{Monitor, Outage};
use super::view::{self, HealthView, LinkView, MachineView, PoseView, UtcTime};
use super::{
    Gaps, HEALTH_AGE_MAX, MachineReport, ORIGIN_OFF_MAX_M, POSE_AGE_LIMIT, POSE_AGE_MAX, POSES_MISSING_MAX,
    PoseSample, Presence, Publication, RIVAL_AFTER, RIVAL_SHOWN_FOR, RIVAL_TOLD_EVERY, Receipt, Severity,
    Topic,
};
use crate::frames::geodesy::SiteFrame;
use crate::frames::{Base, Odom, Pose};
use crate::state::Mode;
use crate::time::{Span, Stamp};

/// So many earlier boots are remembered, so that their stragglers are known as such.
const RETIRED_BOOTS_MAX: usize = 8;
/// So many tokens are held for one machine at most.
const TOKENS_MAX: usize = 8;

/// A value and when it arrived.
#[derive(Debug)]
struct Received<T> {
    value: T,
    at: Stamp,
    boot: Option<u64>,
}

#[derive(Debug)]
pub(super) struct Machine {
    /// Boots whose liveliness token stands.
    tokens: BTreeSet<u64>,
    boot: Option<u64>,
    boot_since: Stamp,
    retired: VecDeque<u64>,
    presence: Presence,
    presence_since: Stamp,
    /// When the token that stands appeared: a machine that never spoke is stale since then.
    announced: Stamp,
    pose: Option<Received<PoseSample>>,
    odom_from_base: Option<Pose<Odom, Base>>,
    report: Option<Received<MachineReport>>,
    gaps: link::Gaps,
    recording: Gaps,
    pose_rate: Rate,
    pose_interval: Interval,
    clock_offset: ClockOffset,
    /// Since when another machine with this id speaks, when it last did, and when that was last told.
    rival: Option<(Stamp, Stamp)>,
    rival_told: Option<Stamp>,
    refused: u64,
    pub monitor: Monitor,
}

impl Machine {
    pub fn new(id: &str, carried_on: Option<Outage>, now: Stamp) -> Self {
        Self {
            tokens: BTreeSet::new(),
            boot: None,
            boot_since: now,
            retired: VecDeque::new(),
            presence: Presence::Lost,
            presence_since: now,
            announced: now,
            pose: None,
            odom_from_base: None,
            report: None,
            gaps: link::Gaps::default(),
            recording: Gaps::default(),
            pose_rate: Rate::default(),
            pose_interval: Interval::default(),
            clock_offset: ClockOffset::default(),
            rival: None,
            rival_told: None,
            refused: 0,
            monitor: Monitor::new(id, carried_on, now),
        }
    }

    pub fn announce(&mut self, boot: u64, now: Stamp) {
        if self.tokens.contains(&boot) {
            return;
        }
        // The ghost of a boot whose link broke silently stays until its lease ends; more than a few are a lie.
        if self.tokens.len() >= TOKENS_MAX {
            self.tokens.pop_first();
        }
        if self.tokens.is_empty() {
            self.announced = now;
        }
        self.tokens.insert(boot);
        // A link that comes back brings back the token of the same boot.
        if !self.retired.contains(&boot) {
            self.adopt(boot, now);
        }
        self.advance(now);
    }

    pub fn withdraw(&mut self, boot: u64, now: Stamp) {
        self.tokens.remove(&boot);
        self.advance(now);
    }

    pub fn receive(&mut self, topic: Topic, publication: &Publication, now: Stamp) -> Receipt {
        if self.succeeds_again(publication.boot, now) {
            self.retired.retain(|boot| *boot != publication.boot);
        }
        if self.retired.contains(&publication.boot) {
            self.refused += 1;
            return self.straggler(publication.boot, now);
        }
        self.adopt(publication.boot, now);
        self.gaps.count(topic, publication.sequence);
        self.clock_offset.observe(publication, now);
        if topic == Topic::Pose {
            self.pose_rate.count(now);
            self.pose_interval.observe(publication.sequence, now);
        }
        Receipt::Accepted
    }

    /// Whether an earlier boot speaks on while the one that followed it has ended: the second of two machines
    /// with one id.
    fn succeeds_again(&self, boot: u64, now: Stamp) -> bool {
        let current_stands = self.boot.is_some_and(|boot| self.tokens.contains(&boot));
        self.tokens.contains(&boot) && !current_stands && now - self.boot_since >= RIVAL_AFTER
    }

    /// A message of an earlier boot: a straggler, or a second machine if its token stands.
    fn straggler(&mut self, boot: u64, now: Stamp) -> Receipt {
        if !self.tokens.contains(&boot) || now - self.boot_since < RIVAL_AFTER {
            return Receipt::OldBoot;
        }
        let since = self.rival_at(now).unwrap_or(now);
        self.rival = Some((since, now));
        if self.rival_told.is_some_and(|told| now - told < RIVAL_TOLD_EVERY) {
            return Receipt::OldBoot;
        }
        self.rival_told = Some(now);
        Receipt::Rival
    }

    /// Since when another machine has this id, too, if one has.
    fn rival_at(&self, now: Stamp) -> Option<Stamp> {
        self.rival.filter(|(_, spoke)| now - *spoke <= RIVAL_SHOWN_FOR).map(|(since, _)| since)
    }

    /// A pose older than this is old: by the machine's own pace if that is slow.
    fn pose_age_max(&self) -> Span {
        let usual = self.pose_interval.usual().unwrap_or_default();
        Span::from_nanos(usual.as_nanos().saturating_mul(POSES_MISSING_MAX))
            .clamp(POSE_AGE_MAX, POSE_AGE_LIMIT)
    }

    pub fn recording_gaps(&mut self, gaps: Gaps) {
        self.recording = gaps;
    }

    pub fn refuse(&mut self) {
        self.refused += 1;
    }

    pub fn pose(&mut self, sample: PoseSample, now: Stamp) {
        let motion = sample.world_from_imu.motion();
        let finite = motion.translation.iter().all(|value| value.is_finite())
            && motion.rotation.to_xyzw().iter().all(|part| part.is_finite())
            && sample.covariance.iter().all(|value| value.is_finite())
            && sample.speed_mps.is_finite();
        if !finite {
            return self.refuse();
        }
        self.monitor.pose(&sample, now);
        self.pose = Some(Received { value: sample, at: now, boot: self.boot });
        self.advance(now);
    }

    pub fn chassis(&mut self, odom_from_base: Option<Pose<Odom, Base>>) {
        self.odom_from_base =
            odom_from_base.filter(|pose| pose.motion().translation.iter().all(|value| value.is_finite()));
    }

    pub fn report(&mut self, report: MachineReport, now: Stamp) {
        self.monitor.report(&report.health, self.boot, now);
        self.report = Some(Received { value: report, at: now, boot: self.boot });
        self.advance(now);
    }

    pub fn fix(&mut self, sigma_m: f64, now: Stamp) {
        if !sigma_m.is_finite() {
            return self.refuse();
        }
        self.monitor.fix(sigma_m, now);
    }

    /// The one place where presence changes; true if it did.
    pub fn advance(&mut self, now: Stamp) -> bool {
        let (presence, since) = self.presence_at(now);
        let heard = self.report.as_ref().filter(|report| report.boot == self.boot);
        let is_young = heard.is_some_and(|report| now - report.at <= HEALTH_AGE_MAX);
        self.monitor.advance(presence != Presence::Lost && is_young, now);
        if presence == self.presence {
            return false;
        }
        self.presence = presence;
        self.presence_since = since;
        true
    }

    /// Presence by the rule of the room's doc, and since when, if it is not as before.
    fn presence_at(&self, now: Stamp) -> (Presence, Stamp) {
        if self.tokens.is_empty() {
            return (Presence::Lost, now);
        }
        let of_this_boot = |boot: Option<u64>| boot.is_some() && boot == self.boot;
        let pose = self.pose.as_ref().filter(|pose| of_this_boot(pose.boot));
        let report = self.report.as_ref().filter(|report| of_this_boot(report.boot));
        if pose.is_none() && !self.retired.is_empty() {
            let heard = report.map_or(self.boot_since, |report| report.at.max(self.boot_since));
            if now <= heard + HEALTH_AGE_MAX {
                return (Presence::Restarted, self.boot_since.min(now));
            }
        }
        let initializing = report.is_some_and(|report| report.value.health.mode == Mode::Initializing);
        let fresh_until = match pose {
            Some(pose) if !initializing => Some(pose.at + self.pose_age_max()),
            _ => report.map(|report| report.at + HEALTH_AGE_MAX),
        };
        match fresh_until {
            Some(until) if now <= until => (Presence::Online, now),
            // Not before the token: a machine that was lost is stale since it is back.
            Some(until) => (Presence::Stale, until.max(self.announced).min(now)),
            None => (Presence::Stale, self.announced.min(now)),
        }
    }

    fn adopt(&mut self, boot: u64, now: Stamp) {
        if self.boot == Some(boot) {
            return;
        }
        if let Some(before) = self.boot.replace(boot) {
            if self.retired.len() == RETIRED_BOOTS_MAX {
                self.retired.pop_front();
            }
            self.retired.push_back(before);
        }
        self.boot_since = now;
        self.gaps.restart();
        self.pose_interval = Interval::default();
        self.clock_offset = ClockOffset::default();
        self.odom_from_base = None;
    }

    pub fn view(&self, id: &str, frame: &SiteFrame, tolerance_m: f64, now: Stamp) -> MachineView {
        let report = self.report.as_ref();
        let pose = self.pose.as_ref().map(|pose| {
            let description = report.map(|report| &report.value);
            let age_s = now.seconds_since(pose.at).max(0.0);
            let fresh_s = self.pose_age_max().as_seconds();
            PoseView { fresh_s, ..PoseView::new(&pose.value, age_s, description, self.odom_from_base, frame) }
        });
        let health =
            report.map(|report| HealthView::new(&report.value, now.seconds_since(report.at).max(0.0)));
        let silent_s = now.seconds_since(self.presence_since).max(0.0);
        let current = report.is_some_and(|report| report.boot == self.boot);
        let (mut state_word, mut severity) =
            view::state_word(self.presence, silent_s, health.as_ref().filter(|_| current), pose.as_ref());
        let origin_off_m = report.map_or(0.0, |report| frame.to_enu(report.value.origin).norm());
        if self.presence == Presence::Online && origin_off_m > ORIGIN_OFF_MAX_M {
            state_word = format!("WRONG ORIGIN: {origin_off_m:.3} m from the site's");
            severity = Severity::Bad;
        }
        let rival_since = self.rival_at(now);
        if self.presence != Presence::Lost && rival_since.is_some() {
            state_word = "TWO MACHINES HAVE THIS ID".to_owned();
            severity = Severity::Bad;
        }
        MachineView {
            id: id.to_owned(),
            name: report
                .map(|report| report.value.name.clone())
                .filter(|name| !name.is_empty())
                .unwrap_or_else(|| id.to_owned()),
            presence: self.presence,
            presence_since: UtcTime(self.presence_since),
            boot: self.boot.map_or_else(String::new, |boot| format!("{boot:016x}")),
            software: report.map_or_else(String::new, |report| report.value.software.clone()),
            state_word,
            severity,
            pose,
            health,
            gnss: self.monitor.view(tolerance_m, now),
            link: LinkView {
                pose_rate_hz: self.pose_rate.hertz(now),
                received: self.gaps.received,
                missed: self.gaps.missed,
                refused: self.refused,
                gaps_open: self.recording.open,
                gaps_filled: self.recording.filled,
                gaps_lost: self.recording.lost,
                clock_offset_s: self.clock_offset.seconds(),
            },
            id_conflict_s: rival_since.map(|since| now.seconds_since(since).max(0.0)),
        }
    }
}
