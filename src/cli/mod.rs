//! The command line: one file a command, each a set of arguments and a function that runs it.
//!
//! Results go to stdout, talk goes to stderr. Exit codes: 0 done, 1 failed, 2 bad arguments or configuration,
//! 3 finished but data was bad or lost, 130 interrupted.

// A shell: here clocks, threads and waiting are allowed.
#![allow(clippy::disallowed_methods)]

#[cfg(feature = "shells")]
mod accounts;
mod check;
#[cfg(feature = "shells")]
mod demo;
mod estimate;
mod evaluate;
mod export;
mod import;
#[cfg(feature = "shells")]
mod logging;
#[cfg(feature = "shells")]
mod machine;
mod progress;
mod realtime;
mod replay;
mod runs;
mod simulate;
#[cfg(feature = "shells")]
mod site;
mod smooth;
mod verify;

use std::error::Error;
use std::path::Path;
use std::process::ExitCode;

use clap::Parser;

use crate::config::{ConfigError, Violation};
use crate::import::ImportError;
#[cfg(feature = "shells")]
use crate::machine::{MachineError, SourceError};

/// Tells a construction site where each of its excavators is, to the centimetre, also when GNSS lets go.
#[derive(Debug, Parser)]
#[command(name = "holdfast", version, max_term_width = 110, arg_required_else_help = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    #[cfg(feature = "shells")]
    Demo(demo::Arguments),
    Simulate(simulate::Arguments),
    Estimate(estimate::Arguments),
    Evaluate(evaluate::Arguments),
    Smooth(smooth::Arguments),
    Import(import::Arguments),
    Export(export::Arguments),
    Check(check::Arguments),
    Verify(verify::Arguments),
    Replay(replay::Arguments),
    #[cfg(feature = "shells")]
    Machine(machine::Arguments),
    #[cfg(feature = "shells")]
    Site(site::Arguments),
}

/// How a command that did not fail has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All is well.
    Done,
    /// Finished, but data was bad or lost.
    DataWasBad,
    /// A configuration file was found bad.
    BadConfiguration,
    /// Somebody ended it before it was done.
    Interrupted,
}

/// Arguments that are well formed, but cannot be used: a file that is not there, a machine that is not in it.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct BadArguments(String);

/// Refuses a path where there is nothing.
fn must_exist(path: &Path) -> Result<(), BadArguments> {
    match path.try_exists() {
        Ok(true) => Ok(()),
        Ok(false) => Err(BadArguments(format!("{}: there is no such file or folder", path.display()))),
        Err(error) => Err(BadArguments(format!("{}: {error}", path.display()))),
    }
}

/// A factor of real time.
fn speed(text: &str) -> Result<f64, String> {
    let speed: f64 = text.parse().map_err(|_| format!("\"{text}\" is not a number"))?;
    if (0.01..=1000.0).contains(&speed) { Ok(speed) } else { Err("must be from 0.01 to 1000".to_owned()) }
}

/// Runs the command that the process was called with.
pub fn main() -> ExitCode {
    let arguments = CommandLine::parse();
    let result = match arguments.command {
        #[cfg(feature = "shells")]
        Command::Demo(arguments) => demo::run(arguments).map(|()| Outcome::Done),
        Command::Simulate(arguments) => simulate::run(arguments).map(|()| Outcome::Done),
        Command::Estimate(arguments) => estimate::run(arguments),
        Command::Evaluate(arguments) => evaluate::run(arguments),
        Command::Smooth(arguments) => smooth::run(arguments),
        Command::Import(arguments) => import::run(arguments),
        Command::Export(arguments) => export::run(arguments),
        Command::Check(arguments) => Ok(check::run(&arguments)),
        Command::Verify(arguments) => verify::run(&arguments),
        Command::Replay(arguments) => replay::run(arguments),
        #[cfg(feature = "shells")]
        Command::Machine(arguments) => machine::run(arguments).map(|()| Outcome::Done),
        #[cfg(feature = "shells")]
        Command::Site(arguments) => site::run(arguments).map(|()| Outcome::Done),
    };
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::BadConfiguration) => ExitCode::from(2),
        Ok(Outcome::DataWasBad) => ExitCode::from(3),
        // As shells say it of whom Ctrl-C has ended.
        Ok(Outcome::Interrupted) => ExitCode::from(130),
        Err(error) => {
            eprintln!("holdfast: {error}");
            exit_code(error.as_ref())
        }
    }
}

fn exit_code(error: &(dyn Error + 'static)) -> ExitCode {
    let mut cause = Some(error);
    while let Some(error) = cause {
        #[cfg(feature = "shells")]
        if let Some(MachineError::Source(SourceError::NotRecorded { .. })) = error.downcast_ref() {
            return ExitCode::from(2);
        }
        if let Some(ImportError::Nothing { .. }) = error.downcast_ref() {
            return ExitCode::from(2);
        }
        if error.is::<ConfigError>() || error.is::<Violation>() || error.is::<BadArguments>() {
            return ExitCode::from(2);
        }
        cause = error.source();
    }
    ExitCode::FAILURE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_is_a_sensible_number() {
        assert_eq!(speed("2.5"), Ok(2.5));
        for text in ["0", "-1", "NaN", "inf", "fast"] {
            assert!(speed(text).is_err(), "{text}");
        }
    }
}
