//! What `holdfast estimate` writes beside poses: `estimate.csv` and `corrections.csv`.

use std::path::Path;

use super::ImportError;
use super::table::{Separator, Text};
use crate::time::Stamp;

const SIGMAS: [&str; 6] = ["sd_x", "sd_y", "sd_z", "sd_roll", "sd_pitch", "sd_yaw"];
const CORRECTIONS: &str = "t,correction_m";

/// Standard deviations of one estimate: x, y, z (m), and rotations about the world's x, y, z (rad).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sigmas {
    /// Of the estimate.
    pub stamp: Stamp,
    /// x, y, z, roll, pitch, yaw.
    pub values: [f64; 6],
}

/// Reads stamps and standard deviations of an `estimate.csv`.
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_sigmas(path: &Path) -> Result<Vec<Sigmas>, ImportError> {
    let text = Text::read(path)?;
    let mut rows = text.rows(Separator::Comma);
    let Some(head) = rows.next() else { return Err(text.error(1, "no header line".to_owned())) };
    let mut columns = [0; 6];
    for (column, name) in columns.iter_mut().zip(SIGMAS) {
        let found = head.fields().iter().position(|field| *field == name);
        *column = found.ok_or_else(|| head.error(0, format!("the header line has no column {name}")))?;
    }
    let count = head.fields().len();
    rows.map(|row| {
        row.expect_fields(count)?;
        let mut values = [0.0; 6];
        for (value, column) in values.iter_mut().zip(columns) {
            *value = row.number(column)?;
        }
        Ok(Sigmas { stamp: row.stamp(0)?, values })
    })
    .collect()
}

/// Reads a `corrections.csv`: when an update moved the newest position, and by how much (m).
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_corrections(path: &Path) -> Result<Vec<(Stamp, f64)>, ImportError> {
    let text = Text::read(path)?;
    let mut rows = text.rows(Separator::Comma);
    match rows.next() {
        Some(head) if head.fields().join(",") == CORRECTIONS => {}
        Some(head) => return Err(head.error(0, format!("the header line must be {CORRECTIONS}"))),
        None => return Err(text.error(1, format!("no header line, expected {CORRECTIONS}"))),
    }
    rows.map(|row| {
        row.expect_fields(2)?;
        Ok((row.stamp(0)?, row.number(1)?))
    })
    .collect()
}
