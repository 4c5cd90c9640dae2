//! Named stretches of time, such as the simulator's `gnss_truth.csv`: `start_s,end_s,condition`.

use std::path::Path;

use super::ImportError;
use super::table::{Separator, Text};
use crate::time::Stamp;

const HEADER: &str = "start_s,end_s,condition";

/// From `start` to before `end` it was so.
#[derive(Clone, Debug, PartialEq)]
pub struct Interval {
    /// The first moment.
    pub start: Stamp,
    /// The first moment after it.
    pub end: Stamp,
    /// How it was, such as `good` or `unreliable`.
    pub condition: String,
}

impl Interval {
    /// Whether `stamp` is inside.
    pub fn holds(&self, stamp: Stamp) -> bool {
        self.start <= stamp && stamp < self.end
    }
}

/// Reads a file of intervals.
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_intervals(path: &Path) -> Result<Vec<Interval>, ImportError> {
    let text = Text::read(path)?;
    let mut rows = text.rows(Separator::Comma);
    match rows.next() {
        Some(head) if head.fields().join(",") == HEADER => {}
        Some(head) => return Err(head.error(0, format!("the header line must be {HEADER}"))),
        None => return Err(text.error(1, format!("no header line, expected {HEADER}"))),
    }
    rows.map(|row| {
        row.expect_fields(3)?;
        let interval =
            Interval { start: row.stamp(0)?, end: row.stamp(1)?, condition: row.fields()[2].to_owned() };
        if interval.end < interval.start {
            return Err(row.error(1, "the interval ends before it starts".to_owned()));
        }
        Ok(interval)
    })
    .collect()
}
