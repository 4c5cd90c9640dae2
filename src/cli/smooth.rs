//! `holdfast smooth`: a whole session as one batch.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use super::progress::{Progress, Unit};
use super::runs::{self, Run};
use super::{BadArguments, Outcome};
use crate::reference::{self, Gain, Memory, Outputs, PartSummary, Summary};

/// Solve a whole session at once: the best that its sensors can say of where the machine was
///
/// LOG_OR_SESSION is a folder of CSV files (imu.csv, gnss_left.csv, ...), an MCAP recording of holdfast, or the folder
/// of a session. The estimator runs over it first, as live; the graph it builds, with all that it believed and refused,
/// is then solved as one batch with the same robust losses, so that each pose also knows what came after it. Where no
/// truth exists, this is the reference; how far the live estimate was from it is printed. What misleads all sensors
/// alike misleads it, too.
///
/// Writes to DIR, or for a session to DIR/ID of each machine: smoothed.tum (one pose for each IMU sample), nodes.csv
/// (states with standard deviations at the stamps of the measurements), covariance.csv (of rotation and position there,
/// the upper half), smooth.json (what was solved, and live against smoothed). The same session gives the same bytes,
/// times in smooth.json apart.
///
/// Memory: all readings are held, some 60 kB for each second of a machine; the batch needs 19 kB a node, of which
/// there are some 25 a second with two antennas at 10 Hz and lidar at 5 Hz: 1.7 GB an hour. What would take more than
/// --memory-mb is given up as soon as that shows; --from-s and --to-s take a part of a session.
///
/// Exit codes: 0 done, 1 failed, 2 bad arguments or machine file, 3 done, but some data was bad, lost or not solved.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Log folder, MCAP recording of holdfast, or folder of a session
    #[arg(value_name = "LOG_OR_SESSION")]
    pub log: PathBuf,
    /// Machine file; a log folder needs one, a session may hold those of its machines
    #[arg(long, value_name = "TOML")]
    pub machine: Option<PathBuf>,
    /// Folder to write to; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Leave out what arrived earlier, in seconds since the first reading
    #[arg(long, value_name = "S", default_value_t = 0.0, value_parser = runs::seconds)]
    pub from_s: f64,
    /// Leave out what arrived later, in seconds since the first reading
    #[arg(long, value_name = "S", value_parser = runs::seconds)]
    pub to_s: Option<f64>,
    /// Memory that the batch may take
    #[arg(long, value_name = "MB", default_value_t = 4_000)]
    pub memory_mb: usize,
}

/// Runs the command.
///
/// # Errors
/// The session or the machine file cannot be used, nothing can be solved, or a file cannot be written.
pub fn run(arguments: Arguments) -> Result<Outcome, Box<dyn Error>> {
    if arguments.to_s.is_some_and(|to_s| to_s <= arguments.from_s) {
        return Err(BadArguments("--to-s must be after --from-s".to_owned()).into());
    }
    let found = runs::read(&arguments.log, arguments.machine.as_deref())?;
    let mut outcome = if found.lost.is_empty() { Outcome::Done } else { Outcome::DataWasBad };
    found.lost.iter().for_each(|lost| eprintln!("{}: {lost}", arguments.log.display()));
    let mut failed = None;
    let runs = found.runs.len();
    for run in found.runs {
        let out = run.folder(&arguments.out);
        let name = run.name.clone();
        match one(run, &arguments, &out) {
            Ok(Outcome::Done) => {}
            Ok(other) => outcome = other,
            Err(error) if runs == 1 => return Err(error),
            Err(error) => {
                eprintln!("{name}: {error}");
                failed = Some(error);
            }
        }
    }
    failed.map_or(Ok(outcome), Err)
}

fn one(mut run: Run, arguments: &Arguments, out: &Path) -> Result<Outcome, Box<dyn Error>> {
    run.keep(arguments.from_s, arguments.to_s);
    let about = |error: &dyn Error| format!("{}: {}: {error}", arguments.log.display(), run.name);
    let begun = Instant::now();
    let mut bar = Progress::new(&format!("{}: running", run.name), Unit::DataSeconds);
    let span_s = run.span_s();
    let mut taken = 0_usize;
    let begin = run.arrivals.first().map(|arrival| arrival.arrival);
    let memory = Memory { allowed_mb: arguments.memory_mb, goes_on_without: false };
    let forward = reference::forward(&run.arrivals, &run.unseen, run.options.clone(), memory, |step, _| {
        if let (reference::Step::Taken(arrival, _), Some(begin)) = (step, begin) {
            taken += 1;
            if taken.is_multiple_of(4_096) {
                bar.show(arrival.arrival.seconds_since(begin), span_s);
            }
        }
    });
    bar.finish();
    let forward_s = begun.elapsed().as_secs_f64();
    let begun = Instant::now();
    let mut bar = Progress::new(&format!("{}: smoothing", run.name), Unit::Count("%"));
    let smoothed =
        reference::smooth(&forward, |part| bar.show(100.0 * part, 100.0)).map_err(|error| about(&error))?;
    bar.finish();
    let batch_s = begun.elapsed().as_secs_f64();
    let outputs = Outputs::create(out).map_err(|error| format!("{}: {error}", out.display()))?;
    outputs.write(&smoothed).map_err(|error| format!("{}: {error}", out.display()))?;
    let summary = Summary {
        machine: run.id.clone(),
        parts: smoothed.chains.iter().map(PartSummary::of).collect(),
        unsolved: smoothed.unsolved.clone(),
        gain: smoothed.gain(&forward.live),
        forward_s,
        batch_s,
    };
    outputs.finish(&summary).map_err(|error| format!("{}: {error}", out.display()))?;
    print(&summary, &run.name, out);
    let converged = summary.parts.iter().all(|part| part.converged);
    for part in summary.parts.iter().filter(|part| !part.converged) {
        eprintln!(
            "{}: from {:.1} s to {:.1} s the batch still moved after {} steps: its poses are not final",
            run.name, part.start_s, part.end_s, part.iterations
        );
    }
    for part in &summary.unsolved {
        eprintln!(
            "{}: from {:.1} s to {:.1} s there is no solution: it {}",
            run.name, part.start_s, part.end_s, part.why
        );
    }
    Ok(if converged && summary.unsolved.is_empty() { Outcome::Done } else { Outcome::DataWasBad })
}

fn print(summary: &Summary, name: &str, out: &Path) {
    let sum = |count: fn(&PartSummary) -> usize| summary.parts.iter().map(count).sum::<usize>();
    println!(
        "{name}: {} nodes in {} {}, {} IMU motions, {} fixes ({} weighted down), {} relative poses, {} chassis turns; run in {:.2} s, solved in {:.2} s: {}",
        sum(|part| part.nodes),
        summary.parts.len(),
        if summary.parts.len() == 1 { "part" } else { "parts" },
        sum(|part| part.imu),
        sum(|part| part.positions),
        sum(|part| part.positions_weighted_down),
        sum(|part| part.between),
        sum(|part| part.turns),
        summary.forward_s,
        summary.batch_s,
        out.display(),
    );
    print_gain(&summary.gain);
}

fn print_gain(gain: &Gain) {
    println!(
        "  {:<10} {:>8} {:>10} {:>10} {:>10} {:>10} {:>10} {:>12} {:>12}",
        "live off by",
        "samples",
        "hor. rms m",
        "hor. 95 %",
        "hor. max",
        "vert. rms",
        "head. deg",
        "live sigma m",
        "smoothed"
    );
    for part in &gain.parts {
        println!(
            "  {:<10}  {:>8} {:>10.4} {:>10.4} {:>10.4} {:>10.4} {:>10.4} {:>12.4} {:>12.4}",
            part.name,
            part.samples,
            part.horizontal_m.rmse,
            part.horizontal_m.p95,
            part.horizontal_m.max,
            part.vertical_m.rmse,
            part.heading_deg.rmse,
            part.live_sigma_m,
            part.smoothed_sigma_m,
        );
    }
}
