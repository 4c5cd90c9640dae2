//! What the estimator costs: one IMU sample, one second of preintegration, one update at two lags, a whole log.
//!
//! `cargo bench --no-default-features` runs all; the figures of a machine are in the README.

use std::hint::black_box;
use std::path::Path;

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use holdfast::config;
use holdfast::estimator::{Estimator, Options, split};
use holdfast::preintegration::{Preintegration, Step};
use holdfast::sensors::{Arrival, Reading};
use holdfast::simulate::{Scenario, Simulation};
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
            predictor.adopt(solution);
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

criterion_group!(benches, propagate_one_sample, preintegrate_one_second, update_at_lag, whole_log);
criterion_main!(benches);
