use nalgebra::SVector;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::*;

const NOISE: ImuNoise = ImuNoise {
    gyroscope_noise_density: 2.0e-3,
    accelerometer_noise_density: 1.0e-2,
    gyroscope_random_walk: 1.0e-5,
    accelerometer_random_walk: 1.0e-4,
    base_gyroscope_random_walk: 8.0e-6,
    missed_part: [0.0; 2],
    gap_s: 0.03,
};

fn steps(count: usize) -> Vec<Step> {
    (0..count)
        .map(|index| {
            let t = index as f64 * 0.01;
            Step {
                span_s: 0.01,
                angular_rate: Vec3::new(0.4 * (3.0 * t).sin(), -0.3, 0.8 * t.cos()),
                specific_force: Vec3::new(0.5 + t, -0.8 * (2.0 * t).cos(), 9.8),
                change: [Vec3::new(0.1, -0.3, 0.02), Vec3::new(1.0, 0.5, -0.7)],
            }
        })
        .collect()
}

fn integrate(steps: &[Step], gyro_bias: Vec3, accel_bias: Vec3) -> Preintegration {
    Preintegration::of_steps(steps.iter().copied(), gyro_bias, accel_bias, &NOISE)
}

fn difference(a: &Preintegration, b: &Preintegration) -> SVector<f64, 9> {
    let mut tangent = SVector::<f64, 9>::zeros();
    tangent.fixed_rows_mut::<3>(0).copy_from(&a.rotation.minus(&b.rotation));
    tangent.fixed_rows_mut::<3>(3).copy_from(&(a.position - b.position));
    tangent.fixed_rows_mut::<3>(6).copy_from(&(a.velocity - b.velocity));
    tangent
}

#[test]
fn one_step_is_exact_for_a_steadily_turning_body() {
    let step = Step {
        span_s: 0.5,
        angular_rate: Vec3::new(0.6, -0.9, 1.4),
        specific_force: Vec3::new(1.0, -2.0, 9.0),
        change: [Vec3::zeros(); 2],
    };
    let fine = Step { span_s: step.span_s / 4096.0, ..step };
    let reference = integrate(&vec![fine; 4096], Vec3::zeros(), Vec3::zeros());
    let coarse = integrate(&[step], Vec3::zeros(), Vec3::zeros());
    assert!(difference(&coarse, &reference).norm() < 1e-9);
    let gravity = Vec3::new(0.0, 0.0, -9.81);
    let start = NavState { velocity: Vec3::new(1.0, 2.0, 3.0), ..NavState::identity() };
    let direct = propagate(&start, &step, &gravity);
    assert!(direct.minus(&coarse.predict(&start, &gravity)).norm() < 1e-12);
}

#[test]
fn bias_jacobians_agree_with_differences() {
    let steps = steps(40);
    let (gyro_bias, accel_bias) = (Vec3::new(0.01, -0.02, 0.005), Vec3::new(0.1, 0.05, -0.2));
    let nominal = integrate(&steps, gyro_bias, accel_bias);
    let nudge = 1e-5;
    for axis in 0..3 {
        let mut step = Vec3::zeros();
        step[axis] = nudge;
        let by_gyro = difference(
            &integrate(&steps, gyro_bias + step, accel_bias),
            &integrate(&steps, gyro_bias - step, accel_bias),
        ) / (2.0 * nudge);
        let by_accel = difference(
            &integrate(&steps, gyro_bias, accel_bias + step),
            &integrate(&steps, gyro_bias, accel_bias - step),
        ) / (2.0 * nudge);
        let agrees = |first: usize, jacobian: &Mat3, tolerance: f64| {
            let error = (by_gyro.fixed_rows::<3>(first) - jacobian.column(axis)).norm();
            assert!(error < tolerance, "axis {axis}, row {first}: {error}");
        };
        agrees(0, &nominal.rotation_by_gyro_bias, 1e-7);
        agrees(3, &nominal.position_by_gyro_bias, 1e-7);
        agrees(6, &nominal.velocity_by_gyro_bias, 1e-6);
        assert!((by_accel.fixed_rows::<3>(3) - nominal.position_by_accel_bias.column(axis)).norm() < 1e-9);
        assert!((by_accel.fixed_rows::<3>(6) - nominal.velocity_by_accel_bias.column(axis)).norm() < 1e-9);
    }
}

#[test]
fn first_order_correction_meets_a_new_integration() {
    let steps = steps(10);
    let nominal = integrate(&steps, Vec3::zeros(), Vec3::zeros());
    let (gyro_bias, accel_bias) = (Vec3::new(1e-3, -2e-3, 1e-3), Vec3::new(0.02, -0.03, 0.01));
    let again = integrate(&steps, gyro_bias, accel_bias);
    let (rotation, position, velocity) = nominal.corrected(&gyro_bias, &accel_bias);
    assert!(rotation.minus(&again.rotation).norm() < 1e-8);
    assert!((position - again.position).norm() < 1e-7);
    assert!((velocity - again.velocity).norm() < 1e-6);
}

#[test]
fn covariance_agrees_with_sampling() {
    covariance_agrees_with_sampled_runs(&NOISE);
}

#[test]
fn covariance_of_what_samples_miss_agrees_with_sampling() {
    covariance_agrees_with_sampled_runs(&ImuNoise { missed_part: [0.2, 0.25], ..NOISE });
}

/// Every block of the covariance against 4000 sampled runs of the same second of motion.
fn covariance_agrees_with_sampled_runs(noise: &ImuNoise) {
    const SEED: u64 = 7;
    const RUNS: usize = 4000;
    let steps = steps(100);
    let nominal = Preintegration::of_steps(steps.iter().copied(), Vec3::zeros(), Vec3::zeros(), noise);
    let mut generator = ChaCha8Rng::seed_from_u64(SEED);
    let mut sampled = Mat9::zeros();
    for _ in 0..RUNS {
        let mut noisy = Preintegration::new(Vec3::zeros(), Vec3::zeros());
        for step in &steps {
            let scale = 1.0 / step.span_s.sqrt();
            let mut draw = || Vec3::from_fn(|_, _| StandardNormal.sample(&mut generator));
            let missed_rate = step.change[0].component_mul(&draw()) * noise.missed_part[0];
            let missed_force = draw() * (step.change[1].norm() / 3.0_f64.sqrt() * noise.missed_part[1]);
            let disturbed = Step {
                angular_rate: step.angular_rate
                    + draw() * (noise.gyroscope_noise_density * scale)
                    + missed_rate,
                specific_force: step.specific_force
                    + draw() * (noise.accelerometer_noise_density * scale)
                    + missed_force,
                ..*step
            };
            noisy.add(&disturbed, noise);
        }
        let error = difference(&noisy, &nominal);
        sampled += error * error.transpose() / RUNS as f64;
    }
    for row in 0..9 {
        for column in 0..9 {
            let scale = (nominal.covariance[(row, row)] * nominal.covariance[(column, column)]).sqrt();
            let error = (sampled[(row, column)] - nominal.covariance[(row, column)]).abs() / scale;
            // Standard deviation of a sampled correlation is at most √(2/RUNS) = 0.022.
            assert!(error < 0.1, "seed {SEED}: ({row}, {column}) is off by {error} of its scale");
        }
    }
}

#[test]
fn gap_widens_the_covariance() {
    let wide = Step { span_s: 0.2, ..steps(1)[0] };
    let fine = Step { span_s: 0.01, ..wide };
    let bridged = integrate(&[wide], Vec3::zeros(), Vec3::zeros());
    let sampled = integrate(&[fine; 20], Vec3::zeros(), Vec3::zeros());
    assert!(bridged.covariance[(8, 8)] > 100.0 * sampled.covariance[(8, 8)]);
}
