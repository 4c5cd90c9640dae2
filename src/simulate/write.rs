//! A whole scenario as log folders with truth.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::{Scenario, Simulation};
use crate::export::{LogFolderWriter, about, write_tum_line};
use crate::sensors::Reading;
use crate::time::Stamp;

/// How far writing is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress<'a> {
    /// The machine that is being written.
    pub machine: &'a str,
    /// Of all machines together, 0 to 1.
    pub fraction: f64,
}

/// Writes `OUT/<machine>/` for each machine of the scenario: a log folder, `truth_imu.tum` and
/// `truth_base.tum` (cabin IMU and chassis in the site frame, at the IMU's stamps), and `gnss_truth.csv`
/// (`start_s,end_s,condition`: the whole log cut into intervals by what GNSS was like, `good` or the
/// scenario's word). `progress` is called about once for each second of data.
///
/// # Errors
/// A file cannot be made or written.
pub fn write(scenario: &Scenario, out: &Path, mut progress: impl FnMut(Progress<'_>)) -> io::Result<()> {
    let count = scenario.machines.len() as f64;
    for (index, machine) in scenario.machines.iter().enumerate() {
        let report = |part: f64| {
            progress(Progress { machine: &machine.id, fraction: (index as f64 + part) / count });
        };
        write_machine(scenario, index, &out.join(&machine.id), report)?;
    }
    Ok(())
}

fn write_machine(
    scenario: &Scenario,
    index: usize,
    directory: &Path,
    mut report: impl FnMut(f64),
) -> io::Result<()> {
    let duration_s = scenario.file.duration_s;
    let mut simulation = Simulation::new(scenario, index).ending_at(Stamp::from_seconds(duration_s));
    let mut log = LogFolderWriter::create(directory)?;
    let mut imu_truth = Target::create(directory, "truth_imu.tum")?;
    let mut base_truth = Target::create(directory, "truth_base.tum")?;
    let mut reported_s = 0.0;
    report(0.0);
    while let Some(arrival) = simulation.next() {
        log.write(&arrival)?;
        let Reading::Imu(sample) = arrival.reading else { continue };
        let truth = simulation.truth(sample.stamp);
        imu_truth.write(|writer| write_tum_line(writer, sample.stamp, &truth.imu.pose))?;
        base_truth.write(|writer| write_tum_line(writer, sample.stamp, &truth.base.pose))?;
        let time_s = sample.stamp.as_seconds();
        if time_s >= reported_s + 1.0 {
            reported_s = time_s;
            report(time_s / duration_s);
        }
    }
    log.finish()?;
    imu_truth.write(BufWriter::flush)?;
    base_truth.write(BufWriter::flush)?;
    let mut gnss_truth = Target::create(directory, "gnss_truth.csv")?;
    gnss_truth.write(|writer| {
        writeln!(writer, "start_s,end_s,condition")?;
        for (start_s, end_s, condition) in simulation.gnss_conditions(duration_s) {
            writeln!(writer, "{start_s},{end_s},{condition}")?;
        }
        writer.flush()
    })?;
    report(1.0);
    Ok(())
}

/// A file whose errors say its name.
struct Target {
    path: std::path::PathBuf,
    writer: BufWriter<File>,
}

impl Target {
    fn create(directory: &Path, name: &str) -> io::Result<Self> {
        let path = directory.join(name);
        let file = File::create(&path).map_err(|error| about(&path, error))?;
        Ok(Self { path, writer: BufWriter::new(file) })
    }

    fn write(&mut self, what: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> io::Result<()> {
        what(&mut self.writer).map_err(|error| about(&self.path, error))
    }
}
