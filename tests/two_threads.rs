//! Predictor and updater on two threads: the predictor never waits, and with the takeovers that were kept a run
//! comes out the same on one thread, to the bit.
#![allow(clippy::disallowed_methods, reason = "what runs on threads is tried on threads")]

#[path = "support/run.rs"]
mod run;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use holdfast::estimator::{Correction, Estimator, Options, Updater, split};
use holdfast::live::{self, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use holdfast::replay::{NotThatRun, again};
use holdfast::sensors::{Arrival, Sensor};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::state::{Estimate, LiveRun, Takeover};
use holdfast::time::Stamp;

use run::on_two_threads;

/// Readings that wait for the updater at most.
const UPDATE_QUEUE: usize = 4_096;

/// So many seconds of the demo's first machine, which loses GNSS after a while.
fn log(seconds: f64) -> (Vec<Arrival>, Options) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario = Scenario::load(&root.join("config/scenarios/construction.toml")).expect("valid");
    let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(seconds));
    let options = simulation.machine().estimator_options();
    (simulation.collect(), options)
}

/// Sleeps until an arrival is due at this speed.
fn paced(speed: f64) -> impl FnMut(&Arrival) {
    let begin = Instant::now();
    move |arrival| {
        let due = Duration::from_secs_f64(arrival.arrival.as_seconds() / speed);
        if let Some(early) = due.checked_sub(begin.elapsed()) {
            std::thread::sleep(early);
        }
    }
}

fn replayed(run: &LiveRun, options: Options) -> Vec<Estimate> {
    let mut estimates = vec![];
    again(run, options, |estimate| estimates.push(*estimate)).expect("that run");
    estimates
}

/// To the bit: `==` would take -0 for 0.
fn assert_same_bits(found: &[Estimate], expected: &[Estimate]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert_eq!(found, expected);
        assert_eq!(format!("{found:?}"), format!("{expected:?}"));
    }
}

fn in_turn(arrivals: &[Arrival], options: Options) -> Vec<Estimate> {
    let mut estimator = Estimator::new(options);
    arrivals.iter().filter_map(|arrival| estimator.push(arrival)).collect()
}

#[test]
fn run_on_two_threads_comes_out_the_same_on_one() {
    let (arrivals, options) = log(60.0);
    let (run, estimates) = on_two_threads(&arrivals, options.clone(), Origin::Machine, paced(30.0), |_| {});
    assert_eq!(run.arrivals.len(), arrivals.len());
    assert!(estimates.len() > 5_000, "{}", estimates.len());
    // As on a machine, solutions come when other readings have come meanwhile: the estimates are others.
    let late = run.takeovers.iter().filter(|takeover| takeover.before > takeover.solution_of + 1).count();
    assert!(late > 100, "{late} of {}", run.takeovers.len());
    assert!(estimates != in_turn(&arrivals, options.clone()));
    assert_same_bits(&replayed(&run, options), &estimates);
}

#[test]
fn readings_that_the_updater_had_no_room_for_are_known_to_the_replay() {
    let (arrivals, options) = log(40.0);
    // It pauses for so long that its queue runs over, though not for so long that it starts anew.
    let pause = arrivals.partition_point(|arrival| arrival.arrival < Stamp::from_seconds(15.0));
    let end = pause + UPDATE_QUEUE + 150;
    let (go_on, worked_off) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let (free, done) = (Arc::clone(&go_on), Arc::clone(&worked_off));
    let mut handed = 0;
    let pace = move |_: &Arrival| {
        handed += 1;
        if handed == end {
            // The predictor takes what it was handed.
            std::thread::sleep(Duration::from_millis(300));
            go_on.store(true, Ordering::SeqCst);
            let begin = Instant::now();
            while worked_off.load(Ordering::SeqCst) < (pause + UPDATE_QUEUE) as u64 {
                assert!(begin.elapsed() < Duration::from_secs(30), "the updater goes on");
                std::thread::sleep(Duration::from_millis(1));
            }
        } else if !(pause..end).contains(&handed) {
            std::thread::sleep(Duration::from_micros(50));
        }
    };
    let slow = move |arrival: &Arrival| {
        done.fetch_add(1, Ordering::SeqCst);
        while arrival.arrival > Stamp::from_seconds(15.0) && !free.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    let (run, estimates) = on_two_threads(&arrivals, options.clone(), Origin::Machine, pace, slow);
    assert!((50..150).contains(&run.unseen.len()), "{} of {} readings", run.unseen.len(), arrivals.len());
    assert_same_bits(&replayed(&run, options.clone()), &estimates);
    // And they matter.
    let mut other = run;
    other.unseen.clear();
    let mut found = vec![];
    let outcome = again(&other, options, |estimate| found.push(*estimate));
    assert!(outcome.is_err() || found != estimates);
}

#[test]
fn log_loses_nothing_however_fast_it_comes() {
    let (arrivals, options) = log(30.0);
    let (run, estimates) = on_two_threads(&arrivals, options.clone(), Origin::Log, |_| {}, |_| {});
    assert_eq!(run.arrivals, arrivals);
    assert!(run.unseen.is_empty());
    assert_same_bits(&replayed(&run, options), &estimates);
}

#[test]
fn predictor_goes_on_while_the_updater_is_stuck() {
    let (arrivals, options) = log(14.0);
    let stuck_since = Stamp::from_seconds(12.0);
    let (handed, seen_when_free) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let (count, at_end) = (Arc::clone(&handed), Arc::clone(&seen_when_free));
    let mut stuck = false;
    let slow = move |arrival: &Arrival| {
        if arrival.arrival > stuck_since && !std::mem::replace(&mut stuck, true) {
            std::thread::sleep(Duration::from_millis(1_000));
            at_end.store(count.load(Ordering::SeqCst), Ordering::SeqCst);
        }
    };
    let mut paced = paced(20.0);
    let pace = move |arrival: &Arrival| {
        paced(arrival);
        handed.fetch_add(1, Ordering::SeqCst);
    };
    let (run, estimates) = on_two_threads(&arrivals, options.clone(), Origin::Machine, pace, slow);
    let total = arrivals.len() as u64;
    assert_eq!(seen_when_free.load(Ordering::SeqCst), total, "the updater was stuck until the end");
    // No solution came meanwhile, and every sample had its estimate.
    let first = estimates[0].stamp;
    let samples = arrivals.iter().filter(|arrival| arrival.reading.sensor() == Sensor::Imu);
    let expected = samples.filter(|arrival| arrival.reading.stamp() >= first).count();
    assert_eq!(estimates.len(), expected);
    let begin = arrivals.partition_point(|arrival| arrival.arrival <= stuck_since) as u64;
    let last = run.takeovers.last().expect("some");
    assert!(last.solution_of <= begin, "{last:?}, stuck at {begin}");
    assert_same_bits(&replayed(&run, options), &estimates);
}

#[test]
fn rehearsals_change_no_bit() {
    let (arrivals, options) = log(20.0);
    let run = |rehearsed: bool| {
        let (mut predictor, mut updater) = split(options.clone());
        let mut estimates = vec![];
        for arrival in &arrivals {
            estimates.extend(predictor.push(arrival));
            if rehearsed {
                predictor.rehearse();
            }
            if let Some(solution) = updater.push(arrival) {
                predictor.adopt(&solution);
            }
            if rehearsed {
                predictor.rehearse();
            }
        }
        estimates
    };
    assert_same_bits(&run(true), &run(false));
}

#[test]
fn takeovers_of_another_run_are_refused() {
    let (arrivals, options) = log(10.0);
    let (run, _) = on_two_threads(&arrivals, options.clone(), Origin::Log, paced(50.0), |_| {});
    let refused = |change: &dyn Fn(&mut LiveRun)| {
        let mut other = run.clone();
        change(&mut other);
        again(&other, options.clone(), |_| {}).expect_err("another run")
    };
    let Takeover { before, solution_of } = run.takeovers[20];
    let wrong = Takeover { before, solution_of: before };
    assert_eq!(refused(&|run| run.takeovers[20] = wrong), NotThatRun::OutOfOrder(wrong));
    let wrong = Takeover { before, solution_of: solution_of - 1 };
    assert_eq!(refused(&|run| run.takeovers[20] = wrong), NotThatRun::NoSolution(wrong));
    let next = run.takeovers[21];
    assert_eq!(refused(&|run| _ = run.takeovers.remove(20)), NotThatRun::NoSolution(next));
    let length = run.arrivals.len() as u64 / 2;
    assert_eq!(refused(&|run| run.arrivals.truncate(length as usize)), NotThatRun::Ends(length));
}

/// Panics at a reading.
struct Panicking;

impl PredictorOutlet for Panicking {
    fn taken(&mut self, taken: Taken<'_>) {
        assert!(taken.number < 1_000, "as this test wants");
    }

    fn taken_over(&mut self, _: Takeover, _: Correction) {}
}

struct Deaf;

impl UpdaterOutlet for Deaf {
    fn worked_off(&mut self, _: &Arrival, _: Option<Duration>, _: &mut Updater) {}

    fn ended(self, _: Updater) {}
}

#[test]
fn panic_of_the_predictor_ends_both_threads_and_is_told() {
    let (arrivals, options) = log(6.0);
    let (threads, inlet) =
        live::start(split(options), Origin::Log, run::PERIOD, Panicking, Deaf).expect("threads");
    let (told, joined) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let taken = arrivals.iter().take_while(|arrival| inlet.hand_over(**arrival)).count();
        drop(inlet);
        let _ = told.send((taken, threads.join()));
    });
    let (_, whole) = joined.recv_timeout(Duration::from_secs(30)).expect("both threads end");
    assert!(!whole, "a panic is told");
}
