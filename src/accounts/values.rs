//! What is said of accounts: roles, accounts, tokens, who has shown what, changes.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::time::{Span, Stamp};

/// What somebody may do: each role includes those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Look at everything.
    Viewer,
    /// Also start and stop sessions, write notes, acknowledge alerts.
    Operator,
    /// Also accounts, tokens of others, and the site plan.
    Admin,
}

impl Role {
    /// All of them, the least first.
    pub const ALL: [Self; 3] = [Self::Viewer, Self::Operator, Self::Admin];

    /// The name in JSON, in the database and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Admin => "admin",
        }
    }

    /// The role of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|role| role.name() == name)
    }
}

/// Why something about accounts cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum AccountsError {
    /// A value is not as it should be.
    #[error("{0}")]
    Invalid(String),
    /// There is nothing of that name.
    #[error("there is no {what} \"{name}\"")]
    Missing {
        /// What is looked for.
        what: &'static str,
        /// What it should be called.
        name: String,
    },
    /// There is one of that name.
    #[error("there is an account \"{0}\" already")]
    Taken(String),
    /// Nobody could make accounts any more.
    #[error("\"{0}\" is the only admin; make another account admin first")]
    OnlyAdmin(String),
    /// The file cannot be read or written.
    #[error("{}: {message}", path.display())]
    Unusable {
        /// Which file.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
}

/// An account.
#[derive(Clone, Debug, PartialEq)]
pub struct User {
    /// By which it signs in; its case does not matter.
    pub name: String,
    /// What it may do.
    pub role: Role,
    /// When it was made.
    pub created: Stamp,
}

/// A token of an account, without the secret.
#[derive(Clone, Debug, PartialEq)]
pub struct Token {
    /// By which it is revoked.
    pub id: String,
    /// Whose it is.
    pub user: String,
    /// What it is for.
    pub label: String,
    /// What it may do, as long as its account may.
    pub role: Role,
    /// When it was made.
    pub created: Stamp,
    /// Until when it is good.
    pub expires: Stamp,
    /// When it was last used, to a minute.
    pub seen: Option<Stamp>,
}

/// Who has shown a good secret.
#[derive(Clone, Debug, PartialEq)]
pub struct Known {
    /// The account.
    pub name: String,
    /// What it may do now.
    pub role: Role,
    /// What was shown.
    pub by: By,
}

/// A good secret, by what is kept of it.
#[derive(Clone, Debug, PartialEq)]
pub enum By {
    /// A browser's cookie: its hash.
    SignIn([u8; 32]),
    /// A token.
    Token {
        /// Which one.
        id: String,
        /// Until when it is good.
        expires: Stamp,
    },
}

/// How long a sign-in is good.
#[derive(Clone, Copy, Debug)]
pub struct SignInLimits {
    /// Since it was last used.
    pub idle: Span,
    /// Since it was made.
    pub total: Span,
}

/// A change, as the book has it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Change {
    /// When.
    pub time: Stamp,
    /// Who; empty where nobody has an account.
    pub who: String,
    /// How that is known: `sign_in`, `token`, `nobody`, `command_line`.
    pub via: String,
    /// From which address.
    pub from: String,
    /// What was asked for.
    pub what: String,
    /// What came of it.
    pub outcome: String,
}
