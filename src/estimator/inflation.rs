//! How much less sure fixes are than their receiver says, learned from their innovations.
//!
//! An innovation ν, the fix less where it was expected, has the variance P + s² σ²: of the estimate, and of the fix,
//! whose reported sigma is off by a factor s. So s² is the mean of (ν² − P) / σ² over the fixes that were used, each
//! with the weight that it has for it, (s² σ² / (P + s² σ²))². Single outliers are cut off, the mean forgets over tens of
//! seconds, and sigmas only ever grow. East and north share one factor, up has its own.
//!
//! An error that changes more slowly than the estimate follows it (seconds) does not show in innovations at all: the
//! estimate goes along with it.

use crate::lie::Vec3;
use crate::time::Stamp;

/// The mean forgets over so long, s.
const MEMORY_S: f64 = 20.0;
/// So many fixes of full weight that were as sure as they said stand for what was before the first.
const BEFORE: f64 = 200.0;
/// Squared innovation over its variance that is cut off; less than a percent of the mean lies beyond.
const CUT: f64 = 9.0;
/// The factor itself, at most.
const FACTOR_MAX: f64 = 5.0;
/// So many standard deviations of the mean square are chance.
const CHANCE: f64 = 2.0;

/// Means over east and north together, and up.
#[derive(Clone, Copy, Debug)]
pub(super) struct Inflation {
    parts: [Mean; 2],
    newest: Option<Stamp>,
}

/// Of (ν² − P) / σ².
#[derive(Clone, Copy, Debug)]
struct Mean {
    sum: f64,
    weight: f64,
}

impl Default for Inflation {
    fn default() -> Self {
        Self { parts: [Mean { sum: BEFORE, weight: BEFORE }; 2], newest: None }
    }
}

impl Mean {
    fn square(&self) -> f64 {
        let square = self.sum / self.weight;
        // The mean of w squares of unit variance has the standard deviation √(2/w).
        let chance = 1.0 + CHANCE * (2.0 / self.weight).sqrt();
        if square <= chance { 1.0 } else { square.min(FACTOR_MAX * FACTOR_MAX) }
    }

    fn note(&mut self, innovation: f64, expected_variance: f64, sigma: f64) {
        let (square, reported) = (self.square(), sigma * sigma);
        let variance = expected_variance + square * reported;
        let cut = (innovation * innovation).min(CUT * variance);
        let weight = (square * reported / variance).powi(2);
        self.sum += weight * (cut - expected_variance) / reported;
        self.weight += weight;
    }
}

impl Inflation {
    /// What sigmas are multiplied by: east, north, up.
    pub fn factors(&self) -> Vec3 {
        let [horizontal, up] = self.parts.map(|part| part.square().sqrt());
        Vec3::new(horizontal, horizontal, up)
    }

    /// A fix that is used: its innovation, the variance that the estimate gives it, and its sigma without inflation.
    pub fn note(&mut self, stamp: Stamp, innovation: &Vec3, expected_variance: &Vec3, sigma: &Vec3) {
        let elapsed_s = self.newest.map_or(0.0, |newest| stamp.seconds_since(newest).max(0.0));
        self.newest = Some(stamp);
        let kept = libm::exp(-elapsed_s.min(1.0) / MEMORY_S);
        for part in &mut self.parts {
            part.sum *= kept;
            part.weight *= kept;
        }
        for axis in 0..3 {
            let part = &mut self.parts[usize::from(axis == 2)];
            part.note(innovation[axis], expected_variance[axis], sigma[axis]);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const SEED: u64 = 11;

    /// Factors after so many seconds of fixes at 20 Hz whose errors are `scale` times the reported 5 mm, with every
    /// so manieth off by 7 sigmas; the estimate itself is good to 2 mm.
    fn factors_after(seconds: i64, scale: f64, outlier_every: i64) -> Vec3 {
        factors_of(SEED, 20, seconds, scale, outlier_every)
    }

    /// The same for another seed and rate (Hz).
    fn factors_of(seed: u64, rate: i64, seconds: i64, scale: f64, outlier_every: i64) -> Vec3 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let mut inflation = Inflation::default();
        for index in 0..rate * seconds {
            let mut draw = || -> f64 { StandardNormal.sample(&mut generator) };
            let noise = Vec3::new(draw(), draw(), draw()) * (0.005 * scale);
            let own = Vec3::new(draw(), draw(), draw()) * 0.002;
            let off = if index % outlier_every == 0 { 0.035 * scale } else { 0.0 };
            let stamp = Stamp::from_nanos(index * 1_000_000_000 / rate);
            let innovation = noise + own + Vec3::repeat(off);
            inflation.note(stamp, &innovation, &Vec3::repeat(4.0e-6), &Vec3::repeat(0.005));
        }
        inflation.factors()
    }

    #[test]
    fn honest_sigmas_stay_as_they_are() {
        assert_eq!(factors_after(300, 1.0, i64::MAX), Vec3::repeat(1.0));
    }

    #[test]
    fn honest_sigmas_stay_at_low_rates_too() {
        for rate in [1, 5, 20] {
            let factors = (0..40).flat_map(|seed| {
                let factors = factors_of(seed, rate, 300, 1.0, i64::MAX);
                [factors.x, factors.z]
            });
            let inflated = factors.filter(|factor| *factor > 1.0).count();
            // Two standard deviations: a few of 80.
            assert!(inflated <= 6, "{inflated} of 80 at {rate} Hz");
        }
    }

    #[test]
    fn sigmas_that_are_too_small_are_found_within_a_minute() {
        for scale in [2.0, 3.0] {
            let factors = factors_after(60, scale, i64::MAX);
            assert!(
                factors.iter().all(|factor| (factor / scale - 1.0).abs() < 0.15),
                "seed {SEED}: {factors}"
            );
        }
    }

    #[test]
    fn single_outliers_and_the_first_moments_change_little() {
        let (outliers, first) = (factors_after(60, 1.0, 100), factors_after(1, 3.0, i64::MAX));
        assert!(outliers.amax() < 1.15, "seed {SEED}: {outliers}");
        assert!(first.amax() < 2.2, "seed {SEED}: {first}");
    }

    #[test]
    fn factor_is_bounded() {
        assert!(factors_after(120, 50.0, i64::MAX).amax() <= FACTOR_MAX);
    }
}
