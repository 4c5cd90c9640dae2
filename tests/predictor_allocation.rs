//! The predictor's thread allocates nothing and frees nothing once it is in its stride. In a binary of its own,
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
    static COUNTED: Cell<bool> = const { Cell::new(false) };
}
static CALLS: AtomicU64 = AtomicU64::new(0);

/// The system's, which counts what the counted threads ask of it.
struct Counting;

fn count() {
    // A thread that ends has no cell any more, and is not counted.
    if COUNTED.try_with(Cell::get).unwrap_or(false) {
        CALLS.fetch_add(1, Ordering::Relaxed);
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

struct Predictors;

impl PredictorOutlet for Predictors {
    fn taken(&mut self, taken: Taken<'_>) {
        let counted = (SETTLED_S..END_S - 1.0).contains(&taken.arrival.arrival.as_seconds());
        COUNTED.set(counted);
        if counted && taken.estimate.is_some() {
            ESTIMATES.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn taken_over(&mut self, _: Takeover, _: Correction) {
        if COUNTED.get() {
            TAKEOVERS.fetch_add(1, Ordering::Relaxed);
        }
    }
}

struct Updaters;

impl UpdaterOutlet for Updaters {
    fn worked_off(&mut self, _: &Arrival, _: Option<Duration>, updater: &mut Updater) {
        updater.take_events();
    }

    fn ended(self, _: Updater) {}
}

#[test]
fn predictors_thread_allocates_nothing() {
    // What counts does count.
    COUNTED.set(true);
    drop(std::hint::black_box(vec![1_u8]));
    COUNTED.set(false);
    assert_eq!(CALLS.swap(0, Ordering::Relaxed), 2);

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
    assert_eq!(CALLS.load(Ordering::Relaxed), 0, "calls of the allocator");
}
