//! `holdfast evaluate SESSION`: a real session without truth, as a page for those who run the site.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::super::Outcome;
use super::super::progress::{Progress, Unit};
use super::super::runs::{self, Loss, Run, Runs};
use super::study;
use crate::estimator::Estimator;
use crate::reference::{self, Memory, Step};
use crate::review::{self, Collector, Latency, Published, Review};
use crate::sensors::Sensor;

/// Of a machine's work, running takes about this part.
const RUNNING: f64 = 0.4;

/// What `report.json` holds.
#[derive(Serialize)]
struct File<'a> {
    session: &'a Path,
    runs: &'a [Review],
}

/// Reviews every run in a session.
pub(super) fn run(
    session: &Path,
    machine: Option<&Path>,
    memory_mb: usize,
    out: Option<&Path>,
) -> Result<Outcome, Box<dyn Error>> {
    let Runs { runs, lost, files } = runs::read(session, machine)?;
    let outcome = if lost.is_empty() { Outcome::Done } else { Outcome::DataWasBad };
    lost.iter().for_each(|lost| eprintln!("{}: {lost}", session.display()));
    let reviews = runs.iter().map(|run| {
        let lost = lost.iter().filter(|lost| lost.concerns(&run.id)).map(Loss::to_string).collect();
        one(run, &files, lost, memory_mb)
    });
    let reviews = reviews.collect::<Result<Vec<_>, _>>()?;
    for review in &reviews {
        println!("{}", review.machine);
        review.in_short.iter().for_each(|sentence| println!("  {sentence}"));
        review.look_at.iter().for_each(|sentence| println!("  LOOK AT: {sentence}"));
    }
    if let Some(out) = out {
        let name = session.file_name().unwrap_or(session.as_os_str()).to_string_lossy();
        let page = review::page(&format!("Session {name}"), &reviews);
        study::write(&page, &File { session, runs: &reviews }, out)?;
    }
    Ok(outcome)
}

fn one(run: &Run, files: &[PathBuf], lost: Vec<String>, memory_mb: usize) -> Result<Review, Box<dyn Error>> {
    let mut bar = Progress::new(&format!("{}: judging", run.name), Unit::Count("%"));
    let (begin, span_s) = (run.arrivals.first().map(|arrival| arrival.arrival), run.span_s().max(1e-9));
    let mut collector = Collector::default();
    let mut taken = 0_usize;
    let memory = Memory { allowed_mb: memory_mb, goes_on_without: true };
    let note = |step: Step<'_>, estimator: &Estimator| {
        if let (Step::Taken(arrival, _), Some(begin)) = (&step, begin)
            && arrival.reading.sensor() == Sensor::Imu
        {
            taken += 1;
            if taken.is_multiple_of(1_024) {
                bar.show(100.0 * RUNNING * arrival.arrival.seconds_since(begin) / span_s, 100.0);
            }
        }
        collector.note(step, estimator);
    };
    let forward = reference::forward(&run.arrivals, &run.unseen, run.options.clone(), memory, note);
    let smoothed =
        reference::smooth(&forward, |part| bar.show(100.0 * (RUNNING + (1.0 - RUNNING) * part), 100.0));
    bar.finish();
    let latency = if files.is_empty() {
        Latency::default()
    } else {
        let whole: u64 = files.iter().map(|file| fs::metadata(file).map_or(0, |about| about.len())).sum();
        let mut bar = Progress::new(&format!("{}: timing", run.name), Unit::Bytes);
        let paths = files.iter().map(PathBuf::as_path);
        let tell = |bytes| bar.show(bytes as f64, whole as f64);
        Published::read(paths, &run.id, run.boot, tell)?.latency()
    };
    let judged = match &smoothed {
        Ok(smoothed) => Ok((smoothed.gain(&forward.live), smoothed)),
        Err(error) => Err(error.to_string()),
    };
    Ok(collector.finish(&run.name, judged, latency, lost))
}
