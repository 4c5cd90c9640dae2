//! Where machines were: a thin trail of the last hour, for those who come late.

use std::collections::BTreeMap;

use serde::Serialize;

use super::MACHINES_MAX;
use super::last_hour::{LastHour, POINTS_MAX, Point};
use super::view::{FleetView, Presence, UtcTime};
use crate::state::{GnssState, Mode};
use crate::time::{Span, Stamp};

/// From one point to the next, at least.
const EVERY: Span = Span::from_millis(1_000);
/// The most points of one machine.
pub const TRAIL_POINTS_MAX: usize = POINTS_MAX;

/// Where a machine was at one time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct TrailPoint {
    /// When it arrived, by the site's clock.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub time: UtcTime,
    /// By the machine's stamps.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub stamp: UtcTime,
    /// Of the cabin IMU in the site frame: east, north, up, m.
    pub position_m: [f64; 3],
    /// Of the cabin IMU, degrees.
    pub latitude_deg: f64,
    /// Of the cabin IMU, degrees.
    pub longitude_deg: f64,
    /// Of the cabin's axis in the site frame: east, north, up, m.
    pub cabin_position_m: [f64; 3],
    /// Of the cabin's x axis: 0 is the site's north, clockwise, [0, 360).
    pub heading_deg: f64,
    /// The longer half axis of the ellipse in which it is with 95 % probability, m.
    pub semi_major_m: f64,
    /// Mode of the estimator; `null` if it is not known.
    pub mode: Option<Mode>,
    /// What could be said of its fixes; `null` if it is not known.
    pub gnss: Option<GnssState>,
}

impl Point for TrailPoint {
    fn changed_from(&self, before: &Self) -> bool {
        (self.mode, self.gnss) != (before.mode, before.gnss)
    }

    fn tells(&self) -> f64 {
        self.semi_major_m
    }
}

/// The trails of all machines.
#[derive(Debug, Default)]
pub struct Trails(BTreeMap<String, LastHour<TrailPoint>>);

impl Trails {
    /// Adds the machines that are online and have a new pose.
    pub fn observe(&mut self, view: &FleetView) {
        for machine in view.machines.iter().filter(|machine| machine.presence == Presence::Online) {
            let Some(pose) = &machine.pose else { continue };
            let time = view.time.0 - Span::from_seconds(pose.age_s);
            let trail = self.0.get(&machine.id);
            let last = trail.and_then(LastHour::last).map(|(_, last)| last);
            let is_due = last.is_none_or(|last| time - last.time.0 >= EVERY && last.stamp != pose.stamp);
            if !is_due || (trail.is_none() && self.0.len() >= MACHINES_MAX) {
                continue;
            }
            let point = TrailPoint {
                time: UtcTime(time),
                stamp: pose.stamp,
                position_m: pose.position_m,
                latitude_deg: pose.latitude_deg,
                longitude_deg: pose.longitude_deg,
                cabin_position_m: pose.cabin_position_m,
                heading_deg: pose.heading_deg,
                semi_major_m: pose.ellipse95.semi_major_m,
                mode: machine.health.as_ref().map(|health| health.report.mode),
                gnss: machine.health.as_ref().map(|health| health.report.gnss),
            };
            self.0.entry(machine.id.clone()).or_default().push(time, point);
        }
    }

    /// Points of a machine that arrived after `since` and in the last hour, `limit` at most, oldest first; and whether
    /// there are more.
    pub fn points(
        &self,
        machine: &str,
        since: Option<Stamp>,
        limit: usize,
        now: Stamp,
    ) -> (Vec<TrailPoint>, bool) {
        let Some(trail) = self.0.get(machine) else { return (Vec::new(), false) };
        let (points, more) = trail.points(since, limit, now);
        (points.map(|(_, point)| *point).collect(), more)
    }
}
