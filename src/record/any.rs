//! Reads MCAP files of anybody: topics, types and messages as they stand in the file, ours or not.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::Record;

use super::recover::file_end;
use super::scan::Scanner;
use super::{RecordError, parse_channel_name, stamp_of};
use crate::time::Stamp;
use crate::wire::Topic;

/// A channel of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Such as `/cabin/imu/data`.
    pub topic: String,
    /// Name of its schema, such as `sensor_msgs/msg/Imu`; empty without a schema.
    pub message_type: String,
    /// Of its messages, such as `cdr` or `json`.
    pub encoding: String,
}

impl Channel {
    /// Whose it is and what it says, if it is named as in our recordings.
    pub fn ours(&self) -> Option<(&str, Topic)> {
        parse_channel_name(&self.topic)
    }
}

/// A message of any channel.
#[derive(Clone, Debug, PartialEq)]
pub struct AnyMessage {
    /// Its channel.
    pub channel: Arc<Channel>,
    /// When the recorder received it.
    pub received: Stamp,
    /// When it was sent.
    pub sent: Stamp,
    /// As its channel says.
    pub payload: Vec<u8>,
}

/// All messages of a file in its order. What is torn or damaged is passed over.
pub struct AnyMessages {
    path: PathBuf,
    scanner: Scanner,
    types: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Arc<Channel>>,
    library: String,
    ready: VecDeque<Record<'static>>,
}

/// Opens any MCAP file.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn read_any(path: &Path) -> Result<AnyMessages, RecordError> {
    Ok(AnyMessages {
        path: path.to_owned(),
        scanner: Scanner::open(path)?,
        types: BTreeMap::new(),
        channels: BTreeMap::new(),
        library: String::new(),
        ready: VecDeque::new(),
    })
}

impl AnyMessages {
    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How many of the file's bytes were read.
    pub fn bytes_read(&self) -> u64 {
        self.scanner.at()
    }

    /// Bytes that could not be read so far: of damaged chunks, and of the torn end once it was reached.
    pub fn lost_bytes(&self) -> u64 {
        self.scanner.damage.torn_bytes + self.scanner.damage.damaged_bytes
    }

    /// Takes what is no message; gives back what is.
    fn take(&mut self, record: Record<'static>) -> Option<AnyMessage> {
        match record {
            Record::Header(header) => self.library = header.library,
            Record::Schema { header, .. } => {
                self.types.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let message_type = self.types.get(&channel.schema_id).cloned().unwrap_or_default();
                let known =
                    Channel { topic: channel.topic, message_type, encoding: channel.message_encoding };
                self.channels.insert(channel.id, Arc::new(known));
            }
            Record::Message { header, data } => {
                let channel = self.channels.get(&header.channel_id)?.clone();
                return Some(AnyMessage {
                    channel,
                    received: stamp_of(header.log_time),
                    sent: stamp_of(header.publish_time),
                    payload: data.into_owned(),
                });
            }
            _ => {}
        }
        None
    }

    /// Reads on without the messages, to the end or to where `enough` says so.
    fn skim(&mut self, mut enough: impl FnMut(&Self, &Record<'static>) -> bool) -> Result<(), RecordError> {
        while let Some(block) = self.scanner.next_block()? {
            for record in block {
                if matches!(record, Record::Message { .. }) {
                    continue;
                }
                let done = enough(self, &record);
                self.take(record);
                if done {
                    return Ok(());
                }
            }
        }
        Ok(())
    }
}

impl Iterator for AnyMessages {
    type Item = Result<AnyMessage, RecordError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            while let Some(record) = self.ready.pop_front() {
                if let Some(message) = self.take(record) {
                    return Some(Ok(message));
                }
            }
            match self.scanner.next_block() {
                Ok(Some(records)) => self.ready.extend(records),
                Ok(None) => return None,
                Err(error) => return Some(Err(error)),
            }
        }
    }
}

/// The channels of a file, by topic, and how many of its bytes turned out to be lost; from its index where it has
/// one, else all of it is read.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn channels(path: &Path) -> Result<(Vec<Channel>, u64), RecordError> {
    let mut file = read_any(path)?;
    if let Some(at) = file_end(path)?.map(|end| end.summary_start) {
        file.scanner.seek(at)?;
        let mut has_messages = false;
        file.skim(|_, record| {
            has_messages |= matches!(record, Record::Statistics(statistics) if statistics.message_count > 0);
            false
        })?;
        // An index may leave out channels; then there are none of them, or fewer than have messages.
        if file.channels.is_empty() && has_messages {
            file = read_any(path)?;
            file.skim(|_, _| false)?;
        }
    } else {
        file.skim(|_, _| false)?;
    }
    let lost_bytes = file.lost_bytes();
    let mut channels: Vec<Channel> = file.channels.into_values().map(|channel| (*channel).clone()).collect();
    channels.sort_by(|left, right| left.topic.cmp(&right.topic));
    channels.dedup();
    Ok((channels, lost_bytes))
}

/// The program that wrote a file, such as `holdfast 0.1.0`; empty if it does not say.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn library(path: &Path) -> Result<String, RecordError> {
    let mut file = read_any(path)?;
    file.skim(|_, _| true)?;
    Ok(file.library)
}

/// The first metadata record of that name; found by the index where there is one, else all of the file is read.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn metadata(path: &Path, name: &str) -> Result<Option<BTreeMap<String, String>>, RecordError> {
    let mut file = read_any(path)?;
    let mut found = None;
    if let Some(at) = file_end(path)?.map(|end| end.summary_start) {
        let mut offset = None;
        file.scanner.seek(at)?;
        file.skim(|_, record| {
            if let Record::MetadataIndex(index) = record
                && index.name == name
            {
                offset = Some(index.offset);
            }
            offset.is_some()
        })?;
        let Some(offset) = offset else { return Ok(None) };
        file.scanner.seek(offset)?;
    }
    file.skim(|_, record| {
        if let Record::Metadata(metadata) = record
            && metadata.name == name
        {
            found = Some(metadata.metadata.clone());
        }
        found.is_some()
    })?;
    Ok(found)
}
