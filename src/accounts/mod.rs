//! Who may do what: accounts with roles, sign-ins of browsers, tokens of programs, and the book of changes.
//!
//! Kept in one SQLite file, `accounts.db`, that its owner alone may read. The server and the command line open it
//! at the same time; what one of them writes, the other sees at its next question. No file means no accounts:
//! nothing is written before there is something to keep. A file that cannot be read is an error, never an empty
//! one.
//!
//! Secrets are not in it: of passwords there is an argon2id hash, of tokens and sign-ins, which are random, a
//! SHA-256. Times come in as arguments. Not in here: HTTP, cookies, rates (room `site`).

mod database;
mod password;
mod secret;
#[cfg(test)]
mod tests;
mod values;

use std::fs::OpenOptions;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use crate::time::{Span, Stamp};
use database::Database;
pub use password::{PASSWORD_MAX, PASSWORD_MIN, Password};
pub use secret::Secret;
pub use values::{AccountsError, By, Change, Known, Role, SignInLimits, Token, User};

/// Name of the file.
const FILE: &str = "accounts.db";
/// When somebody was last there is written down this exactly.
const SEEN_EVERY: Span = Span::from_millis(60_000);
/// More tokens of one account are refused.
pub const TOKENS_MAX: usize = 100;
/// A token is good for so many days at most.
pub const TOKEN_DAYS_MAX: u32 = 3660;
/// The book keeps so many changes; the oldest go.
const CHANGES_MAX: i64 = 100_000;

/// The file and its two connections: who reads does not wait for who writes.
#[derive(Debug)]
pub struct Accounts {
    path: PathBuf,
    reading: Mutex<Option<Open>>,
    writing: Mutex<Option<Open>>,
}

#[derive(Debug)]
struct Open {
    database: Database,
    /// Device and number: tells whether another file took its place.
    file: (u64, u64),
}

impl Accounts {
    /// The accounts of a site that keeps its data in `directory`.
    ///
    /// # Errors
    /// There is a file, and it cannot be used.
    pub fn of(directory: &Path) -> Result<Self, AccountsError> {
        let accounts =
            Self { path: directory.join(FILE), reading: Mutex::default(), writing: Mutex::default() };
        accounts.exist()?;
        Ok(accounts)
    }

    /// Where they are kept.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether there is any account.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn exist(&self) -> Result<bool, AccountsError> {
        Ok(self.read(Database::has_users)?.unwrap_or(false))
    }

    /// All accounts by name.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn users(&self) -> Result<Vec<User>, AccountsError> {
        Ok(self.read(Database::users)?.unwrap_or_default())
    }

    /// One account.
    ///
    /// # Errors
    /// There is none of that name, or the file cannot be used.
    pub fn user(&self, name: &str) -> Result<User, AccountsError> {
        let user = self.read(|database| database.user(name))?.flatten();
        user.map(|(user, _)| user).ok_or_else(|| missing("account", name))
    }

    /// Makes an account.
    ///
    /// # Errors
    /// The name or the password is not as it should be, or the name is taken.
    pub fn add_user(
        &self,
        name: &str,
        role: Role,
        password: &Password,
        now: Stamp,
    ) -> Result<User, AccountsError> {
        check_name(name)?;
        let hash = password.check(name)?.hash()?;
        let user = User { name: name.to_owned(), role, created: now };
        match self.write(|database| database.add_user(&user, &hash))? {
            true => Ok(user),
            false => Err(AccountsError::Taken(name.to_owned())),
        }
    }

    /// Removes an account with its tokens and sign-ins. `keep_admin` refuses to remove the only admin.
    ///
    /// # Errors
    /// There is none of that name, or it is the only admin.
    pub fn remove_user(&self, name: &str, keep_admin: bool) -> Result<(), AccountsError> {
        let removed =
            self.write(|database| database.guarded(name, keep_admin, |database| database.remove_user(name)))?;
        settled(removed, name)
    }

    /// Gives an account another role. `keep_admin` refuses to take it from the only admin.
    ///
    /// # Errors
    /// There is none of that name, or it is the only admin.
    pub fn set_role(&self, name: &str, role: Role, keep_admin: bool) -> Result<(), AccountsError> {
        let set = self.write(|database| {
            let keep = keep_admin && role != Role::Admin;
            database.guarded(name, keep, |database| database.set_role(name, role))
        })?;
        settled(set, name)
    }

    /// Whether an account could have that password.
    ///
    /// # Errors
    /// There is none of that name, or the password is not as it should be.
    pub fn check_new_password(&self, name: &str, password: &Password) -> Result<(), AccountsError> {
        self.user(name)?;
        password.check(name).map(|_| ())
    }

    /// Gives an account another password, and ends its sign-ins.
    ///
    /// # Errors
    /// There is none of that name, or the password is not as it should be.
    pub fn set_password(&self, name: &str, password: &Password) -> Result<(), AccountsError> {
        let hash = password.check(name)?.hash()?;
        let set = self
            .write(|database| database.guarded(name, false, |database| database.set_password(name, &hash)))?;
        settled(set, name)
    }

    /// The account, if the password is right. Takes as long for a name that does not exist.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn check_password(&self, name: &str, password: &Password) -> Result<Option<User>, AccountsError> {
        let found = self.read(|database| database.user(name))?.flatten();
        let right = password.is_of(found.as_ref().map(|(_, hash)| hash.as_str()));
        Ok(found.map(|(user, _)| user).filter(|_| right))
    }

    /// Signs an account in: the secret is for the browser's cookie.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn sign_in(&self, name: &str, limits: SignInLimits, now: Stamp) -> Result<Secret, AccountsError> {
        let secret = Secret::draw("")?;
        self.write(|database| database.add_sign_in(&secret.hash(), name, now, limits))?;
        Ok(secret)
    }

    /// Ends a sign-in, if there is one.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn sign_out(&self, secret: &Secret) -> Result<(), AccountsError> {
        if self.path.exists() {
            self.write(|database| database.remove_sign_in(&secret.hash()))
        } else {
            Ok(())
        }
    }

    /// Whose sign-in that is, if it is good; `true` asks for [`Accounts::seen`].
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn signed_in(
        &self,
        secret: &Secret,
        limits: SignInLimits,
        now: Stamp,
    ) -> Result<Option<(Known, bool)>, AccountsError> {
        self.by_sign_in(secret.hash(), limits, now)
    }

    fn by_sign_in(
        &self,
        hash: [u8; 32],
        limits: SignInLimits,
        now: Stamp,
    ) -> Result<Option<(Known, bool)>, AccountsError> {
        let found = self.read(|database| database.sign_in(&hash))?.flatten();
        let good = found.filter(|found| now - found.created < limits.total && now - found.seen < limits.idle);
        Ok(good.map(|found| {
            let known = Known { name: found.user, role: found.role, by: By::SignIn(hash) };
            (known, now - found.seen >= SEEN_EVERY)
        }))
    }

    /// Makes a token; the secret is shown once. It expires after so many days, and with its account.
    ///
    /// # Errors
    /// There is no such account or it has too many tokens, or label or days are not as they should be.
    pub fn add_token(
        &self,
        user: &str,
        label: &str,
        role: Role,
        expires: Stamp,
        now: Stamp,
    ) -> Result<(Token, Secret), AccountsError> {
        let length = label.chars().count();
        if !(1..=100).contains(&length) || label.chars().any(char::is_control) {
            return Err(invalid("the label must have 1 to 100 characters, and say what the token is for"));
        }
        let days = expires.seconds_since(now) / 86_400.0;
        if !(days > 0.0 && days <= f64::from(TOKEN_DAYS_MAX) + 1.0) {
            return Err(invalid(&format!("a token is good for 1 to {TOKEN_DAYS_MAX} days")));
        }
        let account = self.user(user)?;
        let secret = Secret::draw("hf_")?;
        let token = Token {
            id: Secret::draw("")?.reveal()[..12].to_owned(),
            user: account.name,
            label: label.to_owned(),
            role: role.min(account.role),
            created: now,
            expires,
            seen: None,
        };
        match self.write(|database| database.add_token(&token, &secret.hash(), TOKENS_MAX))? {
            true => Ok((token, secret)),
            false => {
                let many = format!("\"{user}\" has {TOKENS_MAX} tokens already; revoke some first");
                Err(AccountsError::Invalid(many))
            }
        }
    }

    /// Tokens by account and id: of one account, or of all.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn tokens(&self, user: Option<&str>) -> Result<Vec<Token>, AccountsError> {
        Ok(self.read(|database| database.tokens(user))?.unwrap_or_default())
    }

    /// Revokes a token: of one account, or of any.
    ///
    /// # Errors
    /// There is none of that id.
    pub fn revoke_token(&self, id: &str, user: Option<&str>) -> Result<(), AccountsError> {
        let there = self.tokens(user)?.iter().any(|token| token.id == id);
        if there && self.write(|database| database.remove_token(id))? {
            return Ok(());
        }
        Err(missing("token", id))
    }

    /// Whose token that is, if it is good; `true` asks for [`Accounts::seen`].
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn by_token(&self, secret: &Secret, now: Stamp) -> Result<Option<(Known, bool)>, AccountsError> {
        let found = self.read(|database| database.token(&secret.hash()))?.flatten();
        Ok(found.filter(|(token, _)| now < token.expires).map(|(token, role)| {
            let is_due = token.seen.is_none_or(|seen| now - seen >= SEEN_EVERY);
            let known = Known {
                name: token.user,
                role: role.min(token.role),
                by: By::Token { id: token.id, expires: token.expires },
            };
            (known, is_due)
        }))
    }

    /// Writes down that a sign-in or a token was used.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn seen(&self, secret: &Secret, now: Stamp) -> Result<(), AccountsError> {
        self.write(|database| database.seen(&secret.hash(), now))
    }

    /// Whether what was shown then would still be good now.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn still(&self, known: &Known, limits: SignInLimits, now: Stamp) -> Result<bool, AccountsError> {
        match &known.by {
            By::SignIn(hash) => Ok(self.by_sign_in(*hash, limits, now)?.is_some()),
            By::Token { id, expires } => {
                Ok(now < *expires && self.tokens(Some(&known.name))?.iter().any(|token| token.id == *id))
            }
        }
    }

    /// Writes a change into the book.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn note(&self, change: &Change) -> Result<(), AccountsError> {
        self.write(|database| database.note(change, CHANGES_MAX))
    }

    /// The newest changes before number `before`, newest first, each with its number.
    ///
    /// # Errors
    /// [`AccountsError::Unusable`].
    pub fn changes(&self, before: Option<i64>, most: usize) -> Result<Vec<(i64, Change)>, AccountsError> {
        Ok(self.read(|database| database.changes(before, most))?.unwrap_or_default())
    }

    /// Asks; `None` if there is no file.
    fn read<T>(
        &self,
        ask: impl FnOnce(&Database) -> rusqlite::Result<T>,
    ) -> Result<Option<T>, AccountsError> {
        let mut reading = self.reading.lock().unwrap_or_else(PoisonError::into_inner);
        match self.connect(&mut reading)? {
            Some(database) => ask(database).map(Some).map_err(|error| self.unusable(&error)),
            None => Ok(None),
        }
    }

    /// Changes; makes the file if there is none.
    fn write<T>(&self, change: impl FnOnce(&Database) -> rusqlite::Result<T>) -> Result<T, AccountsError> {
        let mut writing = self.writing.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.path.exists() {
            if let Some(directory) = self.path.parent() {
                std::fs::create_dir_all(directory).map_err(|error| self.unusable(&error))?;
            }
            let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&self.path);
            if let Err(error) = made
                && error.kind() != std::io::ErrorKind::AlreadyExists
            {
                return Err(self.unusable(&error));
            }
        }
        match self.connect(&mut writing)? {
            Some(database) => change(database).map_err(|error| self.unusable(&error)),
            None => Err(self.unusable(&"it is gone")),
        }
    }

    /// The connection, opened if it is not, and again if another file took the place of the one that was.
    fn connect<'a>(&self, open: &'a mut Option<Open>) -> Result<Option<&'a Database>, AccountsError> {
        let about = match std::fs::metadata(&self.path) {
            Ok(about) => about,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                *open = None;
                return Ok(None);
            }
            Err(error) => return Err(self.unusable(&error)),
        };
        let file = (about.dev(), about.ino());
        if open.as_ref().is_none_or(|open| open.file != file) {
            if about.permissions().mode() & 0o077 != 0 {
                let owner_only = std::fs::Permissions::from_mode(0o600);
                std::fs::set_permissions(&self.path, owner_only).map_err(|error| self.unusable(&error))?;
            }
            let database = Database::open(&self.path).map_err(|error| self.unusable(&error))?;
            *open = Some(Open { database, file });
        }
        Ok(open.as_ref().map(|open| &open.database))
    }

    fn unusable(&self, error: &dyn std::fmt::Display) -> AccountsError {
        AccountsError::Unusable { path: self.path.clone(), message: error.to_string() }
    }
}

fn invalid(message: &str) -> AccountsError {
    AccountsError::Invalid(message.to_owned())
}

fn missing(what: &'static str, name: &str) -> AccountsError {
    AccountsError::Missing { what, name: name.chars().take(80).collect() }
}

fn settled(settled: database::Settled, name: &str) -> Result<(), AccountsError> {
    match settled {
        database::Settled::Done => Ok(()),
        database::Settled::Missing => Err(missing("account", name)),
        database::Settled::OnlyAdmin => Err(AccountsError::OnlyAdmin(name.to_owned())),
    }
}

fn check_name(name: &str) -> Result<(), AccountsError> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"._@-".contains(&byte);
    let starts_well = name.bytes().next().is_some_and(|byte| byte.is_ascii_alphanumeric());
    match starts_well && name.len() <= 64 && name.bytes().all(plain) {
        true => Ok(()),
        false => Err(invalid(
            "a name has 1 to 64 letters, digits, '.', '_', '@' and '-', and begins with a letter or digit",
        )),
    }
}
