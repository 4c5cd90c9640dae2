//! What is said of many sizes.

use serde::Serialize;

/// Of sizes, all zero or above.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Statistics {
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Half are smaller.
    pub median: f64,
    /// 95 % are smaller.
    pub p95: f64,
    /// Greatest.
    pub max: f64,
}

impl Statistics {
    /// `None` of nothing.
    pub fn of(mut sizes: Vec<f64>) -> Option<Self> {
        sizes.sort_by(f64::total_cmp);
        let max = *sizes.last()?;
        let count = sizes.len() as f64;
        // Linear between the two nearest ranks.
        let quantile = |part: f64| {
            let rank = part * (count - 1.0);
            let low = sizes[rank.floor() as usize];
            low + (sizes[rank.ceil() as usize] - low) * rank.fract()
        };
        Some(Self {
            rmse: (sizes.iter().map(|size| size * size).sum::<f64>() / count).sqrt(),
            mean: sizes.iter().sum::<f64>() / count,
            median: quantile(0.5),
            p95: quantile(0.95),
            max,
        })
    }
}
