//! Covariances of what is predicted from a known state.

use crate::lie::{Mat3, Vec3, hat};
use crate::preintegration::{ImuNoise, Preintegration};
use crate::state::{NavState, StateMatrix, row};

/// Covariance of the state at the end of a motion: F P Fᵀ + Q, with the biases walking.
pub fn predict_covariance(
    motion: &Preintegration,
    start: &NavState,
    covariance: &StateMatrix,
    noise: &ImuNoise,
) -> StateMatrix {
    let span = motion.span_s;
    let rotation = start.rotation.matrix();
    let back = rotation.transpose();
    // X Fᵀ, of whose rows those of the biases are the identity's.
    let times_transition = |x: &StateMatrix| {
        let columns = |first: usize| x.fixed_columns::<3>(first);
        let (turn, velocity) = (columns(row::ROTATION), columns(row::VELOCITY));
        let (gyro_bias, accel_bias) = (columns(row::GYRO_BIAS), columns(row::ACCEL_BIAS));
        let mut product = *x;
        product.fixed_columns_mut::<3>(row::ROTATION).copy_from(
            &(turn * motion.rotation.matrix() + gyro_bias * motion.rotation_by_gyro_bias.transpose()),
        );
        // −R hat(Δ) transposed is hat(Δ) Rᵀ.
        let mut position = product.fixed_columns_mut::<3>(row::POSITION);
        position += turn * (hat(&motion.position) * back)
            + velocity * span
            + gyro_bias * (motion.position_by_gyro_bias.transpose() * back)
            + accel_bias * (motion.position_by_accel_bias.transpose() * back);
        let mut moved = product.fixed_columns_mut::<3>(row::VELOCITY);
        moved += turn * (hat(&motion.velocity) * back)
            + gyro_bias * (motion.velocity_by_gyro_bias.transpose() * back)
            + accel_bias * (motion.velocity_by_accel_bias.transpose() * back);
        product
    };
    // P is symmetric: (P Fᵀ)ᵀ Fᵀ = F P Fᵀ.
    let mut predicted = times_transition(&times_transition(covariance).transpose());
    // The motion's noise is written in imu_i: positions and velocities turn into the world.
    let turns = [Mat3::identity(), rotation, rotation];
    for block_row in 0..3 {
        for block_column in 0..3 {
            let block = turns[block_row]
                * motion.covariance.fixed_view::<3, 3>(3 * block_row, 3 * block_column)
                * turns[block_column].transpose();
            let mut target = predicted.fixed_view_mut::<3, 3>(3 * block_row, 3 * block_column);
            target += block;
        }
    }
    for axis in 0..3 {
        predicted[(row::GYRO_BIAS + axis, row::GYRO_BIAS + axis)] +=
            noise.gyroscope_random_walk.powi(2) * span;
        predicted[(row::ACCEL_BIAS + axis, row::ACCEL_BIAS + axis)] +=
            noise.accelerometer_random_walk.powi(2) * span;
    }
    predicted[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] += noise.base_gyroscope_random_walk.powi(2) * span;
    (predicted + predicted.transpose()) * 0.5
}

/// Covariance (m²) in the world of a point fixed to the body at `lever_arm` (IMU frame, m).
pub fn predicted_position_covariance(state: &NavState, covariance: &StateMatrix, lever_arm: &Vec3) -> Mat3 {
    let by_rotation = -state.rotation.matrix() * hat(lever_arm);
    let block = |row: usize, column: usize| covariance.fixed_view::<3, 3>(row, column).into_owned();
    let cross = by_rotation * block(row::ROTATION, row::POSITION);
    by_rotation * block(row::ROTATION, row::ROTATION) * by_rotation.transpose()
        + cross
        + cross.transpose()
        + block(row::POSITION, row::POSITION)
}
