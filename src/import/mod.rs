//! Readers of what others (and the room `export`) wrote: log folders and TUM trajectories.
//!
//! A file that is not what it should be gives one error with file, line and column. A number that cannot
//! be a measurement (NaN, a stamp that goes back) is data: it is handed on, and the estimator refuses
//! and counts it.

mod log_folder;
mod table;
mod tum;

use std::path::PathBuf;

pub use log_folder::{LogFolder, read_log_folder};
pub use tum::{StampedPose, read_tum};

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
}
