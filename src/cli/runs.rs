//! The runs in a log or a session: whose readings, by which machine file, in which order.

use std::collections::BTreeSet;
use std::error::Error;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use super::progress::{Progress, Unit};
use super::{BadArguments, must_exist};
use crate::config::{self, Machine};
use crate::estimator::Options;
use crate::import::{Source, log_folder_bytes, read_log_folder_showing, read_recordings, source_of};
use crate::record::{Places, RecordedBoot, Step};
use crate::sensors::{Arrival, Sensor};
use crate::time::Span;
use crate::wire::BootId;

/// The readings of one machine from one boot on.
pub struct Run {
    /// Of the machine.
    pub id: String,
    /// The machine, and which of its boots if there are several.
    pub name: String,
    /// Which boot, if the recording tells.
    pub boot: Option<BootId>,
    /// Whether it is one of a session, whose machines have a folder each.
    in_session: bool,
    /// How the machine was configured.
    pub options: Options,
    /// In the order in which the estimator took them.
    pub arrivals: Vec<Arrival>,
    /// Those, by their place, of which only its fast half knew.
    pub unseen: BTreeSet<u64>,
}

/// What a log or a session holds.
pub struct Runs {
    /// By machine, oldest first.
    pub runs: Vec<Run>,
    /// What could not be read or used.
    pub lost: Vec<Loss>,
    /// The recordings; none of a log folder.
    pub files: Vec<PathBuf>,
}

/// What of a session could not be read or used.
#[derive(Clone, Debug, PartialEq)]
pub struct Loss {
    /// Whose; `None` if nobody can tell.
    pub id: Option<String>,
    /// In words, with the name of the run.
    pub what: String,
}

impl fmt::Display for Loss {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.what)
    }
}

impl Loss {
    fn of(id: &str, what: String) -> Self {
        Self { id: Some(id.to_owned()), what }
    }

    /// Whether it is a loss of this machine, or may be.
    pub fn concerns(&self, id: &str) -> bool {
        self.id.as_deref().is_none_or(|of| of == id)
    }
}

/// A span on the command line.
pub fn seconds(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| format!("\"{text}\" is not a number"))?;
    if (0.0..=1e9).contains(&seconds) { Ok(seconds) } else { Err("must be from 0 to 1e9".to_owned()) }
}

/// Reads a log folder, a recording or a session.
pub fn read(path: &Path, machine_file: Option<&Path>) -> Result<Runs, Box<dyn Error>> {
    must_exist(path)?;
    let machine: Option<Machine> = machine_file.map(config::load).transpose()?;
    match (source_of(&[path.to_owned()])?, machine) {
        (Source::LogFolder(folder), Some(machine)) => read_log(&folder, &machine),
        (Source::LogFolder(_), None) => {
            let message = format!(
                "{}: a log folder does not say how its machine is built: give --machine",
                path.display()
            );
            Err(BadArguments(message).into())
        }
        (Source::Bag(_), _) => {
            let message = format!("{}: is a ROS 2 bag, for import to read first", path.display());
            Err(BadArguments(message).into())
        }
        (Source::Recordings(files), machine) => read_session(&files, path, machine.as_ref()),
    }
}

fn read_log(path: &Path, machine: &Machine) -> Result<Runs, Box<dyn Error>> {
    let whole = log_folder_bytes(path) as f64;
    let mut bar = Progress::new("reading", Unit::Bytes);
    let arrivals = read_log_folder_showing(path, |bytes| bar.show(bytes as f64, whole))?.arrivals;
    let run = Run::without_journal(machine, false, arrivals);
    Ok(Runs { runs: vec![run], lost: Vec::new(), files: Vec::new() })
}

fn read_session(files: &[PathBuf], path: &Path, machine: Option<&Machine>) -> Result<Runs, Box<dyn Error>> {
    let whole: u64 = files.iter().map(|file| fs::metadata(file).map_or(0, |about| about.len())).sum();
    let mut bar = Progress::new("reading", Unit::Bytes);
    let places =
        Places::of(files.iter().map(PathBuf::as_path), |bytes| bar.show(bytes as f64, whole as f64))?;
    bar.finish();
    let mut ids: Vec<&str> = places.machines().collect();
    if let Some(machine) = machine {
        if !ids.contains(&machine.id.as_str()) {
            let known = ids.join(", ");
            let message = format!("{}: has no readings of {}, but of: {known}", path.display(), machine.id);
            return Err(BadArguments(message).into());
        }
        ids.retain(|id| *id == machine.id);
    }
    let mut found = Runs { runs: Vec::new(), lost: Vec::new(), files: files.to_vec() };
    if places.lost_bytes() > 0 {
        let what = format!("{} bytes of the recording could not be read", places.lost_bytes());
        found.lost.push(Loss { id: None, what });
    }
    for id in ids {
        let boots = places.boots(id)?;
        let several = boots.len() > 1;
        let before = (found.runs.len(), found.lost.len());
        for boot in boots {
            read_boot(boot, id, several, machine, &mut found)?;
        }
        if let (true, Some(machine)) = (found.runs.len() == before.0, machine) {
            // No journal says in which order they were taken: by their arrival.
            let mut bar = Progress::new(&format!("{id}: reading"), Unit::Bytes);
            let readings = read_recordings(files, id, |bytes| bar.show(bytes as f64, whole as f64))?;
            bar.finish();
            let arrivals = readings.arrivals.into_iter().collect::<Result<Vec<_>, _>>()?;
            if !arrivals.is_empty() {
                found.lost.truncate(before.1);
                found.runs.push(Run::without_journal(machine, true, arrivals));
            }
        }
    }
    if found.runs.is_empty() {
        let lost: Vec<String> = found.lost.iter().map(Loss::to_string).collect();
        let why = if lost.is_empty() { String::new() } else { format!(": {}", lost.join("; ")) };
        let advice = if machine.is_none() { "; give the machine file with --machine" } else { "" };
        let message = format!("{}: there are no readings that can be run again{why}{advice}", path.display());
        return Err(message.into());
    }
    Ok(found)
}

/// One boot, with what is missing of it.
fn read_boot(
    mut boot: RecordedBoot<'_>,
    id: &str,
    several: bool,
    machine: Option<&Machine>,
    found: &mut Runs,
) -> Result<(), Box<dyn Error>> {
    let boot_name = boot.boot().map_or_else(|| "not told".to_owned(), |boot| boot.to_string());
    let name = if several { format!("{id} boot {boot_name}") } else { id.to_owned() };
    let (mut arrivals, mut unseen) = (Vec::new(), BTreeSet::new());
    let mut bar = Progress::new(&format!("{name}: taking in"), Unit::Count("samples"));
    let (whole, mut samples) = (boot.samples() as f64, 0_u64);
    while let Some(step) = boot.next_step()? {
        if let Step::Reading { arrival, seen } = step {
            if arrival.reading.sensor() == Sensor::Imu {
                samples += 1;
                if samples.is_multiple_of(1_024) {
                    bar.show(samples as f64, whole);
                }
            }
            if !seen {
                unseen.insert(arrivals.len() as u64);
            }
            arrivals.push(arrival);
        }
    }
    bar.finish();
    if let Some(gap) = boot.gap() {
        found.lost.push(Loss::of(id, format!("{name}: {gap}")));
    }
    if arrivals.is_empty() {
        return Ok(());
    }
    let options = match (machine, boot.head()) {
        (Some(machine), _) => machine.estimator_options(),
        (None, Some(head)) => {
            let path = format!("machine file of {id} in the recording");
            config::parse::<Machine>(&head.machine_file, Path::new(&path))?.estimator_options()
        }
        (None, None) => {
            let advice = "the recording does not hold its machine file: give it with --machine";
            found.lost.push(Loss::of(id, format!("{name}: {advice}")));
            return Ok(());
        }
    };
    found.runs.push(Run {
        id: id.to_owned(),
        name,
        boot: boot.boot(),
        in_session: true,
        options,
        arrivals,
        unseen,
    });
    Ok(())
}

impl Run {
    /// Readings in the order of their arrival.
    fn without_journal(machine: &Machine, in_session: bool, arrivals: Vec<Arrival>) -> Self {
        Self {
            id: machine.id.clone(),
            name: machine.id.clone(),
            boot: None,
            in_session,
            options: machine.estimator_options(),
            arrivals,
            unseen: BTreeSet::new(),
        }
    }

    /// From the first reading to the last, s.
    pub fn span_s(&self) -> f64 {
        match (self.arrivals.first(), self.arrivals.last()) {
            (Some(first), Some(last)) => last.arrival.seconds_since(first.arrival),
            _ => 0.0,
        }
    }

    /// Leaves out what arrived before `from_s` and after `to_s`, s since the first reading.
    pub fn keep(&mut self, from_s: f64, to_s: Option<f64>) {
        let Some(begin) = self.arrivals.first().map(|arrival| arrival.arrival) else { return };
        if from_s <= 0.0 && to_s.is_none() {
            return;
        }
        let from = begin + Span::from_seconds(from_s);
        let to = to_s.map(|to_s| begin + Span::from_seconds(to_s));
        let inside = |arrival: &Arrival| arrival.arrival >= from && to.is_none_or(|to| arrival.arrival <= to);
        let (mut arrivals, mut unseen) = (Vec::new(), BTreeSet::new());
        for (number, arrival) in (0_u64..).zip(std::mem::take(&mut self.arrivals)) {
            if inside(&arrival) {
                if self.unseen.contains(&number) {
                    unseen.insert(arrivals.len() as u64);
                }
                arrivals.push(arrival);
            }
        }
        (self.arrivals, self.unseen) = (arrivals, unseen);
    }

    /// Where its files go under a folder.
    pub fn folder(&self, out: &Path) -> PathBuf {
        if self.in_session { out.join(self.name.replace(' ', "-")) } else { out.to_owned() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loss_of_one_machine_is_not_that_of_another_whose_id_begins_alike() {
        let loss = Loss::of("walker-10", "walker-10: the journal ends".to_owned());
        assert!(loss.concerns("walker-10") && !loss.concerns("walker-1"));
        let loss = Loss::of("walker-1", "walker-1 boot 00000000000000ab: the journal ends".to_owned());
        assert!(loss.concerns("walker-1") && !loss.concerns("walker-10"));
        let of_the_file = Loss { id: None, what: "5 bytes of the recording could not be read".to_owned() };
        assert!(of_the_file.concerns("walker-1") && of_the_file.concerns("walker-10"));
    }
}
