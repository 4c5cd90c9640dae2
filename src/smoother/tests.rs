//! The smoother against a dense solve of the same window by QR, which shares none of its elimination.

use faer::Mat;
use faer::linalg::solvers::SolveLstsqCore;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::node::LaterEdge;
use super::*;
use crate::frames::{Imu, Lidar, Pose};
use crate::lie::{Se3, So3};
use crate::state::{STATE_DIM, StateVector, row};

const NOISE: ImuNoise = ImuNoise::OF_TESTS;

fn gravity() -> Vec3 {
    Vec3::new(0.0, 0.0, -9.81)
}

fn lever_arm() -> Vec3 {
    Vec3::new(-1.1, 0.8, 2.0)
}

fn imu_from_lidar() -> Pose<Imu, Lidar> {
    Pose::assume(Se3::new(So3::from_yaw_pitch_roll(1.2, 0.3, 0.1), Vec3::new(0.7, 0.4, 1.5)))
}

/// Samples of a machine that turns and accelerates, and its true states at the samples.
fn motion(seconds: f64) -> Vec<(ImuSample, NavState)> {
    let mut state = NavState {
        rotation: So3::from_yaw_pitch_roll(0.5, 0.05, -0.1),
        velocity: Vec3::new(0.5, 0.2, 0.0),
        ..NavState::identity()
    };
    let rate = |t: f64| Vec3::new(0.1 * (2.0 * t).sin(), 0.05 * (3.0 * t).cos(), 0.4 * t.sin());
    let force =
        |t: f64| Vec3::new(0.8 * (1.5 * t).cos(), 0.5 * (2.5 * t).sin(), 9.81 + 0.2 * (4.0 * t).sin());
    let sample = |index: i64| ImuSample {
        stamp: Stamp::from_nanos(index * 10_000_000),
        angular_rate: rate(index as f64 * 0.01),
        specific_force: force(index as f64 * 0.01),
    };
    let mut samples = vec![(sample(0), state)];
    for index in 1..=(seconds * 100.0) as i64 {
        let next = sample(index);
        state = propagate(&state, &Step::between(&samples[samples.len() - 1].0, &next), &gravity());
        samples.push((next, state));
    }
    samples
}

use crate::preintegration::Step;

struct Draw(ChaCha8Rng);

impl Draw {
    fn vector(&mut self, sigma: f64) -> Vec3 {
        Vec3::from_fn(|_, _| {
            let sample: f64 = StandardNormal.sample(&mut self.0);
            sigma * sample
        })
    }
}

fn wide_information() -> StateMatrix {
    let sigmas = [0.05, 0.5, 0.5, 0.01, 0.1, 0.01];
    StateMatrix::from_diagonal(&StateVector::from_fn(|row, _| f64::powi(sigmas[row / 3], -2)))
}

fn started(lag_s: f64, truth: &[(ImuSample, NavState)], draw: &mut Draw) -> Smoother {
    let mut options = Options::new(Span::from_seconds(lag_s), gravity(), NOISE);
    options.relinearize = [1e-9; 6];
    options.iterations_max = 12;
    let mut smoother = Smoother::new(options);
    truth.iter().for_each(|(sample, _)| smoother.push_sample(*sample));
    let mut tangent = StateVector::zeros();
    for part in 0..3 {
        tangent.fixed_rows_mut::<3>(3 * part).copy_from(&draw.vector(0.03));
    }
    smoother.start(truth[0].0.stamp, truth[0].1.plus(&tangent), &wide_information()).expect("covered");
    smoother
}

fn true_state(truth: &[(ImuSample, NavState)], stamp: Stamp) -> NavState {
    let mut samples = SampleBuffer::default();
    truth.iter().for_each(|(sample, _)| samples.push(*sample));
    let before = truth.partition_point(|(sample, _)| sample.stamp <= stamp) - 1;
    let (sample, state) = &truth[before];
    samples
        .steps(sample.stamp, stamp)
        .expect("covered")
        .fold(*state, |state, step| propagate(&state, &step, &gravity()))
}

fn fix(truth: &[(ImuSample, NavState)], stamp: Stamp, draw: &mut Draw) -> PositionFactor {
    let state = true_state(truth, stamp);
    PositionFactor {
        measured: state.position + state.rotation * lever_arm() + draw.vector(0.01),
        lever_arm: lever_arm(),
        sigma: Vec3::new(0.01, 0.01, 0.015),
        huber_threshold: f64::INFINITY,
    }
}

fn increment(truth: &[(ImuSample, NavState)], from: Stamp, to: Stamp, draw: &mut Draw) -> BetweenFactor {
    let lidar = |stamp| true_state(truth, stamp).world_from_imu() * imu_from_lidar();
    let exact: Pose<Lidar, Lidar> = lidar(from).inverse() * lidar(to);
    let (turn, shift) = (draw.vector(1e-3), draw.vector(6e-3));
    let error = Se3::new(So3::exp(&turn), shift);
    BetweenFactor {
        measured: *exact.motion() * error,
        imu_from_sensor: *imu_from_lidar().motion(),
        sigma: [1e-3, 6e-3],
    }
}

fn add_fix(smoother: &mut Smoother, truth: &[(ImuSample, NavState)], millis: i64, draw: &mut Draw) {
    let stamp = Stamp::from_nanos(millis * 1_000_000 + 317_000);
    let node = smoother.node_at(stamp).expect("in the window");
    smoother.add_position(node, fix(truth, stamp, draw)).expect("node exists");
}

fn add_increment(
    smoother: &mut Smoother,
    truth: &[(ImuSample, NavState)],
    from: i64,
    to: i64,
    draw: &mut Draw,
) {
    let [from, to] = [from, to].map(|millis| Stamp::from_nanos(millis * 1_000_000));
    let (first, second) =
        (smoother.node_at(from).expect("in the window"), smoother.node_at(to).expect("in the window"));
    smoother.add_between(first, second, increment(truth, from, to, draw)).expect("nodes exist");
}

/// A chassis that turns like the cabin, with a gyroscope of no bias.
fn add_turn(smoother: &mut Smoother, truth: &[(ImuSample, NavState)], from: i64, to: i64, draw: &mut Draw) {
    let [from, to] = [from, to]
        .map(|millis| smoother.node_at(Stamp::from_nanos(millis * 1_000_000)).expect("in the window"));
    let [first, second] = [from, to].map(|stamp| true_state(truth, stamp).rotation);
    let factor = TurnFactor {
        measured: first.inverse() * second * So3::exp(&draw.vector(3e-4)),
        base_gyro_bias: 0.0,
        span_s: to.seconds_since(from),
        imu_from_base: [So3::identity(); 2],
        sigma: 3e-4,
    };
    smoother.add_turn(from, to, factor).expect("nodes exist");
}

fn add_pose(smoother: &mut Smoother, truth: &[(ImuSample, NavState)], millis: i64, draw: &mut Draw) {
    let stamp = Stamp::from_nanos(millis * 1_000_000);
    let node = smoother.node_at(stamp).expect("in the window");
    let seen = true_state(truth, node).world_from_imu() * imu_from_lidar();
    let error = Se3::new(So3::exp(&draw.vector(1e-2)), draw.vector(0.02));
    let factor = PoseFactor {
        measured: Se3::new(error.rotation * seen.rotation(), error.translation + seen.translation()),
        imu_from_sensor: *imu_from_lidar().motion(),
        whiten: PoseFactor::whiten(&crate::lie::Vec6::new(1e-2, 1e-2, 1e-2, 0.02, 0.02, 0.02)),
    };
    smoother.add_pose(node, factor).expect("node exists");
}

/// Gauss-Newton over the whole window at once: estimates, and covariance of the newest node.
fn dense_solve(smoother: &mut Smoother, start: NavState) -> (Vec<NavState>, StateMatrix) {
    let columns = STATE_DIM * smoother.nodes.len();
    let mut states: Vec<NavState> = smoother.estimates().map(|(_, estimate)| estimate).collect();
    let nodes = &smoother.nodes;
    let mut covariance = StateMatrix::zeros();
    for _ in 0..8 {
        let mut rows: Vec<(Vec<(usize, f64)>, f64)> = Vec::new();
        let root = wide_information().map(f64::sqrt);
        let moved = states[0].minus(&start);
        let turn = So3::right_jacobian_inverse(&moved.fixed_rows::<3>(0).into_owned());
        for row in 0..STATE_DIM {
            let entries = if row < 3 {
                (0..3).map(|column| (column, root[(row, row)] * turn[(row, column)])).collect()
            } else {
                vec![(row, root[(row, row)])]
            };
            rows.push((entries, root[(row, row)] * moved[row]));
        }
        for (index, node) in nodes.iter().enumerate() {
            let base = STATE_DIM * index;
            if let Some(link) = &node.link {
                let linear = link.linearize(&states[index], &states[index + 1], &gravity());
                for row in 0..STATE_DIM {
                    let mut entries = Vec::new();
                    for column in 0..STATE_DIM {
                        entries.push((base + column, linear.jacobian_i[(row, column)]));
                        entries.push((base + STATE_DIM + column, linear.jacobian_j[(row, column)]));
                    }
                    rows.push((entries, linear.residual[row]));
                }
            }
            for factor in node.positions.iter().map(|position| &position.factor) {
                let linear = factor.linearize(&states[index]);
                for row in 0..3 {
                    let entries =
                        (0..6).map(|column| (base + column, linear.jacobian[(row, column)])).collect();
                    rows.push((entries, linear.residual[row]));
                }
            }
            for factor in node.poses.iter().map(|pose| &pose.factor) {
                let linear = factor.linearize(&states[index]);
                for row in 0..6 {
                    let entries =
                        (0..6).map(|column| (base + column, linear.jacobian[(row, column)])).collect();
                    rows.push((entries, linear.residual[row]));
                }
            }
            for LaterEdge { later, edge, .. } in &node.edges {
                let other = nodes.iter().position(|node| node.stamp == *later).expect("in the window");
                let factor = match edge {
                    Edge::Between(factor) => factor,
                    Edge::Turn(factor) => {
                        let linear = factor.linearize(&states[index], &states[other]);
                        let mut entries = vec![(base + row::BASE_GYRO_BIAS, linear.base_gyro_bias)];
                        for axis in 0..3 {
                            entries.push((base + axis, linear.rotation_i[axis]));
                            entries.push((STATE_DIM * other + axis, linear.rotation_j[axis]));
                        }
                        rows.push((entries, linear.residual));
                        continue;
                    }
                };
                let linear = factor.linearize(&states[index], &states[other]);
                for row in 0..6 {
                    let mut entries = Vec::new();
                    for column in 0..6 {
                        entries.push((base + column, linear.jacobian_i[(row, column)]));
                        entries.push((STATE_DIM * other + column, linear.jacobian_j[(row, column)]));
                    }
                    rows.push((entries, linear.residual[row]));
                }
            }
        }
        let mut jacobian = Mat::<f64>::zeros(rows.len(), columns);
        let mut right = Mat::<f64>::zeros(rows.len(), 1);
        for (row, (entries, residual)) in rows.iter().enumerate() {
            for (column, value) in entries {
                jacobian[(row, *column)] += value;
            }
            right[(row, 0)] = -residual;
        }
        let factorized = jacobian.qr();
        factorized.solve_lstsq_in_place_with_conj(faer::Conj::No, right.as_mut());
        for (index, state) in states.iter_mut().enumerate() {
            *state = state.plus(&StateVector::from_fn(|row, _| right[(STATE_DIM * index + row, 0)]));
        }
        // Covariance of the last node: from R's last block, (R₂₂ᵀ R₂₂)⁻¹.
        let last = columns - STATE_DIM;
        let upper = factorized.thin_R();
        let block = StateMatrix::from_fn(|r, c| if c >= r { upper[(last + r, last + c)] } else { 0.0 });
        let inverse = block.try_inverse().expect("determined");
        covariance = inverse * inverse.transpose();
    }
    (states, covariance)
}

fn assert_agrees(smoother: &mut Smoother, start: NavState, tolerance: f64) {
    let (dense, covariance) = dense_solve(smoother, start);
    for ((stamp, estimate), dense) in smoother.estimates().zip(&dense) {
        let error = estimate.minus(dense).amax();
        assert!(error < tolerance, "at {stamp}: {error}");
    }
    let scale = covariance.diagonal().map(f64::sqrt);
    for row in 0..STATE_DIM {
        for column in 0..STATE_DIM {
            let error = smoother.newest_covariance()[(row, column)] - covariance[(row, column)];
            assert!(error.abs() < 1e-5 * scale[row] * scale[column], "covariance ({row}, {column}): {error}");
        }
    }
}

#[test]
fn window_with_overlapping_edges_agrees_with_a_dense_solve() {
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(1));
    let truth = motion(2.5);
    let mut smoother = started(100.0, &truth, &mut draw);
    let start = smoother.newest().expect("started").1;
    for millis in (50..2400).step_by(50) {
        add_fix(&mut smoother, &truth, millis, &mut draw);
        if millis % 200 == 0 {
            add_increment(&mut smoother, &truth, millis - 190, millis - 5, &mut draw);
        }
        if millis % 600 == 0 {
            // Two longer edges over the short ones.
            add_increment(&mut smoother, &truth, millis - 505, millis - 23, &mut draw);
            add_increment(&mut smoother, &truth, millis - 333, millis - 5, &mut draw);
        }
        if millis % 500 == 0 {
            add_turn(&mut smoother, &truth, millis - 450, millis, &mut draw);
            add_pose(&mut smoother, &truth, millis - 111, &mut draw);
        }
        smoother.update().expect("determined");
    }
    assert_agrees(&mut smoother, start, 1e-7);
    let (stamp, newest) = smoother.newest().expect("started");
    let error = newest.minus(&true_state(&truth, stamp));
    let information = smoother.newest_covariance().try_inverse().expect("positive definite");
    // Chi-square with 16 degrees of freedom is under 47 with probability 0.9999.
    let squared = (error.transpose() * information * error)[(0, 0)];
    assert!(squared < 47.0, "normalized estimation error squared is {squared}");
}

#[test]
fn late_measurements_in_any_order_lead_to_the_same_estimate() {
    let truth = motion(1.0);
    let millis = [100_i64, 150, 200, 250, 300, 350, 400, 450];
    let shuffled = [100_i64, 300, 200, 150, 450, 400, 250, 350];
    let solve = |order: &[i64]| {
        let mut smoother = started(100.0, &truth, &mut Draw(ChaCha8Rng::seed_from_u64(2)));
        for millis in order {
            add_fix(&mut smoother, &truth, *millis, &mut Draw(ChaCha8Rng::seed_from_u64(*millis as u64)));
            smoother.update().expect("determined");
        }
        smoother
    };
    let (mut in_order, mut late) = (solve(&millis), solve(&shuffled));
    for ((stamp, a), (_, b)) in in_order.estimates().zip(late.estimates()) {
        assert!(a.minus(&b).amax() < 1e-6, "at {stamp}: {}", a.minus(&b));
    }
    assert_agrees(
        &mut late,
        started(100.0, &truth, &mut Draw(ChaCha8Rng::seed_from_u64(2))).newest().expect("started").1,
        1e-7,
    );
}

/// Marginalization loses nothing but the choice of linearization points.
#[test]
fn short_window_ends_where_the_whole_does() {
    let truth = motion(6.0);
    let solve = |lag_s: f64| {
        let mut draw = Draw(ChaCha8Rng::seed_from_u64(3));
        let mut smoother = started(lag_s, &truth, &mut draw);
        for millis in (50..5900).step_by(50) {
            add_fix(&mut smoother, &truth, millis, &mut draw);
            if millis % 200 == 0 {
                add_increment(&mut smoother, &truth, millis - 190, millis - 5, &mut draw);
            }
            smoother.update().expect("determined");
        }
        let (_, newest) = smoother.newest().expect("started");
        (newest, *smoother.newest_covariance(), smoother.estimates().count())
    };
    let (whole, whole_covariance, _) = solve(100.0);
    let (short, short_covariance, nodes) = solve(1.0);
    assert!(nodes < 40, "{nodes} nodes in a window of one second");
    let sigma = whole_covariance.diagonal().map(f64::sqrt);
    let in_sigmas = short.minus(&whole).component_div(&sigma).amax();
    assert!(in_sigmas < 0.05, "{in_sigmas} sigmas apart");
    let growth = short_covariance.diagonal().component_div(&whole_covariance.diagonal());
    assert!((growth.max() - 1.0).abs() < 0.03 && (growth.min() - 1.0).abs() < 0.03, "{growth}");
}

#[test]
fn what_is_too_old_or_ahead_of_the_imu_is_refused() {
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(4));
    let truth = motion(3.0);
    let mut smoother = started(0.5, &truth, &mut draw);
    for millis in (50..2000).step_by(50) {
        add_fix(&mut smoother, &truth, millis, &mut draw);
        smoother.update().expect("determined");
    }
    let before: Vec<_> = smoother.estimates().collect();
    assert!(matches!(smoother.node_at(Stamp::from_nanos(300_000_000)), Err(SmootherError::TooOld { .. })));
    assert!(matches!(
        smoother.node_at(Stamp::from_nanos(9_000_000_000)),
        Err(SmootherError::AheadOfImu { .. })
    ));
    assert_eq!(before, smoother.estimates().collect::<Vec<_>>());
}

#[test]
fn measurement_next_to_a_node_gets_that_node() {
    let truth = motion(1.0);
    let mut smoother = started(10.0, &truth, &mut Draw(ChaCha8Rng::seed_from_u64(5)));
    let node = smoother.node_at(Stamp::from_nanos(500_000_000)).expect("covered");
    for nanos in [499_100_000, 500_900_000] {
        assert_eq!(smoother.node_at(Stamp::from_nanos(nanos)), Ok(node));
    }
    assert_ne!(smoother.node_at(Stamp::from_nanos(501_500_000)), Ok(node));
}

/// Old nodes are left unsolved until somebody asks: what is seen must not depend on who asks when, and in the end must
/// be what the whole window says.
#[test]
fn what_is_left_unsolved_changes_nothing_that_is_seen() {
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(9));
    let truth = motion(3.0);
    let mut smoother = started(100.0, &truth, &mut draw);
    let start = smoother.newest().expect("started").1;
    // The limits of practice, wider by what so short a window knows less.
    let practice = Options::new(Span::from_seconds(100.0), gravity(), NOISE);
    smoother.options.relinearize = practice.relinearize.map(|limit| 10.0 * limit);
    smoother.options.iterations_max = practice.iterations_max;
    let mut left_unsolved = 0;
    for millis in (50..2900).step_by(50) {
        add_fix(&mut smoother, &truth, millis, &mut draw);
        if millis % 200 == 0 {
            // Late, over nodes that may not be solved.
            add_increment(&mut smoother, &truth, millis - 190, millis - 120, &mut draw);
        }
        if millis % 500 == 0 {
            add_turn(&mut smoother, &truth, millis - 450, millis, &mut draw);
        }
        smoother.update().expect("determined");
        left_unsolved += usize::from(smoother.solved > 0);
        let mut asked = smoother.clone();
        asked.solve_back_to(0);
        assert_eq!(asked.newest(), smoother.newest());
        assert_eq!(asked.newest_covariance(), smoother.newest_covariance());
    }
    assert!(left_unsolved > 10, "nothing is left unsolved: this shows nothing");
    // Linearized at the end as finely as in the other tests, it is what the dense solve says.
    smoother.options.relinearize = [1e-9; 6];
    smoother.options.iterations_max = 12;
    add_fix(&mut smoother, &truth, 2_900, &mut draw);
    smoother.update().expect("determined");
    assert_agrees(&mut smoother, start, 1e-7);
}

/// Covariance of the prediction against sampled states pushed through the same motion.
#[test]
fn predicted_covariance_agrees_with_sampling() {
    const RUNS: usize = 3000;
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(6));
    let truth = motion(1.0);
    let start = truth[0].1;
    let mut samples = SampleBuffer::default();
    truth.iter().for_each(|(sample, _)| samples.push(*sample));
    let steps: Vec<Step> = samples.steps(truth[0].0.stamp, truth[60].0.stamp).expect("covered").collect();
    let sigmas = [0.01, 0.02, 0.03, 1e-3, 0.02, 1e-3];
    let covariance =
        StateMatrix::from_diagonal(&StateVector::from_fn(|row, _| f64::powi(sigmas[row / 3], 2)));
    let motion = Preintegration::of_steps(steps.iter().copied(), Vec3::zeros(), Vec3::zeros(), &NOISE);
    let predicted = predict_covariance(&motion, &start, &covariance, &NOISE);
    assert_eq!(
        predict_pose_covariance(&motion, &start, &covariance),
        predicted.fixed_view::<6, 6>(0, 0).into_owned()
    );
    let nominal = motion.predict(&start, &gravity());
    let mut sampled = StateMatrix::zeros();
    for _ in 0..RUNS {
        let mut tangent = StateVector::zeros();
        for (part, sigma) in sigmas.iter().enumerate() {
            let drawn = draw.vector(*sigma);
            let room = (STATE_DIM - 3 * part).min(3);
            tangent.rows_mut(3 * part, room).copy_from(&drawn.rows(0, room));
        }
        let end = steps.iter().fold(start.plus(&tangent), |state, step| {
            let noisy = Step {
                angular_rate: step.angular_rate
                    + draw.vector(NOISE.gyroscope_noise_density / step.span_s.sqrt()),
                specific_force: step.specific_force
                    + draw.vector(NOISE.accelerometer_noise_density / step.span_s.sqrt()),
                ..*step
            };
            propagate(&state, &noisy, &gravity())
        });
        let error = end.minus(&nominal);
        sampled += error * error.transpose() / RUNS as f64;
    }
    for row in 0..STATE_DIM {
        for column in 0..STATE_DIM {
            let scale = (predicted[(row, row)] * predicted[(column, column)]).sqrt();
            let error = (sampled[(row, column)] - predicted[(row, column)]).abs() / scale;
            assert!(error < 0.12, "({row}, {column}) is off by {error} of its scale");
        }
    }
}
