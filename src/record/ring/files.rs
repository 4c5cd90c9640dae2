//! What an earlier run left behind.

use std::path::Path;

use mcap::records::{Metadata, Record};

use super::reader::Contents;
use super::{COUNTED_FROM, HELD, HeldFile, Numbers, RingOptions, Runs};
use crate::record::recover::file_end;
use crate::record::scan::Scanner;
use crate::record::{RecordError, file_error, recover};
use crate::wire::Topic;

/// The files of a folder, oldest first, and the number that the next one has: nothing there has it. Those that
/// were torn are recovered.
pub(super) fn read(options: &RingOptions) -> Result<(Vec<HeldFile>, u64), RecordError> {
    let folder = &options.folder;
    let cannot = file_error(folder, "cannot be read");
    let mut files = Vec::new();
    let mut next = 0;
    for entry in std::fs::read_dir(folder).map_err(&cannot)? {
        let entry = entry.map_err(&cannot)?;
        let name = entry.file_name().into_string().unwrap_or_default();
        let Some((number, rest)) = name.split_once('-') else { continue };
        let Ok(number) = number.parse::<u64>() else { continue };
        // Whatever it is: what has a number of ours is not written over.
        next = next.max(number.saturating_add(1));
        let Some(Ok(boot)) = rest.strip_suffix(".mcap").map(str::parse) else { continue };
        let path = entry.path();
        // On a full disk it stays torn, and is read as it is.
        if recover(&path).is_ok_and(|summary| summary.messages == 0) {
            // If it stays it holds nothing.
            let _ = std::fs::remove_file(&path);
            continue;
        }
        let held = match look(&path, &options.machine) {
            Ok(held) => Some(held),
            // It stays where it is, for somebody to look at.
            Err(RecordError::NotMcap { .. }) => continue,
            Err(_) => None,
        };
        let is_read = held.is_some();
        let unknown = || (Runs::new(), Numbers::new(), entry.metadata().map_or(0, |about| about.len()));
        let (runs, counted_from, bytes) = held.unwrap_or_else(unknown);
        files.push(HeldFile { number, path, boot, runs, counted_from, is_read, bytes });
    }
    files.sort_by_key(|file| file.number);
    Ok((files, next))
}

/// First and last number of each topic, what was counted before, and how many bytes are whole: as the file says, or
/// as is found by reading it.
fn look(path: &Path, machine: &str) -> Result<(Runs, Numbers, u64), RecordError> {
    if let Some(end) = file_end(path)? {
        let mut scanner = Scanner::open(path)?;
        scanner.seek(end.summary_start)?;
        let (mut held, mut counted_from) = (None, None);
        while let Some(records) = scanner.next_block()? {
            for record in records {
                match record {
                    Record::MetadataIndex(index) if index.name == HELD => held = Some(index.offset),
                    Record::MetadataIndex(index) if index.name == COUNTED_FROM => {
                        counted_from.get_or_insert(index.offset);
                    }
                    _ => {}
                }
            }
        }
        if let (Some(held), Some(counted_from)) = (held, counted_from) {
            let counted_from = metadata(&mut scanner, counted_from, |number| number.parse().ok())?;
            return Ok((metadata(&mut scanner, held, run_of)?, counted_from, end.bytes));
        }
    }
    let mut contents = Contents::new(path, machine);
    contents.read_on(u64::MAX)?;
    let bytes = file_end(path)?.map_or(contents.read_to, |end| end.bytes);
    Ok((contents.runs(), contents.counted_from, bytes))
}

/// What a metadata record says of each topic.
fn metadata<T>(
    scanner: &mut Scanner,
    at: u64,
    read: impl Fn(&str) -> Option<T>,
) -> Result<std::collections::BTreeMap<Topic, T>, RecordError> {
    scanner.seek(at)?;
    let records = scanner.next_block()?.unwrap_or_default();
    let told = records.into_iter().find_map(|record| match record {
        Record::Metadata(Metadata { metadata, .. }) => Some(metadata),
        _ => None,
    });
    let told = told.unwrap_or_default();
    Ok(told.iter().filter_map(|(topic, text)| Some((Topic::from_name(topic)?, read(text)?))).collect())
}

fn run_of(run: &str) -> Option<(u64, u64)> {
    let (first, last) = run.split_once(' ')?;
    Some((first.parse().ok()?, last.parse().ok()?))
}
