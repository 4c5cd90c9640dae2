//! Everything that a recording holds of a machine's boots: what its estimator took, and what it published.

use std::collections::BTreeMap;
use std::path::Path;

use super::journal::runs_of;
use super::order::sorted;
use super::read::PROGRESS_EVERY;
use super::{BootRun, RecordError, Recorded, read_messages};
use crate::state::LiveRun;
use crate::wire::{BootId, JournalHead, Topic, decode_journal_page};

/// A published pose, as it was sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Published {
    /// Its number, the lower 32 bits.
    pub sequence: u32,
    /// CDR.
    pub payload: Vec<u8>,
}

/// One boot of a machine.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedBoot {
    /// Which; `None` in recordings that do not tell.
    pub boot: Option<BootId>,
    /// Who took the readings, if the recording tells.
    pub head: Option<JournalHead>,
    /// From the boot on, without a gap; what came after one is not in it.
    pub run: LiveRun,
    /// What is missing, if something is: the run ends before it.
    pub gap: Option<String>,
    /// Readings of the boot in the recording, whether the run has them or not.
    pub readings: u64,
    /// Topic `pose`, in the order of the numbers.
    pub poses: Vec<Published>,
    /// Topic `odom`, the same.
    pub odoms: Vec<Published>,
}

/// All boots of a machine.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordedBoots {
    /// Oldest first.
    pub boots: Vec<RecordedBoot>,
    /// Bytes of the files that could not be read: damaged chunks and torn ends.
    pub lost_bytes: u64,
}

/// Reads the boots of `machine` from the files of one or more sessions; `tell` hears how many bytes were read. All
/// of it is held in memory, some 200 kB for each second of a machine at 100 Hz.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_boots<'a>(
    paths: impl IntoIterator<Item = &'a Path>,
    machine: &str,
    mut tell: impl FnMut(u64),
) -> Result<RecordedBoots, RecordError> {
    let Said { messages, mut heads, lost_bytes } = read_said(paths, machine, &mut tell)?;
    let mut boots: Vec<RecordedBoot> = Vec::new();
    let mut others = Vec::new();
    for message in messages {
        if !matches!(message.topic, Topic::Health | Topic::Event)
            && boots.last().is_none_or(|last| last.boot != message.boot)
        {
            let head = message.boot.and_then(|boot| heads.remove(&boot));
            boots.push(RecordedBoot::without_journal(message.boot, head));
        }
        match boots.last_mut() {
            Some(last) if matches!(message.topic, Topic::Pose | Topic::Odom) => last.put(message),
            last => {
                if let (Some(last), Topic::Sensor(_)) = (last, message.topic) {
                    last.readings += 1;
                }
                others.push(message);
            }
        }
    }
    for BootRun { boot, head, run, gap } in runs_of(others) {
        if let Some(found) = boots.iter_mut().find(|found| found.boot == Some(boot)) {
            found.head = head.or(found.head.take());
            (found.run, found.gap) = (run, gap);
        }
    }
    Ok(RecordedBoots { boots, lost_bytes })
}

/// All that a machine said, and what is known of its boots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Said {
    /// Boot by boot, in the order in which the machine sent them.
    pub messages: Vec<Recorded<Vec<u8>>>,
    /// Out of the metadata of on-board records; the journal tells of others.
    pub heads: BTreeMap<BootId, JournalHead>,
    /// Bytes of the files that could not be read: damaged chunks and torn ends.
    pub lost_bytes: u64,
}

impl Said {
    /// The newest machine file in it.
    pub fn machine_file(&self) -> Option<String> {
        let pages = self.messages.iter().rev().filter(|message| message.topic == Topic::Journal);
        let told = pages.filter_map(|message| decode_journal_page(&message.payload).ok()?.head);
        let mut told = told.map(|head| head.machine_file);
        told.next().or_else(|| self.heads.values().next_back().map(|head| head.machine_file.clone()))
    }
}

/// Reads all that `machine` said from the files of one or more sessions, as [`super::read_in_order`] does; `tell`
/// hears how many bytes were read.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_said<'a>(
    paths: impl IntoIterator<Item = &'a Path>,
    machine: &str,
    mut tell: impl FnMut(u64),
) -> Result<Said, RecordError> {
    let mut said = Said::default();
    let (mut bytes_before, mut read) = (0, 0_u64);
    for path in paths {
        let mut messages = read_messages(path)?;
        while let Some(message) = messages.next() {
            let message = message?;
            if message.machine == machine {
                said.messages.push(message);
            }
            read += 1;
            if read.is_multiple_of(PROGRESS_EVERY) {
                tell(bytes_before + messages.read_bytes());
            }
        }
        bytes_before += messages.read_bytes();
        said.lost_bytes += messages.lost_bytes();
        let own = messages.about().iter().filter(|((of, _), _)| of == machine);
        said.heads.extend(own.map(|((_, boot), head)| (*boot, head.clone())));
    }
    said.messages = sorted(said.messages);
    Ok(said)
}

impl RecordedBoot {
    fn without_journal(boot: Option<BootId>, head: Option<JournalHead>) -> Self {
        let gap = Some("there is no journal of it".to_owned());
        Self { boot, head, run: LiveRun::default(), gap, readings: 0, poses: Vec::new(), odoms: Vec::new() }
    }

    fn put(&mut self, message: Recorded<Vec<u8>>) {
        let published = Published { sequence: message.sequence as u32, payload: message.payload };
        match message.topic {
            Topic::Odom => self.odoms.push(published),
            _ => self.poses.push(published),
        }
    }
}
