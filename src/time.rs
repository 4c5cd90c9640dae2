//! Stamps and spans in integer nanoseconds, so that the same inputs give the same bits.
//!
//! A [`Stamp`] counts from an epoch that the source of the reading chose: Unix time on a machine,
//! the start of the log in a simulation. Nothing in here reads a clock.

use std::fmt;
use std::ops::{Add, AddAssign, Sub};

use serde::{Deserialize, Serialize};

const NANOS_PER_SECOND: i64 = 1_000_000_000;

/// A point in time, nanoseconds since the epoch of its source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Stamp(i64);

/// A length of time, nanoseconds; may be negative.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Span(i64);

impl Stamp {
    /// A stamp `nanos` nanoseconds after the epoch.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// The stamp nearest to `seconds` after the epoch. Saturates at the ends of the range.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * NANOS_PER_SECOND as f64).round() as i64)
    }

    /// Nanoseconds since the epoch.
    pub const fn as_nanos(self) -> i64 {
        self.0
    }

    /// Seconds since the epoch; exact to about 0.2 µs for Unix times. For people and plots, not for arithmetic.
    pub fn as_seconds(self) -> f64 {
        self.0 as f64 / NANOS_PER_SECOND as f64
    }

    /// Seconds from `earlier` to `self`, exact for spans of days.
    pub fn seconds_since(self, earlier: Stamp) -> f64 {
        (self - earlier).as_seconds()
    }

    /// Reads decimal seconds such as `1690.25` without going through a float, so that a file written
    /// with nine decimals comes back bit for bit. Scientific notation is accepted through `f64`.
    /// `None` if it is not a finite number in range.
    pub fn parse_seconds(text: &str) -> Option<Self> {
        let text = text.trim();
        let (negative, digits) = match text.strip_prefix('-') {
            Some(rest) => (true, rest),
            None => (false, text.strip_prefix('+').unwrap_or(text)),
        };
        let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
        let plain = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
        if (whole.is_empty() && fraction.is_empty()) || !plain(whole) || !plain(fraction) {
            let seconds: f64 = text.parse().ok()?;
            let in_range = seconds.is_finite() && seconds.abs() < 9.0e9;
            return in_range.then(|| Self::from_seconds(seconds));
        }
        let whole: i64 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
        let mut nanos = 0_i64;
        for place in 0..9 {
            let digit = fraction.as_bytes().get(place).map_or(0, |byte| i64::from(byte - b'0'));
            nanos = nanos * 10 + digit;
        }
        let magnitude = whole.checked_mul(NANOS_PER_SECOND)?.checked_add(nanos)?;
        Some(Self(if negative { -magnitude } else { magnitude }))
    }
}

impl Span {
    /// A span of `nanos` nanoseconds.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// A span of `millis` milliseconds.
    pub const fn from_millis(millis: i64) -> Self {
        Self(millis * 1_000_000)
    }

    /// The span nearest to `seconds`. Saturates at the ends of the range.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * NANOS_PER_SECOND as f64).round() as i64)
    }

    /// Nanoseconds.
    pub const fn as_nanos(self) -> i64 {
        self.0
    }

    /// Seconds.
    pub fn as_seconds(self) -> f64 {
        self.0 as f64 / NANOS_PER_SECOND as f64
    }
}

impl Sub for Stamp {
    type Output = Span;
    fn sub(self, earlier: Stamp) -> Span {
        Span(self.0.saturating_sub(earlier.0))
    }
}

impl Add<Span> for Stamp {
    type Output = Stamp;
    fn add(self, span: Span) -> Stamp {
        Stamp(self.0.saturating_add(span.0))
    }
}

impl AddAssign<Span> for Stamp {
    fn add_assign(&mut self, span: Span) {
        *self = *self + span;
    }
}

impl Sub<Span> for Stamp {
    type Output = Stamp;
    fn sub(self, span: Span) -> Stamp {
        Stamp(self.0.saturating_sub(span.0))
    }
}

/// Seconds with nine decimals, exact: what [`Stamp::parse_seconds`] reads back bit for bit.
impl fmt::Display for Stamp {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let magnitude = self.0.unsigned_abs();
        let (whole, nanos) = (magnitude / NANOS_PER_SECOND as u64, magnitude % NANOS_PER_SECOND as u64);
        write!(formatter, "{sign}{whole}.{nanos:09}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_are_read_and_written_without_loss() {
        for nanos in [0, 1, -1, 478_710_633_000, 1_700_000_000_123_456_789, -5_000_000_001] {
            let stamp = Stamp::from_nanos(nanos);
            assert_eq!(Stamp::parse_seconds(&stamp.to_string()), Some(stamp), "{nanos}");
        }
        assert_eq!(Stamp::parse_seconds("0.1"), Some(Stamp::from_nanos(100_000_000)));
        assert_eq!(Stamp::parse_seconds(".5"), Some(Stamp::from_nanos(500_000_000)));
        assert_eq!(Stamp::parse_seconds("1e-3"), Some(Stamp::from_nanos(1_000_000)));
    }

    #[test]
    fn what_is_not_a_time_is_refused() {
        for text in ["", ".", "nan", "inf", "12:00", "1e300", "99999999999999999999", "--1", "1.2.3"] {
            assert_eq!(Stamp::parse_seconds(text), None, "{text}");
        }
    }

    #[test]
    fn arithmetic_saturates_instead_of_wrapping() {
        let far = Stamp::from_nanos(i64::MAX);
        assert_eq!(far + Span::from_nanos(1), far);
        assert_eq!((far - Stamp::from_nanos(i64::MIN)).as_nanos(), i64::MAX);
    }
}
