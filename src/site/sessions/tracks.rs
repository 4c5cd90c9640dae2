//! What the machines of a session did, thin enough to be sent at once: for replay on the page.
//!
//! One pass over the files, whatever their order: late messages are filed where they came, so everything finds
//! its place by when the machine sent it. Of each span of time the first pose is kept; when there are too many,
//! the spans are doubled. So memory is bounded however long the session is.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::fleet::{MachineReport, PoseSample, PoseView, StatePoint, recorded_word};
use crate::frames::geodesy::SiteFrame;
use crate::frames::{Base, Odom, Pose};
use crate::record::{RecordError, Recorded, read_messages};
use crate::site::aggregator;
use crate::state::{Event, EventKind, GnssState, Mode};
use crate::time::{Span, Stamp};
use crate::wire::{BootId, Odometry, RosMessage, Topic, decode_event, decode_report};

/// Poses of all machines together, at most.
pub(in crate::site) const POSES_MAX: usize = 24_000;
/// Reports of all machines together, at most, beside those at which the state changed.
const REPORTS_MAX: usize = 8_000;
/// States that change all the time are told so often at most.
const CHANGES_MAX: usize = 8_000;
/// Events, at most.
pub(in crate::site) const EVENTS_MAX: usize = 5_000;
/// The finest spans.
pub(in crate::site) const STEP_LEAST: Span = Span::from_millis(50);
/// Without a wish.
const STEP_USUAL: Span = Span::from_millis(200);
const REPORT_STEP: Span = Span::from_millis(1_000);
/// Without any pose for so long is a silence.
const SILENCE: Span = Span::from_millis(2_000);
/// Poses of so long are held by their first and their last: between them is no silence.
const SILENCE_BIN_NS: i64 = 1_000_000_000;
/// Eleven days; what comes after is not looked at for silences.
const SECONDS_MAX: usize = 1_000_000;
/// A machine's clock that is off by more is put right.
const CLOCK_OFF: Span = Span::from_millis(500);
/// Messages between two looks at whether anybody still waits.
const LOOK_EVERY: u64 = 4_096;

/// Which part of a session.
#[derive(Clone, Debug, Default)]
pub(in crate::site) struct Wanted {
    pub machine: Option<String>,
    /// By the machines' clocks.
    pub from: Option<Stamp>,
    pub to: Option<Stamp>,
    pub step: Option<Span>,
}

impl Wanted {
    fn covers(&self, message: &Recorded<Vec<u8>>) -> bool {
        self.machine.as_ref().is_none_or(|machine| *machine == message.machine)
            && self.from.is_none_or(|from| message.sent >= from)
            && self.to.is_none_or(|to| message.sent < to)
    }
}

/// All machines of a session.
#[derive(Debug)]
pub(in crate::site) struct Tracks {
    pub step: Span,
    pub machines: Vec<Track>,
}

/// One machine.
#[derive(Debug)]
pub(in crate::site) struct Track {
    pub id: String,
    pub name: String,
    pub software: String,
    /// What was added to its times, since its clock is not the site's.
    pub clock_shift: Span,
    pub poses: Vec<(Stamp, PoseView)>,
    pub states: Vec<(Stamp, StatePoint)>,
    /// From and to.
    pub silences: Vec<(Stamp, Stamp)>,
    /// Poses that were sent, but are not in the session.
    pub poses_missing: u64,
}

/// What happened, with how much was left out.
#[derive(Debug, Default)]
pub(in crate::site) struct Events {
    pub events: Vec<(Stamp, String, Event)>,
    pub left_out: u64,
}

#[derive(Default)]
struct Gathering {
    poses: BTreeMap<i64, (Stamp, Option<BootId>, PoseSample)>,
    chassis: BTreeMap<i64, (Stamp, Option<Pose<Odom, Base>>)>,
    reports: BTreeMap<Stamp, Said>,
    /// The first and the last pose of each second that has one.
    seconds: BTreeMap<i64, (Stamp, Stamp)>,
    /// Numbers of the poses of each boot: least, most, how many.
    counted: BTreeMap<Option<BootId>, (u64, u64, u64)>,
    /// The shortest transit of each boot.
    transit: Option<Span>,
    software: String,
}

struct Said {
    boot: Option<BootId>,
    report: MachineReport,
    transit: Span,
}

impl Said {
    fn state(&self) -> (Mode, GnssState) {
        (self.report.health.mode, self.report.health.gnss)
    }
}

/// Reads the tracks of a session from its files.
///
/// # Errors
/// [`RecordError`] if a file cannot be read. `Ok(None)` if nobody waits any more.
pub(in crate::site) fn tracks(
    files: &[PathBuf],
    wanted: &Wanted,
    frame: &SiteFrame,
    given_up: &AtomicBool,
) -> Result<Option<Tracks>, RecordError> {
    let mut machines: BTreeMap<String, Gathering> = BTreeMap::new();
    let mut step = wanted.step.unwrap_or(STEP_USUAL).max(STEP_LEAST);
    let mut report_step = REPORT_STEP;
    let (mut poses, mut reports) = (0_usize, 0_usize);
    let whole = visit(files, given_up, |message| {
        if !wanted.covers(&message) || !matches!(message.topic, Topic::Pose | Topic::Odom | Topic::Health) {
            return;
        }
        let gathering = machines.entry(message.machine.clone()).or_default();
        match message.topic {
            Topic::Pose => poses += usize::from(gathering.pose(&message, step)),
            Topic::Odom => gathering.chassis(&message, step),
            _ => reports += usize::from(gathering.report(message, report_step)),
        }
        while poses > POSES_MAX {
            step = Span::from_nanos(2 * step.as_nanos());
            machines.values_mut().for_each(|gathering| gathering.thin_poses(step));
            poses = machines.values().map(|gathering| gathering.poses.len()).sum();
        }
        while reports > REPORTS_MAX + CHANGES_MAX {
            report_step = Span::from_nanos(2 * report_step.as_nanos());
            machines.values_mut().for_each(|gathering| gathering.thin_reports(report_step, reports));
            reports = machines.values().map(|gathering| gathering.reports.len()).sum();
        }
    })?;
    let track = |(id, gathering): (String, Gathering)| gathering.finish(id, frame);
    Ok(whole.then(|| Tracks { step, machines: machines.into_iter().map(track).collect() }))
}

/// Reads what happened in a session, in order of time. Refused readings are the first to be left out.
///
/// # Errors
/// [`RecordError`] if a file cannot be read. `Ok(None)` if nobody waits any more.
pub(in crate::site) fn events(
    files: &[PathBuf],
    wanted: &Wanted,
    given_up: &AtomicBool,
) -> Result<Option<Events>, RecordError> {
    let mut found = Events::default();
    let whole = visit(files, given_up, |message| {
        if message.topic != Topic::Event || !wanted.covers(&message) {
            return;
        }
        let Ok(event) = decode_event(&message.payload) else { return };
        found.events.push((Stamp::from_nanos(event.stamp_ns), message.machine, event));
        if found.events.len() >= 2 * EVENTS_MAX {
            found.thin();
        }
    })?;
    found.thin();
    Ok(whole.then_some(found))
}

impl Events {
    fn thin(&mut self) {
        self.events.sort_by(|(at, machine, _), (other_at, other, _)| (at, machine).cmp(&(other_at, other)));
        self.events.dedup();
        let before = self.events.len();
        if before > EVENTS_MAX {
            self.events.retain(|(.., event)| !matches!(event.what, EventKind::Refused { .. }));
        }
        self.events.truncate(EVENTS_MAX);
        self.left_out += (before - self.events.len()) as u64;
    }
}

/// Hands over all messages of the files; `false` if nobody waits any more.
fn visit(
    files: &[PathBuf],
    given_up: &AtomicBool,
    mut take: impl FnMut(Recorded<Vec<u8>>),
) -> Result<bool, RecordError> {
    let mut number = 0_u64;
    for path in files {
        for message in read_messages(path)? {
            number += 1;
            if number.is_multiple_of(LOOK_EVERY) && given_up.load(Ordering::Relaxed) {
                return Ok(false);
            }
            take(message?);
        }
    }
    Ok(true)
}

fn bin(at: Stamp, step: Span) -> i64 {
    at.as_nanos().div_euclid(step.as_nanos())
}

/// Keeps the first of each span.
fn thinned<T>(held: BTreeMap<i64, T>, step: Span, at: impl Fn(&T) -> Stamp) -> BTreeMap<i64, T> {
    let mut kept = BTreeMap::new();
    for value in held.into_values() {
        kept.entry(bin(at(&value), step)).or_insert(value);
    }
    kept
}

impl Gathering {
    fn observe_transit(&mut self, message: &Recorded<Vec<u8>>) -> Span {
        let transit = message.received - message.sent;
        self.transit = Some(self.transit.map_or(transit, |least| least.min(transit)));
        transit
    }

    fn heard_pose(&mut self, sent: Stamp) {
        let second = sent.as_nanos().div_euclid(SILENCE_BIN_NS);
        if let Some((first, last)) = self.seconds.get_mut(&second) {
            (*first, *last) = ((*first).min(sent), (*last).max(sent));
        } else if self.seconds.len() < SECONDS_MAX {
            self.seconds.insert(second, (sent, sent));
        }
    }

    /// Whether there is one more.
    fn pose(&mut self, message: &Recorded<Vec<u8>>, step: Span) -> bool {
        self.observe_transit(message);
        let (least, most, count) =
            self.counted.entry(message.boot).or_insert((message.sequence, message.sequence, 0));
        (*least, *most) = ((*least).min(message.sequence), (*most).max(message.sequence));
        *count += 1;
        self.heard_pose(message.sent);
        let bin = bin(message.sent, step);
        if self.poses.get(&bin).is_some_and(|(held, ..)| *held <= message.sent) {
            return false;
        }
        let sample = Odometry::decode(&message.payload).and_then(|message| aggregator::pose_sample(&message));
        let Ok(sample) = sample else { return false };
        let motion = sample.world_from_imu.motion();
        let finite = motion.translation.iter().chain(sample.covariance.iter()).all(|value| value.is_finite());
        finite && self.poses.insert(bin, (message.sent, message.boot, sample)).is_none()
    }

    fn chassis(&mut self, message: &Recorded<Vec<u8>>, step: Span) {
        let bin = bin(message.sent, step);
        // Those without a pose beside them are not needed: their number stays bounded.
        if !self.poses.contains_key(&bin)
            || self.chassis.get(&bin).is_some_and(|(held, _)| *held <= message.sent)
        {
            return;
        }
        let odom =
            Odometry::decode(&message.payload).and_then(|message| aggregator::odom_from_base(&message));
        if let Ok(odom) = odom {
            self.chassis.insert(bin, (message.sent, odom));
        }
    }

    fn report(&mut self, message: Recorded<Vec<u8>>, step: Span) -> bool {
        let transit = self.observe_transit(&message);
        let Ok(told) = decode_report(&message.payload) else { return false };
        let Ok(report) = aggregator::report(told) else { return false };
        self.software.clone_from(&report.software);
        let said = Said { boot: message.boot, report, transit };
        let before = self.reports.range(..=message.sent).next_back();
        let is_needed = before.is_none_or(|(at, before)| {
            bin(*at, step) != bin(message.sent, step) || before.state() != said.state()
        });
        is_needed && self.reports.insert(message.sent, said).is_none()
    }

    fn thin_poses(&mut self, step: Span) {
        self.poses = thinned(std::mem::take(&mut self.poses), step, |(at, ..)| *at);
        self.chassis = thinned(std::mem::take(&mut self.chassis), step, |(at, _)| *at);
    }

    /// Changes of the state stay, unless they alone are too many.
    fn thin_reports(&mut self, step: Span, held: usize) {
        let mut last: Option<(i64, (Mode, GnssState))> = None;
        let keep_changes = held <= REPORTS_MAX + 2 * CHANGES_MAX && step <= Span::from_millis(64_000);
        self.reports.retain(|at, said| {
            let this = (bin(*at, step), said.state());
            let keep = last.is_none_or(|last| last.0 != this.0 || (keep_changes && last.1 != this.1));
            if keep {
                last = Some(this);
            }
            keep
        });
    }

    fn finish(self, id: String, frame: &SiteFrame) -> Track {
        // Transit is never negative, and the shortest is milliseconds: more is the clock.
        let off = self.transit.unwrap_or_default();
        let is_off = off.as_nanos().abs() > CLOCK_OFF.as_nanos();
        let clock_shift = if is_off { off } else { Span::default() };
        let newest = self.reports.values().next_back();
        let name = newest.map(|said| said.report.name.clone()).filter(|name| !name.is_empty());
        let name = name.unwrap_or_else(|| id.clone());
        let pose_views: Vec<(Stamp, PoseView)> = self
            .poses
            .iter()
            .map(|(bin, (at, boot, sample))| {
                let before = self.reports.range(..=*at).next_back();
                // A pose before the first report of its boot: where the IMU sits was told right after.
                let said = before.filter(|(_, said)| said.boot == *boot);
                let said = said.or_else(|| self.reports.range(*at..).next());
                let odom = self.chassis.get(bin).and_then(|(_, odom)| *odom);
                let report = said.map(|(_, said)| &said.report);
                (*at + clock_shift, PoseView::recorded(sample, report, odom, frame))
            })
            .collect();
        let states = self.reports.iter().map(|(at, said)| {
            let at = *at + clock_shift;
            let next = pose_views.partition_point(|(pose_at, _)| *pose_at <= at);
            let pose = next.checked_sub(1).map(|index| &pose_views[index].1);
            let (word, severity) = recorded_word(&said.report, pose);
            let transit_s = said.transit.as_seconds() - clock_shift.as_seconds();
            (at, StatePoint::recorded(&said.report, word, severity, pose, transit_s))
        });
        let states = states.collect();
        let sent: u64 = self.counted.values().map(|(least, most, _)| most - least + 1).sum();
        let got: u64 = self.counted.values().map(|(.., count)| count).sum();
        Track {
            name,
            software: self.software,
            clock_shift,
            states,
            silences: silences(&self.seconds, clock_shift),
            poses_missing: sent.saturating_sub(got),
            poses: pose_views,
            id,
        }
    }
}

/// From the last pose before to the first one after.
fn silences(seconds: &BTreeMap<i64, (Stamp, Stamp)>, shift: Span) -> Vec<(Stamp, Stamp)> {
    let pairs = seconds.values().zip(seconds.values().skip(1));
    let gaps = pairs.map(|((_, last), (first, _))| (*last, *first));
    gaps.filter(|(from, to)| *to - *from >= SILENCE).map(|(from, to)| (from + shift, to + shift)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_is_told_to_the_pose_wherever_its_seconds_begin() {
        for phase_ms in [0, 1, 400, 600, 999] {
            let mut gathering = Gathering::default();
            let stamp = |millis: i64| Stamp::from_nanos((millis + phase_ms) * 1_000_000);
            // In the order of a backfill.
            for millis in [4_100, 6_100, 6_200, 0, 100, 900, 200, 2_100, 8_199] {
                gathering.heard_pose(stamp(millis));
            }
            let half = Span::from_millis(500);
            let expected =
                [(2_100, 4_100), (4_100, 6_100)].map(|(from, to)| (stamp(from) + half, stamp(to) + half));
            assert_eq!(silences(&gathering.seconds, half), expected, "{phase_ms}");
        }
    }

    #[test]
    fn thinning_keeps_the_first_of_each_span() {
        let held: BTreeMap<i64, Stamp> =
            (0..10).map(|index| (index, Stamp::from_nanos(index * 100 + 30))).collect();
        let kept = thinned(held, Span::from_nanos(250), |at| *at);
        let times: Vec<i64> = kept.values().map(|at| at.as_nanos()).collect();
        assert_eq!(times, [30, 330, 530, 830]);
    }
}
