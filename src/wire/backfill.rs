//! What the site asks of a machine's on-board record, and what it is answered.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{ATTACHMENT_BYTES, Attachment, BootId, Topic, WireError};

/// An answer takes no more bytes than this, whatever is asked; a message that is longer alone goes alone.
pub const BATCH_BYTES_MAX: u64 = 256 * 1024;
/// Questions and lists of holdings longer than this are not ours.
const JSON_BYTES_MAX: usize = 4 * 1024 * 1024;
const VERSION: u8 = 1;
/// Topic and length of a message.
const MESSAGE_HEAD_BYTES: usize = 1 + 4;

/// Numbers of messages, the last one included.
pub type Range = [u64; 2];

/// Messages that are wanted, by topic; ranges ascend.
pub type Wanted = BTreeMap<Topic, Vec<Range>>;

/// Payload of a query on [`super::record_key`], JSON.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "ask", rename_all = "snake_case")]
pub enum RecordRequest {
    /// What is there? Answered by [`Holdings`], JSON.
    Holdings,
    /// Messages of one boot, of all topics in the order in which the machine sent them. Answered by a [`Batch`].
    Messages {
        /// Which boot counts them.
        boot: BootId,
        /// Which.
        wanted: Wanted,
        /// So many bytes at most.
        bytes: u64,
    },
}

/// What an on-board record holds.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holdings {
    /// Whether there is an on-board record at all.
    pub kept: Kept,
    /// Oldest first.
    pub boots: Vec<HeldBoot>,
}

/// Whether a machine keeps an on-board record.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kept {
    /// It does.
    #[default]
    Yes,
    /// Not now: it is still opened, or the disk refuses. Ask again.
    NotNow,
    /// Its configuration says no.
    No,
}

/// What is held of one boot.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeldBoot {
    /// Which.
    pub boot: BootId,
    /// Whether it is the one that answers: more will come.
    pub current: bool,
    /// First and last message of each topic; some in between may be missing.
    pub topics: BTreeMap<Topic, Range>,
    /// What there was of a topic below this number is overwritten; what else is missing never was on board.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub overwritten: BTreeMap<Topic, u64>,
    /// Some of it cannot be read now, so that nothing of it is known to be lost.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unread: bool,
}

/// Messages out of an on-board record, each as it was sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// For each topic that was asked for: all that is held and was asked for below this number is in here. What is
    /// above may be in here, too.
    pub done: BTreeMap<Topic, u64>,
    /// In the order in which the machine sent them.
    pub messages: Vec<(Topic, Attachment, Vec<u8>)>,
}

impl RecordRequest {
    /// Reads a query's payload.
    ///
    /// # Errors
    /// [`WireError`] if it is too long or no question.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        decode("question to a record", bytes)
    }
}

impl Holdings {
    /// Reads the answer.
    ///
    /// # Errors
    /// [`WireError`] if it is too long or something else.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        decode("holdings of a record", bytes)
    }
}

impl Batch {
    /// Bytes that a message takes in a batch.
    pub fn bytes_of(payload: &[u8]) -> u64 {
        (MESSAGE_HEAD_BYTES + ATTACHMENT_BYTES + payload.len()) as u64
    }

    /// The bytes: version (u8 = 1), number of topics (u8); for each its name (u8 length, text) and `done` (u64);
    /// then the messages, each as topic (u8, counted from 0), length of the payload (u32), attachment, payload.
    /// Numbers are little endian.
    pub fn encode(&self) -> Vec<u8> {
        let messages: u64 = self.messages.iter().map(|(_, _, payload)| Self::bytes_of(payload)).sum();
        let mut bytes = Vec::with_capacity(512 + messages as usize);
        let mut topics: Vec<Topic> = self.done.keys().copied().collect();
        for (topic, ..) in &self.messages {
            if !topics.contains(topic) {
                topics.push(*topic);
            }
        }
        bytes.extend([VERSION, topics.len() as u8]);
        for topic in &topics {
            bytes.push(topic.name().len() as u8);
            bytes.extend(topic.name().as_bytes());
            bytes.extend(self.done.get(topic).copied().unwrap_or(0).to_le_bytes());
        }
        for (topic, attachment, payload) in &self.messages {
            let index = topics.iter().position(|known| known == topic).unwrap_or_default();
            bytes.push(index as u8);
            bytes.extend((payload.len() as u32).to_le_bytes());
            bytes.extend(attachment.encode());
            bytes.extend(payload);
        }
        bytes
    }

    /// Reads the bytes back.
    ///
    /// # Errors
    /// [`WireError`] if they are something else, or cut short.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let mut left = Left(bytes);
        if left.number::<1>()? != [VERSION] {
            return Err(unusable("another version"));
        }
        let [count] = left.number()?;
        let mut batch = Batch::default();
        let mut topics = Vec::new();
        for _ in 0..count {
            let [length] = left.number()?;
            let name = std::str::from_utf8(left.take(usize::from(length))?).unwrap_or_default();
            let topic = Topic::from_name(name).ok_or_else(|| unusable("an unknown topic"))?;
            topics.push(topic);
            batch.done.insert(topic, u64::from_le_bytes(left.number()?));
        }
        while !left.0.is_empty() {
            let [index] = left.number()?;
            let topic = *topics.get(usize::from(index)).ok_or_else(|| unusable("a message of no topic"))?;
            let length = u32::from_le_bytes(left.number()?);
            let attachment = Attachment::decode(left.take(ATTACHMENT_BYTES)?)?;
            batch.messages.push((topic, attachment, left.take(length as usize)?.to_vec()));
        }
        Ok(batch)
    }
}

struct Left<'a>(&'a [u8]);

impl<'a> Left<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], WireError> {
        let (part, rest) = self.0.split_at_checked(count).ok_or_else(|| unusable("cut short"))?;
        self.0 = rest;
        Ok(part)
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        let mut number = [0; N];
        number.copy_from_slice(self.take(N)?);
        Ok(number)
    }
}

fn unusable(reason: &str) -> WireError {
    WireError::Unusable { message: "batch of a record", reason: reason.to_owned() }
}

fn decode<T: serde::de::DeserializeOwned>(message: &'static str, bytes: &[u8]) -> Result<T, WireError> {
    if bytes.len() > JSON_BYTES_MAX {
        return Err(WireError::TooLong { message, length: bytes.len(), limit: JSON_BYTES_MAX });
    }
    serde_json::from_slice(bytes).map_err(|source| WireError::Json { message, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::Sensor;
    use crate::time::Stamp;
    use crate::wire::encode_json;

    fn batch() -> Batch {
        let stamp = Stamp::from_nanos(5);
        let attachment = Attachment { sequence: 7, boot: BootId(0xab), stamp, sent: stamp };
        Batch {
            done: [(Topic::Pose, 8), (Topic::Sensor(Sensor::Imu), u64::MAX)].into(),
            messages: vec![
                (Topic::Pose, attachment, vec![1, 2, 3]),
                (Topic::Sensor(Sensor::Imu), Attachment { sequence: 0, ..attachment }, vec![]),
            ],
        }
    }

    #[test]
    fn batch_comes_back_and_what_is_cut_is_refused() {
        let bytes = batch().encode();
        assert_eq!(Batch::decode(&bytes).expect("ours"), batch());
        let messages: u64 = batch().messages.iter().map(|(.., payload)| Batch::bytes_of(payload)).sum();
        let head = bytes.len() as u64 - messages;
        for length in 0..bytes.len() {
            let cut = Batch::decode(&bytes[..length]);
            // Between two messages it is a shorter batch.
            let whole = [head, head + Batch::bytes_of(&[1, 2, 3])].contains(&(length as u64));
            assert_eq!(cut.is_ok(), whole, "{length}: {cut:?}");
        }
        let mut other = bytes;
        other[0] = 9;
        assert!(Batch::decode(&other).expect_err("version").to_string().contains("another version"));
    }

    #[test]
    fn questions_and_holdings_are_as_documented() {
        let wanted = [(Topic::Sensor(Sensor::Imu), vec![[3, 5], [9, 9]])].into();
        let request = RecordRequest::Messages { boot: BootId(1), wanted, bytes: 1000 };
        let bytes = encode_json("question", &request).expect("JSON");
        assert_eq!(
            std::str::from_utf8(&bytes).expect("text"),
            r#"{"ask":"messages","boot":"0000000000000001","wanted":{"sensor/imu":[[3,5],[9,9]]},"bytes":1000}"#
        );
        assert_eq!(RecordRequest::decode(&bytes).expect("ours"), request);
        let topics = [(Topic::Pose, [0, 9])].into();
        let held =
            HeldBoot { boot: BootId(2), current: true, topics, overwritten: BTreeMap::new(), unread: false };
        let mut holdings = Holdings { kept: Kept::Yes, boots: vec![held] };
        let bytes = encode_json("holdings", &holdings).expect("JSON");
        assert_eq!(
            std::str::from_utf8(&bytes).expect("text"),
            r#"{"kept":"yes","boots":[{"boot":"0000000000000002","current":true,"topics":{"pose":[0,9]}}]}"#
        );
        assert_eq!(Holdings::decode(&bytes).expect("ours"), holdings);
        holdings.boots[0].overwritten = [(Topic::Pose, 7)].into();
        holdings.boots[0].unread = true;
        let bytes = encode_json("holdings", &holdings).expect("JSON");
        assert!(bytes.ends_with(br#""overwritten":{"pose":7},"unread":true}]}"#));
        assert_eq!(Holdings::decode(&bytes).expect("ours"), holdings);
        assert!(RecordRequest::decode(br#"{"ask":"everything"}"#).is_err());
        assert!(RecordRequest::decode(br#"{"ask":"messages","wanted":{"sonar":[]}}"#).is_err());
    }
}
