//! What the machine counts of itself.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::replay::{Distribution, Times};
use crate::wire::{Latency, Topic};

/// Counted by all threads; nothing is decided by it.
#[derive(Debug, Default)]
pub(super) struct Counters {
    /// Readings that the predictor took.
    pub(super) readings: AtomicU64,
    /// Estimates that it gave.
    pub(super) estimates: AtomicU64,
    /// Messages that hold no reading.
    pub(super) undecodable: AtomicU64,
    /// Readings that the predictor's queue did not take.
    pub(super) input_dropped: AtomicU64,
    /// Readings that the updater's queue did not take: they are missing in the estimate.
    pub(super) update_dropped: AtomicU64,
    /// Messages that the outbox did not take.
    pub(super) output_dropped: AtomicU64,
    /// Messages that were not sent for want of room; they are in the on-board record, if there is one.
    pub(super) unsent: AtomicU64,
    /// Messages that may not be in the on-board record: it had no room for them, or its disk failed.
    pub(super) record_dropped: AtomicU64,
    /// From IMU samples to their estimates.
    pub(super) predict: SharedTimes,
    /// Updates.
    pub(super) update: SharedTimes,
}

/// Times that one thread notes and others look at, without a lock that the one could wait on.
#[derive(Debug)]
pub(super) struct SharedTimes {
    buckets: [AtomicU64; Times::BUCKETS],
    sum: AtomicU64,
    /// The bits of a float.
    sum_of_squares: AtomicU64,
    max: AtomicU64,
    /// Since somebody last asked.
    recent_max: AtomicU64,
}

impl Default for SharedTimes {
    fn default() -> Self {
        Self {
            buckets: [const { AtomicU64::new(0) }; Times::BUCKETS],
            sum: AtomicU64::new(0),
            sum_of_squares: AtomicU64::new(0),
            max: AtomicU64::new(0),
            recent_max: AtomicU64::new(0),
        }
    }
}

impl SharedTimes {
    /// Counts one; on one thread only.
    pub(super) fn note(&self, duration: Duration) {
        let nanos = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        self.buckets[Times::bucket(nanos)].fetch_add(1, Ordering::Relaxed);
        self.sum.fetch_add(nanos, Ordering::Relaxed);
        let squares = f64::from_bits(self.sum_of_squares.load(Ordering::Relaxed));
        self.sum_of_squares.store((squares + (nanos as f64).powi(2)).to_bits(), Ordering::Relaxed);
        self.max.fetch_max(nanos, Ordering::Relaxed);
        self.recent_max.fetch_max(nanos, Ordering::Relaxed);
    }

    /// All so far; what is noted meanwhile may be in it by half.
    fn times(&self) -> Times {
        let buckets = self.buckets.iter().map(|bucket| bucket.load(Ordering::Relaxed)).collect();
        let sum = self.sum.load(Ordering::Relaxed) as f64;
        let squares = f64::from_bits(self.sum_of_squares.load(Ordering::Relaxed));
        Times::of(buckets, sum, squares, self.max.load(Ordering::Relaxed))
    }

    /// Those since `told`, which becomes all so far; `None` if there were none.
    pub(super) fn latency_since(&self, told: &mut Times) -> Option<Latency> {
        let times = self.times();
        let max = self.recent_max.swap(0, Ordering::Relaxed);
        let recent = times.since(told, max);
        *told = times;
        let Distribution { mean, p99, max, .. } = recent.distribution();
        (recent.count() > 0).then_some(Latency { mean_us: mean, p99_us: p99, max_us: max })
    }
}

impl Counters {
    /// Causes of losses.
    pub(super) const LOSSES: usize = 6;

    /// What was lost so far, by cause.
    pub(super) fn losses(&self) -> [(&'static str, u64); Self::LOSSES] {
        [
            ("messages without a reading", self.undecodable.load(Ordering::Relaxed)),
            ("readings that the predictor had no room for", self.input_dropped.load(Ordering::Relaxed)),
            ("readings that the updater had no room for", self.update_dropped.load(Ordering::Relaxed)),
            ("messages that the outbox had no room for", self.output_dropped.load(Ordering::Relaxed)),
            ("messages that the network had no room for", self.unsent.load(Ordering::Relaxed)),
            ("messages that the on-board record could not keep", self.record_dropped.load(Ordering::Relaxed)),
        ]
    }

    pub(super) fn report(&self, published: BTreeMap<Topic, u64>) -> Report {
        let update = self.update.times();
        Report {
            readings: self.readings.load(Ordering::Relaxed),
            estimates: self.estimates.load(Ordering::Relaxed),
            lost: self.losses().iter().map(|(_, count)| count).sum(),
            predict_us: self.predict.times().distribution(),
            updates: update.count(),
            update_us: update.distribution(),
            published,
        }
    }
}

/// What a machine's peer did in its run.
#[derive(Clone, Debug)]
pub struct Report {
    /// Readings that the estimator took.
    pub readings: u64,
    /// Estimates that it gave.
    pub estimates: u64,
    /// Readings and messages that were lost for want of room or sense.
    pub lost: u64,
    /// From an IMU sample to its propagated state.
    pub predict_us: Distribution,
    /// Updates of the smoother.
    pub updates: u64,
    /// Time of one.
    pub update_us: Distribution,
    /// Messages of each topic.
    pub published: BTreeMap<Topic, u64>,
}

impl fmt::Display for Report {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Distribution { mean, p99, p999, max, .. } = self.predict_us;
        write!(
            formatter,
            "{} readings, {} estimates in {mean:.1} µs each (99 %: {p99:.1}, 99.9 %: {p999:.1}, at most \
             {max:.0}), {} updates in {:.0} µs each (99 %: {:.0}, at most {:.0}), {} messages published, \
             {} readings or messages lost",
            self.readings,
            self.estimates,
            self.updates,
            self.update_us.mean,
            self.update_us.p99,
            self.update_us.max,
            self.published.values().sum::<u64>(),
            self.lost,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recent_latency_is_that_since_the_last_look() {
        let times = SharedTimes::default();
        let mut told = Times::default();
        assert_eq!(times.latency_since(&mut told), None);
        (0..100).for_each(|_| times.note(Duration::from_micros(50)));
        let first = times.latency_since(&mut told).expect("some");
        assert_eq!((first.mean_us, first.max_us), (50.0, 50.0));
        assert_eq!(times.latency_since(&mut told), None);
        times.note(Duration::from_micros(4));
        let second = times.latency_since(&mut told).expect("one");
        assert_eq!((second.mean_us, second.max_us), (4.0, 4.0));
        assert!((second.p99_us / 4.0 - 1.0).abs() < 0.02, "{second:?}");
        let all = times.times();
        assert_eq!((all.count(), all.distribution().max), (101, 50.0));
    }
}
