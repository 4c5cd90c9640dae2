//! The 33 bytes that go with every publication: version, sequence number, boot, stamp, time of sending.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::WireError;
use crate::time::Stamp;

/// Length of an encoded [`Attachment`].
pub const ATTACHMENT_BYTES: usize = 33;
const VERSION: u8 = 1;

/// One run of one machine's process; drawn anew at every start. Sequence numbers count within it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "shells", schema(value_type = String))]
#[serde(try_from = "String", into = "String")]
pub struct BootId(pub u64);

impl fmt::Display for BootId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:016x}", self.0)
    }
}

impl From<BootId> for String {
    fn from(boot: BootId) -> String {
        boot.to_string()
    }
}

impl FromStr for BootId {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let hexadecimal = text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let number = if hexadecimal { u64::from_str_radix(text, 16).ok() } else { None };
        number.map(BootId).ok_or_else(|| format!("boot \"{text:.40}\" is not 16 hexadecimal digits"))
    }
}

impl TryFrom<String> for BootId {
    type Error = String;
    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

/// Goes with every publication, so that gaps, restarts and delays show.
///
/// Encoded as version (u8 = 1), then little endian: sequence (u64), boot (u64), stamp (i64 ns), sent (i64 ns).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// Counts the publications of this topic since the boot, from 0.
    pub sequence: u64,
    /// The run that counts.
    pub boot: BootId,
    /// When what is published was measured.
    pub stamp: Stamp,
    /// When it was published, by the machine's clock; for readings, when they arrived at the machine.
    pub sent: Stamp,
}

impl Attachment {
    /// The bytes.
    pub fn encode(&self) -> [u8; ATTACHMENT_BYTES] {
        let mut bytes = [0; ATTACHMENT_BYTES];
        bytes[0] = VERSION;
        bytes[1..9].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[9..17].copy_from_slice(&self.boot.0.to_le_bytes());
        bytes[17..25].copy_from_slice(&self.stamp.as_nanos().to_le_bytes());
        bytes[25..33].copy_from_slice(&self.sent.as_nanos().to_le_bytes());
        bytes
    }

    /// Reads the bytes back.
    ///
    /// # Errors
    /// [`WireError::Attachment`] if the length or the version is another.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let bytes: &[u8; ATTACHMENT_BYTES] = bytes.try_into().map_err(|_| {
            WireError::Attachment(format!("{} bytes, must be {ATTACHMENT_BYTES}", bytes.len()))
        })?;
        if bytes[0] != VERSION {
            return Err(WireError::Attachment(format!("version {}, known is {VERSION}", bytes[0])));
        }
        let word = |first: usize| {
            let mut word = [0; 8];
            word.copy_from_slice(&bytes[first..first + 8]);
            word
        };
        Ok(Self {
            sequence: u64::from_le_bytes(word(1)),
            boot: BootId(u64::from_le_bytes(word(9))),
            stamp: Stamp::from_nanos(i64::from_le_bytes(word(17))),
            sent: Stamp::from_nanos(i64::from_le_bytes(word(25))),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_as_documented() {
        let attachment = Attachment {
            sequence: 0x0102,
            boot: BootId(0xa1b2_c3d4_e5f6_0718),
            stamp: Stamp::from_nanos(-2),
            sent: Stamp::from_nanos(1),
        };
        let bytes = attachment.encode();
        let mut expected = vec![1, 2, 1, 0, 0, 0, 0, 0, 0, 0x18, 7, 0xf6, 0xe5, 0xd4, 0xc3, 0xb2, 0xa1];
        expected.extend([0xfe, 255, 255, 255, 255, 255, 255, 255, 1, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bytes.as_slice(), expected);
        assert_eq!(Attachment::decode(&bytes).expect("ours"), attachment);
        assert_eq!(attachment.boot.to_string(), "a1b2c3d4e5f60718");
    }

    #[test]
    fn what_is_not_ours_is_refused() {
        let good =
            Attachment { sequence: 1, boot: BootId(2), stamp: Stamp::default(), sent: Stamp::default() };
        let bytes = good.encode();
        let message = Attachment::decode(&bytes[..32]).expect_err("short").to_string();
        assert_eq!(message, "attachment: 32 bytes, must be 33");
        let mut other = bytes;
        other[0] = 2;
        assert!(Attachment::decode(&other).expect_err("version").to_string().contains("version 2"));
        assert!("12".parse::<BootId>().is_err());
        assert!("+1b2c3d4e5f60718".parse::<BootId>().is_err());
    }
}
