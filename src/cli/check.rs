//! `holdfast check`: validates machine files.

use std::path::PathBuf;

use super::Outcome;
use crate::config::{self, Machine};

/// Check machine files: unknown keys, wrong types, values out of range
///
/// Prints one line for each file; errors name file, line and column. Exit code 2 if a file is bad.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Machine files
    #[arg(required = true, value_name = "TOML")]
    pub files: Vec<PathBuf>,
}

/// Runs the command.
pub fn run(arguments: &Arguments) -> Outcome {
    let mut outcome = Outcome::Done;
    for path in &arguments.files {
        match config::load::<Machine>(path) {
            Ok(machine) => println!("{}: ok, {} ({})", path.display(), machine.id, machine.display_name()),
            Err(error) => {
                eprintln!("{error}");
                outcome = Outcome::BadConfiguration;
            }
        }
    }
    outcome
}
