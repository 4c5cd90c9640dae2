//! When a sensor measures, and when its readings arrive.

use super::dice::Dice;
use super::scenario::Timing;
use crate::time::{Span, Stamp};

/// The stamps of one sensor, evenly spaced but for jitter and not in step with other sensors, and their
/// arrival. A reading never overtakes the one before it.
#[derive(Clone, Debug)]
pub(super) struct Clock {
    timing: Timing,
    phase_s: f64,
    count: u64,
    last_arrival: Stamp,
    dice: Dice,
}

/// When a reading was taken and when it arrives.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tick {
    pub stamp: Stamp,
    pub arrival: Stamp,
}

impl Clock {
    pub(super) fn new(timing: Timing, mut dice: Dice) -> Self {
        let phase_s = dice.uniform(0.0, 1.0 / timing.rate_hz);
        Self { timing, phase_s, count: 0, last_arrival: Stamp::from_nanos(i64::MIN), dice }
    }

    pub(super) fn tick(&mut self) -> Tick {
        let Timing { rate_hz, latency_s, latency_jitter_s, stamp_jitter_s } = self.timing;
        let even = Stamp::from_seconds(self.count as f64 / rate_hz + self.phase_s + stamp_jitter_s);
        self.count += 1;
        let stamp = even + Span::from_seconds(self.dice.uniform(-stamp_jitter_s, stamp_jitter_s));
        let latency_s = (latency_s + latency_jitter_s * self.dice.normal()).max(0.3 * latency_s);
        let arrival =
            (stamp + Span::from_seconds(latency_s)).max(self.last_arrival + Span::from_nanos(1_000));
        self.last_arrival = arrival;
        Tick { stamp, arrival }
    }
}
