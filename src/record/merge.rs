//! Several files of a session as one: their data one after the other, and one index for all. Nothing is copied
//! until it is read, and no chunk is opened.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::read::parse_record;
use mcap::records::{Record, Statistics, SummaryOffset, op};

use super::recover::{End, file_end};
use super::scan::{RECORD_HEAD_BYTES, Scanner};
use super::{RecordError, encode, file_error};

/// Opcode, length and body of the end of the data.
const DATA_END_BYTES: u64 = RECORD_HEAD_BYTES + 4;

/// A part of a file that is made of several.
#[derive(Clone, Debug)]
pub enum Piece {
    /// As they are.
    Bytes(Vec<u8>),
    /// Out of a file.
    Of {
        /// Which file.
        path: PathBuf,
        /// From which byte on.
        start: u64,
        /// So many.
        bytes: u64,
    },
    /// Index records out of a file, whose data have moved.
    Moved {
        /// Which file.
        path: PathBuf,
        /// From which byte on.
        start: u64,
        /// So many.
        bytes: u64,
        /// How far.
        by: i64,
    },
}

impl Piece {
    /// Its length.
    pub fn bytes(&self) -> u64 {
        match self {
            Piece::Bytes(bytes) => bytes.len() as u64,
            Piece::Of { bytes, .. } | Piece::Moved { bytes, .. } => *bytes,
        }
    }

    /// All of it, in memory: for the index of one file. Data are better read in blocks.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be read.
    pub fn load(&self) -> Result<Vec<u8>, RecordError> {
        match self {
            Piece::Bytes(bytes) => Ok(bytes.clone()),
            Piece::Of { path, start, bytes } => load(path, *start, *bytes),
            Piece::Moved { path, start, bytes, by } => {
                let mut records = load(path, *start, *bytes)?;
                let damaged = || RecordError::Apart { path: path.clone(), reason: "its index is damaged" };
                shift(&mut records, *by).ok_or_else(damaged)?;
                Ok(records)
            }
        }
    }
}

/// One file out of several of one session, in the order of their numbers. `unfinished` is the one that is being
/// written, with the bytes of it that are whole; then the result has no index, as that one has none.
///
/// # Errors
/// [`RecordError::Apart`] if they do not agree on their channels; others if one cannot be read.
pub fn merge(files: &[PathBuf], unfinished: Option<(&Path, u64)>) -> Result<Vec<Piece>, RecordError> {
    let mut pieces = Vec::new();
    let mut at = 0;
    let mut summary = Merged::default();
    for path in files {
        let end = file_end(path)?.ok_or_else(|| RecordError::Unfinished { path: path.clone() })?;
        let start = data_start(path)?;
        let data_end = end.summary_start.saturating_sub(DATA_END_BYTES);
        if at == 0 {
            pieces.push(Piece::Of { path: path.clone(), start: 0, bytes: start });
            at = start;
        }
        summary.add(path, &end, at as i64 - start as i64)?;
        let bytes = data_end.saturating_sub(start);
        pieces.push(Piece::Of { path: path.clone(), start, bytes });
        at += bytes;
    }
    match unfinished {
        Some((path, whole)) => {
            let start = if at == 0 { 0 } else { data_start(path)? };
            pieces.push(Piece::Of { path: path.to_owned(), start, bytes: whole.saturating_sub(start) });
        }
        None => pieces.extend(summary.end(at)),
    }
    Ok(pieces)
}

/// The summaries of several files.
#[derive(Default)]
struct Merged {
    /// Their records, as they will stand.
    schemas: BTreeMap<u16, Vec<u8>>,
    channels: BTreeMap<u16, Vec<u8>>,
    statistics: Option<Statistics>,
    chunks: Vec<Piece>,
    attachments: Vec<Piece>,
    metadata: Vec<Piece>,
}

impl Merged {
    fn add(&mut self, path: &Path, end: &End, by: i64) -> Result<(), RecordError> {
        let apart = |reason| RecordError::Apart { path: path.to_owned(), reason };
        if end.offsets_start == 0 {
            return Err(apart("its index has no index"));
        }
        let mut scanner = Scanner::open(path)?;
        scanner.seek(end.offsets_start)?;
        let mut groups = Vec::new();
        while let Some(records) = scanner.next_block()? {
            groups.extend(records.into_iter().filter_map(|record| match record {
                Record::SummaryOffset(offset) => Some(offset),
                _ => None,
            }));
        }
        for SummaryOffset { group_opcode, group_start: start, group_length: bytes } in groups {
            let moved = Piece::Moved { path: path.to_owned(), start, bytes, by };
            match group_opcode {
                op::CHUNK_INDEX => self.chunks.push(moved),
                op::ATTACHMENT_INDEX => self.attachments.push(moved),
                op::METADATA_INDEX => self.metadata.push(moved),
                op::SCHEMA | op::CHANNEL | op::STATISTICS => {
                    self.define(&load(path, start, bytes)?).map_err(apart)?;
                }
                _ => return Err(apart("its index has something unknown")),
            }
        }
        Ok(())
    }

    fn define(&mut self, records: &[u8]) -> Result<(), &'static str> {
        for (opcode, body) in split(records) {
            let record =
                body.and_then(|body| parse_record(opcode, body).ok()).ok_or("its index is damaged")?;
            let mut bytes = Vec::new();
            let before = match record {
                Record::Schema { header, data } => {
                    encode::schema(&mut bytes, &header, &data);
                    self.schemas.insert(header.id, bytes.clone())
                }
                Record::Channel(channel) => {
                    encode::channel(&mut bytes, &channel);
                    self.channels.insert(channel.id, bytes.clone())
                }
                Record::Statistics(statistics) => {
                    self.count(statistics);
                    None
                }
                _ => None,
            };
            if before.is_some_and(|before| before != bytes) {
                return Err("its channels have other numbers than those of the file before");
            }
        }
        Ok(())
    }

    fn count(&mut self, more: Statistics) {
        let Some(all) = &mut self.statistics else {
            self.statistics = Some(more);
            return;
        };
        if more.message_count > 0 {
            let (start, end) = (more.message_start_time, more.message_end_time);
            let first = all.message_count == 0;
            all.message_start_time = if first { start } else { all.message_start_time.min(start) };
            all.message_end_time = if first { end } else { all.message_end_time.max(end) };
        }
        all.message_count += more.message_count;
        all.attachment_count += more.attachment_count;
        all.metadata_count += more.metadata_count;
        all.chunk_count += more.chunk_count;
        for (channel, count) in more.channel_message_counts {
            *all.channel_message_counts.entry(channel).or_default() += count;
        }
    }

    /// What comes after data that end at `at`.
    fn end(self, at: u64) -> Vec<Piece> {
        let mut data_end = Vec::new();
        encode::data_end(&mut data_end, 0);
        let summary_start = at + data_end.len() as u64;
        let mut statistics = Vec::new();
        if let Some(mut all) = self.statistics {
            all.schema_count = self.schemas.len() as u16;
            all.channel_count = self.channels.len() as u32;
            encode::statistics(&mut statistics, &all);
        }
        let bytes =
            |records: BTreeMap<u16, Vec<u8>>| vec![Piece::Bytes(records.into_values().flatten().collect())];
        let groups = [
            (op::SCHEMA, bytes(self.schemas)),
            (op::CHANNEL, bytes(self.channels)),
            (op::STATISTICS, vec![Piece::Bytes(statistics)]),
            (op::CHUNK_INDEX, self.chunks),
            (op::ATTACHMENT_INDEX, self.attachments),
            (op::METADATA_INDEX, self.metadata),
        ];
        let mut pieces = vec![Piece::Bytes(data_end)];
        let mut offsets = Vec::new();
        let mut group_start = summary_start;
        for (group_opcode, group) in groups {
            let group_length: u64 = group.iter().map(Piece::bytes).sum();
            if group_length > 0 {
                encode::summary_offset(
                    &mut offsets,
                    &SummaryOffset { group_opcode, group_start, group_length },
                );
            }
            group_start += group_length;
            pieces.extend(group);
        }
        encode::end(&mut offsets, summary_start, group_start, None);
        pieces.push(Piece::Bytes(offsets));
        pieces
    }
}

/// Where the records after the header begin.
fn data_start(path: &Path) -> Result<u64, RecordError> {
    let mut scanner = Scanner::open(path)?;
    match scanner.next_raw()? {
        Some(raw) if raw.opcode == op::HEADER => Ok(raw.end()),
        _ => Err(RecordError::NotMcap { path: path.to_owned() }),
    }
}

fn load(path: &Path, start: u64, bytes: u64) -> Result<Vec<u8>, RecordError> {
    let read = file_error(path, "cannot be read");
    let mut file = File::open(path).map_err(&read)?;
    let length = file.metadata().map_err(&read)?.len();
    if start.checked_add(bytes).is_none_or(|end| end > length) {
        return Err(RecordError::Apart { path: path.to_owned(), reason: "its index is damaged" });
    }
    file.seek(SeekFrom::Start(start)).map_err(&read)?;
    let mut block = vec![0; bytes as usize];
    file.read_exact(&mut block).map_err(&read)?;
    Ok(block)
}

/// Opcodes and bodies of records one after the other; the last has no body if they do not end with a record.
fn split(mut bytes: &[u8]) -> impl Iterator<Item = (u8, Option<&[u8]>)> {
    std::iter::from_fn(move || {
        let opcode = *bytes.first()?;
        let body = body_range(bytes).and_then(|body| bytes.get(body));
        bytes = body.map_or(&[], |body| &bytes[RECORD_HEAD_BYTES as usize + body.len()..]);
        Some((opcode, body))
    })
}

fn body_range(record: &[u8]) -> Option<std::ops::Range<usize>> {
    let head = RECORD_HEAD_BYTES as usize;
    let length = u64::from_le_bytes(record.get(1..head)?.try_into().ok()?);
    Some(head..head.checked_add(usize::try_from(length).ok()?)?)
}

/// Changes the places in index records; `None` if they are no whole index records.
fn shift(mut records: &mut [u8], by: i64) -> Option<()> {
    while let Some(opcode) = records.first().copied() {
        let body = body_range(records)?;
        let (record, rest) = records.split_at_mut_checked(body.end)?;
        let body = &mut record[body.start..];
        match opcode {
            op::CHUNK_INDEX => {
                shift_number(body.get_mut(16..24)?, by)?;
                let map_bytes = u32::from_le_bytes(body.get(32..36)?.try_into().ok()?) as usize;
                for entry in body.get_mut(36..36 + map_bytes)?.chunks_exact_mut(10) {
                    shift_number(&mut entry[2..], by)?;
                }
            }
            op::ATTACHMENT_INDEX | op::METADATA_INDEX => shift_number(body.get_mut(..8)?, by)?,
            _ => return None,
        }
        records = rest;
    }
    Some(())
}

fn shift_number(bytes: &mut [u8], by: i64) -> Option<()> {
    let number = u64::from_le_bytes((&*bytes).try_into().ok()?).checked_add_signed(by)?;
    bytes.copy_from_slice(&number.to_le_bytes());
    Some(())
}
