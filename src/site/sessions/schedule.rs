//! When a new session begins by itself.

use jiff::Timestamp;
use jiff::civil::Time;
use jiff::tz::TimeZone;

use crate::config::{self, Rotate, Violation};
use crate::time::Stamp;

/// Days or shifts of a site.
#[derive(Clone, Debug)]
pub(super) struct Schedule {
    zone: TimeZone,
    /// When something begins each day; empty if nothing does.
    times: Vec<Time>,
}

impl Schedule {
    pub fn of(config: &config::Site) -> Result<Self, Violation> {
        let times = match config.record.rotate {
            Rotate::Day => vec![Time::midnight()],
            Rotate::Shift => config.record.shift_times()?,
            Rotate::Never => vec![],
        };
        Ok(Self { zone: config.zone()?, times })
    }

    /// When the next day or shift begins after `now`; `None` if none does. A time that the clocks pass over in
    /// spring is as much later as they are put forward; one that they pass twice in autumn counts the first time.
    pub fn next(&self, now: Stamp) -> Option<Stamp> {
        let now = timestamp(now);
        let today = now.to_zoned(self.zone.clone()).date();
        // The day before and two days after: on one of them something begins, wherever the clocks are put.
        let days =
            [today.yesterday(), Ok(today), today.tomorrow(), today.tomorrow().and_then(|day| day.tomorrow())];
        let begins = days.into_iter().flatten().flat_map(|day| {
            self.times.iter().filter_map(move |time| day.to_datetime(*time).to_zoned(self.zone.clone()).ok())
        });
        let next = begins.map(|begin| begin.timestamp()).filter(|begin| *begin > now).min()?;
        i64::try_from(next.as_nanosecond()).ok().map(Stamp::from_nanos)
    }
}

/// Every stamp has one.
pub(super) fn timestamp(stamp: Stamp) -> Timestamp {
    Timestamp::from_nanosecond(i128::from(stamp.as_nanos()))
        .expect("every stamp is in jiff's range, which reaches from year -9999 to 9999")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schedule(zone: &str, times: &[(i8, i8)]) -> Schedule {
        let times = times.iter().map(|(hour, minute)| Time::constant(*hour, *minute, 0, 0)).collect();
        Schedule { zone: TimeZone::get(zone).expect("a zone"), times }
    }

    fn next(schedule: &Schedule, now: &str) -> String {
        let now: Timestamp = now.parse().expect("a time");
        let stamp = Stamp::from_nanos(i64::try_from(now.as_nanosecond()).expect("in range"));
        timestamp(schedule.next(stamp).expect("something begins")).to_string()
    }

    #[test]
    fn days_and_shifts_begin_by_the_clock_of_the_site() {
        let days = schedule("Europe/Zurich", &[(0, 0)]);
        assert_eq!(next(&days, "2026-11-23T10:00:00Z"), "2026-11-23T23:00:00Z");
        assert_eq!(next(&days, "2026-11-23T23:00:00Z"), "2026-11-24T23:00:00Z");
        assert_eq!(next(&days, "2026-07-01T22:30:00Z"), "2026-07-02T22:00:00Z");
        let shifts = schedule("America/Los_Angeles", &[(6, 0), (14, 0), (22, 0)]);
        assert_eq!(next(&shifts, "2026-11-23T13:59:59Z"), "2026-11-23T14:00:00Z");
        assert_eq!(next(&shifts, "2026-11-24T06:00:00Z"), "2026-11-24T14:00:00Z");
        assert_eq!(next(&schedule("UTC", &[(0, 0)]), "2026-12-31T23:59:59.5Z"), "2027-01-01T00:00:00Z");
        assert_eq!(schedule("UTC", &[]).next(Stamp::from_nanos(0)), None);
    }

    #[test]
    fn days_that_the_clocks_make_longer_or_shorter_begin_once() {
        let zurich = schedule("Europe/Zurich", &[(2, 30)]);
        // 2:30 does not exist on 29 March 2026, and is there twice on 25 October 2026.
        assert_eq!(next(&zurich, "2026-03-28T12:00:00Z"), "2026-03-29T01:30:00Z");
        assert_eq!(next(&zurich, "2026-03-29T01:30:00Z"), "2026-03-30T00:30:00Z");
        assert_eq!(next(&zurich, "2026-10-24T12:00:00Z"), "2026-10-25T00:30:00Z");
        assert_eq!(next(&zurich, "2026-10-25T00:30:00Z"), "2026-10-26T01:30:00Z");
        // Samoa had no 30 December 2011.
        let apia = schedule("Pacific/Apia", &[(0, 0)]);
        assert_eq!(next(&apia, "2011-12-30T09:00:00Z"), "2011-12-30T10:00:00Z");
    }
}
