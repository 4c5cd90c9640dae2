//! The factors of a chain: their cost, and their normal equations.

use std::sync::Arc;

use super::layout::{Equations, Layout};
use super::{BatchError, FactorCounts};
use crate::factors::huber_weight;
use crate::lie::{So3, Vec3, Vec6};
use crate::smoother::{Edge, PastNode, WindowStart};
use crate::state::{NavState, StateMatrix, StateVector, row};

/// A link is as long as its nodes are apart, but for the rounding of its steps, s.
const LINK_APART_MAX_S: f64 = 1.0e-6;

/// A chain and where its edges lead.
pub(super) struct Graph<'a> {
    chain: &'a [Arc<PastNode>],
    start: &'a WindowStart,
    gravity: Vec3,
    /// From, to, and which of the older node's edges.
    edges: Vec<([usize; 2], &'a Edge)>,
}

impl<'a> Graph<'a> {
    /// Checks that the chain is one.
    pub fn new(chain: &'a [Arc<PastNode>], gravity: Vec3) -> Result<Self, BatchError> {
        let first = chain.first().ok_or(BatchError::Empty)?;
        let start = first.start.as_deref().ok_or(BatchError::NotAChain)?;
        if chain[1..].iter().any(|node| node.start.is_some()) {
            return Err(BatchError::NotAChain);
        }
        let mut edges = Vec::new();
        for (from, node) in chain.iter().enumerate() {
            let broken = BatchError::Broken { stamp: node.stamp };
            let next = chain.get(from + 1);
            if next.is_some_and(|next| !links(node, next)) {
                return Err(broken);
            }
            for (later, edge) in &node.edges {
                let ahead = chain[from + 1..].binary_search_by_key(later, |node| node.stamp);
                edges.push(([from, from + 1 + ahead.map_err(|_| broken)?], edge));
            }
        }
        Ok(Self { chain, start, gravity, edges })
    }

    /// From and to of all edges.
    pub fn edge_ends(&self) -> Vec<[usize; 2]> {
        self.edges.iter().map(|(ends, _)| *ends).collect()
    }

    /// ½ Σ ρ(‖r‖²), with the start's ½ δᵀ Λ δ.
    pub fn cost(&self, states: &[NavState]) -> f64 {
        let off = states[0].minus(&self.start.state);
        let mut sum = off.dot(&(self.start.information * off));
        for (index, node) in self.chain.iter().enumerate() {
            let state = &states[index];
            if let (Some(link), Some(next)) = (&node.link, states.get(index + 1)) {
                sum += link.residual(state, next, &self.gravity).norm_squared();
            }
            for factor in &node.positions {
                sum += huber(factor.residual(state).norm(), factor.huber_threshold);
            }
            for factor in &node.poses {
                sum += factor.residual(state).norm_squared();
            }
        }
        for ([from, to], edge) in &self.edges {
            sum += match edge {
                Edge::Between(factor) => factor.residual(&states[*from], &states[*to]).norm_squared(),
                Edge::Turn(factor) => factor.residual(&states[*from], &states[*to]).powi(2),
            };
        }
        0.5 * sum
    }

    /// H = Σ w JᵀJ and g = −Σ w Jᵀr at these states, with w the weights of the losses there.
    pub fn assemble(&self, states: &[NavState], layout: &Layout, equations: &mut Equations) {
        equations.clear();
        self.add_start(&states[0], layout, equations);
        for (index, node) in self.chain.iter().enumerate() {
            let state = &states[index];
            if let (Some(link), Some(next)) = (&node.link, states.get(index + 1)) {
                let linear = link.linearize(state, next, &self.gravity);
                let (by_i, by_j) = (linear.jacobian_i.transpose(), linear.jacobian_j.transpose());
                equations.add_whole(layout, index, &(by_i * linear.jacobian_i));
                equations.add_neighbours(layout, index + 1, &(by_i * linear.jacobian_j));
                equations.add_whole(layout, index + 1, &(by_j * linear.jacobian_j));
                equations.right[index] -= by_i * linear.residual;
                equations.right[index + 1] -= by_j * linear.residual;
            }
            for factor in &node.positions {
                let linear = factor.linearize(state);
                let weight = huber_weight(linear.residual.norm(), factor.huber_threshold);
                let back = linear.jacobian.transpose() * weight;
                equations.add_pose(layout, index, &(back * linear.jacobian));
                subtract(&mut equations.right[index], &(back * linear.residual));
            }
            for factor in &node.poses {
                let linear = factor.linearize(state);
                let back = linear.jacobian.transpose();
                equations.add_pose(layout, index, &(back * linear.jacobian));
                subtract(&mut equations.right[index], &(back * linear.residual));
            }
        }
        for (ends, edge) in &self.edges {
            add_edge(states, *ends, edge, layout, equations);
        }
        equations.finish(layout);
    }

    /// δ_start = Δ + J δ with Δ from where the start's information holds and J = diag(Jr⁻¹(Δ_φ), I): H = Jᵀ Λ J,
    /// g = −Jᵀ Λ Δ, as the window has it.
    fn add_start(&self, state: &NavState, layout: &Layout, equations: &mut Equations) {
        let off = state.minus(&self.start.state);
        let mut by_state = StateMatrix::identity();
        let turn: Vec3 = off.fixed_rows::<3>(row::ROTATION).into_owned();
        by_state
            .fixed_view_mut::<3, 3>(row::ROTATION, row::ROTATION)
            .copy_from(&So3::right_jacobian_inverse(&turn));
        let back = by_state.transpose() * self.start.information;
        equations.add_whole(layout, 0, &(back * by_state));
        equations.right[0] -= back * off;
    }

    /// How many factors there are.
    pub fn counts(&self, states: &[NavState]) -> FactorCounts {
        let mut counts = FactorCounts { imu: self.chain.len() - 1, ..FactorCounts::default() };
        for (node, state) in self.chain.iter().zip(states) {
            counts.positions += node.positions.len();
            counts.poses += node.poses.len();
            let odd =
                node.positions.iter().filter(|factor| factor.residual(state).norm() > factor.huber_threshold);
            counts.weighted_down += odd.count();
        }
        counts.between = self.edges.iter().filter(|(_, edge)| matches!(edge, Edge::Between(_))).count();
        counts.turns = self.edges.len() - counts.between;
        counts
    }
}

fn add_edge(states: &[NavState], ends: [usize; 2], edge: &Edge, layout: &Layout, equations: &mut Equations) {
    let [from, to] = ends;
    let (state_i, state_j) = (&states[from], &states[to]);
    match edge {
        Edge::Between(factor) => {
            let linear = factor.linearize(state_i, state_j);
            let (by_i, by_j) = (linear.jacobian_i.transpose(), linear.jacobian_j.transpose());
            equations.add_pose(layout, from, &(by_i * linear.jacobian_i));
            equations.add_pose(layout, to, &(by_j * linear.jacobian_j));
            let across = by_i * linear.jacobian_j;
            for column in 0..across.ncols() {
                for row in 0..across.nrows() {
                    equations.add_edge(layout, ends, row, column, across[(row, column)]);
                }
            }
            subtract(&mut equations.right[from], &(by_i * linear.residual));
            subtract(&mut equations.right[to], &(by_j * linear.residual));
        }
        Edge::Turn(factor) => {
            let linear = factor.linearize(state_i, state_j);
            let mut by_i = StateVector::zeros();
            by_i.fixed_rows_mut::<3>(row::ROTATION).copy_from(&linear.rotation_i);
            by_i[row::BASE_GYRO_BIAS] = linear.base_gyro_bias;
            let by_j = linear.rotation_j;
            equations.add_whole(layout, from, &(by_i * by_i.transpose()));
            equations.add_own(layout, to, row::ROTATION..row::ROTATION + 3, |row, column| {
                by_j[row] * by_j[column]
            });
            for (row, value) in by_i.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                for axis in 0..3 {
                    equations.add_edge(layout, ends, row, row::ROTATION + axis, value * by_j[axis]);
                }
            }
            equations.right[from] -= by_i * linear.residual;
            let mut rotation = equations.right[to].fixed_rows_mut::<3>(row::ROTATION);
            rotation -= by_j * linear.residual;
        }
    }
}

/// Whether a node's link leads to the next one.
fn links(node: &PastNode, next: &PastNode) -> bool {
    let span_s = next.stamp.seconds_since(node.stamp);
    node.link
        .as_ref()
        .is_some_and(|link| span_s > 0.0 && (link.motion().span_s - span_s).abs() < LINK_APART_MAX_S)
}

/// From the first rows of a node's g.
fn subtract(right: &mut StateVector, part: &Vec6) {
    let mut pose = right.fixed_rows_mut::<6>(row::ROTATION);
    pose -= part;
}

/// Huber's loss of a whitened residual of that length: its square up to the threshold, then straight on.
fn huber(norm: f64, threshold: f64) -> f64 {
    if norm <= threshold { norm * norm } else { threshold * (2.0 * norm - threshold) }
}
