//! A machine's messages in the order in which it sent them, whatever the order in which they were received.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

use super::{RecordError, Recorded, read_messages};
use crate::time::Stamp;
use crate::wire::{BootId, Topic};

/// The messages of one boot.
type Topics = BTreeMap<Topic, Vec<Recorded<Vec<u8>>>>;

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

/// The messages of one machine in that order.
pub(super) fn sorted(messages: Vec<Recorded<Vec<u8>>>) -> Vec<Recorded<Vec<u8>>> {
    let mut boots: BTreeMap<Option<BootId>, Topics> = BTreeMap::new();
    for message in messages {
        boots.entry(message.boot).or_default().entry(message.topic).or_default().push(message);
    }
    let mut runs: Vec<(Stamp, Vec<Recorded<Vec<u8>>>)> = Vec::new();
    for (boot, topics) in boots {
        let first = topics.values().flatten().map(|message| message.sent).min().unwrap_or_default();
        runs.push((first, in_order(topics, boot.is_some())));
    }
    runs.sort_by_key(|(first, _)| *first);
    runs.into_iter().flat_map(|(_, messages)| messages).collect()
}

fn in_order(topics: Topics, counted: bool) -> Vec<Recorded<Vec<u8>>> {
    // Each topic with the time at which a message may come: not before those of its topic.
    let mut queues: Vec<VecDeque<(Stamp, Recorded<Vec<u8>>)>> = Vec::new();
    for mut messages in topics.into_values() {
        if counted {
            messages.sort_by_key(|message| message.sequence);
            messages.dedup_by_key(|message| message.sequence);
        } else {
            messages.sort_by_key(|message| message.sent);
        }
        let mut latest: Option<Stamp> = None;
        let due = messages.into_iter().map(|message| {
            let at = latest.map_or(message.sent, |latest| latest.max(message.sent));
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
