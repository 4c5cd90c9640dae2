//! `holdfast site user` and `holdfast site token`: accounts and tokens, also while the server runs.

use std::error::Error;
use std::io::{IsTerminal as _, Read as _, Write as _};
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use crate::accounts::{Accounts, AccountsError, Change, Password, Role, TOKEN_DAYS_MAX, User};
use crate::config;
use crate::time::{Span, Stamp};

/// Nobody types a longer password.
const PASSWORD_BYTES_MAX: u64 = 4096;

/// Which site's accounts.
#[derive(Debug, clap::Args)]
pub struct Place {
    /// Site file, which says where its data are
    #[arg(long, value_name = "TOML", conflicts_with = "data")]
    config: Option<PathBuf>,
    /// Where the site's data are
    #[arg(long, value_name = "DIR", default_value = "holdfast-data")]
    data: PathBuf,
}

/// What is to be done with accounts.
#[derive(Debug, clap::Subcommand)]
pub enum UserCommand {
    /// Make an account; as soon as there is one, the site asks who is there
    Add {
        /// By which it signs in: letters, digits, '.', '_', '@' and '-'
        name: String,
        /// What it may do: viewer, operator or admin
        #[arg(long, value_parser = role, default_value = "viewer")]
        role: Role,
        #[command(flatten)]
        typing: Typing,
        #[command(flatten)]
        place: Place,
    },
    /// Remove an account with its tokens and sign-ins
    Remove {
        /// Of the account
        name: String,
        #[command(flatten)]
        place: Place,
    },
    /// List all accounts: name and role
    List {
        #[command(flatten)]
        place: Place,
    },
    /// Give an account another password, and end its sign-ins
    Password {
        /// Of the account
        name: String,
        #[command(flatten)]
        typing: Typing,
        #[command(flatten)]
        place: Place,
    },
    /// Give an account another role
    Role {
        /// Of the account
        name: String,
        /// What it may do: viewer, operator or admin
        #[arg(value_parser = role)]
        role: Role,
        #[command(flatten)]
        place: Place,
    },
}

/// Where a password comes from.
#[derive(Debug, clap::Args)]
pub struct Typing {
    /// Read the password from stdin to its end, instead of asking for it; a line break at the end is none of it
    #[arg(long)]
    password_stdin: bool,
}

/// What is to be done with tokens.
#[derive(Debug, clap::Subcommand)]
pub enum TokenCommand {
    /// Make a token for a program, and print it: this once
    Add {
        /// What it is for
        label: String,
        /// Whose it is: it may not do more than that account, and goes with it
        #[arg(long, value_name = "NAME")]
        user: String,
        /// What it may do: viewer, operator or admin
        #[arg(long, value_parser = role, default_value = "viewer")]
        role: Role,
        /// It is good for so many days
        #[arg(long, default_value_t = 90, value_parser = clap::value_parser!(u32).range(1..=i64::from(TOKEN_DAYS_MAX)))]
        days: u32,
        #[command(flatten)]
        place: Place,
    },
    /// List tokens: id, account, role, when it expires, what it is for
    List {
        /// Only of this account
        #[arg(long, value_name = "NAME")]
        user: Option<String>,
        #[command(flatten)]
        place: Place,
    },
    /// Revoke a token
    Revoke {
        /// As the list has it
        id: String,
        #[command(flatten)]
        place: Place,
    },
}

fn role(text: &str) -> Result<Role, String> {
    Role::from_name(text).ok_or_else(|| "must be viewer, operator or admin".to_owned())
}

/// Does it to accounts.
///
/// # Errors
/// It cannot be done: there is no such account, the password is none, the file cannot be written.
pub fn run_user(command: UserCommand) -> Result<(), Box<dyn Error>> {
    match command {
        UserCommand::Add { name, role, typing, place } => {
            let accounts = place.accounts()?;
            let is_first = !accounts.exist()?;
            let password = typing.password(&name)?;
            accounts.add_user(&name, role, &password, now())?;
            accounts.noted(&format!("user add {name} as {}", role.name()))?;
            let asks = if is_first { "; the site asks who is there from now on" } else { "" };
            say(&format!("{name} is {} in {}{asks}", role.name(), accounts.path().display()));
            if is_first && role != Role::Admin {
                say("this account cannot make others: holdfast site user role NAME admin");
            }
        }
        UserCommand::Remove { name, place } => {
            let accounts = place.accounts()?;
            accounts.remove_user(&name, false)?;
            accounts.noted(&format!("user remove {name}"))?;
            say(&format!("{name} is gone"));
            if !accounts.exist()? {
                say(
                    "there are no accounts any more: on loopback, nobody is asked; elsewhere, nobody gets in",
                );
            } else if !accounts.users()?.iter().any(|user| user.role == Role::Admin) {
                say("no admin is left: holdfast site user role NAME admin");
            }
        }
        UserCommand::List { place } => {
            let users = place.accounts()?.users()?;
            let lines = users.iter().map(|User { name, role, .. }| format!("{name}\t{}\n", role.name()));
            print(&lines.collect::<String>());
        }
        UserCommand::Password { name, typing, place } => {
            let accounts = place.accounts()?;
            let name = accounts.user(&name)?.name;
            let password = typing.password(&name)?;
            accounts.set_password(&name, &password)?;
            accounts.noted(&format!("user password {name}"))?;
            say(&format!("{name} has another password, and is signed out everywhere"));
        }
        UserCommand::Role { name, role, place } => {
            let accounts = place.accounts()?;
            accounts.set_role(&name, role, false)?;
            accounts.noted(&format!("user role {name} {}", role.name()))?;
            say(&format!("{name} is {}", role.name()));
        }
    }
    Ok(())
}

/// Does it to tokens.
///
/// # Errors
/// It cannot be done: there is no such account or token, the file cannot be written.
pub fn run_token(command: TokenCommand) -> Result<(), Box<dyn Error>> {
    match command {
        TokenCommand::Add { label, user, role, days, place } => {
            let accounts = place.accounts()?;
            let now = now();
            let expires = now + Span::from_seconds(86_400.0 * f64::from(days));
            let (token, secret) = accounts.add_token(&user, &label, role, expires, now)?;
            accounts.noted(&format!("token add {} of {}: {label}", token.id, token.user))?;
            let (id, role) = (&token.id, token.role.name());
            say(&format!("token {id} of {}, {role}, for {days} days; it is shown this once:", token.user));
            print(&format!("{}\n", secret.reveal()));
        }
        TokenCommand::List { user, place } => {
            let tokens = place.accounts()?.tokens(user.as_deref())?;
            let lines = tokens.iter().map(|token| {
                let expires = crate::fleet::UtcTime(token.expires);
                format!("{}\t{}\t{}\t{expires}\t{}\n", token.id, token.user, token.role.name(), token.label)
            });
            print(&lines.collect::<String>());
        }
        TokenCommand::Revoke { id, place } => {
            let accounts = place.accounts()?;
            accounts.revoke_token(&id, None)?;
            accounts.noted(&format!("token revoke {id}"))?;
            say(&format!("token {id} is good no more"));
        }
    }
    Ok(())
}

impl Place {
    fn accounts(&self) -> Result<Accounts, Box<dyn Error>> {
        let directory = match &self.config {
            Some(config) => config::load::<config::Site>(config)?.record.directory,
            None => self.data.clone(),
        };
        Ok(Accounts::of(&directory)?)
    }
}

impl Accounts {
    /// Writes what was done here into the book of changes.
    fn noted(&self, what: &str) -> Result<(), AccountsError> {
        let change = Change {
            time: now(),
            via: "command_line".to_owned(),
            what: what.to_owned(),
            outcome: "done".to_owned(),
            ..Change::default()
        };
        self.note(&change)
    }
}

impl Typing {
    /// The password: from stdin, or typed twice at the terminal, which does not show it.
    fn password(&self, name: &str) -> Result<Password, Box<dyn Error>> {
        if self.password_stdin {
            let mut text = String::new();
            std::io::stdin().take(PASSWORD_BYTES_MAX).read_to_string(&mut text)?;
            let line = text.strip_suffix('\n').unwrap_or(&text);
            return Ok(Password::new(line.strip_suffix('\r').unwrap_or(line).to_owned()));
        }
        if !std::io::stdin().is_terminal() {
            return Err("there is no terminal to ask for the password: use --password-stdin".into());
        }
        let first = rpassword::prompt_password(format!("Password of {name}: "))?;
        let second = rpassword::prompt_password("The same again: ")?;
        if first == second { Ok(Password::new(first)) } else { Err("those are two passwords".into()) }
    }
}

fn say(text: &str) {
    eprintln!("{text}");
}

fn print(text: &str) {
    // Whoever started us may have stopped reading; that is no reason to fail.
    let _ = std::io::stdout().write_all(text.as_bytes());
}

fn now() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Stamp::from_nanos(i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX))
}
