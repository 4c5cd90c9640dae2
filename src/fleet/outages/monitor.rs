//! One machine's fixes, and the outage that goes on.

use super::budget::{Budget, budget};
use super::shadow::Shadow;
use super::thinned::Thinned;
use super::view::{CurrentOutage, GnssView};
use super::{CellKey, CellTime, Ending, FLOAT_SIGMA_M, FixState, Outage, SigmaSample, TrackPoint};
use crate::fleet::PoseSample;
use crate::fleet::view::UtcTime;
use crate::lie::Vec3;
use crate::state::{Health, Mode, OutageReport};
use crate::time::{Span, Stamp};

/// Sigma is sampled so often at first, s, and the track so densely, m.
const SIGMA_SPACING_S: f64 = 0.5;
const TRACK_SPACING_M: f64 = 0.25;
/// Where the machine tells no way, steps shorter than this are noise, m.
const STEP_MIN_M: f64 = 0.05;
/// What the receiver reported so long ago says nothing any more.
const REPORTED_SIGMA_AGE_MAX: Span = Span::from_millis(2_000);
/// An outage that goes on is told again so often.
const TOLD_EVERY: Span = Span::from_millis(1_000);

/// An outage that began, goes on or ended, as it stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// The outage.
    pub outage: Outage,
    /// It began and ended while the site did not hear the machine: it may be known already from before.
    pub told_late: bool,
}

#[derive(Debug)]
pub(in crate::fleet) struct Monitor {
    machine: String,
    state: FixState,
    since: Stamp,
    /// What the machine said last, once it did.
    told: Option<FixState>,
    mode: Option<Mode>,
    /// The largest horizontal sigma that the receiver reported of its newest fix, m.
    reported_sigma_m: Option<(f64, Stamp)>,
    heard: Option<Stamp>,
    position: Option<Vec3>,
    sigma_m: Option<f64>,
    open: Option<Outage>,
    /// From where the way of an outage is counted, if the machine does not tell it.
    step_from: Option<Vec3>,
    /// The machine's name of the last outage that is over: it goes on telling it.
    over: Option<(u64, i64)>,
    told_at: Option<Stamp>,
    changes: Vec<Change>,
    shadow: Shadow,
}

impl Monitor {
    /// `carried_on` is an outage that went on when the site server ended.
    pub fn new(machine: &str, carried_on: Option<Outage>, now: Stamp) -> Self {
        Self {
            machine: machine.to_owned(),
            state: FixState::LinkLost,
            since: now,
            told: None,
            mode: None,
            reported_sigma_m: None,
            heard: None,
            position: None,
            sigma_m: None,
            open: carried_on,
            step_from: None,
            over: None,
            told_at: None,
            changes: Vec::new(),
            shadow: Shadow::default(),
        }
    }

    /// What the receiver reports of a fix: the larger horizontal sigma, m.
    pub fn fix(&mut self, sigma_m: f64, now: Stamp) {
        self.reported_sigma_m = Some((sigma_m, now));
    }

    pub fn pose(&mut self, sample: &PoseSample, now: Stamp) {
        let position = sample.world_from_imu.translation();
        let sigma_m = worst_horizontal_sigma(sample);
        self.heard = Some(now);
        self.position = Some(position);
        self.sigma_m = Some(sigma_m);
        self.shadow.count(&position, self.state, now);
        let Some(outage) = self.open.as_mut().filter(|outage| outage.cause != FixState::LinkLost) else {
            return;
        };
        let time_s = now.seconds_since(outage.start);
        outage.last_heard = now;
        outage.sigma_m = Some(sigma_m);
        outage.sigma_start_m.get_or_insert(sigma_m);
        outage.sigma_max_m = Some(outage.sigma_max_m.map_or(sigma_m, |most| most.max(sigma_m)));
        outage.place_m.get_or_insert(position.into());
        let step_from = *self.step_from.get_or_insert(position);
        let step_m = (position - step_from).norm();
        if step_m >= STEP_MIN_M {
            self.step_from = Some(position);
            if outage.machine_start_ns.is_none() {
                outage.travelled_m = Some(outage.travelled_m.unwrap_or(0.0) + step_m);
            }
        }
        let travelled_m = outage.travelled_m.unwrap_or(0.0);
        outage.sigma.push(time_s, || SigmaSample { time_s, travelled_m, sigma_m });
        outage.track.push_apart(
            |last| (position - Vec3::from(last.position_m)).norm(),
            || TrackPoint { time_s, position_m: position.into() },
        );
    }

    /// What the machine says. [`Monitor::advance`] is to follow.
    pub fn report(&mut self, health: &Health, boot: Option<u64>, now: Stamp) {
        let heard_before = self.heard.replace(now);
        self.told = Some(health.gnss.into());
        self.mode = Some(health.mode);
        let site_time =
            |stamp_ns: i64| now - (Stamp::from_nanos(health.stamp_ns) - Stamp::from_nanos(stamp_ns));
        let told = health.outage.as_ref();
        if let Some(outage) = &mut self.open
            && let Some((end, ending)) = outage.follow(health, boot, now)
        {
            outage.jump_m = told.filter(|_| ending == Ending::Recovered).and_then(|told| told.jump_m);
            self.end(end, ending);
        }
        if self.open.is_some() {
            return;
        }
        match told {
            Some(told) if told.end_stamp_ns.is_none() => {
                let start = site_time(told.start_stamp_ns).min(now);
                self.begin(told.cause.into(), start, Some(told), boot, now);
            }
            // It says so as long as there is no other.
            Some(told) if boot.is_none_or(|boot| self.over != Some((boot, told.start_stamp_ns))) => {
                self.begin_and_end_late(told, boot, site_time, heard_before);
            }
            _ => {}
        }
        let holds = matches!(health.mode, Mode::Fallback | Mode::ImuOnly);
        if self.open.is_none() && holds && !FixState::from(health.gnss).is_good() {
            // From software that tells no outages, or for the moment before it does.
            self.begin(health.gnss.into(), now, None, boot, now);
        }
    }

    /// The one place where the state of the fixes changes. `linked` says whether the machine is heard.
    pub fn advance(&mut self, linked: bool, now: Stamp) {
        let told = self.told.filter(|_| linked);
        let reported = self.reported_sigma_m.filter(|(_, at)| now - *at <= REPORTED_SIGMA_AGE_MAX);
        let is_float = reported.is_some_and(|(sigma_m, _)| sigma_m > FLOAT_SIGMA_M);
        let state = match told {
            None => FixState::LinkLost,
            Some(FixState::Fixed) if is_float => FixState::Float,
            Some(state) => state,
        };
        if state != self.state {
            self.state = state;
            self.since = now;
        }
        let open = self.open.as_ref().map(|outage| outage.cause);
        if state == FixState::LinkLost && self.told.is_some() && open.is_none() {
            let start = self.heard.unwrap_or(now).min(now);
            self.begin(FixState::LinkLost, start, None, None, now);
        }
        if state != FixState::LinkLost && open == Some(FixState::LinkLost) {
            self.end(now, Ending::LinkBack);
        }
        let is_due = self.told_at.is_none_or(|told_at| now - told_at >= TOLD_EVERY);
        if let Some(outage) = self.open.as_ref().filter(|_| is_due) {
            self.told_at = Some(now);
            self.changes.push(Change { outage: outage.clone(), told_late: false });
        }
    }

    fn begin(
        &mut self,
        cause: FixState,
        start: Stamp,
        told: Option<&OutageReport>,
        boot: Option<u64>,
        now: Stamp,
    ) {
        let place_m = self.position.map(Vec3::into);
        self.step_from = self.position;
        let heard_now = cause != FixState::LinkLost;
        let sigma_m = self.sigma_m.filter(|_| heard_now);
        let mut outage = Outage {
            id: self.name(told, boot, start),
            machine: self.machine.clone(),
            boot,
            cause,
            start,
            machine_start_ns: told.map(|told| told.start_stamp_ns),
            end: None,
            ended_by: None,
            last_heard: if heard_now { now } else { start },
            travelled_m: heard_now.then(|| told.map_or(0.0, |told| told.travelled_m)),
            jump_m: None,
            sigma_start_m: sigma_m,
            sigma_m,
            sigma_max_m: sigma_m,
            place_m,
            sigma: Thinned::new(SIGMA_SPACING_S),
            track: Thinned::new(TRACK_SPACING_M),
        };
        if let Some(position_m) = place_m {
            outage.track.push(0.0, || TrackPoint { time_s: 0.0, position_m });
        }
        self.told_at = Some(now);
        self.changes.push(Change { outage: outage.clone(), told_late: false });
        self.open = Some(outage);
    }

    fn end(&mut self, end: Stamp, ending: Ending) {
        let Some(mut outage) = self.open.take() else { return };
        outage.end = Some(end.max(outage.start));
        outage.ended_by = Some(ending);
        if let (Some(boot), Some(start)) = (outage.boot, outage.machine_start_ns) {
            self.over = Some((boot, start));
        }
        self.changes.push(Change { outage, told_late: false });
    }

    /// The machine tells an outage that is over, and that the site did not hear of.
    fn begin_and_end_late(
        &mut self,
        told: &OutageReport,
        boot: Option<u64>,
        site_time: impl Fn(i64) -> Stamp,
        heard_before: Option<Stamp>,
    ) {
        let (Some(boot), Some(end_ns)) = (boot, told.end_stamp_ns) else { return };
        self.over = Some((boot, told.start_stamp_ns));
        let (start, end) = (site_time(told.start_stamp_ns), site_time(end_ns));
        let outage = Outage {
            id: self.name(Some(told), Some(boot), start),
            machine: self.machine.clone(),
            boot: Some(boot),
            cause: told.cause.into(),
            start,
            machine_start_ns: Some(told.start_stamp_ns),
            end: Some(end.max(start)),
            ended_by: Some(Ending::Recovered),
            last_heard: heard_before.unwrap_or(start).clamp(start, end.max(start)),
            travelled_m: Some(told.travelled_m),
            jump_m: told.jump_m,
            sigma_start_m: None,
            sigma_m: None,
            sigma_max_m: None,
            place_m: None,
            sigma: Thinned::new(SIGMA_SPACING_S),
            track: Thinned::new(TRACK_SPACING_M),
        };
        self.changes.push(Change { outage, told_late: true });
    }

    /// The same for the same outage, however often and by whichever run of the site server it is heard of.
    fn name(&self, told: Option<&OutageReport>, boot: Option<u64>, start: Stamp) -> String {
        let machine = &self.machine;
        match (told, boot) {
            (Some(told), Some(boot)) => format!("{machine}.{boot:016x}.{}", told.start_stamp_ns),
            _ => format!("{machine}.site.{}", start.as_nanos()),
        }
    }

    /// Outages that began, ended, or go on and were not told for a second.
    pub fn take_changes(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    pub fn take_cells(&mut self) -> std::collections::BTreeMap<CellKey, CellTime> {
        self.shadow.take()
    }

    /// The budget that is left, in an outage that the machine tells of.
    fn budget(&self, outage: &Outage, tolerance_m: f64, now: Stamp) -> Option<Budget> {
        let newest = SigmaSample {
            time_s: outage.last_heard.min(now).seconds_since(outage.start),
            travelled_m: outage.travelled_m.unwrap_or(0.0),
            sigma_m: outage.sigma_m?,
        };
        budget(outage.sigma.samples(), newest, tolerance_m)
    }

    pub fn view(&self, tolerance_m: f64, now: Stamp) -> GnssView {
        GnssView {
            state: self.state,
            since: UtcTime(self.since),
            mode: self.mode,
            outage: self.open.as_ref().map(|outage| CurrentOutage {
                id: outage.id.clone(),
                cause: outage.cause,
                start: UtcTime(outage.start),
                duration_s: outage.duration_s(now),
                travelled_m: outage.travelled_m,
                position_sigma_m: outage.sigma_m,
                budget: self.budget(outage, tolerance_m, now),
            }),
        }
    }
}

impl Outage {
    /// Takes in what the machine says while this outage goes on; returns when and how it ended, if it did.
    fn follow(&mut self, health: &Health, boot: Option<u64>, now: Stamp) -> Option<(Stamp, Ending)> {
        if self.cause == FixState::LinkLost {
            return Some((now, Ending::LinkBack));
        }
        if self.boot != boot {
            return Some((self.last_heard, Ending::Restarted));
        }
        let told = health.outage.as_ref();
        let Some(told) = told.filter(|told| self.machine_start_ns.is_none() || self.is_named(told)) else {
            if self.machine_start_ns.is_some() {
                return Some((self.last_heard, Ending::Unheard));
            }
            let holds = matches!(health.mode, Mode::Fallback | Mode::ImuOnly);
            self.last_heard = now;
            return (!holds || FixState::from(health.gnss).is_good()).then_some((now, Ending::Recovered));
        };
        if self.machine_start_ns.is_none() {
            // Found by its mode before the machine said so.
            if told.end_stamp_ns.is_some() {
                return (FixState::from(health.gnss).is_good()).then_some((now, Ending::Recovered));
            }
            self.machine_start_ns = Some(told.start_stamp_ns);
        }
        self.travelled_m = Some(told.travelled_m);
        let Some(end_ns) = told.end_stamp_ns else {
            self.last_heard = now;
            return None;
        };
        let ago = Stamp::from_nanos(health.stamp_ns) - Stamp::from_nanos(end_ns);
        Some(((now - ago).min(now), Ending::Recovered))
    }

    fn is_named(&self, told: &OutageReport) -> bool {
        self.machine_start_ns == Some(told.start_stamp_ns)
    }
}

/// Square root of the larger eigenvalue of the horizontal position's covariance, m.
fn worst_horizontal_sigma(sample: &PoseSample) -> f64 {
    let covariance = &sample.covariance;
    let mean = 0.5 * (covariance[(0, 0)] + covariance[(1, 1)]);
    let half = 0.5 * (covariance[(0, 0)] - covariance[(1, 1)]);
    (mean + half.hypot(covariance[(0, 1)])).max(0.0).sqrt()
}
