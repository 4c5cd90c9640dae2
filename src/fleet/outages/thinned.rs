//! Samples over a length (time or way) that nobody knows beforehand, in bounded memory.

use serde::{Deserialize, Serialize};

/// When so many are held, every second one goes and the spacing doubles.
pub const SAMPLES_MAX: usize = 256;

/// Samples at least a spacing apart; the spacing grows with the length.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Thinned<T> {
    spacing: f64,
    /// Where the newest sample was taken.
    newest: Option<f64>,
    samples: Vec<T>,
}

impl<T> Thinned<T> {
    /// None yet; `spacing` is in the unit in which samples are pushed.
    pub fn new(spacing: f64) -> Self {
        Self { spacing, newest: None, samples: Vec::new() }
    }

    /// Takes the sample if it is the first one, or far enough from the one before.
    pub fn push(&mut self, at: f64, sample: impl FnOnce() -> T) {
        if self.newest.is_some_and(|newest| at < newest + self.spacing) {
            return;
        }
        if self.samples.len() >= SAMPLES_MAX {
            let mut index = 0;
            self.samples.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.spacing *= 2.0;
        }
        self.newest = Some(at);
        self.samples.push(sample());
    }

    /// The same for samples that lie somewhere: takes it if it is far enough from the one before.
    pub fn push_apart(&mut self, from_last: impl FnOnce(&T) -> f64, sample: impl FnOnce() -> T) {
        let apart = self.samples.last().map_or(0.0, from_last);
        self.push(self.newest.unwrap_or(0.0) + apart, sample);
    }

    /// Oldest first.
    pub fn samples(&self) -> &[T] {
        &self.samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn however_long_it_lasts_the_samples_are_few_and_cover_all_of_it() {
        let mut thinned = Thinned::new(0.5);
        for step in 0..1_000_000 {
            let at = f64::from(step) * 0.01;
            thinned.push(at, || at);
        }
        let samples = thinned.samples();
        assert!((SAMPLES_MAX / 2..=SAMPLES_MAX).contains(&samples.len()), "{}", samples.len());
        assert_eq!(samples[0], 0.0);
        assert!(samples[samples.len() - 1] > 9_800.0, "{:?}", samples.last());
        let steps: Vec<f64> = samples.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let (least, most) = steps.iter().fold((f64::MAX, 0.0_f64), |(a, b), x| (a.min(*x), b.max(*x)));
        assert!(least >= 0.5 && most <= 4.0 * least, "{least} {most}");
    }
}
