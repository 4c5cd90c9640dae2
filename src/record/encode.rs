//! Bytes of the records that the MCAP library writes only by itself: indexes, statistics, the end of a file.
//!
//! A recovery that completes a file where it lies, and files that are put one after the other, need them.

use std::collections::BTreeMap;

use mcap::MAGIC;
use mcap::records::{
    AttachmentIndex, Channel, ChunkIndex, Metadata, MetadataIndex, SchemaHeader, Statistics, SummaryOffset,
    op,
};

/// A record is appended: opcode, length, and what `body` writes.
fn record(out: &mut Vec<u8>, opcode: u8, body: impl FnOnce(&mut Vec<u8>)) {
    out.push(opcode);
    let length_at = out.len();
    out.extend([0; 8]);
    let body_at = out.len();
    body(out);
    let length = (out.len() - body_at) as u64;
    out[length_at..body_at].copy_from_slice(&length.to_le_bytes());
}

fn u16(out: &mut Vec<u8>, value: u16) {
    out.extend(value.to_le_bytes());
}

fn u32(out: &mut Vec<u8>, value: u32) {
    out.extend(value.to_le_bytes());
}

fn u64(out: &mut Vec<u8>, value: u64) {
    out.extend(value.to_le_bytes());
}

/// The format counts bytes of texts, lists and maps with 32 bits.
fn counted(out: &mut Vec<u8>, content: impl FnOnce(&mut Vec<u8>)) {
    let length_at = out.len();
    u32(out, 0);
    let content_at = out.len();
    content(out);
    let length = (out.len() - content_at) as u32;
    out[length_at..content_at].copy_from_slice(&length.to_le_bytes());
}

fn text(out: &mut Vec<u8>, text: &str) {
    counted(out, |out| out.extend(text.as_bytes()));
}

fn texts(out: &mut Vec<u8>, map: &BTreeMap<String, String>) {
    counted(out, |out| {
        for (key, value) in map {
            text(out, key);
            text(out, value);
        }
    });
}

fn numbers(out: &mut Vec<u8>, map: &BTreeMap<u16, u64>) {
    counted(out, |out| {
        for (key, value) in map {
            u16(out, *key);
            u64(out, *value);
        }
    });
}

pub(super) fn schema(out: &mut Vec<u8>, header: &SchemaHeader, data: &[u8]) {
    record(out, op::SCHEMA, |out| {
        u16(out, header.id);
        text(out, &header.name);
        text(out, &header.encoding);
        counted(out, |out| out.extend(data));
    });
}

pub(super) fn channel(out: &mut Vec<u8>, channel: &Channel) {
    record(out, op::CHANNEL, |out| {
        u16(out, channel.id);
        u16(out, channel.schema_id);
        text(out, &channel.topic);
        text(out, &channel.message_encoding);
        texts(out, &channel.metadata);
    });
}

/// `entries` are times of receiving, and places in the unpacked chunk.
pub(super) fn message_index(out: &mut Vec<u8>, channel_id: u16, entries: &[(u64, u64)]) {
    record(out, op::MESSAGE_INDEX, |out| {
        u16(out, channel_id);
        counted(out, |out| {
            for (log_time, offset) in entries {
                u64(out, *log_time);
                u64(out, *offset);
            }
        });
    });
}

pub(super) fn chunk_index(out: &mut Vec<u8>, index: &ChunkIndex) {
    record(out, op::CHUNK_INDEX, |out| {
        u64(out, index.message_start_time);
        u64(out, index.message_end_time);
        u64(out, index.chunk_start_offset);
        u64(out, index.chunk_length);
        numbers(out, &index.message_index_offsets);
        u64(out, index.message_index_length);
        text(out, &index.compression);
        u64(out, index.compressed_size);
        u64(out, index.uncompressed_size);
    });
}

pub(super) fn attachment_index(out: &mut Vec<u8>, index: &AttachmentIndex) {
    record(out, op::ATTACHMENT_INDEX, |out| {
        for value in [index.offset, index.length, index.log_time, index.create_time, index.data_size] {
            u64(out, value);
        }
        text(out, &index.name);
        text(out, &index.media_type);
    });
}

pub(super) fn metadata(out: &mut Vec<u8>, metadata: &Metadata) {
    record(out, op::METADATA, |out| {
        text(out, &metadata.name);
        texts(out, &metadata.metadata);
    });
}

pub(super) fn metadata_index(out: &mut Vec<u8>, index: &MetadataIndex) {
    record(out, op::METADATA_INDEX, |out| {
        u64(out, index.offset);
        u64(out, index.length);
        text(out, &index.name);
    });
}

pub(super) fn statistics(out: &mut Vec<u8>, statistics: &Statistics) {
    record(out, op::STATISTICS, |out| {
        u64(out, statistics.message_count);
        u16(out, statistics.schema_count);
        u32(out, statistics.channel_count);
        u32(out, statistics.attachment_count);
        u32(out, statistics.metadata_count);
        u32(out, statistics.chunk_count);
        u64(out, statistics.message_start_time);
        u64(out, statistics.message_end_time);
        numbers(out, &statistics.channel_message_counts);
    });
}

pub(super) fn summary_offset(out: &mut Vec<u8>, offset: &SummaryOffset) {
    record(out, op::SUMMARY_OFFSET, |out| {
        out.push(offset.group_opcode);
        u64(out, offset.group_start);
        u64(out, offset.group_length);
    });
}

/// The checksum is of everything before; 0 says that there is none.
pub(super) fn data_end(out: &mut Vec<u8>, data_crc: u32) {
    record(out, op::DATA_END, |out| u32(out, data_crc));
}

/// Footer and magic: the last bytes of a file. The summary's checksum, which runs into the footer, is only there
/// if `crc_of` says where in `out` the summary begins.
pub(super) fn end(out: &mut Vec<u8>, summary_start: u64, summary_offset_start: u64, crc_of: Option<usize>) {
    record(out, op::FOOTER, |out| {
        u64(out, summary_start);
        u64(out, summary_offset_start);
        u32(out, 0);
    });
    if let Some(from) = crc_of {
        let at = out.len() - 4;
        let crc = crc32fast::hash(&out[from..at]);
        out[at..].copy_from_slice(&crc.to_le_bytes());
    }
    out.extend(MAGIC);
}
