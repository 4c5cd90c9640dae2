//! One node of the window: a state at an exact stamp, and the factors it is the oldest part of.

use super::elimination::{Conditional, Message, POSE_DIM, TURN_DIM, add_rows};
use crate::factors::{BetweenFactor, ImuFactor, PoseFactor, PositionFactor, TurnFactor, huber_weight};
use crate::lie::Vec3;
use crate::state::{NavState, STATE_DIM, StateVector, row};
use crate::time::Stamp;

/// Side of the block that the IMU adds to two neighbours.
const PAIR_DIM: usize = 2 * STATE_DIM;
/// Length of a lower triangle with its right-hand side, stored as in [`Message`].
const fn block_len(size: usize) -> usize {
    size * (size + 1)
}

/// A factor that ties a node to a later one, not its neighbour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Edge {
    /// A relative pose.
    Between(BetweenFactor),
    /// A turn by the chassis' gyroscope.
    Turn(TurnFactor),
}

#[derive(Clone)]
pub(super) struct Node {
    pub stamp: Stamp,
    /// Where the factors are linearized.
    pub linearization: NavState,
    /// The estimate is `linearization.plus(delta)`.
    pub delta: StateVector,
    /// Ties this node to the next.
    pub link: Option<ImuFactor>,
    /// Linearized `link`; stale after either end was moved.
    pub link_block: [f64; block_len(PAIR_DIM)],
    pub link_is_linear: bool,
    pub positions: Vec<PositionFactor>,
    pub poses: Vec<PoseFactor>,
    /// To later nodes.
    pub edges: Vec<(Stamp, Edge)>,
    /// The oldest node with an edge to this one.
    pub reaches_back: Option<Stamp>,
    /// What older nodes say of this one and of later ones.
    pub incoming: Message,
    pub conditional: Conditional,
}

impl Node {
    pub fn new() -> Self {
        Self {
            stamp: Stamp::default(),
            linearization: NavState::identity(),
            delta: StateVector::zeros(),
            link: None,
            link_block: [0.0; block_len(PAIR_DIM)],
            link_is_linear: false,
            positions: Vec::new(),
            poses: Vec::new(),
            edges: Vec::new(),
            reaches_back: None,
            incoming: Message::default(),
            conditional: Conditional::default(),
        }
    }

    /// Makes a used node as good as new; its buffers keep their room.
    pub fn reset(&mut self, stamp: Stamp, linearization: NavState) {
        self.stamp = stamp;
        self.linearization = linearization;
        self.delta = StateVector::zeros();
        self.link = None;
        self.link_is_linear = false;
        self.positions.clear();
        self.poses.clear();
        self.edges.clear();
        self.reaches_back = None;
        self.incoming.clear();
    }

    /// The state as far as it is known.
    pub fn estimate(&self) -> NavState {
        self.linearization.plus(&self.delta)
    }

    pub fn set_link(&mut self, link: ImuFactor) {
        self.link = Some(link);
        self.link_is_linear = false;
    }

    /// Side and split of `link_block`.
    pub const LINK_SHAPE: (usize, usize) = (PAIR_DIM, STATE_DIM);

    pub fn linearize_link(&mut self, next: &NavState, gravity: &Vec3) {
        let Some(link) = &self.link else { return };
        if self.link_is_linear {
            return;
        }
        let linear = link.linearize(&self.linearization, next, gravity);
        self.link_block.fill(0.0);
        let rows = (0..STATE_DIM).map(|index| {
            let row: [f64; PAIR_DIM] = std::array::from_fn(|column| match column.checked_sub(STATE_DIM) {
                None => linear.jacobian_i[(index, column)],
                Some(later) => linear.jacobian_j[(index, later)],
            });
            (row, linear.residual[index])
        });
        add_rows(&mut self.link_block, rows);
        self.link_is_linear = true;
    }

    /// The block over this node's pose of its positions, weighted by their losses at the estimate, and poses.
    pub fn pose_block(&self) -> Option<[f64; block_len(POSE_DIM)]> {
        if self.positions.is_empty() && self.poses.is_empty() {
            return None;
        }
        let mut block = [0.0; block_len(POSE_DIM)];
        let estimate = self.estimate();
        for factor in &self.positions {
            let weight = huber_weight(factor.residual(&estimate).norm(), factor.huber_threshold).sqrt();
            let linear = factor.linearize(&self.linearization);
            let rows = (0..3).map(|index| {
                let row: [f64; POSE_DIM] =
                    std::array::from_fn(|column| linear.jacobian[(index, column)] * weight);
                (row, linear.residual[index] * weight)
            });
            add_rows(&mut block, rows);
        }
        for factor in &self.poses {
            let linear = factor.linearize(&self.linearization);
            let rows = (0..POSE_DIM).map(|index| {
                let row: [f64; POSE_DIM] = std::array::from_fn(|column| linear.jacobian[(index, column)]);
                (row, linear.residual[index])
            });
            add_rows(&mut block, rows);
        }
        Some(block)
    }

    /// A turn's block over this node and the later one's pose.
    pub fn turn_block(&self, factor: &TurnFactor, later: &NavState) -> [f64; block_len(TURN_DIM)] {
        let linear = factor.linearize(&self.linearization, later);
        let mut row = [0.0; TURN_DIM];
        row[row::ROTATION..row::ROTATION + 3].copy_from_slice(linear.rotation_i.as_slice());
        row[row::BASE_GYRO_BIAS] = linear.base_gyro_bias;
        row[STATE_DIM..STATE_DIM + 3].copy_from_slice(linear.rotation_j.as_slice());
        let mut block = [0.0; block_len(TURN_DIM)];
        add_rows(&mut block, std::iter::once((row, linear.residual)));
        block
    }

    /// A relative pose's block over both poses.
    pub fn between_block(&self, factor: &BetweenFactor, later: &NavState) -> [f64; block_len(2 * POSE_DIM)] {
        let linear = factor.linearize(&self.linearization, later);
        let mut block = [0.0; block_len(2 * POSE_DIM)];
        let rows = (0..POSE_DIM).map(|index| {
            let row: [f64; 2 * POSE_DIM] = std::array::from_fn(|column| match column.checked_sub(POSE_DIM) {
                None => linear.jacobian_i[(index, column)],
                Some(later) => linear.jacobian_j[(index, later)],
            });
            (row, linear.residual[index])
        });
        add_rows(&mut block, rows);
        block
    }
}
