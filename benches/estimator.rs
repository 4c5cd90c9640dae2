//! What the estimator costs: one IMU sample, alone and while updates run, one second of preintegration, one update
//! at two lags, a whole log.
//!
//! `cargo bench --no-default-features` runs all; the figures of a machine are in the README.

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Sender, SyncSender, channel, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use holdfast::config;
use holdfast::estimator::{Correction, Estimator, Options, Updater, split};
use holdfast::live::{self, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use holdfast::preintegration::{Preintegration, Step};
use holdfast::replay::{Distribution, Times};
use holdfast::sensors::{Arrival, Reading};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::state::{Estimate, Takeover};
use holdfast::time::{Span, Stamp};

/// One machine of the construction scenario up to `seconds`, and its options.
fn construction(seconds: f64) -> (Vec<Arrival>, Options) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario =
        Scenario::load(&root.join("config/scenarios/construction.toml")).expect("a valid scenario");
    let machine: config::Machine =
        config::load(&root.join("config/machines/simulated-roof.toml")).expect("a valid machine file");
    let end = Stamp::from_seconds(seconds);
    let arrivals = Simulation::new(&scenario, 0).take_while(|arrival| arrival.arrival < end).collect();
    (arrivals, machine.estimator_options())
}

fn propagate_one_sample(criterion: &mut Criterion) {
    let (arrivals, options) = construction(20.0);
    let (mut predictor, mut updater) = split(options);
    let mut newest = None;
    for arrival in &arrivals {
        predictor.push(arrival);
        if let Some(solution) = updater.push(arrival) {
            predictor.adopt(&solution);
        }
        if let Reading::Imu(sample) = arrival.reading {
            newest = Some((arrival.arrival, sample));
        }
    }
    let (mut at, mut sample) = newest.expect("the log has IMU samples");
    criterion.bench_function("propagate one IMU sample", |bencher| {
        bencher.iter(|| {
            at += Span::from_millis(10);
            sample.stamp += Span::from_millis(10);
            let arrival = Arrival { arrival: at, reading: Reading::Imu(sample) };
            black_box(predictor.push(black_box(&arrival)))
        });
    });
}

fn preintegrate_one_second(criterion: &mut Criterion) {
    let (arrivals, options) = construction(3.0);
    let samples: Vec<_> = arrivals
        .iter()
        .filter_map(|arrival| match arrival.reading {
            Reading::Imu(sample) => Some(sample),
            _ => None,
        })
        .take(101)
        .collect();
    let noise = options.smoother.noise;
    criterion.bench_function("preintegrate one second at 100 Hz", |bencher| {
        bencher.iter(|| {
            let steps = samples.windows(2).map(|pair| Step::between(&pair[0], &pair[1]));
            black_box(Preintegration::of_steps(steps, Default::default(), Default::default(), &noise))
        });
    });
}

/// Every measurement of a second (40 fixes, 5 lidar poses) brings the window up to date.
fn update_at_lag(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("update");
    for lag_s in [2.0, 10.0] {
        let (arrivals, mut options) = construction(31.0);
        options.smoother.lag = Span::from_seconds(lag_s);
        let begin = arrivals.partition_point(|arrival| arrival.arrival < Stamp::from_seconds(30.0));
        let updates = arrivals[begin..]
            .iter()
            .filter(|arrival| {
                matches!(
                    arrival.reading,
                    Reading::GnssLeft(_) | Reading::GnssRight(_) | Reading::LidarOdometry(_)
                )
            })
            .count();
        group.throughput(Throughput::Elements(updates as u64));
        group.bench_function(format!("one second of measurements, {lag_s} s lag"), |bencher| {
            bencher.iter_batched(
                || {
                    let (_, mut updater) = split(options.clone());
                    arrivals[..begin].iter().for_each(|arrival| drop(updater.push(arrival)));
                    updater
                },
                |mut updater| {
                    arrivals[begin..].iter().for_each(|arrival| drop(black_box(updater.push(arrival))));
                    updater
                },
                BatchSize::LargeInput,
            );
        });
    }
    group.finish();
}

fn whole_log(criterion: &mut Criterion) {
    const SECONDS: f64 = 60.0;
    let (arrivals, options) = construction(SECONDS);
    let mut group = criterion.benchmark_group("whole log");
    group.sample_size(10);
    // Elements are seconds of data, so that "elem/s" reads as times real time.
    group.throughput(Throughput::Elements(SECONDS as u64));
    group.bench_function("construction, 60 s", |bencher| {
        bencher.iter(|| {
            let mut estimator = Estimator::new(options.clone());
            arrivals.iter().filter_map(|arrival| estimator.push(arrival)).last()
        });
    });
    group.finish();
}

/// One IMU sample to its estimate as on a machine: readings come at their pace and the updater works on a thread
/// of its own. At real time the caches are cold and the core may sleep between two samples; at twenty times
/// that, an update runs nearly always.
///
/// Not criterion's to measure: it would call the function in a row.
fn propagate_while_updates_run(_: &mut Criterion) {
    // Criterion passes these when the benchmarks are only tried, or others are asked for.
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let filters = || arguments.iter().filter(|argument| !argument.starts_with('-'));
    let name = "propagate one IMU sample while updates run";
    if arguments.iter().any(|argument| argument == "--test" || argument == "--list")
        || filters().next().is_some() && !filters().any(|filter| name.contains(filter.as_str()))
    {
        return;
    }
    for (speed, seconds) in [(1.0, 20.0), (20.0, 100.0)] {
        for rehearsed in [false, true] {
            let (prediction, since_handed, takeovers) = live(speed, seconds, rehearsed);
            let how = if rehearsed { "rehearsed" } else { "not rehearsed" };
            println!("{name}, {speed} times real time, {how}: {takeovers} takeovers");
            for (what, times) in [("sample to state", prediction), ("with the wake-up", since_handed)] {
                let Distribution { mean, p50, p99, p999, max, .. } = times.distribution();
                println!(
                    "  {what}: {} samples, mean {mean:.2} µs, 50 % {p50:.2}, 99 % {p99:.2}, 99.9 % {p999:.2}, \
                     max {max:.0}",
                    times.count()
                );
            }
        }
    }
}

/// Until the estimate has started: not paced, not measured.
const START_S: f64 = 15.0;

/// Measures on the predictor's thread, and passes estimates on to another thread, as a machine does.
struct Measuring {
    begin: Instant,
    /// When each reading was handed over, ns since `begin`.
    handed: Arc<Vec<AtomicU64>>,
    passed_on: SyncSender<Estimate>,
    measured: Sender<(Times, Times, u64)>,
    times: (Times, Times, u64),
    settled: bool,
}

impl PredictorOutlet for Measuring {
    fn taken(&mut self, taken: Taken<'_>) {
        let now = self.begin.elapsed().as_nanos() as u64;
        self.settled = taken.arrival.arrival.as_seconds() > START_S + 0.5;
        let Some(estimate) = taken.estimate else { return };
        if self.settled {
            self.times.0.note(taken.took.as_nanos() as u64);
            let handed = self.handed[taken.number as usize].load(Ordering::Relaxed);
            self.times.1.note(now.saturating_sub(handed));
        }
        self.passed_on.try_send(estimate).expect("room");
    }

    fn taken_over(&mut self, _: Takeover, correction: Correction) {
        self.times.2 += u64::from(self.settled);
        black_box(correction);
    }
}

impl Drop for Measuring {
    fn drop(&mut self) {
        let _ = self.measured.send(std::mem::take(&mut self.times));
    }
}

struct Silent;

impl UpdaterOutlet for Silent {
    fn worked_off(&mut self, _: &Arrival, _: Option<Duration>, updater: &mut Updater) {
        updater.take_events();
    }

    fn ended(self, _: Updater) {}
}

/// Over `seconds` of data at `speed`: from the sample in the predictor's hand to its estimate, the same from the
/// hand-over by another thread on, and how many solutions were taken over. Threads and queues are those of a machine.
#[allow(clippy::disallowed_methods, reason = "what is measured here takes real time, on threads")]
fn live(speed: f64, seconds: f64, rehearsed: bool) -> (Times, Times, u64) {
    let (arrivals, options) = construction(START_S + seconds);
    let begin = Instant::now();
    let handed: Arc<Vec<AtomicU64>> = Arc::new(arrivals.iter().map(|_| AtomicU64::new(0)).collect());
    let (passed_on, estimates) = sync_channel(1 << 12);
    let (measured, results) = channel();
    let reader = thread::spawn(move || estimates.iter().for_each(|estimate| _ = black_box(estimate)));
    let measuring = Measuring {
        begin,
        handed: Arc::clone(&handed),
        passed_on,
        measured,
        times: Default::default(),
        settled: false,
    };
    // A sample that is never due is not rehearsed for.
    let period =
        if rehearsed { Duration::from_secs_f64(0.01 / speed) } else { Duration::from_secs(1_000_000) };
    let (threads, inlet) = live::start(split(options), Origin::Log, period, measuring, Silent)
        .expect("the system gives threads");
    let mut paced_from = None;
    for (arrival, handed) in arrivals.iter().zip(handed.iter()) {
        let data_s = arrival.arrival.as_seconds() - START_S;
        if data_s > 0.0 {
            let paced_from = *paced_from.get_or_insert_with(Instant::now);
            let due = Duration::from_secs_f64(data_s / speed);
            if let Some(early) = due.checked_sub(paced_from.elapsed()) {
                thread::sleep(early);
            }
        }
        handed.store(begin.elapsed().as_nanos() as u64, Ordering::Relaxed);
        assert!(inlet.hand_over(*arrival), "the threads live as long as readings come");
    }
    drop(inlet);
    assert!(threads.join(), "no panic");
    reader.join().expect("no panic");
    results.recv().expect("the predictor's thread has ended")
}

criterion_group!(
    benches,
    propagate_one_sample,
    propagate_while_updates_run,
    preintegrate_one_second,
    update_at_lag,
    whole_log
);
criterion_main!(benches);
