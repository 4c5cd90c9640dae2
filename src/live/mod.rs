//! The estimator's two halves on two threads, as a machine runs them and as `estimate --realtime` tries them.
//!
//! ```text
//! inlet ──readings──▶ predictor ──readings──▶ updater
//!                      ▲  │  ▲ └──▶ predictor's outlet  └──▶ updater's outlet
//!                      │  └used┐
//!                      └─solutions, adopted between two readings
//! ```
//!
//! The predictor waits for nothing but its next reading or solution, and that by parking: queues are tried, not
//! waited on, and whoever puts something in unparks the other thread, which takes no lock. A solution is taken
//! over as soon as it is there, at the place in the stream of readings that its [`Takeover`] names; with the
//! readings and the takeovers [`crate::replay::again`] gives the same estimates to the bit. A solution that was adopted
//! goes back to the updater for its next one; in the steady state neither thread allocates or frees anything.
//!
//! Shortly before an IMU sample is due, the predictor's thread wakes and rehearses (see
//! [`Predictor::rehearse`]): the sample then finds warm caches. What is done with estimates, events and health
//! is its callers' business.

#![allow(clippy::disallowed_methods, reason = "shells have threads and clocks")]

mod anticipation;
mod bell;
mod predicting;
mod updating;

use std::io;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::estimator::{Correction, Predictor, Solution, Updater};
use crate::sensors::Arrival;
use crate::state::{Estimate, Takeover};
use bell::Bell;
use predicting::Predicting;
use updating::Updating;

/// Readings on the way to the predictor: some two seconds of all sensors. Full, [`Inlet::offer`] refuses and
/// [`Inlet::hand_over`] waits.
const INPUT_QUEUE: usize = 1_024;
/// Readings on the way to the updater: some nine seconds, longer than any update takes.
const UPDATE_QUEUE: usize = 4_096;
/// Solutions on the way back: more than there are between two readings. Full, the updater waits.
const SOLUTION_QUEUE: usize = 64;

/// Where the readings come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A machine at work. Times of arrival are made to rise strictly; what the updater has no room for, it does
    /// not see, and the outlet is told.
    Machine,
    /// A log, which must not lose anything: who is too fast waits.
    Log,
}

/// A reading that the predictor took.
pub struct Taken<'a> {
    /// Counted from 0.
    pub number: u64,
    /// With the time of arrival that both halves were given.
    pub arrival: &'a Arrival,
    /// Whether the updater gets it, too.
    pub seen: bool,
    /// What it led to.
    pub estimate: Option<Estimate>,
    /// From the reading in hand to the estimate.
    pub took: Duration,
}

/// What becomes of what the predictor says; called on its thread, and had better not wait.
pub trait PredictorOutlet: Send + 'static {
    /// A reading was taken.
    fn taken(&mut self, taken: Taken<'_>);
    /// A solution was taken over, and what it changed.
    fn taken_over(&mut self, takeover: Takeover, correction: Correction);
}

/// What becomes of what the updater says; called on its thread.
pub trait UpdaterOutlet: Send + 'static {
    /// A reading was worked off; `update` is how long it took, if it led to a solution.
    fn worked_off(&mut self, arrival: &Arrival, update: Option<Duration>, updater: &mut Updater);
    /// No more readings come.
    fn ended(self, updater: Updater);
}

/// A solution on its way, with the number of the reading that led to it.
struct Finished {
    solution: Box<Solution>,
    solution_of: u64,
}

/// Both threads.
pub struct Threads {
    predictor: JoinHandle<()>,
    updater: JoinHandle<()>,
}

/// Where the readings go in; the threads end when the last one is dropped.
#[derive(Clone)]
pub struct Inlet {
    /// `None` only while it is dropped.
    sender: Option<SyncSender<Arrival>>,
    bell: Bell,
}

/// Starts both threads. `imu_period` is what passes between two IMU samples by the system's clock.
///
/// # Errors
/// If the system gives no thread.
pub fn start(
    (predictor, updater): (Predictor, Updater),
    origin: Origin,
    imu_period: Duration,
    predictor_outlet: impl PredictorOutlet,
    updater_outlet: impl UpdaterOutlet,
) -> io::Result<(Threads, Inlet)> {
    let (input, readings) = sync_channel(INPUT_QUEUE);
    let (to_updater, update_input) = sync_channel(UPDATE_QUEUE);
    let (finished, solutions) = sync_channel(SOLUTION_QUEUE);
    // As many as can be under way.
    let (used, spare) = sync_channel(SOLUTION_QUEUE + 1);
    let (predictor_bell, updater_bell) = (Bell::default(), Bell::default());
    let updating =
        Updating { updater, outlet: updater_outlet, bell: predictor_bell.clone(), finished, spare };
    let updater = spawn("updater", move || updating.run(&update_input))?;
    updater_bell.hang(updater.thread());
    let predicting =
        Predicting::new(predictor, origin, imu_period, predictor_outlet, to_updater, updater_bell);
    let predictor = spawn("predictor", move || predicting.run(&readings, &solutions, &used))?;
    predictor_bell.hang(predictor.thread());
    Ok((Threads { predictor, updater }, Inlet { sender: Some(input), bell: predictor_bell }))
}

fn spawn(name: &'static str, run: impl FnOnce() + Send + 'static) -> io::Result<JoinHandle<()>> {
    std::thread::Builder::new().name(name.to_owned()).spawn(run)
}

impl Threads {
    /// Waits until both have worked off what is queued; the inlets must be gone. False if one has panicked.
    pub fn join(self) -> bool {
        let (predictor, updater) = (self.predictor.join(), self.updater.join());
        predictor.is_ok() && updater.is_ok()
    }
}

impl Inlet {
    /// Hands a reading over; false if there was no room for it. Never waits.
    pub fn offer(&self, arrival: Arrival) -> bool {
        let taken = self.sender.as_ref().is_some_and(|sender| sender.try_send(arrival).is_ok());
        self.bell.ring();
        taken
    }

    /// Hands a reading over and waits for room; false if the threads have ended.
    pub fn hand_over(&self, arrival: Arrival) -> bool {
        let taken = self.sender.as_ref().is_some_and(|sender| sender.send(arrival).is_ok());
        self.bell.ring();
        taken
    }
}

impl Drop for Inlet {
    fn drop(&mut self) {
        // First the sender, so that the predictor sees the end when it wakes.
        self.sender = None;
        self.bell.ring();
    }
}
