//! The estimators of a session's machines again, side by side on the cores.

use std::collections::BTreeMap;
use std::error::Error;
use std::io::Write as _;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use super::super::Outcome;
use super::super::progress::{Progress, Unit};
use super::{Session, lost};
use crate::config::{self, Machine};
use crate::record::RecordedBoot;
use crate::replay::{self, Checked, Difference, How};

/// What came of one machine.
struct Result {
    boots: Vec<Checked>,
    /// What cannot be checked at all, and bytes that cannot be read.
    unchecked: Vec<String>,
    took_s: f64,
}

/// A failure that another thread can hand over.
type Failure = Box<dyn Error + Send + Sync>;

/// Runs all machines again; compares what comes out if `compares`.
pub(super) fn run(
    session: &Session,
    machine_files: &BTreeMap<String, Machine>,
    compares: bool,
) -> std::result::Result<Outcome, Box<dyn Error>> {
    let begun = Instant::now();
    let bar = Progress::new(if compares { "checking" } else { "running" }, Unit::Bytes);
    // How much of each machine's work is done.
    let shown = Mutex::new((bar, vec![0.0; session.machines.len()]));
    let show = |index: usize, part: f64| {
        let (bar, parts) = &mut *shown.lock().unwrap_or_else(PoisonError::into_inner);
        parts[index] = part;
        let bytes = session.bytes as f64;
        bar.show(bytes * parts.iter().sum::<f64>(), bytes * parts.len() as f64);
    };
    let next = AtomicUsize::new(0);
    let results = Mutex::new(BTreeMap::new());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..cores.min(session.machines.len()) {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(id) = session.machines.get(index) else { return };
                    let result = machine(session, id, machine_files.get(id), |part| show(index, part));
                    results.lock().unwrap_or_else(PoisonError::into_inner).insert(id.as_str(), result);
                }
            });
        }
    });
    shown.into_inner().unwrap_or_else(PoisonError::into_inner).0.finish();
    let mut out = std::io::stdout().lock();
    let (mut differ, mut outcome, mut data_s) = (0, Outcome::Done, 0.0);
    for (id, result) in results.into_inner().unwrap_or_else(PoisonError::into_inner) {
        let result = result.map_err(|error| -> Box<dyn Error> { error })?;
        data_s += result.boots.iter().fold(0.0, |sum, boot| sum + boot.span_s);
        writeln!(out, "{id}: {}", summary(&result, compares))?;
        for boot in &result.boots {
            let name = boot.boot.map_or_else(|| "not told".to_owned(), |boot| boot.to_string());
            if !compares {
                if let Some(why) = &boot.broke_off {
                    outcome = Outcome::DataWasBad;
                    let estimates = boot.estimates;
                    writeln!(
                        out,
                        "NOT RUN: {id}, boot {name}: what comes after {estimates} estimates: {why}"
                    )?;
                }
                continue;
            }
            if let Some(first) = &boot.first {
                differ += 1;
                writeln!(
                    out,
                    "DIFFERS: {id}, boot {name}: {} messages, first {}",
                    boot.differing,
                    told(first)
                )?;
            }
            for what in &boot.unchecked {
                outcome = Outcome::DataWasBad;
                writeln!(out, "NOT CHECKED: {id}, boot {name}: {what}")?;
            }
        }
        let lacks = if compares { "NOT CHECKED" } else { "NOT RUN" };
        for what in &result.unchecked {
            outcome = Outcome::DataWasBad;
            writeln!(out, "{lacks}: {id}, {what}")?;
        }
    }
    let wall_s = begun.elapsed().as_secs_f64();
    eprintln!("{data_s:.1} s of data in {wall_s:.2} s: {:.0} times real time", data_s / wall_s.max(1e-9));
    match differ {
        0 => Ok(outcome),
        boots => Err(format!("{boots} boots came out otherwise than they were recorded").into()),
    }
}

/// One machine, boot by boot.
fn machine(
    session: &Session,
    id: &str,
    file: Option<&Machine>,
    mut tell: impl FnMut(f64),
) -> std::result::Result<Result, Failure> {
    let begun = Instant::now();
    let mut result = Result { boots: Vec::new(), unchecked: Vec::new(), took_s: 0.0 };
    let mut boots = session.places.boots(id)?;
    if boots.is_empty() {
        result.unchecked.push("there are no readings and no poses of it".to_owned());
    }
    if session.places.lost_bytes() > 0 {
        result.unchecked.push(lost(session.places.lost_bytes()));
    }
    let all = boots.iter().map(RecordedBoot::samples).sum::<u64>().max(1) as f64;
    let mut done = 0.0;
    for boot in &mut boots {
        let options = match (file, boot.head()) {
            (Some(file), _) => file.estimator_options(),
            (None, Some(head)) => {
                let path = format!("machine file of {id} in the recording");
                config::parse::<Machine>(&head.machine_file, Path::new(&path))?.estimator_options()
            }
            (None, None) => {
                let name = boot.boot().map_or_else(|| "not told".to_owned(), |boot| boot.to_string());
                // Without a journal, its machine file would not help.
                while boot.next_step()?.is_some() {}
                let advice = "the recording does not hold its machine file: give it with --machine-file";
                let why = boot.gap().unwrap_or(advice);
                result.unchecked.push(format!("boot {name}: {why}"));
                continue;
            }
        };
        let part = boot.samples() as f64 / all;
        let checked = replay::check(boot, options, |fraction| tell(done + part * fraction))?;
        done += part;
        result.boots.push(checked);
    }
    tell(1.0);
    result.took_s = begun.elapsed().as_secs_f64();
    Ok(result)
}

fn summary(result: &Result, compares: bool) -> String {
    let sum = |count: fn(&Checked) -> u64| result.boots.iter().map(count).sum::<u64>();
    let span_s = result.boots.iter().fold(0.0, |sum, boot| sum + boot.span_s);
    let (poses, odoms, differing) =
        (sum(|boot| boot.poses), sum(|boot| boot.odoms), sum(|boot| boot.differing));
    let what = match (compares, differing) {
        (false, _) => format!("{} estimates", sum(|boot| boot.estimates)),
        (true, 0) if poses + odoms == 0 => "nothing was compared".to_owned(),
        (true, 0) => format!("{poses} poses and {odoms} odoms the same to the bit"),
        (true, _) => format!("{poses} poses and {odoms} odoms compared, {differing} DIFFER"),
    };
    let boots = match result.boots.len() {
        1 => "1 boot".to_owned(),
        boots => format!("{boots} boots"),
    };
    let open = match sum(|boot| boot.after_journal) {
        messages if compares && messages > 0 => {
            format!("; {messages} more, which its last page would tell of")
        }
        _ => String::new(),
    };
    let times = span_s / result.took_s.max(1e-9);
    format!("{what}; {span_s:.1} s, {boots}, {times:.0} times real time{open}")
}

fn told(difference: &Difference) -> String {
    let Difference { topic, sequence, stamp, how } = difference;
    let at = stamp.map_or_else(|| "without a stamp".to_owned(), |stamp| format!("at {stamp} s"));
    let how = match how {
        How::Apart { position_m, rotation, parts } => format!(
            "{:.3e} mm and {:.3e}° apart ({})",
            1e3 * position_m,
            rotation.to_degrees(),
            parts.join(", ")
        ),
        How::Unreadable(why) => format!("it cannot be read: {why}"),
        How::NotAgain => "there is no such sample in the run again".to_owned(),
        How::AnotherRun(why) => format!("before it the run is another: {why}"),
    };
    format!("{topic} {sequence} {at}: {how}")
}
