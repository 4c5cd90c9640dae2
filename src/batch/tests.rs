//! The batch on a small chain: against dense algebra, from far away, and between its nodes.

use super::*;
use crate::factors::{BetweenFactor, PositionFactor};
use crate::lie::{Se3, So3};
use crate::preintegration::{ImuNoise, Step, propagate};
use crate::sensors::ImuSample;
use crate::smoother::{self, Smoother};
use crate::state::{STATE_DIM, StateMatrix};
use crate::time::Span;

const NOISE: ImuNoise = ImuNoise::OF_TESTS;
const MILLI: i64 = 1_000_000;

fn gravity() -> Vec3 {
    Vec3::new(0.0, 0.0, -9.81)
}

fn at(millis: i64) -> Stamp {
    Stamp::from_nanos(millis * MILLI)
}

/// Samples of a machine that turns and accelerates, with its states.
fn motion(seconds: i64) -> Vec<(ImuSample, NavState)> {
    let sample = |index: i64| {
        let t = index as f64 * 0.01;
        ImuSample {
            stamp: at(10 * index),
            angular_rate: Vec3::new(0.1 * (2.0 * t).sin(), 0.05 * (3.0 * t).cos(), 0.4 * t.sin()),
            specific_force: Vec3::new(0.8 * (1.5 * t).cos(), 0.5 * (2.5 * t).sin(), 9.81),
        }
    };
    let mut state = NavState::identity();
    let mut samples = vec![(sample(0), state)];
    for index in 1..=seconds * 100 {
        let next = sample(index);
        state = propagate(&state, &Step::between(&samples[samples.len() - 1].0, &next), &gravity());
        samples.push((next, state));
    }
    samples
}

/// Fixes at 5 Hz and lidar edges over 400 ms, each a little off, and one fix far off.
fn history(truth: &[(ImuSample, NavState)], lag: Span) -> Vec<Arc<PastNode>> {
    let mut smoother = Smoother::new(smoother::Options::new(lag, gravity(), NOISE));
    smoother.keep_history();
    truth.iter().for_each(|(sample, _)| smoother.push_sample(*sample));
    let sigmas = [0.05, 0.5, 0.5, 0.01, 0.1, 0.01];
    let information =
        StateMatrix::from_diagonal(&StateVector::from_fn(|row, _| f64::powi(sigmas[row / 3], -2)));
    smoother.start(truth[0].0.stamp, truth[0].1, &information).expect("covered");
    let lever_arm = Vec3::new(-1.1, 0.8, 2.0);
    let end = (truth.len() as i64 - 1) / 20;
    for fix in 1..=end {
        let (stamp, state) = (at(200 * fix), truth[20 * fix as usize].1);
        let node = smoother.node_at(stamp).expect("covered");
        let off = Vec3::new((fix as f64).sin(), (2.0 * fix as f64).cos(), 0.3) * 0.01;
        let far = if fix == 7 { Vec3::new(0.2, 0.0, 0.0) } else { Vec3::zeros() };
        let measured = state.position + state.rotation * lever_arm + off + far;
        let factor = PositionFactor { measured, lever_arm, sigma: Vec3::repeat(0.01), huber_threshold: 5.0 };
        smoother.add_position(node, factor).expect("node exists");
        if fix > 2 && fix % 2 == 0 {
            let pose = |millis: i64| {
                let state = truth[(millis / 10) as usize].1;
                Se3::new(state.rotation, state.position)
            };
            let error = Se3::new(So3::exp(&Vec3::new(0.0, 1e-3, -1e-3)), Vec3::new(0.004, -0.003, 0.0));
            let measured = pose(200 * (fix - 2)).inverse() * pose(200 * fix) * error;
            let factor = BetweenFactor { measured, imu_from_sensor: Se3::identity(), sigma: [1e-3, 6e-3] };
            smoother.add_between(at(200 * (fix - 2)), stamp, factor).expect("nodes exist");
        }
        smoother.update().expect("determined");
    }
    smoother.take_history()
}

fn solved(chain: &[Arc<PastNode>]) -> Solution {
    solve(chain, &Options::new(gravity()), |_| {}).expect("determined")
}

#[test]
fn history_holds_every_node_once_in_order() {
    let chain = history(&motion(6), Span::from_seconds(1.0));
    let stamps: Vec<i64> = chain.iter().map(|node| node.stamp.as_nanos() / MILLI).collect();
    assert_eq!(stamps, (0..=30).map(|index| 200 * index).collect::<Vec<_>>());
    assert!(chain[0].start.is_some() && chain[1..].iter().all(|node| node.start.is_none()));
    assert_eq!(chain.iter().map(|node| node.positions.len()).sum::<usize>(), 30);
    assert_eq!(chain.iter().map(|node| node.edges.len()).sum::<usize>(), 14);
    assert!(chain[30].link.is_none() && chain[..30].iter().all(|node| node.link.is_some()));
}

#[test]
fn a_short_window_built_the_same_graph_as_one_that_holds_all() {
    let truth = motion(6);
    let (short, long) = [1.0, 100.0].map(|lag_s| history(&truth, Span::from_seconds(lag_s))).into();
    let (short, long) = (solved(&short), solved(&long));
    assert!(short.converged && short.factors == long.factors);
    assert_eq!(short.factors.weighted_down, 1);
    for (short, long) in short.nodes.iter().zip(&long.nodes) {
        // Links were preintegrated around other biases.
        assert!(short.state.minus(&long.state).norm() < 1e-6, "{}", short.state.minus(&long.state));
    }
}

#[test]
fn the_same_chain_gives_the_same_bits() {
    let chain = history(&motion(6), Span::from_seconds(1.0));
    assert_eq!(solved(&chain), solved(&chain));
}

#[test]
fn a_bad_guess_ends_in_the_same_place() {
    let chain = history(&motion(6), Span::from_seconds(1.0));
    let reference = solved(&chain);
    let moved: Vec<Arc<PastNode>> = (0_i32..)
        .zip(&chain)
        .map(|(index, node)| {
            let turn = f64::from(index % 7 - 3);
            let tangent = StateVector::from_fn(|row, _| {
                if row < 3 {
                    0.1 * turn
                } else if row < 9 {
                    turn
                } else {
                    0.0
                }
            });
            Arc::new(PastNode { estimate: node.estimate.plus(&tangent), ..(**node).clone() })
        })
        .collect();
    let solution = solved(&moved);
    assert!(solution.converged && solution.cost[0] > 1e3 * solution.cost[1], "{:?}", solution.cost);
    for (node, reference) in solution.nodes.iter().zip(&reference.nodes) {
        assert!(node.state.minus(&reference.state).norm() < 1e-6);
    }
}

#[test]
fn covariances_are_those_of_the_whole_inverse() {
    let chain = history(&motion(4), Span::from_seconds(1.0));
    let states: Vec<NavState> = solved(&chain).nodes.iter().map(|node| node.state).collect();
    let graph = Graph::new(&chain, gravity()).expect("a chain");
    let layout = Layout::new(chain.len(), graph.edge_ends()).expect("small");
    let mut equations = layout.equations();
    graph.assemble(&states, &layout, &mut equations);
    let size = chain.len() * STATE_DIM;
    let mut dense = nalgebra::DMatrix::<f64>::zeros(size, size);
    for column in 0..size {
        for place in layout.column_starts[column]..layout.column_starts[column + 1] {
            let row = layout.rows[place as usize] as usize;
            dense[(row, column)] = equations.entries[place as usize];
            dense[(column, row)] = equations.entries[place as usize];
        }
    }
    let inverse = dense.cholesky().expect("positive definite").inverse();
    let mut factorization = layout.analyze().expect("small");
    factorization.factorize(&layout, &equations).expect("positive definite");
    for (node, covariance) in factorization.into_covariances().iter().enumerate() {
        let expected = inverse.fixed_view::<6, 6>(STATE_DIM * node, STATE_DIM * node);
        for row in 0..6 {
            for column in 0..6 {
                let scale = (expected[(row, row)] * expected[(column, column)]).sqrt();
                let off = (covariance[(row, column)] - expected[(row, column)]).abs() / scale;
                assert!(off < 1e-5, "node {node}, {row} {column}: {off}");
            }
        }
    }
}

#[test]
fn the_trajectory_passes_its_nodes_and_never_steps() {
    let truth = motion(6);
    let solution = solved(&history(&truth, Span::from_seconds(1.0)));
    let samples: Vec<ImuSample> = truth.iter().map(|(sample, _)| *sample).collect();
    let mut states = Vec::new();
    fill(&solution.nodes, &samples, &gravity(), |stamp, state, _| states.push((stamp, *state)));
    assert_eq!(states.len(), samples.len());
    for node in &solution.nodes {
        let (_, state) = states.iter().find(|(stamp, _)| *stamp == node.stamp).expect("a sample is there");
        assert!(state.minus(&node.state).norm() < 1e-12);
    }
    for (pair, truth) in states.windows(2).zip(truth.windows(2)) {
        let step = pair[1].1.position - pair[0].1.position;
        let mean = (truth[0].1.velocity + truth[1].1.velocity) * 0.005;
        assert!((step - mean).norm() < 1e-3, "{}", (step - mean).norm());
    }
}

#[test]
fn what_is_no_chain_is_refused_in_words() {
    let chain = history(&motion(2), Span::from_seconds(1.0));
    let refused =
        |chain: &[Arc<PastNode>]| solve(chain, &Options::new(gravity()), |_| {}).expect_err("refused");
    assert_eq!(refused(&[]), BatchError::Empty);
    assert_eq!(refused(&chain[1..]), BatchError::NotAChain);
    let mut twice = chain.clone();
    twice.extend_from_slice(&chain);
    assert_eq!(refused(&twice), BatchError::NotAChain);
    assert_eq!(chains(&twice).map(<[_]>::len).collect::<Vec<_>>(), [chain.len(), chain.len()]);
    let mut broken = chain.clone();
    broken.remove(6);
    assert_eq!(refused(&broken), BatchError::Broken { stamp: chain[4].stamp }, "its edge leads nowhere");
    let mut broken = chain.clone();
    broken.remove(7);
    assert_eq!(refused(&broken), BatchError::Broken { stamp: chain[6].stamp }, "its link is too short");
    let free = Arc::new(PastNode {
        start: Some(Box::new(crate::smoother::WindowStart {
            state: NavState::identity(),
            information: StateMatrix::zeros(),
        })),
        positions: Vec::new(),
        edges: Vec::new(),
        link: None,
        ..(*chain[0]).clone()
    });
    assert_eq!(refused(&[free]), BatchError::NotDetermined { stamp: chain[0].stamp });
}
