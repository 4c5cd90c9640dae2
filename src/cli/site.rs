//! `holdfast site`: the site server.

use std::error::Error;
use std::io::Write as _;
use std::net::SocketAddr;
use std::path::PathBuf;

use tokio::signal::unix::{SignalKind, signal};

use super::accounts::{self, TokenCommand, UserCommand};
use super::logging;
use crate::config;
use crate::site::Site;

/// Run the site server: machines dial in, people look at the page
///
/// Serves the page and the API, and records everything that the machines send. Prints the address of the page
/// and the Zenoh endpoints for the machines, then runs until Ctrl-C or SIGTERM; the recording is closed then.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct Arguments {
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Site file, such as config/site.toml
    #[arg(long, value_name = "TOML", required = true)]
    pub config: Option<PathBuf>,
    /// Address of page and API, instead of the site file's; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT")]
    pub listen: Option<SocketAddr>,
    /// Where recordings go, instead of the site file's
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
}

/// What else there is to do for a site.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Accounts: who may look, operate, administer
    #[command(subcommand)]
    User(UserCommand),
    /// Tokens with which programs use the API
    #[command(subcommand)]
    Token(TokenCommand),
}

/// Runs the command.
///
/// # Errors
/// The configuration cannot be used, or an address or the data folder cannot.
pub fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    match arguments.command {
        Some(Command::User(command)) => return accounts::run_user(command),
        Some(Command::Token(command)) => return accounts::run_token(command),
        None => {}
    }
    let file = arguments.config.ok_or("which site? --config TOML")?;
    let mut config: config::Site = config::load(&file)?;
    config.http.listen = arguments.listen.unwrap_or(config.http.listen);
    config.record.directory = arguments.data.unwrap_or(config.record.directory);
    logging::start();
    // Zenoh refuses to run on a runtime of one thread.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("site")
        .enable_all()
        .build()?;
    runtime.block_on(serve(&config))
}

async fn serve(config: &config::Site) -> Result<(), Box<dyn Error>> {
    // Before anything starts, so that an early signal ends it in order.
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let site = Site::start(config).await?;
    let mut said = format!("dashboard http://{}/\n", site.address());
    for endpoint in site.endpoints() {
        said.push_str(&format!("zenoh {endpoint}\n"));
    }
    // Whoever started us may have stopped reading; that is no reason to end.
    let _ = std::io::stdout().write_all(said.as_bytes());
    tokio::select! {
        _ = terminate.recv() => {}
        _ = interrupt.recv() => {}
    }
    site.stop().await;
    Ok(())
}
