//! What the sessions' files say, known by heart in SQLite. Nothing is in it that is not in the files.

use std::collections::BTreeMap;
use std::path::Path;

use rusqlite::{Connection, Result, params};

use super::folder::{Look, Notes};
use crate::database::{Durability, Schema};
use crate::record::{FileState, Summary};
use crate::time::Stamp;

const TABLES: &str = "
    CREATE TABLE sessions (
        id TEXT PRIMARY KEY,
        name TEXT NOT NULL,
        notes TEXT NOT NULL,
        tags TEXT NOT NULL          -- a JSON list
    ) STRICT;
    CREATE TABLE files (
        session TEXT NOT NULL REFERENCES sessions (id) ON DELETE CASCADE,
        number INTEGER NOT NULL,
        bytes INTEGER NOT NULL,
        modified_ns INTEGER NOT NULL,
        state TEXT,                 -- complete, recovered, truncated; NULL if it was not closed
        messages INTEGER NOT NULL,
        lost_bytes INTEGER NOT NULL,
        first_ns INTEGER,
        last_ns INTEGER,
        machines TEXT NOT NULL,     -- a JSON list
        PRIMARY KEY (session, number)
    ) STRICT;
";

/// The newest rows, which a power cut may cost, are read from the files again.
const SCHEMA: Schema = Schema { tables: TABLES, version: 1, durability: Durability::AllButTheNewest };

/// A file of a session, as it was looked at; `summary` is `None` if it was not closed, or cannot be read.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Part {
    pub look: Look,
    pub summary: Option<Summary>,
}

/// A session and its files by number.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Entry {
    pub notes: Notes,
    pub parts: BTreeMap<u32, Part>,
}

/// The database.
#[derive(Debug)]
pub(super) struct Database {
    connection: Connection,
}

impl Database {
    /// Opens the database. One that is damaged or of another version is put aside, and an empty one takes its
    /// place.
    pub fn open(path: &Path) -> Result<Self> {
        Ok(Self { connection: SCHEMA.open_or_begin_anew(path, "made anew from the recordings")? })
    }

    /// One that is gone with the process.
    pub fn in_memory() -> Result<Self> {
        Ok(Self { connection: SCHEMA.in_memory()? })
    }

    pub fn put_notes(&mut self, id: &str, notes: &Notes) -> Result<()> {
        let tags = serde_json::to_string(&notes.tags).unwrap_or_default();
        self.connection.execute(
            "INSERT INTO sessions (id, name, notes, tags) VALUES (?1, ?2, ?3, ?4)
             ON CONFLICT (id) DO UPDATE SET name = ?2, notes = ?3, tags = ?4",
            params![id, notes.name, notes.notes, tags],
        )?;
        Ok(())
    }

    /// The session must be there.
    pub fn put_part(&mut self, id: &str, number: u32, part: &Part) -> Result<()> {
        let Part { look, summary } = part;
        let summary = summary.as_ref();
        let span = summary.and_then(|summary| summary.span);
        let machines = summary.map_or(&[][..], |summary| &summary.machines);
        self.connection.execute(
            "INSERT OR REPLACE INTO files (session, number, bytes, modified_ns, state, messages, lost_bytes,
             first_ns, last_ns, machines) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)",
            params![
                id,
                number,
                integer(look.bytes),
                look.modified_ns,
                summary.map(|summary| summary.state.name()),
                integer(summary.map_or(0, |summary| summary.messages)),
                integer(summary.map_or(0, |summary| summary.lost_bytes)),
                span.map(|(first, _)| first.as_nanos()),
                span.map(|(_, last)| last.as_nanos()),
                serde_json::to_string(machines).unwrap_or_default(),
            ],
        )?;
        Ok(())
    }

    pub fn remove(&mut self, id: &str) -> Result<()> {
        self.connection.execute("DELETE FROM sessions WHERE id = ?1", [id])?;
        Ok(())
    }

    pub fn remove_part(&mut self, id: &str, number: u32) -> Result<()> {
        self.connection
            .execute("DELETE FROM files WHERE session = ?1 AND number = ?2", params![id, number])?;
        Ok(())
    }

    /// All sessions, or one, by id.
    pub fn entries(&mut self, only: Option<&str>) -> Result<BTreeMap<String, Entry>> {
        let mut entries = BTreeMap::new();
        let mut sessions = self
            .connection
            .prepare("SELECT id, name, notes, tags FROM sessions WHERE ?1 IS NULL OR id = ?1")?;
        let mut rows = sessions.query([only])?;
        while let Some(row) = rows.next()? {
            let tags: String = row.get(3)?;
            let tags = serde_json::from_str(&tags).unwrap_or_default();
            let notes = Notes { name: row.get(1)?, notes: row.get(2)?, tags };
            entries.insert(row.get(0)?, Entry { notes, parts: BTreeMap::new() });
        }
        let mut files = self.connection.prepare(
            "SELECT session, number, bytes, modified_ns, state, messages, lost_bytes, first_ns, last_ns, machines
             FROM files WHERE ?1 IS NULL OR session = ?1",
        )?;
        let mut rows = files.query([only])?;
        while let Some(row) = rows.next()? {
            let id: String = row.get(0)?;
            let look = Look { bytes: natural(row.get(2)?), modified_ns: row.get(3)? };
            let state: Option<String> = row.get(4)?;
            let span: (Option<i64>, Option<i64>) = (row.get(7)?, row.get(8)?);
            let machines: String = row.get(9)?;
            let (messages, lost_bytes) = (natural(row.get(5)?), natural(row.get(6)?));
            let summary = state.and_then(|state| FileState::from_name(&state)).map(|state| Summary {
                state,
                messages,
                bytes: look.bytes,
                span: span
                    .0
                    .zip(span.1)
                    .map(|(first, last)| (Stamp::from_nanos(first), Stamp::from_nanos(last))),
                machines: serde_json::from_str(&machines).unwrap_or_default(),
                lost_bytes,
            });
            if let Some(entry) = entries.get_mut(&id) {
                entry.parts.insert(row.get(1)?, Part { look, summary });
            }
        }
        Ok(entries)
    }
}

/// SQLite's integers have a sign.
fn integer(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn natural(value: i64) -> u64 {
    u64::try_from(value).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(number: u64) -> Part {
        let look = Look { bytes: 100 + number, modified_ns: 7 };
        let span = Some((Stamp::from_nanos(1), Stamp::from_nanos(2)));
        let machines = vec!["a".to_owned(), "b-1".to_owned()];
        let summary = Summary {
            state: FileState::Recovered,
            messages: 5,
            bytes: look.bytes,
            span,
            machines,
            lost_bytes: 3,
        };
        Part { look, summary: Some(summary) }
    }

    #[test]
    fn what_is_put_comes_back_also_after_a_restart_and_is_lost_with_a_damaged_file() {
        let folder = std::env::temp_dir().join(format!("holdfast-database-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        let path = folder.join("catalogue.sqlite");
        let mut first = Database::open(&path).expect("opens");
        let notes =
            Notes { name: "n'; --".to_owned(), notes: "äöü\n".to_owned(), tags: vec!["t".to_owned()] };
        first.put_notes("s", &Notes::default()).expect("put");
        first.put_part("s", 0, &part(0)).expect("put");
        first.put_part("s", 1, &Part { summary: None, ..part(1) }).expect("put");
        first.put_notes("s", &notes).expect("put");
        first.put_part("s", 0, &part(2)).expect("put");
        let expected = Entry { notes, parts: [(0, part(2)), (1, Part { summary: None, ..part(1) })].into() };
        let mut database = Database::open(&path).expect("opens beside the first");
        assert_eq!(database.entries(None).expect("read"), [("s".to_owned(), expected.clone())].into());
        assert_eq!(database.entries(Some("t")).expect("read").len(), 0);
        assert!(database.put_part("t", 0, &part(0)).is_err(), "there is no such session");
        database.remove_part("s", 1).expect("removed");
        assert_eq!(database.entries(Some("s")).expect("read")["s"].parts.len(), 1);
        database.remove("s").expect("removed");
        assert_eq!(database.entries(None).expect("read").len(), 0);
        drop((first, database));

        for damage in [&b"this is no database"[..], b""] {
            std::fs::write(&path, damage).expect("damaged");
            let mut database = Database::open(&path).expect("made anew");
            assert_eq!(database.entries(None).expect("read").len(), 0);
            database.put_notes("s", &Notes::default()).expect("works");
        }
        std::fs::remove_dir_all(folder).expect("removed");
    }
}
