//! `holdfast simulate`: a scenario as log folders with truth.

use std::error::Error;
use std::path::PathBuf;

use crate::simulate::{self, Scenario};

use super::progress::{Progress, Unit};

/// Simulate excavators: write their sensor readings and the truth
///
/// Writes one log folder for each machine of the scenario, DIR/MACHINE/, with the readings of all its
/// sensors (imu.csv, gnss_left.csv, ...), the true poses of cabin IMU and chassis at every IMU sample
/// (truth_imu.tum, truth_base.tum), and what GNSS was like (gnss_truth.csv). The same scenario gives the
/// same bytes.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Scenario file, such as config/scenarios/construction.toml
    #[arg(long, value_name = "TOML")]
    pub scenario: PathBuf,
    /// Folder to write to, made if it is not there; or, if it ends in .mcap, one recording with the readings
    /// of all machines, which estimate and machine --play read, without the truth
    #[arg(long, value_name = "DIR_OR_MCAP")]
    pub out: PathBuf,
}

/// Runs the command.
///
/// # Errors
/// The scenario cannot be used, or a file cannot be written.
pub fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    let scenario = Scenario::load(&arguments.scenario)?;
    let whole_s = scenario.file.duration_s * scenario.machine_ids().len() as f64;
    let mut bar = Progress::new("simulating", Unit::DataSeconds);
    if arguments.out.extension().is_some_and(|extension| extension == "mcap") {
        let written = simulate::write_recording(&scenario, &arguments.out, |part| {
            bar.show(part.fraction * whole_s, whole_s)
        });
        bar.finish();
        let summary = written?;
        println!(
            "{}: {} readings of {}",
            arguments.out.display(),
            summary.messages,
            summary.machines.join(", ")
        );
        return Ok(());
    }
    let written =
        simulate::write(&scenario, &arguments.out, |part| bar.show(part.fraction * whole_s, whole_s));
    bar.finish();
    written?;
    for id in scenario.machine_ids() {
        println!("{}", arguments.out.join(id).display());
    }
    Ok(())
}
