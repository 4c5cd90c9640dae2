//! IMU preintegration on the manifold, and the buffer of samples it is made from.
//!
//! Between two nodes the IMU's samples become one relative motion that does not depend on the state, with
//! its covariance and its first-order dependence on the biases (Forster, Carlone, Dellaert, Scaramuzza,
//! "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", TRO 2017; cited as \[F\]).
//! Tangent order as everywhere: rotation, position, velocity.

mod samples;

pub use samples::{SampleBuffer, Step};

use nalgebra::SMatrix;

use crate::lie::{Mat3, So3, Vec3, hat};
use crate::state::NavState;

/// Covariance over (rotation, position, velocity).
pub type Mat9 = SMatrix<f64, 9, 9>;

/// Continuous-time noise of the cabin IMU, by Kalibr's names.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuNoise {
    /// rad/s/√Hz.
    pub gyroscope_noise_density: f64,
    /// m/s²/√Hz.
    pub accelerometer_noise_density: f64,
    /// rad/s²/√Hz.
    pub gyroscope_random_walk: f64,
    /// m/s³/√Hz.
    pub accelerometer_random_walk: f64,
    /// Of the chassis' gyroscope, whose bias is estimated along, rad/s²/√Hz.
    pub base_gyroscope_random_walk: f64,
    /// What a step's mean may be off, as a part of how much the readings change over the step: of the angular rate,
    /// of the specific force. Samples miss a part of a vibration that is faster than they are.
    pub missed_part: [f64; 2],
    /// Two samples further apart than this are a gap, s.
    pub gap_s: f64,
}

#[cfg(test)]
impl ImuNoise {
    /// Of a good industrial IMU, as the tests' machines carry it.
    pub(crate) const OF_TESTS: Self = Self {
        gyroscope_noise_density: 1.6e-4,
        accelerometer_noise_density: 1.1e-3,
        gyroscope_random_walk: 8.0e-6,
        accelerometer_random_walk: 6.0e-5,
        base_gyroscope_random_walk: 8.0e-6,
        missed_part: [0.0; 2],
        gap_s: 0.05,
    };
}

/// What is not known of the motion inside a gap between two samples, one sigma: rad/s.
const GAP_ANGULAR_RATE_SIGMA: f64 = 0.05;
/// The same for the specific force: m/s².
const GAP_SPECIFIC_FORCE_SIGMA: f64 = 0.5;

/// The motion between two stamps as the IMU saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct Preintegration {
    /// Length, s.
    pub span_s: f64,
    /// ΔR: `imu_i_from_imu_j`.
    pub rotation: So3,
    /// Δp, m, in `imu_i`, without gravity and initial velocity.
    pub position: Vec3,
    /// Δv, m/s, in `imu_i`, without gravity.
    pub velocity: Vec3,
    /// Bias for which these hold, rad/s.
    pub gyro_bias: Vec3,
    /// Bias for which these hold, m/s².
    pub accel_bias: Vec3,
    /// ∂ΔR/∂gyro bias (right tangent).
    pub rotation_by_gyro_bias: Mat3,
    /// ∂Δp/∂gyro bias.
    pub position_by_gyro_bias: Mat3,
    /// ∂Δp/∂accelerometer bias.
    pub position_by_accel_bias: Mat3,
    /// ∂Δv/∂gyro bias.
    pub velocity_by_gyro_bias: Mat3,
    /// ∂Δv/∂accelerometer bias.
    pub velocity_by_accel_bias: Mat3,
    /// Of the white noise, over (rotation, position, velocity).
    pub covariance: Mat9,
}

impl Preintegration {
    /// No motion yet, around these biases.
    pub fn new(gyro_bias: Vec3, accel_bias: Vec3) -> Self {
        Self {
            span_s: 0.0,
            rotation: So3::identity(),
            position: Vec3::zeros(),
            velocity: Vec3::zeros(),
            gyro_bias,
            accel_bias,
            rotation_by_gyro_bias: Mat3::zeros(),
            position_by_gyro_bias: Mat3::zeros(),
            position_by_accel_bias: Mat3::zeros(),
            velocity_by_gyro_bias: Mat3::zeros(),
            velocity_by_accel_bias: Mat3::zeros(),
            covariance: Mat9::zeros(),
        }
    }

    /// The motion over several steps.
    pub fn of_steps(
        steps: impl Iterator<Item = Step>,
        gyro_bias: Vec3,
        accel_bias: Vec3,
        noise: &ImuNoise,
    ) -> Self {
        let mut motion = Self::new(gyro_bias, accel_bias);
        steps.for_each(|step| motion.add(&step, noise));
        motion
    }

    /// Appends one step of constant angular rate and specific force in the turning body.
    ///
    /// With φ = (ω − b_g) dt and a = f − b_a, exact for that motion:
    /// ΔR ← ΔR Exp(φ), Δv ← Δv + ΔR Γ₁(φ) a dt, Δp ← Δp + Δv dt + ΔR Γ₂(φ) a dt²
    /// (\[F\] eqs. 35 to 37 have Γ₁ = I, Γ₂ = ½ I). Covariance by \[F\] eq. 63 with the integrals of white
    /// noise over the step, bias Jacobians by differentiating the lines above.
    pub fn add(&mut self, step: &Step, noise: &ImuNoise) {
        let dt = step.span_s;
        let phi = (step.angular_rate - self.gyro_bias) * dt;
        let acceleration = step.specific_force - self.accel_bias;
        let turn = So3::exp(&phi);
        let (gamma_1, gamma_2) = gammas(&phi);
        let velocity_step = gamma_1 * acceleration * dt;
        let position_step = gamma_2 * acceleration * (dt * dt);
        let rotation = self.rotation.matrix();
        let turn_back = turn.matrix().transpose();
        let right_jacobian = gamma_1.transpose();

        // Error dynamics: rotation by the step, position by velocity, both by the turned acceleration.
        let position_by_rotation = -rotation * hat(&position_step);
        let velocity_by_rotation = -rotation * hat(&velocity_step);
        self.propagate_covariance(step, &turn_back, &position_by_rotation, &velocity_by_rotation, noise);

        // To third order in φ, with d(φ × (φ × a)) = ((φ·a) I + φ aᵀ − 2 a φᵀ) dφ and ∂φ/∂b_g = −dt.
        let hat_acceleration = hat(&acceleration);
        let twice_turned = Mat3::identity() * phi.dot(&acceleration) + phi * acceleration.transpose()
            - acceleration * phi.transpose() * 2.0;
        let velocity_by_phi = hat_acceleration * -0.5 + twice_turned / 6.0;
        let position_by_phi = hat_acceleration * (-1.0 / 6.0) + twice_turned / 24.0;
        let rotation_by_bias = self.rotation_by_gyro_bias;
        self.position_by_gyro_bias += self.velocity_by_gyro_bias * dt
            + position_by_rotation * rotation_by_bias
            - rotation * position_by_phi * (dt * dt * dt);
        self.position_by_accel_bias += self.velocity_by_accel_bias * dt - rotation * gamma_2 * (dt * dt);
        self.velocity_by_gyro_bias +=
            velocity_by_rotation * rotation_by_bias - rotation * velocity_by_phi * (dt * dt);
        self.velocity_by_accel_bias -= rotation * gamma_1 * dt;
        self.rotation_by_gyro_bias = turn_back * rotation_by_bias - right_jacobian * dt;

        self.position += self.velocity * dt + rotation * position_step;
        self.velocity += rotation * velocity_step;
        self.rotation = (self.rotation * turn).renormalized();
        self.span_s += dt;
    }

    fn propagate_covariance(
        &mut self,
        step: &Step,
        turn_back: &Mat3,
        position_by_rotation: &Mat3,
        velocity_by_rotation: &Mat3,
        noise: &ImuNoise,
    ) {
        let dt = step.span_s;
        let block =
            |row: usize, column: usize| self.covariance.fixed_view::<3, 3>(3 * row, 3 * column).into_owned();
        let (rr, rp, rv) = (block(0, 0), block(0, 1), block(0, 2));
        let (pp, pv, vv) = (block(1, 1), block(1, 2), block(2, 2));
        let (pr, vr, vp) = (rp.transpose(), rv.transpose(), pv.transpose());

        // Rows of F P, with F = [turn_back 0 0; A I dt; B 0 I].
        let (a, b) = (position_by_rotation, velocity_by_rotation);
        let (fr_r, fr_p, fr_v) = (turn_back * rr, turn_back * rp, turn_back * rv);
        let (fp_r, fp_p, fp_v) = (a * rr + pr + vr * dt, a * rp + pp + vp * dt, a * rv + pv + vv * dt);
        let (fv_r, fv_v) = (b * rr + vr, b * rv + vv);
        let new_rr = fr_r * turn_back.transpose();
        let new_rp = fr_r * a.transpose() + fr_p + fr_v * dt;
        let new_rv = fr_r * b.transpose() + fr_v;
        let new_pp = fp_r * a.transpose() + fp_p + fp_v * dt;
        let new_pv = fp_r * b.transpose() + fp_v;
        let new_vv = fv_r * b.transpose() + fv_v;

        let gap_s = if dt > noise.gap_s { dt } else { 0.0 };
        let [missed_rate, missed_force] = noise.missed_part.map(|part| (part * dt).powi(2));
        let rate = noise.gyroscope_noise_density.powi(2) * dt + (GAP_ANGULAR_RATE_SIGMA * gap_s).powi(2);
        let rate = step.change[0].component_mul(&step.change[0]) * missed_rate + Vec3::repeat(rate);
        // Of no direction, since it is turned into the frame of the start.
        let force = noise.accelerometer_noise_density.powi(2) * dt
            + (GAP_SPECIFIC_FORCE_SIGMA * gap_s).powi(2)
            + step.change[1].norm_squared() / 3.0 * missed_force;
        let identity = Mat3::identity();
        self.set_block(0, 0, &(new_rr + Mat3::from_diagonal(&rate)));
        self.set_block(0, 1, &new_rp);
        self.set_block(0, 2, &new_rv);
        self.set_block(1, 1, &(new_pp + identity * (force * dt * dt / 3.0)));
        self.set_block(1, 2, &(new_pv + identity * (force * dt / 2.0)));
        self.set_block(2, 2, &(new_vv + identity * force));
    }

    fn set_block(&mut self, row: usize, column: usize, block: &Mat3) {
        self.covariance.fixed_view_mut::<3, 3>(3 * row, 3 * column).copy_from(block);
        if row != column {
            self.covariance.fixed_view_mut::<3, 3>(3 * column, 3 * row).copy_from(&block.transpose());
        }
    }

    /// The same motion for other biases, to first order (\[F\] eq. 44): ΔR, Δp, Δv.
    pub fn corrected(&self, gyro_bias: &Vec3, accel_bias: &Vec3) -> (So3, Vec3, Vec3) {
        let gyro_change = gyro_bias - self.gyro_bias;
        let accel_change = accel_bias - self.accel_bias;
        (
            self.rotation.plus(&(self.rotation_by_gyro_bias * gyro_change)),
            self.position
                + self.position_by_gyro_bias * gyro_change
                + self.position_by_accel_bias * accel_change,
            self.velocity
                + self.velocity_by_gyro_bias * gyro_change
                + self.velocity_by_accel_bias * accel_change,
        )
    }

    /// The state at the end, given the one at the start; gravity in the world, m/s².
    pub fn predict(&self, start: &NavState, gravity: &Vec3) -> NavState {
        let (rotation, position, velocity) = self.corrected(&start.gyro_bias, &start.accel_bias);
        let span = self.span_s;
        NavState {
            rotation: (start.rotation * rotation).renormalized(),
            position: start.position
                + start.velocity * span
                + gravity * (0.5 * span * span)
                + start.rotation * position,
            velocity: start.velocity + gravity * span + start.rotation * velocity,
            ..*start
        }
    }
}

/// One step of a state, exact for constant angular rate and specific force in the turning body.
pub fn propagate(state: &NavState, step: &Step, gravity: &Vec3) -> NavState {
    let dt = step.span_s;
    let phi = (step.angular_rate - state.gyro_bias) * dt;
    let acceleration = step.specific_force - state.accel_bias;
    let (gamma_1, gamma_2) = gammas(&phi);
    let velocity_step = state.rotation * (gamma_1 * acceleration * dt) + gravity * dt;
    let position_step = state.rotation * (gamma_2 * acceleration * (dt * dt))
        + gravity * (0.5 * dt * dt)
        + state.velocity * dt;
    NavState {
        rotation: (state.rotation * So3::exp(&phi)).renormalized(),
        position: state.position + position_step,
        velocity: state.velocity + velocity_step,
        ..*state
    }
}

/// Γ₁ = ∫₀¹ Exp(sφ) ds (the left Jacobian) and Γ₂ = ∫₀¹ ∫₀ˢ Exp(uφ) du ds, the first and second integral of a
/// turning body's attitude (Bloesch et al., "State estimation for legged robots", RSS 2012, eq. 16).
fn gammas(phi: &Vec3) -> (Mat3, Mat3) {
    let angle_squared = phi.norm_squared();
    let hat_phi = hat(phi);
    let hat_squared = hat_phi * hat_phi;
    let (a, b, c) = if angle_squared < 1e-4 {
        (
            0.5 - angle_squared / 24.0 + angle_squared * angle_squared / 720.0,
            1.0 / 6.0 - angle_squared / 120.0 + angle_squared * angle_squared / 5040.0,
            1.0 / 24.0 - angle_squared / 720.0 + angle_squared * angle_squared / 40320.0,
        )
    } else {
        let angle = angle_squared.sqrt();
        let (sin, cos) = libm::sincos(angle);
        (
            (1.0 - cos) / angle_squared,
            (angle - sin) / (angle_squared * angle),
            (0.5 * angle_squared + cos - 1.0) / (angle_squared * angle_squared),
        )
    };
    let identity = Mat3::identity();
    (identity + hat_phi * a + hat_squared * b, identity * 0.5 + hat_phi * b + hat_squared * c)
}

#[cfg(test)]
mod tests;
