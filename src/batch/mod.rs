//! A whole chain of states at once: the graph that a window was given, node by node, solved as one batch.
//!
//! Live, a state is what was known when it left the window; here it is what all measurements say, those that came
//! after it too. Nodes, factors and losses are those of the live graph ([`PastNode`]); which measurements to believe
//! was decided there. Equations, order of elimination and memory: `README.md` beside this file.

mod factorization;
mod graph;
mod layout;
mod trajectory;

use std::sync::Arc;

use graph::Graph;
use layout::Layout;
pub use trajectory::fill;

use crate::lie::{Mat6, Vec3};
use crate::smoother::PastNode;
use crate::state::{NavState, StateVector};
use crate::time::Stamp;

/// Bytes that a node of a chain takes while it is solved, with three edges to each; what its factors take is not
/// counted.
pub const NODE_BYTES: usize = 16_000;

/// Damping that the first failed step begins with, as a part of the diagonal; and the largest.
const DAMPING: [f64; 2] = [1.0e-6, 1.0e6];
/// Costs are sums of so many terms that they are compared no finer than by this part.
const COST_ROUNDING: f64 = 1.0e-9;

/// Settings of the solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// In the world, m/s².
    pub gravity: Vec3,
    /// A step in which no node moves further than this is the last: rotation (rad), position (m), velocity (m/s),
    /// gyro bias (rad/s), accelerometer bias (m/s²), chassis gyro bias (rad/s).
    pub tolerance: [f64; 6],
    /// Steps at most.
    pub iterations_max: usize,
}

impl Options {
    /// As fine as the numbers carry.
    pub fn new(gravity: Vec3) -> Self {
        Self { gravity, tolerance: [1.0e-8, 1.0e-7, 1.0e-7, 1.0e-9, 1.0e-7, 1.0e-9], iterations_max: 30 }
    }
}

/// Why a chain has no solution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BatchError {
    /// There is nothing to solve.
    #[error("has no nodes")]
    Empty,
    /// The chain does not begin where a window was started.
    #[error("does not begin with a start, or holds a second one")]
    NotAChain,
    /// An edge leads to no later node of the chain, or two neighbours are not linked.
    #[error("is broken behind the node at {stamp} s")]
    Broken {
        /// Of the node.
        stamp: Stamp,
    },
    /// More entries than an index counts.
    #[error("has too many nodes for one batch: divide it")]
    TooLarge,
    /// The normal equations are not positive definite, however damped.
    #[error("is not determined by its measurements at {stamp} s")]
    NotDetermined {
        /// Of the node at which it shows.
        stamp: Stamp,
    },
}

/// A node of the solution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SmoothedNode {
    /// Of the node.
    pub stamp: Stamp,
    /// By all measurements of the chain.
    pub state: NavState,
    /// Of rotation (rad, right tangent) and position (m, world).
    pub covariance: Mat6,
}

/// What a chain's measurements say together.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// Oldest first.
    pub nodes: Vec<SmoothedNode>,
    /// Steps taken.
    pub iterations: usize,
    /// Whether the last one was within the tolerance.
    pub converged: bool,
    /// ½ Σ ρ(‖r‖²) at the start of the first step and after the last.
    pub cost: [f64; 2],
    /// Factors by kind.
    pub factors: FactorCounts,
}

/// Factors of a graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FactorCounts {
    /// Between neighbours.
    pub imu: usize,
    /// Antenna positions.
    pub positions: usize,
    /// Antenna positions beyond their loss' threshold at the solution.
    pub weighted_down: usize,
    /// Poses in the world.
    pub poses: usize,
    /// Relative poses, of lidar and of a chassis that stands.
    pub between: usize,
    /// Turns of the chassis.
    pub turns: usize,
}

/// How far a solve has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Steps that were tried.
    pub iterations: usize,
    /// The largest move of the last step, in tolerances; the solve ends at 1.
    pub moved: f64,
}

/// The chains of a history: each begins where the window was started.
pub fn chains(history: &[Arc<PastNode>]) -> impl Iterator<Item = &[Arc<PastNode>]> {
    history.chunk_by(|_, next| next.start.is_none())
}

/// Solves a chain. `tell` hears of every step.
///
/// One thread, sums in one order, no fused operations: the same chain gives the same bits.
///
/// # Errors
/// [`BatchError`].
pub fn solve(
    chain: &[Arc<PastNode>],
    options: &Options,
    mut tell: impl FnMut(Progress),
) -> Result<Solution, BatchError> {
    let graph = Graph::new(chain, options.gravity)?;
    let layout = Layout::new(chain.len(), graph.edge_ends())?;
    let mut factorization = layout.analyze()?;
    let mut states: Vec<NavState> = chain.iter().map(|node| node.estimate).collect();
    let not_determined =
        |column: usize| BatchError::NotDetermined { stamp: chain[layout.node_of(column)].stamp };
    let mut cost = graph.cost(&states);
    let first_cost = cost;
    let (mut damping, mut iterations, mut converged) = (0.0, 0, false);
    let mut normal = layout.equations();
    let mut assembled = false;
    while iterations < options.iterations_max && !converged {
        if !assembled {
            graph.assemble(&states, &layout, &mut normal);
            assembled = true;
        }
        iterations += 1;
        normal.damp(&layout, damping);
        if let Err(column) = factorization.factorize(&layout, &normal) {
            damping = more(damping);
            if damping > DAMPING[1] {
                return Err(not_determined(column));
            }
            continue;
        }
        let step = factorization.solve(&normal);
        let moved = largest(&step, &options.tolerance);
        let next: Vec<NavState> = states.iter().zip(&step).map(|(state, step)| state.plus(step)).collect();
        let next_cost = graph.cost(&next);
        tell(Progress { iterations, moved });
        if !moved.is_finite() || !(next_cost <= cost * (1.0 + COST_ROUNDING) || moved <= 1.0) {
            damping = more(damping);
            if damping > DAMPING[1] {
                break;
            }
            continue;
        }
        (states, cost) = (next, next_cost);
        assembled = false;
        // A damped step is short for being damped.
        converged = moved <= 1.0 && damping == 0.0;
        damping = if damping <= DAMPING[0] { 0.0 } else { damping / 10.0 };
    }
    if !converged {
        graph.assemble(&states, &layout, &mut normal);
        normal.damp(&layout, 0.0);
        factorization.factorize(&layout, &normal).map_err(not_determined)?;
    }
    let covariances = factorization.into_covariances();
    let nodes = chain.iter().zip(states.iter().zip(covariances));
    let nodes = nodes.map(|(node, (state, covariance))| SmoothedNode {
        stamp: node.stamp,
        state: *state,
        covariance,
    });
    Ok(Solution {
        nodes: nodes.collect(),
        iterations,
        converged,
        cost: [first_cost, cost],
        factors: graph.counts(&states),
    })
}

fn more(damping: f64) -> f64 {
    (damping * 10.0).max(DAMPING[0])
}

/// The largest move of a step, in tolerances.
fn largest(step: &[StateVector], tolerance: &[f64; 6]) -> f64 {
    let moved = step.iter().flat_map(|node| node.iter().enumerate());
    moved.fold(0.0, |largest, (row, value)| {
        let moved = value.abs() / tolerance[row / 3];
        if moved > largest || moved.is_nan() { moved } else { largest }
    })
}

#[cfg(test)]
mod tests;
