//! Completes a torn file where it lies: the torn end is cut off, and an index is written in its place.
//!
//! Needs no room for a second copy, and is quick: what is whole stays where it is. A crash in between leaves
//! another torn file, which is completed at the next try. Only a file that is damaged within, not just torn at
//! its end, cannot be completed so.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

use mcap::records::MetadataIndex;

use super::gather::gather;
use super::recover::recovery_note;
use super::scan::Scanner;
use super::{RecordError, encode, file_error};

/// Completes the file; false if it is damaged within, and nothing was done.
pub(super) fn complete(path: &Path) -> Result<bool, RecordError> {
    let mut scanner = Scanner::open(path)?;
    let Ok(mut found) = gather(&mut scanner, &mut |_, _| {}, &mut |_| {})? else { return Ok(false) };
    let mut tail = Vec::new();
    if let Some(mut open) = found.unindexed {
        for (channel_id, entries) in &open.places {
            open.index.message_index_offsets.insert(*channel_id, found.end + tail.len() as u64);
            encode::message_index(&mut tail, *channel_id, entries);
        }
        open.index.message_index_length = tail.len() as u64;
        found.index.chunks.push(open.index);
    }
    let note = recovery_note(scanner.damage, found.index.messages());
    let offset = found.end + tail.len() as u64;
    encode::metadata(&mut tail, &note);
    let length = found.end + tail.len() as u64 - offset;
    found.index.metadata.push(MetadataIndex { offset, length, name: note.name });
    found.crc.update(&tail);
    let end = found.index.encode_end(found.end + tail.len() as u64, found.crc.finalize());
    tail.extend(end);

    let mut file = File::options().write(true).open(path).map_err(file_error(path, "cannot be opened"))?;
    file.set_len(found.end).map_err(file_error(path, "cannot be cut"))?;
    file.seek(SeekFrom::Start(found.end)).map_err(file_error(path, "cannot be written"))?;
    file.write_all(&tail).map_err(file_error(path, "cannot be written"))?;
    file.sync_all().map_err(file_error(path, "cannot be synced"))?;
    Ok(true)
}
