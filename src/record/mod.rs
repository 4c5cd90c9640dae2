//! Recordings: MCAP files with every machine's messages, written so that a power cut costs one second at most.
//!
//! A file has profile `ros2`; its topics are `/{machine}/{topic}`, ROS 2 messages in CDR with `ros2msg`
//! schemas, reports, events and the journal as JSON without a schema (rosbags refuses a file that holds a schema of
//! another kind). `log_time` is when the recorder received a message, `publish_time` when the machine sent
//! it, which for a reading is when it arrived at the machine. This room touches files, but reads no clock:
//! the caller gives the time. Which sessions there are is the site's business.
//!
//! A topic has a channel for each boot of its machine, for each boot counts its messages anew. The files of a
//! session agree on the numbers of their channels, so that they can be put one after the other as they are.

mod any;
mod boots;
mod check;
mod complete;
mod encode;
mod files;
mod gather;
mod index;
mod journal;
mod ledger;
mod merge;
mod order;
mod places;
mod ranges;
mod read;
mod recover;
mod ring;
mod scan;
mod write;

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::time::Stamp;
use crate::wire::{BootId, Topic};

pub use self::ring::{FILE_BYTES, Ring, RingOptions, RingReader, Shelf};
pub use any::{AnyMessage, AnyMessages, Channel, channels, library, metadata, read_any};
pub use boots::{Published, RecordedBoot, Step};
pub use check::{Checked, Checker, Missing, Stream};
pub use files::files_of;
pub use journal::{BootRun, read_live_runs};
pub use ledger::{Gap, GapCause, GapCounts, Ledger, Plan};
pub use merge::{Piece, merge};
pub use order::{Said, read_in_order, read_said};
pub use places::Places;
pub use ranges::Ranges;
pub use read::{Arrivals, Messages, machines, read_arrivals, read_messages};
pub use recover::{inspect, recover};
pub use write::{ChannelBook, RecordWriter, SYNC_EVERY};

/// Name of the metadata record that tells of the site: `id`, `name`, and the origin of the site frame as
/// `latitude_deg`, `longitude_deg`, `altitude_m`.
pub const SITE: &str = "holdfast.site";
/// Name of the metadata record that says which file of which session it is in: `id`, `file`.
pub const SESSION: &str = "holdfast.session";
/// Name of the metadata record that says whose boot has messages in the file: `machine`, `boot`.
pub const BOOT_SEEN: &str = "holdfast.boot";
/// Name of the metadata record that says how a file was recovered.
const RECOVERY: &str = "holdfast.recovery";
/// Name of the metadata record that says whose an on-board record is, and how the machine was configured.
pub const MACHINE: &str = "holdfast.machine";
/// In a channel's metadata: the boot that counts its messages.
const BOOT: &str = "boot";

/// A message to record, or out of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Recorded<P> {
    /// Whose it is.
    pub machine: String,
    /// What it says.
    pub topic: Topic,
    /// The run of the machine that counts; `None` if nobody told. Each has channels of its own.
    pub boot: Option<BootId>,
    /// The machine's count of this topic since the boot; the file keeps its lower 32 bits.
    pub sequence: u64,
    /// When the recorder received it.
    pub received: Stamp,
    /// When the machine sent it; for a reading, when it arrived at the machine.
    pub sent: Stamp,
    /// CDR or JSON.
    pub payload: P,
}

/// How whole a finished file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FileState {
    /// Closed by its writer.
    Complete,
    /// Its writer died between two chunks; everything that had reached the file is there.
    Recovered,
    /// The file ended within a chunk, or a chunk was damaged: those messages are lost.
    Truncated,
}

impl FileState {
    /// The name in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            FileState::Complete => "complete",
            FileState::Recovered => "recovered",
            FileState::Truncated => "truncated",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [FileState::Complete, FileState::Recovered, FileState::Truncated]
            .into_iter()
            .find(|state| state.name() == name)
    }
}

/// What a finished file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// How whole it is.
    pub state: FileState,
    /// Messages in it.
    pub messages: u64,
    /// Its length.
    pub bytes: u64,
    /// When its first and its last message were received; `None` without messages.
    pub span: Option<(Stamp, Stamp)>,
    /// Whose messages are in it, sorted.
    pub machines: Vec<String>,
    /// Bytes that were given up in recovery.
    pub lost_bytes: u64,
}

/// Why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The system refuses.
    #[error("{}: {what}: {source}", path.display())]
    File {
        /// Which file or folder.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// What the system says.
        source: std::io::Error,
    },
    /// The MCAP library refuses.
    #[error("{}: {what}: {source}", path.display())]
    Mcap {
        /// Which file.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// What it says.
        source: mcap::McapError,
    },
    /// It does not begin as an MCAP file does.
    #[error("{}: is not an MCAP file", path.display())]
    NotMcap {
        /// Which file.
        path: PathBuf,
    },
    /// It was not closed by its writer.
    #[error("{}: was not closed by its writer, and needs recovery", path.display())]
    Unfinished {
        /// Which file.
        path: PathBuf,
    },
    /// It cannot be put together with the others of its session.
    #[error("{}: cannot be put together with the others: {reason}", path.display())]
    Apart {
        /// Which file.
        path: PathBuf,
        /// What does not fit.
        reason: &'static str,
    },
    /// A message cannot be used.
    #[error("{}: {topic} of {machine}, message {sequence}: {source}", path.display())]
    Message {
        /// Which file.
        path: PathBuf,
        /// Whose message.
        machine: String,
        /// Its topic.
        topic: Topic,
        /// Its sequence number.
        sequence: u64,
        /// What is wrong with it.
        source: crate::wire::WireError,
    },
    /// After recovery the file did not hold what was put into it.
    #[error("{}: holds {found} messages after recovery, {written} were written; the torn file was kept", path.display())]
    Miscounted {
        /// Which file.
        path: PathBuf,
        /// Messages that were written.
        written: u64,
        /// Messages that were found.
        found: u64,
    },
}

impl RecordError {
    /// What the system says, if it was the system that refused.
    pub fn system(&self) -> Option<&std::io::Error> {
        match self {
            RecordError::File { source, .. }
            | RecordError::Mcap { source: mcap::McapError::Io(source), .. } => Some(source),
            _ => None,
        }
    }

    /// Whether there is no room.
    pub fn is_disk_full(&self) -> bool {
        self.system().is_some_and(says_full)
    }
}

/// Whether the system says that there is no room.
pub fn says_full(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge)
}

fn file_error<'a>(path: &'a Path, what: &'static str) -> impl Fn(std::io::Error) -> RecordError + 'a {
    move |source| RecordError::File { path: path.to_owned(), what, source }
}

fn mcap_error<'a>(path: &'a Path, what: &'static str) -> impl Fn(mcap::McapError) -> RecordError + 'a {
    move |source| RecordError::Mcap { path: path.to_owned(), what, source }
}

/// Makes a new or renamed entry of the file's folder survive a power cut.
fn sync_folder_of(path: &Path) -> Result<(), RecordError> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    sync_folder(folder).map_err(file_error(folder, "cannot be synced"))
}

/// Makes new and renamed entries of a folder survive a power cut.
///
/// # Errors
/// What the system says.
pub fn sync_folder(folder: &Path) -> std::io::Result<()> {
    std::fs::File::open(folder)?.sync_all()
}

fn channel_name(machine: &str, topic: Topic) -> String {
    format!("/{machine}/{}", topic.name())
}

fn parse_channel_name(name: &str) -> Option<(&str, Topic)> {
    let (machine, topic) = name.strip_prefix('/')?.split_once('/')?;
    Some((machine, Topic::from_name(topic)?))
}

fn stamp_of(nanos: u64) -> Stamp {
    Stamp::from_nanos(i64::try_from(nanos).unwrap_or(i64::MAX))
}

#[cfg(test)]
mod tests;
