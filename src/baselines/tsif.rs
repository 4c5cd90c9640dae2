//! TSIF: the two-state implicit filter, with IMU and GNSS.
//!
//! Bloesch, Burri, Sommer, Siegwart and Hutter, "The Two-State Implicit Filter: Recursive Estimation for Mobile
//! Robots" (RA-L 2018, first shown 2017), cited as \[B\]. There is no process model: residuals r(x₀, x₁) tie the
//! state before to the state now, and the one before is marginalized. With J₀, J₁ the whitened Jacobians, y the
//! whitened residuals at the mean before and at the newest guess of now, and Λ the information before (\[B\] section
//! III-B):
//!
//! D = Λ + J₀ᵀ J₀, S = J₁ᵀ (1 − J₀ D⁻¹ J₀ᵀ), Λ' = S J₁, x₁ ← x₁ ⊞ −Λ'⁻¹ S y, until that is small.
//!
//! The angular rate is part of the state, as in the authors' IMU and GPS filter; the gyroscope measures it. As there,
//! the filter waits for measurements on their way and the IMU carries its newest state to the present. `README.md`
//! says what is tuned, and how this differs from the authors' code.

use std::collections::VecDeque;

use nalgebra::{SMatrix, SVector};

use super::filter::{Core, Took};
use super::fix_gate::{Fix, FixGate};
use crate::estimator::{Options, Start};
use crate::lie::{Mat3, So3, Vec3, hat};
use crate::preintegration::{ImuNoise, SampleBuffer, Step};
use crate::sensors::Reading;
use crate::state::{Mode, NavState, StateMatrix, row};
use crate::time::{Span, Stamp};

/// The state without the chassis gyro's bias, and the angular rate.
const DIM: usize = 18;
const RATE: usize = 15;
/// Rows of the residuals that every step has: rotation, position, velocity, gyroscope, both biases.
const ROWS: usize = 18;
type Vector = SVector<f64, DIM>;
type Matrix = SMatrix<f64, DIM, DIM>;

/// Fixes on their way are waited for so long.
const WAIT: Span = Span::from_millis(150);
/// What the attitude's kinematics may be off in a step, rad: nothing but rounding.
const ATTITUDE_SIGMA: f64 = 1.0e-6;
/// What the position's kinematics may be off in a step, m.
const POSITION_SIGMA: f64 = 1.0e-5;
/// As in the authors' filter: at most so many iterations, until the step is so many sigmas.
const ITERATIONS_MAX: usize = 10;
const STEP_SIGMAS: f64 = 0.1;
/// Variance of what TSIF does not estimate: the chassis gyro's bias, (rad/s)².
const BASE_BIAS_VARIANCE: f64 = 1.0e-4;

/// Mean of both kinds: a navigation state and the angular rate (rad/s, IMU frame, without bias).
#[derive(Clone, Copy, Debug)]
pub(super) struct TwoState {
    pub nav: NavState,
    pub rate: Vec3,
}

impl TwoState {
    pub fn plus(&self, tangent: &Vector) -> Self {
        let mut nav = crate::state::StateVector::zeros();
        nav.fixed_rows_mut::<RATE>(0).copy_from(&tangent.fixed_rows::<RATE>(0));
        Self { nav: self.nav.plus(&nav), rate: self.rate + tangent.fixed_rows::<3>(RATE) }
    }
}

/// See the file.
pub struct Tsif {
    stamp: Stamp,
    mean: TwoState,
    information: Matrix,
    gate: FixGate,
    /// Read, but not used yet, in order of their stamps.
    waiting: VecDeque<Fix>,
}

/// Residuals of one step with their Jacobians over both states; not whitened.
pub(super) struct Linear {
    pub residual: SVector<f64, ROWS>,
    pub by_before: SMatrix<f64, ROWS, DIM>,
    pub by_now: SMatrix<f64, ROWS, DIM>,
}

/// Residuals of a step of `dt`, with the IMU's mean readings ω̃ and f̃ over it (\[B\] section IV, in the world instead
/// of the body, and by the mid-point):
///
/// Log(R₀ᵀ R₁) − ω₁ dt, p₁ − p₀ − (v₀ + v₁) dt/2, R₀ᵀ (v₁ − v₀ − g dt) − Exp(ω₁ dt/2) (f̃ − b_a₀) dt,
/// ω̃ − ω₁ − b_g₁, b_g₁ − b_g₀, b_a₁ − b_a₀.
pub(super) fn residuals(before: &TwoState, now: &TwoState, step: &Step, gravity: &Vec3) -> Linear {
    let dt = step.span_s;
    let (x0, x1) = (&before.nav, &now.nav);
    let turn = x1.rotation.minus(&x0.rotation);
    let gained = x0.rotation.inverse() * (x1.velocity - x0.velocity - gravity * dt);
    let half_turn = now.rate * (0.5 * dt);
    let middle = So3::exp(&half_turn).matrix();
    let force = step.specific_force - x0.accel_bias;

    let mut residual = SVector::<f64, ROWS>::zeros();
    let mut set = |first: usize, value: Vec3| residual.fixed_rows_mut::<3>(first).copy_from(&value);
    set(0, turn - now.rate * dt);
    set(3, x1.position - x0.position - (x0.velocity + x1.velocity) * (0.5 * dt));
    set(6, gained - middle * force * dt);
    set(9, step.angular_rate - now.rate - x1.gyro_bias);
    set(12, x1.gyro_bias - x0.gyro_bias);
    set(15, x1.accel_bias - x0.accel_bias);

    let identity = Mat3::identity();
    let mut by_before = SMatrix::<f64, ROWS, DIM>::zeros();
    let mut by_now = SMatrix::<f64, ROWS, DIM>::zeros();
    let inverse = So3::right_jacobian_inverse(&turn);
    let back = x0.rotation.inverse().matrix();
    {
        let mut set = |row: usize, column: usize, block: Mat3| {
            by_before.fixed_view_mut::<3, 3>(row, column).copy_from(&block);
        };
        set(0, row::ROTATION, -inverse * So3::exp(&turn).matrix().transpose());
        set(3, row::POSITION, -identity);
        set(3, row::VELOCITY, identity * (-0.5 * dt));
        set(6, row::ROTATION, hat(&gained));
        set(6, row::VELOCITY, -back);
        set(6, row::ACCEL_BIAS, middle * dt);
        set(12, row::GYRO_BIAS, -identity);
        set(15, row::ACCEL_BIAS, -identity);
    }
    let mut set = |row: usize, column: usize, block: Mat3| {
        by_now.fixed_view_mut::<3, 3>(row, column).copy_from(&block);
    };
    set(0, row::ROTATION, inverse);
    set(0, RATE, identity * -dt);
    set(3, row::POSITION, identity);
    set(3, row::VELOCITY, identity * (-0.5 * dt));
    set(6, row::VELOCITY, back);
    set(6, RATE, middle * hat(&force) * So3::right_jacobian(&half_turn) * (0.5 * dt * dt));
    set(9, RATE, -identity);
    set(9, row::GYRO_BIAS, -identity);
    set(12, row::GYRO_BIAS, identity);
    set(15, row::ACCEL_BIAS, identity);
    Linear { residual, by_before, by_now }
}

/// One sigma of each row of [`residuals`].
fn sigmas(step: &Step, noise: &ImuNoise) -> SVector<f64, ROWS> {
    let root_s = step.span_s.sqrt();
    // What samples miss of the engine's vibration, as in our own preintegration.
    let [missed_rate, missed_force] = noise.missed_part;
    let missed = step.change[1].norm() / 3.0_f64.sqrt() * missed_force * step.span_s;
    let velocity = libm::hypot(noise.accelerometer_noise_density * root_s, missed);
    let mut sigmas = SVector::<f64, ROWS>::zeros();
    for axis in 0..3 {
        sigmas[axis] = ATTITUDE_SIGMA;
        sigmas[3 + axis] = POSITION_SIGMA;
        sigmas[6 + axis] = velocity;
        sigmas[9 + axis] =
            libm::hypot(noise.gyroscope_noise_density / root_s, step.change[0][axis] * missed_rate);
        sigmas[12 + axis] = noise.gyroscope_random_walk * root_s;
        sigmas[15 + axis] = noise.accelerometer_random_walk * root_s;
    }
    sigmas
}

impl Tsif {
    /// One two-state step, with the fixes of its end.
    fn step(&mut self, step: &Step, fixes: &[Fix], options: &Options) {
        let gravity = &options.smoother.gravity;
        let weights = sigmas(step, &options.smoother.noise).map(f64::recip);
        let before = self.mean;
        let mut now = guess(&before, step, gravity);
        let mut information = self.information;
        for _ in 0..ITERATIONS_MAX {
            let mut linear = residuals(&before, &now, step, gravity);
            for (row, weight) in weights.iter().enumerate() {
                linear.residual[row] *= weight;
                linear.by_before.row_mut(row).scale_mut(*weight);
                linear.by_now.row_mut(row).scale_mut(*weight);
            }
            let marginal = self.information + linear.by_before.transpose() * linear.by_before;
            let Some(factor) = marginal.cholesky() else { return };
            let cross = linear.by_before.transpose() * linear.by_now;
            let solved = factor.solve(&cross);
            let pulled = factor.solve(&(linear.by_before.transpose() * linear.residual));
            let mut new = linear.by_now.transpose() * linear.by_now - cross.transpose() * solved;
            let mut gradient = linear.by_now.transpose() * linear.residual - cross.transpose() * pulled;
            for fix in fixes {
                add_fix(&mut new, &mut gradient, &now.nav, fix);
            }
            information = (new + new.transpose()) * 0.5;
            let Some(factor) = information.cholesky() else { return };
            let change = factor.solve(&-gradient);
            now = now.plus(&change);
            let sigmas = (change.dot(&(information * change)) / DIM as f64).max(0.0).sqrt();
            if sigmas < STEP_SIGMAS {
                break;
            }
        }
        self.mean = now;
        self.information = information;
    }

    /// Up to `until`, over all fixes on the way.
    fn advance(&mut self, until: Stamp, options: &Options, samples: &SampleBuffer) -> bool {
        let mut moved = false;
        loop {
            let next = self.waiting.front().map(|fix| fix.stamp).filter(|stamp| *stamp <= until);
            let target = next.unwrap_or(until);
            if target > self.stamp {
                let steps: Option<Vec<Step>> = samples.steps(self.stamp, target).map(Iterator::collect);
                let Some(steps) = steps.filter(|steps| !steps.is_empty()) else { break };
                let last = steps.len() - 1;
                for (index, step) in steps.iter().enumerate() {
                    let fixes = if index == last { self.take_fixes(target) } else { Vec::new() };
                    self.step(step, &fixes, options);
                }
                self.stamp = target;
                moved = true;
            } else if next.is_none() {
                break;
            } else {
                self.waiting.pop_front();
            }
        }
        moved
    }

    /// The fixes of `stamp`: all are believed.
    fn take_fixes(&mut self, stamp: Stamp) -> Vec<Fix> {
        let mut fixes = Vec::new();
        while let Some(fix) = self.waiting.pop_front_if(|fix| fix.stamp == stamp) {
            self.gate.note_used(stamp);
            fixes.push(fix);
        }
        fixes
    }

    fn state_covariance(&self) -> StateMatrix {
        let whole = self.information.try_inverse().unwrap_or_else(Matrix::identity);
        let mut covariance = StateMatrix::zeros();
        covariance.fixed_view_mut::<RATE, RATE>(0, 0).copy_from(&whole.fixed_view::<RATE, RATE>(0, 0));
        covariance[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] = BASE_BIAS_VARIANCE;
        covariance
    }
}

/// Where the readings take the state: only what the iteration starts from.
fn guess(before: &TwoState, step: &Step, gravity: &Vec3) -> TwoState {
    let nav = crate::preintegration::propagate(&before.nav, step, gravity);
    TwoState { nav, rate: step.angular_rate - before.nav.gyro_bias }
}

/// p₁ + R₁ l − z, over sigma.
fn add_fix(information: &mut Matrix, gradient: &mut Vector, nav: &NavState, fix: &Fix) {
    let factor = crate::factors::PositionFactor {
        measured: fix.measured,
        lever_arm: fix.lever_arm,
        sigma: fix.sigma,
        huber_threshold: f64::INFINITY,
    };
    let linear = factor.linearize(nav);
    let mut block = information.fixed_view_mut::<6, 6>(0, 0);
    block += linear.jacobian.transpose() * linear.jacobian;
    let mut part = gradient.fixed_rows_mut::<6>(0);
    part += linear.jacobian.transpose() * linear.residual;
}

impl Core for Tsif {
    fn begin(_: &Options, start: &Start) -> Self {
        let mut information = Matrix::identity();
        let prior = start.information.fixed_view::<RATE, RATE>(0, 0);
        information.fixed_view_mut::<RATE, RATE>(0, 0).copy_from(&prior);
        let mean = TwoState { nav: start.state, rate: Vec3::zeros() };
        Self { stamp: start.stamp, mean, information, gate: FixGate::default(), waiting: VecDeque::new() }
    }

    fn take(&mut self, options: &Options, reading: &Reading, samples: &SampleBuffer) -> Took {
        let newest = samples.newest().map_or(self.stamp, |sample| sample.stamp);
        let (fix, lever_arm) = match reading {
            Reading::Imu(_) => {
                let waited = (newest - WAIT).max(self.stamp);
                let fixes = self.waiting.len();
                return match self.advance(waited, options, samples) {
                    true if self.waiting.len() == fixes => Took::Moved,
                    true => Took::Updated,
                    false => Took::Nothing,
                };
            }
            Reading::GnssLeft(fix) => (fix, Some(options.antenna_left)),
            Reading::GnssRight(fix) => (fix, options.antenna_right),
            _ => return Took::Nothing,
        };
        let Some(lever_arm) = lever_arm else { return Took::Nothing };
        let fix = match FixGate::read(&options.gate, &options.site, fix, lever_arm) {
            Ok(fix) => fix,
            Err(reason) => return Took::Refused(reason),
        };
        if fix.stamp <= self.stamp {
            let late_s = self.stamp.seconds_since(fix.stamp);
            return Took::Refused(format!("is {late_s:.3} s older than the filter's state"));
        }
        let place = self.waiting.partition_point(|waiting| waiting.stamp <= fix.stamp);
        self.waiting.insert(place, fix);
        // All that is awaited of this epoch is there: no need to wait longer.
        let of_epoch = self.waiting.iter().filter(|waiting| waiting.stamp == fix.stamp).count();
        if of_epoch < 1 + usize::from(options.antenna_right.is_some()) {
            return Took::Nothing;
        }
        if self.advance(fix.stamp, options, samples) { Took::Updated } else { Took::Nothing }
    }

    fn newest(&self) -> (Stamp, NavState, StateMatrix) {
        (self.stamp, self.mean.nav, self.state_covariance())
    }

    fn needs_since(&self) -> Stamp {
        self.stamp
    }

    fn mode(&self, now: Stamp) -> Mode {
        if self.gate.trusts(now) { Mode::Main } else { Mode::ImuOnly }
    }
}
