//! The smoother asks for no memory once it has run for a while: counted by an allocator of its own.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use holdfast::factors::{BetweenFactor, PositionFactor, TurnFactor};
use holdfast::lie::{Se3, So3, Vec3};
use holdfast::preintegration::ImuNoise;
use holdfast::sensors::ImuSample;
use holdfast::smoother::{Options, Smoother};
use holdfast::state::{NavState, StateMatrix, StateVector};
use holdfast::time::{Span, Stamp};

struct Counting;

static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

// SAFETY: the system's allocator does the work.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        unsafe { System.realloc(memory, layout, size) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const LAG_S: f64 = 2.0;
const SAMPLE_MS: i64 = 10;
const LEVER_ARMS: [Vec3; 2] = [Vec3::new(-1.1, 0.8, 2.0), Vec3::new(-1.1, -0.8, 2.0)];

fn at(millis: i64) -> Stamp {
    Stamp::from_nanos(millis * 1_000_000)
}

fn started() -> Smoother {
    let noise = ImuNoise {
        gyroscope_noise_density: 1.6e-4,
        accelerometer_noise_density: 1.1e-3,
        gyroscope_random_walk: 8.0e-6,
        accelerometer_random_walk: 6.0e-5,
        base_gyroscope_random_walk: 8.0e-6,
        missed_part: [0.0; 2],
        gap_s: 0.05,
    };
    let options = Options::new(Span::from_seconds(LAG_S), Vec3::new(0.0, 0.0, -9.81), noise);
    let mut smoother = Smoother::new(options);
    smoother.push_sample(sample(0));
    smoother.push_sample(sample(SAMPLE_MS));
    let sigmas = [0.05, 0.5, 0.5, 0.01, 0.1, 0.01];
    let information = StateVector::from_fn(|row, _| f64::powi(sigmas[row / 3], -2));
    smoother
        .start(at(0), NavState::identity(), &StateMatrix::from_diagonal(&information))
        .expect("covered by samples");
    smoother
}

/// Of a body that stays near the origin, as its sensors say with some error.
fn sample(millis: i64) -> ImuSample {
    let t = millis as f64 * 1e-3;
    ImuSample {
        stamp: at(millis),
        angular_rate: Vec3::new(0.01 * (3.0 * t).sin(), 0.01 * (2.0 * t).cos(), 0.02 * t.sin()),
        specific_force: Vec3::new(0.05 * t.cos(), 0.05 * (2.0 * t).sin(), 9.81),
    }
}

/// What comes in ten milliseconds; returns the number of updates.
fn step(smoother: &mut Smoother, millis: i64) -> usize {
    let mut updates = 0;
    let mut update = |smoother: &mut Smoother| {
        smoother.update().expect("determined");
        updates += 1;
    };
    smoother.push_sample(sample(millis));
    if millis % 40 == 0 {
        // Two antennas of one epoch, at a stamp between two samples.
        let stamp = at(millis) - Span::from_millis(3);
        for lever_arm in LEVER_ARMS {
            smoother.predict(stamp).expect("covered");
            let node = smoother.node_at(stamp).expect("in the window");
            let wave = 0.003 * (millis as f64 * 0.7).sin();
            let factor = PositionFactor {
                measured: lever_arm + Vec3::new(wave, -wave, wave),
                lever_arm,
                sigma: Vec3::new(0.008, 0.008, 0.012),
                huber_threshold: 5.0,
            };
            smoother.add_position(node, factor).expect("the node is there");
            update(smoother);
        }
    }
    if millis % 200 == 0 && millis > 1000 {
        // A lidar increment, 110 ms late.
        let [from, to] = [millis - 310, millis - 110].map(at);
        let nodes = [from, to].map(|stamp| smoother.node_at(stamp).expect("in the window"));
        for node in nodes {
            smoother.state_at(node).expect("in the window");
        }
        let factor = BetweenFactor {
            measured: Se3::identity(),
            imu_from_sensor: Se3::identity(),
            sigma: [1e-3, 6e-3],
        };
        smoother.add_between(nodes[0], nodes[1], factor).expect("the nodes are there");
        update(smoother);
    }
    if millis % 1000 == 0 && millis > 2000 {
        // The chassis stood for a second; now and then for longer.
        let span = if millis % 7000 == 0 { 1600 } else { 1000 };
        let [from, to] = [millis - 100 - span, millis - 100]
            .map(|millis| smoother.node_before(at(millis)).expect("in the window"));
        let tie = BetweenFactor {
            measured: Se3::identity(),
            imu_from_sensor: Se3::identity(),
            sigma: [1e-4, 1e-3],
        };
        let turn = TurnFactor {
            measured: So3::identity(),
            base_gyro_bias: 0.0,
            span_s: to.seconds_since(from),
            imu_from_base: [So3::identity(); 2],
            sigma: 1e-3,
        };
        smoother.add_between(from, to, tie).expect("the nodes are there");
        smoother.add_turn(from, to, turn).expect("the nodes are there");
        update(smoother);
    }
    updates
}

#[test]
fn an_update_asks_for_no_memory_in_the_steady_state() {
    const WARM_UP_MS: i64 = 20_000;
    const END_MS: i64 = 320_000;
    let mut smoother = started();
    let mut updates = 0;
    let mut worst = (0, 0);
    for millis in (2 * SAMPLE_MS..END_MS).step_by(SAMPLE_MS as usize) {
        let before = ALLOCATIONS.load(Ordering::Relaxed);
        updates += step(&mut smoother, millis);
        let asked = ALLOCATIONS.load(Ordering::Relaxed) - before;
        if millis > WARM_UP_MS && asked > worst.0 {
            worst = (asked, millis);
        }
    }
    assert!(ALLOCATIONS.load(Ordering::Relaxed) > 100, "the allocator counts");
    assert!(updates > 15_000, "{updates} updates");
    assert_eq!(worst.0, 0, "allocations at {} ms", worst.1);
    let (stamp, state) = smoother.newest().expect("started");
    assert!(stamp > at(END_MS - 100) && state.position.norm() < 0.1, "{stamp}: {}", state.position);
}
