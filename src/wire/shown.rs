//! ROS 2 messages that are made for those who look on: places of frames, and the log. No machine sends them.

use super::cdr::{CdrError, CdrReader, CdrWriter};
use super::messages::{Header, RosMessage, read_time, write_time};
use crate::time::Stamp;

/// Bytes of the shortest transform: a header, an empty name, seven numbers.
const TRANSFORM_BYTES_MIN: usize = 8 + 4 + 4 + 56;

/// `geometry_msgs/TransformStamped`: the child in the header's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct TransformStamped {
    /// Stamp, and the parent.
    pub header: Header,
    /// The child.
    pub child_frame_id: String,
    /// Of the child's origin, m.
    pub translation: [f64; 3],
    /// x, y, z, w.
    pub rotation: [f64; 4],
}

/// `tf2_msgs/TFMessage`.
#[derive(Clone, Debug, PartialEq)]
pub struct TfMessage {
    /// In any order.
    pub transforms: Vec<TransformStamped>,
}

impl RosMessage for TfMessage {
    const TYPE: &'static str = "tf2_msgs/msg/TFMessage";

    fn write(&self, cdr: &mut CdrWriter) {
        cdr.count(self.transforms.len());
        for transform in &self.transforms {
            transform.header.write(cdr);
            cdr.string(&transform.child_frame_id);
            cdr.f64_array(&transform.translation);
            cdr.f64_array(&transform.rotation);
        }
    }

    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        let count = cdr.count(TRANSFORM_BYTES_MIN)?;
        let mut transforms = Vec::with_capacity(count);
        for _ in 0..count {
            transforms.push(TransformStamped {
                header: Header::read(cdr)?,
                child_frame_id: cdr.string()?.to_owned(),
                translation: cdr.f64_array()?,
                rotation: cdr.f64_array()?,
            });
        }
        Ok(Self { transforms })
    }
}

/// How much a line of the log matters, as `rcl_interfaces/Log` counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum LogLevel {
    /// For the record.
    Info = 20,
    /// Something works less well.
    Warn = 30,
    /// Something does not work.
    Error = 40,
}

/// `rcl_interfaces/Log`; file, function and line are empty.
#[derive(Clone, Debug, PartialEq)]
pub struct Log {
    /// When it happened.
    pub stamp: Stamp,
    /// How much it matters.
    pub level: LogLevel,
    /// Who says so.
    pub name: String,
    /// What.
    pub text: String,
}

impl RosMessage for Log {
    const TYPE: &'static str = "rcl_interfaces/msg/Log";

    fn write(&self, cdr: &mut CdrWriter) {
        write_time(self.stamp, cdr);
        cdr.u8(self.level as u8);
        cdr.string(&self.name);
        cdr.string(&self.text);
        cdr.string("");
        cdr.string("");
        cdr.u32(0);
    }

    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        let stamp = read_time(cdr)?;
        let at = cdr.at();
        let level = match cdr.u8()? {
            20 => LogLevel::Info,
            30 => LogLevel::Warn,
            40 => LogLevel::Error,
            _ => return Err(CdrError::BadValue { at, reason: "is no level of ours" }),
        };
        let (name, text) = (cdr.string()?.to_owned(), cdr.string()?.to_owned());
        let _file_and_function = (cdr.string()?, cdr.string()?);
        let _line = cdr.u32()?;
        Ok(Self { stamp, level, name, text })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_and_torn_ones_do_not() {
        let transform = TransformStamped {
            header: Header::new(Stamp::from_nanos(1_790_000_000_123_456_789), "world"),
            child_frame_id: "yard-1/imu".to_owned(),
            translation: [1.0, -2.0, 0.1],
            rotation: [0.0, 0.0, 0.6, 0.8],
        };
        let message = TfMessage { transforms: vec![transform.clone(), transform] };
        let bytes = message.encode();
        assert_eq!(TfMessage::decode(&bytes).expect("own bytes"), message);
        let log = Log {
            stamp: Stamp::from_nanos(5),
            level: LogLevel::Warn,
            name: "yard-1".to_owned(),
            text: "GNSS lost: silent".to_owned(),
        };
        let logged = log.encode();
        assert_eq!(Log::decode(&logged).expect("own bytes"), log);
        for length in 0..bytes.len() {
            assert!(TfMessage::decode(&bytes[..length]).is_err(), "{length}");
        }
        for length in 0..logged.len() {
            assert!(Log::decode(&logged[..length]).is_err(), "{length}");
        }
        // A count that the bytes do not have room for.
        let mut many = bytes;
        many[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(TfMessage::decode(&many).is_err());
    }
}
