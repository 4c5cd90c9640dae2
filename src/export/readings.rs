//! Readings of one machine into a recording or a log folder.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use super::{LogFolderWriter, Target, about};
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

/// Writes readings; see [`ReadingsWriter::create`]. What was there stays until [`ReadingsWriter::finish`].
pub struct ReadingsWriter(Into);

enum Into {
    Folder(Box<LogFolderWriter>),
    Recording {
        target: Target,
        writer: Box<RecordWriter>,
        machine: String,
        sequences: [u64; Sensor::ALL.len()],
    },
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
            return Ok(Self(Into::Folder(Box::new(LogFolderWriter::create(out)?))));
        }
        let target = Target::of(out)?;
        if target.is_special() {
            let error = io::Error::other("is no regular file: a recording needs one");
            return Err(about(out, error).into());
        }
        let mut writer = RecordWriter::create(target.place())?;
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
        let (writer, sequences) = (Box::new(writer), Default::default());
        Ok(Self(Into::Recording { target, writer, machine, sequences }))
    }

    /// Adds a reading.
    ///
    /// # Errors
    /// [`ReadingsError`] if it cannot be written.
    pub fn write(&mut self, arrival: &Arrival) -> Result<(), ReadingsError> {
        match &mut self.0 {
            Into::Folder(writer) => writer.write(arrival)?,
            Into::Recording { writer, machine, sequences, .. } => {
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
            Into::Folder(writer) => writer.finish()?,
            Into::Recording { target, writer, .. } => {
                writer.finish()?;
                target.keep()?;
            }
        }
        Ok(())
    }
}
