//! Position of one GNSS antenna.

use nalgebra::SMatrix;

use crate::lie::{Mat3, Vec3, hat};
use crate::state::{NavState, row};

/// The phase centre of an antenna was measured in the world.
///
/// r = Σ^(−½) (p + R l − z), with the lever arm l in the IMU frame: the residual is on the antenna, so that no
/// attitude is assumed when the measurement is made (Nubert et al. 2022, eq. 9, move it to the IMU instead).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PositionFactor {
    /// z: the antenna in the world, m.
    pub measured: Vec3,
    /// l: the antenna in the IMU frame, m.
    pub lever_arm: Vec3,
    /// One sigma east, north, up, m.
    pub sigma: Vec3,
    /// Huber's threshold in sigmas, over the norm of the whitened residual.
    pub huber_threshold: f64,
}

/// [`PositionFactor`] at a state: residual, and Jacobian over (rotation, position).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearPosition {
    /// Whitened, 3.
    pub residual: Vec3,
    /// ∂residual/∂(rotation, position), 3×6.
    pub jacobian: SMatrix<f64, 3, 6>,
}

impl PositionFactor {
    /// Whitened residual.
    pub fn residual(&self, state: &NavState) -> Vec3 {
        (state.position + state.rotation * self.lever_arm - self.measured).component_div(&self.sigma)
    }

    /// Residual and Jacobian: ∂r/∂φ = −Σ^(−½) R hat(l), ∂r/∂p = Σ^(−½).
    pub fn linearize(&self, state: &NavState) -> LinearPosition {
        let whiten = Mat3::from_diagonal(&self.sigma.map(f64::recip));
        let mut jacobian = SMatrix::<f64, 3, 6>::zeros();
        jacobian
            .fixed_view_mut::<3, 3>(0, row::ROTATION)
            .copy_from(&(-whiten * state.rotation.matrix() * hat(&self.lever_arm)));
        jacobian.fixed_view_mut::<3, 3>(0, row::POSITION).copy_from(&whiten);
        LinearPosition { residual: self.residual(state), jacobian }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::factors::differences;

    #[test]
    fn jacobian_agrees_with_differences() {
        let factor = PositionFactor {
            measured: Vec3::new(3.0, 4.0, 1.0),
            lever_arm: Vec3::new(-1.1, 0.8, 2.0),
            sigma: Vec3::new(0.008, 0.009, 0.014),
            huber_threshold: 3.0,
        };
        for state in differences::states() {
            let numeric = differences::jacobian(&state, |state| factor.residual(state));
            let analytic = factor.linearize(&state).jacobian;
            let error = (numeric.fixed_columns::<6>(0) - analytic).norm() / analytic.norm();
            assert!(error < 1e-8, "{error}");
            assert_eq!(numeric.fixed_columns::<9>(6).norm(), 0.0);
        }
    }
}
