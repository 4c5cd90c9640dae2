//! The motion between two trajectories whose frames are not tied to each other.

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
    /// The rigid motion and the scale that fit positions best.
    Sim3,
    /// The scale alone of [`Alignment::Sim3`].
    Scale,
    /// The motion between the first poses.
    Origin,
}

/// What maps the estimate onto the truth: positions are scaled, then all is moved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Similarity {
    pub scale: f64,
    pub motion: Se3,
}

impl Alignment {
    /// What maps the estimate onto the truth, by least squares over positions: Umeyama, "Least-squares estimation
    /// of transformation parameters between two point patterns" (1991). `None` if positions that lie on a line, or in
    /// one point, leave the rotation open.
    pub(super) fn solve(self, pairs: &[Pair]) -> Option<Similarity> {
        let unscaled = |motion| Some(Similarity { scale: 1.0, motion });
        let (Some(first), false) = (pairs.first(), self == Alignment::None) else {
            return unscaled(Se3::identity());
        };
        if self == Alignment::Origin {
            return unscaled(first.truth * first.estimate.inverse());
        }
        let count = pairs.len() as f64;
        let truth_mean = pairs.iter().map(|pair| pair.truth.translation).sum::<Vec3>() / count;
        let estimate_mean = pairs.iter().map(|pair| pair.estimate.translation).sum::<Vec3>() / count;
        let mut spread = Mat3::zeros();
        let mut variance = 0.0;
        for pair in pairs {
            let (truth, estimate) = (pair.truth.translation, pair.estimate.translation);
            spread += (truth - truth_mean) * (estimate - estimate_mean).transpose();
            variance += (estimate - estimate_mean).norm_squared();
        }
        let (rotation, trace) = match self {
            Alignment::Yaw => {
                let (x, y) = (spread[(0, 0)] + spread[(1, 1)], spread[(1, 0)] - spread[(0, 1)]);
                (So3::exp(&(Vec3::z() * libm::atan2(y, x))), 0.0)
            }
            _ => closest_rotation(&(spread / count))?,
        };
        let trace = trace * count;
        let scale = match self {
            Alignment::Sim3 | Alignment::Scale if variance > 0.0 => trace / variance,
            _ => 1.0,
        };
        if self == Alignment::Scale {
            return Some(Similarity { scale, motion: Se3::identity() });
        }
        Some(Similarity { scale, motion: Se3::new(rotation, truth_mean - rotation * estimate_mean * scale) })
    }
}

/// The rotation `R` that maximizes `trace(Rᵀ spread)`, and that trace; `None` if there are several.
fn closest_rotation(spread: &Mat3) -> Option<(So3, f64)> {
    let decomposition = spread.svd(true, true);
    let (left, right) = (decomposition.u?, decomposition.v_t?);
    // Singular values are in falling order.
    let values = decomposition.singular_values;
    if values[1] <= f64::EPSILON {
        return None;
    }
    let mut handedness = Vec3::repeat(1.0);
    handedness.z = (left * right).determinant().signum();
    let rotation = So3::from_matrix(&(left * Mat3::from_diagonal(&handedness) * right));
    Some((rotation, values.dot(&handedness)))
}
