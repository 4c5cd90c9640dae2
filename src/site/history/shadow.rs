//! Time in the cells of the site, in the database.

use rusqlite::{Result, params};

use super::database::Database;
use crate::fleet::{CellKey, CellTime, Observed, QUARTER};
use crate::time::Stamp;

/// Which part of the map.
#[derive(Clone, Debug)]
pub(in crate::site) struct Area {
    pub machine: Option<String>,
    pub from: Stamp,
    pub to: Stamp,
    /// Cells of the map are so many times as wide as those in the database.
    pub multiple: i64,
    /// No more cells than this.
    pub limit: usize,
}

/// The quarter of an hour in which a time is.
pub(super) fn quarter(stamp: Stamp) -> i64 {
    stamp.as_nanos().div_euclid(QUARTER.as_nanos())
}

/// The first quarter of an hour that begins then or later.
fn quarter_after(stamp: Stamp) -> i64 {
    -(-i128::from(stamp.as_nanos())).div_euclid(i128::from(QUARTER.as_nanos())) as i64
}

impl Database {
    pub fn add_cells(&mut self, cells: &[(String, CellKey, CellTime)]) -> Result<()> {
        let transaction = self.connection.transaction()?;
        {
            let mut add = transaction.prepare(
                "INSERT INTO cells (quarter, machine, east, north, observed_ns, float_ns, without_ns)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7) ON CONFLICT (quarter, machine, east, north) DO UPDATE SET
                 observed_ns = observed_ns + ?5, float_ns = float_ns + ?6, without_ns = without_ns + ?7",
            )?;
            for (machine, key, time) in cells {
                add.execute(params![
                    key.quarter,
                    machine,
                    key.east,
                    key.north,
                    time.observed_ns,
                    time.float_ns,
                    time.without_ns
                ])?;
            }
        }
        transaction.commit()
    }

    /// Columns, rows and times of the map's cells; whole quarters of an hour that touch the time.
    pub fn cells(&mut self, area: &Area) -> Result<Vec<(i64, i64, CellTime)>> {
        // SQLite divides towards zero.
        let mut found = self.connection.prepare(
            "SELECT (east - ((east % ?4) + ?4) % ?4) / ?4 AS column, (north - ((north % ?4) + ?4) % ?4) / ?4 AS row,
             SUM(observed_ns), SUM(float_ns), SUM(without_ns) FROM cells
             WHERE quarter >= ?1 AND quarter < ?2 AND (?3 IS NULL OR machine = ?3)
             GROUP BY column, row ORDER BY column, row LIMIT ?5",
        )?;
        let limit = i64::try_from(area.limit).unwrap_or(i64::MAX);
        let bounds = params![quarter(area.from), quarter_after(area.to), area.machine, area.multiple, limit];
        let rows = found.query_map(bounds, |row| {
            let time = CellTime { observed_ns: row.get(2)?, float_ns: row.get(3)?, without_ns: row.get(4)? };
            Ok((row.get(0)?, row.get(1)?, time))
        })?;
        rows.collect()
    }

    /// Time that poses came, by machine and quarter of an hour.
    pub fn observed(&mut self, from: Stamp, to: Stamp) -> Result<Vec<Observed>> {
        let mut found = self.connection.prepare(
            "SELECT machine, quarter, SUM(observed_ns), SUM(float_ns), SUM(without_ns) FROM cells
             WHERE quarter >= ?1 AND quarter < ?2 GROUP BY machine, quarter",
        )?;
        let rows = found.query_map(params![quarter(from), quarter_after(to)], |row| {
            let time = CellTime { observed_ns: row.get(2)?, float_ns: row.get(3)?, without_ns: row.get(4)? };
            Ok(Observed { machine: row.get(0)?, quarter: row.get(1)?, time })
        })?;
        rows.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_add_up_and_are_joined_to_larger_ones_on_both_sides_of_the_origin() {
        let mut database = Database::in_memory().expect("opens");
        let time = CellTime { observed_ns: 10, float_ns: 1, without_ns: 4 };
        let cell = |quarter, east, north| ("a".to_owned(), CellKey { quarter, east, north }, time);
        database.add_cells(&[cell(5, -1, 0), cell(5, -5, 0), cell(5, 0, 4)]).expect("kept");
        database.add_cells(&[cell(5, -1, 0), cell(6, -6, -1)]).expect("kept");
        let at = |quarter: i64| Stamp::from_nanos(quarter * QUARTER.as_nanos());
        let mut of = |from, to, multiple| {
            let area = Area { machine: None, from, to, multiple, limit: 10 };
            let cells = database.cells(&area).expect("read");
            cells.into_iter().map(|(column, row, time)| (column, row, time.observed_ns)).collect::<Vec<_>>()
        };
        assert_eq!(of(at(5), at(7), 5), [(-2, -1, 10), (-1, 0, 30), (0, 0, 10)]);
        assert_eq!(of(at(5), at(6), 1), [(-5, 0, 10), (-1, 0, 20), (0, 4, 10)]);
        assert_eq!(of(Stamp::from_nanos(at(6).as_nanos() + 1), at(9), 1), [(-6, -1, 10)], "whole quarters");
        let observed = database.observed(at(0), at(9)).expect("read");
        let totals: Vec<_> = observed.iter().map(|one| (one.quarter, one.time.without_ns)).collect();
        assert_eq!(totals, [(5, 16), (6, 4)]);
    }
}
