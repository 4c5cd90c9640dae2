//! Outages in the database.

use rusqlite::{OptionalExtension as _, Result, Row, params};

use super::database::Database;
use crate::fleet::{FixState, Outage, SigmaSample, Thinned, TrackPoint};
use crate::time::Stamp;

/// Which outages.
#[derive(Clone, Debug, Default)]
pub(in crate::site) struct Filter {
    pub machine: Option<String>,
    pub cause: Option<FixState>,
    /// Whether it goes on.
    pub open: Option<bool>,
    /// Those that touch the time from here on, and up to here.
    pub from: Option<Stamp>,
    pub to: Option<Stamp>,
    pub min_duration_ns: Option<i64>,
    /// Those after this one, in the order of the list.
    pub after: Option<Cursor>,
    pub limit: usize,
}

/// A place in the list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::site) struct Cursor {
    pub start: Stamp,
    pub id: String,
}

/// A part of the list.
#[derive(Debug)]
pub(in crate::site) struct Page {
    /// Without their samples, newest first.
    pub outages: Vec<Outage>,
    /// Where the list goes on, if it does.
    pub next: Option<Cursor>,
}

type Samples = (Thinned<SigmaSample>, Thinned<TrackPoint>);

impl Cursor {
    /// As it is written in addresses.
    pub fn encode(&self) -> String {
        format!("{:x}.{}", self.start.as_nanos(), self.id)
    }

    /// `None` if it is none of ours.
    pub fn decode(text: &str) -> Option<Self> {
        let (start, id) = text.split_once('.')?;
        let start = Stamp::from_nanos(i64::from_str_radix(start, 16).ok()?);
        (!id.is_empty() && id.len() <= 200).then(|| Self { start, id: id.to_owned() })
    }
}

pub(super) fn json_error(error: serde_json::Error) -> rusqlite::Error {
    rusqlite::Error::ToSqlConversionFailure(Box::new(error))
}

fn body(row: &Row<'_>) -> Result<Outage> {
    let text: String = row.get(0)?;
    serde_json::from_str(&text).map_err(json_error)
}

impl Database {
    pub fn put_outage(&mut self, outage: &Outage) -> Result<()> {
        let samples: (&Thinned<_>, &Thinned<_>) = (&outage.sigma, &outage.track);
        let samples = serde_json::to_string(&samples).map_err(json_error)?;
        let without = Outage { sigma: Thinned::new(0.0), track: Thinned::new(0.0), ..outage.clone() };
        let body = serde_json::to_string(&without).map_err(json_error)?;
        self.connection.execute(
            "INSERT INTO outages (id, machine, cause, start_ns, end_ns, body, samples)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)
             ON CONFLICT (id) DO UPDATE SET cause = ?3, start_ns = ?4, end_ns = ?5, body = ?6, samples = ?7",
            params![
                outage.id,
                outage.machine,
                outage.cause.name(),
                outage.start.as_nanos(),
                outage.end.map(Stamp::as_nanos),
                body,
                samples,
            ],
        )?;
        Ok(())
    }

    /// One outage with its samples.
    pub fn outage(&mut self, id: &str) -> Result<Option<Outage>> {
        let with_samples = |row: &Row<'_>| {
            let samples: String = row.get(1)?;
            let (sigma, track): Samples = serde_json::from_str(&samples).map_err(json_error)?;
            Ok(Outage { sigma, track, ..body(row)? })
        };
        let mut found = self.connection.prepare("SELECT body, samples FROM outages WHERE id = ?1")?;
        found.query_row([id], with_samples).optional()
    }

    /// Those that go on, with their samples, newest first.
    pub fn open_outages(&mut self) -> Result<Vec<Outage>> {
        let ids: Vec<String> = {
            let text = "SELECT id FROM outages WHERE end_ns IS NULL ORDER BY start_ns DESC";
            let mut found = self.connection.prepare(text)?;
            found.query_map([], |row| row.get(0))?.collect::<Result<_>>()?
        };
        ids.iter().filter_map(|id| self.outage(id).transpose()).collect()
    }

    /// Newest first.
    pub fn outages(&mut self, filter: &Filter, now: Stamp) -> Result<Page> {
        let mut found = self.connection.prepare(
            "SELECT body FROM outages WHERE (?1 IS NULL OR machine = ?1) AND (?2 IS NULL OR cause = ?2)
             AND (?3 IS NULL OR (end_ns IS NULL) = ?3)
             AND (?4 IS NULL OR COALESCE(end_ns, ?7) >= ?4) AND (?5 IS NULL OR start_ns < ?5)
             AND (?6 IS NULL OR COALESCE(end_ns, ?7) - start_ns >= ?6)
             AND (?8 IS NULL OR (start_ns, id) < (?8, ?9))
             ORDER BY start_ns DESC, id DESC LIMIT ?10",
        )?;
        let Filter { machine, cause, open, from, to, min_duration_ns, after, limit } = filter;
        let rows = found.query_map(
            params![
                machine,
                cause.map(FixState::name),
                open,
                from.map(Stamp::as_nanos),
                to.map(Stamp::as_nanos),
                min_duration_ns,
                now.as_nanos(),
                after.as_ref().map(|cursor| cursor.start.as_nanos()),
                after.as_ref().map(|cursor| &cursor.id),
                i64::try_from(limit + 1).unwrap_or(i64::MAX),
            ],
            body,
        )?;
        let mut outages: Vec<Outage> = rows.collect::<Result<_>>()?;
        let goes_on = outages.len() > *limit;
        outages.truncate(*limit);
        let last = outages.last().filter(|_| goes_on);
        let next = last.map(|last| Cursor { start: last.start, id: last.id.clone() });
        Ok(Page { outages, next })
    }
}
