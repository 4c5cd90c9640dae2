//! The second opinion on every Jacobian: central differences over the state's tangent.

use nalgebra::{SMatrix, SVector};

use crate::lie::{So3, Vec3};
use crate::state::{NavState, STATE_DIM, StateVector};

/// States of a machine somewhere on a site, tilted, moving, with biases.
pub fn states() -> Vec<NavState> {
    (0..4)
        .map(|index| {
            let k = f64::from(index);
            NavState {
                rotation: So3::from_yaw_pitch_roll(2.0 - k, 0.3 * k - 0.4, 0.2 + 0.1 * k),
                position: Vec3::new(3.0 + 0.7 * k, -4.0 + 0.3 * k, 1.0 + 0.1 * k),
                velocity: Vec3::new(1.0, -0.5 * k, 0.2),
                gyro_bias: Vec3::new(3e-3, -2e-3, 1e-3 * k),
                accel_bias: Vec3::new(0.05, -0.04, 0.02 * k),
                base_gyro_bias: 1e-3 * k - 2e-3,
            }
        })
        .collect()
}

/// ∂residual/∂state by central differences.
pub fn jacobian<const ROWS: usize>(
    state: &NavState,
    residual: impl Fn(&NavState) -> SVector<f64, ROWS>,
) -> SMatrix<f64, ROWS, STATE_DIM> {
    let step = 1e-6;
    let mut jacobian = SMatrix::<f64, ROWS, STATE_DIM>::zeros();
    for column in 0..STATE_DIM {
        let mut nudge = StateVector::zeros();
        nudge[column] = step;
        let difference: SVector<f64, ROWS> =
            (residual(&state.plus(&nudge)) - residual(&state.plus(&-nudge))) / (2.0 * step);
        jacobian.set_column(column, &difference);
    }
    jacobian
}
