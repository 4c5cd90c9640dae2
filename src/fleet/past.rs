//! What machines said of themselves in the last hour, for plots.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Serialize, Serializer};

use super::last_hour::{LastHour, Point};
use super::view::{FleetView, PoseView, Severity};
use super::{MACHINES_MAX, MachineReport};
use crate::sensors::Sensor;
use crate::state::{GnssState, Health, Mode};
use crate::time::{Span, Stamp};

/// From one point to the next, at least.
const EVERY: Span = Span::from_millis(1_000);

/// How often a sensor spoke.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct SensorRate {
    /// Which one.
    pub sensor: Sensor,
    /// Over the second before, Hz.
    pub rate_hz: f64,
}

/// How often each sensor spoke, of those that ever did. Kept in place: an hour of points shall take no room beside.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rates([Option<f32>; Sensor::ALL.len()]);

impl Rates {
    /// In the order of the sensors.
    pub fn iter(&self) -> impl Iterator<Item = SensorRate> {
        let told = Sensor::ALL.into_iter().zip(self.0);
        // To a thousandth, which a single precision has up to some thousand.
        let rate = |rate_hz: f32| (f64::from(rate_hz) * 1e3).round() / 1e3;
        told.filter_map(move |(sensor, told)| Some(SensorRate { sensor, rate_hz: rate(told?) }))
    }
}

impl FromIterator<SensorRate> for Rates {
    fn from_iter<I: IntoIterator<Item = SensorRate>>(rates: I) -> Self {
        let mut told = Self::default();
        for SensorRate { sensor, rate_hz } in rates {
            let place = Sensor::ALL.iter().zip(&mut told.0).find(|(which, _)| **which == sensor);
            if let Some((_, place)) = place {
                *place = Some(rate_hz as f32);
            }
        }
        told
    }
}

impl Serialize for Rates {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.iter())
    }
}

/// What is known of a machine at one time.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct StatePoint {
    /// Since the start of the answer that it is in, s.
    pub time_s: f64,
    /// The state in a few words.
    #[cfg_attr(feature = "shells", schema(value_type = String))]
    pub state_word: Arc<str>,
    /// How much it asks for attention.
    pub severity: Severity,
    /// What the estimate rests on.
    pub mode: Mode,
    /// State of the fixes.
    pub gnss: GnssState,
    /// While initializing: what is missing.
    #[cfg_attr(feature = "shells", schema(value_type = Option<String>))]
    pub waits_for: Option<Arc<str>>,
    /// One sigma of the position along its worst horizontal direction, m; `null` before the start.
    pub position_sigma_m: Option<f64>,
    /// One sigma of the heading.
    pub heading_sigma_deg: Option<f64>,
    /// Of the cabin IMU, m/s; `null` if no pose was known.
    pub speed_mps: Option<f64>,
    /// Largest ratio of innovation to its gate over the second before; over 1 was refused.
    pub worst_test_ratio: f64,
    /// Which sensor that was.
    pub worst_test_sensor: Option<Sensor>,
    /// The sensors that ever spoke.
    #[cfg_attr(feature = "shells", schema(value_type = Vec<SensorRate>))]
    pub rates: Rates,
    /// Gyro bias, rad/s, in the IMU frame.
    pub gyro_bias: [f64; 3],
    /// Accelerometer bias, m/s², in the IMU frame.
    pub accel_bias: [f64; 3],
    /// Mean time of a smoother update, µs.
    pub update_us: f64,
    /// From the newest estimate to the report, s.
    pub estimate_age_s: Option<f64>,
    /// From an IMU sample to its estimate, 99 % of them, µs.
    pub prediction_p99_us: Option<f64>,
    /// Live, the site's clock less the machine's; of a recording, from sending to receiving by both clocks, s.
    pub clock_offset_s: Option<f64>,
    /// Live: poses that arrived in the second before.
    pub pose_rate_hz: Option<f64>,
}

impl StatePoint {
    /// Of a recorded report, with the pose that was the newest then.
    pub fn recorded(
        report: &MachineReport,
        state_word: String,
        severity: Severity,
        pose: Option<&PoseView>,
        transit_s: f64,
    ) -> Self {
        Self {
            estimate_age_s: report.estimate_age_s,
            prediction_p99_us: report.prediction_p99_us,
            clock_offset_s: Some(transit_s),
            ..Self::of(&report.health, state_word, severity, pose)
        }
    }

    fn of(health: &Health, state_word: String, severity: Severity, pose: Option<&PoseView>) -> Self {
        let rates = health.sensors.iter();
        Self {
            time_s: 0.0,
            state_word: state_word.into(),
            severity,
            mode: health.mode,
            gnss: health.gnss,
            waits_for: health.waits_for.as_deref().map(Into::into),
            position_sigma_m: health.position_sigma_m,
            heading_sigma_deg: health.heading_sigma_deg,
            speed_mps: pose.map(|pose| pose.speed_mps),
            worst_test_ratio: health.worst_test_ratio,
            worst_test_sensor: health.worst_test_sensor,
            rates: rates.map(|told| SensorRate { sensor: told.sensor, rate_hz: told.rate_hz }).collect(),
            gyro_bias: health.gyro_bias,
            accel_bias: health.accel_bias,
            update_us: health.update_us,
            estimate_age_s: None,
            prediction_p99_us: None,
            clock_offset_s: None,
            pose_rate_hz: None,
        }
    }
}

impl StatePoint {
    /// Words that are those of the point before take no more room.
    fn share_words(&mut self, before: &Self) {
        if self.state_word == before.state_word {
            self.state_word = Arc::clone(&before.state_word);
        }
        if self.waits_for == before.waits_for {
            self.waits_for.clone_from(&before.waits_for);
        }
    }
}

impl Point for StatePoint {
    fn changed_from(&self, before: &Self) -> bool {
        let of = |point: &Self| (point.mode, point.gnss, point.severity);
        of(self) != of(before)
    }

    fn tells(&self) -> f64 {
        self.worst_test_ratio
    }
}

/// The last hour of all machines.
#[derive(Debug, Default)]
pub struct Past(BTreeMap<String, LastHour<StatePoint>>);

impl Past {
    /// Adds the machines that said something since.
    pub fn observe(&mut self, view: &FleetView) {
        for machine in &view.machines {
            let Some(health) = &machine.health else { continue };
            let at = view.time.0 - Span::from_seconds(health.age_s);
            let points = self.0.get(&machine.id);
            let last = points.and_then(LastHour::last);
            // Reports come once a second, more or less: a point for each, but not for those in between.
            let is_due = last.is_none_or(|(last, _)| at - *last >= Span::from_nanos(EVERY.as_nanos() / 2));
            if !is_due || (points.is_none() && self.0.len() >= MACHINES_MAX) {
                continue;
            }
            let (word, severity) = (machine.state_word.clone(), machine.severity);
            let mut point = StatePoint {
                estimate_age_s: health.estimate_age_s,
                prediction_p99_us: health.prediction_p99_us,
                clock_offset_s: machine.link.clock_offset_s,
                pose_rate_hz: Some(machine.link.pose_rate_hz),
                ..StatePoint::of(&health.report, word, severity, machine.pose.as_ref())
            };
            if let Some((_, last)) = last {
                point.share_words(last);
            }
            self.0.entry(machine.id.clone()).or_default().push(at, point);
        }
    }

    /// What is known of a machine after `since` and of the last hour, oldest first.
    pub fn points(&self, machine: &str, since: Option<Stamp>, now: Stamp) -> Vec<(Stamp, StatePoint)> {
        let Some(points) = self.0.get(machine) else { return Vec::new() };
        points.points(since, usize::MAX, now).0.cloned().collect()
    }
}
