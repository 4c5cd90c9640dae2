//! Sets of message numbers, as ranges.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::{Deserialize, Serialize};

/// Numbers; consecutive ones cost nothing.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<(u64, u64)>", into = "Vec<(u64, u64)>")]
pub struct Ranges {
    /// Where each range begins, and the number after its last; they neither touch nor overlap.
    ends: BTreeMap<u64, u64>,
}

impl Ranges {
    /// Adds a number; false if it was there.
    pub fn insert(&mut self, number: u64) -> bool {
        if self.contains(number) {
            return false;
        }
        self.insert_range(number..number.saturating_add(1));
        true
    }

    /// Adds numbers.
    pub fn insert_range(&mut self, range: Range<u64>) {
        let Range { mut start, mut end } = range;
        if start >= end {
            return;
        }
        if let Some((before, before_end)) = self.ends.range(..=start).next_back()
            && *before_end >= start
        {
            start = *before;
            end = end.max(*before_end);
        }
        while let Some((next, next_end)) = self.ends.range(start..=end).next() {
            let next = *next;
            end = end.max(*next_end);
            self.ends.remove(&next);
        }
        self.ends.insert(start, end);
    }

    /// Adds those of another set.
    pub fn extend(&mut self, other: &Ranges) {
        other.iter().for_each(|range| self.insert_range(range));
    }

    /// Whether the number is there.
    pub fn contains(&self, number: u64) -> bool {
        self.ends.range(..=number).next_back().is_some_and(|(_, end)| *end > number)
    }

    /// The ranges, ascending.
    pub fn iter(&self) -> impl Iterator<Item = Range<u64>> + '_ {
        self.ends.iter().map(|(start, end)| *start..*end)
    }

    /// What of `range` is not there, ascending.
    pub fn missing_in(&self, range: Range<u64>) -> Ranges {
        let Range { start: mut at, end } = range;
        let mut missing = Ranges::default();
        if let Some((_, before_end)) = self.ends.range(..=at).next_back() {
            at = at.max(*before_end);
        }
        if at >= end {
            return missing;
        }
        for (start, after) in self.ends.range(at..end) {
            missing.insert_range(at..*start);
            at = *after;
        }
        missing.insert_range(at..end);
        missing
    }

    /// What is there and not in the other set.
    pub fn without(&self, other: &Ranges) -> Ranges {
        let mut left = Ranges::default();
        self.iter().for_each(|range| left.extend(&other.missing_in(range)));
        left
    }

    /// How many numbers.
    pub fn count(&self) -> u64 {
        self.iter().map(|range| range.end - range.start).sum()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// The number after the last; 0 if there are none.
    pub fn end(&self) -> u64 {
        self.ends.last_key_value().map_or(0, |(_, end)| *end)
    }
}

/// The number with this lower half that is nearest to `near`: files keep 32 bits of a number.
pub(super) fn widen_near(lower: u32, near: u64) -> u64 {
    let ahead = i64::from(lower.wrapping_sub(near as u32) as i32);
    near.checked_add_signed(ahead).unwrap_or(u64::from(lower))
}

/// The first number with this lower half that is not below `least`.
pub(super) fn widen_from(lower: u32, least: u64) -> u64 {
    least + u64::from(lower.wrapping_sub(least as u32))
}

impl From<Vec<(u64, u64)>> for Ranges {
    fn from(ranges: Vec<(u64, u64)>) -> Self {
        let mut set = Ranges::default();
        ranges.into_iter().for_each(|(start, end)| set.insert_range(start..end));
        set
    }
}

impl From<Ranges> for Vec<(u64, u64)> {
    fn from(set: Ranges) -> Self {
        set.ends.into_iter().collect()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    fn set(ranges: &[(u64, u64)]) -> Ranges {
        Ranges::from(ranges.to_vec())
    }

    #[test]
    fn ranges_join_and_say_what_is_missing() {
        let mut numbers = set(&[(0, 3), (5, 7), (10, 11)]);
        assert_eq!(numbers.missing_in(0..12), set(&[(3, 5), (7, 10), (11, 12)]));
        assert_eq!(numbers.missing_in(1..3), Ranges::default());
        assert_eq!(numbers.missing_in(4..6), set(&[(4, 5)]));
        assert!(numbers.insert(3) && numbers.insert(4) && !numbers.insert(4));
        assert_eq!(numbers, set(&[(0, 7), (10, 11)]));
        numbers.insert_range(6..20);
        assert_eq!((numbers.clone(), numbers.count(), numbers.end()), (set(&[(0, 20)]), 20, 20));
        assert_eq!(numbers.without(&set(&[(2, 4), (19, 30)])), set(&[(0, 2), (4, 19)]));
        numbers.insert_range(9..9);
        assert!(numbers.insert(u64::MAX - 1) && numbers.contains(u64::MAX - 1));
    }

    #[test]
    fn lower_halves_are_widened() {
        let far = 1_u64 << 32;
        assert_eq!((widen_near(3, 5), widen_near(5, 3), widen_near(3, far - 2)), (3, 5, far + 3));
        assert_eq!((widen_near(u32::MAX, far + 1), widen_near(u32::MAX, 1)), (far - 1, far - 1));
        assert_eq!((widen_from(5, 5), widen_from(4, 5), widen_from(7, 3 * far)), (5, far + 4, 3 * far + 7));
    }

    #[test]
    fn ranges_are_a_set_whatever_the_order() {
        // Multiplicative steps visit all residues of a prime in a wild order.
        let mut plain = BTreeSet::new();
        let mut ranges = Ranges::default();
        let mut number = 1_u64;
        for step in 0..400 {
            number = number * 123 % 509;
            assert_eq!(ranges.insert(number), plain.insert(number), "{step}");
            if step % 50 == 0 {
                ranges.insert_range(number..number + 5);
                plain.extend(number..number + 5);
            }
            assert_eq!(ranges.count(), plain.len() as u64);
        }
        let missing: Vec<u64> = ranges.missing_in(0..600).iter().flatten().collect();
        assert_eq!(missing, (0..600).filter(|number| !plain.contains(number)).collect::<Vec<_>>());
        let pairs: Vec<(u64, u64)> = ranges.clone().into();
        assert!(pairs.windows(2).all(|pair| pair[0].1 < pair[1].0));
    }
}
