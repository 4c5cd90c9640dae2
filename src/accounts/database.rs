//! The tables and what is asked of them.

use std::path::Path;

use rusqlite::{Connection, OptionalExtension as _, Result, Row, params};

use super::{Change, Role, SignInLimits, Token, User};
use crate::database::{Durability, Schema};
use crate::time::Stamp;

const TABLES: &str = "
    CREATE TABLE users (
        name TEXT PRIMARY KEY COLLATE NOCASE,
        role TEXT NOT NULL,
        password TEXT NOT NULL,     -- argon2id, in the PHC format
        created_ns INTEGER NOT NULL
    ) STRICT;
    CREATE TABLE sign_ins (
        hash BLOB PRIMARY KEY,      -- SHA-256 of the cookie
        user TEXT NOT NULL COLLATE NOCASE REFERENCES users (name) ON DELETE CASCADE,
        created_ns INTEGER NOT NULL,
        seen_ns INTEGER NOT NULL
    ) STRICT;
    CREATE TABLE tokens (
        id TEXT PRIMARY KEY,
        hash BLOB NOT NULL UNIQUE,  -- SHA-256 of the token
        user TEXT NOT NULL COLLATE NOCASE REFERENCES users (name) ON DELETE CASCADE,
        label TEXT NOT NULL,
        role TEXT NOT NULL,
        created_ns INTEGER NOT NULL,
        expires_ns INTEGER NOT NULL,
        seen_ns INTEGER
    ) STRICT;
    CREATE TABLE changes (
        number INTEGER PRIMARY KEY AUTOINCREMENT,
        time_ns INTEGER NOT NULL,
        who TEXT NOT NULL,
        via TEXT NOT NULL,
        source TEXT NOT NULL,
        what TEXT NOT NULL,
        outcome TEXT NOT NULL
    ) STRICT;
";

/// A revoked token stays revoked after a power cut.
const SCHEMA: Schema = Schema { tables: TABLES, version: 1, durability: Durability::Everything };

/// What became of a change to an account.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Settled {
    Done,
    Missing,
    OnlyAdmin,
}

/// A sign-in that may be too old.
#[derive(Debug)]
pub(super) struct SignIn {
    pub user: String,
    pub role: Role,
    pub created: Stamp,
    pub seen: Stamp,
}

/// One connection.
#[derive(Debug)]
pub(super) struct Database {
    connection: Connection,
}

impl Database {
    /// Opens the file, which may be empty.
    pub fn open(path: &Path) -> Result<Self> {
        Ok(Self { connection: SCHEMA.open(path)? })
    }

    pub fn has_users(&self) -> Result<bool> {
        self.connection.prepare("SELECT EXISTS (SELECT 1 FROM users)")?.query_row([], |row| row.get(0))
    }

    pub fn users(&self) -> Result<Vec<User>> {
        let mut users = self.connection.prepare("SELECT name, role, created_ns FROM users ORDER BY name")?;
        users.query_map([], user)?.collect()
    }

    /// The account and its password's hash.
    pub fn user(&self, name: &str) -> Result<Option<(User, String)>> {
        let text = "SELECT name, role, created_ns, password FROM users WHERE name = ?1";
        let mut users = self.connection.prepare(text)?;
        users.query_row([name], |row| Ok((user(row)?, row.get(3)?))).optional()
    }

    /// False if there is one of that name.
    pub fn add_user(&self, user: &User, password: &str) -> Result<bool> {
        let added = self.connection.execute(
            "INSERT INTO users (name, role, password, created_ns) VALUES (?1, ?2, ?3, ?4)
             ON CONFLICT (name) DO NOTHING",
            params![user.name, user.role.name(), password, user.created.as_nanos()],
        )?;
        Ok(added == 1)
    }

    /// Changes an account that is there, and if `keep_admin` not if it is the only admin.
    pub fn guarded(
        &self,
        name: &str,
        keep_admin: bool,
        change: impl FnOnce(&Self) -> Result<()>,
    ) -> Result<Settled> {
        // Nobody else writes between the question and the change.
        self.connection.execute_batch("BEGIN IMMEDIATE")?;
        let settled = self.settle(name, keep_admin, change);
        self.connection.execute_batch(if settled.is_ok() { "COMMIT" } else { "ROLLBACK" })?;
        settled
    }

    fn settle(
        &self,
        name: &str,
        keep_admin: bool,
        change: impl FnOnce(&Self) -> Result<()>,
    ) -> Result<Settled> {
        let Some((user, _)) = self.user(name)? else { return Ok(Settled::Missing) };
        if keep_admin && user.role == Role::Admin {
            let count = "SELECT count(*) FROM users WHERE role = 'admin'";
            let admins: i64 = self.connection.query_row(count, [], |row| row.get(0))?;
            if admins < 2 {
                return Ok(Settled::OnlyAdmin);
            }
        }
        change(self)?;
        Ok(Settled::Done)
    }

    pub fn remove_user(&self, name: &str) -> Result<()> {
        self.connection.execute("DELETE FROM users WHERE name = ?1", [name])?;
        Ok(())
    }

    pub fn set_role(&self, name: &str, role: Role) -> Result<()> {
        self.connection.execute("UPDATE users SET role = ?2 WHERE name = ?1", [name, role.name()])?;
        Ok(())
    }

    pub fn set_password(&self, name: &str, password: &str) -> Result<()> {
        self.connection.execute("UPDATE users SET password = ?2 WHERE name = ?1", [name, password])?;
        self.connection.execute("DELETE FROM sign_ins WHERE user = ?1", [name])?;
        Ok(())
    }

    /// Adds one, and forgets those that are no good any more.
    pub fn add_sign_in(&self, hash: &[u8; 32], user: &str, now: Stamp, limits: SignInLimits) -> Result<()> {
        self.connection.execute(
            "DELETE FROM sign_ins WHERE created_ns <= ?1 OR seen_ns <= ?2",
            [(now - limits.total).as_nanos(), (now - limits.idle).as_nanos()],
        )?;
        self.connection.execute(
            "INSERT INTO sign_ins (hash, user, created_ns, seen_ns) VALUES (?1, ?2, ?3, ?3)",
            params![hash, user, now.as_nanos()],
        )?;
        Ok(())
    }

    pub fn sign_in(&self, hash: &[u8; 32]) -> Result<Option<SignIn>> {
        let mut sign_ins = self.connection.prepare(
            "SELECT users.name, users.role, sign_ins.created_ns, seen_ns
             FROM sign_ins JOIN users ON users.name = sign_ins.user WHERE hash = ?1",
        )?;
        let read = |row: &Row<'_>| {
            Ok(SignIn {
                user: row.get(0)?,
                role: role(row, 1)?,
                created: Stamp::from_nanos(row.get(2)?),
                seen: Stamp::from_nanos(row.get(3)?),
            })
        };
        sign_ins.query_row([hash], read).optional()
    }

    pub fn remove_sign_in(&self, hash: &[u8; 32]) -> Result<()> {
        self.connection.execute("DELETE FROM sign_ins WHERE hash = ?1", [hash])?;
        Ok(())
    }

    /// False if the account has `most` already.
    pub fn add_token(&self, token: &Token, hash: &[u8; 32], most: usize) -> Result<bool> {
        let added = self.connection.execute(
            "INSERT INTO tokens (id, hash, user, label, role, created_ns, expires_ns)
             SELECT ?1, ?2, ?3, ?4, ?5, ?6, ?7 WHERE (SELECT count(*) FROM tokens WHERE user = ?3) < ?8",
            params![
                token.id,
                hash,
                token.user,
                token.label,
                token.role.name(),
                token.created.as_nanos(),
                token.expires.as_nanos(),
                i64::try_from(most).unwrap_or(i64::MAX)
            ],
        )?;
        Ok(added == 1)
    }

    pub fn tokens(&self, user: Option<&str>) -> Result<Vec<Token>> {
        let mut tokens = self.connection.prepare(
            "SELECT id, user, label, role, created_ns, expires_ns, seen_ns FROM tokens
             WHERE ?1 IS NULL OR user = ?1 ORDER BY user, created_ns, id",
        )?;
        tokens.query_map([user], token)?.collect()
    }

    /// The token, and its account's role.
    pub fn token(&self, hash: &[u8; 32]) -> Result<Option<(Token, Role)>> {
        let mut tokens = self.connection.prepare(
            "SELECT id, users.name, label, tokens.role, tokens.created_ns, expires_ns, seen_ns, users.role
             FROM tokens JOIN users ON users.name = tokens.user WHERE hash = ?1",
        )?;
        tokens.query_row([hash], |row| Ok((token(row)?, role(row, 7)?))).optional()
    }

    pub fn remove_token(&self, id: &str) -> Result<bool> {
        Ok(self.connection.execute("DELETE FROM tokens WHERE id = ?1", [id])? == 1)
    }

    /// A sign-in or a token was used.
    pub fn seen(&self, hash: &[u8; 32], now: Stamp) -> Result<()> {
        for table in ["sign_ins", "tokens"] {
            let text = format!("UPDATE {table} SET seen_ns = ?2 WHERE hash = ?1");
            self.connection.execute(&text, params![hash, now.as_nanos()])?;
        }
        Ok(())
    }

    /// Adds a change, and forgets what is older than the newest `most`.
    pub fn note(&self, change: &Change, most: i64) -> Result<()> {
        let Change { time, who, via, from, what, outcome } = change;
        self.connection.execute(
            "INSERT INTO changes (time_ns, who, via, source, what, outcome) VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
            params![time.as_nanos(), who, via, from, what, outcome],
        )?;
        let last = self.connection.last_insert_rowid();
        self.connection.execute("DELETE FROM changes WHERE number <= ?1", [last - most])?;
        Ok(())
    }

    pub fn changes(&self, before: Option<i64>, most: usize) -> Result<Vec<(i64, Change)>> {
        let mut changes = self.connection.prepare(
            "SELECT number, time_ns, who, via, source, what, outcome FROM changes
             WHERE ?1 IS NULL OR number < ?1 ORDER BY number DESC LIMIT ?2",
        )?;
        let read = |row: &Row<'_>| {
            let change = Change {
                time: Stamp::from_nanos(row.get(1)?),
                who: row.get(2)?,
                via: row.get(3)?,
                from: row.get(4)?,
                what: row.get(5)?,
                outcome: row.get(6)?,
            };
            Ok((row.get(0)?, change))
        };
        changes.query_map(params![before, i64::try_from(most).unwrap_or(i64::MAX)], read)?.collect()
    }
}

fn user(row: &Row<'_>) -> Result<User> {
    Ok(User { name: row.get(0)?, role: role(row, 1)?, created: Stamp::from_nanos(row.get(2)?) })
}

fn token(row: &Row<'_>) -> Result<Token> {
    let seen: Option<i64> = row.get(6)?;
    Ok(Token {
        id: row.get(0)?,
        user: row.get(1)?,
        label: row.get(2)?,
        role: role(row, 3)?,
        created: Stamp::from_nanos(row.get(4)?),
        expires: Stamp::from_nanos(row.get(5)?),
        seen: seen.map(Stamp::from_nanos),
    })
}

/// A role that this program does not know is no role at all.
fn role(row: &Row<'_>, column: usize) -> Result<Role> {
    let name: String = row.get(column)?;
    Role::from_name(&name).ok_or_else(|| {
        let message = format!("\"{name}\" is no role");
        rusqlite::Error::FromSqlConversionFailure(column, rusqlite::types::Type::Text, message.into())
    })
}
