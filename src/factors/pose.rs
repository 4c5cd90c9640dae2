//! Pose of a sensor in the world: a lidar pose that is held to be global.

use crate::lie::{Mat6, Se3, So3, Vec6, hat};
use crate::state::{NavState, row};

/// A sensor's pose in the world was found, such as that of the lidar in its map, with the map fixed to the world by
/// an earlier estimate: a pseudo-global pose (Nubert et al. 2022, section IV-C).
///
/// With T = `world_from_imu` = (R, p), X = `imu_from_sensor` and Z = `world_from_sensor` as measured,
///
///   r = W (Log(R R_X R_Zᵀ), p + R t_X − t_Z),   Wᵀ W = Σ⁻¹,
///
/// both parts in the world's axes, so that roll and pitch can be weighted apart from the heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseFactor {
    /// Z.
    pub measured: Se3,
    /// X.
    pub imu_from_sensor: Se3,
    /// Square root of the information in the world's axes, rows and columns as the residual: rotation about x, y, z
    /// (1/rad), position (1/m).
    pub whiten: Mat6,
}

/// [`PoseFactor`] at a state: residual, and Jacobian over (rotation, position).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearPose {
    /// Whitened, 6.
    pub residual: Vec6,
    /// 6×6.
    pub jacobian: Mat6,
}

impl PoseFactor {
    /// W of errors that are independent: one sigma each, rotation about x, y, z (rad), position (m).
    pub fn whiten(sigma: &Vec6) -> Mat6 {
        Mat6::from_diagonal(&sigma.map(f64::recip))
    }

    /// Whitened residual.
    pub fn residual(&self, state: &NavState) -> Vec6 {
        self.whiten * self.error(state)
    }

    /// Residual and Jacobian.
    pub fn linearize(&self, state: &NavState) -> LinearPose {
        LinearPose { residual: self.residual(state), jacobian: self.whiten * self.error_jacobian(state) }
    }

    /// Of [`Self::error`] over (rotation, position). Exp(R δ) stands before the rotation's error E, so
    /// ∂e_φ/∂δ = Jl⁻¹(e_φ) R with Jl⁻¹(φ) = Jr⁻¹(−φ); ∂e_p/∂δ = −R hat(t_X).
    pub fn error_jacobian(&self, state: &NavState) -> Mat6 {
        let error = self.error(state);
        let rotation = state.rotation.matrix();
        let left_inverse = So3::right_jacobian_inverse(&-error.fixed_rows::<3>(row::ROTATION).into_owned());
        let mut jacobian = Mat6::zeros();
        jacobian.fixed_view_mut::<3, 3>(row::ROTATION, row::ROTATION).copy_from(&(left_inverse * rotation));
        let by_rotation = -rotation * hat(&self.imu_from_sensor.translation);
        jacobian.fixed_view_mut::<3, 3>(row::POSITION, row::ROTATION).copy_from(&by_rotation);
        jacobian.fixed_view_mut::<3, 3>(row::POSITION, row::POSITION).fill_with_identity();
        jacobian
    }

    /// Before it is whitened: rotation (rad), position (m), of the state's against the measured.
    pub fn error(&self, state: &NavState) -> Vec6 {
        let turned = state.rotation * self.imu_from_sensor.rotation;
        let rotation = (turned * self.measured.rotation.inverse()).log();
        let position =
            state.position + state.rotation * self.imu_from_sensor.translation - self.measured.translation;
        Vec6::from_iterator(rotation.iter().chain(position.iter()).copied())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::factors::differences;
    use crate::lie::Vec3;

    fn correlated() -> Mat6 {
        let mut whiten = PoseFactor::whiten(&Vec6::from_column_slice(&[0.05, 0.05, 1e-3, 6e-3, 6e-3, 1e-2]));
        whiten[(2, 4)] = 50.0;
        whiten[(5, 1)] = -20.0;
        whiten
    }

    #[test]
    fn jacobian_agrees_with_differences() {
        let factor = PoseFactor {
            measured: Se3::new(So3::from_yaw_pitch_roll(0.4, 0.1, -0.2), Vec3::new(1.0, 0.2, 0.1)),
            imu_from_sensor: Se3::new(So3::from_yaw_pitch_roll(1.5, 0.2, 3.0), Vec3::new(0.7, -0.6, 1.7)),
            whiten: correlated(),
        };
        for state in differences::states() {
            let linear = factor.linearize(&state);
            let by_state = differences::jacobian(&state, |state| factor.residual(state));
            let error = (by_state.fixed_columns::<6>(0) - linear.jacobian).norm() / linear.jacobian.norm();
            assert!(error < 1e-7, "{error}");
            assert!(by_state.columns(6, 10).norm() == 0.0);
        }
    }

    #[test]
    fn residual_is_in_the_axes_of_the_world() {
        let state = differences::states()[1];
        let imu_from_sensor = Se3::new(So3::from_yaw_pitch_roll(1.5, 0.2, 3.0), Vec3::new(0.7, -0.6, 1.7));
        let seen = *state.world_from_imu().motion() * imu_from_sensor;
        // The sensor sees itself turned to the right and further east than it is.
        let off = Se3::new(So3::about(&Vec3::z(), -0.01) * seen.rotation, seen.translation + Vec3::x() * 0.1);
        let factor = PoseFactor { measured: off, imu_from_sensor, whiten: Mat6::identity() };
        let expected = Vec6::from_column_slice(&[0.0, 0.0, 0.01, -0.1, 0.0, 0.0]);
        assert!((factor.residual(&state) - expected).norm() < 1e-12);
    }
}
