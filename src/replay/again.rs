//! A run on two threads once more on one: every solution taken over where it was, so that all bits are the same.

use std::collections::VecDeque;

use crate::estimator::{Options, Solution, split};
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

/// Gives every estimate of the run to `said`, as the machine that ran it had them.
///
/// # Errors
/// [`NotThatRun`] where readings and takeovers do not fit together.
pub fn again(run: &LiveRun, options: Options, mut said: impl FnMut(&Estimate)) -> Result<(), NotThatRun> {
    let (mut predictor, mut updater) = split(options);
    let mut solutions: VecDeque<(u64, Box<Solution>)> = VecDeque::new();
    let mut to_update = (0_u64..).zip(&run.arrivals);
    let mut updated = 0;
    let mut takeovers = run.takeovers.iter().copied().peekable();
    for (number, arrival) in (0_u64..).zip(&run.arrivals) {
        while let Some(takeover) = takeovers.next_if(|takeover| takeover.before <= number) {
            if takeover.before < number || takeover.solution_of >= number {
                return Err(NotThatRun::OutOfOrder(takeover));
            }
            while updated <= takeover.solution_of
                && let Some((late, arrival)) = to_update.next()
            {
                updated = late + 1;
                if run.unseen.contains(&late) {
                    continue;
                }
                solutions.extend(updater.push(arrival).map(|solution| (late, solution)));
                updater.take_events();
            }
            match solutions.pop_front() {
                Some((of, solution)) if of == takeover.solution_of => predictor.adopt(&solution),
                _ => return Err(NotThatRun::NoSolution(takeover)),
            }
        }
        if let Some(estimate) = predictor.push(arrival) {
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
