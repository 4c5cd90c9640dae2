//! Outages added up: for each machine, and for each day of the site.

use std::collections::{BTreeMap, BTreeSet};

use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Timestamp, ToSpan as _};
use serde::Serialize;

use super::{CellTime, FixState, Outage, QUARTER};
use crate::fleet::view::UtcTime;
use crate::time::{Span, Stamp};

/// Outages of one cause.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct CauseTally {
    /// What was wrong when they began.
    pub cause: FixState,
    /// How many began.
    pub outages: u64,
    /// How long they lasted, s.
    pub duration_s: f64,
}

/// Outages of a machine in a span of time. Those that lasted longer count with the part in the span; what is told
/// once for an outage (their number, way, jump, sigma) counts where it began. A lost link counts by itself: whether
/// there was GNSS meanwhile nobody knows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Tally {
    /// GNSS outages that began.
    pub outages: u64,
    /// How long GNSS was out, s.
    pub duration_s: f64,
    /// The longest one's part in the span, s.
    pub longest_s: f64,
    /// Way in outages, m.
    pub travelled_m: f64,
    /// Largest jump at a recovery, m; `null` if there was none.
    pub jump_max_m: Option<f64>,
    /// Largest sigma in an outage, m; `null` if nobody knows.
    pub position_sigma_max_m: Option<f64>,
    /// The same by cause.
    pub by_cause: Vec<CauseTally>,
    /// How often the link was lost.
    pub link_losses: u64,
    /// How long the link was lost, s.
    pub link_lost_s: f64,
    /// How long poses came, s.
    pub observed_s: f64,
    /// Of that, with fixes that are usable, but not to the centimetre, s.
    pub float_s: f64,
    /// Of that, without good GNSS, s.
    pub without_gnss_s: f64,
}

/// One day of a machine.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct DayStatistics {
    /// By the site's time zone, such as `2026-11-23`.
    #[cfg_attr(feature = "shells", schema(format = Date))]
    pub day: String,
    /// What happened on it.
    #[serde(flatten)]
    pub tally: Tally,
}

/// One machine.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct MachineStatistics {
    /// Its id.
    pub machine: String,
    /// Over the whole span.
    pub total: Tally,
    /// Day by day, without those on which nothing was heard of it.
    pub days: Vec<DayStatistics>,
}

/// Outages added up.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Statistics {
    /// From here on.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub from: UtcTime,
    /// Up to here.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub to: UtcTime,
    /// IANA name of the zone by which days begin.
    pub time_zone: String,
    /// In the order of their ids.
    pub machines: Vec<MachineStatistics>,
}

/// Time that poses came from a machine in a quarter of an hour.
#[derive(Clone, Debug, PartialEq)]
pub struct Observed {
    /// The machine's id.
    pub machine: String,
    /// Quarters of an hour since the epoch.
    pub quarter: i64,
    /// How long.
    pub time: CellTime,
}

impl Statistics {
    /// Of the outages and times that touch the span; an outage that goes on counts up to `now`.
    pub fn of(
        outages: &[Outage],
        observed: &[Observed],
        (from, to): (Stamp, Stamp),
        zone: &TimeZone,
        now: Stamp,
    ) -> Self {
        let machines: BTreeSet<&str> = outages
            .iter()
            .map(|outage| outage.machine.as_str())
            .chain(observed.iter().map(|observed| observed.machine.as_str()))
            .collect();
        let days = days(from, to, zone);
        let machine = |machine: &str| {
            let outages: Vec<&Outage> = outages.iter().filter(|outage| outage.machine == machine).collect();
            let observed: Vec<&Observed> =
                observed.iter().filter(|observed| observed.machine == machine).collect();
            let tally = |from, to| Tally::of(&outages, &observed, (from, to), now);
            let days = days
                .iter()
                .map(|(day, from, to)| DayStatistics { day: day.to_string(), tally: tally(*from, *to) });
            MachineStatistics {
                machine: machine.to_owned(),
                total: tally(from, to),
                days: days.filter(|day| !day.tally.is_empty()).collect(),
            }
        };
        Self {
            from: UtcTime(from),
            to: UtcTime(to),
            time_zone: zone.iana_name().unwrap_or("UTC").to_owned(),
            machines: machines.into_iter().map(machine).collect(),
        }
    }
}

impl Tally {
    fn of(outages: &[&Outage], observed: &[&Observed], (from, to): (Stamp, Stamp), now: Stamp) -> Self {
        let mut tally = Self::default();
        let mut causes: BTreeMap<FixState, CauseTally> = BTreeMap::new();
        for outage in outages {
            let inside = outage.end.unwrap_or(now).min(to) - outage.start.max(from);
            let began = outage.start >= from && outage.start < to;
            if inside < Span::default() || (inside == Span::default() && !began) {
                continue;
            }
            let (inside_s, count) = (inside.as_seconds(), u64::from(began));
            if outage.cause == FixState::LinkLost {
                tally.link_losses += count;
                tally.link_lost_s += inside_s;
                continue;
            }
            tally.outages += count;
            tally.duration_s += inside_s;
            tally.longest_s = tally.longest_s.max(inside_s);
            let cause = causes.entry(outage.cause).or_insert(CauseTally {
                cause: outage.cause,
                outages: 0,
                duration_s: 0.0,
            });
            cause.outages += count;
            cause.duration_s += inside_s;
            if began {
                tally.travelled_m += outage.travelled_m.unwrap_or(0.0);
                tally.jump_max_m = larger(tally.jump_max_m, outage.jump_m);
                tally.position_sigma_max_m = larger(tally.position_sigma_max_m, outage.sigma_max_m);
            }
        }
        tally.by_cause = causes.into_values().collect();
        let mut time = CellTime::default();
        for observed in observed {
            let start = Stamp::from_nanos(observed.quarter.saturating_mul(QUARTER.as_nanos()));
            if start >= from && start < to {
                time.add(&observed.time);
            }
        }
        let seconds = |nanos: i64| Span::from_nanos(nanos).as_seconds();
        tally.observed_s = seconds(time.observed_ns);
        tally.float_s = seconds(time.float_ns);
        tally.without_gnss_s = seconds(time.without_ns);
        tally
    }

    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

fn larger(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    one.into_iter().chain(other).reduce(f64::max)
}

/// The site's days that touch the span, each with its part of it.
fn days(from: Stamp, to: Stamp, zone: &TimeZone) -> Vec<(Date, Stamp, Stamp)> {
    let mut days = Vec::new();
    let Ok(first) = Timestamp::from_nanosecond(i128::from(from.as_nanos())) else { return days };
    let mut day = zone.to_datetime(first).date();
    loop {
        let next = day.checked_add(1.day());
        let midnight = |date: Date| -> Option<Stamp> {
            let zoned = zone.to_zoned(date.at(0, 0, 0, 0)).ok()?;
            i64::try_from(zoned.timestamp().as_nanosecond()).ok().map(Stamp::from_nanos)
        };
        let (Some(begin), Some(end)) = (midnight(day), next.as_ref().ok().copied().and_then(midnight)) else {
            return days;
        };
        if begin >= to {
            return days;
        }
        days.push((day, begin.max(from), end.min(to)));
        match next {
            Ok(next) => day = next,
            Err(_) => return days,
        }
    }
}
