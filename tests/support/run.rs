//! What a test keeps of a run on two threads.

use std::collections::BTreeSet;
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use holdfast::estimator::{Correction, Options, Updater, split};
use holdfast::live::{self, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use holdfast::sensors::Arrival;
use holdfast::state::{Estimate, LiveRun, Takeover};

/// An IMU's period.
pub const PERIOD: Duration = Duration::from_millis(10);

/// Sends everything on; dropped at the end.
struct Keeper(Sender<Kept>);

#[expect(clippy::large_enum_variant, reason = "few takeovers among many estimates")]
enum Kept {
    Reading(Arrival, bool, Option<Estimate>),
    Takeover(Takeover),
}

impl PredictorOutlet for Keeper {
    fn taken(&mut self, taken: Taken<'_>) {
        let _ = self.0.send(Kept::Reading(*taken.arrival, taken.seen, taken.estimate));
    }

    fn taken_over(&mut self, takeover: Takeover, _: Correction) {
        let _ = self.0.send(Kept::Takeover(takeover));
    }
}

/// Calls this after each reading, on the updater's thread.
struct Slow<F>(F);

impl<F: FnMut(&Arrival) + Send + 'static> UpdaterOutlet for Slow<F> {
    fn worked_off(&mut self, arrival: &Arrival, _: Option<Duration>, updater: &mut Updater) {
        updater.take_events();
        (self.0)(arrival);
    }

    fn ended(self, _: Updater) {}
}

/// Runs `arrivals` on two threads as fast as `pace` lets them come; `slow` runs on the updater's thread.
pub fn on_two_threads(
    arrivals: &[Arrival],
    options: Options,
    origin: Origin,
    mut pace: impl FnMut(&Arrival),
    slow: impl FnMut(&Arrival) + Send + 'static,
) -> (LiveRun, Vec<Estimate>) {
    let (sender, kept) = channel();
    let (threads, inlet) =
        live::start(split(options), origin, PERIOD, Keeper(sender), Slow(slow)).expect("threads");
    for arrival in arrivals {
        pace(arrival);
        assert!(inlet.hand_over(*arrival), "the threads go on");
    }
    drop(inlet);
    assert!(threads.join(), "no panic");
    let mut run = LiveRun { arrivals: vec![], unseen: BTreeSet::new(), takeovers: vec![] };
    let mut estimates = vec![];
    for kept in kept {
        match kept {
            Kept::Reading(arrival, seen, estimate) => {
                if !seen {
                    run.unseen.insert(run.arrivals.len() as u64);
                }
                run.arrivals.push(arrival);
                estimates.extend(estimate);
            }
            Kept::Takeover(takeover) => run.takeovers.push(takeover),
        }
    }
    (run, estimates)
}
