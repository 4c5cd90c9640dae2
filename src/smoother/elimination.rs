//! Elimination of one node from the normal equations, and the message it leaves to the next.
//!
//! The cost over the tangents δ of some variables is ½ δᵀ H δ − gᵀ δ. Eliminating a node takes a partial
//! Cholesky factorization of (H, g): the first columns give the node from the later variables, what is left
//! is the marginal information on those (Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017,
//! section 3.4). Only lower triangles are stored, column by column, with gᵀ as the last row.

use crate::state::STATE_DIM;
use crate::time::Stamp;

/// Rotation and position: all of a later node that an edge to it touches.
pub(super) const POSE_DIM: usize = 6;
/// Side of the block that a turn of the chassis adds: all of the earlier node, the pose of the later.
pub(super) const TURN_DIM: usize = STATE_DIM + POSE_DIM;

/// A variable of a front: the node at `stamp`, by its first `dim` rows (6 or 16).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Variable {
    pub stamp: Stamp,
    pub dim: usize,
}

/// Information on some variables: lower triangle of H with gᵀ below, (n + 1) × n.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Message {
    pub variables: Vec<Variable>,
    pub values: Vec<f64>,
}

/// How an eliminated node follows from later variables: the first 16 columns of the factorized front.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Conditional {
    /// Without the node itself.
    pub parents: Vec<Variable>,
    /// (n + 1) × 16: L, then Y, then dᵀ.
    pub columns: Vec<f64>,
}

/// H is not positive definite: some direction of some state is not observed at all, or numbers overflowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct NotPositive;

/// The normal equations of one node and what it is tied to.
#[derive(Clone, Debug, Default)]
pub(super) struct Front {
    variables: Vec<Variable>,
    offsets: Vec<usize>,
    size: usize,
    values: Vec<f64>,
}

impl Message {
    /// Side of H.
    pub fn size(&self) -> usize {
        self.variables.iter().map(|variable| variable.dim).sum()
    }

    pub fn clear(&mut self) {
        self.variables.clear();
        self.values.clear();
    }
}

impl Front {
    /// Starts over with the node and nothing known.
    pub fn begin(&mut self, node: Stamp) {
        self.variables.clear();
        self.variables.push(Variable { stamp: node, dim: STATE_DIM });
    }

    /// Makes room for the first `dim` rows of the node at `stamp`.
    pub fn include(&mut self, stamp: Stamp, dim: usize) {
        match self.variables.binary_search_by_key(&stamp, |variable| variable.stamp) {
            Ok(found) => self.variables[found].dim = self.variables[found].dim.max(dim),
            Err(place) => self.variables.insert(place, Variable { stamp, dim }),
        }
    }

    /// All variables are included: zeroes H and g.
    pub fn lay_out(&mut self) {
        self.offsets.clear();
        self.size = 0;
        for variable in &self.variables {
            self.offsets.push(self.size);
            self.size += variable.dim;
        }
        self.values.clear();
        self.values.resize(self.size * (self.size + 1), 0.0);
    }

    /// First row of the node at `stamp`, which must be included.
    pub fn offset(&self, stamp: Stamp) -> usize {
        let found = self
            .variables
            .binary_search_by_key(&stamp, |variable| variable.stamp)
            .expect("a variable is included before it is used");
        self.offsets[found]
    }

    /// Adds a message on included variables.
    pub fn add_message(&mut self, message: &Message) {
        let mut source = 0;
        let stride = message.size() + 1;
        for (index, variable) in message.variables.iter().enumerate() {
            let target = self.offset(variable.stamp);
            for column in 0..variable.dim {
                let from = &message.values[(source + column) * stride..][..stride];
                let mut row = source + column;
                // The rest of this variable's own block, then whole blocks below, then g.
                self.add_to_column(target + column, target + column, &from[row..source + variable.dim]);
                row = source + variable.dim;
                for below in &message.variables[index + 1..] {
                    self.add_to_column(
                        target + column,
                        self.offset(below.stamp),
                        &from[row..row + below.dim],
                    );
                    row += below.dim;
                }
                self.add_to_column(target + column, self.size, &from[row..]);
            }
            source += variable.dim;
        }
    }

    fn add_to_column(&mut self, column: usize, row: usize, values: &[f64]) {
        let start = column * (self.size + 1) + row;
        for (target, value) in self.values[start..start + values.len()].iter_mut().zip(values) {
            *target += value;
        }
    }

    /// Adds a lower-triangular block of the layout of [`Message`] over consecutive variables that begin at
    /// the nodes' `offsets`: block 0 of `split` rows at `offsets[0]`, the rest at `offsets[1]`.
    pub fn add_pair(&mut self, offsets: [usize; 2], split: usize, size: usize, values: &[f64]) {
        let stride = size + 1;
        for column in 0..size {
            let from = &values[column * stride..(column + 1) * stride];
            if column < split {
                self.add_to_column(offsets[0] + column, offsets[0] + column, &from[column..split]);
                self.add_to_column(offsets[0] + column, offsets[1], &from[split..size]);
                self.add_to_column(offsets[0] + column, self.size, &from[size..]);
            } else {
                let target = offsets[1] + column - split;
                self.add_to_column(target, target, &from[column..size]);
                self.add_to_column(target, self.size, &from[size..]);
            }
        }
    }

    /// Eliminates the first variable; leaves its conditional and the message on the others.
    pub fn eliminate(
        &mut self,
        conditional: &mut Conditional,
        message: &mut Message,
    ) -> Result<(), NotPositive> {
        let stride = self.size + 1;
        partial_cholesky(&mut self.values, self.size)?;
        conditional.parents.clear();
        conditional.parents.extend_from_slice(&self.variables[1..]);
        conditional.columns.clear();
        conditional.columns.extend_from_slice(&self.values[..STATE_DIM * stride]);
        message.variables.clear();
        message.variables.extend_from_slice(&self.variables[1..]);
        message.values.clear();
        for column in STATE_DIM..self.size {
            message
                .values
                .extend_from_slice(&self.values[column * stride + STATE_DIM..(column + 1) * stride]);
        }
        Ok(())
    }
}

impl Conditional {
    /// Side of the front it came from.
    fn size(&self) -> usize {
        self.columns.len() / STATE_DIM - 1
    }

    /// The node's δ, given the parents' in `solution[16..]`; written to `solution[..16]`.
    pub fn solve(&self, solution: &mut [f64]) {
        let size = self.size();
        let stride = size + 1;
        for column in (0..STATE_DIM).rev() {
            let values = &self.columns[column * stride..(column + 1) * stride];
            let mut sum = values[size];
            for row in column + 1..size {
                sum -= values[row] * solution[row];
            }
            solution[column] = sum / values[column];
        }
    }

    /// The lower-triangular L (16×16) of a node without parents.
    pub fn lower(&self) -> nalgebra::SMatrix<f64, STATE_DIM, STATE_DIM> {
        let stride = self.size() + 1;
        nalgebra::SMatrix::from_fn(
            |row, column| {
                if row >= column { self.columns[column * stride + row] } else { 0.0 }
            },
        )
    }
}

/// Factorizes the first 16 columns of the (size + 1) × size lower triangle and subtracts their part from
/// the rest. Cost: about 16 size²/2 multiplications.
fn partial_cholesky(values: &mut [f64], size: usize) -> Result<(), NotPositive> {
    let stride = size + 1;
    for pivot in 0..STATE_DIM {
        let (head, tail) = values.split_at_mut((pivot + 1) * stride);
        let column = &mut head[pivot * stride..];
        let diagonal = column[pivot];
        if !(diagonal > 0.0 && diagonal.is_finite()) {
            return Err(NotPositive);
        }
        let scale = 1.0 / diagonal.sqrt();
        column[pivot..].iter_mut().for_each(|value| *value *= scale);
        for (index, other) in tail.chunks_exact_mut(stride).enumerate() {
            let row = pivot + 1 + index;
            let factor = column[row];
            if factor != 0.0 {
                for (target, value) in other[row..].iter_mut().zip(&column[row..]) {
                    *target -= factor * value;
                }
            }
        }
    }
    Ok(())
}

/// Adds JᵀJ and −Jᵀr of whitened rows to a block of the layout of [`Message`] of side `N`.
/// Each row of the Jacobian comes with its residual.
pub(super) fn add_rows<const N: usize>(values: &mut [f64], rows: impl Iterator<Item = ([f64; N], f64)>) {
    let stride = N + 1;
    for (row, residual) in rows {
        for column in 0..N {
            let factor = row[column];
            if factor == 0.0 {
                continue;
            }
            let target = &mut values[column * stride..(column + 1) * stride];
            for (value, other) in target[column..N].iter_mut().zip(&row[column..]) {
                *value += factor * other;
            }
            target[N] -= factor * residual;
        }
    }
}
