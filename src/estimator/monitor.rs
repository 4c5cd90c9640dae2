//! What is told of the estimate: events as they happen, health when asked.

use crate::lie::Vec3;
use crate::sensors::Sensor;
use crate::state::{
    Event, EventKind, GnssState, Graph, Health, Mode, NavState, OutageReport, SensorHealth, Severity,
    StateMatrix, row,
};
use crate::time::{Span, Stamp};

/// Refusals of one sensor are told at most so often.
const REFUSALS_EVERY: Span = Span::from_millis(1_000);
/// The worst test ratio is that of so long.
const TEST_WINDOW: Span = Span::from_millis(1_000);
/// Events that nobody took are kept up to this number; the oldest go first.
const EVENTS_MAX: usize = 4_096;

#[derive(Clone, Debug)]
pub(super) struct Monitor {
    events: Vec<Event>,
    mode: Mode,
    /// As it was last told.
    graph: Graph,
    refusals: [Refusals; Sensor::ALL.len()],
    outage: Option<OutageReport>,
    worst_test: Option<(Stamp, Sensor, f64)>,
    newest: Option<(Stamp, NavState, StateMatrix)>,
    updates: u64,
    update_us: f64,
}

#[derive(Clone, Debug, Default)]
struct Refusals {
    told: Option<Stamp>,
    /// Since then.
    count: u64,
    /// Of the newest.
    reason: String,
}

impl Default for Monitor {
    fn default() -> Self {
        Self {
            events: Vec::new(),
            mode: Mode::Initializing,
            graph: Graph::Main,
            refusals: Default::default(),
            outage: None,
            worst_test: None,
            newest: None,
            updates: 0,
            update_us: 0.0,
        }
    }
}

impl Monitor {
    pub fn push(&mut self, event: Event) {
        if self.events.len() >= EVENTS_MAX {
            self.events.remove(0);
        }
        self.events.push(event);
    }

    pub fn take_events(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.events)
    }

    pub fn note_start(&mut self, stamp: Stamp, heading_from: &str, heading_sigma: f64) {
        let heading_sigma_deg = heading_sigma.to_degrees();
        let what = EventKind::Initialized { heading_from: heading_from.to_owned(), heading_sigma_deg };
        self.push(Event::new(stamp, Severity::Info, what));
    }

    pub fn note_restart(&mut self, stamp: Stamp, reason: &str) {
        self.push(Event::new(stamp, Severity::Error, EventKind::Restarted { reason: reason.to_owned() }));
        self.note_mode(stamp, Mode::Initializing);
        self.newest = None;
    }

    pub fn note_mode(&mut self, stamp: Stamp, mode: Mode) {
        if mode == self.mode {
            return;
        }
        let severity = match mode {
            Mode::Main => Severity::Info,
            Mode::Initializing | Mode::Fallback => Severity::Warning,
            Mode::ImuOnly => Severity::Error,
        };
        self.push(Event::new(stamp, severity, EventKind::ModeChanged { from: self.mode, to: mode }));
        self.mode = mode;
    }

    pub fn note_graph(&mut self, stamp: Stamp, to: Graph, why: &str) {
        if to != self.graph {
            let what = EventKind::GraphChanged { from: self.graph, to, reason: why.to_owned() };
            self.push(Event::new(stamp, Severity::Info, what));
            self.graph = to;
        }
    }

    pub fn note_gnss(&mut self, stamp: Stamp, from: GnssState, to: GnssState) {
        if from != to {
            let severity = if to == GnssState::Fixed { Severity::Info } else { Severity::Warning };
            self.push(Event::new(stamp, severity, EventKind::GnssChanged { from, to }));
        }
    }

    pub fn note_refusal(&mut self, now: Stamp, sensor: Sensor, reason: String) {
        let book = &mut self.refusals[sensor as usize];
        book.count += 1;
        book.reason = reason;
        self.tell_refusals(now);
    }

    /// Tells the refusals of each sensor that has told none for a second.
    pub fn tell_refusals(&mut self, now: Stamp) {
        for sensor in Sensor::ALL {
            let book = &self.refusals[sensor as usize];
            // A clock that went back does not silence the book.
            let silent = book.told.is_some_and(|told| now >= told && now - told < REFUSALS_EVERY);
            if book.count > 0 && !silent {
                self.tell_refusals_of(sensor, now);
            }
        }
    }

    /// Tells all that was not told yet.
    pub fn tell_rest(&mut self, now: Stamp) {
        for sensor in Sensor::ALL {
            if self.refusals[sensor as usize].count > 0 {
                self.tell_refusals_of(sensor, now);
            }
        }
    }

    fn tell_refusals_of(&mut self, sensor: Sensor, now: Stamp) {
        let book = &mut self.refusals[sensor as usize];
        book.told = Some(now);
        let (reason, count) = (std::mem::take(&mut book.reason), std::mem::take(&mut book.count));
        self.push(Event::new(now, Severity::Warning, EventKind::Refused { sensor, reason, count }));
    }

    pub fn note_test(&mut self, now: Stamp, sensor: Sensor, ratio: f64) {
        let fresh = self.worst_test.filter(|(stamp, _, _)| now >= *stamp && now - *stamp < TEST_WINDOW);
        if fresh.is_none_or(|(_, _, worst)| ratio >= worst) {
            self.worst_test = Some((now, sensor, ratio));
        }
    }

    pub fn note_update(&mut self, stamp: Stamp, state: &NavState, covariance: &StateMatrix, mode: Mode) {
        if let (Some((_, before, _)), Some(outage)) = (&self.newest, &mut self.outage)
            && outage.end_stamp_ns.is_none()
        {
            outage.travelled_m += (state.position - before.position).norm();
        }
        self.newest = Some((stamp, *state, *covariance));
        self.updates += 1;
        self.note_mode(stamp, mode);
    }

    /// One that goes on already stays as it is.
    pub fn begin_outage(&mut self, stamp: Stamp, since: Stamp, cause: GnssState) {
        if self.outage.as_ref().is_some_and(|outage| outage.end_stamp_ns.is_none()) {
            return;
        }
        self.outage = Some(OutageReport {
            start_stamp_ns: since.as_nanos(),
            end_stamp_ns: None,
            cause,
            travelled_m: 0.0,
            jump_m: None,
        });
        self.push(Event::new(stamp, Severity::Warning, EventKind::OutageBegan { cause }));
    }

    pub fn end_outage(&mut self, stamp: Stamp, jump_m: Option<f64>) {
        let Some(outage) = self.outage.as_mut().filter(|outage| outage.end_stamp_ns.is_none()) else {
            return;
        };
        outage.end_stamp_ns = Some(stamp.as_nanos());
        outage.jump_m = jump_m;
        let report = outage.clone();
        self.push(Event::new(stamp, Severity::Info, EventKind::OutageEnded(report)));
    }

    pub fn note_update_time(&mut self, micros: f64) {
        self.update_us += 0.05 * (micros - self.update_us);
    }

    pub fn health(
        &self,
        now: Stamp,
        waits_for: Option<String>,
        (gnss, gnss_inflation): (GnssState, [f64; 2]),
        sensors: Vec<SensorHealth>,
    ) -> Health {
        let worst = self.worst_test.filter(|(stamp, _, _)| now - *stamp < TEST_WINDOW);
        let state = self.newest.as_ref().map(|(_, state, _)| *state);
        let array = |vector: Vec3| [vector.x, vector.y, vector.z];
        Health {
            stamp_ns: now.as_nanos(),
            mode: self.mode,
            waits_for,
            gnss,
            gnss_inflation,
            position_sigma_m: self
                .newest
                .as_ref()
                .map(|(_, _, covariance)| worst_horizontal_sigma(covariance)),
            heading_sigma_deg: self
                .newest
                .as_ref()
                .map(|(_, state, covariance)| state.heading_variance(covariance).sqrt().to_degrees()),
            worst_test_ratio: worst.map_or(0.0, |(_, _, ratio)| ratio.min(1.0e6)),
            worst_test_sensor: worst.map(|(_, sensor, _)| sensor),
            sensors,
            outage: self.outage.clone(),
            updates: self.updates,
            update_us: self.update_us,
            gyro_bias: state.map_or([0.0; 3], |state| array(state.gyro_bias)),
            accel_bias: state.map_or([0.0; 3], |state| array(state.accel_bias)),
        }
    }
}

/// Square root of the larger eigenvalue of the horizontal position's covariance, m.
fn worst_horizontal_sigma(covariance: &StateMatrix) -> f64 {
    let (x, y) = (row::POSITION, row::POSITION + 1);
    let mean = 0.5 * (covariance[(x, x)] + covariance[(y, y)]);
    let half = 0.5 * (covariance[(x, x)] - covariance[(y, y)]);
    (mean + libm::hypot(half, covariance[(x, y)])).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refusal_is_told_once_and_at_most_once_a_second() {
        let mut monitor = Monitor::default();
        let at = |millis: i64| Stamp::from_nanos(millis * 1_000_000);
        for millis in (0..=2_500).step_by(10) {
            monitor.note_refusal(at(millis), Sensor::GnssLeft, format!("reason {millis}"));
        }
        monitor.tell_refusals(at(3_200));
        monitor.note_refusal(at(3_300), Sensor::GnssLeft, "the last".to_owned());
        monitor.tell_rest(at(3_300));
        let counts: Vec<u64> = monitor
            .take_events()
            .into_iter()
            .filter_map(|event| match event.what {
                EventKind::Refused { count, .. } => Some(count),
                _ => None,
            })
            .collect();
        assert_eq!(counts, [1, 100, 100, 50, 1]);
    }
}
