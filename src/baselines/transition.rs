//! How an error of the state grows over a motion: the linear map that `smoother::predict_covariance` applies
//! without forming it.

use crate::lie::hat;
use crate::preintegration::Preintegration;
use crate::state::{NavState, StateMatrix, row};

/// ∂(state at the end)/∂(state at the start) of [`Preintegration::predict`], in the state's tangent
/// (Forster et al. 2017, eqs. 44 and 70 ff., with the biases kept).
pub(super) fn transition(motion: &Preintegration, start: &NavState) -> StateMatrix {
    let rotation = start.rotation.matrix();
    let mut matrix = StateMatrix::identity();
    let mut set = |row: usize, column: usize, block: crate::lie::Mat3| {
        matrix.fixed_view_mut::<3, 3>(row, column).copy_from(&block);
    };
    set(row::ROTATION, row::ROTATION, motion.rotation.matrix().transpose());
    set(row::ROTATION, row::GYRO_BIAS, motion.rotation_by_gyro_bias);
    set(row::POSITION, row::ROTATION, -rotation * hat(&motion.position));
    set(row::POSITION, row::VELOCITY, crate::lie::Mat3::identity() * motion.span_s);
    set(row::POSITION, row::GYRO_BIAS, rotation * motion.position_by_gyro_bias);
    set(row::POSITION, row::ACCEL_BIAS, rotation * motion.position_by_accel_bias);
    set(row::VELOCITY, row::ROTATION, -rotation * hat(&motion.velocity));
    set(row::VELOCITY, row::GYRO_BIAS, rotation * motion.velocity_by_gyro_bias);
    set(row::VELOCITY, row::ACCEL_BIAS, rotation * motion.velocity_by_accel_bias);
    matrix
}
