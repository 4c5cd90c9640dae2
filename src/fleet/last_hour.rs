//! The last hour of something that is told once a second: whole for five minutes, and before that thinned.
//!
//! Of what is older than five minutes, each five seconds keep the point that tells the most, and every point at which
//! something changed. So the memory of a machine is bounded, and no change and no
//! peak is missing from a plot.
//!
//! The room of an hour in which little changes is taken, and touched, at the first point: what a site needs for so many
//! machines is seen in its first minute, not after its first hour.

use std::collections::VecDeque;

use crate::time::{Span, Stamp};

/// Older points are not told.
const KEPT: Span = Span::from_millis(3_600_000);
/// Points are whole for so long.
const WHOLE: Span = Span::from_millis(300_000);
/// How many that are, and some more.
const WHOLE_POINTS: usize = 310;
/// Of older ones, one is kept in each such span.
const THINNED: Span = Span::from_millis(5_000);
/// How many that are in an hour, and some changes.
const THINNED_POINTS: usize = 720;
/// The most points, should something change all the time: the oldest go.
pub(super) const POINTS_MAX: usize = 3_600;

/// What is told.
pub(super) trait Point {
    /// Whether something is otherwise than in the point before.
    fn changed_from(&self, before: &Self) -> bool;
    /// How much it tells: of several that are alike, the one with the most is kept.
    fn tells(&self) -> f64;
}

/// The last hour of one machine.
#[derive(Debug)]
pub(super) struct LastHour<T> {
    thinned: VecDeque<(Stamp, T)>,
    whole: VecDeque<(Stamp, T)>,
}

impl<T> Default for LastHour<T> {
    fn default() -> Self {
        Self { thinned: VecDeque::new(), whole: VecDeque::new() }
    }
}

impl<T: Point + Clone> LastHour<T> {
    /// The newest point.
    pub fn last(&self) -> Option<&(Stamp, T)> {
        self.whole.back()
    }

    /// Adds a point, newer than those before.
    pub fn push(&mut self, at: Stamp, point: T) {
        if self.whole.capacity() == 0 {
            self.take_room(at, &point);
        }
        self.whole.push_back((at, point));
        while let Some((then, _)) = self.whole.front()
            && at - *then > WHOLE
        {
            self.thinned.extend(self.whole.pop_front());
            self.thin();
        }
        while self.thinned.front().is_some_and(|(then, _)| at - *then > KEPT)
            || self.thinned.len() + self.whole.len() > POINTS_MAX
        {
            if self.thinned.pop_front().is_none() {
                self.whole.pop_front();
            }
        }
    }

    fn take_room(&mut self, at: Stamp, point: &T) {
        for (points, count) in [(&mut self.whole, WHOLE_POINTS), (&mut self.thinned, THINNED_POINTS)] {
            points.reserve_exact(count);
            points.resize(count, (at, point.clone()));
            points.clear();
        }
    }

    /// Lets go the lesser of the last two thinned points, if they are of one span and alike.
    fn thin(&mut self) {
        let from_the_end =
            |count| self.thinned.len().checked_sub(count).and_then(|index| self.thinned.get(index));
        let [Some((then, before)), Some((at, newest))] = [2, 1].map(from_the_end) else { return };
        let span = |at: &Stamp| at.as_nanos().div_euclid(THINNED.as_nanos());
        if span(then) != span(at) || newest.changed_from(before) {
            return;
        }
        let lesser = if newest.tells() > before.tells() { 2 } else { 1 };
        let index = self.thinned.len() - lesser;
        self.thinned.remove(index);
    }

    /// Points after `since` and of the hour before `now`, `limit` at most, oldest first; and whether there are more.
    pub fn points(
        &self,
        since: Option<Stamp>,
        limit: usize,
        now: Stamp,
    ) -> (impl Iterator<Item = &(Stamp, T)>, bool) {
        let begins = now - KEPT;
        let since = since.map_or(begins, |since| since.max(begins));
        let after = |points: &VecDeque<(Stamp, T)>| points.partition_point(|(at, _)| *at <= since);
        let (thinned, whole) = (after(&self.thinned), after(&self.whole));
        let count = self.thinned.len() - thinned + self.whole.len() - whole;
        (self.thinned.range(thinned..).chain(self.whole.range(whole..)).take(limit), count > limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is the case, and how much of it.
    #[derive(Clone, Debug, PartialEq)]
    struct Said(&'static str, f64);

    impl Point for Said {
        fn changed_from(&self, before: &Self) -> bool {
            self.0 != before.0
        }

        fn tells(&self) -> f64 {
            self.1
        }
    }

    fn at(second: i64) -> Stamp {
        Stamp::from_nanos(second * 1_000_000_000)
    }

    #[test]
    fn five_minutes_are_whole_and_what_is_older_keeps_its_peaks_and_changes() {
        let mut hour = LastHour::default();
        for second in 0..2_000 {
            let what = if (701..=702).contains(&second) { "off" } else { "on" };
            hour.push(at(second), Said(what, if second == 618 { 9.0 } else { 1.0 }));
        }
        let now = at(1_999);
        let seconds = |since| {
            let (points, _) = hour.points(Some(at(since)), 10_000, now);
            points.map(|(at, _)| at.as_nanos() / 1_000_000_000).collect::<Vec<_>>()
        };
        assert_eq!(seconds(1_698), (1_699..2_000).collect::<Vec<_>>(), "whole");
        assert_eq!(seconds(-1).len(), 301 + 340 + 2, "one in five seconds, and where it changed");
        let around = |from: i64, to: i64| {
            seconds(from - 1).into_iter().filter(|second| *second <= to).collect::<Vec<_>>()
        };
        assert_eq!(around(610, 624), [610, 618, 620], "the peak stays");
        assert_eq!(around(695, 709), [695, 700, 701, 703, 705], "and so do changes");
        let (first, more) = hour.points(None, 3, now);
        assert_eq!((first.count(), more), (3, true));
    }

    #[test]
    fn an_hour_is_kept_and_never_more_than_its_most() {
        let mut hour = LastHour::default();
        for second in 0..9_000 {
            hour.push(at(second), Said("on", 1.0));
        }
        let (points, more) = hour.points(None, 10_000, at(8_999));
        let points: Vec<_> = points.collect();
        assert!(!more && points[0].0 >= at(8_999 - 3_600) && points[0].0 < at(8_999 - 3_590));
        assert!((900..1_000).contains(&points.len()), "{}", points.len());

        let mut restless = LastHour::default();
        for second in 0..9_000 {
            restless.push(at(second), Said(if second % 2 == 0 { "on" } else { "off" }, 1.0));
        }
        assert_eq!(restless.points(None, 10_000, at(8_999)).0.count(), POINTS_MAX);
    }
}
