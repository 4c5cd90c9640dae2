//! Which sessions are too old, or too many.

use crate::config;
use crate::time::{Span, Stamp};

/// What is kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Retention {
    age: Option<Span>,
    bytes: Option<u64>,
}

/// A session that may be deleted.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Candidate {
    pub id: String,
    /// When its last message was received.
    pub ended: Stamp,
    pub bytes: u64,
}

impl Retention {
    pub fn of(record: &config::Record) -> Self {
        Self {
            age: record.keep_days.map(|days| Span::from_seconds(days * 86_400.0)),
            bytes: record.keep_gb.map(|gigabytes| (gigabytes * 1e9) as u64),
        }
    }

    /// The ids of those that must go, oldest first, and why. `sessions` are all that have ended, oldest first;
    /// `running_bytes` are those of the one that runs, which counts, but stays.
    pub fn expired(&self, sessions: &[Candidate], running_bytes: u64, now: Stamp) -> Vec<(String, String)> {
        let mut bytes = sessions.iter().fold(running_bytes, |sum, session| sum.saturating_add(session.bytes));
        let mut expired = Vec::new();
        for session in sessions {
            let age = now - session.ended;
            let too_many = self.bytes.filter(|limit| bytes > *limit);
            let why = match (self.age.filter(|limit| age > *limit), too_many) {
                (Some(_), _) => format!("it ended {:.1} days ago", age.as_seconds() / 86_400.0),
                (None, Some(limit)) => {
                    format!("all sessions have {:.3} GB, more than {:.3} GB", giga(bytes), giga(limit))
                }
                (None, None) => continue,
            };
            bytes -= session.bytes;
            expired.push((session.id.clone(), why));
        }
        expired
    }
}

fn giga(bytes: u64) -> f64 {
    bytes as f64 / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY: i64 = 86_400_000;

    fn sessions() -> Vec<Candidate> {
        let session = |day| Candidate {
            id: format!("day-{day}"),
            ended: Stamp::from_nanos(0) + Span::from_millis(day * DAY),
            bytes: 1_000_000_000,
        };
        [1, 2, 3, 4].map(session).into()
    }

    fn expired(age_days: Option<f64>, gigabytes: Option<f64>, running_bytes: u64) -> Vec<String> {
        let record = config::Record { keep_days: age_days, keep_gb: gigabytes, ..config::Record::default() };
        let now = Stamp::from_nanos(0) + Span::from_millis(5 * DAY);
        let expired = Retention::of(&record).expired(&sessions(), running_bytes, now);
        expired.into_iter().map(|(id, _)| id).collect()
    }

    #[test]
    fn oldest_go_first_and_nothing_goes_that_may_stay() {
        assert_eq!(expired(None, None, u64::MAX), Vec::<String>::new());
        assert_eq!(expired(Some(2.5), None, 0), ["day-1", "day-2"]);
        assert_eq!(expired(Some(4.0), None, 0), Vec::<String>::new(), "not yet older");
        assert_eq!(expired(None, Some(4.0), 0), Vec::<String>::new());
        assert_eq!(expired(None, Some(3.5), 0), ["day-1"]);
        assert_eq!(expired(None, Some(3.5), 1_000_000_000), ["day-1", "day-2"]);
        assert_eq!(expired(Some(3.5), Some(2.5), 0), ["day-1", "day-2"]);
        assert_eq!(expired(None, Some(0.0), 0).len(), 4);
    }
}
