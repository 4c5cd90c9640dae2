//! What goes over the wire: keys, ROS 2 messages in CDR, JSON reports, and the attachment of each publication.
//!
//! Bytes become values here and values bytes, nothing else: sessions are the shells' business, files are
//! the `record` room's. Malformed input gives an error that says what is wrong and where; it never panics
//! and never allocates more than it brought.

mod attachment;
mod backfill;
mod cdr;
mod convert;
mod journal;
mod keys;
mod messages;
mod report;
mod schema;
mod shown;
mod topic;

pub use attachment::{ATTACHMENT_BYTES, Attachment, BootId};
pub use backfill::{BATCH_BYTES_MAX, Batch, HeldBoot, Holdings, Kept, Range, RecordRequest, Wanted};
pub use cdr::{CdrError, CdrReader, CdrWriter};
pub use convert::{decode_reading, encode_reading, odom_message, pose_message};
pub use journal::{JournalHead, JournalPage, PAGE_READINGS_MAX};
pub use keys::{
    Key, KeyError, alive_key, alive_selector, configuration_key, record_key, topic_key, topic_selector,
};
pub use messages::{Header, Imu, JointState, NavSatFix, NavSatStatus, Odometry, RosMessage};
pub use report::{
    Latency, MachineReport, OnBoardRecord, Origin, RigidMotion, decode_event, decode_journal_page,
    decode_report, encode_json, payload_stamp,
};
pub use schema::{Schema, schema_of};
pub use shown::{Log, LogLevel, TfMessage, TransformStamped};
pub use topic::Topic;

/// Why bytes from the wire cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The CDR bytes do not hold the message.
    #[error("{message}: {source}")]
    Cdr {
        /// Type of the message that was expected.
        message: &'static str,
        /// What is wrong with the bytes.
        source: CdrError,
    },
    /// The message is well formed, but says nothing that can be used.
    #[error("{message}: {reason}")]
    Unusable {
        /// Type of the message.
        message: &'static str,
        /// What is wrong with its content.
        reason: String,
    },
    /// The JSON text does not hold the message.
    #[error("{message}: {source}")]
    Json {
        /// Type of the message that was expected.
        message: &'static str,
        /// What is wrong with the text.
        source: serde_json::Error,
    },
    /// Longer than any message of its kind may be.
    #[error("{message}: {length} bytes, at most {limit} are taken")]
    TooLong {
        /// Type of the message that was expected.
        message: &'static str,
        /// Bytes that came.
        length: usize,
        /// Bytes that are taken.
        limit: usize,
    },
    /// The attachment is not ours.
    #[error("attachment: {0}")]
    Attachment(String),
}
