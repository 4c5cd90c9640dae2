//! `holdfast evaluate`: how far estimates are from the truth.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::evaluate::{self, Alignment, Errors, Options, Report};
use crate::import::{ImportError, StampedPose, TumReader, read_intervals};

use super::must_exist;
use super::progress::{Progress, Unit};

/// Compare estimated trajectories with the true one
///
/// Poses are compared at the stamps of the estimate, with the truth interpolated in between. Errors of
/// position are in metres, of heading in degrees. The table goes to stdout; with --out, everything also
/// goes to DIR/report.json.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// True trajectory, lines of `t x y z qx qy qz qw` (TUM)
    #[arg(long, value_name = "TUM")]
    pub truth: PathBuf,
    /// Estimated trajectory in the same format; more than one may be given
    #[arg(long, value_name = "TUM", required = true, num_args = 1..)]
    pub estimate: Vec<PathBuf>,
    /// Folder for report.json; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// File of `start_s,end_s,condition`, such as the simulator's gnss_truth.csv: also tell the errors of
    /// each condition and interval
    #[arg(long, value_name = "CSV")]
    pub intervals: Option<PathBuf>,
    /// Compare only inside intervals of this condition, such as "good"
    #[arg(long, value_name = "CONDITION", requires = "intervals")]
    pub only: Option<String>,
    /// What to take out first, fitted over all positions: nothing, translation and yaw, or a rigid motion
    #[arg(long, value_enum, default_value_t = Align::None)]
    pub align: Align,
}

/// The choices of `--align`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Align {
    /// Both are in the same frame.
    None,
    /// Translation and turn about the vertical.
    Yaw,
    /// Rigid motion.
    Se3,
}

/// What `report.json` holds.
#[derive(Serialize)]
struct File {
    truth: PathBuf,
    estimates: Vec<Estimate>,
}

#[derive(Serialize)]
struct Estimate {
    file: PathBuf,
    #[serde(flatten)]
    report: Report,
}

/// Runs the command.
///
/// # Errors
/// A file cannot be read or written, or nothing can be compared.
pub fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    must_exist(&arguments.truth)?;
    arguments.estimate.iter().chain(&arguments.intervals).try_for_each(|path| must_exist(path))?;
    let truth = read(&arguments.truth)?;
    let intervals = arguments.intervals.as_deref().map(read_intervals).transpose()?.unwrap_or_default();
    let alignment = match arguments.align {
        Align::None => Alignment::None,
        Align::Yaw => Alignment::Yaw,
        Align::Se3 => Alignment::Se3,
    };
    let options = Options { alignment, intervals, only: arguments.only, ..Options::default() };
    let mut estimates = Vec::new();
    for path in &arguments.estimate {
        let estimate = read(path)?;
        let report = evaluate::compare(&truth, &estimate, &options)
            .map_err(|error| format!("{}: {error}", path.display()))?;
        estimates.push(Estimate { file: path.clone(), report });
    }
    for Estimate { file, report } in &estimates {
        print(file, report);
    }
    if let Some(out) = arguments.out {
        let file = out.join("report.json");
        let failed = |error| format!("{}: {error}", file.display());
        let text = serde_json::to_string_pretty(&File { truth: arguments.truth, estimates })?;
        fs::create_dir_all(&out).and_then(|()| fs::write(&file, text + "\n")).map_err(failed)?;
    }
    Ok(())
}

/// Reads a trajectory behind a bar; what comes after takes a small part of that time.
fn read(path: &Path) -> Result<Vec<StampedPose>, ImportError> {
    let whole = fs::metadata(path).map_or(0, |file| file.len()) as f64;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let mut bar = Progress::new(&format!("reading {name}"), Unit::Bytes);
    let mut reader = TumReader::open(path)?;
    let mut poses = Vec::new();
    while let Some(pose) = reader.next() {
        poses.push(pose?);
        bar.show(reader.bytes_read() as f64, whole);
    }
    Ok(poses)
}

fn print(file: &Path, report: &Report) {
    println!("{}", file.display());
    println!(
        "  {} poses compared from {:.3} s to {:.3} s, {} without truth, {} outside the intervals",
        report.compared, report.start_s, report.end_s, report.without_truth, report.outside_intervals
    );
    println!(
        "  {:<32} {:>8} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}",
        "", "poses", "rmse m", "mean m", "median m", "max m", "hor. m", "vert. m", "head. deg"
    );
    print_errors("all", &report.errors);
    for part in &report.conditions {
        print_errors(&part.condition, &part.errors);
    }
    for part in &report.intervals {
        print_errors(
            &format!("{} {:.1} s to {:.1} s", part.condition, part.start_s, part.end_s),
            &part.errors,
        );
    }
}

fn print_errors(name: &str, errors: &Errors) {
    println!(
        "  {name:<32} {:>8} {:>9.4} {:>9.4} {:>9.4} {:>9.4} {:>9.4} {:>9.4} {:>9.4}",
        errors.poses,
        errors.position_m.rmse,
        errors.position_m.mean,
        errors.position_m.median,
        errors.position_m.max,
        errors.horizontal_m.rmse,
        errors.vertical_m.rmse,
        errors.heading_deg.rmse
    );
}
