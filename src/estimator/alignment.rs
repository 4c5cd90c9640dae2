//! Heading, velocity and tilt of a machine in motion, from one antenna and the IMU.
//!
//! The IMU is integrated from a first guess of roll and pitch, with heading zero: that gives the antenna's
//! path q(τ) but for heading ψ, start position p₀, start velocity v₀ and a constant horizontal acceleration c
//! from the error of the tilt. Each fix says, horizontally,
//! z = p₀ + v₀ τ + ½ c τ² + \[a −b; b a\] q(τ), with a = cos ψ and b = sin ψ,
//! which is linear in all eight unknowns (the closed form of Martinelli, "Closed-form solution of
//! visual-inertial structure from motion", IJCV 2014, with fixes in place of bearings). That a² + b² comes out
//! as one is not asked for, and so proves the solution.

use nalgebra::{SMatrix, SVector};

use crate::lie::{So3, Vec3};
use crate::preintegration::{Preintegration, SampleBuffer};
use crate::state::NavState;
use crate::time::Stamp;

/// Unknowns: p₀ (2), v₀ (2), c (2), a, b.
const UNKNOWNS: usize = 8;
/// Fewest fixes that are worth a try.
const FIXES_MIN: usize = 6;
/// How far a² + b² may be from one.
const SCALE_TOLERANCE: f64 = 0.2;

/// A fix of the antenna in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Anchor {
    pub stamp: Stamp,
    pub position: Vec3,
    /// Horizontal sigma, m.
    pub sigma_m: f64,
}

/// What is known before.
#[derive(Clone, Copy, Debug)]
pub(super) struct Guess {
    /// Attitude at the first fix, with heading zero.
    pub rotation: So3,
    pub gyro_bias: Vec3,
    pub accel_bias: Vec3,
    /// One sigma of the acceleration that an error of the tilt looks like, m/s².
    pub acceleration_sigma: f64,
    /// One sigma of the gyro bias, rad/s.
    pub gyro_bias_sigma: f64,
}

/// The state at the first fix.
#[derive(Clone, Copy, Debug)]
pub(super) struct Aligned {
    pub stamp: Stamp,
    pub state: NavState,
    /// rad.
    pub heading_sigma: f64,
}

/// Solves for the state at the first fix. `None` while the motion says too little, or contradicts the IMU.
pub(super) fn align(
    samples: &SampleBuffer,
    fixes: &[Anchor],
    lever_arm: &Vec3,
    guess: &Guess,
    gravity: &Vec3,
) -> Option<Aligned> {
    let first = fixes.first()?;
    if fixes.len() < FIXES_MIN {
        return None;
    }
    let mut information = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
    let mut right = SVector::<f64, UNKNOWNS>::zeros();
    for unknown in 4..6 {
        information[(unknown, unknown)] = guess.acceleration_sigma.powi(-2);
    }
    let paths = antenna_path(samples, fixes, lever_arm, guess, gravity)?;
    let row = |tau: f64, path: &Vec3, axis: usize| {
        let mut row = SVector::<f64, UNKNOWNS>::zeros();
        row[axis] = 1.0;
        row[2 + axis] = tau;
        row[4 + axis] = 0.5 * tau * tau;
        (row[6], row[7]) = if axis == 0 { (path.x, -path.y) } else { (path.y, path.x) };
        row
    };
    // Positions relative to the first fix keep the normal equations well scaled.
    let relative = |fix: &Anchor| fix.position - first.position;
    for (fix, path) in fixes.iter().zip(&paths) {
        let tau = fix.stamp.seconds_since(first.stamp);
        for axis in 0..2 {
            let row = row(tau, path, axis) / fix.sigma_m;
            information += row * row.transpose();
            right += row * (relative(fix)[axis] / fix.sigma_m);
        }
    }
    let covariance = information.try_inverse()?;
    let solution = covariance * right;
    let (cos, sin) = (solution[6], solution[7]);
    let scale = libm::hypot(cos, sin);
    let residual_squared: f64 = fixes
        .iter()
        .zip(&paths)
        .flat_map(|(fix, path)| {
            let tau = fix.stamp.seconds_since(first.stamp);
            (0..2).map(move |axis| (row(tau, path, axis).dot(&solution) - relative(fix)[axis]).powi(2))
        })
        .sum();
    let residual_m = (residual_squared / (2.0 * fixes.len() as f64)).sqrt();
    if (scale - 1.0).abs() > SCALE_TOLERANCE || residual_m > 0.05 + 3.0 * first.sigma_m {
        return None;
    }
    let across = SVector::<f64, 2>::new(-sin / scale, cos / scale);
    let heading_variance =
        (across.transpose() * covariance.fixed_view::<2, 2>(6, 6) * across)[(0, 0)] / (scale * scale);

    // Fixes that fit worse than their sigmas say so of the solution too, and the gyro bias turns the path.
    let degrees_of_freedom = (2 * fixes.len() - UNKNOWNS).max(1) as f64;
    let misfit = (residual_squared / (degrees_of_freedom * first.sigma_m.powi(2))).max(1.0);
    let turned = 0.5 * guess.gyro_bias_sigma * fixes.last()?.stamp.seconds_since(first.stamp);
    let heading_sigma = (heading_variance * misfit + turned * turned).sqrt();

    let (height, climb) = fit_line(
        fixes
            .iter()
            .zip(&paths)
            .map(|(fix, path)| (fix.stamp.seconds_since(first.stamp), relative(fix).z - path.z)),
    )?;
    let heading = So3::about(&Vec3::z(), libm::atan2(sin, cos));
    // An acceleration c looks like a tilt δθ with δθ × (g up) = c.
    let g = gravity.norm();
    let tilt = So3::exp(&Vec3::new(-solution[5] / g, solution[4] / g, 0.0));
    let state = NavState {
        rotation: (tilt * heading * guess.rotation).renormalized(),
        position: first.position + Vec3::new(solution[0], solution[1], height),
        velocity: Vec3::new(solution[2], solution[3], climb),
        gyro_bias: guess.gyro_bias,
        accel_bias: guess.accel_bias,
        base_gyro_bias: 0.0,
    };
    Some(Aligned { stamp: first.stamp, state, heading_sigma })
}

/// Attitude at `start` with heading zero, from the mean specific force until `end`: good to the machine's own
/// mean acceleration, which the alignment then finds.
pub(super) fn level_from_mean_force(
    samples: &SampleBuffer,
    start: Stamp,
    end: Stamp,
    gyro_bias: &Vec3,
    accel_bias: &Vec3,
) -> Option<So3> {
    let mut rotation = So3::identity();
    let mut sum = Vec3::zeros();
    for step in samples.steps(start, end)? {
        sum += rotation * (step.specific_force - accel_bias) * step.span_s;
        rotation = rotation.plus(&((step.angular_rate - gyro_bias) * step.span_s));
    }
    (sum.norm() > 1.0e-3).then(|| without_heading(&So3::between(&sum.normalize(), &Vec3::z())))
}

/// The same roll and pitch with heading zero.
pub(super) fn without_heading(rotation: &So3) -> So3 {
    let [yaw, _, _] = rotation.yaw_pitch_roll();
    So3::about(&Vec3::z(), -yaw) * *rotation
}

/// Way of the antenna from the start of the first fix, in the level frame with heading zero.
fn antenna_path(
    samples: &SampleBuffer,
    fixes: &[Anchor],
    lever_arm: &Vec3,
    guess: &Guess,
    gravity: &Vec3,
) -> Option<Vec<Vec3>> {
    let noiseless = crate::preintegration::ImuNoise {
        gyroscope_noise_density: 0.0,
        accelerometer_noise_density: 0.0,
        gyroscope_random_walk: 0.0,
        accelerometer_random_walk: 0.0,
        base_gyroscope_random_walk: 0.0,
        missed_part: [0.0; 2],
        gap_s: f64::INFINITY,
    };
    let mut motion = Preintegration::new(guess.gyro_bias, guess.accel_bias);
    let start = NavState {
        rotation: guess.rotation,
        gyro_bias: guess.gyro_bias,
        accel_bias: guess.accel_bias,
        ..NavState::identity()
    };
    let mut reached = fixes.first()?.stamp;
    fixes
        .iter()
        .map(|fix| {
            samples.steps(reached, fix.stamp)?.for_each(|step| motion.add(&step, &noiseless));
            reached = fix.stamp;
            let state = motion.predict(&start, gravity);
            Some(state.position + state.rotation * *lever_arm)
        })
        .collect()
}

/// Least-squares line through (x, y): value at zero and slope.
pub(super) fn fit_line(points: impl Iterator<Item = (f64, f64)>) -> Option<(f64, f64)> {
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (x, y) in points {
        n += 1.0;
        sx += x;
        sy += y;
        sxx += x * x;
        sxy += x * y;
    }
    let determinant = n * sxx - sx * sx;
    (determinant > 0.0).then(|| {
        let slope = (n * sxy - sx * sy) / determinant;
        ((sy - slope * sx) / n, slope)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preintegration::{Step, propagate};
    use crate::sensors::ImuSample;

    /// A tilted machine that speeds up, turns and brakes; fixes of its antenna without noise.
    fn drive(heading: f64, velocity: Vec3) -> (SampleBuffer, Vec<Anchor>, NavState) {
        let gravity = Vec3::new(0.0, 0.0, -9.81);
        let start = NavState {
            rotation: So3::about(&Vec3::z(), heading) * So3::from_yaw_pitch_roll(0.0, 0.1, -0.05),
            position: Vec3::new(30.0, -12.0, 2.0),
            velocity,
            ..NavState::identity()
        };
        let lever_arm = Vec3::new(-0.5, 0.3, 1.8);
        let mut samples = SampleBuffer::default();
        let mut fixes = Vec::new();
        let mut state = start;
        let mut previous: Option<ImuSample> = None;
        for index in 0..500_i32 {
            let t = f64::from(index) * 0.01;
            let sample = ImuSample {
                stamp: Stamp::from_nanos(i64::from(index) * 10_000_000),
                angular_rate: Vec3::new(0.02, 0.01, 0.3 * (0.8 * t).sin()),
                specific_force: Vec3::new(0.9 * (1.1 * t).cos() - 1.0, 0.4 * t.sin(), 9.7),
            };
            if let Some(previous) = previous {
                state = propagate(&state, &Step::between(&previous, &sample), &gravity);
            }
            samples.push(sample);
            previous = Some(sample);
            if index % 10 == 0 {
                let position = state.position + state.rotation * lever_arm;
                fixes.push(Anchor { stamp: sample.stamp, position, sigma_m: 0.01 });
            }
        }
        (samples, fixes, start)
    }

    #[test]
    fn heading_comes_from_motion_at_any_heading_and_speed() {
        for heading in [-3.0, -1.2, 0.0, 0.7, 2.9] {
            for velocity in [Vec3::zeros(), Vec3::new(4.0, -2.0, 0.3)] {
                let (samples, fixes, start) = drive(heading, velocity);
                // The tilt is guessed wrong by about a degree.
                let guess = Guess {
                    rotation: without_heading(&(So3::exp(&Vec3::new(0.02, -0.015, 0.0)) * start.rotation)),
                    gyro_bias: Vec3::zeros(),
                    accel_bias: Vec3::zeros(),
                    acceleration_sigma: 0.3,
                    gyro_bias_sigma: 1.0e-4,
                };
                let gravity = Vec3::new(0.0, 0.0, -9.81);
                let lever_arm = Vec3::new(-0.5, 0.3, 1.8);
                let aligned = align(&samples, &fixes, &lever_arm, &guess, &gravity).expect("enough motion");
                let error = aligned.state.minus(&start);
                assert!(error.fixed_rows::<3>(0).norm() < 0.02, "{heading}: {error}");
                assert!(error.fixed_rows::<3>(6).norm() < 0.05, "{heading}: {error}");
                assert!(aligned.heading_sigma < 0.05);
            }
        }
    }

    #[test]
    fn standstill_says_nothing_of_the_heading() {
        let mut samples = SampleBuffer::default();
        (0..300).for_each(|index| {
            samples.push(ImuSample {
                stamp: Stamp::from_nanos(index * 10_000_000),
                angular_rate: Vec3::zeros(),
                specific_force: Vec3::z() * 9.81,
            });
        });
        let fixes: Vec<Anchor> = (0..50)
            .map(|index| Anchor {
                stamp: Stamp::from_nanos(index * 50_000_000),
                position: Vec3::new(0.01 * f64::from((index % 3) as i32 - 1), 0.0, 0.0),
                sigma_m: 0.01,
            })
            .collect();
        let guess = Guess {
            rotation: So3::identity(),
            gyro_bias: Vec3::zeros(),
            accel_bias: Vec3::zeros(),
            acceleration_sigma: 0.1,
            gyro_bias_sigma: 1.0e-4,
        };
        let aligned = align(&samples, &fixes, &Vec3::new(0.1, 0.0, 0.1), &guess, &Vec3::new(0.0, 0.0, -9.81));
        assert!(aligned.is_none_or(|aligned| aligned.heading_sigma > 0.02), "{aligned:?}");
    }
}
