//! A run on two threads once more on one: every solution taken over where it was, so that all bits are the same.

use std::collections::VecDeque;

use crate::estimator::{Options, Predictor, Solution, Updater, split};
use crate::sensors::Arrival;
use crate::state::{Estimate, LiveRun, Takeover};

/// The takeovers are not those of these readings, or of other options.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotThatRun {
    /// The updater made no solution where one was taken over.
    #[error(
        "reading {} leads to no solution, but one was taken over before reading {}",
        .0.solution_of,
        .0.before
    )]
    NoSolution(Takeover),
    /// Takeovers that are not in order, or of solutions of readings to come.
    #[error("a takeover before reading {} of a solution of reading {} is out of order", .0.before, .0.solution_of)]
    OutOfOrder(Takeover),
    /// Readings are missing at the end.
    #[error("{0} readings are there, more were taken before the last takeover")]
    Ends(u64),
}

/// A run on two threads, on one.
pub struct Again {
    predictor: Predictor,
    updater: Updater,
    /// What the predictor took, and the updater not yet: it comes as far as the next solution that is taken over.
    waiting: VecDeque<(u64, Arrival, bool)>,
    solutions: VecDeque<(u64, Box<Solution>)>,
    taken: u64,
}

impl Again {
    /// Before the first reading.
    pub fn new(options: Options) -> Self {
        let (predictor, updater) = split(options);
        Self { predictor, updater, waiting: VecDeque::new(), solutions: VecDeque::new(), taken: 0 }
    }

    /// Takes a reading; `seen` says whether the updater took it, too.
    pub fn push(&mut self, arrival: &Arrival, seen: bool) -> Option<Estimate> {
        self.waiting.push_back((self.taken, *arrival, seen));
        self.taken += 1;
        self.predictor.push(arrival)
    }

    /// Takes over the solution to which the reading of that number led.
    ///
    /// # Errors
    /// [`NotThatRun`] if there is none.
    pub fn take_over(&mut self, solution_of: u64) -> Result<(), NotThatRun> {
        let takeover = Takeover { before: self.taken, solution_of };
        if solution_of >= self.taken {
            return Err(NotThatRun::OutOfOrder(takeover));
        }
        while let Some((number, arrival, seen)) =
            self.waiting.pop_front_if(|(number, ..)| *number <= solution_of)
        {
            if seen {
                self.solutions.extend(self.updater.push(&arrival).map(|solution| (number, solution)));
                self.updater.take_events();
            }
        }
        match self.solutions.pop_front() {
            Some((of, solution)) if of == solution_of => {
                self.predictor.adopt(&solution);
                Ok(())
            }
            _ => Err(NotThatRun::NoSolution(takeover)),
        }
    }
}

/// Gives every estimate of the run to `said`, as the machine that ran it had them.
///
/// # Errors
/// [`NotThatRun`] where readings and takeovers do not fit together.
pub fn again(run: &LiveRun, options: Options, mut said: impl FnMut(&Estimate)) -> Result<(), NotThatRun> {
    let mut again = Again::new(options);
    let mut takeovers = run.takeovers.iter().copied().peekable();
    for (number, arrival) in (0_u64..).zip(&run.arrivals) {
        while let Some(takeover) = takeovers.next_if(|takeover| takeover.before <= number) {
            if takeover.before < number {
                return Err(NotThatRun::OutOfOrder(takeover));
            }
            again.take_over(takeover.solution_of)?;
        }
        if let Some(estimate) = again.push(arrival, !run.unseen.contains(&number)) {
            said(&estimate);
        }
    }
    let length = run.arrivals.len() as u64;
    // What was taken over after the last reading changed nothing any more.
    match takeovers.find(|takeover| takeover.before > length) {
        Some(_) => Err(NotThatRun::Ends(length)),
        None => Ok(()),
    }
}
