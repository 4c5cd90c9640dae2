//! The predictor's thread.

use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError};
use std::thread;
use std::time::{Duration, Instant};

use super::anticipation::{Anticipation, Now};
use super::bell::Bell;
use super::{Finished, Origin, PredictorOutlet, Taken};
use crate::estimator::{Predictor, Solution};
use crate::sensors::{Arrival, Sensor};
use crate::state::Takeover;
use crate::time::{Span, Stamp};

/// A reading that arrives so much before the last one shows that the clock was set back.
const CLOCK_SET_BACK: Span = Span::from_millis(1_000);
/// A reading for the updater, with its number.
pub(super) type Numbered = (u64, Arrival);

/// What the thread owns.
pub(super) struct Predicting<O> {
    predictor: Predictor,
    origin: Origin,
    anticipation: Anticipation,
    outlet: O,
    /// `None` only while it is dropped.
    to_updater: Option<SyncSender<Numbered>>,
    updater_bell: Bell,
    /// Readings taken so far.
    taken: u64,
    latest_arrival: Option<Stamp>,
}

impl<O: PredictorOutlet> Predicting<O> {
    pub(super) fn new(
        predictor: Predictor,
        origin: Origin,
        imu_period: Duration,
        outlet: O,
        to_updater: SyncSender<Numbered>,
        updater_bell: Bell,
    ) -> Self {
        Self {
            predictor,
            origin,
            anticipation: Anticipation::new(imu_period),
            outlet,
            to_updater: Some(to_updater),
            updater_bell,
            taken: 0,
            latest_arrival: None,
        }
    }

    /// Until the last inlet is dropped or the updater is gone.
    pub(super) fn run(
        mut self,
        readings: &Receiver<Arrival>,
        solutions: &Receiver<Finished>,
        used: &SyncSender<Box<Solution>>,
    ) {
        loop {
            let reading = readings.try_recv();
            let mut idle = reading.is_err();
            match reading {
                Ok(arrival) => {
                    if !self.take(arrival) {
                        // The updater has panicked; without it there is no estimate worth having.
                        break;
                    }
                }
                Err(TryRecvError::Disconnected) => break,
                Err(TryRecvError::Empty) => {}
            }
            // One after each reading, so that neither keeps the other waiting.
            if let Ok(finished) = solutions.try_recv() {
                idle = false;
                self.take_over(&finished);
                // There is room for all that can be under way.
                let _ = used.try_send(finished.solution);
            }
            if idle {
                self.wait();
            }
        }
    }

    /// False if the updater is gone.
    fn take(&mut self, mut arrival: Arrival) -> bool {
        let start = Instant::now();
        arrival.arrival = self.in_order(arrival.arrival);
        let estimate = self.predictor.push(&arrival);
        let took = start.elapsed();
        let number = self.taken;
        self.taken += 1;
        let Some(to_updater) = &self.to_updater else { return false };
        let seen = match self.origin {
            Origin::Machine => match to_updater.try_send((number, arrival)) {
                Ok(()) => true,
                Err(TrySendError::Full(_)) => false,
                Err(TrySendError::Disconnected(_)) => return false,
            },
            Origin::Log => match to_updater.send((number, arrival)) {
                Ok(()) => true,
                Err(_) => return false,
            },
        };
        self.updater_bell.ring();
        if arrival.reading.sensor() == Sensor::Imu {
            self.anticipation.note_sample(start);
        }
        self.outlet.taken(Taken { number, arrival: &arrival, seen, estimate, took });
        self.predictor.settle();
        true
    }

    fn take_over(&mut self, finished: &Finished) {
        let correction = self.predictor.adopt_measured(&finished.solution);
        let takeover = Takeover { before: self.taken, solution_of: finished.solution_of };
        self.outlet.taken_over(takeover, correction);
        self.predictor.settle();
    }

    /// Parks until somebody rings or a rehearsal is due, and rehearses. Wakes too early at times, which does no
    /// harm.
    fn wait(&mut self) {
        match self.anticipation.at(Instant::now()) {
            Now::Wait => thread::park(),
            Now::WaitFor(span) => thread::park_timeout(span),
            Now::RehearseAndWaitFor(span) => {
                self.predictor.rehearse();
                thread::park_timeout(span);
            }
        }
    }

    /// Times of arrival rise strictly, so that their order can be had from a recording, unless the clock was
    /// set back. A log's stay as they are.
    fn in_order(&mut self, arrival: Stamp) -> Stamp {
        let earliest = self.latest_arrival.map(|latest| latest + Span::from_nanos(1));
        let arrival = match earliest {
            Some(earliest)
                if self.origin == Origin::Machine
                    && arrival < earliest
                    && earliest - arrival < CLOCK_SET_BACK =>
            {
                earliest
            }
            _ => arrival,
        };
        self.latest_arrival = Some(arrival);
        arrival
    }
}

impl<O> Drop for Predicting<O> {
    /// Also when the thread panics: the updater, asleep, would wait for ever.
    fn drop(&mut self) {
        // First the sender, so that the updater sees the end when it wakes.
        self.to_updater = None;
        self.updater_bell.ring();
    }
}
