//! What files or folders are that are to be imported.

use std::path::{Path, PathBuf};

use super::ImportError;
use super::bag_folder::{METADATA, mcap_files};
use crate::export::log_file;
use crate::record;
use crate::sensors::Sensor;

/// The program that writes recordings names itself so.
const OURS: &str = "holdfast ";

/// What can be imported.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// Folder of CSV files.
    LogFolder(PathBuf),
    /// ROS 2 bag: a folder, or a single MCAP file that others wrote.
    Bag(PathBuf),
    /// Recordings that we wrote, of one session.
    Recordings(Vec<PathBuf>),
}

/// Says what is at `paths`, which exist.
///
/// # Errors
/// [`ImportError`] if it is nothing that can be imported, or not together; what would be is said.
pub fn source_of(paths: &[PathBuf]) -> Result<Source, ImportError> {
    match paths {
        [path] => source_at(path),
        paths => {
            let mut files = Vec::new();
            for path in paths {
                match source_at(path)? {
                    Source::Recordings(more) => files.extend(more),
                    Source::LogFolder(_) | Source::Bag(_) => {
                        let message =
                            "several sources must all be recordings of holdfast, of one session".to_owned();
                        return Err(ImportError::Bag { path: path.clone(), message });
                    }
                }
            }
            Ok(Source::Recordings(files))
        }
    }
}

fn source_at(path: &Path) -> Result<Source, ImportError> {
    if path.is_dir() && Sensor::ALL.into_iter().any(|sensor| log_file(path, sensor).exists()) {
        return Ok(Source::LogFolder(path.to_owned()));
    }
    let files = match path.is_dir() && path.join(METADATA).exists() {
        true => mcap_files(path)?.files,
        false => record::files_of(path)?,
    };
    if files.is_empty() {
        return Err(ImportError::Nothing { path: path.to_owned() });
    }
    let (mut ours, mut others) = (Vec::new(), Vec::new());
    for file in files {
        let is_ours = record::library(&file)?.starts_with(OURS);
        if is_ours { &mut ours } else { &mut others }.push(file);
    }
    match (ours.first(), others.first()) {
        (Some(_), None) => Ok(Source::Recordings(ours)),
        (Some(ours), Some(other)) => {
            let name = |file: &Path| file.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let message = format!(
                "holds a recording of holdfast ({}) and another's ({}): name those that belong together",
                name(ours),
                name(other)
            );
            Err(ImportError::Bag { path: path.to_owned(), message })
        }
        (None, _) => Ok(Source::Bag(path.to_owned())),
    }
}

impl Source {
    /// The files that are read.
    ///
    /// # Errors
    /// [`ImportError`] if a bag cannot be looked into.
    pub fn files(&self) -> Result<Vec<PathBuf>, ImportError> {
        Ok(match self {
            Source::LogFolder(folder) => Sensor::ALL.map(|sensor| log_file(folder, sensor)).to_vec(),
            Source::Bag(path) => mcap_files(path)?.files,
            Source::Recordings(files) => files.clone(),
        })
    }
}
