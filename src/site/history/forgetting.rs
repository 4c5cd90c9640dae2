//! What is too old is forgotten, where the site file says so.

use rusqlite::{Result, params};

use super::database::Database;
use super::shadow::quarter;
use crate::fleet::AlertState;
use crate::time::Stamp;

/// Rows that are forgotten at once: whoever else wants the database waits no longer than for these.
const ROWS: i64 = 2_000;

impl Database {
    /// Forgets some of what was over before: outages by their end, alerts that were seen by when they were raised, time
    /// in cells by whole quarters of an hour. Says whether there is more of it.
    pub fn forget(&mut self, before: Stamp) -> Result<bool> {
        let transaction = self.connection.transaction()?;
        let outages = transaction.execute(
            "DELETE FROM outages WHERE id IN
             (SELECT id FROM outages WHERE start_ns < ?1 AND end_ns < ?1 ORDER BY start_ns LIMIT ?2)",
            params![before.as_nanos(), ROWS],
        )?;
        let alerts = transaction.execute(
            "DELETE FROM alerts WHERE id IN
             (SELECT id FROM alerts WHERE raised_ns < ?1 AND state = ?3 ORDER BY raised_ns LIMIT ?2)",
            params![before.as_nanos(), ROWS, AlertState::Cleared.name()],
        )?;
        let cells = transaction.execute(
            "DELETE FROM cells WHERE (quarter, machine, east, north) IN
             (SELECT quarter, machine, east, north FROM cells WHERE quarter < ?1 ORDER BY quarter LIMIT ?2)",
            params![quarter(before), ROWS],
        )?;
        transaction.commit()?;
        let most = usize::try_from(ROWS).unwrap_or(usize::MAX);
        Ok([outages, alerts, cells].into_iter().any(|count| count == most))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::{CellKey, CellTime, QUARTER};
    use crate::site::history::alerts::an_alert;

    #[test]
    fn what_was_over_before_is_forgotten_piece_by_piece_and_nothing_else() {
        let mut database = Database::in_memory().expect("opens");
        let hour = 4 * QUARTER.as_nanos();
        for (id, start, end) in
            [("old", 1, Some(2)), ("long", 1, Some(hour)), ("on", 1, None), ("new", hour, None)]
        {
            let row = params![id, start, end];
            let text = "INSERT INTO outages (id, machine, cause, start_ns, end_ns, body, samples)
                        VALUES (?1, 'a', 'silent', ?2, ?3, '{}', '[]')";
            database.connection.execute(text, row).expect("kept");
        }
        let alerts = [an_alert(1, AlertState::Cleared), an_alert(2, AlertState::ClearedUnacknowledged)];
        database.put_alerts(&alerts, &[]).expect("kept");
        database.put_alerts(&[an_alert(hour, AlertState::Cleared)], &[]).expect("kept");
        let time = CellTime { observed_ns: 10, float_ns: 0, without_ns: 0 };
        let many = ROWS + 7;
        let cells = |quarter, count| {
            let cell = |east| ("a".to_owned(), CellKey { quarter, east, north: 0 }, time);
            (0..count).map(cell).collect::<Vec<_>>()
        };
        database.add_cells(&cells(0, many)).expect("kept");
        database.add_cells(&cells(3, 5)).expect("kept");

        let before = Stamp::from_nanos(hour - 1);
        assert!(database.forget(before).expect("forgets"), "not all of it at once");
        assert!(!database.forget(before).expect("forgets"));
        let left = |text: &str| {
            let mut found = database.connection.prepare(text).expect("SQL");
            let rows = found.query_map([], |row| row.get::<_, String>(0)).expect("rows");
            rows.collect::<Result<Vec<_>>>().expect("read")
        };
        assert_eq!(left("SELECT id FROM outages ORDER BY id"), ["long", "new", "on"]);
        let seen_late = format!("disk_low..{hour}");
        assert_eq!(left("SELECT id FROM alerts ORDER BY id"), ["disk_low..2", seen_late.as_str()]);
        assert_eq!(left("SELECT DISTINCT CAST(quarter AS TEXT) FROM cells"), ["3"]);
    }
}
