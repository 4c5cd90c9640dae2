//! `holdfast replay`: the machines of a session once more.

use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;
use std::fs;
#[cfg(feature = "shells")]
use std::path::Path;
use std::path::PathBuf;

use super::progress::{Progress, Unit};
use super::{BadArguments, Outcome, must_exist};
use crate::config::{self, Machine};
use crate::record::{self, Places};

mod check;
#[cfg(feature = "shells")]
mod play;

/// Run the machines of a recorded session again: to a site, or to check every bit of their poses
///
/// SESSION is an MCAP recording of holdfast, several, or the folder of a session; a machine's on-board record is
/// one, too. What was fetched later, and so is late in the file, is put in its place.
///
/// With --check, the estimators of all machines run again on the recorded readings, as fast as the cores allow,
/// and take over every solution where the journal says that they did; what they give is compared with the recorded
/// poses and odometry, byte for byte. Prints one line for each machine, and of the first sample that differs which
/// it is and how far apart. How the machines were configured is in the session, or in files given with
/// --machine-file. With --speed max they run the same way, and nothing is compared; a run that breaks off before its
/// recording ends is told all the same.
///
/// Else each machine becomes a Zenoh peer that says to the site all that was recorded of it, when it said it or so
/// much faster, with the stamps that it had and new boot ids. The session is held in memory for that, some 200 kB for
/// each second of a machine; the other ways read it as they go. Give it a site of its own, with ids like those that
/// really work elsewhere it would be mistaken for them.
///
/// Exit codes: 0 done, 1 something differs or failed, or the site went away, 2 bad arguments or machine file, 3 done,
/// but some of it could not be run, checked, read or sent, 130 interrupted.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Recordings, or the folder of a session
    #[arg(required = true, value_name = "SESSION")]
    pub sessions: Vec<PathBuf>,
    /// How fast: a factor of real time, or max: in this process alone, and no faster than it can
    #[arg(long, value_name = "X|max", value_parser = speed)]
    pub speed: Option<Speed>,
    /// Zenoh endpoint of the site to which the machines speak; by default tcp/127.0.0.1:7447
    #[arg(long, value_name = "ENDPOINT", value_parser = endpoint, conflicts_with = "check")]
    pub site: Option<String>,
    /// Id of that site; what the machines were configured for, if it is not told
    #[arg(long, value_name = "ID", conflicts_with = "check")]
    pub site_id: Option<String>,
    /// Only this machine; may be given several times
    #[arg(long, value_name = "ID")]
    pub machine: Vec<String>,
    /// Compare what the estimators give with what was recorded
    #[arg(long)]
    pub check: bool,
    /// Machine file to use instead of what the session holds, for the machine of its id; may be given several times
    #[arg(long, value_name = "TOML")]
    pub machine_file: Vec<PathBuf>,
}

/// How fast a session passes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// So many seconds in a second.
    Times(f64),
    /// As fast as it can be computed.
    Max,
}

/// Where a site listens that was told nothing else.
const SITE: &str = "tcp/127.0.0.1:7447";

fn speed(text: &str) -> Result<Speed, String> {
    if text == "max" { Ok(Speed::Max) } else { super::speed(text).map(Speed::Times) }
}

fn endpoint(text: &str) -> Result<String, String> {
    config::endpoint(text).map(|()| text.to_owned())
}

/// A session and whose part of it is wanted.
struct Session {
    #[cfg_attr(not(feature = "shells"), expect(dead_code, reason = "a session is played by the shells"))]
    files: Vec<PathBuf>,
    bytes: u64,
    machines: Vec<String>,
    places: Places,
}

#[cfg(feature = "shells")]
impl Session {
    fn paths(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(PathBuf::as_path)
    }
}

/// Bytes of a recording are lost.
fn lost(bytes: u64) -> String {
    format!("{bytes} bytes of the recording cannot be read")
}

/// Runs the command.
///
/// # Errors
/// A file cannot be used, nobody listens, or something came out otherwise than it was recorded.
pub fn run(arguments: Arguments) -> Result<Outcome, Box<dyn Error>> {
    let in_process = arguments.check || arguments.speed == Some(Speed::Max);
    if let (true, Some(Speed::Times(_))) = (arguments.check, arguments.speed) {
        let message = "--check runs as fast as it can: --speed goes with it as max only";
        return Err(BadArguments(message.to_owned()).into());
    }
    if in_process && (arguments.site.is_some() || arguments.site_id.is_some()) {
        let message = "--speed max runs in this process, and speaks to no site";
        return Err(BadArguments(message.to_owned()).into());
    }
    let mut machine_files: BTreeMap<String, Machine> = BTreeMap::new();
    for path in &arguments.machine_file {
        let machine: Machine = config::load(path)?;
        machine_files.insert(machine.id.clone(), machine);
    }
    let session = open(&arguments)?;
    if in_process {
        return check::run(&session, &machine_files, arguments.check);
    }
    let speed = match arguments.speed {
        Some(Speed::Times(speed)) => speed,
        _ => 1.0,
    };
    play(&session, &arguments, machine_files, speed)
}

#[cfg(feature = "shells")]
fn play(
    session: &Session,
    arguments: &Arguments,
    machine_files: BTreeMap<String, Machine>,
    speed: f64,
) -> Result<Outcome, Box<dyn Error>> {
    let endpoint = arguments.site.clone().unwrap_or_else(|| SITE.to_owned());
    let site = play::Site { endpoint, id: arguments.site_id.clone(), machine_files };
    play::run(session, &site, speed)
}

#[cfg(not(feature = "shells"))]
fn play(
    _: &Session,
    arguments: &Arguments,
    _: BTreeMap<String, Machine>,
    speed: f64,
) -> Result<Outcome, Box<dyn Error>> {
    let message = format!(
        "this holdfast was built without Zenoh, and cannot replay to {} at speed {speed}: use --check or --speed max",
        arguments.site.as_deref().unwrap_or(SITE)
    );
    Err(BadArguments(message).into())
}

fn open(arguments: &Arguments) -> Result<Session, Box<dyn Error>> {
    let mut files = Vec::new();
    for path in &arguments.sessions {
        must_exist(path)?;
        let found = record::files_of(path)?;
        if found.is_empty() {
            let message = format!("{}: there are no recordings (*.mcap) in it", path.display());
            return Err(BadArguments(message).into());
        }
        files.extend(found);
    }
    let bytes: u64 = files.iter().map(|path| fs::metadata(path).map_or(0, |about| about.len())).sum();
    let mut bar = Progress::new("reading", Unit::Bytes);
    let show = |read: u64| bar.show(read as f64, bytes as f64);
    let places = Places::of(files.iter().map(PathBuf::as_path), show)?;
    bar.finish();
    let found: BTreeSet<String> = places.machines().map(str::to_owned).collect();
    let mut wanted: BTreeSet<String> = arguments.machine.iter().cloned().collect();
    if let Some(unknown) = wanted.iter().find(|id| !found.contains(*id)) {
        let known: Vec<_> = found.iter().map(String::as_str).collect();
        let message = format!("the session has no machine {unknown}, but: {}", known.join(", "));
        return Err(BadArguments(message).into());
    }
    if wanted.is_empty() {
        wanted = found;
    }
    if wanted.is_empty() {
        return Err(BadArguments("the session has no machines".to_owned()).into());
    }
    Ok(Session { files, bytes, machines: wanted.into_iter().collect(), places })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_is_a_number_or_max() {
        assert_eq!(speed("max"), Ok(Speed::Max));
        assert_eq!(speed("2"), Ok(Speed::Times(2.0)));
        assert!(speed("0").is_err() && speed("fast").is_err());
    }
}
