//! How long, and how far, until the position is worse than the site tolerates.
//!
//! The variance of the position along its worst horizontal direction, v = σ², is fitted over the outage so far
//! by v(x) = a + b x + c x² with b, c ≥ 0 (least squares), once with x the time (s) and once with x the way (m):
//! the linear part is a random walk, as increments of the lidar odometry add up to; the quadratic part is a
//! constant error of velocity or heading, carried on. From the newest point (x₀, v₀) on, the tolerance T is
//! reached where v₀ + b (x - x₀) + c (x² - x₀²) = T², that is after
//!
//! ```text
//! x - x₀ = 2 k / (b + √(b² + 4 c k)) - x₀,    k = T² - v₀ + b x₀ + c x₀²
//! ```
//! Where neither b nor c is above zero the variance does not grow, and there is no end.

use serde::Serialize;

use super::SigmaSample;

/// Fewer samples say nothing about growth.
const SAMPLES_MIN: usize = 5;
/// A shorter time or way says nothing about growth.
const SPAN_MIN_S: f64 = 2.0;
const SPAN_MIN_M: f64 = 0.5;
/// What lasts longer than this may as well last for ever.
const TIME_MAX_S: f64 = 86_400.0;
const DISTANCE_MAX_M: f64 = 100_000.0;

/// What is left until one sigma of the position passes the site's tolerance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Budget {
    /// The site's tolerance: one sigma along the worst horizontal direction, m.
    pub tolerance_m: f64,
    /// Time that is left, s; 0 if the tolerance is passed, `null` if the sigma does not grow with time.
    pub time_s: Option<f64>,
    /// Way that is left, m; 0 if the tolerance is passed, `null` if the sigma does not grow with the way.
    pub distance_m: Option<f64>,
}

/// By the room's equation; `None` as long as the outage is too young to tell, unless the tolerance is passed.
pub(super) fn budget(samples: &[SigmaSample], newest: SigmaSample, tolerance_m: f64) -> Option<Budget> {
    if newest.sigma_m >= tolerance_m {
        return Some(Budget { tolerance_m, time_s: Some(0.0), distance_m: Some(0.0) });
    }
    let first = samples.first()?;
    if samples.len() < SAMPLES_MIN || newest.time_s - first.time_s < SPAN_MIN_S {
        return None;
    }
    let left = |x: fn(&SigmaSample) -> f64, span_min: f64, limit: f64| {
        let x0 = x(&newest);
        if x0 - x(first) < span_min {
            return None;
        }
        let growth = Growth::fit(samples.iter().map(|sample| (x(sample), sample.sigma_m.powi(2))))?;
        let gap = tolerance_m * tolerance_m - newest.sigma_m * newest.sigma_m;
        Some(growth.until(x0, gap)).filter(|left| *left <= limit)
    };
    Some(Budget {
        tolerance_m,
        time_s: left(|sample| sample.time_s, SPAN_MIN_S, TIME_MAX_S),
        distance_m: left(|sample| sample.travelled_m, SPAN_MIN_M, DISTANCE_MAX_M),
    })
}

/// The growing part of the fit.
#[derive(Clone, Copy, Debug)]
struct Growth {
    linear: f64,
    quadratic: f64,
}

impl Growth {
    /// `None` if it does not grow.
    fn fit(points: impl Iterator<Item = (f64, f64)> + Clone) -> Option<Self> {
        let count = points.clone().count() as f64;
        let mean = |of: fn((f64, f64)) -> f64| points.clone().map(of).sum::<f64>() / count;
        let (mean_x, mean_xx, mean_v) = (mean(|p| p.0), mean(|p| p.0 * p.0), mean(|p| p.1));
        // Normal equations of the centred columns x, x² and v.
        let [mut xx, mut xq, mut qq, mut xv, mut qv] = [0.0; 5];
        for (x, v) in points {
            let (x, q, v) = (x - mean_x, x * x - mean_xx, v - mean_v);
            xx += x * x;
            xq += x * q;
            qq += q * q;
            xv += x * v;
            qv += q * v;
        }
        let determinant = xx * qq - xq * xq;
        if determinant > 1e-9 * xx * qq {
            let linear = (qq * xv - xq * qv) / determinant;
            let quadratic = (xx * qv - xq * xv) / determinant;
            if linear >= 0.0 && quadratic >= 0.0 {
                return Some(Self { linear, quadratic }).filter(Self::grows);
            }
        }
        // One of them would be negative: the better of the two that are left.
        let explains_more = xv * xv * qq >= qv * qv * xx;
        let alone = if explains_more || qv <= 0.0 {
            Self { linear: xv / xx, quadratic: 0.0 }
        } else {
            Self { linear: 0.0, quadratic: qv / qq }
        };
        Some(alone).filter(Self::grows)
    }

    fn grows(&self) -> bool {
        self.linear >= 0.0 && self.quadratic >= 0.0 && self.linear + self.quadratic > 0.0
    }

    /// From `x0` on until the variance is larger by `gap`.
    fn until(&self, x0: f64, gap: f64) -> f64 {
        let Self { linear: b, quadratic: c } = *self;
        let k = gap + b * x0 + c * x0 * x0;
        (2.0 * k / (b + (b * b + 4.0 * c * k).sqrt()) - x0).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Samples every half second at half a metre a second, of a variance over time.
    fn samples(seconds: f64, variance: impl Fn(f64) -> f64) -> Vec<SigmaSample> {
        let count = (seconds * 2.0) as i32;
        let sample = |index: i32| {
            let time_s = 0.5 * f64::from(index);
            SigmaSample { time_s, travelled_m: 0.5 * time_s, sigma_m: variance(time_s).sqrt() }
        };
        (0..=count).map(sample).collect()
    }

    fn of(samples: &[SigmaSample]) -> Option<Budget> {
        budget(samples, *samples.last().expect("some"), 0.05)
    }

    #[test]
    fn random_walk_ends_where_its_variance_does() {
        // 0.0025 m² is reached at t = (0.0025 - 0.0001) / 2e-5 = 120 s, of which 20 s have passed.
        let budget = of(&samples(20.0, |t| 1e-4 + 2e-5 * t)).expect("known");
        assert!((budget.time_s.expect("grows") - 100.0).abs() < 1e-6, "{budget:?}");
        assert!((budget.distance_m.expect("grows") - 50.0).abs() < 1e-6, "{budget:?}");
    }

    #[test]
    fn error_of_heading_ends_where_its_square_does() {
        // 1e-4 + 6e-6 t² = 0.0025 at t = 20 s.
        let budget = of(&samples(10.0, |t| 1e-4 + 6e-6 * t * t)).expect("known");
        assert!((budget.time_s.expect("grows") - 10.0).abs() < 1e-6, "{budget:?}");
        let both = of(&samples(10.0, |t| 1e-4 + 2e-5 * t + 5e-6 * t * t)).expect("known");
        assert!((both.time_s.expect("grows") - 10.0).abs() < 1e-6, "{both:?}");
    }

    #[test]
    fn what_does_not_grow_has_no_end() {
        for flat in [samples(30.0, |_| 4e-4), samples(30.0, |t| 4e-4 - 1e-6 * t)] {
            let budget = of(&flat).expect("known");
            assert_eq!((budget.time_s, budget.distance_m), (None, None));
        }
    }

    #[test]
    fn standing_machine_has_an_end_in_time_but_none_in_way() {
        let mut standing = samples(20.0, |t| 1e-4 + 2e-5 * t);
        standing.iter_mut().for_each(|sample| sample.travelled_m = 3.0);
        let budget = of(&standing).expect("known");
        assert!(budget.time_s.is_some() && budget.distance_m.is_none(), "{budget:?}");
    }

    #[test]
    fn growth_that_slows_down_is_taken_as_steady_and_never_as_shrinking() {
        let budget = of(&samples(30.0, |t| 1e-4 + 1e-4 * t.sqrt())).expect("known");
        let left = budget.time_s.expect("grows");
        assert!(left.is_finite() && left > 30.0, "{left}");
    }

    #[test]
    fn young_outage_tells_nothing_and_a_spent_budget_is_zero() {
        assert_eq!(of(&samples(1.5, |t| 1e-4 + 1e-5 * t)), None);
        assert_eq!(budget(&[], SigmaSample { time_s: 0.0, travelled_m: 0.0, sigma_m: 0.01 }, 0.05), None);
        let spent = of(&samples(1.5, |_| 0.01)).expect("known at once");
        assert_eq!((spent.time_s, spent.distance_m), (Some(0.0), Some(0.0)));
    }
}
