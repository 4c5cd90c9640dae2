//! How good the link to one machine is: gaps, rate, clock offset. Bounded memory, no clock.

use std::collections::{BTreeMap, VecDeque};

use super::{Publication, Topic};
use crate::time::{Span, Stamp};

/// Length of a slot of [`Rate`].
const SLOT_NANOS: i64 = 100_000_000;
/// Slots that make up the rate: one second.
const SLOTS: usize = 10;
/// The offset is the minimum over one to two of these, so that it follows a drifting clock.
const OFFSET_WINDOW: Span = Span::from_millis(60_000);

/// Messages of one machine: how many came, how many did not.
#[derive(Debug, Default)]
pub(super) struct Gaps {
    next: BTreeMap<Topic, u64>,
    pub received: u64,
    pub missed: u64,
}

impl Gaps {
    /// Counts one message. What was sent before the first one that we saw of a boot is not missed: nobody
    /// may have listened.
    pub fn count(&mut self, topic: Topic, sequence: u64) {
        self.received += 1;
        let next = self.next.entry(topic).or_insert(sequence);
        // A number from before the expected one is a repetition, or a stray after a counted gap: no gap.
        self.missed = self.missed.saturating_add(sequence.saturating_sub(*next));
        *next = (*next).max(sequence.saturating_add(1));
    }

    /// The machine counts from zero again.
    pub fn restart(&mut self) {
        self.next.clear();
    }
}

/// Messages in a second, over whole slots, so that the number is calm and falls to zero by itself.
#[derive(Debug, Default)]
pub(super) struct Rate {
    /// The newest slot is at `newest % len`; one more than is summed, because the newest is not full yet.
    counts: [u32; SLOTS + 1],
    newest: i64,
}

impl Rate {
    /// Counts one message at `now`.
    pub fn count(&mut self, now: Stamp) {
        let slot = now.as_nanos().div_euclid(SLOT_NANOS);
        if slot > self.newest {
            let passed = (slot - self.newest).min(self.counts.len() as i64);
            for step in 0..passed {
                self.counts[Self::place(slot - step)] = 0;
            }
            self.newest = slot;
        }
        let count = &mut self.counts[Self::place(self.newest)];
        *count = count.saturating_add(1);
    }

    /// Messages in the last whole second before the slot of `now`, Hz.
    pub fn hertz(&self, now: Stamp) -> f64 {
        let slot = now.as_nanos().div_euclid(SLOT_NANOS);
        let oldest = (slot - SLOTS as i64).max(self.newest - SLOTS as i64);
        let counted = (oldest..slot).filter(|slot| *slot <= self.newest);
        counted.map(|slot| f64::from(self.counts[Self::place(slot)])).sum()
    }

    fn place(slot: i64) -> usize {
        slot.rem_euclid(SLOTS as i64 + 1) as usize
    }
}

/// Intervals that are remembered; one that is long because the machine paused does not count.
const INTERVALS: usize = 5;

/// The usual time between two messages of a topic, by the site's clock. Messages that were lost do not make it
/// longer: it is told by their numbers how many there were.
#[derive(Debug, Default)]
pub(super) struct Interval {
    last: Option<(u64, Stamp)>,
    recent: VecDeque<Span>,
}

impl Interval {
    /// Counts the message `sequence` at `now`.
    pub fn observe(&mut self, sequence: u64, now: Stamp) {
        if let Some((before, at)) = self.last {
            let count = i64::try_from(sequence.saturating_sub(before)).unwrap_or(i64::MAX);
            if count == 0 {
                return;
            }
            if self.recent.len() == INTERVALS {
                self.recent.pop_front();
            }
            self.recent.push_back(Span::from_nanos((now - at).as_nanos().max(0) / count));
        }
        self.last = Some((sequence, now));
    }

    /// The median of the last ones, the shorter of two in the middle; `None` before there are two.
    pub fn usual(&self) -> Option<Span> {
        if self.recent.len() < 2 {
            return None;
        }
        let mut sorted: Vec<Span> = self.recent.iter().copied().collect();
        sorted.sort_unstable();
        Some(sorted[(sorted.len() - 1) / 2])
    }
}

/// Estimate of the site's clock less the machine's, from the messages' sending times: the minimum of received
/// less sent, which is the offset plus the shortest transit.
#[derive(Debug, Default)]
pub(super) struct ClockOffset {
    window_start: Option<Stamp>,
    current: Option<Span>,
    previous: Option<Span>,
}

impl ClockOffset {
    /// Takes in one message that arrived at `now`.
    pub fn observe(&mut self, publication: &Publication, now: Stamp) {
        let difference = now - publication.sent;
        match self.window_start {
            Some(start) if now - start < OFFSET_WINDOW => {
                self.current = Some(self.current.map_or(difference, |least| least.min(difference)));
            }
            _ => {
                self.previous = self.current;
                self.current = Some(difference);
                self.window_start = Some(now);
            }
        }
    }

    /// The estimate, s; `None` before the first message.
    pub fn seconds(&self) -> Option<f64> {
        self.current.into_iter().chain(self.previous).min().map(Span::as_seconds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Stamp {
        Stamp::from_seconds(1_000.0 + seconds)
    }

    #[test]
    fn gaps_are_counted_per_topic_and_repetitions_are_not() {
        let mut gaps = Gaps::default();
        for (topic, sequence) in
            [(Topic::Pose, 7), (Topic::Pose, 8), (Topic::Odom, 0), (Topic::Pose, 12), (Topic::Pose, 12)]
        {
            gaps.count(topic, sequence);
        }
        assert_eq!((gaps.received, gaps.missed), (5, 3));
        gaps.restart();
        gaps.count(Topic::Pose, 0);
        assert_eq!((gaps.received, gaps.missed), (6, 3));
    }

    #[test]
    fn sequence_at_the_end_of_its_range_does_not_overflow() {
        let mut gaps = Gaps::default();
        gaps.count(Topic::Pose, 0);
        gaps.count(Topic::Pose, u64::MAX);
        gaps.count(Topic::Odom, 0);
        gaps.count(Topic::Odom, u64::MAX);
        assert_eq!(gaps.missed, u64::MAX);
    }

    #[test]
    fn rate_is_that_of_the_last_second_and_falls_to_zero() {
        let mut rate = Rate::default();
        assert_eq!(rate.hertz(at(0.0)), 0.0);
        for sample in 0..300 {
            rate.count(at(f64::from(sample) * 0.01));
        }
        assert_eq!(rate.hertz(at(3.0)), 100.0);
        assert_eq!(rate.hertz(at(3.05)), 100.0);
        assert_eq!(rate.hertz(at(3.5)), 50.0);
        assert_eq!(rate.hertz(at(4.0)), 0.0);
        assert_eq!(rate.hertz(at(1_000_000.0)), 0.0);
        rate.count(at(2_000_000.0));
        assert_eq!(rate.hertz(at(2_000_000.1)), 1.0);
    }

    #[test]
    fn interval_is_the_usual_one_whatever_was_lost_or_late() {
        let mut interval = Interval::default();
        for (sequence, seconds) in [(0, 0.0), (1, 1.0)] {
            interval.observe(sequence, at(seconds));
        }
        assert_eq!(interval.usual(), None, "one may be a pause");
        // Numbers 2 and 3 are lost, 5 comes after a pause, 6 twice.
        for (sequence, seconds) in [(4, 4.0), (5, 90.0), (6, 91.0), (6, 91.5), (7, 92.0)] {
            interval.observe(sequence, at(seconds));
        }
        assert_eq!(interval.usual(), Some(Span::from_millis(1000)));
    }

    #[test]
    fn clock_offset_is_the_least_difference_and_follows_the_clock() {
        let mut offset = ClockOffset::default();
        let mut observe = |sent: f64, received: f64| {
            let publication = Publication { sequence: 0, boot: 1, stamp: at(sent), sent: at(sent) };
            offset.observe(&publication, at(received));
            offset.seconds().expect("observed")
        };
        assert!((observe(0.0, 2.010) - 2.010).abs() < 1e-9);
        assert!((observe(1.0, 3.001) - 2.001).abs() < 1e-9);
        assert!((observe(2.0, 4.300) - 2.001).abs() < 1e-9, "a late message does not change it");
        // The machine's clock was set right: within two windows the old minimum is forgotten.
        for second in 5..130 {
            observe(f64::from(second), f64::from(second) + 5.0);
        }
        assert!((offset.seconds().expect("observed") - 5.0).abs() < 1e-9);
    }
}
