//! The history's database and its tables.

use std::path::Path;

use rusqlite::{Connection, Result};

/// Counts the changes of the tables; a database with another number is put aside.
const VERSION: i64 = 1;

const TABLES: &str = "
    CREATE TABLE outages (
        id TEXT PRIMARY KEY,
        machine TEXT NOT NULL,
        cause TEXT NOT NULL,
        start_ns INTEGER NOT NULL,
        end_ns INTEGER,             -- NULL while it goes on
        body TEXT NOT NULL,         -- JSON without the samples
        samples TEXT NOT NULL       -- JSON: sigma over time and track
    ) STRICT;
    CREATE INDEX outages_by_start ON outages (start_ns, id);
    CREATE TABLE cells (
        quarter INTEGER NOT NULL,   -- of an hour, since the epoch
        machine TEXT NOT NULL,
        east INTEGER NOT NULL,
        north INTEGER NOT NULL,
        observed_ns INTEGER NOT NULL,
        float_ns INTEGER NOT NULL,
        without_ns INTEGER NOT NULL,
        PRIMARY KEY (quarter, machine, east, north)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE alerts (
        id TEXT PRIMARY KEY,
        rule TEXT NOT NULL,
        machine TEXT,               -- NULL if it is the site's
        state TEXT NOT NULL,
        raised_ns INTEGER NOT NULL,
        body TEXT NOT NULL          -- JSON
    ) STRICT;
    CREATE INDEX alerts_by_time ON alerts (raised_ns, id);
    CREATE TABLE deliveries (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        channel TEXT NOT NULL,
        alert TEXT NOT NULL,
        body TEXT NOT NULL,         -- the alert as it was then, JSON
        failures INTEGER NOT NULL,
        since_ns INTEGER NOT NULL,
        due_ns INTEGER NOT NULL
    ) STRICT;
    CREATE INDEX deliveries_by_channel ON deliveries (channel, id);
";

/// The database.
#[derive(Debug)]
pub(super) struct Database {
    pub(super) connection: Connection,
}

impl Database {
    /// Opens the database. One that is damaged or of another version is put aside, and an empty one takes its
    /// place.
    pub fn open(path: &Path) -> Result<Self> {
        if !path.exists() {
            return Self::create(Connection::open(path)?);
        }
        let known = Connection::open(path).and_then(|connection| {
            connection.pragma_update(None, "journal_mode", "WAL")?;
            let verdict: String = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
            let version: i64 = connection.query_row("PRAGMA user_version", [], |row| row.get(0))?;
            Ok((connection, verdict, version))
        });
        let why = match known {
            Ok((connection, verdict, VERSION)) if verdict == "ok" => return Self::prepare(connection),
            Ok((_, verdict, VERSION)) => format!("is damaged: {verdict}"),
            Ok((_, _, version)) => format!("is of version {version}, not {VERSION}"),
            Err(error) => format!("cannot be read: {error}"),
        };
        let beside = |end: &str| {
            let mut name = path.as_os_str().to_owned();
            name.push(end);
            name
        };
        tracing::error!(
            "{}: {why}; it is put aside as .damaged, and the history begins anew",
            path.display()
        );
        for end in ["", "-wal", "-shm"] {
            // What is not there is not in the way.
            let _ = std::fs::rename(beside(end), beside(&format!(".damaged{end}")));
        }
        Self::create(Connection::open(path)?)
    }

    /// One that is gone with the process.
    pub fn in_memory() -> Result<Self> {
        Self::create(Connection::open_in_memory()?)
    }

    fn create(connection: Connection) -> Result<Self> {
        connection.pragma_update(None, "journal_mode", "WAL")?;
        connection.execute_batch(&format!("BEGIN; {TABLES} PRAGMA user_version = {VERSION}; COMMIT;"))?;
        Self::prepare(connection)
    }

    fn prepare(connection: Connection) -> Result<Self> {
        // A power cut may cost the newest rows, and damages nothing.
        connection.pragma_update(None, "synchronous", "NORMAL")?;
        Ok(Self { connection })
    }
}
