//! Errors of position and heading, and what they are against the covariance that came with them.

use crate::evaluate::chi_square::mean_bounds;
use crate::lie::Vec3;
use crate::simulate::Truth;
use crate::state::{Estimate, row};
use crate::time::Stamp;

/// Values at one a second: what two values in a row say is nearly the same.
#[derive(Clone, Debug, Default)]
pub struct Series {
    count: f64,
    sum: f64,
    /// Once a second: time (s), value.
    pub sampled: Vec<(f64, f64)>,
}

impl Series {
    /// Takes a value, if it is a number.
    pub fn note(&mut self, stamp: Stamp, value: f64) {
        if !value.is_finite() {
            return;
        }
        self.count += 1.0;
        self.sum += value;
        let time_s = stamp.as_seconds();
        if self.sampled.last().is_none_or(|(last_s, _)| time_s >= last_s + 1.0) {
            self.sampled.push((time_s, value));
        }
    }

    /// Of all values; NaN of none.
    pub fn mean(&self) -> f64 {
        self.sum / self.count
    }

    /// So many independent values would have a mean as sure: the sampled ones over their correlation time, which is
    /// summed up to where the correlation fades (Geyer 1992).
    pub fn independent(&self) -> f64 {
        let values: Vec<f64> = self.sampled.iter().map(|(_, value)| *value).collect();
        let count = values.len();
        if count < 3 {
            return count as f64;
        }
        let mean = values.iter().sum::<f64>() / count as f64;
        let covariance = |lag: usize| {
            let pairs = values.iter().zip(&values[lag..]);
            pairs.map(|(a, b)| (a - mean) * (b - mean)).sum::<f64>() / count as f64
        };
        let variance = covariance(0);
        if variance <= 0.0 {
            return 1.0;
        }
        let mut time = 1.0;
        for lag in 1..count / 2 {
            let correlation = covariance(lag) / variance;
            if correlation < 0.05 {
                break;
            }
            time += 2.0 * correlation;
        }
        count as f64 / time
    }
}

/// Errors of some estimates.
#[derive(Clone, Debug, Default)]
pub struct Errors {
    count: f64,
    position_squared: f64,
    horizontal_squared: f64,
    vertical_squared: f64,
    heading_squared: f64,
    /// Of the position, m.
    pub largest_m: f64,
    /// Squared over their variance, summed: x, y, z, and rotations about them.
    normalized: [f64; 6],
    /// Position: eᵀ C⁻¹ e over its three degrees of freedom (NEES).
    pub position_nees: Series,
}

impl Errors {
    /// One estimate that is so far off on all axes alike, with such a sigma: m, rad.
    #[cfg(test)]
    pub fn off_by(off: f64, sigma: f64) -> Self {
        let normalized = [(off / sigma).powi(2); 6];
        let squared = 3.0 * off * off;
        let heading_squared = off * off;
        Self { count: 1.0, position_squared: squared, heading_squared, normalized, ..Self::default() }
    }

    pub(super) fn note(&mut self, estimate: &Estimate, truth: &Truth) {
        let position = estimate.state.position - truth.state.position;
        let rotation = (estimate.state.rotation * truth.state.rotation.inverse()).log();
        self.count += 1.0;
        self.position_squared += position.norm_squared();
        self.horizontal_squared += position.xy().norm_squared();
        self.vertical_squared += position.z.powi(2);
        self.heading_squared += rotation.z.powi(2);
        self.largest_m = self.largest_m.max(position.norm());
        let sigma = [estimate.position_sigma_m(), estimate.rotation_sigma()].concat();
        for (axis, error) in position.iter().chain(rotation.iter()).enumerate() {
            self.normalized[axis] += (error / sigma[axis]).powi(2);
        }
        let block = estimate.covariance.fixed_view::<3, 3>(row::POSITION, row::POSITION).into_owned();
        let solved: Option<Vec3> = block.cholesky().map(|factor| factor.solve(&position));
        let nees = solved.map_or(f64::NAN, |solved| position.dot(&solved) / 3.0);
        self.position_nees.note(estimate.stamp, nees);
    }

    /// Takes those of another run along. The series of NEES stays that of the first.
    pub fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.position_squared += other.position_squared;
        self.horizontal_squared += other.horizontal_squared;
        self.vertical_squared += other.vertical_squared;
        self.heading_squared += other.heading_squared;
        self.largest_m = self.largest_m.max(other.largest_m);
        self.normalized.iter_mut().zip(other.normalized).for_each(|(sum, value)| *sum += value);
    }

    /// How many estimates.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Root of the mean squared distance, m; NaN of none.
    pub fn rmse_m(&self) -> f64 {
        (self.position_squared / self.count).sqrt()
    }

    /// The same in the horizontal plane, m.
    pub fn horizontal_rmse_m(&self) -> f64 {
        (self.horizontal_squared / self.count).sqrt()
    }

    /// The same of heights, m.
    pub fn vertical_rmse_m(&self) -> f64 {
        (self.vertical_squared / self.count).sqrt()
    }

    /// Root of the mean squared turn about the vertical, degrees.
    pub fn heading_rmse_deg(&self) -> f64 {
        (self.heading_squared / self.count).sqrt().to_degrees()
    }

    /// Mean squared errors over their variances: x, y, z, and rotations about them. One is as the covariance says.
    pub fn nees(&self) -> [f64; 6] {
        self.normalized.map(|sum| sum / self.count)
    }
}

/// Bounds for the mean of several runs' series, each value of three degrees of freedom divided by them.
pub fn bounds_of(series: &[&Series]) -> [f64; 2] {
    mean_bounds(series.iter().map(|series| series.independent()).sum(), 3.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_that_stay_alike_count_less() {
        let mut white = Series::default();
        let mut slow = Series::default();
        let mut state = 1_u64;
        for index in 0..2_000 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let value = (state >> 33) as f64 / f64::from(1_u32 << 31);
            white.note(Stamp::from_seconds(f64::from(index)), value);
            slow.note(Stamp::from_seconds(f64::from(index)), (f64::from(index) / 100.0).sin());
        }
        assert!(white.independent() > 1_500.0, "{}", white.independent());
        assert!(slow.independent() < 60.0, "{}", slow.independent());
        assert!((white.mean() - 0.5).abs() < 0.03);
        let [low, high] = bounds_of(&[&white]);
        assert!(low > 0.94 && low < 1.0 && high > 1.0 && high < 1.06, "{low} {high}");
    }
}
