//! SQLite files of our own: how they are opened and looked after, whoever keeps what in them.
//!
//! A log beside the file keeps writers and readers apart, so that a process that is killed damages nothing; who writes
//! at the same time is waited for; references hold. What the tables are, and what is asked of them, is their owners'.

#![allow(clippy::disallowed_methods, reason = "files are a shell's")]

use std::path::Path;
use std::time::Duration;

use rusqlite::{Connection, ErrorCode, Result, TransactionBehavior};

/// How long one waits for another process to finish writing.
const PATIENCE: Duration = Duration::from_secs(5);

/// What a power cut may cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Durability {
    /// Nothing: what is written is on the disk.
    Everything,
    /// The newest rows; what is there is whole.
    AllButTheNewest,
}

/// What is in a file.
#[derive(Clone, Copy, Debug)]
pub struct Schema {
    /// Statements that make the tables.
    pub tables: &'static str,
    /// Counts the changes of the tables, from 1.
    pub version: i64,
    /// What a power cut may cost.
    pub durability: Durability,
}

/// What was found.
enum Found {
    Usable(Connection),
    /// And why it is not.
    Unusable(String),
}

impl Schema {
    /// Opens the file; one that is empty, or not there, gets the tables. One of another version is left as it is.
    ///
    /// # Errors
    /// The file is no database, is of another version, or cannot be opened or written.
    pub fn open(&self, path: &Path) -> Result<Connection> {
        match self.look(path)? {
            Found::Usable(connection) => Ok(connection),
            Found::Unusable(why) => Err(rusqlite::Error::ToSqlConversionFailure(format!("it {why}").into())),
        }
    }

    /// Opens the file likewise; one that is damaged or of another version is put aside as `.damaged`, where only the
    /// last of them is kept, and an empty one takes its place. `then` says what that means, such as `the history begins
    /// anew`.
    ///
    /// # Errors
    /// Somebody else holds the file for long, or no file can be made there.
    pub fn open_or_begin_anew(&self, path: &Path, then: &str) -> Result<Connection> {
        let why = match self.look_closely(path) {
            Ok(Found::Usable(connection)) => return Ok(connection),
            Ok(Found::Unusable(why)) => why,
            // It is well, but somebody else's for now.
            Err(error) if is_busy(&error) => return Err(error),
            Err(error) => format!("cannot be read: {error}"),
        };
        tracing::error!("{}: {why}; it is put aside as .damaged, and {then}", path.display());
        let beside = |end: &str| {
            let mut name = path.as_os_str().to_owned();
            name.push(end);
            name
        };
        for end in ["", "-wal", "-shm"] {
            // What is not there is not in the way; but the log of another file would be.
            let (from, to) = (beside(end), beside(&format!(".damaged{end}")));
            let _ = std::fs::remove_file(&to);
            if std::fs::rename(&from, to).is_err() {
                let _ = std::fs::remove_file(from);
            }
        }
        self.open(path)
    }

    /// One that is gone with the process.
    ///
    /// # Errors
    /// There is no memory for it.
    pub fn in_memory(&self) -> Result<Connection> {
        match self.take(Connection::open_in_memory()?)? {
            Found::Usable(connection) => Ok(connection),
            Found::Unusable(why) => Err(rusqlite::Error::ToSqlConversionFailure(why.into())),
        }
    }

    fn look(&self, path: &Path) -> Result<Found> {
        self.take(Connection::open(path)?)
    }

    /// Reads the whole file, too: damage need not be where one looks first.
    fn look_closely(&self, path: &Path) -> Result<Found> {
        let connection = match self.look(path)? {
            Found::Usable(connection) => connection,
            unusable @ Found::Unusable(_) => return Ok(unusable),
        };
        let verdict: String = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
        Ok(match verdict.as_str() {
            "ok" => Found::Usable(connection),
            _ => Found::Unusable(format!("is damaged: {verdict}")),
        })
    }

    fn take(&self, mut connection: Connection) -> Result<Found> {
        let Self { tables, version: ours, durability } = *self;
        connection.busy_timeout(PATIENCE)?;
        connection.pragma_update(None, "journal_mode", "WAL")?;
        let synchronous = match durability {
            Durability::Everything => "FULL",
            Durability::AllButTheNewest => "NORMAL",
        };
        connection.pragma_update(None, "synchronous", synchronous)?;
        connection.pragma_update(None, "foreign_keys", true)?;
        // Two processes may begin at once: one makes the tables, the other finds them.
        let made = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let version: i64 = made.query_row("PRAGMA user_version", [], |row| row.get(0))?;
        let count: i64 = made.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
        if (version, count) == (0, 0) {
            made.execute_batch(&format!("{tables} PRAGMA user_version = {ours};"))?;
        } else if version != ours {
            return Ok(Found::Unusable(format!(
                "is of version {version}, this program knows version {ours}"
            )));
        }
        made.commit()?;
        Ok(Found::Usable(connection))
    }
}

fn is_busy(error: &rusqlite::Error) -> bool {
    matches!(error.sqlite_error_code(), Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOTES: Schema = Schema {
        tables: "CREATE TABLE notes (text TEXT) STRICT; CREATE TABLE marks (
            note INTEGER REFERENCES notes (rowid)) STRICT;",
        version: 1,
        durability: Durability::AllButTheNewest,
    };
    const LATER: Schema = Schema { version: 2, durability: Durability::Everything, ..NOTES };

    struct Folder(std::path::PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let folder =
                std::env::temp_dir().join(format!("holdfast-database-{name}-{}", std::process::id()));
            std::fs::create_dir_all(&folder).expect("a folder");
            Self(folder)
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    fn count(connection: &Connection) -> i64 {
        connection.query_row("SELECT count(*) FROM notes", [], |row| row.get(0)).expect("counted")
    }

    fn pragma<T: rusqlite::types::FromSql>(connection: &Connection, name: &str) -> T {
        connection.pragma_query_value(None, name, |row| row.get(0)).expect("a value")
    }

    #[test]
    fn every_connection_is_looked_after_in_the_same_way() {
        let folder = Folder::new("alike");
        let kept = [(NOTES, 1), (LATER, 2)];
        for (index, (schema, synchronous)) in kept.into_iter().enumerate() {
            let path = folder.0.join(format!("{index}.sqlite"));
            for _ in 0..2 {
                for connection in
                    [schema.open(&path).expect("opens"), schema.open_or_begin_anew(&path, "").expect("opens")]
                {
                    assert_eq!(pragma::<String>(&connection, "journal_mode"), "wal");
                    assert_eq!(pragma::<i64>(&connection, "synchronous"), synchronous);
                    assert_eq!(pragma::<i64>(&connection, "foreign_keys"), 1);
                    assert_eq!(pragma::<i64>(&connection, "busy_timeout"), PATIENCE.as_millis() as i64);
                    assert_eq!(pragma::<i64>(&connection, "user_version"), schema.version);
                    connection.execute("INSERT INTO notes VALUES ('x')", []).expect("written");
                }
            }
            assert_eq!(count(&schema.open(&path).expect("opens")), 4);
        }
        assert_eq!(count(&NOTES.in_memory().expect("opens")), 0);
    }

    #[test]
    fn another_version_is_refused_or_put_aside_with_its_log() {
        let folder = Folder::new("version");
        let path = folder.0.join("notes.sqlite");
        let first = NOTES.open(&path).expect("opens");
        first.execute("INSERT INTO notes VALUES ('x')", []).expect("written");
        let refused = LATER.open(&path).expect_err("of another version").to_string();
        assert!(refused.contains("is of version 1, this program knows version 2"), "{refused}");
        assert_eq!(count(&NOTES.open(&path).expect("as it was")), 1);
        drop(first);
        assert_eq!(count(&LATER.open_or_begin_anew(&path, "all begins anew").expect("opens")), 0);
        let aside = folder.0.join("notes.sqlite.damaged");
        assert_eq!(count(&NOTES.open(&aside).expect("kept")), 1);
    }

    #[test]
    fn damage_anywhere_is_found_and_put_aside() {
        let folder = Folder::new("damage");
        let path = folder.0.join("notes.sqlite");
        let connection = NOTES.open(&path).expect("opens");
        for _ in 0..2_000 {
            connection.execute("INSERT INTO notes VALUES (hex(randomblob(40)))", []).expect("written");
        }
        drop(connection);
        let mut bytes = std::fs::read(&path).expect("read");
        let middle = bytes.len() / 2;
        assert!(middle > 40_000, "{middle}");
        bytes[middle..middle + 8_192].fill(0xa5);
        for damaged in [&b"this is no database"[..], &bytes] {
            std::fs::write(&path, damaged).expect("damaged");
            let connection = NOTES.open_or_begin_anew(&path, "all begins anew").expect("opens");
            assert_eq!(count(&connection), 0);
            drop(connection);
            assert_eq!(std::fs::read(folder.0.join("notes.sqlite.damaged")).expect("kept"), damaged);
        }
        std::fs::write(&path, b"this is no database").expect("damaged");
        assert!(NOTES.open(&path).is_err());
        assert_eq!(std::fs::read(&path).expect("left as it is"), b"this is no database");
    }

    #[test]
    fn somebody_who_is_writing_is_waited_for_and_is_no_damage() {
        let folder = Folder::new("busy");
        let path = folder.0.join("notes.sqlite");
        let connection = NOTES.open(&path).expect("opens");
        connection.execute_batch("BEGIN IMMEDIATE; INSERT INTO notes VALUES ('x');").expect("begun");
        let waiting = std::thread::spawn({
            let path = path.clone();
            move || count(&NOTES.open_or_begin_anew(&path, "").expect("opens"))
        });
        std::thread::sleep(Duration::from_millis(200));
        assert!(!waiting.is_finished());
        connection.execute_batch("COMMIT").expect("written");
        assert_eq!(waiting.join().expect("opened"), 1);
        assert!(!folder.0.join("notes.sqlite.damaged").exists());
    }
}
