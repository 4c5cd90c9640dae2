//! The estimator of one machine: readings in, estimates at IMU rate out.
//!
//! Two halves. The [`Updater`] keeps the smoother's window and turns measurements into [`Solution`]s; the
//! [`Predictor`] carries the newest solution along with every IMU sample. On a machine they live on two threads
//! and the predictor never waits ([`split`]); offline, [`Estimator`] runs both in turn on one thread, and the
//! same readings give the same bits. Neither reads a clock, a file or a socket. `README.md` beside this file
//! tells the whole story.

mod alignment;
mod chassis_turn;
mod gate;
mod graphs;
mod inbox;
mod inflation;
mod initialization;
mod lidar;
mod method;
mod monitor;
mod options;
mod place;
mod predictor;
mod resumption;
mod standstill;
mod starter;
mod ties;
mod updater;

pub use gate::Options as GateOptions;
pub use initialization::Start;
pub use method::Method;
pub use options::{InOutage, Initialization, Options};
pub use predictor::Predictor;
pub use starter::{Admitted, Starter};
pub use updater::Updater;

use std::sync::Arc;

use crate::sensors::{Arrival, ImuSample};
use crate::smoother::PastNode;
use crate::state::{Estimate, Event, Health, Mode, NavState, StateMatrix};
use crate::time::{Span, Stamp};

/// A gap in the IMU's samples up to this length is bridged; after a longer one the estimate starts anew.
const IMU_GAP_MAX: Span = Span::from_millis(500);
/// A measurement this far ahead of the IMU has a wrong clock.
pub(crate) const AHEAD_MAX: Span = Span::from_millis(1_000);

/// What an update found: the newest node of the window.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// Of the node.
    pub stamp: Stamp,
    /// Its state.
    pub state: NavState,
    /// Of its state, in the state's tangent.
    pub covariance: StateMatrix,
    /// What the estimate rests on.
    pub mode: Mode,
    /// The first one after a start.
    pub restart: bool,
}

/// Both halves, for two threads. Each must be given every arrival, in the same order; solutions go from the
/// updater to [`Predictor::adopt`] between two arrivals. Between which, decides the bits of what follows: who
/// keeps that as a [`crate::state::Takeover`] can have the same run again, on one thread.
pub fn split(options: Options) -> (Predictor, Updater) {
    (Predictor::new(options.clone()), Updater::new(options))
}

/// What one estimate rested on, from its start until it was given up.
#[derive(Clone, Debug)]
pub struct Past {
    /// Nodes of the answering graph with their factors, oldest first. A chain begins at each node with a `start`:
    /// where fixes seated the estimate anew, nothing ties it to what was before.
    ///
    /// After an outage that is main, with the fixes that ended it; what fallback alone was told is not in it.
    pub nodes: Vec<Arc<PastNode>>,
    /// Samples of the cabin IMU, oldest first, from before the first node on.
    pub samples: Vec<ImuSample>,
}

/// What a solution changed when it was taken over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correction {
    /// How far it moved the position at the newest IMU sample, m: the consistency of prediction and update
    /// (Nubert et al. 2022, section V-D). `None` for the first one after a start.
    pub correction_m: Option<f64>,
}

/// Both halves in turn, on the caller's thread.
pub struct Estimator {
    predictor: Predictor,
    updater: Updater,
}

impl Estimator {
    /// An estimator that has seen nothing yet.
    pub fn new(options: Options) -> Self {
        let (predictor, updater) = split(options);
        Self { predictor, updater }
    }

    /// Keeps every node with its factors, for [`Estimator::take_history`]; see [`Updater::keep_history`].
    pub fn keep_history(&mut self) {
        self.updater.keep_history();
    }

    /// How much is kept; see [`Updater::history_nodes`].
    pub fn history_nodes(&self) -> [usize; 2] {
        self.updater.history_nodes()
    }

    /// Keeps it no longer; see [`Updater::forget_history`].
    pub fn forget_history(&mut self) {
        self.updater.forget_history();
    }

    /// The graph as it was built; see [`Updater::take_history`].
    pub fn take_history(&mut self) -> Vec<Past> {
        self.updater.take_history()
    }

    /// Takes a reading, in order of arrival. An IMU sample gives an estimate once started; what the reading
    /// itself corrects is in the next one, as it is on a machine.
    pub fn push(&mut self, arrival: &Arrival) -> Option<Estimate> {
        let estimate = self.predict(arrival);
        self.update(arrival);
        estimate
    }

    /// First half of [`Estimator::push`], for callers that time the halves.
    pub fn predict(&mut self, arrival: &Arrival) -> Option<Estimate> {
        self.predictor.push(arrival)
    }

    /// Second half of [`Estimator::push`]: takes over the solution that the reading led to, if any.
    pub fn update(&mut self, arrival: &Arrival) -> Option<Correction> {
        let solution = self.updater.push(arrival)?;
        Some(self.predictor.adopt_measured(&solution))
    }

    /// Readings that were no measurements at all or came against the clock.
    pub fn unfit_readings(&self) -> u64 {
        self.updater.unfit_readings()
    }

    /// Health as of the newest arrival.
    pub fn health(&self) -> Health {
        self.updater.health()
    }

    /// No more readings come: tells what was held back for being told too often.
    pub fn finish(&mut self) {
        self.updater.finish();
    }

    /// Events since the last call, oldest first.
    pub fn take_events(&mut self) -> Vec<Event> {
        self.updater.take_events()
    }
}
