//! The updater's thread.

use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};
use std::thread;
use std::time::Instant;

use super::bell::Bell;
use super::predicting::Numbered;
use super::{Finished, UpdaterOutlet};
use crate::estimator::{Solution, Updater};

/// What the thread owns.
pub(super) struct Updating<O> {
    pub(super) updater: Updater,
    pub(super) outlet: O,
    /// The predictor's.
    pub(super) bell: Bell,
    pub(super) finished: SyncSender<Finished>,
    /// Solutions that the predictor has copied.
    pub(super) spare: Receiver<Box<Solution>>,
}

impl<O: UpdaterOutlet> Updating<O> {
    /// Until no more readings come. The rest is worked off for its events even if the predictor has ended.
    pub(super) fn run(mut self, readings: &Receiver<Numbered>) {
        loop {
            match readings.try_recv() {
                Ok(reading) => self.work_off(reading),
                Err(TryRecvError::Empty) => thread::park(),
                Err(TryRecvError::Disconnected) => break,
            }
        }
        self.outlet.ended(self.updater);
    }

    fn work_off(&mut self, (number, arrival): Numbered) {
        self.spare.try_iter().for_each(|used| self.updater.recycle(used));
        let start = Instant::now();
        let solution = self.updater.push(&arrival);
        let took = solution.is_some().then(|| start.elapsed());
        if let Some(solution) = solution {
            // An error says that the predictor has ended, and needs no solution any more.
            let _ = self.finished.send(Finished { solution, solution_of: number });
            self.bell.ring();
        }
        self.outlet.worked_off(&arrival, took, &mut self.updater);
    }
}
