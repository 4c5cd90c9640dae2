//! `holdfast estimate`: a log through the estimator.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use super::progress::{Progress, Unit};
use super::{BadArguments, Outcome, must_exist};
use crate::baselines::Kind;
use crate::config::{self, Machine};
use crate::export::Faults;
use crate::import::{
    Source, log_folder_bytes, read_log_folder_showing, read_recordings, recorded_machines, source_of,
};
use crate::replay::{Outputs, Summary};
use crate::sensors::Arrival;

/// Run the estimator over a log and write poses, events and a summary
///
/// LOG is a folder of CSV files (imu.csv, gnss_left.csv, ...; all but imu.csv optional) or an MCAP recording
/// of holdfast, all files of a session or their folder. Writes to DIR: world.tum, odom.tum and base_odom.tum (one
/// pose for each IMU sample, as it would have been published live), estimate.csv (with biases and standard
/// deviations), corrections.csv (how far each update moved the newest position), events.jsonl, summary.json.
/// The same log and machine file give the same bytes, times in summary.json apart. With --realtime there is also
/// takeovers.csv: before which reading (of all sensors, counted from 0) the solution of which reading was taken
/// over; with it the run can be had again to the bit.
///
/// Exit codes: 0 done, 1 failed, 2 bad arguments or machine file, 3 done, but some data was bad or lost.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Log folder, MCAP recordings of a session, or their folder
    #[arg(required = true)]
    pub log: Vec<PathBuf>,
    /// Machine file, such as config/machines/rtk-drive.toml
    #[arg(long, value_name = "TOML")]
    pub machine: PathBuf,
    /// Folder to write to; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Play the log at the speed it was recorded, with prediction and update on two threads as on a machine
    #[arg(long)]
    pub realtime: bool,
    /// How fast to play the log, 1 is real time
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, requires = "realtime", value_parser = super::speed)]
    pub speed: f64,
    /// Estimator to run; all but "dual" are for comparison (see src/baselines/README.md), publish one pose only and
    /// know nothing of the chassis
    #[arg(long, value_enum, default_value_t = Method::Dual)]
    pub method: Method,
}

/// Estimators that can be run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// Graph-based estimator of this project
    Dual,
    /// Two-state implicit filter: IMU and GNSS (Bloesch et al. 2017)
    Tsif,
    /// Error-state Kalman filter with a state buffer: IMU, GNSS and lidar (Lynen et al. 2013)
    Msf,
    /// Lidar odometry alone, aligned at the start; one pose for each lidar pose
    Lidar,
    /// The IMU alone from the start on
    DeadReckoning,
}

impl Method {
    fn kind(self) -> Kind {
        match self {
            Method::Dual => Kind::Dual,
            Method::Tsif => Kind::Tsif,
            Method::Msf => Kind::Msf,
            Method::Lidar => Kind::Lidar,
            Method::DeadReckoning => Kind::DeadReckoning,
        }
    }
}

/// Runs the command.
///
/// # Errors
/// The log or the machine file cannot be used, or a file cannot be written.
pub fn run(arguments: Arguments) -> Result<Outcome, Box<dyn Error>> {
    if arguments.realtime && arguments.method != Method::Dual {
        let message = "--realtime needs two halves on two threads, which only --method dual has";
        return Err(BadArguments(message.to_owned()).into());
    }
    let machine: Machine = config::load(&arguments.machine)?;
    arguments.log.iter().try_for_each(|log| must_exist(log))?;
    let (arrivals, lost_bytes) = read(&arguments.log, &machine)?;
    let begin = arrivals.first().map(|arrival| arrival.arrival);
    let end = arrivals.last().map(|arrival| arrival.arrival);
    let (Some(begin), Some(end)) = (begin, end) else {
        let message = format!("{}: has no readings of {}", arguments.log[0].display(), machine.id);
        return Err(BadArguments(message).into());
    };
    let log_s = end.seconds_since(begin).max(1e-9);
    let mut outputs = Outputs::create(&arguments.out)?;
    let mut bar = Progress::new("estimating", Unit::DataSeconds);
    let mut show = |data_s: f64| bar.show(data_s, log_s);
    let summary = if arguments.realtime {
        super::realtime::run(&arrivals, &machine, arguments.speed, &mut outputs, show)?
    } else {
        let epoch = Instant::now();
        let clock = move || u64::try_from(epoch.elapsed().as_nanos()).unwrap_or(u64::MAX);
        let arrivals = arrivals.into_iter().map(Ok::<Arrival, std::io::Error>);
        let options = machine.estimator_options();
        crate::replay::run(
            arrivals,
            arguments.method.kind().estimator(options),
            &mut outputs,
            clock,
            |progress| show(progress.data_s),
        )?
    };
    bar.finish();
    outputs.finish(&summary)?;
    report(&summary, &arguments.out);
    if summary.estimates == 0 {
        let waits_for = summary.health.waits_for.as_deref().unwrap_or("readings");
        return Err(format!("the estimate never started: it waits for {waits_for}").into());
    }
    let mut faults = Faults::default();
    faults.note_lost(&arguments.log[0], lost_bytes);
    eprint!("{faults}");
    Ok(if lost_bytes > 0 || summary.unfit_readings > 0 { Outcome::DataWasBad } else { Outcome::Done })
}

/// All readings of the machine in order of arrival, and how many bytes of the log were lost.
fn read(logs: &[PathBuf], machine: &Machine) -> Result<(Vec<Arrival>, u64), Box<dyn Error>> {
    let log = logs[0].display();
    let mut bar = Progress::new("reading", Unit::Bytes);
    match source_of(logs)? {
        Source::LogFolder(folder) => {
            let whole = log_folder_bytes(&folder) as f64;
            Ok((read_log_folder_showing(&folder, |bytes| bar.show(bytes as f64, whole))?.arrivals, 0))
        }
        Source::Bag(_) => {
            Err(BadArguments(format!("{log}: is a ROS 2 bag, for import to read first")).into())
        }
        Source::Recordings(files) => {
            let bytes = |file: &PathBuf| std::fs::metadata(file).map_or(0, |file| file.len());
            let whole = files.iter().map(bytes).sum::<u64>() as f64;
            let readings = read_recordings(&files, &machine.id, |bytes| bar.show(bytes as f64, whole))?;
            bar.finish();
            let arrivals: Vec<Arrival> = readings.arrivals.into_iter().collect::<Result<_, _>>()?;
            if arrivals.is_empty() {
                let known = recorded_machines(&files)?.join(", ");
                let message = format!("{log}: has no readings of {}, but topics of: {known}", machine.id);
                return Err(BadArguments(message).into());
            }
            Ok((arrivals, readings.lost_bytes))
        }
    }
}

fn report(summary: &Summary, out: &Path) {
    println!(
        "{}: {} estimates from {} IMU samples, {} updates; {:.0} s of data in {:.2} s ({:.0} times real time)",
        out.display(),
        summary.estimates,
        summary.imu_samples,
        summary.updates,
        summary.data_s,
        summary.wall_s,
        summary.data_s / summary.wall_s.max(1e-9),
    );
    println!(
        "predict {:.2} µs (99.9 %: {:.1}), update {:.0} µs (99 %: {:.0}), update moves prediction {:.2} ± {:.2} cm",
        summary.predict_us.mean,
        summary.predict_us.p999,
        summary.update_us.mean,
        summary.update_us.p99,
        summary.consistency_cm.mean,
        summary.consistency_cm.sd,
    );
    for outage in &summary.outages {
        let end = outage.end_s.map_or("the end".to_owned(), |end| format!("{end:.2} s"));
        let jump =
            outage.jump_m.map_or(String::new(), |jump| format!(", corrected by {:.1} cm", 100.0 * jump));
        println!(
            "GNSS outage ({}) from {:.2} s to {end}: {:.1} m travelled{jump}",
            outage.cause.name(),
            outage.start_s,
            outage.travelled_m
        );
    }
    if summary.unfit_readings > 0 {
        println!("{} readings were refused as bad data, see events.jsonl", summary.unfit_readings);
    }
}
