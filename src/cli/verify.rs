//! `holdfast verify`: checks recordings, and counts what is missing in them.

use std::collections::BTreeSet;
use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use super::progress::{Progress, Unit};
use super::{BadArguments, Outcome, must_exist};
use crate::record::{Checker, FileState, Missing, RecordError, Stream, files_of};

/// Check recordings: checksums, indexes and counts of each file, and gaps in the numbers of the messages
///
/// Prints one line for each file, and one for each topic of a machine that lacks messages between its first and
/// its last, boot by boot; files of one folder are counted through together. Changes nothing. Exit code 0 if
/// everything is whole, 3 if something is damaged, was not closed, was given up in recovery, or is missing.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// MCAP files, folders of sessions, or the folder that holds those
    #[arg(required = true, value_name = "RECORDING")]
    pub recordings: Vec<PathBuf>,
}

/// Runs the command.
///
/// # Errors
/// A path leads nowhere, or a folder has no recordings.
pub fn run(arguments: &Arguments) -> Result<Outcome, Box<dyn Error>> {
    let mut sessions = Vec::new();
    for path in &arguments.recordings {
        must_exist(path)?;
        let found = sessions_at(path)?;
        if found.is_empty() {
            let message = format!("{}: there are no recordings (*.mcap) in it", path.display());
            return Err(BadArguments(message).into());
        }
        sessions.extend(found);
    }
    let bytes_of = |path: &PathBuf| fs::metadata(path).map_or(0, |about| about.len());
    let mut progress = Progress::new("verifying", Unit::Bytes);
    let all_bytes: u64 = sessions.iter().flatten().map(bytes_of).sum();
    let mut bytes_before = 0;
    let mut outcome = Outcome::Done;
    for files in &sessions {
        let mut checker = Checker::default();
        for path in files {
            let checked = checker.check(path, |bytes| {
                progress.show((bytes_before + bytes) as f64, all_bytes as f64);
            });
            bytes_before += bytes_of(path);
            let (line, is_whole) = match checked {
                Ok(checked) => {
                    let summary = &checked.summary;
                    let is_whole = checked.faults.is_empty() && summary.state != FileState::Truncated;
                    let mut line = format!(
                        "{}, {} messages of {}, {} chunks, {} bytes",
                        summary.state.name(),
                        summary.messages,
                        machines(&summary.machines),
                        checked.chunks,
                        summary.bytes
                    );
                    if summary.lost_bytes > 0 {
                        line.push_str(&format!(", {} bytes were given up in recovery", summary.lost_bytes));
                    }
                    if !checked.faults.is_empty() {
                        line = format!("DAMAGED: {} ({line})", checked.faults.join("; "));
                    }
                    (format!("{}: {line}", path.display()), is_whole)
                }
                Err(RecordError::Unfinished { .. }) => {
                    (format!("{}: NOT CLOSED: is being written, or needs recovery", path.display()), false)
                }
                // Says the path itself.
                Err(error) => (error.to_string(), false),
            };
            progress.say(&line)?;
            if !is_whole {
                outcome = Outcome::DataWasBad;
            }
        }
        for line in missing(&checker) {
            progress.say(&line)?;
            outcome = Outcome::DataWasBad;
        }
    }
    progress.finish();
    Ok(outcome)
}

/// One line for each stream that lacks messages, or has some twice.
fn missing(checker: &Checker) -> Vec<String> {
    let mut lines = Vec::new();
    for Missing { stream, messages, gaps } in checker.missing() {
        lines.push(format!("MISSING: {}: {messages} messages in {gaps} gaps", told(&stream)));
    }
    for (stream, messages) in checker.repeated() {
        lines.push(format!("TWICE: {}: {messages} messages", told(&stream)));
    }
    lines
}

fn told(stream: &Stream) -> String {
    let boot = stream.boot.map_or_else(|| "boot not told".to_owned(), |boot| format!("boot {boot}"));
    format!("{} of {}, {boot}", stream.topic, stream.machine)
}

fn machines(ids: &[String]) -> String {
    match ids {
        [] => "nobody".to_owned(),
        ids => ids.join(", "),
    }
}

/// The files at a path, those of a session together.
fn sessions_at(path: &Path) -> Result<Vec<Vec<PathBuf>>, Box<dyn Error>> {
    let mut sessions = vec![files_of(path)?];
    if path.is_dir() {
        let entries = || fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<_>>();
        let entries: BTreeSet<PathBuf> = entries().map_err(|error| format!("{}: {error}", path.display()))?;
        for folder in entries.iter().filter(|entry| entry.is_dir()) {
            sessions.push(files_of(folder)?);
        }
    }
    sessions.retain(|files| !files.is_empty());
    Ok(sessions)
}
