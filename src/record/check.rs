//! Holds what a file says of itself against what is in it, and counts what is missing between its messages.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::records::{MessageHeader, Record};

use super::gather::gather;
use super::index::Index;
use super::ranges::{Ranges, widen_near};
use super::recover::{file_end, inspect};
use super::scan::Scanner;
use super::{BOOT, RecordError, Summary, parse_channel_name};
use crate::wire::{BootId, Topic};

/// What one machine says on one topic from one boot on: its messages are counted through.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Stream {
    /// Whose messages.
    pub machine: String,
    /// Since when they are counted; `None` if the recording does not tell.
    pub boot: Option<BootId>,
    /// What they say.
    pub topic: Topic,
}

/// Messages of a stream that are not there, between two that are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missing {
    /// Of which stream.
    pub stream: Stream,
    /// So many messages.
    pub messages: u64,
    /// In so many gaps.
    pub gaps: u64,
}

/// Checks files, and counts through the messages of all of them.
#[derive(Debug, Default)]
pub struct Checker {
    streams: BTreeMap<Stream, Counted>,
}

/// What a file turned out to be.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// What it says of itself.
    pub summary: Summary,
    /// Chunks in it.
    pub chunks: u64,
    /// What is wrong with it; empty if all is well.
    pub faults: Vec<String>,
}

impl Checker {
    /// Reads a whole file: the checksums of its chunks, of its data and of its end, its indexes, and its counts.
    /// `tell` hears how many bytes were read.
    ///
    /// # Errors
    /// [`RecordError`] if the file cannot be read, is no MCAP file or was not closed.
    pub fn check(&mut self, path: &Path, mut tell: impl FnMut(u64)) -> Result<Checked, RecordError> {
        let summary = inspect(path)?;
        let unfinished = || RecordError::Unfinished { path: path.to_owned() };
        let end = file_end(path)?.ok_or_else(unfinished)?;
        let mut scanner = Scanner::open(path)?;
        let mut last: Option<(u16, Stream)> = None;
        let mut visit = |index: &Index, header: &MessageHeader| {
            if last.as_ref().is_none_or(|(id, _)| *id != header.channel_id) {
                last = stream(index, header.channel_id).map(|stream| (header.channel_id, stream));
            }
            if let Some((_, stream)) = &last {
                match self.streams.get_mut(stream) {
                    Some(counted) => counted.add(header.sequence),
                    None => self.streams.entry(stream.clone()).or_default().add(header.sequence),
                }
            }
        };
        let found = match gather(&mut scanner, &mut visit, &mut tell)? {
            Ok(found) => found,
            Err(damage) => return Ok(Checked { summary, chunks: 0, faults: vec![damage] }),
        };
        let mut faults = Vec::new();
        let mut must = |holds: bool, fault: &str| {
            if !holds {
                faults.push(fault.to_owned());
            }
        };
        must(found.unindexed.is_none(), "the last chunk lacks message indexes");
        let data_crc = found.crc.finalize();
        must(found.said_crc.is_some(), "the data section has no end");
        let right = |said: Option<u32>| said.is_none_or(|said| said == 0 || said == data_crc);
        must(right(found.said_crc), "the checksum of the data section is wrong");
        must(end.checksum_is_right(path)?, "the checksum of the index is wrong");
        let said = read_summary(&mut scanner, end.summary_start)?;
        must(said.channels == found.index.channels, "the index names other channels than the data");
        must(said.schemas == found.index.schemas, "the index names other schemas than the data");
        must(said.chunks == found.index.chunks, "the index has other chunks than the data");
        must(said.metadata == found.index.metadata, "the index has other metadata than the data");
        must(said.attachments == found.index.attachments, "the index has other attachments than the data");
        let statistics = found.index.statistics();
        must(said.statistics.as_ref() == Some(&statistics), "the statistics do not count what is there");
        Ok(Checked { summary, chunks: found.index.chunks.len() as u64, faults })
    }

    /// What is missing so far. Messages may come in any order, and from any of the files.
    pub fn missing(&self) -> Vec<Missing> {
        let missing = self.streams.iter().filter_map(|(stream, Counted { numbers, .. })| {
            let gaps = numbers.missing_in(numbers.iter().next()?.start..numbers.end());
            let (messages, gaps) = (gaps.count(), gaps.iter().count() as u64);
            (gaps > 0).then(|| Missing { stream: stream.clone(), messages, gaps })
        });
        missing.collect()
    }

    /// The streams with messages that are there more than once, and how many. Where boots are not told, a
    /// machine that was restarted counts anew, so that these are left out.
    pub fn repeated(&self) -> Vec<(Stream, u64)> {
        let told = self.streams.iter().filter(|(stream, _)| stream.boot.is_some());
        let repeated = told.filter(|(_, counted)| counted.repeated > 0);
        repeated.map(|(stream, counted)| (stream.clone(), counted.repeated)).collect()
    }
}

fn stream(index: &Index, channel_id: u16) -> Option<Stream> {
    let channel = index.channels.get(&channel_id)?;
    let (machine, topic) = parse_channel_name(&channel.topic)?;
    let boot = channel.metadata.get(BOOT).and_then(|boot| boot.parse().ok());
    Some(Stream { machine: machine.to_owned(), boot, topic })
}

/// Which numbers of a stream are there.
#[derive(Debug, Default)]
struct Counted {
    /// From [`Counted::ORIGIN`] on: the first message of a file may be one that came before others.
    numbers: Ranges,
    last: Option<u64>,
    repeated: u64,
}

impl Counted {
    const ORIGIN: u64 = 1 << 32;

    /// The file has the lower 32 bits of a number; the rest is as near as can be to the number before.
    fn add(&mut self, lower: u32) {
        let number = widen_near(lower, self.last.unwrap_or(Self::ORIGIN + u64::from(lower)));
        self.last = Some(number);
        self.repeated += u64::from(!self.numbers.insert(number));
    }
}

/// The summary of a file as it stands there.
#[derive(Default)]
struct Said {
    schemas: BTreeMap<u16, (mcap::records::SchemaHeader, Vec<u8>)>,
    channels: BTreeMap<u16, mcap::records::Channel>,
    chunks: Vec<mcap::records::ChunkIndex>,
    attachments: Vec<mcap::records::AttachmentIndex>,
    metadata: Vec<mcap::records::MetadataIndex>,
    statistics: Option<mcap::records::Statistics>,
}

fn read_summary(scanner: &mut Scanner, at: u64) -> Result<Said, RecordError> {
    let mut said = Said::default();
    scanner.seek(at)?;
    while let Some(records) = scanner.next_block()? {
        for record in records {
            match record {
                Record::Schema { header, data } => {
                    said.schemas.insert(header.id, (header, data.into_owned()));
                }
                Record::Channel(channel) => {
                    said.channels.insert(channel.id, channel);
                }
                Record::ChunkIndex(index) => said.chunks.push(index),
                Record::AttachmentIndex(index) => said.attachments.push(index),
                Record::MetadataIndex(index) => said.metadata.push(index),
                Record::Statistics(statistics) => said.statistics = Some(statistics),
                _ => {}
            }
        }
    }
    Ok(said)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(numbers: &[u32]) -> (Vec<(i64, i64)>, u64) {
        let mut counted = Counted::default();
        numbers.iter().for_each(|number| counted.add(*number));
        let place = |number: u64| number as i64 - Counted::ORIGIN as i64;
        let runs = counted.numbers.iter().map(|range| (place(range.start), place(range.end)));
        (runs.collect(), counted.repeated)
    }

    #[test]
    fn numbers_may_come_late_twice_and_past_32_bits() {
        assert_eq!(counted(&[0, 1, 2]), (vec![(0, 3)], 0));
        assert_eq!(counted(&[5, 6, 9, 7, 8, 10]), (vec![(5, 11)], 0));
        assert_eq!(counted(&[0, 1, 4, 1, 4]), (vec![(0, 2), (4, 5)], 2));
        assert_eq!(counted(&[3, 2, 0]), (vec![(0, 1), (2, 4)], 0));
        let end = i64::from(u32::MAX);
        assert_eq!(
            counted(&[u32::MAX - 1, u32::MAX, 0, 2]),
            (vec![(end - 1, end + 2), (end + 3, end + 4)], 0)
        );
        assert_eq!(counted(&[1, u32::MAX, 0]), (vec![(-1, 2)], 0), "it had begun before");
    }
}
