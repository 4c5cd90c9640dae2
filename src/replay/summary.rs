//! What a run amounts to: counts, times, consistency, outages.

use serde::{Deserialize, Serialize};

use crate::estimator::Correction;
use crate::sensors::{Arrival, Reading};
use crate::state::{Event, EventKind, GnssState, Health, OutageReport};
use crate::time::Stamp;

/// The contents of `summary.json`.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// IMU samples in the log.
    pub imu_samples: u64,
    /// Estimates written: one for each IMU sample after the start.
    pub estimates: u64,
    /// Solutions taken over.
    pub updates: u64,
    /// From the first reading to the last, s.
    pub data_s: f64,
    /// The run by the caller's clock, s.
    pub wall_s: f64,
    /// Most memory the process held, bytes; 0 where the system does not say.
    pub peak_rss_bytes: u64,
    /// From an IMU sample to its estimate.
    pub predict_us: Distribution,
    /// From a measurement to the solution taken over.
    pub update_us: Distribution,
    /// How far solutions move the position that was predicted, cm.
    pub consistency_cm: Moments,
    /// Outages of GNSS, oldest first.
    pub outages: Vec<Outage>,
    /// Readings that were no measurements at all or came against the clock.
    pub unfit_readings: u64,
    /// Health at the end.
    pub health: Health,
}

/// Mean and standard deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Moments {
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub sd: f64,
}

/// A distribution of times, µs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distribution {
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub sd: f64,
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// 99.9th percentile.
    pub p999: f64,
    /// Largest.
    pub max: f64,
}

/// One outage of GNSS.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outage {
    /// Stamp of the last good fix, s.
    pub start_s: f64,
    /// Stamp at which fixes were trusted again, s; `null` if the log ended before.
    pub end_s: Option<f64>,
    /// What was wrong.
    pub cause: GnssState,
    /// Way of the IMU meanwhile, m.
    pub travelled_m: f64,
    /// Correction at the end, m.
    pub jump_m: Option<f64>,
}

impl From<&OutageReport> for Outage {
    fn from(report: &OutageReport) -> Self {
        let seconds = |nanos: i64| Stamp::from_nanos(nanos).as_seconds();
        Self {
            start_s: seconds(report.start_stamp_ns),
            end_s: report.end_stamp_ns.map(seconds),
            cause: report.cause,
            travelled_m: report.travelled_m,
            jump_m: report.jump_m,
        }
    }
}

/// Times in nanoseconds, each counted in a bucket 1/64 wide of its octave: constant memory, within 1.6 %.
#[derive(Clone, Debug)]
pub struct Times {
    buckets: Vec<u64>,
    count: u64,
    sum: f64,
    sum_of_squares: f64,
    max: u64,
}

impl Default for Times {
    fn default() -> Self {
        Self { buckets: vec![0; Self::BUCKETS], count: 0, sum: 0.0, sum_of_squares: 0.0, max: 0 }
    }
}

impl Times {
    /// How many buckets there are.
    pub const BUCKETS: usize = 64 * 64;

    /// The bucket in which a time is counted.
    pub fn bucket(nanos: u64) -> usize {
        let octave = 63 - nanos.max(64).leading_zeros() as usize;
        let place = ((nanos.max(64) >> (octave - 6)) & 63) as usize;
        octave * 64 + place
    }

    /// Times that were counted elsewhere: [`Times::BUCKETS`] counts, sums and largest in nanoseconds.
    pub fn of(buckets: Vec<u64>, sum: f64, sum_of_squares: f64, max: u64) -> Self {
        assert_eq!(buckets.len(), Self::BUCKETS, "one count a bucket");
        let count = buckets.iter().sum();
        Self { buckets, count, sum, sum_of_squares, max }
    }

    /// Those that are not in `earlier`, of which the largest is `max`.
    pub fn since(&self, earlier: &Self, max: u64) -> Self {
        let buckets = self.buckets.iter().zip(&earlier.buckets);
        let buckets = buckets.map(|(now, before)| now.saturating_sub(*before)).collect();
        let sum = self.sum - earlier.sum;
        Self::of(buckets, sum, self.sum_of_squares - earlier.sum_of_squares, max)
    }

    /// Counts one.
    pub fn note(&mut self, nanos: u64) {
        self.buckets[Self::bucket(nanos)] += 1;
        self.count += 1;
        self.sum += nanos as f64;
        self.sum_of_squares += (nanos as f64).powi(2);
        self.max = self.max.max(nanos);
    }

    /// How many were counted.
    pub fn count(&self) -> u64 {
        self.count
    }

    fn quantile_us(&self, quantile: f64) -> f64 {
        let rank = (quantile * self.count as f64).ceil() as u64;
        let mut seen = 0;
        for (index, count) in self.buckets.iter().enumerate() {
            seen += count;
            if seen >= rank.max(1) {
                let (octave, place) = (index / 64, index % 64);
                let middle = 2.0_f64.powi(octave as i32) * (1.0 + (place as f64 + 0.5) / 64.0);
                return (middle / 1e3).min(self.max as f64 / 1e3);
            }
        }
        0.0
    }

    /// What was counted so far; zeros if nothing was.
    pub fn distribution(&self) -> Distribution {
        if self.count == 0 {
            return Distribution::default();
        }
        let moments = moments(self.count, self.sum / 1e3, self.sum_of_squares / 1e6);
        Distribution {
            mean: moments.mean,
            sd: moments.sd,
            p50: self.quantile_us(0.5),
            p99: self.quantile_us(0.99),
            p999: self.quantile_us(0.999),
            max: self.max as f64 / 1e3,
        }
    }
}

fn moments(count: u64, sum: f64, sum_of_squares: f64) -> Moments {
    if count == 0 {
        return Moments::default();
    }
    let mean = sum / count as f64;
    Moments { mean, sd: (sum_of_squares / count as f64 - mean * mean).max(0.0).sqrt() }
}

/// What is counted along a run.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub readings: u64,
    pub estimates: u64,
    pub predict: Times,
    pub update: Times,
    imu_samples: u64,
    first: Option<Stamp>,
    last: Option<Stamp>,
    corrections: u64,
    correction_sum_cm: f64,
    correction_squares_cm: f64,
    outages: Vec<Outage>,
}

impl Tally {
    pub fn note_arrival(&mut self, arrival: &Arrival) {
        self.readings += 1;
        self.imu_samples += u64::from(matches!(arrival.reading, Reading::Imu(_)));
        self.first.get_or_insert(arrival.arrival);
        self.last = Some(arrival.arrival);
    }

    pub fn data_s(&self) -> f64 {
        match (self.first, self.last) {
            (Some(first), Some(last)) => last.seconds_since(first),
            _ => 0.0,
        }
    }

    pub fn note_correction(&mut self, correction: &Correction) {
        if let Some(correction_m) = correction.correction_m {
            self.corrections += 1;
            self.correction_sum_cm += 100.0 * correction_m;
            self.correction_squares_cm += (100.0 * correction_m).powi(2);
        }
    }

    pub fn note_event(&mut self, event: &Event) {
        if let EventKind::OutageEnded(report) = &event.what {
            self.outages.push(Outage::from(report));
        }
    }

    pub fn summary(mut self, wall_nanos: u64, unfit_readings: u64, health: Health) -> Summary {
        let running = health.outage.as_ref().filter(|outage| outage.end_stamp_ns.is_none());
        self.outages.extend(running.map(Outage::from));
        Summary {
            imu_samples: self.imu_samples,
            estimates: self.estimates,
            updates: self.update.count,
            data_s: self.data_s(),
            wall_s: wall_nanos as f64 / 1e9,
            peak_rss_bytes: peak_rss_bytes(),
            predict_us: self.predict.distribution(),
            update_us: self.update.distribution(),
            consistency_cm: moments(self.corrections, self.correction_sum_cm, self.correction_squares_cm),
            outages: self.outages,
            unfit_readings,
            health,
        }
    }
}

/// `VmHWM` of this process, where the system says it.
fn peak_rss_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) * 1024
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_within_a_bucket() {
        let mut times = Times::default();
        (1..=100_000_u64).for_each(|index| times.note(index * 10));
        let distribution = times.distribution();
        assert!((distribution.mean - 500.0).abs() < 0.1);
        assert!((distribution.p50 / 500.0 - 1.0).abs() < 0.02, "{}", distribution.p50);
        assert!((distribution.p999 / 999.0 - 1.0).abs() < 0.02, "{}", distribution.p999);
        assert_eq!(distribution.max, 1000.0);
    }
}
