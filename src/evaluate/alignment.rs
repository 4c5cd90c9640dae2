//! The rigid motion between two trajectories whose frames are not tied to each other.

use serde::Serialize;

use super::Pair;
use crate::lie::{Mat3, Se3, So3, Vec3};

/// What is taken out of the difference of two trajectories before errors are measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Alignment {
    /// Nothing: both are in the same frame.
    #[default]
    None,
    /// The translation and the turn about the vertical that fit positions best: both know the vertical.
    Yaw,
    /// The rigid motion that fits positions best.
    Se3,
}

impl Alignment {
    /// The motion that maps the estimate onto the truth, by least squares over positions: Umeyama, "Least-
    /// squares estimation of transformation parameters between two point patterns" (1991), without scale.
    pub(super) fn solve(self, pairs: &[Pair]) -> Se3 {
        if self == Alignment::None {
            return Se3::identity();
        }
        let count = pairs.len() as f64;
        let truth_mean = pairs.iter().map(|pair| pair.truth.translation).sum::<Vec3>() / count;
        let estimate_mean = pairs.iter().map(|pair| pair.estimate.translation).sum::<Vec3>() / count;
        let mut spread = Mat3::zeros();
        for pair in pairs {
            let (truth, estimate) = (pair.truth.translation, pair.estimate.translation);
            spread += (truth - truth_mean) * (estimate - estimate_mean).transpose();
        }
        let rotation = match self {
            Alignment::None => So3::identity(),
            Alignment::Yaw => {
                let (x, y) = (spread[(0, 0)] + spread[(1, 1)], spread[(1, 0)] - spread[(0, 1)]);
                So3::exp(&(Vec3::z() * libm::atan2(y, x)))
            }
            Alignment::Se3 => closest_rotation(&spread),
        };
        Se3::new(rotation, truth_mean - rotation * estimate_mean)
    }
}

/// The rotation `R` that maximizes `trace(Rᵀ spread)`.
fn closest_rotation(spread: &Mat3) -> So3 {
    let decomposition = spread.svd(true, true);
    let (Some(left), Some(right)) = (decomposition.u, decomposition.v_t) else {
        return So3::identity();
    };
    let mut handedness = Vec3::repeat(1.0);
    handedness.z = (left * right).determinant().signum();
    So3::from_matrix(&(left * Mat3::from_diagonal(&handedness) * right))
}
