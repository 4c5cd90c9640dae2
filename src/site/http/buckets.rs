//! How often somebody may do something: a bucket of permits for each, filled at a steady rate.

use std::collections::BTreeMap;

use crate::time::Stamp;

/// So many are remembered; beyond that, those who have the most permits are forgotten.
const REMEMBERED_MAX: usize = 10_000;

/// Buckets by key.
#[derive(Debug)]
pub(super) struct Buckets {
    per_s: f64,
    size: f64,
    left: BTreeMap<String, (f64, Stamp)>,
}

impl Buckets {
    /// Full buckets of `size` permits, into which `per_s` come each second.
    pub fn new(per_s: f64, size: f64) -> Self {
        Self { per_s, size, left: BTreeMap::new() }
    }

    /// Takes a permit.
    ///
    /// # Errors
    /// There is none; the next one comes after so many seconds.
    pub fn take(&mut self, key: &str, now: Stamp) -> Result<(), f64> {
        let left = self.left(key, now);
        if left < 1.0 {
            return Err((1.0 - left) / self.per_s);
        }
        if !self.left.contains_key(key) && self.left.len() >= REMEMBERED_MAX {
            self.forget(now);
        }
        self.left.insert(key.to_owned(), (left - 1.0, now));
        Ok(())
    }

    /// Gives back a permit that was not needed.
    pub fn give_back(&mut self, key: &str, now: Stamp) {
        let left = self.left(key, now) + 1.0;
        if left < self.size {
            self.left.insert(key.to_owned(), (left, now));
        } else {
            self.left.remove(key);
        }
    }

    fn left(&self, key: &str, now: Stamp) -> f64 {
        let filled =
            |(left, at): &(f64, Stamp)| (left + self.per_s * now.seconds_since(*at).max(0.0)).min(self.size);
        self.left.get(key).map_or(self.size, filled)
    }

    /// Forgets full buckets, and if that is too few, the fuller half of the others.
    fn forget(&mut self, now: Stamp) {
        let mut left: Vec<(f64, String)> =
            self.left.keys().map(|key| (self.left(key, now), key.clone())).collect();
        left.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (index, (left, key)) in left.into_iter().enumerate() {
            if left >= self.size || index < REMEMBERED_MAX / 2 {
                self.left.remove(&key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Stamp {
        Stamp::from_seconds(1000.0 + seconds)
    }

    #[test]
    fn permits_run_out_come_again_and_are_everybodys_own() {
        let mut buckets = Buckets::new(0.5, 3.0);
        for _ in 0..3 {
            assert_eq!(buckets.take("a", at(0.0)), Ok(()));
        }
        assert_eq!(buckets.take("a", at(0.0)), Err(2.0));
        assert_eq!(buckets.take("b", at(0.0)), Ok(()), "another one's is full");
        assert_eq!(buckets.take("a", at(1.0)), Err(1.0));
        assert_eq!(buckets.take("a", at(2.0)), Ok(()));
        buckets.give_back("a", at(2.0));
        assert_eq!(buckets.take("a", at(2.0)), Ok(()));
        for _ in 0..3 {
            assert_eq!(buckets.take("a", at(1000.0)), Ok(()), "never more than it holds");
        }
        assert!(buckets.take("a", at(1000.0)).is_err());
    }

    #[test]
    fn a_flood_of_names_is_forgotten_before_those_who_are_out() {
        let mut buckets = Buckets::new(1e-6, 2.0);
        for _ in 0..2 {
            buckets.take("out", at(0.0)).expect("full");
        }
        for name in 0..3 * REMEMBERED_MAX {
            buckets.take(&name.to_string(), at(1.0)).expect("full");
        }
        assert!(buckets.left.len() <= REMEMBERED_MAX);
        assert!(buckets.take("out", at(1.0)).is_err());
    }
}
