//! `holdfast export`: poses for other people's programs.

use std::error::Error;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use super::import::is_same;
use super::progress::{Progress, Unit};
use super::{BadArguments, Outcome, must_exist};
use crate::config::{self, Machine};
use crate::export::{
    self, Faults, Format, Frame, Lack, Options, Outage, Spool, Target, TrackPose, TrackWriter, Written,
    outages_of_events,
};
use crate::frames::geodesy::SiteFrame;
use crate::import::TumReader;
use crate::record::files_of;
use crate::replay::Outputs;
use crate::state::Event;
use crate::time::Span;

/// Write poses as TUM, CSV, GeoJSON, GPX or KML
///
/// INPUT is a recording of holdfast (.mcap; all files of a session together, or their folder), a folder that
/// estimate wrote, or a TUM file. Every machine of a recording becomes a track of its own; a TUM file takes one,
/// chosen with --machine. Poses are those of the cabin IMU as they were published live, in the order of their
/// stamps.
///
/// GeoJSON, GPX and KML are in WGS84, heights above its ellipsoid. The origin of the site is in a session's
/// recording; for other inputs, and if it is to be another, --machine-file gives it. Lines are cut where poses are
/// more than --gap apart; GeoJSON and KML also tell where GNSS was out.
///
/// This is for poses. Readings are written as CSV by import: holdfast import SESSION.mcap --machine M.toml --out DIR
///
/// Exit codes: 0 done, 1 failed, 2 bad arguments or machine file, 3 done, but some data was bad or lost.
#[derive(Debug, clap::Args)]
#[command(after_long_help = FORMATS_AND_EXAMPLES)]
pub struct Arguments {
    /// Recordings of a session or their folder, an estimate's folder, or a TUM file
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// File to write; "-" is stdout
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// What to write; by default what the file's name ends in
    #[arg(long, value_parser = format)]
    pub format: Option<Format>,
    /// Only this machine
    #[arg(long, value_name = "ID")]
    pub machine: Option<String>,
    /// Machine file with the origin of the site frame
    #[arg(long, value_name = "TOML")]
    pub machine_file: Option<PathBuf>,
    /// Which poses: of the cabin IMU in the site, or smooth ones in the machine's odom frame
    ///
    /// Those in odom are of the chassis; of the cabin IMU where the machine, or the estimate all along, did not know
    /// the chassis. They have no places in WGS84. A TUM file is of one frame, and this says of which.
    #[arg(long, value_enum, default_value_t = FrameChoice::World)]
    pub frame: FrameChoice,
    /// At most so many poses a second; by default all
    #[arg(long, value_name = "HZ", value_parser = positive)]
    pub rate: Option<f64>,
    /// Poses so many seconds apart are not joined by a line
    #[arg(long, value_name = "S", default_value_t = 1.0, value_parser = positive)]
    pub gap: f64,
}

const FORMATS_AND_EXAMPLES: &str = "\
Formats:
  tum      t x y z qx qy qz qw, for evo
  csv      machine,t,x,y,z,qx,qy,qz,qw,gnss; of poses in the site frame also
           the place in WGS84, where the origin is known
  geojson  RFC 7946: a LineString for each stretch, with machine, start, end,
           gnss, coordTimes
  gpx      GPX 1.1: a track for each machine
  kml      KML 2.2 with gx:Track: a folder for each machine, red where GNSS
           was out

Examples:
  holdfast export holdfast-data/sessions/2026-03-14/ --out site.geojson
  holdfast export s-0000.mcap s-0001.mcap --machine menzi-1 --out menzi.tum
  holdfast export out/ --machine-file menzi.toml --rate 1 --out menzi.gpx
  holdfast export out/base_odom.tum --format csv --out - | gzip > base.csv.gz";

/// The choices of `--frame`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum FrameChoice {
    /// Cabin IMU in the site
    World,
    /// In the machine's odom frame
    Odom,
}

type Writer = TrackWriter<Box<dyn Write>>;

/// Runs the command.
///
/// # Errors
/// An input or the machine file cannot be used, or the file cannot be written.
pub fn run(arguments: Arguments) -> Result<Outcome, Box<dyn Error>> {
    let format = chosen_format(&arguments)?;
    arguments.input.iter().try_for_each(|input| must_exist(input))?;
    if format.needs_origin() && arguments.frame == FrameChoice::Odom {
        return Err(bad(format!("{} is in WGS84, and the odom frame is not tied to it", format.name())));
    }
    let machine: Option<Machine> = arguments.machine_file.as_deref().map(config::load).transpose()?;
    let site = machine.as_ref().map(|machine| machine.world.site_frame());
    // The odom frame is not tied to the earth: its poses have no places, whatever else is known.
    let site = site.filter(|_| arguments.frame == FrameChoice::World);
    let recordings = recordings(&arguments.input)?;
    let of_estimate = arguments.input.iter().filter(|input| input.is_dir());
    let of_estimate = of_estimate.flat_map(|folder| Outputs::FILES.map(|file| folder.join(file)));
    let mut needed = arguments.input.iter().cloned().chain(recordings.clone()).chain(of_estimate);
    if let Some(input) = needed.find(|input| is_same(input, &arguments.out)) {
        return Err(bad(format!(
            "{}: is part of what is exported, and would be overwritten",
            input.display()
        )));
    }
    if let Some(file) = arguments.machine_file.iter().find(|file| is_same(file, &arguments.out)) {
        return Err(bad(format!("{}: is the machine file, and would be overwritten", file.display())));
    }
    let exported = if recordings.is_empty() {
        let name = arguments.machine.clone().or(machine.map(|machine| machine.id));
        from_tum(&arguments, format, site, name)
    } else {
        from_recordings(&arguments, format, site, &recordings)
    };
    let (written, faults) = match exported {
        // Who reads our stdout has seen enough, such as head.
        Err(error) if arguments.out.as_os_str() == "-" && is_broken_pipe(error.as_ref()) => {
            return Ok(Outcome::Done);
        }
        exported => exported?,
    };
    let thinned =
        if written.thinned > 0 { format!(", {} left out by --rate", written.thinned) } else { String::new() };
    let gaps = if written.gaps > 0 { format!(", {} gaps", written.gaps) } else { String::new() };
    eprintln!(
        "{}: {} poses of {} as {}{thinned}{gaps}",
        arguments.out.display(),
        written.poses,
        if written.tracks == 1 { "1 track".to_owned() } else { format!("{} tracks", written.tracks) },
        format.name(),
    );
    eprint!("{faults}");
    Ok(if faults.is_empty() { Outcome::Done } else { Outcome::DataWasBad })
}

fn is_broken_pipe(error: &(dyn Error + 'static)) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}

fn bad(message: String) -> Box<dyn Error> {
    BadArguments(message).into()
}

fn format(text: &str) -> Result<Format, String> {
    Format::from_name(text)
        .ok_or_else(|| format!("must be one of {}", Format::ALL.map(Format::name).join(", ")))
}

fn positive(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("\"{text}\" is not a number"))?;
    let range = Options::RANGE;
    match range.contains(&value) {
        true => Ok(value),
        false => Err(format!("must be from {} to {}", range.start(), range.end())),
    }
}

fn chosen_format(arguments: &Arguments) -> Result<Format, Box<dyn Error>> {
    let end = || arguments.out.extension().and_then(|end| end.to_str());
    let by_name = || match end()? {
        "json" => Some(Format::GeoJson),
        end => Format::from_name(end),
    };
    arguments.format.or_else(by_name).ok_or_else(|| {
        let formats = Format::ALL.map(Format::name).join(", ");
        bad(format!("{}: say with --format what to write: {formats}", arguments.out.display()))
    })
}

/// The MCAP files of the input: those that are named, and those of a folder that is none of an estimate.
fn recordings(inputs: &[PathBuf]) -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let mut files = Vec::new();
    for input in inputs {
        if input.is_dir() && !input.join("world.tum").exists() {
            let found = files_of(input)?;
            if found.is_empty() {
                let message = "is no folder of estimate (world.tum), and has no recordings (.mcap)";
                return Err(bad(format!("{}: {message}", input.display())));
            }
            files.extend(found);
        } else if is_mcap(input) {
            files.push(input.clone());
        }
    }
    if inputs.len() > 1 && inputs.iter().any(|input| !is_mcap(input)) {
        return Err(bad("several inputs must all be recordings (.mcap) of one session".to_owned()));
    }
    Ok(files)
}

fn is_mcap(path: &Path) -> bool {
    path.extension().is_some_and(|end| end == "mcap")
}

fn open(out: &Path) -> std::io::Result<(Option<Target>, Box<dyn Write>)> {
    const BUFFER_BYTES: usize = 1 << 16;
    if out.as_os_str() == "-" {
        return Ok((None, Box::new(BufWriter::with_capacity(BUFFER_BYTES, std::io::stdout()))));
    }
    let target = Target::of(out)?;
    let file = target.open()?;
    Ok((Some(target), Box::new(BufWriter::with_capacity(BUFFER_BYTES, file))))
}

fn begin(
    arguments: &Arguments,
    format: Format,
    site: Option<SiteFrame>,
) -> Result<(Option<Target>, Writer), Box<dyn Error>> {
    if format.needs_origin() && site.is_none() {
        let message = format!(
            "{} is in WGS84, and the input does not tell the origin of its frame: give --machine-file",
            format.name()
        );
        return Err(bad(message));
    }
    let options = Options {
        format,
        site,
        gap: Span::from_seconds(arguments.gap),
        period: arguments.rate.map(|rate| Span::from_seconds(1.0 / rate)),
    };
    let (target, out) = open(&arguments.out)?;
    Ok((target, TrackWriter::new(out, options)?))
}

fn from_recordings(
    arguments: &Arguments,
    format: Format,
    site: Option<SiteFrame>,
    files: &[PathBuf],
) -> Result<(Written, Faults), Box<dyn Error>> {
    let whole: u64 = files.iter().filter_map(|file| fs::metadata(file).ok()).map(|file| file.len()).sum();
    let end = format!("{}.scratch", std::process::id());
    // Beside what is written, if that is on a disk.
    let scratch = match &arguments.out {
        out if out.as_os_str() == "-" || (out.exists() && !out.is_file()) => {
            export::beside(&std::env::temp_dir().join("holdfast-export"), &end)
        }
        out => export::beside(out, &end),
    };
    let frame = match arguments.frame {
        FrameChoice::World => Frame::World,
        FrameChoice::Odom => Frame::Odom,
    };
    if let Some(folder) = scratch.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    }
    let mut progress = Progress::new("reading", Unit::Bytes);
    let only = arguments.machine.as_deref();
    let show = |bytes: u64| progress.show(bytes as f64, whole as f64);
    let mut gathered = export::gather(files, only, frame, Spool::new(scratch), show)?;
    progress.finish();
    let site = site.or(gathered.origin.map(SiteFrame::new));
    let first = files[0].display();
    let known = gathered.machines.join(", ");
    match gathered.lack(only, format, site.is_some()) {
        // What is wrong with the origin is said in `begin`, as for other inputs.
        None | Some(Lack::Origin) => {}
        Some(Lack::Machine) => {
            return Err(bad(format!("{first}: has no machine {}, but: {known}", only.unwrap_or_default())));
        }
        Some(Lack::Poses) => {
            eprint!("{}", gathered.faults);
            let hint = "run estimate on it, and export its folder";
            return Err(format!("{first}: has no poses, but topics of: {known}; {hint}").into());
        }
        Some(Lack::OneTrack(machines)) => {
            let (format, ids) = (format.name(), machines.join(", "));
            return Err(bad(format!("a {format} file takes one machine, choose with --machine: {ids}")));
        }
    }
    let (target, mut writer) = begin(arguments, format, site)?;
    let count: u64 = gathered.spool.machines().iter().map(|(_, count)| count).sum();
    let mut progress = Progress::new("writing", Unit::Count("poses"));
    let twice = gathered.write_tracks(&mut writer, |done| progress.show(done as f64, count as f64))?;
    progress.finish();
    for (machine, poses) in twice {
        eprintln!("{machine}: {poses} poses are in the recording twice, and were written once");
    }
    let (_, written) = writer.finish()?;
    target.map_or(Ok(()), Target::keep)?;
    Ok((written, gathered.faults))
}

fn from_tum(
    arguments: &Arguments,
    format: Format,
    site: Option<SiteFrame>,
    name: Option<String>,
) -> Result<(Written, Faults), Box<dyn Error>> {
    let input = &arguments.input[0];
    let mut faults = Faults::default();
    let (path, outages) = if input.is_dir() {
        let has_poses = |name: &str| fs::metadata(input.join(name)).is_ok_and(|file| file.len() > 0);
        let name = match arguments.frame {
            FrameChoice::World => "world.tum",
            // Of the chassis, as a machine publishes it, if it was ever known.
            FrameChoice::Odom if has_poses("base_odom.tum") => "base_odom.tum",
            FrameChoice::Odom => "odom.tum",
        };
        (input.join(name), outages_in(&input.join("events.jsonl"), &mut faults)?)
    } else {
        (input.clone(), None)
    };
    let stem = |path: &Path| path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
    let name = name.or_else(|| stem(input)).unwrap_or_default();
    let mut poses = TumReader::open(&path)?;
    let whole = fs::metadata(&path).map_or(0, |file| file.len());
    let (target, mut writer) = begin(arguments, format, site)?;
    writer.begin_track(&name, outages)?;
    let mut progress = Progress::new("exporting", Unit::Bytes);
    while let Some(pose) = poses.next() {
        let pose = pose?;
        progress.show(poses.bytes_read() as f64, whole as f64);
        let pose = TrackPose {
            stamp: pose.stamp,
            position: pose.pose.translation,
            quaternion_xyzw: pose.pose.rotation.to_xyzw(),
        };
        if pose.is_fit() {
            writer.pose(&pose)?;
        } else {
            let kind = format!("{}: poses that are nowhere on the earth", path.display());
            faults.note(&kind, || format!("at {}", pose.stamp));
        }
    }
    progress.finish();
    let (_, written) = writer.finish()?;
    if written.poses == 0 {
        return Err(format!("{}: has no poses", path.display()).into());
    }
    target.map_or(Ok(()), Target::keep)?;
    Ok((written, faults))
}

/// The outages that an estimate's events tell of; `None` without the file.
fn outages_in(path: &Path, faults: &mut Faults) -> Result<Option<Vec<Outage>>, Box<dyn Error>> {
    if !path.exists() {
        return Ok(None);
    }
    let failed = |error: std::io::Error| format!("{}: {error}", path.display());
    let mut events: Vec<Event> = Vec::new();
    for (index, line) in BufReader::new(File::open(path).map_err(failed)?).lines().enumerate() {
        match serde_json::from_str(&line.map_err(failed)?) {
            Ok(event) => events.push(event),
            Err(error) => {
                let kind = format!("{}: lines that are no event", path.display());
                faults.note(&kind, || format!("line {}: {error}", index + 1));
            }
        }
    }
    Ok(Some(outages_of_events(&events)))
}
