//! `holdfast evaluate`: how far estimates are from the truth, and how far methods are from each other.

use std::error::Error;
use std::fs;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::progress::{Progress, Unit};
use super::{BadArguments, Outcome, must_exist};
use crate::config::{self, Machine};
use crate::evaluate::comparison::{self, Fixes, Given, Judgement, RunSummary};
use crate::evaluate::{Alignment, DeltaUnit, Errors, EvoOptions, Options, Report, monte_carlo, paper};
use crate::import::{
    ImportError, StampedPose, TumReader, log_folder_bytes, read_corrections, read_intervals,
    read_log_folder_showing, read_sigmas,
};
use crate::sensors::Reading;

mod crowd;
mod session;
mod study;

/// Compare estimated trajectories with the true one, or methods with each other
///
/// Of files (--truth, --estimate): poses are compared at the stamps of the estimate, with the truth interpolated in
/// between. Errors of position are in metres, of heading in degrees. With --out, DIR gets report.html (tables and plots,
/// to be read offline) and report.json (everything). Where an estimate is the folder of `holdfast estimate`, or a world.tum
/// in one, its standard deviations, odom, corrections and times are judged as well. report.json also has APE and RPE by
/// the definitions of evo, of all pose relations.
///
/// Simulated (--paper): both tasks of the paper by our estimator and by TSIF, MSF, lidar odometry alone and dead reckoning;
/// its tables and figures next to the paper's own, and latencies measured on this computer. Or (--monte-carlo N): N seeded
/// runs of each, medians and tails, and accuracy against the length of an outage and the quality of the lidar. The same
/// seeds give the same figures whatever the number of threads, latencies apart.
///
/// Of a real session (SESSION), which has no truth: for how long the position was known and by what, outages, how well fixes
/// fitted, how far updates moved predictions, how late things were, and how far the live position was from the session
/// solved as a whole (`holdfast smooth`), in plain words, with plots. With --out, one page to print (report.html) and the
/// same as report.json. All readings are held in memory, some 60 kB for each second of a machine, and 19 kB for each
/// measurement; beyond --memory-mb the page goes without the whole solution, and says so.
///
/// Exit codes: 0 done, 1 failed, 2 bad arguments or machine file, 3 done, but a part of the session could not be read.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("what").required(true).args(["session", "truth", "paper", "monte_carlo"]))]
pub struct Arguments {
    /// Recording of holdfast, folder of a session, or log folder; without a truth
    #[arg(value_name = "SESSION")]
    pub session: Option<PathBuf>,
    /// True trajectory, lines of `t x y z qx qy qz qw` (TUM)
    #[arg(long, value_name = "TUM", requires = "estimate")]
    pub truth: Option<PathBuf>,
    /// Estimated trajectory in the same format, or a folder of `holdfast estimate`; more than one may be given
    #[arg(long, value_name = "TUM_OR_DIR", num_args = 1.., requires = "truth")]
    pub estimate: Vec<PathBuf>,
    /// Run the paper's tasks in the simulator, by all methods
    #[arg(long)]
    pub paper: bool,
    /// Run so many seeds of everything in the simulator
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub monte_carlo: Option<u64>,
    /// Folder for report.html and report.json; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// File of `start_s,end_s,condition`, such as the simulator's gnss_truth.csv: also tell the errors of
    /// each condition and interval
    #[arg(long, value_name = "CSV", requires = "truth")]
    pub intervals: Option<PathBuf>,
    /// Compare only inside intervals of this condition, such as "good"
    #[arg(long, value_name = "CONDITION", requires = "intervals")]
    pub only: Option<String>,
    /// Log folder the estimates were made of: also hold them against its RTK fixes, those whose
    /// reported sigmas the machine file does not refuse
    #[arg(long, value_name = "DIR", requires = "truth", requires = "machine")]
    pub log: Option<PathBuf>,
    /// Machine file: of --log, which says where the antenna is; or of the machine to judge in SESSION, if that does not
    /// hold its own
    #[arg(long, value_name = "TOML", conflicts_with_all = ["paper", "monte_carlo"])]
    pub machine: Option<PathBuf>,
    /// SESSION: memory that its whole solution may take
    #[arg(long, value_name = "MB", default_value_t = 4_000)]
    pub memory_mb: usize,
    /// What to take out first, fitted over all positions: nothing, translation and yaw, a rigid motion, a rigid
    /// motion with scale, the scale alone, or the motion between the first poses
    #[arg(long, value_enum, default_value_t = Align::None, requires = "truth")]
    pub align: Align,
    /// evo's n_to_align: fit evo's figures over the first N poses only
    #[arg(long, value_name = "N", requires = "truth")]
    pub align_first: Option<usize>,
    /// evo's delta: the length of a step of RPE
    #[arg(long, value_name = "LENGTH", default_value_t = 1.0, value_parser = delta)]
    pub delta: f64,
    /// evo's delta_unit
    #[arg(long, value_enum, default_value_t = StepUnit::Frames)]
    pub delta_unit: StepUnit,
    /// evo's all_pairs: every pair of poses a step apart, not only one after the other
    #[arg(long)]
    pub all_pairs: bool,
    /// evo's pairs_from_reference: steps are those of the truth
    #[arg(long)]
    pub pairs_from_truth: bool,
    /// evo's t_max_diff: poses further apart in time are no pair, s
    #[arg(long, value_name = "S", default_value_t = 0.01)]
    pub max_diff_s: f64,
    /// Simulated: added to the seeds of the tasks, or seed of the first run
    #[arg(long, value_name = "SEED", default_value_t = 0, conflicts_with = "truth")]
    pub seed: u64,
    /// Simulated: threads to run on; as many as there are processors if it is missing
    #[arg(long, value_name = "N", conflicts_with = "truth")]
    pub threads: Option<NonZeroUsize>,
    /// Simulated: end the tasks early, for a try
    #[arg(long, value_name = "S", conflicts_with = "truth", value_parser = end)]
    pub until_s: Option<f64>,
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
    /// Rigid motion and scale.
    Sim3,
    /// Scale.
    Scale,
    /// Between the first poses.
    Origin,
}

/// The choices of `--delta-unit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum StepUnit {
    /// Poses.
    Frames,
    /// Way, m.
    Meters,
    /// Turn, degrees.
    Degrees,
    /// Turn, rad.
    Radians,
}

fn delta(text: &str) -> Result<f64, String> {
    let delta: f64 = text.parse().map_err(|_| format!("\"{text}\" is not a number"))?;
    if delta > 0.0 && delta.is_finite() { Ok(delta) } else { Err("must be above 0".to_owned()) }
}

fn end(text: &str) -> Result<f64, String> {
    let end_s: f64 = text.parse().map_err(|_| format!("\"{text}\" is not a number"))?;
    if (20.0..=1e5).contains(&end_s) { Ok(end_s) } else { Err("must be 20 at least".to_owned()) }
}

/// What `report.json` holds.
#[derive(Serialize)]
struct File<'a> {
    truth: &'a Path,
    estimates: Vec<Estimate<'a>>,
}

#[derive(Serialize)]
struct Estimate<'a> {
    file: &'a Path,
    #[serde(flatten)]
    judgement: &'a Judgement,
}

/// Runs the command.
///
/// # Errors
/// A file cannot be read or written, or nothing can be compared.
pub fn run(arguments: Arguments) -> Result<Outcome, Box<dyn Error>> {
    if let Some(session) = &arguments.session {
        let (machine, out) = (arguments.machine.as_deref(), arguments.out.as_deref());
        return session::run(session, machine, arguments.memory_mb, out);
    }
    let threads = arguments.threads.unwrap_or_else(crowd::processors);
    let out = arguments.out.as_deref();
    let (seed, end_s) = (arguments.seed, arguments.until_s);
    match (&arguments.truth, arguments.monte_carlo) {
        (Some(truth), _) => files(&arguments, truth),
        (None, Some(runs)) => {
            let limits = monte_carlo::Limits { runs, first_seed: seed, end_s };
            study::monte_carlo(&limits, threads, out)
        }
        (None, None) => study::paper(paper::Limits { seed, end_s }, threads, out),
    }?;
    Ok(Outcome::Done)
}

fn files(arguments: &Arguments, truth_path: &Path) -> Result<(), Box<dyn Error>> {
    must_exist(truth_path)?;
    arguments.estimate.iter().chain(&arguments.intervals).try_for_each(|path| must_exist(path))?;
    if arguments.delta_unit == StepUnit::Frames && arguments.delta.fract() != 0.0 {
        return Err(BadArguments(format!("--delta {} must be whole in frames", arguments.delta)).into());
    }
    let truth = read(truth_path)?;
    let intervals = arguments.intervals.as_deref().map(read_intervals).transpose()?.unwrap_or_default();
    let fixes = match (&arguments.log, &arguments.machine) {
        (Some(log), Some(machine)) => Some(read_fixes(log, machine)?),
        _ => None,
    };
    let alignment = alignment(arguments.align);
    let options = Options { alignment, intervals, only: arguments.only.clone(), ..Options::default() };
    let evo_options = evo_options(arguments, alignment);
    let mut given = Vec::new();
    let mut judgements = Vec::new();
    for path in &arguments.estimate {
        let one = read_given(path)?;
        let judgement = comparison::judge(&one, &truth, fixes.as_ref(), &options, &evo_options)
            .map_err(|error| format!("{}: {error}", path.display()))?;
        given.push(one);
        judgements.push(judgement);
    }
    for (path, judgement) in arguments.estimate.iter().zip(&judgements) {
        print(path, &judgement.report);
    }
    let Some(out) = &arguments.out else { return Ok(()) };
    let name = truth_path.file_name().unwrap_or_default().to_string_lossy();
    let page = comparison::page(&truth, &given, &judgements, &options, &format!("Estimates against {name}"));
    let estimates = arguments.estimate.iter().zip(&judgements);
    let estimates = estimates.map(|(file, judgement)| Estimate { file, judgement }).collect();
    study::write(&page, &File { truth: truth_path, estimates }, out)
}

const fn alignment(align: Align) -> Alignment {
    match align {
        Align::None => Alignment::None,
        Align::Yaw => Alignment::Yaw,
        Align::Se3 => Alignment::Se3,
        Align::Sim3 => Alignment::Sim3,
        Align::Scale => Alignment::Scale,
        Align::Origin => Alignment::Origin,
    }
}

fn evo_options(arguments: &Arguments, alignment: Alignment) -> EvoOptions {
    EvoOptions {
        max_diff_s: arguments.max_diff_s,
        alignment,
        align_first: arguments.align_first,
        delta: arguments.delta,
        delta_unit: match arguments.delta_unit {
            StepUnit::Frames => DeltaUnit::Frames,
            StepUnit::Meters => DeltaUnit::Meters,
            StepUnit::Degrees => DeltaUnit::Degrees,
            StepUnit::Radians => DeltaUnit::Radians,
        },
        all_pairs: arguments.all_pairs,
        pairs_from_truth: arguments.pairs_from_truth,
        ..EvoOptions::default()
    }
}

/// An estimate with what lies beside it: of a folder, or of a `world.tum`, all that `holdfast estimate` wrote.
fn read_given(path: &Path) -> Result<Given, Box<dyn Error>> {
    let is_folder = path.is_dir();
    let world = if is_folder { path.join("world.tum") } else { path.to_owned() };
    let name = path.to_string_lossy().into_owned();
    let mut given = Given { name, world: read(&world)?, ..Given::default() };
    if !is_folder && world.file_name().is_none_or(|name| name != "world.tum") {
        return Ok(given);
    }
    let beside = |name: &str| Some(world.with_file_name(name)).filter(|path| path.is_file());
    if let Some(path) = beside("odom.tum") {
        given.odom = read(&path)?;
    }
    if let Some(path) = beside("estimate.csv") {
        given.sigmas = read_sigmas(&path)?;
    }
    if let Some(path) = beside("corrections.csv") {
        given.corrections = read_corrections(&path)?;
    }
    if let Some(path) = beside("summary.json") {
        let text = fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
        let summary: RunSummary =
            serde_json::from_str(&text).map_err(|error| format!("{}: {error}", path.display()))?;
        given.summary = Some(summary);
    }
    Ok(given)
}

fn read_fixes(log: &Path, machine: &Path) -> Result<Fixes, Box<dyn Error>> {
    must_exist(log)?;
    let options = config::load::<Machine>(machine)?.estimator_options();
    let mut fixes = Vec::new();
    let whole = log_folder_bytes(log) as f64;
    let mut bar = Progress::new("reading the fixes", Unit::Bytes);
    let folder = read_log_folder_showing(log, |bytes| bar.show(bytes as f64, whole))?;
    bar.finish();
    for arrival in folder.arrivals {
        let (Reading::GnssLeft(fix), Ok(())) = (arrival.reading, arrival.reading.check()) else { continue };
        // Others are no RTK fixes by the receiver's own word.
        if fix.sigma_enu_m.xy().amax() <= options.gate.sigma_max_m {
            fixes.push((fix.stamp, options.site.to_enu(fix.position), fix.sigma_enu_m));
        }
    }
    fixes.sort_by_key(|(stamp, ..)| *stamp);
    Ok(Fixes { lever_arm: options.antenna_left, fixes })
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
