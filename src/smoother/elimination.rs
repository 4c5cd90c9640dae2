//! Elimination of one node from the normal equations, and the message it leaves to the next.
//!
//! The cost over the tangents δ of some variables is ½ δᵀ H δ − gᵀ δ. Eliminating a node takes a partial
//! Cholesky factorization of (H, g): the first columns give the node from the later variables, what is left
//! is the marginal information on those (Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017,
//! section 3.4). All is kept in tiles, of which a node takes all of its own or those of its pose.

use super::kernels;
use super::tile::{LANES, Quad, Tile, lower_len};
use crate::state::{STATE_DIM, StateMatrix};
use crate::time::Stamp;

/// Rotation and position: all of a later node that an edge to it touches.
pub(super) const POSE_DIM: usize = 6;
/// Tiles in a column that a pose takes.
pub(super) const POSE_TILES: usize = POSE_DIM.div_ceil(LANES);
/// Tiles in a column that a whole node takes.
pub(super) const NODE_TILES: usize = STATE_DIM / LANES;
const _: () = assert!(STATE_DIM.is_multiple_of(LANES), "a node fills its tiles");

/// A variable: the node at `stamp`, by its first `tiles` tiles (a pose's or a whole node's).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Variable {
    pub stamp: Stamp,
    pub tiles: usize,
    /// Its first tile in a column.
    pub first: usize,
}

/// Information on some variables, oldest first: H and g.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Message {
    pub variables: Vec<Variable>,
    /// Lower half of H, column of tiles by column of tiles.
    pub tiles: Vec<Tile>,
    pub right: Vec<Quad>,
}

/// The normal equations of one node and the later variables it is tied to. Once eliminated: how the node follows
/// from those, and the message on them.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Front {
    /// The node's columns of H, one row of tiles at a time; eliminated: L, then Y.
    panel: Vec<[Tile; NODE_TILES]>,
    /// The node's part of g; eliminated: d.
    right: [Quad; NODE_TILES],
    /// Of the eliminated: 1/diagonal of L.
    scales: [Quad; NODE_TILES],
    /// On the later variables, which are the node's parents.
    pub message: Message,
}

/// H is not positive definite: some direction of some state is not observed at all, or numbers overflowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct NotPositive;

impl Clone for Message {
    fn clone(&self) -> Self {
        let mut copy = Self::default();
        copy.clone_from(self);
        copy
    }

    fn clone_from(&mut self, source: &Self) {
        self.variables.clone_from(&source.variables);
        self.tiles.clone_from(&source.tiles);
        self.right.clone_from(&source.right);
    }
}

impl Clone for Front {
    fn clone(&self) -> Self {
        let mut copy = Self::default();
        copy.clone_from(self);
        copy
    }

    fn clone_from(&mut self, source: &Self) {
        self.panel.clone_from(&source.panel);
        self.right = source.right;
        self.scales = source.scales;
        self.message.clone_from(&source.message);
    }
}

impl Message {
    /// Tiles in a column.
    pub fn side(&self) -> usize {
        self.right.len()
    }

    pub fn clear(&mut self) {
        self.variables.clear();
        self.tiles.clear();
        self.right.clear();
    }

    /// Makes room for the first `tiles` tiles of the node at `stamp`.
    pub fn include(&mut self, stamp: Stamp, tiles: usize) {
        let place = self.variables.partition_point(|variable| variable.stamp < stamp);
        match self.variables.get_mut(place) {
            Some(found) if found.stamp == stamp => found.tiles = found.tiles.max(tiles),
            _ => self.variables.insert(place, Variable { stamp, tiles, first: 0 }),
        }
    }

    /// All variables are included: zeroes H and g.
    pub fn lay_out(&mut self) {
        let mut side = 0;
        for variable in &mut self.variables {
            variable.first = side;
            side += variable.tiles;
        }
        self.tiles.clear();
        self.tiles.resize(lower_len(side), Tile::ZERO);
        self.right.clear();
        self.right.resize(side, [0.0; LANES]);
    }

    fn first_of(&self, stamp: Stamp) -> usize {
        let found = self.variables.iter().find(|variable| variable.stamp == stamp);
        found.expect("a variable is included before it is used").first
    }

    /// The number at a row and a column, row not before column.
    pub fn at(&mut self, row: usize, column: usize) -> &mut f64 {
        let place = lower_place(self.side(), row / LANES, column / LANES);
        &mut self.tiles[place].0[column % LANES][row % LANES]
    }
}

/// Index of the tile at `row` and `column` in the lower half of a square of `side` tiles.
#[inline(always)]
pub(super) fn lower_place(side: usize, row: usize, column: usize) -> usize {
    column * side - lower_len(column) + row
}

impl Front {
    /// Starts over with nothing known; then later variables are included in `message`.
    pub fn begin(&mut self) {
        self.message.variables.clear();
    }

    /// All variables are included: zeroes H and g.
    pub fn lay_out(&mut self) {
        self.message.lay_out();
        self.panel.clear();
        self.panel.resize(NODE_TILES + self.message.side(), [Tile::ZERO; NODE_TILES]);
        self.right = [[0.0; LANES]; NODE_TILES];
    }

    /// Room for so many tiles in a column, so that no more is asked for up to there.
    pub fn reserve(&mut self, side: usize) {
        reserve(&mut self.panel, side);
        let of_message = side.saturating_sub(NODE_TILES);
        reserve(&mut self.message.variables, of_message / POSE_TILES);
        reserve(&mut self.message.tiles, lower_len(of_message));
        reserve(&mut self.message.right, of_message);
    }

    /// Tiles in a column.
    pub fn side(&self) -> usize {
        self.panel.len()
    }

    /// First tile of the node at `stamp`, which must be included and not be this one.
    pub fn first_of(&self, stamp: Stamp) -> usize {
        NODE_TILES + self.message.first_of(stamp)
    }

    /// Adds a message, of which variable `node` is this front's own; the others are included.
    pub fn add_message(&mut self, node: Stamp, message: &Message, places: &mut Vec<usize>) {
        places.clear();
        for variable in &message.variables {
            let first = if variable.stamp == node { 0 } else { self.first_of(variable.stamp) };
            places.extend(first..first + variable.tiles);
        }
        self.add(places, &message.tiles, &message.right);
    }

    /// Adds the lower half of a square of tiles, and the right-hand side, of which tile `i` belongs at
    /// `places[i]`; places ascend.
    pub fn add(&mut self, places: &[usize], tiles: &[Tile], right: &[Quad]) {
        let Message { tiles: rest, right: rest_right, .. } = &mut self.message;
        kernels::add(&mut self.panel, &mut self.right, rest, rest_right, places, tiles, right);
    }

    /// Eliminates the node: leaves its conditional and the message on the others.
    pub fn eliminate(&mut self) -> Result<(), NotPositive> {
        let Message { tiles, right, .. } = &mut self.message;
        kernels::eliminate(&mut self.panel, &mut self.right, &mut self.scales, tiles, right)
    }

    /// The eliminated node's δ, given the parents' in `solution[NODE_TILES..]`; written before them.
    pub fn solve(&self, solution: &mut [Quad]) {
        kernels::solve(&self.panel, &self.right, &self.scales, solution);
    }

    /// Covariance of an eliminated node without parents: (L Lᵀ)⁻¹.
    pub fn covariance(&self) -> StateMatrix {
        let inverse = kernels::inverse(&self.panel, &self.scales);
        let mut covariance = StateMatrix::zeros();
        for (row, tiles) in inverse.iter().enumerate() {
            for (column, tile) in tiles[..=row].iter().enumerate() {
                let block = nalgebra::SMatrix::<f64, LANES, LANES>::from(tile.0);
                let (row, column) = (row * LANES, column * LANES);
                covariance.fixed_view_mut::<LANES, LANES>(column, row).copy_from(&block.transpose());
                covariance.fixed_view_mut::<LANES, LANES>(row, column).copy_from(&block);
            }
        }
        covariance
    }
}

/// Room for `len` values in all.
pub(super) fn reserve<T>(values: &mut Vec<T>, len: usize) {
    values.reserve(len.saturating_sub(values.len()));
}
