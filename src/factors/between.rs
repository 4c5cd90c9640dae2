//! Relative pose of a sensor, or of the IMU itself, between two nodes.

use nalgebra::SMatrix;

use crate::lie::{Mat6, Se3, Vec6};
use crate::state::NavState;

/// How a sensor moved from node i to node j was measured: by lidar odometry, or by a chassis that stood still.
///
/// r = Σ^(−½) Log(Z⁻¹ (T_i X)⁻¹ (T_j X)), with T = `world_from_imu`, X = `imu_from_sensor` and
/// Z = `sensor_i_from_sensor_j` as measured; tangent of SE(3), rotation first (Nubert et al. 2022, eq. 11).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BetweenFactor {
    /// Z, in the sensor's frame.
    pub measured: Se3,
    /// X; the identity if the motion is that of the IMU.
    pub imu_from_sensor: Se3,
    /// One sigma of rotation (rad) and translation (m), each for all its axes.
    pub sigma: [f64; 2],
}

/// [`BetweenFactor`] at two states: residual, and Jacobians over (rotation, position) of each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearBetween {
    /// Whitened, 6.
    pub residual: Vec6,
    /// Over node i, 6×6.
    pub jacobian_i: Mat6,
    /// Over node j, 6×6.
    pub jacobian_j: Mat6,
}

impl BetweenFactor {
    /// Whitened residual.
    pub fn residual(&self, state_i: &NavState, state_j: &NavState) -> Vec6 {
        self.whiten(&self.error(state_i, state_j).log())
    }

    /// Residual and Jacobians. With E = Exp(r): a right perturbation ξ of T_j X passes through as
    /// Jr⁻¹(r) Ad(X⁻¹) ξ, one of T_i as −Jr⁻¹(r) Ad((T_i⁻¹ T_j X)⁻¹) ξ; positions perturb in the world, so
    /// their columns are turned by Rᵀ.
    pub fn linearize(&self, state_i: &NavState, state_j: &NavState) -> LinearBetween {
        let residual = self.error(state_i, state_j).log();
        let inverse_jacobian = Se3::right_jacobian_inverse(&residual);
        let extrinsic = self.imu_from_sensor;
        let imu_i_from_sensor_j = relative(state_i, state_j) * extrinsic;
        let by_i = -inverse_jacobian * imu_i_from_sensor_j.inverse().adjoint();
        let by_j = inverse_jacobian * extrinsic.inverse().adjoint();
        LinearBetween {
            residual: self.whiten(&residual),
            jacobian_i: self.whiten_rows(&over_state(&by_i, state_i)),
            jacobian_j: self.whiten_rows(&over_state(&by_j, state_j)),
        }
    }

    fn error(&self, state_i: &NavState, state_j: &NavState) -> Se3 {
        let extrinsic = self.imu_from_sensor;
        self.measured.inverse() * extrinsic.inverse() * relative(state_i, state_j) * extrinsic
    }

    fn whiten(&self, residual: &Vec6) -> Vec6 {
        Vec6::from_fn(|axis, _| residual[axis] / self.sigma[axis / 3])
    }

    fn whiten_rows(&self, jacobian: &Mat6) -> Mat6 {
        Mat6::from_fn(|axis, column| jacobian[(axis, column)] / self.sigma[axis / 3])
    }
}

fn relative(state_i: &NavState, state_j: &NavState) -> Se3 {
    Se3::new(state_i.rotation, state_i.position).inverse() * Se3::new(state_j.rotation, state_j.position)
}

/// From a right perturbation of SE(3) to the state's tangent, where positions add in the world.
fn over_state(jacobian: &Mat6, state: &NavState) -> Mat6 {
    let mut over_state = *jacobian;
    let turned: SMatrix<f64, 6, 3> = jacobian.fixed_view::<6, 3>(0, 3) * state.rotation.matrix().transpose();
    over_state.fixed_view_mut::<6, 3>(0, 3).copy_from(&turned);
    over_state
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::factors::differences;
    use crate::lie::{So3, Vec3};

    #[test]
    fn jacobians_agree_with_differences() {
        let factor = BetweenFactor {
            measured: Se3::new(So3::from_yaw_pitch_roll(0.4, 0.1, -0.2), Vec3::new(1.0, 0.2, 0.1)),
            imu_from_sensor: Se3::new(So3::from_yaw_pitch_roll(1.5, 0.2, 3.0), Vec3::new(0.7, -0.6, 1.7)),
            sigma: [1e-3, 6e-3],
        };
        let states = differences::states();
        for pair in states.windows(2) {
            let linear = factor.linearize(&pair[0], &pair[1]);
            let by_i = differences::jacobian(&pair[0], |state| factor.residual(state, &pair[1]));
            let by_j = differences::jacobian(&pair[1], |state| factor.residual(&pair[0], state));
            let error_i = (by_i.fixed_columns::<6>(0) - linear.jacobian_i).norm() / linear.jacobian_i.norm();
            let error_j = (by_j.fixed_columns::<6>(0) - linear.jacobian_j).norm() / linear.jacobian_j.norm();
            assert!(error_i < 1e-7 && error_j < 1e-7, "{error_i} {error_j}");
        }
    }

    #[test]
    fn residual_vanishes_for_the_true_motion() {
        let states = differences::states();
        let extrinsic = Se3::new(So3::from_yaw_pitch_roll(0.3, 0.2, 0.1), Vec3::new(1.0, 2.0, 3.0));
        let lidar = |state: &NavState| *state.world_from_imu().motion() * extrinsic;
        let factor = BetweenFactor {
            measured: lidar(&states[0]).inverse() * lidar(&states[1]),
            imu_from_sensor: extrinsic,
            sigma: [1.0, 1.0],
        };
        assert!(factor.residual(&states[0], &states[1]).norm() < 1e-13);
    }
}
