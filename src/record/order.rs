//! A machine's messages in the order in which it sent them, whatever the order in which they were received.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

use super::read::PROGRESS_EVERY;
use super::{RecordError, Recorded, read_messages};
use crate::time::Stamp;
use crate::wire::{BootId, JournalHead, Topic, decode_journal_page};

/// By what something that was sent has its place among the others.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rank {
    pub boot: Option<BootId>,
    pub topic: Topic,
    pub sequence: u64,
    pub sent: Stamp,
}

/// What has a place.
pub(super) trait Ranked {
    fn rank(&self) -> Rank;
}

impl<P> Ranked for Recorded<P> {
    fn rank(&self) -> Rank {
        let Self { boot, topic, sequence, sent, .. } = *self;
        Rank { boot, topic, sequence, sent }
    }
}

/// What was sent in one boot.
type Topics<T> = BTreeMap<Topic, Vec<T>>;

/// Reads all messages of `machine` from the files of a session: boot by boot, and within a boot by the time of
/// sending; those of one topic in the order of their numbers, even if the machine's clock was set back. What is
/// there twice comes once. Holds them all in memory.
///
/// Where a recording does not tell boots, messages are by time of sending alone.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_in_order<'a>(
    paths: impl IntoIterator<Item = &'a Path>,
    machine: &str,
) -> Result<Vec<Recorded<Vec<u8>>>, RecordError> {
    let mut messages = Vec::new();
    for path in paths {
        for message in read_messages(path)? {
            let message = message?;
            if message.machine == machine {
                messages.push(message);
            }
        }
    }
    Ok(sorted(messages))
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

/// Reads all that `machine` said from the files of one or more sessions, as [`read_in_order`] does; `tell`
/// hears how many bytes were read. All of it is held in memory, some 200 kB for each second of a machine at 100 Hz.
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

/// What one machine sent, in that order.
pub(super) fn sorted<T: Ranked>(messages: Vec<T>) -> Vec<T> {
    let mut boots: BTreeMap<Option<BootId>, Topics<T>> = BTreeMap::new();
    for message in messages {
        let Rank { boot, topic, .. } = message.rank();
        boots.entry(boot).or_default().entry(topic).or_default().push(message);
    }
    let mut runs: Vec<(Stamp, Vec<T>)> = Vec::new();
    for (boot, topics) in boots {
        let first = topics.values().flatten().map(|message| message.rank().sent).min().unwrap_or_default();
        runs.push((first, in_order(topics, boot.is_some())));
    }
    runs.sort_by_key(|(first, _)| *first);
    runs.into_iter().flat_map(|(_, messages)| messages).collect()
}

fn in_order<T: Ranked>(topics: Topics<T>, counted: bool) -> Vec<T> {
    // Each topic with the time at which a message may come: not before those of its topic.
    let mut queues: Vec<VecDeque<(Stamp, T)>> = Vec::new();
    for mut messages in topics.into_values() {
        if counted {
            messages.sort_by_key(|message| message.rank().sequence);
            messages.dedup_by_key(|message| message.rank().sequence);
        } else {
            messages.sort_by_key(|message| message.rank().sent);
        }
        let mut latest: Option<Stamp> = None;
        let due = messages.into_iter().map(|message| {
            let sent = message.rank().sent;
            let at = latest.map_or(sent, |latest| latest.max(sent));
            latest = Some(at);
            (at, message)
        });
        queues.push(due.collect());
    }
    let mut next: BTreeSet<(Stamp, usize)> = BTreeSet::new();
    for (index, queue) in queues.iter().enumerate() {
        next.extend(queue.front().map(|(at, _)| (*at, index)));
    }
    let mut ordered = Vec::with_capacity(queues.iter().map(VecDeque::len).sum());
    while let Some((_, index)) = next.pop_first() {
        ordered.extend(queues[index].pop_front().map(|(_, message)| message));
        next.extend(queues[index].front().map(|(at, _)| (*at, index)));
    }
    ordered
}
