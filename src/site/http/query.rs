//! What addresses ask for after the `?`: times, and how much at once.

use axum::http::StatusCode;

use super::problem::Problem;
use crate::time::Stamp;

/// Entries of a page, if nothing is said, and at most.
const LIMIT_DEFAULT: usize = 100;
const LIMIT_MAX: usize = 1000;

pub(super) fn bad(detail: impl Into<String>) -> Problem {
    Problem::new(StatusCode::BAD_REQUEST, detail)
}

/// A time in RFC 3339, with any offset.
pub(super) fn time(name: &str, text: Option<&str>) -> Result<Option<Stamp>, Problem> {
    let Some(text) = text else { return Ok(None) };
    let wrong = || {
        let text: String = text.chars().take(80).collect();
        bad(format!("{name} is {text:?}, must be a time such as 2026-11-23T05:00:00Z"))
    };
    let timestamp: jiff::Timestamp = text.parse().map_err(|_| wrong())?;
    let nanos = i64::try_from(timestamp.as_nanosecond()).map_err(|_| wrong())?;
    Ok(Some(Stamp::from_nanos(nanos)))
}

pub(super) fn limit(asked: Option<usize>) -> Result<usize, Problem> {
    let limit = asked.unwrap_or(LIMIT_DEFAULT);
    match (1..=LIMIT_MAX).contains(&limit) {
        true => Ok(limit),
        false => Err(bad(format!("limit is {limit}, must be from 1 to {LIMIT_MAX}"))),
    }
}
