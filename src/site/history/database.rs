//! The history's database and its tables.

use std::path::Path;

use rusqlite::{Connection, Result};

use crate::database::{Durability, Schema};

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

const SCHEMA: Schema = Schema { tables: TABLES, version: 1, durability: Durability::AllButTheNewest };

/// The database.
#[derive(Debug)]
pub(super) struct Database {
    pub(super) connection: Connection,
}

impl Database {
    /// Opens the database. One that is damaged or of another version is put aside, and an empty one takes its
    /// place.
    pub fn open(path: &Path) -> Result<Self> {
        Ok(Self { connection: SCHEMA.open_or_begin_anew(path, "the history begins anew")? })
    }

    /// One that is gone with the process.
    pub fn in_memory() -> Result<Self> {
        Ok(Self { connection: SCHEMA.in_memory()? })
    }
}
