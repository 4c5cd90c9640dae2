//! Readings of one machine out of recordings of ours.

use std::path::PathBuf;

use crate::record::{self, RecordError, read_arrivals};
use crate::sensors::Arrival;

/// The readings of a machine.
#[derive(Debug)]
pub struct RecordedReadings {
    /// In the order of their arrival; one that cannot be decoded is an error in its place.
    pub arrivals: Vec<Result<Arrival, RecordError>>,
    /// Bytes that could not be read: damaged chunks and torn ends.
    pub lost_bytes: u64,
}

/// Reads the readings of `machine` from a file, or from all files of a session, in the order in which the machine had
/// them, each once; `progress` hears how many bytes were read.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_recordings(
    files: &[PathBuf],
    machine: &str,
    progress: impl FnMut(u64),
) -> Result<RecordedReadings, RecordError> {
    let arrivals = read_arrivals(files.iter().map(PathBuf::as_path), machine, progress)?;
    let lost_bytes = arrivals.lost_bytes();
    Ok(RecordedReadings { arrivals: arrivals.collect(), lost_bytes })
}

/// The machines whose topics are in any of the files, sorted.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn recorded_machines(files: &[PathBuf]) -> Result<Vec<String>, RecordError> {
    let mut machines = Vec::new();
    for file in files {
        machines.extend(record::machines(file)?);
    }
    machines.sort();
    machines.dedup();
    Ok(machines)
}
