//! What the rules look at, out of what the fleet shows.

use super::{Observation, RuleKind, Subject};
use crate::fleet::{FixState, FleetView, HEALTH_AGE_MAX, MachineView, Presence, SIGMAS_95};

/// What the rules look at beside the machines.
#[derive(Clone, Debug, Default)]
pub struct SiteState {
    /// Room on the disk of the recordings; `None` if nothing is recorded, or nobody knows.
    pub disk_free_bytes: Option<u64>,
    /// The site's tolerance: one sigma, m.
    pub tolerance_m: f64,
    /// For how long what should be recorded is not; `None` if nobody wants to record.
    pub unrecorded: Option<Unrecorded>,
}

/// For how long what should be recorded is not.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Unrecorded {
    /// 0 if it is, s.
    pub for_s: f64,
    /// Why it is not, in words.
    pub why: String,
}

/// One for each rule and what it can be about, also where all is well.
pub fn observations(fleet: &FleetView, site: &SiteState) -> Vec<Observation> {
    let disk_gb = site.disk_free_bytes.map(|bytes| bytes as f64 / 1e9);
    let of_site = |rule| Subject { rule, machine: None, part: None };
    let why = site.unrecorded.as_ref().map_or("", |unrecorded| &unrecorded.why);
    let mut observations = vec![
        Observation {
            subject: of_site(RuleKind::DiskLow),
            value: disk_gb,
            message: format!("the recordings' disk has {:.1} GB left", disk_gb.unwrap_or(0.0)),
        },
        Observation {
            subject: of_site(RuleKind::RecordingPaused),
            // Who stops the recording has seen that it was paused.
            value: Some(site.unrecorded.as_ref().map_or(0.0, |unrecorded| unrecorded.for_s)),
            message: why.to_owned(),
        },
    ];
    for machine in &fleet.machines {
        of_machine(machine, fleet, site.tolerance_m, &mut observations);
    }
    observations
}

fn of_machine(machine: &MachineView, fleet: &FleetView, tolerance_m: f64, into: &mut Vec<Observation>) {
    let id = &machine.id;
    let mut add = |rule: RuleKind, part: Option<&str>, value: Option<f64>, message: String| {
        let subject = Subject { rule, machine: Some(id.clone()), part: part.map(str::to_owned) };
        into.push(Observation { subject, value, message });
    };
    let away = !machine.presence.is_heard();
    let away_s = fleet.time.0.seconds_since(machine.presence_since.0).max(0.0);
    let word = if machine.presence == Presence::Lost { "is not connected" } else { "says nothing new" };
    add(RuleKind::MachineLost, None, Some(if away { away_s } else { 0.0 }), format!("{id} {word}"));

    let message = format!("two machines say that they are {id}: one is refused until the other has ended");
    add(RuleKind::IdConflict, None, Some(machine.id_conflict_s.unwrap_or(0.0)), message);

    // Of a machine that is not heard nothing else is known.
    let health = machine.health.as_ref().filter(|health| health.age_s <= HEALTH_AGE_MAX.as_seconds());
    let health = health.filter(|_| machine.presence != Presence::Lost);
    let outage = machine.gnss.outage.as_ref().filter(|outage| outage.cause != FixState::LinkLost);
    let outage_s = outage.map_or(0.0, |outage| outage.duration_s);
    let cause = outage.map_or("", |outage| outage.cause.name());
    let message = format!("{id} is without GNSS ({cause}) for {outage_s:.0} s");
    add(RuleKind::OutageLonger, None, health.map(|_| outage_s), message);

    let pose = machine.pose.as_ref().filter(|_| machine.presence == Presence::Online);
    let sigma_m = pose.map(|pose| pose.ellipse95.semi_major_m / SIGMAS_95);
    let message = format!(
        "{id}: one sigma of the position is {:.1} cm, the site tolerates {:.1} cm",
        100.0 * sigma_m.unwrap_or(0.0),
        100.0 * tolerance_m
    );
    add(RuleKind::SigmaOverTolerance, None, sigma_m.map(|sigma_m| sigma_m / tolerance_m), message);

    let offset_s = machine.link.clock_offset_s.filter(|_| health.is_some());
    let message = format!("{id}: its clock is {:+.3} s off the site's", -offset_s.unwrap_or(0.0));
    add(RuleKind::ClockOff, None, offset_s.map(f64::abs), message);

    let late_s = health.and_then(|health| health.estimate_age_s);
    let message = format!("{id}: its newest estimate is {:.2} s old when told", late_s.unwrap_or(0.0));
    add(RuleKind::EstimatorLate, None, late_s, message);

    for sensor in health.map_or(&[][..], |health| &health.report.sensors) {
        let name = sensor.sensor.name();
        let message = format!("{id}: {name} is silent for {:.1} s", sensor.age_s.unwrap_or(0.0));
        add(RuleKind::SensorSilent, Some(name), sensor.age_s, message);
    }
}
