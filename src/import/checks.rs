//! What is told of readings on their way: numbers that cannot be measured, stamps that go back. They are handed on
//! all the same: the estimator refuses them for itself, and counts them.

use crate::export::Faults;
use crate::sensors::{Arrival, Sensor};
use crate::time::Stamp;

/// Looks at the readings of one machine in the order in which they go out.
#[derive(Clone, Debug, Default)]
pub struct Checks {
    faults: Faults,
    counts: [u64; Sensor::ALL.len()],
    last: [Option<Stamp>; Sensor::ALL.len()],
    span: Option<(Stamp, Stamp)>,
}

impl Checks {
    /// Looks at one.
    pub fn note(&mut self, arrival: &Arrival) {
        let sensor = arrival.reading.sensor();
        let index = sensor as usize;
        self.counts[index] += 1;
        let number = self.counts[index];
        let stamp = arrival.reading.stamp();
        if let Err(unfit) = arrival.reading.check() {
            let kind = format!("{sensor}: readings that cannot be a measurement");
            self.faults.note(&kind, || format!("reading {number} at {stamp}: {unfit}"));
        }
        match self.last[index] {
            Some(last) if stamp <= last => {
                let kind = format!("{sensor}: stamps that do not come after the one before");
                self.faults.note(&kind, || format!("reading {number}: {stamp} after {last}"));
            }
            _ => self.last[index] = Some(stamp),
        }
        self.span = Some(match self.span {
            None => (stamp, stamp),
            Some((first, last)) => (first.min(stamp), last.max(stamp)),
        });
    }

    /// Readings of a sensor.
    pub fn count(&self, sensor: Sensor) -> u64 {
        self.counts[sensor as usize]
    }

    /// Readings of all sensors.
    pub fn total(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Smallest and largest stamp.
    pub fn span(&self) -> Option<(Stamp, Stamp)> {
        self.span
    }

    /// What was found.
    pub fn faults(&self) -> &Faults {
        &self.faults
    }
}
