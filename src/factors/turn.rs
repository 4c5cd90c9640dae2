//! Turn of the chassis by its own gyroscope, between two nodes.

use crate::lie::{So3, Vec3};
use crate::state::NavState;

/// How the chassis turned about its vertical from node i to node j, by its gyroscope: a second opinion on the
/// heading, whose bias walks independently of the cabin's.
///
/// With C = rotation of `imu_from_base` by the cabin turn, M = ΔR of the chassis integrated with the bias b₀, and
/// the chassis gyro's bias b at node i,
///
///   r = ( e_zᵀ Log(Mᵀ C_iᵀ R_iᵀ R_j C_j) + Δt (b − b₀) ) / σ.
///
/// Only the turn about the vertical counts: roll and pitch are known better from gravity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TurnFactor {
    /// M: `base_i_from_base_j`.
    pub measured: So3,
    /// b₀, rad/s.
    pub base_gyro_bias: f64,
    /// Δt, s.
    pub span_s: f64,
    /// C_i and C_j: `imu_from_base`.
    pub imu_from_base: [So3; 2],
    /// One sigma, rad.
    pub sigma: f64,
}

/// [`TurnFactor`] at two states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearTurn {
    /// Whitened.
    pub residual: f64,
    /// Over the rotation of node i.
    pub rotation_i: Vec3,
    /// Over the chassis gyro's bias of node i.
    pub base_gyro_bias: f64,
    /// Over the rotation of node j.
    pub rotation_j: Vec3,
}

impl TurnFactor {
    /// Whitened residual.
    pub fn residual(&self, state_i: &NavState, state_j: &NavState) -> f64 {
        let by_bias = self.span_s * (state_i.base_gyro_bias - self.base_gyro_bias);
        (self.error(state_i, state_j).z + by_bias) / self.sigma
    }

    /// Residual and Jacobians. R_j moves the error by Jr⁻¹(e) C_jᵀ δ_j, R_i by −Jr⁻¹(e) C_jᵀ R_jᵀ R_i δ_i.
    pub fn linearize(&self, state_i: &NavState, state_j: &NavState) -> LinearTurn {
        let inverse_jacobian = So3::right_jacobian_inverse(&self.error(state_i, state_j));
        let last_row: Vec3 = inverse_jacobian.row(2).transpose() / self.sigma;
        let over_j = self.imu_from_base[1].matrix() * last_row;
        let over_i = -((state_i.rotation.inverse() * state_j.rotation).matrix() * over_j);
        LinearTurn {
            residual: self.residual(state_i, state_j),
            rotation_i: over_i,
            base_gyro_bias: self.span_s / self.sigma,
            rotation_j: over_j,
        }
    }

    fn error(&self, state_i: &NavState, state_j: &NavState) -> Vec3 {
        let [from, to] = self.imu_from_base;
        let chassis = from.inverse() * state_i.rotation.inverse() * state_j.rotation * to;
        (self.measured.inverse() * chassis).log()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::factors::differences;
    use crate::state::row;
    use nalgebra::SVector;

    #[test]
    fn jacobians_agree_with_differences() {
        let factor = TurnFactor {
            measured: So3::from_yaw_pitch_roll(0.9, 0.1, -0.2),
            base_gyro_bias: 1e-3,
            span_s: 1.2,
            imu_from_base: [
                So3::from_yaw_pitch_roll(0.4, 0.1, 3.0),
                So3::from_yaw_pitch_roll(-0.3, 0.1, 3.0),
            ],
            sigma: 3e-4,
        };
        for pair in differences::states().windows(2) {
            let linear = factor.linearize(&pair[0], &pair[1]);
            let residual = |i: &NavState, j: &NavState| SVector::<f64, 1>::new(factor.residual(i, j));
            let by_i = differences::jacobian(&pair[0], |state| residual(state, &pair[1]));
            let by_j = differences::jacobian(&pair[1], |state| residual(&pair[0], state));
            let rotation = |jacobian: &nalgebra::SMatrix<f64, 1, 16>| {
                jacobian.fixed_columns::<3>(row::ROTATION).transpose()
            };
            let scale = 1e-6 * linear.rotation_j.norm();
            assert!((rotation(&by_i) - linear.rotation_i).norm() < scale);
            assert!((rotation(&by_j) - linear.rotation_j).norm() < scale);
            assert!((by_i[row::BASE_GYRO_BIAS] - linear.base_gyro_bias).abs() < scale);
            let others = by_i.columns(3, 12).norm() + by_j.columns(3, 13).norm();
            assert!(others < scale, "depends on nothing else: {others}");
        }
    }

    #[test]
    fn true_bias_explains_the_turn() {
        let states = differences::states();
        let [from, to] = [So3::from_yaw_pitch_roll(0.4, 0.1, 3.0), So3::from_yaw_pitch_roll(0.7, 0.1, 3.0)];
        let chassis = from.inverse() * states[0].rotation.inverse() * states[1].rotation * to;
        let (bias, span_s) = (2e-3, 0.9);
        // The gyroscope reads the bias too much about z.
        let measured = chassis * So3::exp(&Vec3::new(0.0, 0.0, bias * span_s));
        let factor =
            TurnFactor { measured, base_gyro_bias: 0.0, span_s, imu_from_base: [from, to], sigma: 1e-3 };
        let state_i = NavState { base_gyro_bias: bias, ..states[0] };
        assert!(factor.residual(&state_i, &states[1]).abs() < 1e-9);
    }
}
