//! The fixed-lag smoother: a window of states at the exact stamps of the measurements.
//!
//! Neighbours are tied by the IMU, so the window is a chain with few long edges; nodes are eliminated from the
//! oldest to the newest, each leaving a message to the next. An update re-linearizes and re-eliminates only
//! from the oldest touched node on; the message into the oldest node of the window is the marginal prior.
//! Complexity and derivation: `README.md` beside this file. Which measurements to believe is not decided here.

mod ahead;
mod elimination;
mod history;
mod kernels;
mod node;
mod prediction;
mod prior;
mod solver;
mod tile;

use std::collections::VecDeque;

use history::History;
pub use history::{PastNode, WindowStart};
pub use node::Edge;
use node::{Node, Room};
pub use prediction::{
    PoseCovariance, predict_covariance, predict_pose_covariance, predicted_position_covariance,
};
use prior::Prior;
use tile::Quad;

use crate::factors::{BetweenFactor, ImuFactor, PoseFactor, PositionFactor, TurnFactor};
use crate::lie::Vec3;
use crate::preintegration::{ImuNoise, Preintegration, SampleBuffer, propagate};
use crate::sensors::ImuSample;
use crate::state::{NavState, StateMatrix};
use crate::time::{Span, Stamp};
use ahead::Ahead;
use elimination::POSE_DIM;

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

/// A window that is held has no more nodes than so: two minutes without measurements.
pub const HELD_NODES: usize = 256;

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
    /// Nodes solved by back-substitution, over all iterations.
    pub solved: usize,
    /// Nodes in the window afterwards.
    pub nodes: usize,
}

/// The window. See the room's first lines.
pub struct Smoother {
    options: Options,
    samples: SampleBuffer,
    nodes: VecDeque<Box<Node>>,
    /// Nodes that left the window, kept for their buffers.
    spare: Vec<Box<Node>>,
    prior: Prior,
    /// Index of the oldest node whose elimination is out of date.
    touched: usize,
    /// Index of the oldest node whose δ is that of the last elimination; never behind `touched`.
    solved: usize,
    updates_since_sweep: usize,
    /// Nodes from here on stay, older than the lag or not.
    held: Option<Stamp>,
    room: Room,
    /// The motion behind some node that was last asked for.
    recent: Option<Recent>,
    ahead: Ahead,
    /// What has left the window, where it is asked for.
    history: Option<History>,
    // Scratch, kept for its room.
    solution: Vec<Quad>,
    places: Vec<usize>,
    newest_covariance: StateMatrix,
}

/// A preintegrated motion and where it belongs.
#[derive(Clone)]
struct Recent {
    from: Stamp,
    to: Stamp,
    motion: Preintegration,
}

impl Smoother {
    /// An empty window.
    pub fn new(options: Options) -> Self {
        Self {
            options,
            samples: SampleBuffer::default(),
            nodes: VecDeque::new(),
            spare: Vec::new(),
            prior: Prior::default(),
            touched: 0,
            solved: 0,
            updates_since_sweep: 0,
            held: None,
            room: Room::default(),
            recent: None,
            ahead: Ahead::default(),
            history: None,
            solution: Vec::new(),
            places: Vec::new(),
            newest_covariance: StateMatrix::zeros(),
        }
    }

    /// Appends an IMU sample, newer than all before.
    pub fn push_sample(&mut self, sample: ImuSample) {
        self.samples.push(sample);
        if let Some(node) = self.nodes.back() {
            self.ahead.follow(node.stamp, &node.estimate(), &self.samples, &self.options.noise);
        }
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
        if self.history.is_some() {
            self.solve_back_to(0);
        }
        if let Some(history) = &mut self.history {
            history.close(&self.nodes);
            history.begin(state, information);
        }
        while let Some(node) = self.nodes.pop_front() {
            self.spare.push(node);
        }
        let node = self.new_node(stamp, state);
        self.nodes.push_back(node);
        self.prior.begin(stamp, state, information);
        self.recent = None;
        self.ahead.forget();
        self.held = None;
        self.solved = 0;
        self.touched = 0;
        self.samples.forget_before(stamp);
        self.update().map(|_| ())
    }

    /// From now on the window reaches back to the node of `from`, older than the lag or not, as long as it has no
    /// more than [`HELD_NODES`]; None: the lag alone counts. For a sensor that pauses: what it says afterwards is
    /// relative to what it said last.
    pub fn hold(&mut self, from: Option<Stamp>) {
        self.held = from;
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
        self.touch(before);
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
        Ok(())
    }

    fn link(&mut self, from: Stamp, to: Stamp, start: &NavState) -> Result<ImuFactor, SmootherError> {
        let motion = self.motion(from, to, start).ok_or(SmootherError::NotStarted)?.clone();
        ImuFactor::new(motion, &self.options.noise).ok_or(SmootherError::NotDetermined)
    }

    /// The motion between two stamps for the biases of `start`. A prediction and the node that is then made there
    /// ask for the same.
    fn motion(&mut self, from: Stamp, to: Stamp, start: &NavState) -> Option<&Preintegration> {
        let known = self.recent.as_ref().is_some_and(|recent| {
            (recent.from, recent.to) == (from, to)
                && (recent.motion.gyro_bias, recent.motion.accel_bias) == (start.gyro_bias, start.accel_bias)
        });
        if !known {
            let (reached, mut motion) = match self.ahead.known(from, to, start) {
                Some(known) => known.clone(),
                None => (from, Preintegration::new(start.gyro_bias, start.accel_bias)),
            };
            let noise = &self.options.noise;
            self.samples.steps(reached, to)?.for_each(|step| motion.add(&step, noise));
            self.recent = Some(Recent { from, to, motion });
        }
        self.recent.as_ref().map(|recent| &recent.motion)
    }

    fn new_node(&mut self, stamp: Stamp, state: NavState) -> Box<Node> {
        let mut node = self.spare.pop().unwrap_or_else(|| Box::new(Node::new()));
        node.reset(stamp, state, &self.room);
        node
    }

    /// Something will change at a node: what follows from its older estimate is worked out before.
    fn touch(&mut self, index: usize) {
        self.solve_back_to(index);
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
        self.touch(index);
        self.nodes[index].add_position(factor);
        Ok(())
    }

    /// Ties a node to a pose in the world.
    ///
    /// # Errors
    /// If there is no node at that stamp.
    pub fn add_pose(&mut self, node: Stamp, factor: PoseFactor) -> Result<(), SmootherError> {
        let index = self.index_of(node)?;
        self.touch(index);
        self.nodes[index].add_pose(factor);
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
        self.touch(from);
        self.nodes[from].add_edge(later, edge);
        let reached = self.nodes[to].reaches_back.map_or(earlier, |oldest| oldest.min(earlier));
        self.nodes[to].reaches_back = Some(reached);
        Ok(())
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
    pub fn estimates(&mut self) -> impl Iterator<Item = (Stamp, NavState)> + '_ {
        self.solve_back_to(0);
        self.nodes.iter().map(|node| (node.stamp, node.estimate()))
    }

    /// The state at any stamp of the window up to the newest sample, by the IMU from the last node before.
    pub fn state_at(&mut self, stamp: Stamp) -> Option<NavState> {
        let before = self.nodes.partition_point(|node| node.stamp <= stamp).checked_sub(1)?;
        self.solve_back_to(before);
        let node = &self.nodes[before];
        let steps = self.samples.steps(node.stamp, stamp)?;
        Some(steps.fold(node.estimate(), |state, step| propagate(&state, &step, &self.options.gravity)))
    }

    /// State and covariance at a stamp. Behind the newest node the covariance grows with the IMU's noise;
    /// inside the window the newest node's stands in.
    pub fn predict(&mut self, stamp: Stamp) -> Option<(NavState, StateMatrix)> {
        let newest = self.nodes.back()?;
        if stamp <= newest.stamp {
            return Some((self.state_at(stamp)?, self.newest_covariance));
        }
        let (from, start) = (newest.stamp, newest.estimate());
        let (gravity, noise, covariance) = (self.options.gravity, self.options.noise, self.newest_covariance);
        let motion = self.motion(from, stamp, &start)?;
        let covariance = predict_covariance(motion, &start, &covariance, &noise);
        Some((motion.predict(&start, &gravity), covariance))
    }

    /// [`Smoother::predict`] with the pose's part of the covariance alone.
    pub fn predict_pose(&mut self, stamp: Stamp) -> Option<(NavState, PoseCovariance)> {
        let newest = self.nodes.back()?;
        if stamp <= newest.stamp {
            let covariance = self.newest_covariance.fixed_view::<POSE_DIM, POSE_DIM>(0, 0).into_owned();
            return Some((self.state_at(stamp)?, covariance));
        }
        let (from, start) = (newest.stamp, newest.estimate());
        let (gravity, covariance) = (self.options.gravity, self.newest_covariance);
        let motion = self.motion(from, stamp, &start)?;
        let covariance = predict_pose_covariance(motion, &start, &covariance);
        Some((motion.predict(&start, &gravity), covariance))
    }
}

impl Clone for Smoother {
    fn clone(&self) -> Self {
        let mut copy = Self::new(self.options);
        copy.clone_from(self);
        copy
    }

    /// Nodes are copied into those that are there.
    fn clone_from(&mut self, source: &Self) {
        self.options = source.options;
        self.samples.clone_from(&source.samples);
        self.room = source.room;
        while self.nodes.len() > source.nodes.len() {
            self.spare.extend(self.nodes.pop_back());
        }
        while self.nodes.len() < source.nodes.len() {
            let node = self.spare.pop().unwrap_or_else(|| Box::new(Node::new()));
            self.nodes.push_back(node);
        }
        self.nodes.iter_mut().zip(&source.nodes).for_each(|(node, source)| (**node).clone_from(source));
        self.prior.clone_from(&source.prior);
        self.touched = source.touched;
        self.solved = source.solved;
        self.updates_since_sweep = source.updates_since_sweep;
        self.held = source.held;
        self.newest_covariance = source.newest_covariance;
        self.recent = None;
        self.ahead.forget();
        self.history.clone_from(&source.history);
    }
}

#[cfg(test)]
mod tests;
