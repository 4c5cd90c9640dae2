//! Gauss-Newton over the window: what was touched is eliminated, what has moved is solved.

use std::collections::VecDeque;

use super::elimination::{NODE_TILES, POSE_TILES};
use super::node::{LaterEdge, Node, PAIR_TILES};
use super::tile::LANES;
use super::{HELD_NODES, Smoother, SmootherError, UpdateStats};
use crate::state::{NavState, STATE_DIM, StateVector};
use crate::time::Stamp;

/// Back-substitution goes on into the past while nodes move by more than this part of the limits at which they are
/// linearized anew.
const QUIET: f64 = 0.5;
/// So many updates apart at most, all nodes are solved and looked at: some have crept.
const SWEEP_EVERY: usize = 32;

/// Nodes drift together. Where one is linearized anew, those go along that have come so far on their way to the
/// limits, so that they do not follow one by one.
const ON_THE_WAY: f64 = 0.5;

/// Tile of a front at which each tile of a link's block belongs.
const PAIR_PLACES: [usize; PAIR_TILES] = {
    let mut places = [0; PAIR_TILES];
    let mut index = 0;
    while index < PAIR_TILES {
        places[index] = index;
        index += 1;
    }
    places
};

impl Smoother {
    /// Brings the estimate up to date with everything added, and drops what is older than the lag.
    ///
    /// # Errors
    /// [`SmootherError::NotDetermined`]: the window must be started anew.
    pub fn update(&mut self) -> Result<UpdateStats, SmootherError> {
        if self.nodes.is_empty() {
            return Err(SmootherError::NotStarted);
        }
        let mut stats = UpdateStats::default();
        self.updates_since_sweep += 1;
        let sweep = self.updates_since_sweep >= SWEEP_EVERY;
        while self.touched < self.nodes.len() {
            stats.iterations += 1;
            stats.eliminated += self.nodes.len() - self.touched;
            let from = self.touched;
            self.eliminate()?;
            self.solve(from);
            if sweep {
                self.solve_back_to(0);
                self.updates_since_sweep = 0;
            }
            if stats.iterations < self.options.iterations_max {
                self.relinearize();
            }
            stats.solved += self.nodes.len() - self.solved;
        }
        if let Some(newest) = self.nodes.back().filter(|_| stats.iterations > 0) {
            self.newest_covariance = newest.front.covariance();
        }
        self.marginalize();
        stats.nodes = self.nodes.len();
        Ok(stats)
    }

    /// Eliminates from the oldest touched node to the newest.
    fn eliminate(&mut self) -> Result<(), SmootherError> {
        for index in self.touched..self.nodes.len() {
            self.linearize(index);
            self.assemble(index);
            self.nodes[index].front.eliminate().map_err(|_| SmootherError::NotDetermined)?;
        }
        self.touched = self.nodes.len();
        Ok(())
    }

    /// Makes the blocks of the factors that the node at `index` is the oldest part of, where there are none.
    fn linearize(&mut self, index: usize) {
        if let Some(next) = self.nodes.get(index + 1).map(|next| next.linearization) {
            self.nodes[index].linearize_link(&next, &self.options.gravity);
        }
        for edge in 0..self.nodes[index].edges.len() {
            let LaterEdge { later, block, .. } = &self.nodes[index].edges[edge];
            if block.is_none() {
                let later = *linearization_at(&self.nodes, *later);
                self.nodes[index].linearize_edge(edge, &later);
            }
        }
    }

    /// Fills the front with all that ties the node at `index` to itself and to later ones.
    fn assemble(&mut self, index: usize) {
        if index == 0 {
            let nodes = &self.nodes;
            self.prior.move_to(|stamp| *linearization_at(nodes, stamp));
        }
        let mut front = std::mem::take(&mut self.nodes[index].front);
        let node = &self.nodes[index];
        let incoming = match index.checked_sub(1) {
            None => self.prior.message(),
            Some(before) => &self.nodes[before].front.message,
        };
        front.begin();
        for variable in incoming.variables.iter().filter(|variable| variable.stamp != node.stamp) {
            front.message.include(variable.stamp, variable.tiles);
        }
        if let Some(next) = self.nodes.get(index + 1) {
            front.message.include(next.stamp, NODE_TILES);
        }
        for edge in &node.edges {
            front.message.include(edge.later, POSE_TILES);
        }
        front.lay_out();
        if node.link.is_some() {
            front.add(&PAIR_PLACES, &node.link_block.tiles, &node.link_block.right);
        }
        front.add_message(node.stamp, incoming, &mut self.places);
        for LaterEdge { later, block, .. } in &node.edges {
            let Some(block) = block else { continue };
            self.places.clear();
            self.places.extend(0..NODE_TILES);
            let first = front.first_of(*later);
            self.places.extend(first..first + POSE_TILES);
            front.add(&self.places, &block.tiles, &block.right);
        }
        self.room.note(node, &front);
        let node = &mut self.nodes[index];
        if !node.positions.is_empty() {
            let estimate = node.estimate();
            for position in 0..node.positions.len() {
                let block = node.position_block(position, &estimate);
                front.add(&PAIR_PLACES[..POSE_TILES], &block.tiles, &block.right);
            }
        }
        for pose in 0..node.poses.len() {
            let block = node.pose_block(pose);
            front.add(&PAIR_PLACES[..POSE_TILES], &block.tiles, &block.right);
        }
        node.front = front;
    }

    /// Back-substitution from the newest node down to `from`, and on as long as nodes move.
    fn solve(&mut self, from: usize) {
        self.solved = self.nodes.len();
        while self.solved > 0 {
            let change = self.solve_next();
            if self.solved <= from && !self.exceeds_limits(&change, QUIET) {
                return;
            }
        }
    }

    /// Makes sure that δ of the node at `index`, and so its estimate, is that of the last elimination.
    pub(super) fn solve_back_to(&mut self, index: usize) {
        while self.solved > index {
            self.solve_next();
        }
    }

    /// Solves the newest node that is not; returns by how much its δ changed.
    fn solve_next(&mut self) -> StateVector {
        self.solved -= 1;
        let node = &self.nodes[self.solved];
        let solution = &mut self.solution;
        solution.clear();
        solution.resize(node.front.side(), [0.0; LANES]);
        for parent in &node.front.message.variables {
            let rows = parent.tiles * LANES;
            let first = (NODE_TILES + parent.first) * LANES;
            let found = place_of(&self.nodes, parent.stamp);
            solution.as_flattened_mut()[first..first + rows]
                .copy_from_slice(&self.nodes[found].delta.as_slice()[..rows]);
        }
        node.front.solve(solution);
        let delta = StateVector::from_column_slice(&solution.as_flattened()[..STATE_DIM]);
        let change = delta - node.delta;
        self.nodes[self.solved].delta = delta;
        change
    }

    /// Whether some row is larger than a part of the limit at which a node is linearized anew.
    fn exceeds_limits(&self, delta: &StateVector, part: f64) -> bool {
        let limits = self.options.relinearize.map(|limit| limit * part);
        delta.iter().enumerate().any(|(row, value)| value.abs() > limits[row / 3])
    }

    /// If a solved node has gone too far from its linearization, moves that of all nodes that are on the way there
    /// too, and touches all they are tied to.
    fn relinearize(&mut self) {
        let moved = |smoother: &Self, index: usize, part: f64| {
            smoother.exceeds_limits(&smoother.nodes[index].delta, part)
        };
        if !(self.solved..self.nodes.len()).any(|index| moved(self, index, 1.0)) {
            return;
        }
        // All is solved before the first is moved, as long as the old linearization holds.
        self.solve_back_to(0);
        for index in 0..self.nodes.len() {
            if moved(self, index, ON_THE_WAY) {
                self.touched = self.touched.min(self.oldest_tied_to(index));
                self.move_linearization(index);
            }
        }
    }

    /// Index of the oldest node whose front speaks of the one at `index`.
    fn oldest_tied_to(&self, index: usize) -> usize {
        let node = &self.nodes[index];
        // The prior ties all its variables to the oldest node.
        if self.prior.speaks_of(node.stamp) {
            return 0;
        }
        let by_edge =
            node.reaches_back.map_or(index, |stamp| self.nodes.partition_point(|node| node.stamp < stamp));
        by_edge.min(index.saturating_sub(1))
    }

    fn move_linearization(&mut self, index: usize) {
        let Node { stamp, reaches_back, .. } = *self.nodes[index];
        self.nodes[index].relinearize();
        if let Some(before) = index.checked_sub(1) {
            self.nodes[before].forget_link();
        }
        if let Some(oldest) = reaches_back {
            let oldest = self.nodes.partition_point(|node| node.stamp < oldest);
            self.nodes.range_mut(oldest..index).for_each(|node| node.forget_ties_to(stamp));
        }
    }

    /// Drops nodes older than the lag and not held; what they said of those that stay is the new prior.
    fn marginalize(&mut self) {
        let Some(newest) = self.nodes.back().map(|node| node.stamp) else { return };
        let held = self.held.and_then(|held| self.node_before(held));
        let leaves = |oldest: Stamp, nodes: usize| {
            newest - oldest > self.options.lag
                && (held.is_none_or(|held| oldest < held) || nodes > HELD_NODES)
        };
        while self.nodes.len() > 1 && leaves(self.nodes[0].stamp, self.nodes.len()) {
            let Some(mut node) = self.nodes.pop_front() else { return };
            if let Some(history) = &mut self.history {
                history.note(&node);
            }
            let nodes = &self.nodes;
            self.prior.replace(&mut node.front.message, |stamp| *linearization_at(nodes, stamp));
            self.spare.push(node);
            self.touched -= 1;
            self.solved = self.solved.saturating_sub(1);
        }
        self.samples.forget_before(self.nodes[0].stamp);
    }
}

/// Index of a node that is in the window.
fn place_of(nodes: &VecDeque<Box<Node>>, stamp: Stamp) -> usize {
    nodes
        .binary_search_by_key(&stamp, |node| node.stamp)
        .expect("what a node of the window is tied to is in the window")
}

fn linearization_at(nodes: &VecDeque<Box<Node>>, stamp: Stamp) -> &NavState {
    &nodes[place_of(nodes, stamp)].linearization
}
