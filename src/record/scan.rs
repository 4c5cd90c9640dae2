//! Walks a file record by record, and says where it ends to be whole.
//!
//! The library's readers stop at the first thing that is wrong; a recovery must go on after a damaged chunk,
//! must know which bytes it gave up, and must not believe a length that the file does not have.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::MAGIC;
use mcap::read::parse_record;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::{RecordError, file_error};

/// Opcode and length.
pub(super) const RECORD_HEAD_BYTES: u64 = 9;
/// A chunk that claims to unpack to more is taken for damaged.
const CHUNK_UNPACKED_BYTES_MAX: u64 = 1 << 30;

/// Reads records in the order of the file; chunks are unpacked.
pub(super) struct Scanner {
    path: PathBuf,
    file: BufReader<File>,
    at: u64,
    length: u64,
    ended: bool,
    /// What was found to be wrong so far.
    pub(super) damage: Damage,
}

/// What is wrong with a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Damage {
    /// Bytes at the end that are no whole record.
    pub(super) torn_bytes: u64,
    /// Whether those bytes, or a damaged chunk, may have held messages.
    pub(super) messages_lost: bool,
    /// Bytes of chunks that cannot be unpacked.
    pub(super) damaged_bytes: u64,
    /// Whether the data section was closed.
    pub(super) data_ended: bool,
}

/// A record as it lies in a file.
pub(super) struct Raw {
    pub(super) opcode: u8,
    pub(super) body: Vec<u8>,
    /// Where its head begins.
    pub(super) at: u64,
}

impl Raw {
    /// Where the next record begins.
    pub(super) fn end(&self) -> u64 {
        self.at + self.length()
    }

    /// With its head.
    pub(super) fn length(&self) -> u64 {
        RECORD_HEAD_BYTES + self.body.len() as u64
    }
}

/// The records of a chunk, each with its place in the unpacked chunk; `None` if the chunk is damaged. Its
/// checksum is looked at before its records: the library believes the lengths in them.
pub(super) fn unpack(chunk: &Raw) -> Option<Vec<(u64, Record<'static>)>> {
    let Ok(Record::Chunk { header, data }) = parse_record(chunk.opcode, &chunk.body) else { return None };
    let unpacked_bytes = header.uncompressed_size;
    if unpacked_bytes > CHUNK_UNPACKED_BYTES_MAX || header.compressed_size != data.len() as u64 {
        return None;
    }
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit((unpacked_bytes as usize).max(chunk.body.len()));
    let mut reader = LinearReader::new_with_options(options);
    let head = reader.insert(RECORD_HEAD_BYTES as usize);
    head[0] = chunk.opcode;
    head[1..].copy_from_slice(&(chunk.body.len() as u64).to_le_bytes());
    reader.notify_read(RECORD_HEAD_BYTES as usize);
    let mut left = chunk.body.as_slice();
    let mut records = Vec::new();
    let mut at = 0;
    while at < unpacked_bytes {
        match reader.next_event()?.ok()? {
            LinearReadEvent::ReadRequest(_) if left.is_empty() => return None,
            LinearReadEvent::ReadRequest(wanted) => {
                let (part, rest) = left.split_at(wanted.min(left.len()));
                reader.insert(part.len()).copy_from_slice(part);
                reader.notify_read(part.len());
                left = rest;
            }
            LinearReadEvent::Record { data, opcode } => {
                records.push((at, parse_record(opcode, data).ok()?.into_owned()));
                at += RECORD_HEAD_BYTES + data.len() as u64;
            }
        }
    }
    (at == unpacked_bytes).then_some(records)
}

impl Scanner {
    /// Opens a file that begins as an MCAP file does; one that was cut within its first eight bytes counts.
    pub(super) fn open(path: &Path) -> Result<Self, RecordError> {
        let file = File::open(path).map_err(file_error(path, "cannot be opened"))?;
        let length = file.metadata().map_err(file_error(path, "has no length"))?.len();
        let mut file = BufReader::with_capacity(1 << 16, file);
        let magic_bytes = length.min(MAGIC.len() as u64);
        let mut magic = vec![0; magic_bytes as usize];
        file.read_exact(&mut magic).map_err(file_error(path, "cannot be read"))?;
        if !MAGIC.starts_with(&magic) {
            return Err(RecordError::NotMcap { path: path.to_owned() });
        }
        let mut damage = Damage::default();
        if length < MAGIC.len() as u64 {
            damage.torn_bytes = length;
        }
        let ended = length <= MAGIC.len() as u64;
        Ok(Self { path: path.to_owned(), file, at: magic_bytes, length, ended, damage })
    }

    /// How many bytes of the file are behind.
    pub(super) fn at(&self) -> u64 {
        self.at
    }

    /// Goes on at a byte of the file, where a record must begin. The file may have changed since it was opened:
    /// somebody may be writing it.
    pub(super) fn seek(&mut self, at: u64) -> Result<(), RecordError> {
        let read = file_error(&self.path, "cannot be read");
        self.length = self.file.get_ref().metadata().map_err(&read)?.len();
        if at > self.length {
            return Err(read(std::io::ErrorKind::UnexpectedEof.into()));
        }
        self.file.seek(SeekFrom::Start(at)).map_err(&read)?;
        self.at = at;
        self.ended = false;
        Ok(())
    }

    /// The records of the next chunk, or the next record that stands alone; `None` at the footer or where the
    /// file is torn.
    pub(super) fn next_block(&mut self) -> Result<Option<Vec<Record<'static>>>, RecordError> {
        while !self.ended {
            let Some(raw) = self.next_raw()? else { break };
            let Ok(record) = parse_record(raw.opcode, &raw.body) else {
                self.damaged(raw.opcode, raw.body.len());
                continue;
            };
            match record {
                Record::Chunk { .. } => match unpack(&raw) {
                    Some(records) => {
                        return Ok(Some(records.into_iter().map(|(_, record)| record).collect()));
                    }
                    None => self.damaged(op::CHUNK, raw.body.len()),
                },
                Record::Footer(_) => self.ended = true,
                record => {
                    self.damage.data_ended |= matches!(record, Record::DataEnd(_));
                    return Ok(Some(vec![record.into_owned()]));
                }
            }
        }
        self.ended = true;
        Ok(None)
    }

    /// The next record as it lies in the file, the footer too; `None` where the file is torn or ends.
    pub(super) fn next_raw(&mut self) -> Result<Option<Raw>, RecordError> {
        if self.ended {
            return Ok(None);
        }
        let left = self.length - self.at;
        let mut head = [0; RECORD_HEAD_BYTES as usize];
        let head_bytes = left.min(RECORD_HEAD_BYTES) as usize;
        let read = file_error(&self.path, "cannot be read");
        self.file.read_exact(&mut head[..head_bytes]).map_err(&read)?;
        let opcode = head[0];
        let mut body_bytes = [0; 8];
        body_bytes.copy_from_slice(&head[1..]);
        let body_bytes = u64::from_le_bytes(body_bytes);
        // Zero is no opcode: some file systems leave zeros where a power cut kept data from being written.
        if left < RECORD_HEAD_BYTES || opcode == 0 || body_bytes > left - RECORD_HEAD_BYTES {
            self.damage.torn_bytes = left;
            self.damage.messages_lost |= left > 0 && may_hold_messages(opcode);
            self.ended = true;
            return Ok(None);
        }
        let mut body = vec![0; body_bytes as usize];
        self.file.read_exact(&mut body).map_err(&read)?;
        let at = self.at;
        self.at += RECORD_HEAD_BYTES + body_bytes;
        Ok(Some(Raw { opcode, body, at }))
    }

    fn damaged(&mut self, opcode: u8, bytes: usize) {
        self.damage.damaged_bytes += bytes as u64 + RECORD_HEAD_BYTES;
        self.damage.messages_lost |= may_hold_messages(opcode);
    }
}

/// Whether messages, or what is needed to read them, are lost with such a record.
fn may_hold_messages(opcode: u8) -> bool {
    matches!(opcode, 0 | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK | op::ATTACHMENT)
}
