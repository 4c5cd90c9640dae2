//! Makes a proper file of one whose writer died.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::MAGIC;
use mcap::read::parse_record;
use mcap::records::{Metadata, Record, op};

use super::scan::Scanner;
use super::write::{FileWriter, create, finish};
use super::{FileState, RECOVERY, RecordError, Summary};
use super::{file_error, mcap_error, parse_channel_name, stamp_of, sync_folder_of};

/// Opcode, length and body of the footer.
const FOOTER_BYTES: u64 = 9 + 20;

/// What a finished file says of itself; its messages are not read.
///
/// # Errors
/// [`RecordError::Unfinished`] if it was not closed; others if it cannot be read or is no MCAP file.
pub fn inspect(path: &Path) -> Result<Summary, RecordError> {
    let mut scanner = Scanner::open(path)?;
    let unfinished = || RecordError::Unfinished { path: path.to_owned() };
    let (bytes, summary_start) = summary_start(path)?.ok_or_else(unfinished)?;
    let mut summary = Summary {
        state: FileState::Complete,
        messages: 0,
        bytes,
        span: None,
        machines: Vec::new(),
        lost_bytes: 0,
    };
    let mut machines = BTreeSet::new();
    let mut recovery_at = None;
    scanner.seek(summary_start)?;
    while let Some(records) = scanner.next_block()? {
        for record in records {
            match record {
                Record::Statistics(statistics) => {
                    summary.messages = statistics.message_count;
                    let span = (statistics.message_start_time, statistics.message_end_time);
                    summary.span =
                        (statistics.message_count > 0).then(|| (stamp_of(span.0), stamp_of(span.1)));
                }
                Record::Channel(channel) => {
                    machines
                        .extend(parse_channel_name(&channel.topic).map(|(machine, _)| machine.to_owned()));
                }
                Record::MetadataIndex(index) if index.name == RECOVERY => recovery_at = Some(index.offset),
                _ => {}
            }
        }
    }
    if scanner.damage.torn_bytes > 0 {
        return Err(unfinished());
    }
    if let Some(at) = recovery_at {
        scanner.seek(at)?;
        for record in scanner.next_block()?.unwrap_or_default() {
            if let Record::Metadata(Metadata { metadata, .. }) = record {
                let state = metadata.get("state").and_then(|state| FileState::from_name(state));
                summary.state = state.unwrap_or(FileState::Truncated);
                let lost = metadata.get("lost_bytes").and_then(|bytes| bytes.parse().ok());
                summary.lost_bytes = lost.unwrap_or(0);
            }
        }
    }
    summary.machines = machines.into_iter().collect();
    Ok(summary)
}

/// Length of the file and where its summary starts, if the file ends as it should.
pub(super) fn summary_start(path: &Path) -> Result<Option<(u64, u64)>, RecordError> {
    let read = file_error(path, "cannot be read");
    let mut file = File::open(path).map_err(&read)?;
    let length = file.metadata().map_err(&read)?.len();
    let tail_bytes = FOOTER_BYTES + MAGIC.len() as u64;
    if length < tail_bytes + MAGIC.len() as u64 {
        return Ok(None);
    }
    let mut tail = vec![0; tail_bytes as usize];
    file.seek(SeekFrom::Start(length - tail_bytes)).map_err(&read)?;
    file.read_exact(&mut tail).map_err(&read)?;
    let (footer, magic) = tail.split_at(FOOTER_BYTES as usize);
    if magic != MAGIC || footer[0] != op::FOOTER {
        return Ok(None);
    }
    match parse_record(op::FOOTER, &footer[9..]) {
        Ok(Record::Footer(footer)) if (1..length - tail_bytes).contains(&footer.summary_start) => {
            Ok(Some((length, footer.summary_start)))
        }
        _ => Ok(None),
    }
}

/// Leaves a finished file alone; of a torn one, writes what is whole into a proper file beside it, counts
/// that, and puts it in the torn one's place in one step. A crash at any moment leaves the one or the other.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or written, or is no MCAP file; the torn file is kept then.
pub fn recover(path: &Path) -> Result<Summary, RecordError> {
    match inspect(path) {
        Err(RecordError::Unfinished { .. }) => {}
        done => return done,
    }
    let mut beside = path.as_os_str().to_owned();
    beside.push(".recovering");
    let beside = PathBuf::from(beside);
    let rewritten = rewrite(path, &beside).and_then(|written| {
        let summary = inspect(&beside)?;
        let found = count(&beside)?;
        if found != written || summary.messages != written {
            return Err(RecordError::Miscounted { path: path.to_owned(), written, found });
        }
        std::fs::rename(&beside, path).map_err(file_error(path, "cannot be replaced"))?;
        sync_folder_of(path)?;
        Ok(summary)
    });
    if rewritten.is_err() {
        // What is wrong is told already; a leftover is overwritten by the next recovery.
        let _ = std::fs::remove_file(&beside);
    }
    rewritten
}

fn rewrite(torn: &Path, beside: &Path) -> Result<u64, RecordError> {
    let mut scanner = Scanner::open(torn)?;
    let (mut writer, file) = create(beside)?;
    let mut written = 0;
    let mut schemas = BTreeMap::new();
    let mut channels = BTreeMap::new();
    while let Some(records) = scanner.next_block()? {
        // After the data comes the summary, which is written anew.
        if scanner.damage.data_ended {
            continue;
        }
        for record in records {
            let copied = copy(record, &mut writer, &mut schemas, &mut channels);
            written += u64::from(copied.map_err(mcap_error(beside, "cannot be written"))?);
        }
    }
    let damage = scanner.damage;
    let state = if damage.messages_lost { FileState::Truncated } else { FileState::Recovered };
    let lost_bytes = damage.torn_bytes + damage.damaged_bytes;
    let entries = BTreeMap::from([
        ("state".to_owned(), state.name().to_owned()),
        ("lost_bytes".to_owned(), lost_bytes.to_string()),
        ("messages".to_owned(), written.to_string()),
    ]);
    let note = Metadata { name: RECOVERY.to_owned(), metadata: entries };
    writer.write_metadata(&note).map_err(mcap_error(beside, "cannot be written"))?;
    finish(&mut writer, &file, beside)?;
    Ok(written)
}

/// Copies a record; true if it was a message. Ids are given anew, for a damaged chunk may have taken some
/// of the definitions along; messages whose channel is lost are lost.
fn copy(
    record: Record<'static>,
    writer: &mut FileWriter,
    schemas: &mut BTreeMap<u16, u16>,
    channels: &mut BTreeMap<u16, u16>,
) -> Result<bool, mcap::McapError> {
    match record {
        Record::Schema { header, data } => {
            let id = writer.add_schema(&header.name, &header.encoding, &data)?;
            schemas.insert(header.id, id);
        }
        Record::Channel(channel) => {
            let schema = if channel.schema_id == 0 { Some(&0) } else { schemas.get(&channel.schema_id) };
            if let Some(schema) = schema {
                let id = writer.add_channel(
                    *schema,
                    &channel.topic,
                    &channel.message_encoding,
                    &channel.metadata,
                )?;
                channels.insert(channel.id, id);
            }
        }
        Record::Message { mut header, data } => {
            if let Some(id) = channels.get(&header.channel_id) {
                header.channel_id = *id;
                writer.write_to_known_channel(&header, &data)?;
                return Ok(true);
            }
        }
        Record::Metadata(metadata) => writer.write_metadata(&metadata)?,
        Record::Attachment { header, data, .. } => writer.attach(&mcap::Attachment {
            log_time: header.log_time,
            create_time: header.create_time,
            name: header.name,
            media_type: header.media_type,
            data,
        })?,
        _ => {}
    }
    Ok(false)
}

fn count(path: &Path) -> Result<u64, RecordError> {
    let mut scanner = Scanner::open(path)?;
    let mut messages = 0;
    while let Some(records) = scanner.next_block()? {
        messages += records.iter().filter(|record| matches!(record, Record::Message { .. })).count() as u64;
    }
    Ok(messages)
}
