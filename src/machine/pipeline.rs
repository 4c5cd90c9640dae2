//! The estimator's two halves, each on a thread of its own.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::Instant;

use tokio::sync::oneshot;

use super::MachineError;
use super::counters::Counters;
use super::outbox::Outlets;
use crate::estimator::{Predictor, Solution, Updater};
use crate::sensors::{Arrival, Sensor};
use crate::time::{Span, Stamp};

/// Readings on the way to the predictor: some two seconds of all sensors. Full, it refuses live readings and
/// holds played ones up.
const INPUT_QUEUE: usize = 1024;
/// Readings on the way to the updater: some six seconds, longer than any update takes. Full, it refuses.
const UPDATE_QUEUE: usize = 4096;
/// Solutions on the way back. Full, the updater waits: the predictor takes them at its next reading.
const SOLUTION_QUEUE: usize = 4;
/// Health is looked at so often, by the machine's stamps.
const HEALTH_EVERY: Span = Span::from_millis(100);

/// A reading that arrives so much before the last one shows that the clock was set back.
const CLOCK_SET_BACK: Span = Span::from_millis(1000);

/// The two threads.
pub(super) struct Pipeline {
    predictor: JoinHandle<()>,
    updater: JoinHandle<()>,
    /// Its sender lives as long as the predictor's thread, which in turn ends with the updater's.
    ended: oneshot::Receiver<()>,
}

/// Where the readings go in; the pipeline ends when the last one is dropped.
#[derive(Clone)]
pub(super) struct Inlet {
    sender: SyncSender<Arrival>,
    counters: Arc<Counters>,
}

impl Inlet {
    /// Hands a reading over, or counts that there was no room for it; never waits.
    pub(super) fn offer(&self, arrival: Arrival) {
        if self.sender.try_send(arrival).is_err() {
            self.counters.input_dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Hands a reading over and waits for room; false if the pipeline has ended.
    pub(super) fn hand_over(&self, arrival: Arrival) -> bool {
        self.sender.send(arrival).is_ok()
    }
}

impl Pipeline {
    /// Starts both threads.
    pub(super) fn start(
        predictor: Predictor,
        updater: Updater,
        outlets: Outlets,
        counters: Arc<Counters>,
    ) -> Result<(Self, Inlet), MachineError> {
        let (input_sender, input) = sync_channel(INPUT_QUEUE);
        let (update_sender, update_input) = sync_channel(UPDATE_QUEUE);
        let (solution_sender, solutions) = sync_channel(SOLUTION_QUEUE);
        let inlet = Inlet { sender: input_sender, counters: Arc::clone(&counters) };
        let updating = Updating { updater, outlets: outlets.clone(), counters: Arc::clone(&counters) };
        let updater = spawn("updater", move || updating.run(&update_input, &solution_sender))?;
        let mut predicting = Predicting { predictor, outlets, counters, latest: None };
        let (alive, ended) = oneshot::channel();
        let predictor = spawn("predictor", move || {
            let _alive: oneshot::Sender<()> = alive;
            predicting.run(&input, &update_sender, &solutions);
        })?;
        Ok((Self { predictor, updater, ended }, inlet))
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
        let Self { predictor, updater, .. } = self;
        let joined = tokio::task::spawn_blocking(move || (predictor.join(), updater.join())).await;
        if matches!(joined, Ok((Ok(()), Ok(())))) { Ok(()) } else { Err(MachineError::Panicked) }
    }
}

fn spawn(name: &'static str, run: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, MachineError> {
    let thread = std::thread::Builder::new().name(name.to_owned());
    thread.spawn(run).map_err(|source| MachineError::Thread { name, source })
}

/// The predictor's thread.
struct Predicting {
    predictor: Predictor,
    outlets: Outlets,
    counters: Arc<Counters>,
    latest: Option<Stamp>,
}

impl Predicting {
    fn run(
        &mut self,
        input: &Receiver<Arrival>,
        updates: &SyncSender<Arrival>,
        solutions: &Receiver<Box<Solution>>,
    ) {
        for mut arrival in input {
            arrival.arrival = self.in_order(arrival.arrival);
            for solution in solutions.try_iter() {
                self.predictor.adopt(solution);
            }
            let start = Instant::now();
            let estimate = self.predictor.push(&arrival);
            if estimate.is_some() && arrival.reading.sensor() == Sensor::Imu {
                self.counters.predicted_in(start.elapsed());
            }
            self.counters.readings.fetch_add(1, Ordering::Relaxed);
            match updates.try_send(arrival) {
                Ok(()) => {}
                Err(TrySendError::Full(_)) => {
                    self.counters.update_dropped.fetch_add(1, Ordering::Relaxed);
                }
                // The updater has panicked; without it there is no estimate worth publishing.
                Err(TrySendError::Disconnected(_)) => return,
            }
            if let Some(estimate) = estimate {
                self.counters.estimates.fetch_add(1, Ordering::Relaxed);
                self.outlets.estimate(estimate);
            }
            self.outlets.reading(arrival);
            self.predictor.settle();
        }
    }
}

impl Predicting {
    /// Times of arrival rise strictly, so that their order can be had from a recording, unless the clock was
    /// set back.
    fn in_order(&mut self, arrival: Stamp) -> Stamp {
        let earliest = self.latest.map(|latest| latest + Span::from_nanos(1));
        let arrival = match earliest {
            Some(earliest) if arrival < earliest && earliest - arrival < CLOCK_SET_BACK => earliest,
            _ => arrival,
        };
        self.latest = Some(arrival);
        arrival
    }
}

/// The updater's thread.
struct Updating {
    updater: Updater,
    outlets: Outlets,
    counters: Arc<Counters>,
}

impl Updating {
    fn run(mut self, input: &Receiver<Arrival>, solutions: &SyncSender<Box<Solution>>) {
        let mut health_due = None;
        for arrival in input {
            let start = Instant::now();
            let solution = self.updater.push(&arrival);
            if let Some(solution) = solution {
                let duration = start.elapsed();
                self.counters.updated_in(duration);
                self.updater.note_update_time(duration.as_secs_f64() * 1e6);
                if solutions.send(solution).is_err() {
                    // The predictor has ended; nobody waits for the rest.
                    return;
                }
            }
            let events = self.updater.take_events();
            let happened = !events.is_empty();
            for event in events {
                self.outlets.event(event);
            }
            if happened || health_due.is_none_or(|due| arrival.arrival >= due) {
                health_due = Some(arrival.arrival + HEALTH_EVERY);
                self.outlets.health(self.updater.health());
            }
        }
    }
}
