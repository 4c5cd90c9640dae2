//! One node of the window: a state at an exact stamp, and the factors it is the oldest part of.

use super::elimination::{Front, NODE_TILES, POSE_DIM, POSE_TILES, lower_place, reserve};
use super::kernels;
use super::tile::{LANES, Quad, Tile, lower_len};
use crate::factors::{
    BetweenFactor, ImuFactor, LinearPose, LinearPosition, PoseFactor, PositionFactor, TurnFactor,
    huber_weight,
};
use crate::lie::Vec3;
use crate::state::{NavState, STATE_DIM, StateVector, row};
use crate::time::Stamp;

/// A factor that ties a node to a later one, not its neighbour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Edge {
    /// A relative pose.
    Between(BetweenFactor),
    /// A turn by the chassis' gyroscope.
    Turn(TurnFactor),
}

/// JᵀJ, its lower half column of tiles by column of tiles, and −Jᵀr of one factor over `SIDE` tiles in a column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Block<const SIDE: usize, const LEN: usize> {
    pub tiles: [Tile; LEN],
    pub right: [Quad; SIDE],
}

impl<const SIDE: usize, const LEN: usize> Block<SIDE, LEN> {
    const ZERO: Self = Self { tiles: [Tile::ZERO; LEN], right: [[0.0; LANES]; SIDE] };

    /// Of whitened rows of the Jacobian, each with its residual.
    fn of(rows: &[([Quad; SIDE], f64)]) -> Self {
        let mut block = Self::ZERO;
        block.set(rows);
        block
    }

    fn set(&mut self, rows: &[([Quad; SIDE], f64)]) {
        const { assert!(LEN == lower_len(SIDE)) };
        kernels::square(rows, &mut self.tiles, &mut self.right);
    }

    /// Adds a row that is zero but for two columns, which ascend.
    fn add_two(&mut self, columns: [usize; 2], factors: [f64; 2], residual: f64) {
        for (first, column) in columns.into_iter().enumerate() {
            for (row, factor) in columns.into_iter().zip(factors).skip(first) {
                let tile = &mut self.tiles[lower_place(SIDE, row / LANES, column / LANES)];
                tile.0[column % LANES][row % LANES] += factors[first] * factor;
            }
            self.right[column / LANES][column % LANES] -= factors[first] * residual;
        }
    }
}

/// Tiles of two neighbours.
pub(super) const PAIR_TILES: usize = 2 * NODE_TILES;
/// Tiles of a node and the pose of a later one.
pub(super) const EDGE_TILES: usize = NODE_TILES + POSE_TILES;
type PairBlock = Block<PAIR_TILES, { lower_len(PAIR_TILES) }>;
type EdgeBlock = Block<EDGE_TILES, { lower_len(EDGE_TILES) }>;
type PoseBlock = Block<POSE_TILES, { lower_len(POSE_TILES) }>;

/// An edge to the node at `later`.
#[derive(Clone)]
pub(super) struct LaterEdge {
    pub later: Stamp,
    pub edge: Edge,
    /// Linearized; none after either end was moved.
    pub block: Option<EdgeBlock>,
}

/// A position factor of a node.
#[derive(Clone)]
pub(super) struct NodePosition {
    pub factor: PositionFactor,
    /// None after the node was moved.
    linear: Option<LinearPosition>,
}

/// A pose factor of a node.
#[derive(Clone)]
pub(super) struct NodePose {
    pub factor: PoseFactor,
    /// None after the node was moved.
    linear: Option<LinearPose>,
}

pub(super) struct Node {
    pub stamp: Stamp,
    /// Where the factors are linearized.
    pub linearization: NavState,
    /// The estimate is `linearization.plus(delta)`.
    pub delta: StateVector,
    /// Ties this node to the next.
    pub link: Option<ImuFactor>,
    /// Linearized `link`; stale after either end was moved.
    pub link_block: PairBlock,
    link_is_linear: bool,
    pub positions: Vec<NodePosition>,
    pub poses: Vec<NodePose>,
    /// To later nodes.
    pub edges: Vec<LaterEdge>,
    /// The oldest node with an edge to this one.
    pub reaches_back: Option<Stamp>,
    /// What this and older nodes say of later ones.
    pub front: Front,
}

/// The most that a node has needed so far; all get so much room, so that in the end none asks for more.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Room {
    pub positions: usize,
    pub poses: usize,
    pub edges: usize,
    pub front: usize,
}

impl Clone for Node {
    fn clone(&self) -> Self {
        let mut copy = Self::new();
        copy.clone_from(self);
        copy
    }

    /// Buffers keep their room.
    fn clone_from(&mut self, source: &Self) {
        self.stamp = source.stamp;
        self.linearization = source.linearization;
        self.delta = source.delta;
        self.link.clone_from(&source.link);
        if source.link_is_linear {
            self.link_block = source.link_block;
        }
        self.link_is_linear = source.link_is_linear;
        self.positions.clone_from(&source.positions);
        self.poses.clone_from(&source.poses);
        self.edges.clone_from(&source.edges);
        self.reaches_back = source.reaches_back;
        self.front.clone_from(&source.front);
    }
}

impl Room {
    /// A node needs so much.
    pub fn note(&mut self, node: &Node, front: &Front) {
        self.positions = self.positions.max(node.positions.len());
        self.poses = self.poses.max(node.poses.len());
        self.edges = self.edges.max(node.edges.len());
        self.front = self.front.max(front.side());
    }
}

impl Node {
    pub fn new() -> Self {
        Self {
            stamp: Stamp::default(),
            linearization: NavState::identity(),
            delta: StateVector::zeros(),
            link: None,
            link_block: Block::ZERO,
            link_is_linear: false,
            positions: Vec::new(),
            poses: Vec::new(),
            edges: Vec::new(),
            reaches_back: None,
            front: Front::default(),
        }
    }

    /// Makes a used node as good as new; its buffers keep their room.
    pub fn reset(&mut self, stamp: Stamp, linearization: NavState, room: &Room) {
        self.stamp = stamp;
        self.linearization = linearization;
        self.delta = StateVector::zeros();
        self.link = None;
        self.link_is_linear = false;
        self.positions.clear();
        self.poses.clear();
        self.edges.clear();
        self.reaches_back = None;
        reserve(&mut self.positions, room.positions);
        reserve(&mut self.poses, room.poses);
        reserve(&mut self.edges, room.edges);
        self.front.reserve(room.front);
    }

    /// The state as far as it is known.
    pub fn estimate(&self) -> NavState {
        self.linearization.plus(&self.delta)
    }

    pub fn set_link(&mut self, link: ImuFactor) {
        self.link = Some(link);
        self.link_is_linear = false;
    }

    pub fn add_position(&mut self, factor: PositionFactor) {
        self.positions.push(NodePosition { factor, linear: None });
    }

    pub fn add_pose(&mut self, factor: PoseFactor) {
        self.poses.push(NodePose { factor, linear: None });
    }

    pub fn add_edge(&mut self, later: Stamp, edge: Edge) {
        self.edges.push(LaterEdge { later, edge, block: None });
    }

    /// Linearizes at the present estimate from now on.
    pub fn relinearize(&mut self) {
        self.linearization = self.estimate();
        self.delta = StateVector::zeros();
        self.link_is_linear = false;
        self.edges.iter_mut().for_each(|edge| edge.block = None);
        self.positions.iter_mut().for_each(|position| position.linear = None);
        self.poses.iter_mut().for_each(|pose| pose.linear = None);
    }

    /// The node at `later` was moved: what ties this one to it is linearized anew.
    pub fn forget_ties_to(&mut self, later: Stamp) {
        self.edges.iter_mut().filter(|edge| edge.later == later).for_each(|edge| edge.block = None);
    }

    /// The next node was moved.
    pub fn forget_link(&mut self) {
        self.link_is_linear = false;
    }

    /// Makes the link's block over this node and the next, if there is none.
    pub fn linearize_link(&mut self, next: &NavState, gravity: &Vec3) {
        let Some(link) = self.link.as_ref().filter(|_| !self.link_is_linear) else { return };
        let linear = link.linearize(&self.linearization, next, gravity);
        let mut rows = [([[0.0; LANES]; PAIR_TILES], 0.0); row::GYRO_BIAS];
        for (index, (row, residual)) in rows.iter_mut().enumerate() {
            let (own, later) = row.as_flattened_mut().split_at_mut(STATE_DIM);
            copy(linear.jacobian_i.row(index).iter(), own);
            copy(linear.jacobian_j.row(index).iter().take(row::GYRO_BIAS), later);
            *residual = linear.residual[index];
        }
        self.link_block.set(&rows);
        // Each bias walks by itself.
        for bias in row::GYRO_BIAS..STATE_DIM {
            let places = [bias, STATE_DIM + bias];
            let factors = [linear.jacobian_i[(bias, bias)], linear.jacobian_j[(bias, bias)]];
            self.link_block.add_two(places, factors, linear.residual[bias]);
        }
        self.link_is_linear = true;
    }

    /// A position factor's block over this node's pose, weighted by its loss at the estimate.
    pub fn position_block(&mut self, index: usize, estimate: &NavState) -> PoseBlock {
        let NodePosition { factor, linear } = &mut self.positions[index];
        let linear = linear.get_or_insert_with(|| factor.linearize(&self.linearization));
        let weight = huber_weight(factor.residual(estimate).norm(), factor.huber_threshold).sqrt();
        let mut rows = [([[0.0; LANES]; POSE_TILES], 0.0); 3];
        for (index, (row, residual)) in rows.iter_mut().enumerate() {
            for (to, value) in row.as_flattened_mut().iter_mut().zip(linear.jacobian.row(index).iter()) {
                *to = value * weight;
            }
            *residual = linear.residual[index] * weight;
        }
        Block::of(&rows)
    }

    /// A pose factor's block over this node's pose.
    pub fn pose_block(&mut self, index: usize) -> PoseBlock {
        let NodePose { factor, linear } = &mut self.poses[index];
        let linear = linear.get_or_insert_with(|| factor.linearize(&self.linearization));
        let mut rows = [([[0.0; LANES]; POSE_TILES], 0.0); POSE_DIM];
        for (index, (row, residual)) in rows.iter_mut().enumerate() {
            copy(linear.jacobian.row(index).iter(), row.as_flattened_mut());
            *residual = linear.residual[index];
        }
        Block::of(&rows)
    }

    /// Makes an edge's block over this node and the later one's pose.
    pub fn linearize_edge(&mut self, index: usize, later: &NavState) {
        let LaterEdge { edge, block, .. } = &mut self.edges[index];
        *block = Some(match edge {
            Edge::Between(factor) => {
                let linear = factor.linearize(&self.linearization, later);
                let mut rows = [([[0.0; LANES]; EDGE_TILES], 0.0); POSE_DIM];
                for (index, (row, residual)) in rows.iter_mut().enumerate() {
                    let (own, later) = row.as_flattened_mut().split_at_mut(STATE_DIM);
                    copy(linear.jacobian_i.row(index).iter(), own);
                    copy(linear.jacobian_j.row(index).iter(), later);
                    *residual = linear.residual[index];
                }
                Block::of(&rows)
            }
            Edge::Turn(factor) => {
                let linear = factor.linearize(&self.linearization, later);
                let mut row = [[0.0; LANES]; EDGE_TILES];
                let (own, later) = row.as_flattened_mut().split_at_mut(STATE_DIM);
                own[row::ROTATION..row::ROTATION + 3].copy_from_slice(linear.rotation_i.as_slice());
                own[row::BASE_GYRO_BIAS] = linear.base_gyro_bias;
                later[row::ROTATION..row::ROTATION + 3].copy_from_slice(linear.rotation_j.as_slice());
                Block::of(&[(row, linear.residual)])
            }
        });
    }
}

/// Writes values to the first places.
fn copy<'a>(values: impl Iterator<Item = &'a f64>, places: &mut [f64]) {
    places.iter_mut().zip(values).for_each(|(place, value)| *place = *value);
}
