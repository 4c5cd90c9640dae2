//! `holdfast evaluate --paper` and `--monte-carlo`.

use std::error::Error;
use std::fs;
use std::num::NonZeroUsize;
use std::path::Path;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::crowd;
use crate::baselines::Kind;
use crate::estimator::{Correction, Updater, split};
use crate::evaluate::monte_carlo;
use crate::evaluate::paper::{self, Job, Latency, MethodLatency, Sheet};
use crate::evaluate::report::Page;
use crate::evaluate::tasks::Task;
use crate::evaluate::trial::{self, Setup};
use crate::live::{self, Origin, PredictorOutlet, Taken, UpdaterOutlet};
use crate::replay::Times;
use crate::sensors::Arrival;
use crate::simulate::Simulation;
use crate::state::Takeover;
use crate::time::Stamp;

/// Pace of the readings while latency is measured, times real time, and how much of a task.
const LIVE_SPEED: f64 = 20.0;
const LIVE_DATA_S: f64 = 100.0;
/// Until then the estimate starts, which is not measured, s.
const STARTED_S: f64 = 12.0;

/// `--paper`: both tasks by all methods, what the paper shows of them, and latencies of this computer.
///
/// # Errors
/// A file cannot be written, or the system gives no thread.
pub fn paper(limits: paper::Limits, threads: NonZeroUsize, out: Option<&Path>) -> Result<(), Box<dyn Error>> {
    let jobs = Job::all();
    let trials = crowd::run("running both tasks", &jobs, threads, |job| job.run(limits))?;
    eprintln!("measuring latency on this computer");
    let latency = latency(limits)?;
    let study = paper::study(trials, Some(latency.clone()), limits)?;
    let page = study.page();
    #[derive(Serialize)]
    struct File {
        simulated: bool,
        seed: u64,
        tables: Vec<Sheet>,
        latency: Latency,
    }
    let file = File { simulated: true, seed: limits.seed, tables: study.sheets(), latency };
    publish(&page, &file, out)
}

/// `--monte-carlo N`.
///
/// # Errors
/// A file cannot be written.
pub fn monte_carlo(
    limits: &monte_carlo::Limits,
    threads: NonZeroUsize,
    out: Option<&Path>,
) -> Result<(), Box<dyn Error>> {
    let jobs = monte_carlo::jobs(limits);
    let outcomes = crowd::run("simulating", &jobs, threads, |job| job.run(limits))?;
    let results = monte_carlo::results(limits, &jobs, &outcomes);
    publish(&results.page(), &results, out)
}

/// Tables to stdout; page and figures to the folder.
fn publish(page: &Page, figures: &impl Serialize, out: Option<&Path>) -> Result<(), Box<dyn Error>> {
    for table in page.tables() {
        println!("{}", table.text());
    }
    match out {
        Some(out) => write(page, figures, out),
        None => Ok(()),
    }
}

/// `report.html` and `report.json`.
///
/// # Errors
/// A file cannot be written.
pub fn write(page: &Page, figures: &impl Serialize, out: &Path) -> Result<(), Box<dyn Error>> {
    fs::create_dir_all(out).map_err(|error| format!("{}: {error}", out.display()))?;
    let json = serde_json::to_string_pretty(figures)? + "\n";
    for (name, text) in [("report.html", page.html()), ("report.json", json)] {
        let path = out.join(name);
        fs::write(&path, text).map_err(|error| format!("{}: {error}", path.display()))?;
        eprintln!("{}", path.display());
    }
    Ok(())
}

/// With nothing else running: each method on one thread, then ours on two, at the readings' pace.
fn latency(limits: paper::Limits) -> Result<Latency, Box<dyn Error>> {
    let mut scenario = Task::Digging.scenario()?;
    scenario.file.seed = scenario.file.seed.wrapping_add(limits.seed);
    let end_s = limits.end_s.map_or(LIVE_DATA_S, |end_s| end_s.min(LIVE_DATA_S));
    let epoch = Instant::now();
    let clock = || u64::try_from(epoch.elapsed().as_nanos()).unwrap_or(u64::MAX);
    let measure = |kind: Kind| {
        let setup = Setup { end_s: Some(end_s), ..Setup::new(kind, 0) };
        let trial = trial::run(&scenario, setup, clock);
        let (predict_us, update_us) = (trial.predict.distribution(), trial.update.distribution());
        MethodLatency { method: kind.name(), predict_us, update_us }
    };
    let methods = Kind::ALL.into_iter().map(measure).collect();
    let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(end_s));
    let options = simulation.machine().estimator_options();
    let period = Duration::from_secs_f64(1.0 / simulation.machine().imu.update_rate / LIVE_SPEED);
    let arrivals: Vec<Arrival> = simulation.collect();
    let (measured, results) = sync_channel(1);
    let outlet = Measuring { times: Times::default(), measured };
    let (threads, inlet) = live::start(split(options), Origin::Log, period, outlet, Silent)?;
    let begin = Instant::now();
    for arrival in &arrivals {
        let due = Duration::from_secs_f64((arrival.arrival.as_seconds() / LIVE_SPEED).max(0.0));
        if let Some(early) = due.checked_sub(begin.elapsed()) {
            thread::sleep(early);
        }
        if !inlet.hand_over(*arrival) {
            return Err("the estimator's threads have ended early".into());
        }
    }
    drop(inlet);
    if !threads.join() {
        return Err("the estimator's threads have panicked".into());
    }
    let live_us = results.recv().map_err(|_| "the predictor's thread has ended early")?.distribution();
    Ok(Latency { live_us, live_speed: LIVE_SPEED, methods })
}

/// Measures on the predictor's thread.
struct Measuring {
    times: Times,
    measured: SyncSender<Times>,
}

impl PredictorOutlet for Measuring {
    fn taken(&mut self, taken: Taken<'_>) {
        if taken.estimate.is_some() && taken.arrival.arrival.as_seconds() > STARTED_S {
            self.times.note(u64::try_from(taken.took.as_nanos()).unwrap_or(u64::MAX));
        }
    }

    fn taken_over(&mut self, _: Takeover, _: Correction) {}
}

impl Drop for Measuring {
    fn drop(&mut self) {
        // Nobody listens any more if the readings could not be handed over.
        let _ = self.measured.try_send(std::mem::take(&mut self.times));
    }
}

struct Silent;

impl UpdaterOutlet for Silent {
    fn worked_off(&mut self, _: &Arrival, _: Option<Duration>, updater: &mut Updater) {
        updater.take_events();
    }

    fn ended(self, _: Updater) {}
}
