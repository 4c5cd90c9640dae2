//! Covariances of what is predicted from a known state.

use nalgebra::SMatrix;

use super::elimination::POSE_DIM;
use crate::lie::{Mat3, Vec3, hat};
use crate::preintegration::{ImuNoise, Preintegration};
use crate::state::{NavState, STATE_DIM, StateMatrix, row};

/// Covariance over (rotation, position), in the state's tangent.
pub type PoseCovariance = SMatrix<f64, POSE_DIM, POSE_DIM>;

/// What a motion makes of an error at its start: the transposes of the blocks of F that are not the identity's.
struct Transition {
    span: f64,
    rotation_by_rotation: Mat3,
    rotation_by_gyro_bias: Mat3,
    position_by_rotation: Mat3,
    position_by_gyro_bias: Mat3,
    position_by_accel_bias: Mat3,
    velocity_by_rotation: Mat3,
    velocity_by_gyro_bias: Mat3,
    velocity_by_accel_bias: Mat3,
}

impl Transition {
    fn new(motion: &Preintegration, start: &NavState) -> Self {
        let back = start.rotation.matrix().transpose();
        Self {
            span: motion.span_s,
            rotation_by_rotation: motion.rotation.matrix(),
            rotation_by_gyro_bias: motion.rotation_by_gyro_bias.transpose(),
            // −R hat(Δ) transposed is hat(Δ) Rᵀ.
            position_by_rotation: hat(&motion.position) * back,
            position_by_gyro_bias: motion.position_by_gyro_bias.transpose() * back,
            position_by_accel_bias: motion.position_by_accel_bias.transpose() * back,
            velocity_by_rotation: hat(&motion.velocity) * back,
            velocity_by_gyro_bias: motion.velocity_by_gyro_bias.transpose() * back,
            velocity_by_accel_bias: motion.velocity_by_accel_bias.transpose() * back,
        }
    }

    /// The columns of X Fᵀ for the rotation and the position.
    fn pose_columns<const ROWS: usize>(
        &self,
        x: &SMatrix<f64, ROWS, STATE_DIM>,
    ) -> SMatrix<f64, ROWS, POSE_DIM> {
        let columns = |first: usize| x.fixed_columns::<3>(first);
        let (turn, velocity) = (columns(row::ROTATION), columns(row::VELOCITY));
        let (gyro_bias, accel_bias) = (columns(row::GYRO_BIAS), columns(row::ACCEL_BIAS));
        let mut product = x.fixed_columns::<POSE_DIM>(row::ROTATION).into_owned();
        product
            .fixed_columns_mut::<3>(row::ROTATION)
            .copy_from(&(turn * self.rotation_by_rotation + gyro_bias * self.rotation_by_gyro_bias));
        let mut position = product.fixed_columns_mut::<3>(row::POSITION);
        position += turn * self.position_by_rotation
            + velocity * self.span
            + gyro_bias * self.position_by_gyro_bias
            + accel_bias * self.position_by_accel_bias;
        product
    }

    /// X Fᵀ, of whose rows those of the biases are the identity's.
    fn times_transpose(&self, x: &StateMatrix) -> StateMatrix {
        let columns = |first: usize| x.fixed_columns::<3>(first);
        let mut product = *x;
        product.fixed_columns_mut::<POSE_DIM>(row::ROTATION).copy_from(&self.pose_columns(x));
        let mut velocity = product.fixed_columns_mut::<3>(row::VELOCITY);
        velocity += columns(row::ROTATION) * self.velocity_by_rotation
            + columns(row::GYRO_BIAS) * self.velocity_by_gyro_bias
            + columns(row::ACCEL_BIAS) * self.velocity_by_accel_bias;
        product
    }
}

/// Adds a motion's noise over its first `BLOCKS` parts, which is written in imu_i: positions and velocities turn into
/// the world.
fn add_noise<const DIM: usize, const BLOCKS: usize>(
    predicted: &mut SMatrix<f64, DIM, DIM>,
    motion: &Preintegration,
    start: &NavState,
) {
    let rotation = start.rotation.matrix();
    let turns: [Mat3; BLOCKS] =
        std::array::from_fn(|part| if part == 0 { Mat3::identity() } else { rotation });
    for (block_row, row_turn) in turns.iter().enumerate() {
        for (block_column, column_turn) in turns.iter().enumerate() {
            let block = row_turn
                * motion.covariance.fixed_view::<3, 3>(3 * block_row, 3 * block_column)
                * column_turn.transpose();
            let mut target = predicted.fixed_view_mut::<3, 3>(3 * block_row, 3 * block_column);
            target += block;
        }
    }
}

/// Covariance of the state at the end of a motion: F P Fᵀ + Q, with the biases walking.
pub fn predict_covariance(
    motion: &Preintegration,
    start: &NavState,
    covariance: &StateMatrix,
    noise: &ImuNoise,
) -> StateMatrix {
    let span = motion.span_s;
    let transition = Transition::new(motion, start);
    // P is symmetric: (P Fᵀ)ᵀ Fᵀ = F P Fᵀ.
    let mut predicted = transition.times_transpose(&transition.times_transpose(covariance).transpose());
    add_noise::<STATE_DIM, 3>(&mut predicted, motion, start);
    for axis in 0..3 {
        predicted[(row::GYRO_BIAS + axis, row::GYRO_BIAS + axis)] +=
            noise.gyroscope_random_walk.powi(2) * span;
        predicted[(row::ACCEL_BIAS + axis, row::ACCEL_BIAS + axis)] +=
            noise.accelerometer_random_walk.powi(2) * span;
    }
    predicted[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] += noise.base_gyroscope_random_walk.powi(2) * span;
    (predicted + predicted.transpose()) * 0.5
}

/// That part of [`predict_covariance`] that is of the pose, to the bit.
pub fn predict_pose_covariance(
    motion: &Preintegration,
    start: &NavState,
    covariance: &StateMatrix,
) -> PoseCovariance {
    let transition = Transition::new(motion, start);
    let mut predicted = transition.pose_columns(&transition.pose_columns(covariance).transpose());
    add_noise::<POSE_DIM, 2>(&mut predicted, motion, start);
    (predicted + predicted.transpose()) * 0.5
}

/// Covariance (m²) in the world of a point fixed to the body at `lever_arm` (IMU frame, m).
pub fn predicted_position_covariance(
    state: &NavState,
    covariance: &PoseCovariance,
    lever_arm: &Vec3,
) -> Mat3 {
    let by_rotation = -state.rotation.matrix() * hat(lever_arm);
    let block = |row: usize, column: usize| covariance.fixed_view::<3, 3>(row, column).into_owned();
    let cross = by_rotation * block(row::ROTATION, row::POSITION);
    by_rotation * block(row::ROTATION, row::ROTATION) * by_rotation.transpose()
        + cross
        + cross.transpose()
        + block(row::POSITION, row::POSITION)
}
