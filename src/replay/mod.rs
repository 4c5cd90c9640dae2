//! A log through the estimator, and the files that come out of it.
//!
//! The run is deterministic: the same readings give the same files but for the times in `summary.json`, which
//! come from the caller's clock. What ran on two threads, in the room `live`, comes out the same to the bit when
//! it is run [`again`] with the takeovers that were kept of it; [`check`] holds that against what was published.

mod again;
mod check;
mod outputs;
mod summary;

use std::io;

pub use again::{Again, NotThatRun, again};
pub use check::{Checked, Difference, How, check};
pub use outputs::Outputs;
pub use summary::{Distribution, Moments, Outage, Summary, Tally, Times};

use crate::estimator::Method;
use crate::sensors::{Arrival, Reading};

/// What a caller can show of a run that goes on.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Readings so far.
    pub readings: u64,
    /// Of the log so far, s.
    pub data_s: f64,
}

/// Runs an estimator over `arrivals` in their order; every estimate goes to `outputs`.
///
/// `clock` gives nanoseconds from any epoch and is asked around each half of each step.
///
/// # Errors
/// If `arrivals` has an error or a file cannot be written.
pub fn run<E: From<io::Error>>(
    arrivals: impl Iterator<Item = Result<Arrival, E>>,
    mut estimator: impl Method,
    outputs: &mut Outputs,
    mut clock: impl FnMut() -> u64,
    mut progress: impl FnMut(Progress),
) -> Result<Summary, E> {
    let mut tally = Tally::default();
    let begun = clock();
    for arrival in arrivals {
        let arrival = arrival?;
        let before = clock();
        let estimate = estimator.predict(&arrival);
        let predicted = clock();
        let correction = estimator.update(&arrival);
        let updated = clock();
        tally.note_arrival(&arrival);
        if matches!(arrival.reading, Reading::Imu(_)) {
            tally.predict.note(predicted - before);
        }
        if let Some(correction) = correction {
            tally.update.note(updated - predicted);
            tally.note_correction(&correction);
            outputs.write_correction(arrival.arrival, &correction)?;
        }
        if let Some(estimate) = &estimate {
            tally.estimates += 1;
            outputs.write_estimate(estimate)?;
        }
        write_events(&mut estimator, &mut tally, outputs)?;
        if tally.readings.is_multiple_of(4_096) {
            progress(Progress { readings: tally.readings, data_s: tally.data_s() });
        }
    }
    estimator.finish();
    write_events(&mut estimator, &mut tally, outputs)?;
    let health = estimator.health();
    Ok(tally.summary(clock() - begun, estimator.unfit_readings(), health))
}

fn write_events(estimator: &mut impl Method, tally: &mut Tally, outputs: &mut Outputs) -> io::Result<()> {
    estimator.take_events().iter().try_for_each(|event| {
        tally.note_event(event);
        outputs.write_event(event)
    })
}
