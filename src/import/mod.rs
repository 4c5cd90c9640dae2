//! Readers of what others (and the room `export`) wrote: log folders, ROS 2 bags and TUM trajectories.
//!
//! A file that is not what it should be gives one error with file, line and column. A number that cannot
//! be a measurement (NaN, a stamp that goes back) is data: it is handed on, and the estimator refuses
//! and counts it.

mod bag;
mod bag_folder;
mod checks;
mod intervals;
mod log_folder;
mod recording;
mod ros;
mod run_files;
mod source;
mod table;
mod tum;

#[cfg(test)]
mod tests;

use std::path::PathBuf;

pub use bag::{ArrivalTime, Bag, BagReport, BagTopic};
pub use checks::Checks;
pub use intervals::{Interval, read_intervals};
pub use log_folder::{LogFolder, log_folder_bytes, read_log_folder, read_log_folder_showing};
pub use recording::{RecordedReadings, read_recordings, recorded_machines};
pub use run_files::{Sigmas, read_corrections, read_sigmas};
pub use source::{Source, source_of};
pub use tum::{StampedPose, TumReader, read_tum};

/// Why a file cannot be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// Which file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The text is not what it should be.
    #[error("{}:{line}:{column}: {message}", path.display())]
    Invalid {
        /// Which file.
        path: PathBuf,
        /// From 1.
        line: usize,
        /// Character from 1.
        column: usize,
        /// What is wrong, and what would be right.
        message: String,
    },
    /// A bag, or what is to be one, cannot be used.
    #[error("{}: {message}", path.display())]
    Bag {
        /// Which file or folder.
        path: PathBuf,
        /// What is wrong, and what would be right.
        message: String,
    },
    /// There is nothing to import.
    #[error("{}: is neither a log folder (imu.csv, ...) nor a ROS 2 bag or recording (metadata.yaml, *.mcap)", path.display())]
    Nothing {
        /// Which folder.
        path: PathBuf,
    },
    /// An MCAP file cannot be read.
    #[error(transparent)]
    Record(#[from] crate::record::RecordError),
}
