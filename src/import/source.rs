//! What a file or folder is that is to be imported.

use std::path::Path;

use super::ImportError;
use super::bag_folder::looks_like_a_bag;
use crate::export::log_file;
use crate::record;
use crate::sensors::Sensor;

/// The program that writes recordings names itself so.
const OURS: &str = "holdfast ";

/// Kinds of sources.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// Folder of CSV files.
    LogFolder,
    /// ROS 2 bag: a folder, or a single MCAP file that others wrote.
    Bag,
    /// Recording that we wrote.
    Recording,
}

/// Says what is at `path`, which exists.
///
/// # Errors
/// [`ImportError`] if it is nothing that can be imported; what would be is said.
pub fn source_of(path: &Path) -> Result<Source, ImportError> {
    if path.is_dir() {
        if Sensor::ALL.into_iter().any(|sensor| log_file(path, sensor).exists()) {
            return Ok(Source::LogFolder);
        }
        if looks_like_a_bag(path) {
            return Ok(Source::Bag);
        }
        let message =
            "is neither a log folder (imu.csv, ...) nor a ROS 2 bag (metadata.yaml, *.mcap)".to_owned();
        return Err(ImportError::Bag { path: path.to_owned(), message });
    }
    let ours = record::library(path)?.starts_with(OURS);
    Ok(if ours { Source::Recording } else { Source::Bag })
}
