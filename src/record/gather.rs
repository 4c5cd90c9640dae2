//! Reads the data of a file once, checks it, and gathers what the index at its end must say.

use std::collections::BTreeMap;

use crc32fast::Hasher;
use mcap::MAGIC;
use mcap::read::parse_record;
use mcap::records::{AttachmentIndex, ChunkIndex, MessageHeader, Metadata, MetadataIndex, Record, op};

use super::RecordError;
use super::index::Index;
use super::scan::{Raw, Scanner, unpack};

/// Times of receiving, and places in the unpacked chunk, of each channel.
type Places = BTreeMap<u16, Vec<(u64, u64)>>;

/// The data of a file.
pub(super) struct Gathered {
    pub(super) index: Index,
    /// The last chunk, if not all of its message indexes are in the file.
    pub(super) unindexed: Option<OpenChunk>,
    /// Up to here everything is whole.
    pub(super) end: u64,
    /// Of everything up to there.
    pub(super) crc: Hasher,
    /// What the data section says of itself, if it was closed; 0 is nothing.
    pub(super) said_crc: Option<u32>,
}

/// A chunk whose message indexes may still follow.
pub(super) struct OpenChunk {
    pub(super) index: ChunkIndex,
    pub(super) places: Places,
    end: u64,
    crc: Hasher,
}

/// Reads up to the end of the data, or of what is whole; each message is handed to `visit`, and `tell` hears how
/// many bytes were read. The inner error says what is damaged within, so that what comes after cannot be taken as
/// it is.
pub(super) fn gather(
    scanner: &mut Scanner,
    visit: &mut dyn FnMut(&Index, &MessageHeader),
    tell: &mut dyn FnMut(u64),
) -> Result<Result<Gathered, String>, RecordError> {
    let mut crc = Hasher::new();
    crc.update(MAGIC);
    let mut file = Gathered { index: Index::default(), unindexed: None, end: 0, crc, said_crc: None };
    let mut open: Option<OpenChunk> = None;
    while let Some(raw) = scanner.next_raw()? {
        if file.end == 0 && raw.opcode != op::HEADER {
            return Ok(Err("there is no header".to_owned()));
        }
        let Ok(record) = parse_record(raw.opcode, &raw.body) else {
            return Ok(Err(format!("the record at byte {} cannot be read", raw.at)));
        };
        if !matches!(record, Record::MessageIndex(_))
            && let Err(damage) = settle(&mut open, &mut file.index)
        {
            return Ok(Err(damage));
        }
        if let Record::DataEnd(end) = record {
            scanner.damage.data_ended = true;
            file.said_crc = Some(end.data_section_crc);
            break;
        }
        file.crc.update(&[raw.opcode]);
        file.crc.update(&(raw.body.len() as u64).to_le_bytes());
        file.crc.update(&raw.body);
        file.end = raw.end();
        tell(file.end);
        if let Err(what) = file.take(record, &raw, &mut open, visit) {
            return Ok(Err(format!("the {what} at byte {} is damaged", raw.at)));
        }
    }
    if file.end == 0 {
        return Ok(Err("there is no header".to_owned()));
    }
    if let Some(mut torn) = open.take_if(|open| !open.is_indexed()) {
        torn.index.message_index_offsets.clear();
        (file.end, file.crc) = (torn.end, torn.crc.clone());
        file.unindexed = Some(torn);
    }
    Ok(settle(&mut open, &mut file.index).map(|()| file))
}

/// Puts a chunk into the index, if it has all its message indexes.
fn settle(open: &mut Option<OpenChunk>, index: &mut Index) -> Result<(), String> {
    let Some(open) = open.take() else { return Ok(()) };
    if !open.is_indexed() {
        return Err(format!("the chunk at byte {} lacks message indexes", open.index.chunk_start_offset));
    }
    index.chunks.push(open.index);
    Ok(())
}

impl OpenChunk {
    fn is_indexed(&self) -> bool {
        self.index.message_index_offsets.keys().eq(self.places.keys())
    }
}

impl Gathered {
    /// Takes a record in; an error says what kind of thing is damaged.
    fn take(
        &mut self,
        record: Record<'_>,
        raw: &Raw,
        open: &mut Option<OpenChunk>,
        visit: &mut dyn FnMut(&Index, &MessageHeader),
    ) -> Result<(), &'static str> {
        let (offset, length) = (raw.at, raw.length());
        match record {
            Record::Chunk { header, .. } => {
                let mut places = Places::new();
                for (at, record) in unpack(raw).ok_or("chunk")? {
                    if let Record::Message { header, .. } = &record {
                        places.entry(header.channel_id).or_default().push((header.log_time, at));
                    }
                    self.take_unpacked(record, visit)?;
                }
                let index = ChunkIndex {
                    message_start_time: header.message_start_time,
                    message_end_time: header.message_end_time,
                    chunk_start_offset: offset,
                    chunk_length: length,
                    message_index_offsets: BTreeMap::new(),
                    message_index_length: 0,
                    compression: header.compression,
                    compressed_size: header.compressed_size,
                    uncompressed_size: header.uncompressed_size,
                };
                *open = Some(OpenChunk { index, places, end: raw.end(), crc: self.crc.clone() });
            }
            Record::MessageIndex(found) => {
                let open = open.as_mut().ok_or("message index")?;
                let places = open.places.get_mut(&found.channel_id).ok_or("message index")?;
                let mut found_places: Vec<_> =
                    found.records.iter().map(|entry| (entry.log_time, entry.offset)).collect();
                // Writers may sort them by time.
                places.sort_unstable();
                found_places.sort_unstable();
                if found_places != *places {
                    return Err("message index");
                }
                open.index.message_index_offsets.insert(found.channel_id, offset);
                open.index.message_index_length += length;
            }
            Record::Metadata(Metadata { name, .. }) => {
                self.index.metadata.push(MetadataIndex { offset, length, name });
            }
            Record::Attachment { header, data, .. } => self.index.attachments.push(AttachmentIndex {
                offset,
                length,
                log_time: header.log_time,
                create_time: header.create_time,
                data_size: data.len() as u64,
                name: header.name,
                media_type: header.media_type,
            }),
            record => self.take_unpacked(record, visit)?,
        }
        Ok(())
    }

    fn take_unpacked(
        &mut self,
        record: Record<'_>,
        visit: &mut dyn FnMut(&Index, &MessageHeader),
    ) -> Result<(), &'static str> {
        match record {
            Record::Message { header, .. } => {
                if !self.index.channels.contains_key(&header.channel_id) {
                    return Err("channel of a message");
                }
                self.index.count_message(header.channel_id, header.log_time);
                visit(&self.index, &header);
            }
            Record::Schema { header, data } => {
                self.index.schemas.insert(header.id, (header, data.into_owned()));
            }
            Record::Channel(channel) => {
                self.index.channels.insert(channel.id, channel);
            }
            _ => {}
        }
        Ok(())
    }
}
