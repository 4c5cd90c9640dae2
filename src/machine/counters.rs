//! What the machine counts of itself.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::wire::Topic;

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
    predict: Mutex<Durations>,
    update: Mutex<Durations>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Durations {
    count: u64,
    total: Duration,
    longest: Duration,
}

impl Durations {
    fn mean_us(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.total.as_secs_f64() * 1e6 / self.count as f64 }
    }
}

impl Counters {
    /// From an IMU sample to its estimate.
    pub(super) fn predicted_in(&self, duration: Duration) {
        add(&self.predict, duration);
    }

    /// One update.
    pub(super) fn updated_in(&self, duration: Duration) {
        add(&self.update, duration);
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
        let predict = *lock(&self.predict);
        let update = *lock(&self.update);
        Report {
            readings: self.readings.load(Ordering::Relaxed),
            estimates: self.estimates.load(Ordering::Relaxed),
            lost: self.losses().iter().map(|(_, count)| count).sum(),
            predict_us_mean: predict.mean_us(),
            predict_us_max: predict.longest.as_secs_f64() * 1e6,
            updates: update.count,
            update_us_mean: update.mean_us(),
            update_us_max: update.longest.as_secs_f64() * 1e6,
            published,
        }
    }
}

fn lock(durations: &Mutex<Durations>) -> std::sync::MutexGuard<'_, Durations> {
    // Plain numbers cannot be left half-written.
    durations.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

fn add(durations: &Mutex<Durations>, duration: Duration) {
    let mut durations = lock(durations);
    durations.count += 1;
    durations.total += duration;
    durations.longest = durations.longest.max(duration);
}

/// What a machine's peer did in its run.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Readings that the estimator took.
    pub readings: u64,
    /// Estimates that it gave.
    pub estimates: u64,
    /// Readings and messages that were lost for want of room or sense.
    pub lost: u64,
    /// From an IMU sample to its propagated state, µs.
    pub predict_us_mean: f64,
    /// The longest, µs.
    pub predict_us_max: f64,
    /// Updates of the smoother.
    pub updates: u64,
    /// Time of one, µs.
    pub update_us_mean: f64,
    /// The longest, µs.
    pub update_us_max: f64,
    /// Messages of each topic.
    pub published: BTreeMap<Topic, u64>,
}

impl fmt::Display for Report {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            formatter,
            "{} readings, {} estimates in {:.1} µs each ({:.1} at most), {} updates in {:.0} µs each \
             ({:.0} at most), {} messages published, {} readings or messages lost",
            self.readings,
            self.estimates,
            self.predict_us_mean,
            self.predict_us_max,
            self.updates,
            self.update_us_mean,
            self.update_us_max,
            self.published.values().sum::<u64>(),
            self.lost,
        )
    }
}
