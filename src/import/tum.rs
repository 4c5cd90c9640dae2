//! TUM trajectories: lines of `t x y z qx qy qz qw`, comments after `#`.

use std::fs::File;
use std::io::{BufRead, BufReader, Error, ErrorKind};
use std::path::{Path, PathBuf};

use super::ImportError;
use super::table::{Row, Separator};
use crate::lie::{Se3, So3, Vec3};
use crate::time::Stamp;

/// A longer line is none of a trajectory.
const LINE_BYTES_MAX: usize = 1 << 16;

/// A pose and its time. Which frames it is between is the file's promise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// When.
    pub stamp: Stamp,
    /// Where.
    pub pose: Se3,
}

/// Reads a TUM trajectory. Its stamps must increase.
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_tum(path: &Path) -> Result<Vec<StampedPose>, ImportError> {
    TumReader::open(path)?.collect()
}

/// Reads a TUM trajectory pose by pose; its stamps must increase.
pub struct TumReader {
    path: PathBuf,
    reader: BufReader<File>,
    line: usize,
    text: Vec<u8>,
    bytes_read: u64,
    last: Option<Stamp>,
}

impl TumReader {
    /// Opens a file.
    ///
    /// # Errors
    /// [`ImportError::Unreadable`].
    pub fn open(path: &Path) -> Result<Self, ImportError> {
        let unreadable = |source| ImportError::Unreadable { path: path.to_owned(), source };
        Ok(Self {
            path: path.to_owned(),
            reader: BufReader::with_capacity(1 << 16, File::open(path).map_err(unreadable)?),
            line: 0,
            text: Vec::new(),
            bytes_read: 0,
            last: None,
        })
    }

    /// How many bytes of the file are behind.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    fn next_line(&mut self) -> Result<Option<&str>, ImportError> {
        self.text.clear();
        self.line += 1;
        let unreadable = |source| ImportError::Unreadable { path: self.path.clone(), source };
        loop {
            let ready = self.reader.fill_buf().map_err(unreadable)?;
            let (taken, ended) = match ready.iter().position(|byte| *byte == b'\n') {
                Some(end) => (end + 1, true),
                None => (ready.len(), ready.is_empty()),
            };
            self.text.extend_from_slice(&ready[..taken]);
            self.reader.consume(taken);
            self.bytes_read += taken as u64;
            if ended {
                break;
            }
            if self.text.len() > LINE_BYTES_MAX {
                let message = format!("more than {LINE_BYTES_MAX} bytes, expected t x y z qx qy qz qw");
                let path = self.path.clone();
                return Err(ImportError::Invalid { path, line: self.line, column: 1, message });
            }
        }
        if self.text.is_empty() {
            return Ok(None);
        }
        let text = std::str::from_utf8(&self.text);
        let text = text.map_err(|error| unreadable(Error::new(ErrorKind::InvalidData, error)))?;
        Ok(Some(text.trim_end_matches(['\n', '\r'])))
    }

    fn read(&mut self) -> Result<Option<StampedPose>, ImportError> {
        loop {
            let last = self.last;
            let path = self.path.clone();
            let line = self.line + 1;
            let Some(text) = self.next_line()? else { return Ok(None) };
            let text = if line == 1 { text.trim_start_matches('\u{feff}') } else { text };
            if text.trim().is_empty() {
                continue;
            }
            let row = Row::cut(&path, line, text, Separator::Space);
            if row.is_comment() {
                continue;
            }
            row.expect_fields(8)?;
            let pose = StampedPose { stamp: row.stamp(0)?, pose: pose(&row, 1)? };
            if let Some(last) = last
                && pose.stamp <= last
            {
                return Err(row.error(0, format!("time {} does not come after {last}", pose.stamp)));
            }
            self.last = Some(pose.stamp);
            return Ok(Some(pose));
        }
    }
}

impl Iterator for TumReader {
    type Item = Result<StampedPose, ImportError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

fn pose(row: &Row<'_>, first: usize) -> Result<Se3, ImportError> {
    let mut values = [0.0; 7];
    for (index, value) in values.iter_mut().enumerate() {
        *value = row.number(first + index)?;
        if !value.is_finite() {
            return Err(row.error(first + index, format!("{value} cannot be part of a trajectory")));
        }
    }
    let [x, y, z, qx, qy, qz, qw] = values;
    let rotation = So3::from_xyzw(qx, qy, qz, qw)
        .ok_or_else(|| row.error(first + 3, "the quaternion has no length".to_owned()))?;
    Ok(Se3::new(rotation, Vec3::new(x, y, z)))
}
