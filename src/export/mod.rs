//! Files for others: log folders, and trajectories as TUM, CSV, GeoJSON, GPX and KML.
//!
//! Stamps are written with nine decimals and numbers in their shortest exact form, so that the room
//! `import` reads back what was written, bit for bit. Formats for maps are in WGS84 degrees, heights above its
//! ellipsoid. What is written, and when, is the caller's business, and what was there stays until the new is whole.
//!
//! Memory is bounded for poses, whatever their number: a segment of a track, and what the spool holds. It is not for
//! events and outages, of which all are held, nor in a list of topics; nor does that speak for readings, which the
//! caller brings.

mod faults;
mod geojson;
mod gpx;
mod kml;
mod log_folder;
mod plain;
mod readings;
mod recording;
mod spool;
mod target;
mod track;

#[cfg(test)]
mod tests;

use std::io::{self, Write};
use std::path::Path;

pub use faults::Faults;
pub use log_folder::{LogFolderWriter, header, log_file, write_row};
pub use readings::{ReadingsError, ReadingsWriter, Whose};
pub use recording::{Frame, GatherError, Gathered, Lack, gather, outages_of_events};
pub use spool::{Repeats, Spool};
pub use target::{Target, beside};
pub use track::{Format, Options, Outage, TrackPose, TrackWriter, Written};

use crate::lie::Se3;
use crate::time::Stamp;

/// One line of a TUM trajectory: `t x y z qx qy qz qw`.
///
/// # Errors
/// What the writer says.
pub fn write_tum_line(writer: &mut impl Write, stamp: Stamp, pose: &Se3) -> io::Result<()> {
    plain::write_tum(writer, stamp, &pose.translation, pose.rotation.to_xyzw())
}

/// The system's error with the file that it is about.
pub(crate) fn about(path: &Path, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}
