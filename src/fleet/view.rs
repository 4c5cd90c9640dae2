//! What the API says of the fleet: units in the names, times as RFC 3339, words that a person can act on.

use std::fmt;

use serde::{Serialize, Serializer};

use super::{GnssView, MachineReport, POSE_AGE_MAX, PoseSample};
use crate::frames::geodesy::{Geodetic, SiteFrame};
use crate::frames::{Base, Cabin, Odom, Pose, World};
use crate::lie::Vec3;
use crate::state::{GnssState, Health, Mode};
use crate::time::Stamp;

/// Half axes of the 95 % ellipse in standard deviations: the root of the 95 % quantile of χ² with two degrees
/// of freedom, √(-2 ln 0.05).
pub const SIGMAS_95: f64 = 2.447_746_830_680_816;
/// Semi-major axis of the 95 % ellipse up to which a position without GNSS is called a warning, m.
const HOLDING_BAD_ABOVE_M: f64 = 0.10;

/// A point in time that is written as RFC 3339 in UTC with nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UtcTime(pub Stamp);

impl fmt::Display for UtcTime {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let timestamp = jiff::Timestamp::from_nanosecond(i128::from(self.0.as_nanos()))
            .expect("every stamp is in jiff's range, which reaches from year -9999 to 9999");
        write!(formatter, "{timestamp:.9}")
    }
}

impl Serialize for UtcTime {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// The whole site at one time.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct FleetView {
    /// The site.
    pub site: SiteView,
    /// By the site's clock; ages count up to it.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub time: UtcTime,
    /// In the order of their ids.
    pub machines: Vec<MachineView>,
}

/// The site.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct SiteView {
    /// As in keys.
    pub id: String,
    /// For people.
    pub name: String,
    /// IANA name of the time zone in which the site's days and shifts begin.
    pub time_zone: String,
    /// Origin of the site frame.
    pub world: WorldView,
    /// Version of the site server.
    pub software: String,
}

/// Origin of the site frame (ENU), WGS84.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct WorldView {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Above the ellipsoid, m.
    pub altitude_m: f64,
}

impl From<Geodetic> for WorldView {
    fn from(origin: Geodetic) -> Self {
        let Geodetic { latitude_deg, longitude_deg, altitude_m } = origin;
        Self { latitude_deg, longitude_deg, altitude_m }
    }
}

/// Whether a machine is there. `online`: it is connected, and its newest pose is at most half a second old, or three
/// times the usual time between two, or, before its estimator has started, its newest health at most 2.5 s. `stale`: it
/// is connected, and they are older. `restarted`: it is connected with another boot than before, its health is young, and
/// it has not said yet where it is. `lost`: it is not connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Presence {
    /// Connected, and its data are young.
    Online,
    /// Connected, but its data are old.
    Stale,
    /// Connected with another boot than before, which is heard but has not said yet where the machine is.
    Restarted,
    /// Not connected.
    Lost,
}

impl Presence {
    /// The name in JSON and metrics.
    pub const fn name(self) -> &'static str {
        match self {
            Presence::Online => "online",
            Presence::Stale => "stale",
            Presence::Restarted => "restarted",
            Presence::Lost => "lost",
        }
    }

    /// Whether it is connected and says something: online, or on its way there.
    pub const fn is_heard(self) -> bool {
        matches!(self, Presence::Online | Presence::Restarted)
    }
}

/// How much a machine's state asks for attention.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// As it should be.
    Good,
    /// Works less well; look at it.
    Warning,
    /// Do not rely on its position.
    Bad,
    /// Not connected.
    Offline,
}

impl Severity {
    /// The name in JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Severity::Good => "good",
            Severity::Warning => "warning",
            Severity::Bad => "bad",
            Severity::Offline => "offline",
        }
    }
}

/// One machine at one time.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct MachineView {
    /// As in keys.
    pub id: String,
    /// For people; the id as long as the machine has not said its name.
    pub name: String,
    /// Whether it is there.
    pub presence: Presence,
    /// Since when.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub presence_since: UtcTime,
    /// 16 hex digits, drawn at each start of the machine's software; empty if not known yet.
    pub boot: String,
    /// Version of its software; empty if not known yet.
    pub software: String,
    /// The state in a few words.
    pub state_word: String,
    /// How much it asks for attention.
    pub severity: Severity,
    /// The newest pose, however old it is.
    pub pose: Option<PoseView>,
    /// The newest health, however old it is.
    pub health: Option<HealthView>,
    /// Its fixes, and the outage that goes on.
    pub gnss: GnssView,
    /// How good its link is.
    pub link: LinkView,
    /// For how long another machine has said that it has this id, s; `None` if none does. People read it in
    /// `state_word`.
    #[serde(skip)]
    pub id_conflict_s: Option<f64>,
}

/// Where a machine is.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct PoseView {
    /// By the machine's stamps.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub stamp: UtcTime,
    /// Since it arrived, by the site's clock, s.
    pub age_s: f64,
    /// Older than this it is old, s: three times the usual time between two poses, half a second at least.
    pub fresh_s: f64,
    /// Of the cabin IMU in the site frame: east, north, up, m.
    pub position_m: [f64; 3],
    /// Of the cabin IMU, degrees.
    pub latitude_deg: f64,
    /// Of the cabin IMU, degrees.
    pub longitude_deg: f64,
    /// Of the cabin IMU, above the ellipsoid, m.
    pub altitude_m: f64,
    /// Origin of the cabin frame, on the axis about which the cabin turns: where to draw the machine, m.
    pub cabin_position_m: [f64; 3],
    /// Of the cabin's x axis: 0 is the site's north, clockwise, [0, 360).
    pub heading_deg: f64,
    /// One sigma.
    pub heading_sigma_deg: f64,
    /// Of the chassis' x axis, where the cabin-turn angle is known.
    pub chassis_heading_deg: Option<f64>,
    /// Origin of the chassis frame in the site frame, m.
    pub chassis_position_m: Option<[f64; 3]>,
    /// Of the cabin IMU, m/s.
    pub speed_mps: f64,
    /// One sigma of `position_m`: east, north, up, m.
    pub position_sigma_m: [f64; 3],
    /// Where the cabin IMU is with 95 % probability, in the horizontal plane.
    pub ellipse95: Ellipse95,
}

/// An ellipse in the horizontal plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Ellipse95 {
    /// The longer half axis, m.
    pub semi_major_m: f64,
    /// The shorter half axis, m.
    pub semi_minor_m: f64,
    /// Direction of the longer axis: 0 is the site's north, clockwise, [0, 180).
    pub bearing_deg: f64,
}

/// What a machine's estimator says of itself.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct HealthView {
    /// Since it arrived, by the site's clock, s.
    pub age_s: f64,
    /// From the newest estimate to the report, by the machine's clock, s; `null` before the start.
    pub estimate_age_s: Option<f64>,
    /// From an IMU sample to its estimate, 99 % of them over the last second, µs; `null` if it does not tell.
    pub prediction_p99_us: Option<f64>,
    /// As the machine sent it.
    pub report: Health,
}

/// How good the link to a machine is.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct LinkView {
    /// Poses that arrived in the last second.
    pub pose_rate_hz: f64,
    /// Messages that arrived, of all topics.
    pub received: u64,
    /// Messages that were sent but did not arrive, by their sequence numbers.
    pub missed: u64,
    /// Messages that arrived but could not be used.
    pub refused: u64,
    /// Messages that the recording lacks so far; they are fetched from the machine's own record.
    pub gaps_open: u64,
    /// Messages that the recording lacked, and that were fetched.
    pub gaps_filled: u64,
    /// Messages that will never be in the recording.
    pub gaps_lost: u64,
    /// The site's clock less the machine's, plus the shortest transit, s.
    pub clock_offset_s: Option<f64>,
}

impl HealthView {
    /// Of a report that arrived `age_s` ago.
    pub(super) fn new(report: &MachineReport, age_s: f64) -> Self {
        Self {
            age_s,
            estimate_age_s: report.estimate_age_s,
            prediction_p99_us: report.prediction_p99_us,
            report: report.health.clone(),
        }
    }
}

/// The state in a few words as it was when this was reported: that the machine was there is sure.
pub fn recorded_word(report: &MachineReport, pose: Option<&PoseView>) -> (String, Severity) {
    state_word(Presence::Online, 0.0, Some(&HealthView::new(report, 0.0)), pose)
}

impl PoseView {
    /// Of a pose as it was when it was sent.
    pub fn recorded(
        sample: &PoseSample,
        report: Option<&MachineReport>,
        odom_from_base: Option<Pose<Odom, Base>>,
        frame: &SiteFrame,
    ) -> Self {
        Self::new(sample, 0.0, report, odom_from_base, frame)
    }

    pub(super) fn new(
        sample: &PoseSample,
        age_s: f64,
        report: Option<&MachineReport>,
        odom_from_base: Option<Pose<Odom, Base>>,
        frame: &SiteFrame,
    ) -> Self {
        let cabin_from_imu = report.map_or_else(Pose::identity, |report| report.cabin_from_imu);
        let world_from_cabin: Pose<World, Cabin> = sample.world_from_imu * cabin_from_imu.inverse();
        let world_from_odom = report.and_then(|report| report.world_from_odom);
        let world_from_base = world_from_odom.zip(odom_from_base).map(|(world, odom)| world * odom);
        let position = sample.world_from_imu.translation();
        let geodetic = frame.to_geodetic(&position);
        let covariance = &sample.covariance;
        let sigma = |axis: usize| covariance[(axis, axis)].max(0.0).sqrt();
        Self {
            stamp: UtcTime(sample.stamp),
            age_s,
            fresh_s: POSE_AGE_MAX.as_seconds(),
            position_m: position.into(),
            latitude_deg: geodetic.latitude_deg,
            longitude_deg: geodetic.longitude_deg,
            altitude_m: geodetic.altitude_m,
            cabin_position_m: world_from_cabin.translation().into(),
            heading_deg: heading_deg(&world_from_cabin),
            heading_sigma_deg: sigma(5).to_degrees(),
            chassis_heading_deg: world_from_base.as_ref().map(heading_deg),
            chassis_position_m: world_from_base.map(|pose| pose.translation().into()),
            speed_mps: sample.speed_mps,
            position_sigma_m: [sigma(0), sigma(1), sigma(2)],
            ellipse95: Ellipse95::of(covariance[(0, 0)], covariance[(0, 1)], covariance[(1, 1)]),
        }
    }
}

impl Ellipse95 {
    /// Of a horizontal covariance: east-east, east-north, north-north, m².
    fn of(east: f64, mixed: f64, north: f64) -> Self {
        // Eigenvalues of a symmetric 2×2 matrix; the angle of the major axis from east, counterclockwise.
        let centre = 0.5 * (east + north);
        let radius = (0.5 * (east - north)).hypot(mixed);
        let angle = 0.5 * (2.0 * mixed).atan2(east - north);
        Self {
            semi_major_m: SIGMAS_95 * (centre + radius).max(0.0).sqrt(),
            semi_minor_m: SIGMAS_95 * (centre - radius).max(0.0).sqrt(),
            bearing_deg: wrapped(90.0 - angle.to_degrees(), 180.0),
        }
    }
}

/// Compass heading of the x axis of `Child`.
fn heading_deg<Child>(world_from_child: &Pose<World, Child>) -> f64 {
    let forward = world_from_child.rotation() * Vec3::x();
    wrapped(forward.x.atan2(forward.y).to_degrees(), 360.0)
}

/// Into [0, period): `rem_euclid` alone gives the period itself for tiny negative values.
fn wrapped(angle_deg: f64, period_deg: f64) -> f64 {
    let wrapped = angle_deg.rem_euclid(period_deg);
    if wrapped >= period_deg { 0.0 } else { wrapped }
}

/// The state in a few words; `since_s` is how long the presence is what it is.
pub(super) fn state_word(
    presence: Presence,
    since_s: f64,
    health: Option<&HealthView>,
    pose: Option<&PoseView>,
) -> (String, Severity) {
    match presence {
        Presence::Lost => return (format!("OFFLINE {}", minutes(since_s)), Severity::Offline),
        Presence::Stale => return (format!("STALE {}", minutes(since_s)), Severity::Bad),
        Presence::Restarted => {
            let waits_for = health.and_then(|health| health.report.waits_for.as_deref());
            let waits_for = waits_for.map_or_else(String::new, |waits_for| format!(": {waits_for}"));
            return (format!("RESTARTED {}{waits_for}", minutes(since_s)), Severity::Warning);
        }
        Presence::Online => {}
    }
    let Some(health) = health else { return ("CONNECTING".to_owned(), Severity::Warning) };
    let report = &health.report;
    match report.mode {
        Mode::Initializing => {
            let waits_for = report.waits_for.as_deref().unwrap_or("starting");
            (format!("INITIALIZING: {waits_for}"), Severity::Warning)
        }
        Mode::Main => match report.gnss {
            GnssState::Fixed => ("RTK FIXED".to_owned(), Severity::Good),
            GnssState::Degraded => ("DEGRADED".to_owned(), Severity::Warning),
            GnssState::Frozen => ("FROZEN".to_owned(), Severity::Warning),
            GnssState::Jumping => ("JUMPING".to_owned(), Severity::Warning),
            GnssState::Silent => ("NO FIXES".to_owned(), Severity::Warning),
            GnssState::Recovering => ("RECOVERING".to_owned(), Severity::Warning),
        },
        Mode::Fallback => {
            let semi_major_m = pose.map_or(f64::INFINITY, |pose| pose.ellipse95.semi_major_m);
            let severity = if semi_major_m > HOLDING_BAD_ABOVE_M { Severity::Bad } else { Severity::Warning };
            (format!("HOLDING{}", budget(health)), severity)
        }
        Mode::ImuOnly => (format!("IMU ONLY{}", budget(health)), Severity::Bad),
    }
}

/// ` 0:42, 3.1 m, 2.4 cm`: how long without GNSS, how far, and one sigma of the position.
fn budget(health: &HealthView) -> String {
    let report = &health.report;
    let mut text = String::new();
    if let Some(outage) = report.outage.as_ref().filter(|outage| outage.end_stamp_ns.is_none()) {
        let start = Stamp::from_nanos(outage.start_stamp_ns);
        let held_s = Stamp::from_nanos(report.stamp_ns).seconds_since(start) + health.age_s;
        text.push_str(&format!(" {}, {:.1} m", minutes(held_s), outage.travelled_m));
    }
    if let Some(sigma_m) = report.position_sigma_m {
        let separator = if text.is_empty() { " " } else { ", " };
        let sigma =
            if sigma_m < 1.0 { format!("{:.1} cm", sigma_m * 100.0) } else { format!("{sigma_m:.1} m") };
        text.push_str(separator);
        text.push_str(&sigma);
    }
    text
}

/// `0:42`, `12:05`, `3:00:00`.
fn minutes(seconds: f64) -> String {
    let whole = seconds.max(0.0) as u64;
    let (hours, minutes, seconds) = (whole / 3600, whole / 60 % 60, whole % 60);
    if hours > 0 { format!("{hours}:{minutes:02}:{seconds:02}") } else { format!("{minutes}:{seconds:02}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_utc_with_nanoseconds() {
        let stamp = Stamp::from_nanos(1_795_410_000_123_456_789);
        assert_eq!(UtcTime(stamp).to_string(), "2026-11-23T05:00:00.123456789Z");
        assert_eq!(UtcTime(Stamp::from_nanos(0)).to_string(), "1970-01-01T00:00:00.000000000Z");
        for end in [i64::MIN, i64::MAX] {
            assert!(UtcTime(Stamp::from_nanos(end)).to_string().ends_with('Z'));
        }
    }

    #[test]
    fn ellipse_has_the_axes_and_the_bearing_of_the_covariance() {
        let north = Ellipse95::of(0.0001, 0.0, 0.0009);
        assert!((north.semi_major_m - 0.03 * 2.4477).abs() < 1e-5, "{north:?}");
        assert!((north.semi_minor_m - 0.01 * 2.4477).abs() < 1e-5, "{north:?}");
        assert!(north.bearing_deg.abs() < 1e-9, "{north:?}");
        let east = Ellipse95::of(0.0009, 0.0, 0.0001);
        assert!((east.bearing_deg - 90.0).abs() < 1e-9, "{east:?}");
        // Longer along north-east: bearing 45°; along north-west: 135°.
        assert!((Ellipse95::of(2.0, 1.0, 2.0).bearing_deg - 45.0).abs() < 1e-9);
        assert!((Ellipse95::of(2.0, -1.0, 2.0).bearing_deg - 135.0).abs() < 1e-9);
        let nothing = Ellipse95::of(0.0, 0.0, 0.0);
        assert_eq!((nothing.semi_major_m, nothing.semi_minor_m), (0.0, 0.0));
    }

    #[test]
    fn durations_read_as_people_write_them() {
        let written: Vec<_> = [0.0, 42.9, 62.0, 3599.0, 10_800.0, -1.0].into_iter().map(minutes).collect();
        assert_eq!(written, ["0:00", "0:42", "1:02", "59:59", "3:00:00", "0:00"]);
    }
}
