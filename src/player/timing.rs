//! When each message is said again.
//!
//! Machines' clocks differ, and messages that were fetched later were received late: each boot's clock is set by
//! the message that took the least time to the recorder, and a message comes when it was sent by that clock. It
//! comes neither after it was received nor before the first message of all was, and never before those that its
//! machine had said before.

use crate::record::Recorded;
use crate::time::{Span, Stamp};
use crate::wire::BootId;

/// A message and its time.
pub(super) struct Due {
    /// After the beginning of the session.
    pub(super) due: Span,
    /// Which machine's.
    pub(super) machine: usize,
    pub(super) message: Recorded<Vec<u8>>,
    /// Nothing of this boot comes after it.
    pub(super) is_last_of_boot: bool,
}

/// The messages of all machines, each machine's in the order given, one after the other.
pub(super) fn in_turn(machines: Vec<Vec<Recorded<Vec<u8>>>>) -> Vec<Due> {
    let received = machines.iter().flatten().map(|message| message.received);
    let begin = received.min().unwrap_or_default();
    let mut turns = Vec::with_capacity(machines.iter().map(Vec::len).sum());
    for (machine, messages) in machines.into_iter().enumerate() {
        let times = times(&messages, begin);
        let boots: Vec<Option<BootId>> = messages.iter().map(|message| message.boot).collect();
        for (index, (message, due)) in messages.into_iter().zip(times).enumerate() {
            let is_last_of_boot = boots.get(index + 1).is_some_and(|next| *next != message.boot);
            turns.push(Due { due, machine, message, is_last_of_boot });
        }
    }
    // Stable: a machine's messages of one time stay in order.
    turns.sort_by_key(|turn| turn.due);
    // Nothing happens before the first.
    let first = turns.first().map_or(Span::default(), |turn| turn.due);
    turns.iter_mut().for_each(|turn| turn.due = Span::from_nanos(turn.due.as_nanos() - first.as_nanos()));
    turns
}

fn times(messages: &[Recorded<Vec<u8>>], begin: Stamp) -> Vec<Span> {
    let mut times = Vec::with_capacity(messages.len());
    let mut latest = begin;
    for boot in messages.chunk_by(|one, other| one.boot == other.boot) {
        let transit = boot.iter().map(|message| message.received - message.sent).min().unwrap_or_default();
        for message in boot {
            let at = (message.sent + transit).min(message.received);
            latest = latest.max(at);
            times.push(latest - begin);
        }
    }
    times
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Topic;

    fn message(boot: u64, sequence: u64, sent: i64, received: i64) -> Recorded<Vec<u8>> {
        Recorded {
            machine: "a".to_owned(),
            topic: Topic::Event,
            boot: Some(BootId(boot)),
            sequence,
            received: Stamp::from_nanos(received),
            sent: Stamp::from_nanos(sent),
            payload: vec![],
        }
    }

    fn told(turns: &[Due]) -> Vec<(i64, usize, u64, bool)> {
        let told =
            |turn: &Due| (turn.due.as_nanos(), turn.machine, turn.message.sequence, turn.is_last_of_boot);
        turns.iter().map(told).collect()
    }

    #[test]
    fn machines_come_by_one_clock_and_what_was_late_comes_in_its_place() {
        // The first machine's clock is 1000 behind, its second message was fetched; it starts again with its clock
        // set right. The second machine's is years ahead.
        let first = vec![
            message(1, 0, 4_000, 5_000),
            message(1, 1, 4_010, 9_000),
            message(1, 2, 4_020, 5_025),
            message(2, 0, 5_100, 5_101),
        ];
        let years = 1_000_000_000;
        let second = vec![message(3, 0, years + 5_002, 5_012), message(3, 1, years + 5_012, 5_022)];
        assert_eq!(
            told(&in_turn(vec![first, second])),
            [
                (0, 0, 0, false),
                (10, 0, 1, false),
                (12, 1, 0, false),
                (20, 0, 2, true),
                (22, 1, 1, false),
                (101, 0, 0, false)
            ]
        );
        assert!(in_turn(vec![vec![], vec![]]).is_empty());
    }

    #[test]
    fn clock_that_is_set_makes_nobody_wait() {
        let day = 86_400_000_000_000;
        let set = vec![message(1, 0, 10, 10), message(1, 1, day, 20), message(1, 2, day + 10, 30)];
        let turns = in_turn(vec![set]);
        assert!(turns.iter().all(|turn| turn.due.as_nanos() <= 20), "{:?}", told(&turns));
        assert_eq!(turns.iter().map(|turn| turn.message.sequence).collect::<Vec<_>>(), [0, 1, 2]);
    }
}
