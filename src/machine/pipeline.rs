//! The estimator between the source and the outbox: its threads are those of the room `live`.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::oneshot;

use super::MachineError;
use super::counters::Counters;
use super::outbox::Outlets;
use crate::estimator::{Correction, Predictor, Updater};
use crate::live::{self, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use crate::sensors::{Arrival, Sensor};
use crate::state::Takeover;
use crate::time::{Span, Stamp};

/// Health is looked at so often, by the machine's stamps.
const HEALTH_EVERY: Span = Span::from_millis(100);

/// The two threads.
pub(super) struct Pipeline {
    threads: live::Threads,
    /// Its sender lives as long as the predictor's thread, which in turn ends with the updater's.
    ended: oneshot::Receiver<()>,
}

/// Where the readings go in; the pipeline ends when the last one is dropped.
#[derive(Clone)]
pub(super) struct Inlet {
    inlet: live::Inlet,
    counters: Arc<Counters>,
}

impl Inlet {
    /// Hands a reading over, or counts that there was no room for it; never waits.
    pub(super) fn offer(&self, arrival: Arrival) {
        if !self.inlet.offer(arrival) {
            self.counters.input_dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Hands a reading over and waits for room; false if the pipeline has ended.
    pub(super) fn hand_over(&self, arrival: Arrival) -> bool {
        self.inlet.hand_over(arrival)
    }
}

impl Pipeline {
    /// Starts both threads; `imu_period` passes between two IMU samples by the system's clock.
    pub(super) fn start(
        halves: (Predictor, Updater),
        imu_period: Duration,
        outlets: Outlets,
        counters: Arc<Counters>,
    ) -> Result<(Self, Inlet), MachineError> {
        let (alive, ended) = oneshot::channel();
        let updates = Updates { outlets: outlets.clone(), counters: Arc::clone(&counters), health_due: None };
        let predictions =
            Predictions { outlets, counters: Arc::clone(&counters), takeovers: 0, _alive: alive };
        let started = live::start(halves, Origin::Machine, imu_period, predictions, updates);
        let (threads, inlet) =
            started.map_err(|source| MachineError::Thread { name: "estimator", source })?;
        Ok((Self { threads, ended }, Inlet { inlet, counters }))
    }

    /// Waits until the predictor's thread has ended, for whatever reason.
    pub(super) async fn ended(&mut self) {
        // Nothing is ever sent: the error is the end.
        if !self.ended.is_terminated() {
            let _ = (&mut self.ended).await;
        }
    }

    /// Waits until both threads have worked off what is queued; the inlets must be gone.
    pub(super) async fn stop(self) -> Result<(), MachineError> {
        let joined = tokio::task::spawn_blocking(move || self.threads.join()).await;
        if matches!(joined, Ok(true)) { Ok(()) } else { Err(MachineError::Panicked) }
    }
}

/// On the predictor's thread.
struct Predictions {
    outlets: Outlets,
    counters: Arc<Counters>,
    takeovers: u64,
    _alive: oneshot::Sender<()>,
}

impl PredictorOutlet for Predictions {
    fn taken(&mut self, taken: Taken<'_>) {
        let Taken { number, arrival, seen, estimate, took } = taken;
        self.counters.readings.fetch_add(1, Ordering::Relaxed);
        if !seen {
            self.counters.update_dropped.fetch_add(1, Ordering::Relaxed);
        }
        if let Some(estimate) = estimate {
            if arrival.reading.sensor() == Sensor::Imu {
                self.counters.predict.note(took);
            }
            self.counters.estimates.fetch_add(1, Ordering::Relaxed);
            self.outlets.estimate(estimate);
        }
        self.outlets.reading(number, *arrival, seen);
    }

    fn taken_over(&mut self, takeover: Takeover, _: Correction) {
        self.outlets.takeover(self.takeovers, takeover);
        self.takeovers += 1;
    }
}

/// On the updater's thread.
struct Updates {
    outlets: Outlets,
    counters: Arc<Counters>,
    health_due: Option<Stamp>,
}

impl UpdaterOutlet for Updates {
    fn worked_off(&mut self, arrival: &Arrival, update: Option<Duration>, updater: &mut Updater) {
        if let Some(took) = update {
            self.counters.update.note(took);
            updater.note_update_time(took.as_secs_f64() * 1e6);
        }
        let events = updater.take_events();
        let happened = !events.is_empty();
        for event in events {
            self.outlets.event(event);
        }
        if happened || self.health_due.is_none_or(|due| arrival.arrival >= due) {
            self.health_due = Some(arrival.arrival + HEALTH_EVERY);
            self.outlets.health(updater.health());
        }
    }

    fn ended(self, _: Updater) {}
}
