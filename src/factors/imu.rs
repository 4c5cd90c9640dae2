//! The IMU between two neighbouring nodes.

use crate::lie::{Mat3, So3, Vec3, hat};
use crate::preintegration::{ImuNoise, Mat9, Preintegration};
use crate::state::{NavState, STATE_DIM, StateMatrix, StateVector, row};

/// Motion between two samples that no sample sees, m (one sigma per factor): the trapezoid rule is good to
/// about a micrometre, and without it two nodes a millisecond apart would be tied so stiffly that the
/// information of the fixes is lost in rounding.
const UNSEEN_POSITION_SIGMA_M: f64 = 1.0e-6;

/// Residuals of the motion: rotation, position, velocity. Those of the biases follow.
const MOTION_DIM: usize = row::GYRO_BIAS;

/// Preintegrated motion from node i to node j, with the random walk of the biases.
///
/// Residuals of Forster et al. 2017, eq. 45, in the order of the state's tangent:
/// r_φ = Log(ΔR(b)ᵀ R_iᵀ R_j),
/// r_p = R_iᵀ (p_j − p_i − v_i Δt − ½ g Δt²) − Δp(b),
/// r_v = R_iᵀ (v_j − v_i − g Δt) − Δv(b),
/// r_b = b_j − b_i (eq. 47) for the biases of the cabin's gyroscope and accelerometer and of the chassis' gyroscope,
/// each whitened.
#[derive(Clone, Debug, PartialEq)]
pub struct ImuFactor {
    motion: Preintegration,
    /// Lower-triangular W with Wᵀ W = Σ⁻¹ over (rotation, position, velocity).
    whiten: Mat9,
    /// 1/σ of the bias changes: gyro, accelerometer, chassis gyro.
    bias_information_root: [f64; 3],
}

/// [`ImuFactor`] at two states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearImu {
    /// Whitened, 16.
    pub residual: StateVector,
    /// Over node i, 16×16.
    pub jacobian_i: StateMatrix,
    /// Over node j, 16×16.
    pub jacobian_j: StateMatrix,
}

/// What two states say of the motion between them.
struct Seen {
    /// Before whitening.
    residual: StateVector,
    /// r_φ.
    turn: Vec3,
    /// In the IMU frame at i, without gravity and the velocity at i.
    position: Vec3,
    velocity: Vec3,
}

impl ImuFactor {
    /// The factor of a preintegrated motion longer than zero.
    ///
    /// `None` if its covariance is not positive definite, as with numbers that are not finite.
    pub fn new(motion: Preintegration, noise: &ImuNoise) -> Option<Self> {
        let mut covariance = motion.covariance;
        for axis in 0..3 {
            covariance[(row::POSITION + axis, row::POSITION + axis)] += UNSEEN_POSITION_SIGMA_M.powi(2);
        }
        let whiten = covariance.cholesky()?.l().solve_lower_triangular(&Mat9::identity())?;
        let root_span = motion.span_s.sqrt();
        let bias_information_root = [
            1.0 / (noise.gyroscope_random_walk * root_span),
            1.0 / (noise.accelerometer_random_walk * root_span),
            1.0 / (noise.base_gyroscope_random_walk * root_span),
        ];
        Some(Self { motion, whiten, bias_information_root })
    }

    /// The motion it ties by.
    pub fn motion(&self) -> &Preintegration {
        &self.motion
    }

    /// Whitened residual; gravity in the world, m/s².
    pub fn residual(&self, state_i: &NavState, state_j: &NavState, gravity: &Vec3) -> StateVector {
        self.whitened(&self.seen(state_i, state_j, gravity).residual)
    }

    fn seen(&self, state_i: &NavState, state_j: &NavState, gravity: &Vec3) -> Seen {
        let span = self.motion.span_s;
        let (rotation, position, velocity) = self.motion.corrected(&state_i.gyro_bias, &state_i.accel_bias);
        let back = state_i.rotation.inverse();
        let turn = (rotation.inverse() * back * state_j.rotation).log();
        let position_seen = back * moved(state_i, state_j, gravity, span);
        let velocity_seen = back * (state_j.velocity - state_i.velocity - gravity * span);
        let mut residual = StateVector::zeros();
        let mut set = |first: usize, part: Vec3| residual.fixed_rows_mut::<3>(first).copy_from(&part);
        set(row::ROTATION, turn);
        set(row::POSITION, position_seen - position);
        set(row::VELOCITY, velocity_seen - velocity);
        set(row::GYRO_BIAS, state_j.gyro_bias - state_i.gyro_bias);
        set(row::ACCEL_BIAS, state_j.accel_bias - state_i.accel_bias);
        residual[row::BASE_GYRO_BIAS] = state_j.base_gyro_bias - state_i.base_gyro_bias;
        Seen { residual, turn, position: position_seen, velocity: velocity_seen }
    }

    /// Residual and Jacobians (Forster et al. 2017, supplementary material, eqs. A.9 to A.34, for positions
    /// that perturb in the world).
    pub fn linearize(&self, state_i: &NavState, state_j: &NavState, gravity: &Vec3) -> LinearImu {
        let motion = &self.motion;
        let span = motion.span_s;
        let gyro_change = motion.rotation_by_gyro_bias * (state_i.gyro_bias - motion.gyro_bias);
        let back_matrix = state_i.rotation.inverse().matrix();
        let seen = self.seen(state_i, state_j, gravity);
        let inverse_jacobian = So3::right_jacobian_inverse(&seen.turn);

        let mut by_i = StateMatrix::zeros();
        let mut by_j = StateMatrix::zeros();
        let set = |matrix: &mut StateMatrix, row: usize, column: usize, block: &Mat3| {
            matrix.fixed_view_mut::<3, 3>(row, column).copy_from(block);
        };
        let relative = (state_j.rotation.inverse() * state_i.rotation).matrix();
        set(&mut by_i, row::ROTATION, row::ROTATION, &(-inverse_jacobian * relative));
        let by_gyro_bias = -inverse_jacobian
            * So3::exp(&seen.turn).matrix().transpose()
            * So3::right_jacobian(&gyro_change)
            * motion.rotation_by_gyro_bias;
        set(&mut by_i, row::ROTATION, row::GYRO_BIAS, &by_gyro_bias);
        set(&mut by_j, row::ROTATION, row::ROTATION, &inverse_jacobian);

        set(&mut by_i, row::POSITION, row::ROTATION, &hat(&seen.position));
        set(&mut by_i, row::POSITION, row::POSITION, &-back_matrix);
        set(&mut by_i, row::POSITION, row::VELOCITY, &(-back_matrix * span));
        set(&mut by_i, row::POSITION, row::GYRO_BIAS, &-motion.position_by_gyro_bias);
        set(&mut by_i, row::POSITION, row::ACCEL_BIAS, &-motion.position_by_accel_bias);
        set(&mut by_j, row::POSITION, row::POSITION, &back_matrix);

        set(&mut by_i, row::VELOCITY, row::ROTATION, &hat(&seen.velocity));
        set(&mut by_i, row::VELOCITY, row::VELOCITY, &-back_matrix);
        set(&mut by_i, row::VELOCITY, row::GYRO_BIAS, &-motion.velocity_by_gyro_bias);
        set(&mut by_i, row::VELOCITY, row::ACCEL_BIAS, &-motion.velocity_by_accel_bias);
        set(&mut by_j, row::VELOCITY, row::VELOCITY, &back_matrix);

        for bias in [row::GYRO_BIAS, row::ACCEL_BIAS] {
            set(&mut by_i, bias, bias, &-Mat3::identity());
            set(&mut by_j, bias, bias, &Mat3::identity());
        }
        by_i[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] = -1.0;
        by_j[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] = 1.0;
        self.whiten_columns::<STATE_DIM>(&mut by_i);
        self.whiten_columns::<MOTION_DIM>(&mut by_j);
        LinearImu { residual: self.whitened(&seen.residual), jacobian_i: by_i, jacobian_j: by_j }
    }

    fn whitened(&self, residual: &StateVector) -> StateVector {
        let mut whitened = StateVector::zeros();
        for out in 0..9 {
            whitened[out] = (0..=out).map(|inner| self.whiten[(out, inner)] * residual[inner]).sum();
        }
        for bias in 9..STATE_DIM {
            whitened[bias] = residual[bias] * self.bias_information_root[bias / 3 - 3];
        }
        whitened
    }

    /// A Jacobian of which the residuals of the motion depend on the first `BY` columns, those of the biases on their
    /// own.
    fn whiten_columns<const BY: usize>(&self, jacobian: &mut StateMatrix) {
        let whiten = &self.whiten.data.0;
        for column in &mut jacobian.data.0[..BY] {
            let mut whitened = [0.0; MOTION_DIM];
            // The factor is lower triangular, and a column of the Jacobian mostly zero.
            for (inner, value) in
                column.iter().enumerate().take(MOTION_DIM).filter(|(_, value)| **value != 0.0)
            {
                for out in inner..MOTION_DIM {
                    whitened[out] += whiten[inner][out] * value;
                }
            }
            column[..MOTION_DIM].copy_from_slice(&whitened);
        }
        for bias in MOTION_DIM..STATE_DIM {
            jacobian[(bias, bias)] *= self.bias_information_root[bias / 3 - 3];
        }
    }
}

/// p_j − p_i − v_i Δt − ½ g Δt².
fn moved(state_i: &NavState, state_j: &NavState, gravity: &Vec3, span: f64) -> Vec3 {
    state_j.position - state_i.position - state_i.velocity * span - gravity * (0.5 * span * span)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::factors::differences;
    use crate::preintegration::Step;

    const NOISE: ImuNoise = ImuNoise::OF_TESTS;

    fn factor() -> ImuFactor {
        let step = Step {
            span_s: 0.01,
            angular_rate: Vec3::new(0.5, -0.3, 0.8),
            specific_force: Vec3::new(0.4, -0.9, 9.7),
            change: [Vec3::zeros(); 2],
        };
        let steps = std::iter::repeat_n(step, 20);
        let motion = Preintegration::of_steps(steps, Vec3::new(1e-3, 0.0, -1e-3), Vec3::zeros(), &NOISE);
        ImuFactor::new(motion, &NOISE).expect("positive definite")
    }

    #[test]
    fn jacobians_agree_with_differences() {
        let factor = factor();
        let gravity = Vec3::new(0.0, 0.0, -9.81);
        for state_i in differences::states() {
            let tangent = StateVector::from_fn(|index, _| 0.01 * (index as f64 - 7.0));
            let state_j = factor.motion().predict(&state_i, &gravity).plus(&tangent);
            let linear = factor.linearize(&state_i, &state_j, &gravity);
            let by_i = differences::jacobian(&state_i, |state| factor.residual(state, &state_j, &gravity));
            let by_j = differences::jacobian(&state_j, |state| factor.residual(&state_i, state, &gravity));
            // Row by row: whitening makes some rows a million times larger than others.
            for index in 0..STATE_DIM {
                let scale = 1e-6 * (by_i.row(index).norm() + by_j.row(index).norm());
                assert!((by_i.row(index) - linear.jacobian_i.row(index)).norm() < scale, "i, row {index}");
                assert!((by_j.row(index) - linear.jacobian_j.row(index)).norm() < scale, "j, row {index}");
            }
        }
    }

    #[test]
    fn residual_vanishes_for_the_predicted_state() {
        let factor = factor();
        let gravity = Vec3::new(0.0, 0.0, -9.81);
        for state in differences::states() {
            let predicted = factor.motion().predict(&state, &gravity);
            assert!(factor.residual(&state, &predicted, &gravity).norm() < 1e-6);
        }
    }

    #[test]
    fn numbers_that_are_not_finite_make_no_factor() {
        let mut motion = factor().motion().clone();
        motion.covariance[(0, 0)] = f64::NAN;
        assert!(ImuFactor::new(motion, &NOISE).is_none());
    }
}
