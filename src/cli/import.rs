//! `holdfast import`: readings of others become a recording or a log folder.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use super::progress::{Progress, Unit};
use super::{BadArguments, Outcome, must_exist};
use crate::config::{self, Machine};
use crate::export::{Faults, ReadingsError, ReadingsWriter, Whose, log_file};
use crate::import::{self, ArrivalTime, Bag, Checks, Source};
use crate::record;
use crate::sensors::{Arrival, Sensor};

/// Turn CSV logs and ROS 2 bags into a recording or a log folder
///
/// SOURCE is a ROS 2 bag in MCAP (a folder with metadata.yaml, or a single .mcap file), a folder of CSV files
/// (imu.csv, gnss_left.csv, ...), or a recording of holdfast, of which the readings of one machine are taken: a file,
/// or all files of a session or their folder, whose messages are put in the order in which the machine had them.
/// estimate reads what comes out.
///
/// Nothing is lost silently: messages that cannot be used, numbers that cannot be a measurement, clocks that go
/// back and torn files are counted by topic, with the first case of each. Numbers and stamps are handed on as
/// they are; the estimator refuses them for itself. What is at OUT stays as it is until all is written.
///
/// Exit codes: 0 done, 1 failed, 2 bad arguments or machine file, or nothing to import, 3 done, but some data was bad or lost.
#[derive(Debug, clap::Args)]
#[command(after_long_help = TOPICS_AND_EXAMPLES)]
pub struct Arguments {
    /// Bag, log folder, or recordings of a session
    #[arg(required = true)]
    pub source: Vec<PathBuf>,
    /// Machine file: whose readings they are, and where they are in a bag
    #[arg(long, value_name = "TOML")]
    pub machine: PathBuf,
    /// Recording to write, if it ends in .mcap; else a log folder. What is there is overwritten
    #[arg(long, value_name = "DIR_OR_MCAP")]
    pub out: PathBuf,
    /// When the readings of a bag reached the machine
    #[arg(long, value_enum, default_value_t = Arrived::Received)]
    pub arrival: Arrived,
}

const TOPICS_AND_EXAMPLES: &str = "\
The machine file says where the readings are in a bag, for those that it has:
  [topics]
  imu = \"/cabin/imu/data\"             # sensor_msgs/msg/Imu; must be there
  base_imu = \"/chassis/imu/data\"      # sensor_msgs/msg/Imu
  gnss_left = \"/gnss/left/fix\"        # sensor_msgs/msg/NavSatFix
  gnss_right = \"/gnss/right/fix\"      # the same, both with covariances
  lidar_odometry = \"/lidar/odometry\"  # nav_msgs/msg/Odometry, or
                                        # geometry_msgs/msg/PoseStamped, or
                                        # .../PoseWithCovarianceStamped
  cabin_turn = \"/joint_states\"        # sensor_msgs/msg/JointState,
  cabin_turn_joint = \"cabin_turn\"     # and which of its joints
Without [topics] they are /ID/sensor/imu and so on, as in recordings.

Examples:
  holdfast import rosbag2_2026_03_14/ --machine menzi.toml --out menzi.mcap
  holdfast import menzi.mcap --machine menzi.toml --out menzi-csv
  holdfast estimate menzi.mcap --machine menzi.toml --out out";

/// The choices of `--arrival`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Arrived {
    /// When the bag's recorder received them
    Received,
    /// At their stamps: for a recorder that went by another clock than the sensors
    Stamped,
}

/// Runs the command.
///
/// # Errors
/// The source or the machine file cannot be used, or the result cannot be written.
pub fn run(arguments: Arguments) -> Result<Outcome, Box<dyn Error>> {
    let Arguments { source: paths, out, .. } = &arguments;
    let machine: Machine = config::load(&arguments.machine)?;
    paths.iter().try_for_each(|path| must_exist(path))?;
    let source = import::source_of(paths)?;
    refuse_to_overwrite(&source, paths, out)?;
    let mut checks = Checks::default();
    let mut faults = Faults::default();
    let whose = Whose {
        machine: machine.id.clone(),
        site: machine.link.site.clone(),
        origin: machine.world.site_frame().origin(),
        source: paths[0].file_name().unwrap_or_default().to_string_lossy().into_owned(),
    };
    let sink = Sink { out, whose, writer: None };
    let name = &paths[0];
    match &source {
        Source::Bag(bag) => from_bag(bag, &arguments, &machine, sink, &mut checks, &mut faults)?,
        Source::LogFolder(folder) => {
            let whole = import::log_folder_bytes(folder) as f64;
            let mut progress = Progress::new("reading", Unit::Bytes);
            let log = import::read_log_folder_showing(folder, |bytes| progress.show(bytes as f64, whole))?;
            progress.finish();
            let arrivals = log.arrivals.into_iter().map(Ok::<_, record::RecordError>);
            write_all(arrivals, sink, &mut checks, &mut faults, name)?;
        }
        Source::Recordings(files) => {
            let whole: u64 = files.iter().map(|file| fs::metadata(file).map_or(0, |file| file.len())).sum();
            let mut progress = Progress::new("reading", Unit::Bytes);
            let show = |bytes: u64| progress.show(bytes as f64, whole as f64);
            let readings = import::read_recordings(files, &machine.id, show)?;
            progress.finish();
            faults.note_lost(name, readings.lost_bytes);
            write_all(readings.arrivals.into_iter(), sink, &mut checks, &mut faults, name)?;
            if checks.total() == 0 {
                let known = import::recorded_machines(files)?.join(", ");
                let id = &machine.id;
                let message = format!("{}: has no readings of {id}, but topics of: {known}", name.display());
                return Err(BadArguments(message).into());
            }
        }
    }
    if checks.total() == 0 {
        return Err(BadArguments(format!("{}: has no readings", name.display())).into());
    }
    let is_bag = matches!(source, Source::Bag(_));
    for sensor in Sensor::ALL.into_iter().filter(|sensor| !is_bag && checks.count(*sensor) > 0) {
        println!("{sensor}: {} readings", checks.count(sensor));
    }
    let seconds = checks.span().map_or(0.0, |(first, last)| last.seconds_since(first));
    println!("{}: {} readings of {}, {seconds:.1} s", out.display(), checks.total(), machine.id);
    eprint!("{faults}{}", checks.faults());
    let bad = !faults.is_empty() || !checks.faults().is_empty();
    Ok(if bad { Outcome::DataWasBad } else { Outcome::Done })
}

/// Neither what is named nor any file of it may be where the readings go.
fn refuse_to_overwrite(source: &Source, paths: &[PathBuf], out: &Path) -> Result<(), Box<dyn Error>> {
    let mut read = source.files()?;
    read.extend_from_slice(paths);
    let mut written = vec![out.to_owned()];
    if out.is_dir() {
        written.extend(Sensor::ALL.map(|sensor| log_file(out, sensor)));
    }
    match read.iter().find(|file| written.iter().any(|out| is_same(file, out))) {
        Some(file) => {
            let message =
                format!("{}: is part of what is imported, and would be overwritten", file.display());
            Err(BadArguments(message).into())
        }
        None => Ok(()),
    }
}

fn from_bag(
    path: &Path,
    arguments: &Arguments,
    machine: &Machine,
    mut sink: Sink<'_>,
    checks: &mut Checks,
    faults: &mut Faults,
) -> Result<(), Box<dyn Error>> {
    let bag = Bag::open(path, &machine.topics, &machine.id)?;
    let arrival_time = match arguments.arrival {
        Arrived::Received => ArrivalTime::Received,
        Arrived::Stamped => ArrivalTime::Stamped,
    };
    let whole = bag.bytes() as f64;
    let mut progress = Progress::new("importing", Unit::Bytes);
    let report = bag.read(
        arrival_time,
        |arrival| {
            checks.note(arrival);
            sink.write(arrival)
        },
        |bytes| progress.show(bytes as f64, whole),
    )?;
    progress.finish();
    sink.finish()?;
    for (sensor, topic) in &report.sensors {
        let no_fix = if topic.no_fix > 0 {
            format!(", {} say that there is no fix", topic.no_fix)
        } else {
            String::new()
        };
        println!(
            "{sensor}: {} readings of {} messages on {}{no_fix}",
            topic.readings, topic.messages, topic.topic
        );
    }
    *faults = report.faults;
    Ok(())
}

/// What is already in order goes through; an undecodable reading is told of.
fn write_all<E: Error + 'static>(
    arrivals: impl Iterator<Item = Result<Arrival, E>>,
    mut sink: Sink<'_>,
    checks: &mut Checks,
    faults: &mut Faults,
    source: &Path,
) -> Result<(), ReadingsError> {
    let whole = arrivals.size_hint().0 as f64;
    let mut progress = Progress::new("writing", Unit::Count("readings"));
    for (index, arrival) in arrivals.enumerate() {
        progress.show(index as f64, whole);
        match arrival {
            Ok(arrival) => {
                checks.note(&arrival);
                sink.write(&arrival)?;
            }
            Err(error) => {
                let kind = format!("{}: messages that cannot be used", source.display());
                faults.note(&kind, || error.to_string());
            }
        }
    }
    progress.finish();
    sink.finish()
}

/// Makes its file with the first reading, so that a source without any leaves nothing behind.
struct Sink<'a> {
    out: &'a Path,
    whose: Whose,
    writer: Option<ReadingsWriter>,
}

impl Sink<'_> {
    fn write(&mut self, arrival: &Arrival) -> Result<(), ReadingsError> {
        let writer = match &mut self.writer {
            Some(writer) => writer,
            None => self.writer.insert(ReadingsWriter::create(self.out, &self.whose)?),
        };
        writer.write(arrival)
    }

    fn finish(self) -> Result<(), ReadingsError> {
        self.writer.map_or(Ok(()), ReadingsWriter::finish)
    }
}

/// Both are there, and one.
pub(super) fn is_same(left: &Path, right: &Path) -> bool {
    matches!((fs::canonicalize(left), fs::canonicalize(right)), (Ok(left), Ok(right)) if left == right)
}
