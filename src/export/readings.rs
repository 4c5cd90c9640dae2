//! Readings of one machine into a recording or a log folder.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use super::{LogFolderWriter, about};
use crate::frames::geodesy::Geodetic;
use crate::record::{RecordError, RecordWriter, Recorded, SITE};
use crate::sensors::{Arrival, Sensor};
use crate::wire::{Topic, encode_reading};

/// Whose readings they are.
#[derive(Clone, Debug, PartialEq)]
pub struct Whose {
    /// Id of the machine.
    pub machine: String,
    /// Id of its site.
    pub site: String,
    /// Origin of the site frame.
    pub origin: Geodetic,
    /// Where the readings are from, for the record.
    pub source: String,
}

/// Writes readings; see [`ReadingsWriter::create`].
pub struct ReadingsWriter(Target);

enum Target {
    Folder(LogFolderWriter),
    Recording { writer: Box<RecordWriter>, machine: String, sequences: [u64; Sensor::ALL.len()] },
}

/// Why readings cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ReadingsError {
    /// To a log folder.
    #[error(transparent)]
    Folder(#[from] io::Error),
    /// To a recording, or from one.
    #[error(transparent)]
    Record(#[from] RecordError),
}

impl ReadingsWriter {
    /// Begins a recording if `out` ends in `.mcap`, else a log folder; the folders above are made.
    ///
    /// # Errors
    /// [`ReadingsError`] if that fails.
    pub fn create(out: &Path, whose: &Whose) -> Result<Self, ReadingsError> {
        if out.extension().is_none_or(|extension| extension != "mcap") {
            return Ok(Self(Target::Folder(LogFolderWriter::create(out)?)));
        }
        if let Some(folder) = out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(|error| about(folder, error))?;
        }
        let mut writer = RecordWriter::create(out)?;
        let entries = |pairs: &[(&str, String)]| -> BTreeMap<String, String> {
            pairs.iter().map(|(key, value)| ((*key).to_owned(), value.clone())).collect()
        };
        let software = ("software", env!("CARGO_PKG_VERSION").to_owned());
        writer.write_metadata(
            SITE,
            entries(&[
                ("id", whose.site.clone()),
                ("name", whose.site.clone()),
                ("latitude_deg", whose.origin.latitude_deg.to_string()),
                ("longitude_deg", whose.origin.longitude_deg.to_string()),
                ("altitude_m", whose.origin.altitude_m.to_string()),
                software.clone(),
            ]),
        )?;
        let import = [("machine", whose.machine.clone()), ("source", whose.source.clone()), software];
        writer.write_metadata("holdfast.import", entries(&import))?;
        let machine = whose.machine.clone();
        Ok(Self(Target::Recording { writer: Box::new(writer), machine, sequences: Default::default() }))
    }

    /// Adds a reading.
    ///
    /// # Errors
    /// [`ReadingsError`] if it cannot be written.
    pub fn write(&mut self, arrival: &Arrival) -> Result<(), ReadingsError> {
        match &mut self.0 {
            Target::Folder(writer) => writer.write(arrival)?,
            Target::Recording { writer, machine, sequences } => {
                let sensor = arrival.reading.sensor();
                let sequence = &mut sequences[sensor as usize];
                writer.write(&Recorded {
                    machine: machine.clone(),
                    topic: Topic::Sensor(sensor),
                    boot: None,
                    sequence: *sequence,
                    received: arrival.arrival,
                    sent: arrival.arrival,
                    payload: encode_reading(&arrival.reading),
                })?;
                *sequence += 1;
            }
        }
        Ok(())
    }

    /// Closes what was begun.
    ///
    /// # Errors
    /// [`ReadingsError`] if it cannot be written.
    pub fn finish(self) -> Result<(), ReadingsError> {
        match self.0 {
            Target::Folder(writer) => writer.finish()?,
            Target::Recording { writer, .. } => {
                writer.finish()?;
            }
        }
        Ok(())
    }
}
