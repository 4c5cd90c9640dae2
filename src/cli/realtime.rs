//! A log at the speed it was recorded, prediction and update on two threads, as on a machine.

use std::error::Error;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use crate::estimator::{Options, Solution, Updater, split};
use crate::replay::{Outputs, Summary, Tally};
use crate::sensors::{Arrival, Reading};
use crate::state::{Event, Health};

/// Readings under way to the updater: some seconds of all sensors. When it is full the player waits, since a
/// log must not lose anything; a machine counts and drops instead.
const READINGS_UNDER_WAY: usize = 1_024;
/// Solutions under way to the predictor: far more than updates between two IMU samples.
const SOLUTIONS_UNDER_WAY: usize = 256;

/// What the updater's thread hands back.
enum FromUpdater {
    Solution { solution: Box<Solution>, nanos: u64 },
    Events(Vec<Event>),
    End { health: Box<Health>, unfit: u64 },
}

/// Plays `arrivals` in real time; blocks until the end.
///
/// # Errors
/// A file cannot be written.
pub fn run(
    arrivals: &[Arrival],
    options: Options,
    outputs: &mut Outputs,
    mut show: impl FnMut(f64),
) -> Result<Summary, Box<dyn Error>> {
    let (mut predictor, updater) = split(options);
    let (to_updater, readings) = sync_channel::<Arrival>(READINGS_UNDER_WAY);
    let (answers, from_updater) = sync_channel::<FromUpdater>(SOLUTIONS_UNDER_WAY);
    let worker = thread::Builder::new()
        .name("updater".to_owned())
        .spawn(move || work(updater, &readings, &answers))?;
    let mut tally = Tally::default();
    let epoch = Instant::now();
    let Some(first) = arrivals.first().map(|arrival| arrival.arrival) else {
        return Err("the log is empty".into());
    };
    for arrival in arrivals {
        let due = Duration::from_nanos(u64::try_from((arrival.arrival - first).as_nanos()).unwrap_or(0));
        if let Some(early) = due.checked_sub(epoch.elapsed()) {
            thread::sleep(early);
        }
        loop {
            match from_updater.try_recv() {
                Ok(FromUpdater::Solution { solution, nanos }) => {
                    tally.update.note(nanos);
                    let correction = predictor.adopt_measured(solution);
                    tally.note_takeover(&correction);
                }
                Ok(FromUpdater::Events(events)) => note_events(&events, &mut tally, outputs)?,
                Ok(FromUpdater::End { .. }) | Err(TryRecvError::Disconnected | TryRecvError::Empty) => break,
            }
        }
        let before = Instant::now();
        let estimate = predictor.push(arrival);
        let nanos = u64::try_from(before.elapsed().as_nanos()).unwrap_or(u64::MAX);
        if to_updater.send(*arrival).is_err() {
            break;
        }
        tally.note_arrival(arrival);
        if matches!(arrival.reading, Reading::Imu(_)) {
            tally.predict.note(nanos);
            show(due.as_secs_f64());
        }
        if let Some(estimate) = &estimate {
            tally.estimates += 1;
            outputs.write_estimate(estimate)?;
        }
        predictor.settle();
    }
    drop(to_updater);
    let mut end = None;
    for answer in from_updater {
        match answer {
            FromUpdater::Solution { .. } => {}
            FromUpdater::Events(events) => note_events(&events, &mut tally, outputs)?,
            FromUpdater::End { health, unfit } => end = Some((health, unfit)),
        }
    }
    worker.join().map_err(|_| "the updater's thread panicked")?;
    let (health, unfit) = end.ok_or("the updater's thread ended early")?;
    let wall = u64::try_from(epoch.elapsed().as_nanos()).unwrap_or(u64::MAX);
    Ok(tally.summary(wall, unfit, *health))
}

fn note_events(events: &[Event], tally: &mut Tally, outputs: &mut Outputs) -> std::io::Result<()> {
    events.iter().try_for_each(|event| {
        tally.note_event(event);
        outputs.write_event(event)
    })
}

fn work(mut updater: Updater, readings: &Receiver<Arrival>, answers: &SyncSender<FromUpdater>) {
    for arrival in readings {
        let before = Instant::now();
        let solution = updater.push(&arrival);
        let nanos = u64::try_from(before.elapsed().as_nanos()).unwrap_or(u64::MAX);
        if let Some(solution) = solution
            && answers.send(FromUpdater::Solution { solution, nanos }).is_err()
        {
            return;
        }
        let events = updater.take_events();
        if !events.is_empty() && answers.send(FromUpdater::Events(events)).is_err() {
            return;
        }
    }
    updater.finish();
    let events = updater.take_events();
    if !events.is_empty() && answers.send(FromUpdater::Events(events)).is_err() {
        return;
    }
    let end = FromUpdater::End { health: Box::new(updater.health()), unfit: updater.unfit_readings() };
    // Nobody listens only if the player has failed, and then says so itself.
    let _ = answers.send(end);
}
