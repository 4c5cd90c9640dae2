//! What machines said of themselves in the last hour, for plots.

use std::collections::BTreeMap;

use serde::Serialize;

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

/// What is known of a machine at one time.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct StatePoint {
    /// Since the start of the answer that it is in, s.
    pub time_s: f64,
    /// The state in a few words.
    pub state_word: String,
    /// How much it asks for attention.
    pub severity: Severity,
    /// What the estimate rests on.
    pub mode: Mode,
    /// State of the fixes.
    pub gnss: GnssState,
    /// While initializing: what is missing.
    pub waits_for: Option<String>,
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
    pub rates: Vec<SensorRate>,
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
            state_word,
            severity,
            mode: health.mode,
            gnss: health.gnss,
            waits_for: health.waits_for.clone(),
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
            let last = points.and_then(LastHour::last).map(|(last, _)| *last);
            // Reports come once a second, more or less: a point for each, but not for those in between.
            let is_due = last.is_none_or(|last| at - last >= Span::from_nanos(EVERY.as_nanos() / 2));
            if !is_due || (points.is_none() && self.0.len() >= MACHINES_MAX) {
                continue;
            }
            let (word, severity) = (machine.state_word.clone(), machine.severity);
            let point = StatePoint {
                estimate_age_s: health.estimate_age_s,
                prediction_p99_us: health.prediction_p99_us,
                clock_offset_s: machine.link.clock_offset_s,
                pose_rate_hz: Some(machine.link.pose_rate_hz),
                ..StatePoint::of(&health.report, word, severity, machine.pose.as_ref())
            };
            self.0.entry(machine.id.clone()).or_default().push(at, point);
        }
    }

    /// What is known of a machine after `since` and of the last hour, oldest first.
    pub fn points(&self, machine: &str, since: Option<Stamp>, now: Stamp) -> Vec<(Stamp, StatePoint)> {
        let Some(points) = self.0.get(machine) else { return Vec::new() };
        points.points(since, usize::MAX, now).0.cloned().collect()
    }
}
