//! The predictor's thread allocates nothing and frees nothing once it is in its stride, and the updater's next to
//! nothing: memory of solutions is used again. In a binary of its own,
//! since the allocator is the whole process's.
#![allow(clippy::disallowed_methods, reason = "what runs on threads is tried on threads")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use holdfast::estimator::{Correction, Updater, split};
use holdfast::live::{self, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use holdfast::sensors::Arrival;
use holdfast::simulate::{Scenario, Simulation};
use holdfast::state::Takeover;
use holdfast::time::Stamp;

thread_local! {
    static COUNTED: Cell<Option<&'static AtomicU64>> = const { Cell::new(None) };
}
static PREDICTORS: AtomicU64 = AtomicU64::new(0);
static UPDATERS: AtomicU64 = AtomicU64::new(0);

/// The system's, which counts what the counted threads ask of it.
struct Counting;

fn count() {
    // A thread that ends has no cell any more, and is not counted.
    if let Ok(Some(calls)) = COUNTED.try_with(Cell::get) {
        calls.fetch_add(1, Ordering::Relaxed);
    }
}

// SAFETY: everything is left to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// When it is in its stride, and the end, in data.
const SETTLED_S: f64 = 20.0;
const END_S: f64 = 60.0;
/// Fast enough that updates overlap with samples.
const SPEED: f64 = 15.0;

static ESTIMATES: AtomicU64 = AtomicU64::new(0);
static TAKEOVERS: AtomicU64 = AtomicU64::new(0);

fn settled(arrival: &Arrival) -> bool {
    (SETTLED_S..END_S - 1.0).contains(&arrival.arrival.as_seconds())
}

struct Predictors;

impl PredictorOutlet for Predictors {
    fn taken(&mut self, taken: Taken<'_>) {
        let settled = settled(taken.arrival);
        COUNTED.set(settled.then_some(&PREDICTORS));
        if settled && taken.estimate.is_some() {
            ESTIMATES.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn taken_over(&mut self, _: Takeover, _: Correction) {
        if COUNTED.get().is_some() {
            TAKEOVERS.fetch_add(1, Ordering::Relaxed);
        }
    }
}

struct Updaters;

impl UpdaterOutlet for Updaters {
    fn worked_off(&mut self, arrival: &Arrival, _: Option<Duration>, updater: &mut Updater) {
        // What happened is told in words, which take memory.
        COUNTED.set(None);
        updater.take_events();
        COUNTED.set(settled(arrival).then_some(&UPDATERS));
    }

    fn ended(self, _: Updater) {}
}

#[test]
fn predictor_allocates_nothing_and_updates_use_memory_again() {
    // What counts does count.
    COUNTED.set(Some(&PREDICTORS));
    drop(std::hint::black_box(vec![1_u8]));
    COUNTED.set(None);
    assert_eq!(PREDICTORS.swap(0, Ordering::Relaxed), 2);

    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario = Scenario::load(&root.join("config/scenarios/construction.toml")).expect("valid");
    let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(END_S));
    let options = simulation.machine().estimator_options();
    let arrivals: Vec<Arrival> = simulation.collect();
    let period = Duration::from_secs_f64(0.01 / SPEED);
    let (threads, inlet) =
        live::start(split(options), Origin::Machine, period, Predictors, Updaters).expect("threads");
    let begin = Instant::now();
    for arrival in &arrivals {
        let due = Duration::from_secs_f64(arrival.arrival.as_seconds() / SPEED);
        if let Some(early) = due.checked_sub(begin.elapsed()) {
            std::thread::sleep(early);
        }
        assert!(inlet.offer(*arrival));
    }
    drop(inlet);
    assert!(threads.join());
    let (estimates, takeovers) = (ESTIMATES.load(Ordering::Relaxed), TAKEOVERS.load(Ordering::Relaxed));
    assert!(estimates > 3_000, "{estimates} estimates");
    assert!(takeovers > 1_000, "{takeovers} takeovers");
    assert_eq!(PREDICTORS.load(Ordering::Relaxed), 0, "calls of the allocator on the predictor's thread");
    // On a busy computer more solutions may be under way than ever before, and each of them needs memory once.
    let calls = UPDATERS.load(Ordering::Relaxed);
    assert!(calls < takeovers / 10, "{calls} calls of the allocator on the updater's thread");
}
