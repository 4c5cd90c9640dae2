//! What the end of a file says of the rest of it, gathered while a file is read.

use std::collections::BTreeMap;

use mcap::records::{
    AttachmentIndex, Channel, ChunkIndex, MetadataIndex, SchemaHeader, Statistics, SummaryOffset, op,
};

use super::encode;

/// The summary of a file.
#[derive(Debug, Default)]
pub(super) struct Index {
    pub(super) schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    pub(super) channels: BTreeMap<u16, Channel>,
    pub(super) chunks: Vec<ChunkIndex>,
    pub(super) attachments: Vec<AttachmentIndex>,
    pub(super) metadata: Vec<MetadataIndex>,
    pub(super) message_counts: BTreeMap<u16, u64>,
    /// First and last time of receiving, nanoseconds.
    pub(super) bounds: Option<(u64, u64)>,
}

impl Index {
    pub(super) fn count_message(&mut self, channel_id: u16, log_time: u64) {
        *self.message_counts.entry(channel_id).or_default() += 1;
        self.bounds = Some(match self.bounds {
            None => (log_time, log_time),
            Some((first, last)) => (first.min(log_time), last.max(log_time)),
        });
    }

    pub(super) fn messages(&self) -> u64 {
        self.message_counts.values().sum()
    }

    pub(super) fn statistics(&self) -> Statistics {
        let (first, last) = self.bounds.unwrap_or_default();
        Statistics {
            message_count: self.messages(),
            schema_count: self.schemas.len() as u16,
            channel_count: self.channels.len() as u32,
            attachment_count: self.attachments.len() as u32,
            metadata_count: self.metadata.len() as u32,
            chunk_count: self.chunks.len() as u32,
            message_start_time: first,
            message_end_time: last,
            channel_message_counts: self.message_counts.clone(),
        }
    }

    /// Everything after the data of a file whose data section ends at `at` and has this checksum.
    pub(super) fn encode_end(&self, at: u64, data_crc: u32) -> Vec<u8> {
        let mut out = Vec::new();
        encode::data_end(&mut out, data_crc);
        let summary_from = out.len();
        let mut groups = Groups::new(at, &out);
        let summary_start = groups.start;
        self.schemas.values().for_each(|(header, data)| encode::schema(&mut out, header, data));
        groups.close(op::SCHEMA, &out);
        self.channels.values().for_each(|channel| encode::channel(&mut out, channel));
        groups.close(op::CHANNEL, &out);
        encode::statistics(&mut out, &self.statistics());
        groups.close(op::STATISTICS, &out);
        self.chunks.iter().for_each(|index| encode::chunk_index(&mut out, index));
        groups.close(op::CHUNK_INDEX, &out);
        self.attachments.iter().for_each(|index| encode::attachment_index(&mut out, index));
        groups.close(op::ATTACHMENT_INDEX, &out);
        self.metadata.iter().for_each(|index| encode::metadata_index(&mut out, index));
        groups.close(op::METADATA_INDEX, &out);
        let offsets_start = groups.start;
        groups.offsets.iter().for_each(|offset| encode::summary_offset(&mut out, offset));
        encode::end(&mut out, summary_start, offsets_start, Some(summary_from));
        out
    }
}

/// Where in a file each group of records of the summary begins and ends.
struct Groups {
    /// Where in the file the bytes begin.
    at: u64,
    /// Where in the file the next group begins.
    start: u64,
    offsets: Vec<SummaryOffset>,
}

impl Groups {
    fn new(at: u64, out: &[u8]) -> Self {
        Self { at, start: at + out.len() as u64, offsets: Vec::new() }
    }

    fn close(&mut self, opcode: u8, out: &[u8]) {
        let end = self.at + out.len() as u64;
        if end > self.start {
            let (group_start, group_length) = (self.start, end - self.start);
            self.offsets.push(SummaryOffset { group_opcode: opcode, group_start, group_length });
        }
        self.start = end;
    }
}
