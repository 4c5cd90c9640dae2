//! Readings of one machine out of recordings of ours.

use std::path::{Path, PathBuf};

use crate::record::{self, RecordError, read_arrivals_showing, read_said};
use crate::sensors::Arrival;
use crate::wire::{Topic, decode_reading};

/// The readings of a machine.
#[derive(Debug)]
pub struct RecordedReadings {
    /// In the order of their arrival; one that cannot be decoded is an error in its place.
    pub arrivals: Vec<Result<Arrival, RecordError>>,
    /// Bytes that could not be read: damaged chunks and torn ends.
    pub lost_bytes: u64,
}

/// Reads the readings of `machine` from a file, or from all files of a session, in the order in which the machine had
/// them; `progress` hears how many bytes were read. Of a session, all that the machine said is held meanwhile: some
/// 200 kB for each second.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_recordings(
    files: &[PathBuf],
    machine: &str,
    progress: impl FnMut(u64),
) -> Result<RecordedReadings, RecordError> {
    if let [file] = files {
        let arrivals = read_arrivals_showing(file, machine, progress)?;
        let lost_bytes = arrivals.lost_bytes();
        return Ok(RecordedReadings { arrivals: arrivals.collect(), lost_bytes });
    }
    let path = files.first().and_then(|file| file.parent()).unwrap_or(Path::new("."));
    let said = read_said(files.iter().map(PathBuf::as_path), machine, progress)?;
    let reading = |message: record::Recorded<Vec<u8>>| {
        let Topic::Sensor(sensor) = message.topic else { return None };
        let arrival = message.sent;
        Some(decode_reading(sensor, &message.payload).map(|reading| Arrival { arrival, reading }).map_err(
            |source| {
                let record::Recorded { machine, topic, sequence, .. } = message;
                RecordError::Message { path: path.to_owned(), machine, topic, sequence, source }
            },
        ))
    };
    let arrivals = said.messages.into_iter().filter_map(reading).collect();
    Ok(RecordedReadings { arrivals, lost_bytes: said.lost_bytes })
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
