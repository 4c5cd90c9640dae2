//! What the machine counts of itself.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Mutex;
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
    predict: Mutex<Predictions>,
    update: Mutex<Times>,
}

/// From IMU samples to their estimates: since the start, and since somebody last asked.
#[derive(Debug, Default)]
struct Predictions {
    all: Times,
    recent: Times,
}

impl Counters {
    /// From an IMU sample to its estimate.
    pub(super) fn predicted_in(&self, duration: Duration) {
        let nanos = nanos(duration);
        let mut predict = lock(&self.predict);
        predict.all.note(nanos);
        predict.recent.note(nanos);
    }

    /// One update.
    pub(super) fn updated_in(&self, duration: Duration) {
        lock(&self.update).note(nanos(duration));
    }

    /// From IMU samples to their estimates since the last call; `None` if there were none.
    pub(super) fn recent_latency(&self) -> Option<Latency> {
        let recent = {
            let mut predict = lock(&self.predict);
            if predict.recent.count() == 0 {
                return None;
            }
            std::mem::take(&mut predict.recent)
        };
        let Distribution { mean, p99, max, .. } = recent.distribution();
        Some(Latency { mean_us: mean, p99_us: p99, max_us: max })
    }

    /// What was lost so far, by cause.
    pub(super) fn losses(&self) -> [(&'static str, u64); 4] {
        [
            ("messages without a reading", self.undecodable.load(Ordering::Relaxed)),
            ("readings that the predictor had no room for", self.input_dropped.load(Ordering::Relaxed)),
            ("readings that the updater had no room for", self.update_dropped.load(Ordering::Relaxed)),
            ("messages that the outbox had no room for", self.output_dropped.load(Ordering::Relaxed)),
        ]
    }

    pub(super) fn report(&self, published: BTreeMap<Topic, u64>) -> Report {
        let update = lock(&self.update);
        Report {
            readings: self.readings.load(Ordering::Relaxed),
            estimates: self.estimates.load(Ordering::Relaxed),
            lost: self.losses().iter().map(|(_, count)| count).sum(),
            predict_us: lock(&self.predict).all.distribution(),
            updates: update.count(),
            update_us: update.distribution(),
            published,
        }
    }
}

fn lock<T>(counted: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    // Plain numbers: at worst the last one is half counted.
    counted.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
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
