//! Which messages of each machine the recordings have, which they lack, and which are lost for good.
//!
//! Pure: told what was written, what reached the disk, and what machines hold on board; says what to fetch.
//! Machines count the messages of a topic from 0 at each boot, so that whatever is missing before the highest
//! number seen is a gap, and so is whatever a machine holds and the recordings do not.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::Ranges;
use super::ranges::widen_near;
use crate::wire::{BootId, HeldBoot, Holdings, Kept, Topic, Wanted};

/// Of so many boots of a machine that are closed it is remembered that they were.
const CLOSED_MAX: usize = 256;

/// Why messages will never be in a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GapCause {
    /// The on-board record is a ring, and what is there now is younger.
    Overwritten,
    /// The machine's configuration has no on-board record.
    NotKept,
    /// They are not in the on-board record, and were not: its disk did not keep up, or power failed.
    NotOnBoard,
    /// The machine did not answer until the session ended. They are fetched if it ever comes back.
    Unreachable,
}

impl GapCause {
    /// The name in files.
    pub const fn name(self) -> &'static str {
        match self {
            GapCause::Overwritten => "overwritten",
            GapCause::NotKept => "not_kept",
            GapCause::NotOnBoard => "not_on_board",
            GapCause::Unreachable => "unreachable",
        }
    }
}

/// Messages that are missing, and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gap {
    /// Whose.
    pub machine: String,
    /// Since when they are counted.
    pub boot: BootId,
    /// Of which topic.
    pub topic: Topic,
    /// Their numbers.
    pub range: Range<u64>,
    /// Why.
    pub cause: GapCause,
}

impl Gap {
    /// Name of the metadata record that tells of it.
    pub const NAME: &str = "holdfast.gap";

    /// What that record says.
    pub fn entries(&self) -> BTreeMap<String, String> {
        let entries = [
            ("machine", self.machine.clone()),
            ("boot", self.boot.to_string()),
            ("topic", self.topic.name().to_owned()),
            ("from", self.range.start.to_string()),
            ("to", self.range.end.saturating_sub(1).to_string()),
            ("cause", self.cause.name().to_owned()),
        ];
        entries.map(|(key, value)| (key.to_owned(), value)).into()
    }
}

/// Messages of a machine that are missing in the recordings, and that were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GapCounts {
    /// Missing, and not given up.
    pub open: u64,
    /// Fetched from the on-board record.
    pub filled: u64,
    /// Missing for good.
    pub lost: u64,
}

/// The books of all machines.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ledger {
    machines: BTreeMap<String, Book>,
    /// Lost for good, and no recording tells of it so far.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    untold: Vec<Gap>,
    /// Streams with something that is not on the disk.
    #[serde(skip)]
    unsynced: BTreeSet<(String, BootId, Topic)>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Book {
    /// Oldest first, as far as the machine tells.
    order: Vec<BootId>,
    boots: BTreeMap<BootId, BTreeMap<Topic, Stream>>,
    /// Those of which the machine held something when it was asked.
    #[serde(default)]
    held: BTreeSet<BootId>,
    /// When the machine was first met it may have worked for days: what came before is no gap.
    met_in: Option<BootId>,
    filled: u64,
    /// Of boots that are closed.
    #[serde(default)]
    lost_before: u64,
    /// Boots that have ended and that the machine holds no more: what they lack is lost, and nothing else is known of
    /// them. Oldest first.
    #[serde(default, skip_serializing_if = "VecDeque::is_empty")]
    closed: VecDeque<BootId>,
}

/// One topic of one boot.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Stream {
    /// From here on what is missing is a gap.
    #[serde(default)]
    base: u64,
    /// On the disk.
    had: Ranges,
    #[serde(default, skip_serializing_if = "Ranges::is_empty")]
    lost: Ranges,
    /// Missing, and a session that has ended says so.
    #[serde(default, skip_serializing_if = "Ranges::is_empty")]
    told: Ranges,
    /// Written, but perhaps not on the disk.
    #[serde(skip)]
    unsynced: Ranges,
}

impl Stream {
    fn has(&self, number: u64) -> bool {
        self.had.contains(number) || self.unsynced.contains(number)
    }

    /// What is missing between messages that are there.
    fn holes(&self) -> Ranges {
        let settled = self.settled();
        settled.missing_in(self.base..settled.end())
    }

    /// Nothing more is to be done for these.
    fn settled(&self) -> Ranges {
        let mut settled = self.had.clone();
        settled.extend(&self.unsynced);
        settled.extend(&self.lost);
        settled
    }
}

impl Book {
    /// The stream; a new one begins at `number` if the machine was not met before this boot.
    fn stream(&mut self, boot: BootId, topic: Topic, number: u64) -> &mut Stream {
        let met_now = *self.met_in.get_or_insert(boot) == boot;
        if !self.boots.contains_key(&boot) {
            self.order.push(boot);
        }
        let base = match () {
            // Such as in a file that is read once more: the rest may be in others.
            () if self.closed.contains(&boot) => u64::MAX,
            () if met_now => number,
            () => 0,
        };
        let fresh = || Stream { base, ..Stream::default() };
        self.boots.entry(boot).or_default().entry(topic).or_insert_with(fresh)
    }

    /// Of boots that can get nothing more, keeps what is lost as a number, and the name.
    fn close(&mut self, boots: &[BootId]) {
        for boot in boots {
            let topics = self.boots.remove(boot).unwrap_or_default();
            self.lost_before += topics.values().map(|stream| stream.lost.count()).sum::<u64>();
            self.held.remove(boot);
            if !self.closed.contains(boot) {
                self.closed.push_back(*boot);
            }
        }
        self.order.retain(|boot| !boots.contains(boot));
        let spare = self.closed.len().saturating_sub(CLOSED_MAX);
        self.closed.drain(..spare);
    }
}

/// What is to be done for a machine.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// To be fetched, oldest boot first.
    pub wanted: Vec<(BootId, Wanted)>,
    /// Can never be fetched; already in the books.
    pub lost: Vec<Gap>,
}

impl Plan {
    /// Messages to be fetched.
    pub fn count(&self) -> u64 {
        let ranges = self.wanted.iter().flat_map(|(_, wanted)| wanted.values().flatten());
        ranges.map(|[first, last]| last - first + 1).sum()
    }
}

impl Ledger {
    /// A message is about to be written: false if it is there already, and must not be written again.
    pub fn admit(&mut self, machine: &str, boot: BootId, topic: Topic, number: u64) -> bool {
        let stream = self.stream(machine, boot, topic, number);
        if stream.has(number) {
            return false;
        }
        let first = stream.unsynced.is_empty();
        stream.unsynced.insert(number);
        if first {
            self.unsynced.insert((machine.to_owned(), boot, topic));
        }
        true
    }

    /// Everything that was admitted is on the disk.
    pub fn synced(&mut self) {
        for (stream, had) in self.take_unsynced() {
            stream.had.extend(&had);
            // What was given up may come after all.
            stream.lost = stream.lost.without(&had);
        }
    }

    /// What was admitted since the disk was last in step is lost with its file: it is missing again.
    pub fn revoke(&mut self) {
        drop(self.take_unsynced());
    }

    fn take_unsynced(&mut self) -> Vec<(&mut Stream, Ranges)> {
        let dirty = std::mem::take(&mut self.unsynced);
        let mut taken = Vec::new();
        if dirty.is_empty() {
            return taken;
        }
        for (machine, book) in &mut self.machines {
            for (boot, topics) in &mut book.boots {
                for (topic, stream) in topics {
                    if dirty.contains(&(machine.clone(), *boot, *topic)) {
                        let unsynced = std::mem::take(&mut stream.unsynced);
                        taken.push((stream, unsynced));
                    }
                }
            }
        }
        taken
    }

    /// A message is in a file on the disk, which keeps the lower 32 bits of its number.
    pub fn found(&mut self, machine: &str, boot: BootId, topic: Topic, lower: u32) {
        let stream = self.stream(machine, boot, topic, u64::from(lower));
        stream.had.insert(widen_near(lower, stream.had.end().saturating_sub(1)));
    }

    /// A message is not wanted in any recording, such as while nobody wants to record.
    pub fn pass(&mut self, machine: &str, boot: BootId, topic: Topic, number: u64) {
        self.stream(machine, boot, topic, number).had.insert(number);
    }

    /// How many of these were not written and not given up.
    pub fn count_missing(&self, machine: &str, boot: BootId, numbers: &BTreeMap<Topic, Ranges>) -> u64 {
        let topics = self.machines.get(machine).and_then(|book| book.boots.get(&boot));
        let missing = |(topic, numbers): (&Topic, &Ranges)| {
            let stream = topics.and_then(|topics| topics.get(topic));
            stream.map_or(numbers.count(), |stream| numbers.without(&stream.settled()).count())
        };
        numbers.iter().map(missing).sum()
    }

    /// So many messages were fetched.
    pub fn filled(&mut self, machine: &str, count: u64) {
        if let Some(book) = self.machines.get_mut(machine) {
            book.filled += count;
        }
    }

    /// How much is missing between a machine's messages.
    pub fn counts(&self, machine: &str) -> GapCounts {
        let Some(book) = self.machines.get(machine) else { return GapCounts::default() };
        let mut counts = GapCounts { filled: book.filled, lost: book.lost_before, open: 0 };
        for stream in book.boots.values().flat_map(BTreeMap::values) {
            counts.open += stream.holes().count();
            counts.lost += stream.lost.count();
        }
        counts
    }

    /// The gaps that nobody could fill so far, and of which no session tells: one that ends does, and says so by
    /// [`Ledger::open_gaps_were_told`].
    pub fn open_gaps(&self) -> Vec<Gap> {
        let mut gaps = Vec::new();
        for (machine, book) in &self.machines {
            for (boot, topics) in &book.boots {
                for (topic, stream) in topics {
                    let gap = |range| {
                        let machine = machine.clone();
                        Gap { machine, boot: *boot, topic: *topic, range, cause: GapCause::Unreachable }
                    };
                    gaps.extend(stream.holes().without(&stream.told).iter().map(gap));
                }
            }
        }
        gaps
    }

    /// A session that is on the disk tells of the gaps that are open now.
    pub fn open_gaps_were_told(&mut self) {
        let books = self.machines.values_mut();
        for stream in books.flat_map(|book| book.boots.values_mut()).flat_map(BTreeMap::values_mut) {
            stream.told = stream.holes();
        }
    }

    /// What is lost for good and not told in any recording: to be written, and synced, and then
    /// [`Ledger::were_told`].
    pub fn untold(&self) -> &[Gap] {
        &self.untold
    }

    /// The first so many of the untold gaps are told in a recording that is on the disk.
    pub fn were_told(&mut self, count: usize) {
        self.untold.drain(..count.min(self.untold.len()));
    }

    /// Gives up what of these is still missing.
    pub fn lose(
        &mut self,
        machine: &str,
        boot: BootId,
        topic: Topic,
        numbers: &Ranges,
        cause: GapCause,
    ) -> Vec<Gap> {
        if numbers.is_empty() {
            return Vec::new();
        }
        let stream = self.stream(machine, boot, topic, 0);
        let numbers = numbers.without(&stream.settled());
        stream.lost.extend(&numbers);
        let gap = |range| Gap { machine: machine.to_owned(), boot, topic, range, cause };
        let gaps: Vec<Gap> = numbers.iter().map(gap).collect();
        self.untold.extend_from_slice(&gaps);
        gaps
    }

    /// These were asked for, and are not in the answer. `holdings` is what the machine holds after that: what it
    /// does not have then is lost.
    pub fn not_there(
        &mut self,
        machine: &str,
        boot: BootId,
        numbers: &BTreeMap<Topic, Ranges>,
        holdings: &Holdings,
    ) -> Vec<Gap> {
        let mut gaps = Vec::new();
        // A boot that is gone as a whole is found to be when plans are made.
        let Some(held) = of_boot(holdings, boot).filter(|held| !held.unread) else { return gaps };
        for (topic, numbers) in numbers {
            for (numbers, cause) in by_cause(held, *topic, numbers) {
                gaps.extend(self.lose(machine, boot, *topic, &numbers, cause));
            }
        }
        gaps
    }

    /// What to fetch of what a machine holds. `before` is what it held some seconds ago: the last messages of the
    /// boot that runs, held even then, are missing if they have not come by themselves by now; and a boot that
    /// was not there even then is overwritten.
    pub fn plan(&mut self, machine: &str, holdings: &Holdings, before: Option<&Holdings>) -> Plan {
        let book = self.machines.entry(machine.to_owned()).or_default();
        let mut plan = Plan::default();
        let mut lost: Vec<(BootId, Topic, Ranges, GapCause)> = Vec::new();
        if holdings.kept == Kept::NotNow {
            return plan;
        }
        book.meet(holdings);
        let nothing_is_overwritten = holdings.boots.iter().all(|held| held.overwritten.is_empty());
        if holdings.kept == Kept::Yes {
            // A closed one may be there again, with a disk that was away: what was recorded of it is forgotten.
            for held in holdings.boots.iter().filter(|held| !book.closed.contains(&held.boot)) {
                let earlier = before.and_then(|before| of_boot(before, held.boot));
                let wanted = book.compare(held, earlier, &mut lost);
                if !wanted.is_empty() {
                    plan.wanted.push((held.boot, wanted));
                }
            }
        }
        let mut ended = Vec::new();
        for (boot, topics) in &book.boots {
            let held = of_boot(holdings, *boot).is_some();
            let gone = !held && before.is_some_and(|before| of_boot(before, *boot).is_none());
            if !gone {
                continue;
            }
            let cause = match holdings.kept {
                Kept::No => GapCause::NotKept,
                // Such as the last second before a power cut, if it was the first one, too.
                _ if !book.held.contains(boot) && nothing_is_overwritten => GapCause::NotOnBoard,
                _ => GapCause::Overwritten,
            };
            for (topic, stream) in topics {
                lost.push((*boot, *topic, stream.holes(), cause));
            }
            // A machine without a record does not tell which boot runs: the newest. What waits for the disk may have to
            // be counted as missing yet.
            let runs = holdings.kept == Kept::No && book.order.last() == Some(boot);
            if !runs && topics.values().all(|stream| stream.unsynced.is_empty()) {
                ended.push(*boot);
            }
        }
        for (boot, topic, numbers, cause) in lost {
            plan.lost.extend(self.lose(machine, boot, topic, &numbers, cause));
        }
        if let Some(book) = self.machines.get_mut(machine) {
            book.close(&ended);
        }
        plan
    }

    fn stream(&mut self, machine: &str, boot: BootId, topic: Topic, number: u64) -> &mut Stream {
        if !self.machines.contains_key(machine) {
            self.machines.insert(machine.to_owned(), Book::default());
        }
        self.machines.get_mut(machine).expect("it was inserted").stream(boot, topic, number)
    }
}

fn of_boot(holdings: &Holdings, boot: BootId) -> Option<&HeldBoot> {
    holdings.boots.iter().find(|held| held.boot == boot)
}

/// Numbers that a machine does not have, by why it does not.
fn by_cause(held: &HeldBoot, topic: Topic, numbers: &Ranges) -> [(Ranges, GapCause); 2] {
    let end = held.overwritten.get(&topic).copied().unwrap_or(0);
    let overwritten = Ranges::from(vec![(0, end)]);
    let never = numbers.without(&overwritten);
    [(numbers.without(&never), GapCause::Overwritten), (never, GapCause::NotOnBoard)]
}

impl Book {
    /// What boots before the one in which the machine was met have lost is no gap, nor is what that one has lost
    /// before.
    fn meet(&mut self, holdings: &Holdings) {
        let Some(newest) = holdings.boots.last() else { return };
        let met_in = *self.met_in.get_or_insert(newest.boot);
        let met_at = holdings.boots.iter().position(|held| held.boot == met_in);
        for held in &holdings.boots[..met_at.map_or(0, |place| place + 1)] {
            for (topic, [first, _]) in &held.topics {
                let is_known = self.boots.get(&held.boot).is_some_and(|topics| topics.contains_key(topic));
                if !is_known {
                    self.stream(held.boot, *topic, 0).base = *first;
                }
            }
        }
        let told = holdings.boots.iter().filter(|held| !held.topics.is_empty()).map(|held| held.boot);
        self.held.extend(told);
        // The machine knows which boot was before which. Others are older, or never were on its disk.
        let (known, others): (Vec<BootId>, Vec<BootId>) =
            self.order.iter().partition(|boot| of_boot(holdings, **boot).is_some());
        let in_order = holdings.boots.iter().map(|held| held.boot).filter(|boot| known.contains(boot));
        self.order = others.into_iter().chain(in_order).collect();
    }

    /// What to fetch of a boot, and what of it is no longer there.
    fn compare(
        &self,
        held: &HeldBoot,
        earlier: Option<&HeldBoot>,
        lost: &mut Vec<(BootId, Topic, Ranges, GapCause)>,
    ) -> Wanted {
        let boot = held.boot;
        let nothing = BTreeMap::new();
        let ours = self.boots.get(&boot).unwrap_or(&nothing);
        let mut wanted = Wanted::new();
        for (topic, [first, last]) in &held.topics {
            let settled = ours.get(topic).map(Stream::settled).unwrap_or_default();
            let (first, held_end) = (*first, last.saturating_add(1));
            // The newest messages are on their way by themselves.
            let earlier_end =
                earlier.and_then(|earlier| earlier.topics.get(topic)).map(|[_, last]| last.saturating_add(1));
            let end = match held.current {
                true => held_end.min(settled.end().max(earlier_end.unwrap_or(0))),
                false => held_end,
            };
            let missing = settled.missing_in(first..end);
            if !missing.is_empty() {
                wanted.insert(*topic, missing.iter().map(|range| [range.start, range.end - 1]).collect());
            }
            if held.unread {
                continue;
            }
            let base = ours.get(topic).map_or(0, |stream| stream.base);
            let mut gone = settled.missing_in(base..first);
            if !held.current {
                gone.extend(&settled.missing_in(held_end..settled.end()));
            }
            lost.extend(by_cause(held, *topic, &gone).map(|(numbers, cause)| (boot, *topic, numbers, cause)));
        }
        if !held.current && !held.unread {
            for (topic, stream) in ours.iter().filter(|(topic, _)| !held.topics.contains_key(topic)) {
                let gone = by_cause(held, *topic, &stream.holes());
                lost.extend(gone.map(|(numbers, cause)| (boot, *topic, numbers, cause)));
            }
        }
        wanted
    }
}

#[cfg(test)]
mod tests;
