//! A log at the speed it was recorded, prediction and update on two threads, as on a machine.

use std::error::Error;
use std::io;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use crate::config::Machine;
use crate::estimator::{Correction, Updater, split};
use crate::live::{self, Inlet, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use crate::replay::{Outputs, Summary, Tally};
use crate::sensors::{Arrival, Reading};
use crate::state::{Estimate, Event, Health, Takeover};
use crate::time::Stamp;

/// What is said on the way to the files: some seconds. When it is full the threads wait, since nothing of a log
/// must be lost; a machine counts and drops instead.
const SAID: usize = 4_096;

/// What the two threads say.
#[expect(clippy::large_enum_variant, reason = "an estimate a sample is moved, not allocated")]
enum Said {
    Taken { arrival: Arrival, nanos: u64 },
    Estimate(Estimate),
    TakenOver { takeover: Takeover, correction: Correction },
    Updated { nanos: u64 },
    Events(Vec<Event>),
    End { health: Box<Health>, unfit: u64 },
}

/// Plays `arrivals` at `speed` times real time; blocks until the end.
///
/// # Errors
/// A file cannot be written.
pub fn run(
    arrivals: &[Arrival],
    machine: &Machine,
    speed: f64,
    outputs: &mut Outputs,
    show: impl FnMut(f64),
) -> Result<Summary, Box<dyn Error>> {
    outputs.keep_takeovers()?;
    let (sender, said) = sync_channel(SAID);
    let period = Duration::from_secs_f64(1.0 / machine.imu.update_rate / speed);
    let halves = split(machine.estimator_options());
    let outlet = Outlet(sender);
    let (threads, inlet) = live::start(halves, Origin::Log, period, outlet.clone(), outlet)?;
    let begin = Instant::now();
    let written = thread::scope(|scope| {
        let writer = scope.spawn(move || write(said, outputs));
        play(arrivals, speed, begin, &inlet, || writer.is_finished(), show);
        drop(inlet);
        writer.join()
    });
    if !threads.join() {
        return Err("the estimator's threads have panicked".into());
    }
    let (tally, end) = written.map_err(|_| "the writer's thread has panicked")??;
    let (health, unfit) = end.ok_or("the updater's thread ended early")?;
    let wall = nanos(begin.elapsed());
    Ok(tally.summary(wall, unfit, *health))
}

/// Hands every reading over when it is due.
fn play(
    arrivals: &[Arrival],
    speed: f64,
    begin: Instant,
    inlet: &Inlet,
    stopped: impl Fn() -> bool,
    mut show: impl FnMut(f64),
) {
    let Some(first) = arrivals.first().map(|arrival| arrival.arrival) else { return };
    for arrival in arrivals {
        let data_s = arrival.arrival.seconds_since(first);
        let due = Duration::try_from_secs_f64(data_s / speed).unwrap_or(Duration::ZERO);
        if let Some(early) = due.checked_sub(begin.elapsed()) {
            thread::sleep(early);
        }
        if stopped() || !inlet.hand_over(*arrival) {
            return;
        }
        if matches!(arrival.reading, Reading::Imu(_)) {
            show(data_s);
        }
    }
}

type Written = (Tally, Option<(Box<Health>, u64)>);

/// Writes all that is said, until the end. If it fails, the receiver goes with it: nobody waits for the writer.
fn write(said: Receiver<Said>, outputs: &mut Outputs) -> io::Result<Written> {
    let mut tally = Tally::default();
    let mut end = None;
    let mut now = Stamp::default();
    for said in said {
        match said {
            Said::Taken { arrival, nanos } => {
                now = arrival.arrival;
                tally.note_arrival(&arrival);
                if matches!(arrival.reading, Reading::Imu(_)) {
                    tally.predict.note(nanos);
                }
            }
            Said::Estimate(estimate) => {
                tally.estimates += 1;
                outputs.write_estimate(&estimate)?;
            }
            Said::TakenOver { takeover, correction } => {
                tally.note_correction(&correction);
                outputs.write_takeover(&takeover)?;
                outputs.write_correction(now, &correction)?;
            }
            Said::Updated { nanos } => tally.update.note(nanos),
            Said::Events(events) => {
                for event in &events {
                    tally.note_event(event);
                    outputs.write_event(event)?;
                }
            }
            Said::End { health, unfit } => end = Some((health, unfit)),
        }
    }
    Ok((tally, end))
}

/// Both threads' way to the writer. An error says that it has failed, which it tells itself.
#[derive(Clone)]
struct Outlet(SyncSender<Said>);

impl Outlet {
    fn say(&self, said: Said) {
        let _ = self.0.send(said);
    }

    fn events(&self, updater: &mut Updater) {
        let events = updater.take_events();
        if !events.is_empty() {
            self.say(Said::Events(events));
        }
    }
}

impl PredictorOutlet for Outlet {
    fn taken(&mut self, taken: Taken<'_>) {
        self.say(Said::Taken { arrival: *taken.arrival, nanos: nanos(taken.took) });
        if let Some(estimate) = taken.estimate {
            self.say(Said::Estimate(estimate));
        }
    }

    fn taken_over(&mut self, takeover: Takeover, correction: Correction) {
        self.say(Said::TakenOver { takeover, correction });
    }
}

impl UpdaterOutlet for Outlet {
    fn worked_off(&mut self, _: &Arrival, update: Option<Duration>, updater: &mut Updater) {
        if let Some(took) = update {
            self.say(Said::Updated { nanos: nanos(took) });
        }
        self.events(updater);
    }

    fn ended(self, mut updater: Updater) {
        updater.finish();
        self.events(&mut updater);
        self.say(Said::End { health: Box::new(updater.health()), unfit: updater.unfit_readings() });
    }
}

fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
