//! How many increments lie between two lidar poses: where poses were lost, the walk between has as many steps.

use std::collections::VecDeque;

use crate::time::Span;

/// A period that is longer is a gap, not a pace.
const PERIOD_MAX_S: f64 = 1.1;
/// The pace is the median of so many gaps: neither one that was lost nor one that came in haste sets it.
const GAPS: usize = 9;

/// The usual time between two lidar poses, as far as it is known.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct LidarPace {
    /// The newest, s.
    gaps_s: VecDeque<f64>,
}

impl LidarPace {
    /// Sigmas of the motion between two poses so far apart, given those of one increment: errors of increments are
    /// independent, so that variances add up.
    pub fn sigma(&mut self, increment: [f64; 2], gap: Span) -> [f64; 2] {
        let root = self.increments(gap).sqrt();
        increment.map(|sigma| sigma * root)
    }

    /// How many increments so long a gap is, one at least.
    fn increments(&mut self, gap: Span) -> f64 {
        let gap_s = gap.as_seconds();
        let mut sorted: Vec<f64> = self.gaps_s.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let period_s = sorted.get(sorted.len().saturating_sub(1) / 2);
        let increments = period_s.map_or(1.0, |period_s| (gap_s / period_s).round().max(1.0));
        if gap_s > 0.0 && gap_s <= PERIOD_MAX_S {
            self.gaps_s.push_back(gap_s);
            if self.gaps_s.len() > GAPS {
                self.gaps_s.pop_front();
            }
        }
        increments
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted<const N: usize>(pace: &mut LidarPace, millis: [i64; N]) -> [f64; N] {
        millis.map(|millis| pace.increments(Span::from_millis(millis)))
    }

    #[test]
    fn poses_that_were_lost_count_and_jitter_does_not() {
        let mut pace = LidarPace::default();
        assert_eq!(counted(&mut pace, [10_000, 400, 200, 230, 170, 200, 200]), [1.0; 7], "the pace is 5 Hz");
        let gaps = [400, 60_000, 200, 1_000, 200, 0, 90, 200];
        assert_eq!(counted(&mut pace, gaps), [2.0, 300.0, 1.0, 5.0, 1.0, 1.0, 1.0, 1.0]);
        let [turn, shift] = pace.sigma([0.1, 0.2], Span::from_millis(800));
        assert!((turn - 0.2).abs() < 1e-3 && (shift - 0.4).abs() < 1e-3, "{turn} {shift}");
    }

    #[test]
    fn another_pace_is_learned() {
        let mut pace = LidarPace::default();
        for period in [100, 1_000, 100] {
            counted(&mut pace, [period; GAPS]);
            assert_eq!(pace.increments(Span::from_millis(20 * period)), 20.0, "{period} ms");
        }
    }
}
