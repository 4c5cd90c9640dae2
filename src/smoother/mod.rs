//! The fixed-lag smoother: a window of states at the exact stamps of the measurements.
//!
//! Neighbours are tied by the IMU, so the window is a chain with few long edges; nodes are eliminated from the
//! oldest to the newest, each leaving a message to the next. An update re-linearizes and re-eliminates only
//! from the oldest touched node on; the message into the oldest node of the window is the marginal prior.
//! Complexity and derivation: `README.md` beside this file. Which measurements to believe is not decided here.

mod elimination;
mod node;

use std::collections::VecDeque;

use elimination::{Front, Message, POSE_DIM, TURN_DIM, Variable};
use node::{Edge, Node};

use crate::factors::{BetweenFactor, ImuFactor, PoseFactor, PositionFactor, TurnFactor};
use crate::lie::{Mat3, So3, Vec3};
use crate::preintegration::{ImuNoise, Preintegration, SampleBuffer, propagate};
use crate::sensors::ImuSample;
use crate::state::{NavState, STATE_DIM, StateMatrix, StateVector, row};
use crate::time::{Span, Stamp};

/// Nodes are at least this far apart; a measurement closer to a node is attached to that node, and its
/// caller moves it by the motion in between.
const NODE_SPACING: Span = Span::from_millis(1);

/// Settings of the window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Length of the window.
    pub lag: Span,
    /// In the world, m/s².
    pub gravity: Vec3,
    /// Of the cabin IMU.
    pub noise: ImuNoise,
    /// A node is linearized anew when its estimate has moved further than this from where it was: rotation
    /// (rad), position (m), velocity (m/s), gyro bias (rad/s), accelerometer bias (m/s²), chassis gyro bias
    /// (rad/s).
    pub relinearize: [f64; 6],
    /// Gauss-Newton iterations in one update, at most.
    pub iterations_max: usize,
}

impl Options {
    /// Thresholds at which the neglected second order stays under some micrometres.
    pub fn new(lag: Span, gravity: Vec3, noise: ImuNoise) -> Self {
        Self {
            lag,
            gravity,
            noise,
            relinearize: [1.0e-3, 0.1, 0.1, 1.0e-3, 0.02, f64::INFINITY],
            iterations_max: 4,
        }
    }
}

/// Why the window cannot take something.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SmootherError {
    /// Older than the window.
    #[error("is {behind_s:.3} s older than the window")]
    TooOld {
        /// By how much, s.
        behind_s: f64,
    },
    /// The IMU has not come so far.
    #[error("is {ahead_s:.3} s ahead of the IMU")]
    AheadOfImu {
        /// By how much, s.
        ahead_s: f64,
    },
    /// The window was not started.
    #[error("came before the window was started")]
    NotStarted,
    /// The normal equations are not positive definite.
    #[error("the estimate is not determined by its measurements")]
    NotDetermined,
}

/// What an update did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UpdateStats {
    /// Gauss-Newton iterations.
    pub iterations: usize,
    /// Nodes eliminated, over all iterations.
    pub eliminated: usize,
    /// Nodes in the window afterwards.
    pub nodes: usize,
}

/// The window. See the room's first lines.
#[derive(Clone)]
pub struct Smoother {
    options: Options,
    samples: SampleBuffer,
    nodes: VecDeque<Box<Node>>,
    /// Nodes that left the window, kept for their buffers.
    spare: Vec<Box<Node>>,
    /// Marginal information on the oldest nodes, and where it was linearized.
    prior: Message,
    prior_points: Vec<NavState>,
    /// Index of the oldest node whose elimination is out of date.
    touched: usize,
    front: Front,
    outgoing: Message,
    newest_covariance: StateMatrix,
}

impl Smoother {
    /// An empty window.
    pub fn new(options: Options) -> Self {
        Self {
            options,
            samples: SampleBuffer::default(),
            nodes: VecDeque::new(),
            spare: Vec::new(),
            prior: Message::default(),
            prior_points: Vec::new(),
            touched: 0,
            front: Front::default(),
            outgoing: Message::default(),
            newest_covariance: StateMatrix::zeros(),
        }
    }

    /// Appends an IMU sample, newer than all before.
    pub fn push_sample(&mut self, sample: ImuSample) {
        self.samples.push(sample);
    }

    /// The samples of the window.
    pub fn samples(&self) -> &SampleBuffer {
        &self.samples
    }

    /// Starts the window at `stamp` with a state and the information (inverse covariance, 16×16, positive
    /// definite) that is known of it. The samples must reach over `stamp`.
    ///
    /// # Errors
    /// [`SmootherError::AheadOfImu`] or [`SmootherError::TooOld`] if they do not.
    pub fn start(
        &mut self,
        stamp: Stamp,
        state: NavState,
        information: &StateMatrix,
    ) -> Result<(), SmootherError> {
        self.check_covered(stamp)?;
        while let Some(node) = self.nodes.pop_front() {
            self.spare.push(node);
        }
        let node = self.new_node(stamp, state);
        self.nodes.push_back(node);
        self.prior.variables.clear();
        self.prior.variables.push(Variable { stamp, dim: STATE_DIM });
        self.prior.values.clear();
        for column in 0..STATE_DIM {
            self.prior.values.extend((0..STATE_DIM).map(|row| information[(row, column)]));
            self.prior.values.push(0.0);
        }
        self.prior_points.clear();
        self.prior_points.push(state);
        self.touched = 0;
        self.samples.forget_before(stamp);
        self.update().map(|_| ())
    }

    /// Whether the window has begun.
    pub fn is_started(&self) -> bool {
        !self.nodes.is_empty()
    }

    /// The node for a measurement at `stamp`: made there, or the one closer than a millisecond. Returns its
    /// stamp, which names it.
    ///
    /// # Errors
    /// If `stamp` is older than the window or newer than the IMU.
    pub fn node_at(&mut self, stamp: Stamp) -> Result<Stamp, SmootherError> {
        let oldest = self.nodes.front().ok_or(SmootherError::NotStarted)?.stamp;
        if oldest - stamp > NODE_SPACING {
            return Err(SmootherError::TooOld { behind_s: oldest.seconds_since(stamp) });
        }
        let after = self.nodes.partition_point(|node| node.stamp < stamp);
        if let Some(next) = self.nodes.get(after)
            && next.stamp - stamp < NODE_SPACING
        {
            return Ok(next.stamp);
        }
        let before = after.checked_sub(1).ok_or(SmootherError::TooOld { behind_s: 0.0 })?;
        if stamp - self.nodes[before].stamp < NODE_SPACING {
            return Ok(self.nodes[before].stamp);
        }
        self.check_covered(stamp)?;
        self.insert(before, stamp)?;
        Ok(stamp)
    }

    fn check_covered(&self, stamp: Stamp) -> Result<(), SmootherError> {
        let (Some(oldest), Some(newest)) = (self.samples.oldest(), self.samples.newest()) else {
            return Err(SmootherError::AheadOfImu { ahead_s: f64::INFINITY });
        };
        if stamp > newest.stamp {
            Err(SmootherError::AheadOfImu { ahead_s: stamp.seconds_since(newest.stamp) })
        } else if stamp < oldest.stamp {
            Err(SmootherError::TooOld { behind_s: oldest.stamp.seconds_since(stamp) })
        } else {
            Ok(())
        }
    }

    /// Puts a node at `stamp` behind the one at index `before`, splitting its link.
    fn insert(&mut self, before: usize, stamp: Stamp) -> Result<(), SmootherError> {
        let start = self.nodes[before].estimate();
        let from = self.nodes[before].stamp;
        let head = self.link(from, stamp, &start)?;
        let state = head.motion().predict(&start, &self.options.gravity);
        let tail = match self.nodes.get(before + 1) {
            Some(next) => Some(self.link(stamp, next.stamp, &state)?),
            None => None,
        };
        let mut node = self.new_node(stamp, state);
        node.link = tail;
        self.nodes[before].set_link(head);
        self.nodes.insert(before + 1, node);
        self.touch(before);
        Ok(())
    }

    fn link(&self, from: Stamp, to: Stamp, start: &NavState) -> Result<ImuFactor, SmootherError> {
        let steps = self.samples.steps(from, to).ok_or(SmootherError::NotStarted)?;
        let noise = &self.options.noise;
        let motion = Preintegration::of_steps(steps, start.gyro_bias, start.accel_bias, noise);
        ImuFactor::new(motion, noise).ok_or(SmootherError::NotDetermined)
    }

    fn new_node(&mut self, stamp: Stamp, state: NavState) -> Box<Node> {
        let mut node = self.spare.pop().unwrap_or_else(|| Box::new(Node::new()));
        node.reset(stamp, state);
        node
    }

    fn touch(&mut self, index: usize) {
        self.touched = self.touched.min(index);
    }

    fn index_of(&self, node: Stamp) -> Result<usize, SmootherError> {
        let oldest = self.nodes.front().ok_or(SmootherError::NotStarted)?.stamp;
        self.nodes
            .binary_search_by_key(&node, |candidate| candidate.stamp)
            .map_err(|_| SmootherError::TooOld { behind_s: oldest.seconds_since(node).max(0.0) })
    }

    /// Ties a node to a measured antenna position.
    ///
    /// # Errors
    /// If there is no node at that stamp.
    pub fn add_position(&mut self, node: Stamp, factor: PositionFactor) -> Result<(), SmootherError> {
        let index = self.index_of(node)?;
        self.nodes[index].positions.push(factor);
        self.touch(index);
        Ok(())
    }

    /// Ties a node to a pose in the world.
    ///
    /// # Errors
    /// If there is no node at that stamp.
    pub fn add_pose(&mut self, node: Stamp, factor: PoseFactor) -> Result<(), SmootherError> {
        let index = self.index_of(node)?;
        self.nodes[index].poses.push(factor);
        self.touch(index);
        Ok(())
    }

    /// Ties two nodes by a relative pose; `earlier` must be older.
    ///
    /// # Errors
    /// If there is no node at one of the stamps.
    pub fn add_between(
        &mut self,
        earlier: Stamp,
        later: Stamp,
        factor: BetweenFactor,
    ) -> Result<(), SmootherError> {
        self.add_edge(earlier, later, Edge::Between(factor))
    }

    /// Ties two nodes by the turn of the chassis' gyroscope; `earlier` must be older.
    ///
    /// # Errors
    /// If there is no node at one of the stamps.
    pub fn add_turn(
        &mut self,
        earlier: Stamp,
        later: Stamp,
        factor: TurnFactor,
    ) -> Result<(), SmootherError> {
        self.add_edge(earlier, later, Edge::Turn(factor))
    }

    fn add_edge(&mut self, earlier: Stamp, later: Stamp, edge: Edge) -> Result<(), SmootherError> {
        debug_assert!(earlier < later, "an edge goes forward in time");
        let (from, to) = (self.index_of(earlier)?, self.index_of(later)?);
        self.nodes[from].edges.push((later, edge));
        let reached = self.nodes[to].reaches_back.map_or(earlier, |oldest| oldest.min(earlier));
        self.nodes[to].reaches_back = Some(reached);
        self.touch(from);
        Ok(())
    }

    /// Brings the estimate up to date with everything added, and drops what is older than the lag.
    ///
    /// # Errors
    /// [`SmootherError::NotDetermined`]: the window must be started anew.
    pub fn update(&mut self) -> Result<UpdateStats, SmootherError> {
        if self.nodes.is_empty() {
            return Err(SmootherError::NotStarted);
        }
        let mut stats = UpdateStats::default();
        while self.touched < self.nodes.len() {
            stats.iterations += 1;
            stats.eliminated += self.nodes.len() - self.touched;
            self.eliminate()?;
            self.solve();
            if stats.iterations < self.options.iterations_max {
                self.relinearize();
            }
        }
        self.newest_covariance = self.covariance_of_newest()?;
        self.marginalize();
        stats.nodes = self.nodes.len();
        Ok(stats)
    }

    /// Eliminates from the oldest touched node to the newest.
    fn eliminate(&mut self) -> Result<(), SmootherError> {
        if self.touched == 0 {
            self.hand_prior_to_oldest();
        }
        for index in self.touched..self.nodes.len() {
            self.assemble(index);
            let node = &mut self.nodes[index];
            self.front
                .eliminate(&mut node.conditional, &mut self.outgoing)
                .map_err(|_| SmootherError::NotDetermined)?;
            if let Some(next) = self.nodes.get_mut(index + 1) {
                std::mem::swap(&mut next.incoming, &mut self.outgoing);
            }
        }
        self.touched = self.nodes.len();
        Ok(())
    }

    /// Fills the front with all that ties the node at `index` to itself and to later ones.
    fn assemble(&mut self, index: usize) {
        let next = self.nodes.get(index + 1).map(|next| (next.stamp, next.linearization));
        if let Some((_, linearization)) = &next {
            self.nodes[index].linearize_link(linearization, &self.options.gravity);
        }
        let node = &self.nodes[index];
        self.front.begin(node.stamp);
        for variable in &node.incoming.variables {
            self.front.include(variable.stamp, variable.dim);
        }
        if let Some((stamp, _)) = next {
            self.front.include(stamp, STATE_DIM);
        }
        for (later, _) in &node.edges {
            self.front.include(*later, POSE_DIM);
        }
        self.front.lay_out();
        self.front.add_message(&node.incoming);
        if let Some((stamp, _)) = next {
            let (size, split) = Node::LINK_SHAPE;
            let offsets = [0, self.front.offset(stamp)];
            self.front.add_pair(offsets, split, size, &node.link_block);
        }
        if let Some(block) = node.pose_block() {
            self.front.add_pair([0, 0], POSE_DIM, POSE_DIM, &block);
        }
        for (later, edge) in &node.edges {
            let target = self
                .nodes
                .binary_search_by_key(later, |candidate| candidate.stamp)
                .expect("an edge's later end outlives its earlier end");
            let later_state = &self.nodes[target].linearization;
            let offsets = [0, self.front.offset(*later)];
            match edge {
                Edge::Between(factor) => {
                    let block = node.between_block(factor, later_state);
                    self.front.add_pair(offsets, POSE_DIM, 2 * POSE_DIM, &block);
                }
                Edge::Turn(factor) => {
                    let block = node.turn_block(factor, later_state);
                    self.front.add_pair(offsets, STATE_DIM, TURN_DIM, &block);
                }
            }
        }
    }

    /// The oldest node's incoming message: the prior, moved to where its variables are linearized now.
    ///
    /// With δ = Δ + J δ', Δ from the prior's point to the present one and J = diag(Jr⁻¹(Δφ), I):
    /// H' = Jᵀ H J, g' = Jᵀ (g − H Δ).
    fn hand_prior_to_oldest(&mut self) {
        let size = self.prior.size();
        let mut shift = Vec::with_capacity(size);
        let mut jacobians = Vec::with_capacity(self.prior.variables.len());
        for (variable, point) in self.prior.variables.iter().zip(&self.prior_points) {
            let index = self.index_of(variable.stamp).expect("the prior's variables are in the window");
            let moved = self.nodes[index].linearization.minus(point);
            shift.extend_from_slice(&moved.as_slice()[..variable.dim]);
            jacobians.push(So3::right_jacobian_inverse(&moved.fixed_rows::<3>(row::ROTATION).into_owned()));
        }
        let incoming = &mut self.nodes[0].incoming;
        incoming.clone_from(&self.prior);
        if shift.iter().all(|value| *value == 0.0) {
            return;
        }
        let stride = size + 1;
        let mut full = nalgebra::DMatrix::<f64>::from_fn(size, size, |r, c| {
            let (low, high) = (r.max(c), r.min(c));
            self.prior.values[high * stride + low]
        });
        let mut gradient =
            nalgebra::DVector::<f64>::from_fn(size, |r, _| self.prior.values[r * stride + size]);
        gradient -= &full * nalgebra::DVector::from_column_slice(&shift);
        let mut offset = 0;
        for (variable, jacobian) in self.prior.variables.iter().zip(&jacobians) {
            let columns = full.columns(offset, 3) * jacobian;
            full.columns_mut(offset, 3).copy_from(&columns);
            let rows = jacobian.transpose() * full.rows(offset, 3);
            full.rows_mut(offset, 3).copy_from(&rows);
            let part: Vec3 = jacobian.transpose() * gradient.fixed_rows::<3>(offset);
            gradient.fixed_rows_mut::<3>(offset).copy_from(&part);
            offset += variable.dim;
        }
        for column in 0..size {
            for row in column..size {
                incoming.values[column * stride + row] = full[(row, column)];
            }
            incoming.values[column * stride + size] = gradient[column];
        }
    }

    /// Back-substitution from the newest node to the oldest.
    fn solve(&mut self) {
        let mut solution = [0.0; 8 * STATE_DIM];
        for index in (0..self.nodes.len()).rev() {
            let conditional = &self.nodes[index].conditional;
            let mut size = STATE_DIM;
            for parent in &conditional.parents {
                let found = self.index_of(parent.stamp).expect("parents are in the window");
                solution[size..size + parent.dim]
                    .copy_from_slice(&self.nodes[found].delta.as_slice()[..parent.dim]);
                size += parent.dim;
            }
            conditional.solve(&mut solution[..size]);
            self.nodes[index].delta = StateVector::from_column_slice(&solution[..STATE_DIM]);
        }
    }

    /// Moves the linearization of every node that has gone too far from it, and touches all it is tied to.
    fn relinearize(&mut self) {
        for index in 0..self.nodes.len() {
            let delta = &self.nodes[index].delta;
            let limits = &self.options.relinearize;
            let moved = (0..STATE_DIM).any(|row| delta[row].abs() > limits[row / 3]);
            if !moved {
                continue;
            }
            let node = &mut self.nodes[index];
            node.linearization = node.estimate();
            node.delta = StateVector::zeros();
            node.link_is_linear = false;
            let reached = node.reaches_back;
            if index > 0 {
                self.nodes[index - 1].link_is_linear = false;
            }
            let oldest_edge =
                reached.map_or(index, |stamp| self.nodes.partition_point(|node| node.stamp < stamp));
            // The prior ties all its variables to the oldest node.
            let in_prior =
                self.prior.variables.iter().any(|variable| variable.stamp == self.nodes[index].stamp);
            let oldest = if in_prior { 0 } else { oldest_edge.min(index.saturating_sub(1)) };
            self.touch(oldest);
        }
    }

    fn covariance_of_newest(&self) -> Result<StateMatrix, SmootherError> {
        let newest = self.nodes.back().ok_or(SmootherError::NotStarted)?;
        let inverse = newest
            .conditional
            .lower()
            .solve_lower_triangular(&StateMatrix::identity())
            .ok_or(SmootherError::NotDetermined)?;
        Ok(inverse.transpose() * inverse)
    }

    /// Drops nodes older than the lag; what they said of those that stay is the new prior.
    fn marginalize(&mut self) {
        let Some(newest) = self.nodes.back().map(|node| node.stamp) else { return };
        while self.nodes.len() > 1 && newest - self.nodes[0].stamp > self.options.lag {
            std::mem::swap(&mut self.prior, &mut self.nodes[1].incoming);
            if let Some(node) = self.nodes.pop_front() {
                self.spare.push(node);
            }
            self.touched -= 1;
            self.prior_points.clear();
            for variable in 0..self.prior.variables.len() {
                let stamp = self.prior.variables[variable].stamp;
                let index = self.index_of(stamp).expect("a message speaks of nodes in the window");
                self.prior_points.push(self.nodes[index].linearization);
            }
        }
        self.samples.forget_before(self.nodes[0].stamp);
    }

    /// Stamp and estimate of the newest node.
    pub fn newest(&self) -> Option<(Stamp, NavState)> {
        self.nodes.back().map(|node| (node.stamp, node.estimate()))
    }

    /// Stamp of the newest node that is not newer than `stamp`.
    pub fn node_before(&self, stamp: Stamp) -> Option<Stamp> {
        let after = self.nodes.partition_point(|node| node.stamp <= stamp);
        Some(self.nodes[after.checked_sub(1)?].stamp)
    }

    /// Stamp of the oldest node that is not older than `stamp`.
    pub fn node_after(&self, stamp: Stamp) -> Option<Stamp> {
        let after = self.nodes.partition_point(|node| node.stamp < stamp);
        Some(self.nodes.get(after)?.stamp)
    }

    /// Stamp of the oldest node.
    pub fn oldest_stamp(&self) -> Option<Stamp> {
        self.nodes.front().map(|node| node.stamp)
    }

    /// Covariance of the newest node as of the last update, in the state's tangent.
    pub fn newest_covariance(&self) -> &StateMatrix {
        &self.newest_covariance
    }

    /// Stamps and estimates of all nodes, oldest first.
    pub fn estimates(&self) -> impl Iterator<Item = (Stamp, NavState)> + '_ {
        self.nodes.iter().map(|node| (node.stamp, node.estimate()))
    }

    /// The state at any stamp of the window up to the newest sample, by the IMU from the last node before.
    pub fn state_at(&self, stamp: Stamp) -> Option<NavState> {
        let after = self.nodes.partition_point(|node| node.stamp <= stamp);
        let node = &self.nodes[after.checked_sub(1)?];
        let steps = self.samples.steps(node.stamp, stamp)?;
        Some(steps.fold(node.estimate(), |state, step| propagate(&state, &step, &self.options.gravity)))
    }

    /// State and covariance at a stamp. Behind the newest node the covariance grows with the IMU's noise;
    /// inside the window the newest node's stands in.
    pub fn predict(&self, stamp: Stamp) -> Option<(NavState, StateMatrix)> {
        let newest = self.nodes.back()?;
        if stamp <= newest.stamp {
            return Some((self.state_at(stamp)?, self.newest_covariance));
        }
        let start = newest.estimate();
        let steps = self.samples.steps(newest.stamp, stamp)?;
        let motion = Preintegration::of_steps(steps, start.gyro_bias, start.accel_bias, &self.options.noise);
        let covariance = predict_covariance(&motion, &start, &self.newest_covariance, &self.options.noise);
        Some((motion.predict(&start, &self.options.gravity), covariance))
    }
}

/// Covariance of the state at the end of a motion: F P Fᵀ + Q, with the biases walking.
pub fn predict_covariance(
    motion: &Preintegration,
    start: &NavState,
    covariance: &StateMatrix,
    noise: &ImuNoise,
) -> StateMatrix {
    let span = motion.span_s;
    let rotation = start.rotation.matrix();
    let mut transition = StateMatrix::identity();
    let mut set = |row: usize, column: usize, block: &Mat3| {
        transition.fixed_view_mut::<3, 3>(row, column).copy_from(block);
    };
    set(row::ROTATION, row::ROTATION, &motion.rotation.matrix().transpose());
    set(row::ROTATION, row::GYRO_BIAS, &motion.rotation_by_gyro_bias);
    set(row::POSITION, row::ROTATION, &(-rotation * crate::lie::hat(&motion.position)));
    set(row::POSITION, row::VELOCITY, &(Mat3::identity() * span));
    set(row::POSITION, row::GYRO_BIAS, &(rotation * motion.position_by_gyro_bias));
    set(row::POSITION, row::ACCEL_BIAS, &(rotation * motion.position_by_accel_bias));
    set(row::VELOCITY, row::ROTATION, &(-rotation * crate::lie::hat(&motion.velocity)));
    set(row::VELOCITY, row::GYRO_BIAS, &(rotation * motion.velocity_by_gyro_bias));
    set(row::VELOCITY, row::ACCEL_BIAS, &(rotation * motion.velocity_by_accel_bias));
    let mut predicted = transition * covariance * transition.transpose();
    // The motion's noise is written in imu_i: positions and velocities turn into the world.
    let turns = [Mat3::identity(), rotation, rotation];
    for block_row in 0..3 {
        for block_column in 0..3 {
            let block = turns[block_row]
                * motion.covariance.fixed_view::<3, 3>(3 * block_row, 3 * block_column)
                * turns[block_column].transpose();
            let mut target = predicted.fixed_view_mut::<3, 3>(3 * block_row, 3 * block_column);
            target += block;
        }
    }
    for axis in 0..3 {
        predicted[(row::GYRO_BIAS + axis, row::GYRO_BIAS + axis)] +=
            noise.gyroscope_random_walk.powi(2) * span;
        predicted[(row::ACCEL_BIAS + axis, row::ACCEL_BIAS + axis)] +=
            noise.accelerometer_random_walk.powi(2) * span;
    }
    predicted[(row::BASE_GYRO_BIAS, row::BASE_GYRO_BIAS)] += noise.base_gyroscope_random_walk.powi(2) * span;
    (predicted + predicted.transpose()) * 0.5
}

/// Covariance (m²) in the world of a point fixed to the body at `lever_arm` (IMU frame, m).
pub fn predicted_position_covariance(state: &NavState, covariance: &StateMatrix, lever_arm: &Vec3) -> Mat3 {
    let by_rotation = -state.rotation.matrix() * crate::lie::hat(lever_arm);
    let block = |row: usize, column: usize| covariance.fixed_view::<3, 3>(row, column).into_owned();
    let cross = by_rotation * block(row::ROTATION, row::POSITION);
    by_rotation * block(row::ROTATION, row::ROTATION) * by_rotation.transpose()
        + cross
        + cross.transpose()
        + block(row::POSITION, row::POSITION)
}

#[cfg(test)]
mod tests;
