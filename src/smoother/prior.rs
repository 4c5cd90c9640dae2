//! What has left the window said of the nodes that stay: information around the points where it was linearized.

use super::elimination::{Message, NODE_TILES};
use super::tile::LANES;
use crate::lie::{Mat3, So3, Vec3};
use crate::state::{NavState, STATE_DIM, StateMatrix, StateVector, row};
use crate::time::Stamp;

/// The marginal prior (Λ, η).
#[derive(Clone, Default)]
pub(super) struct Prior {
    message: Message,
    /// Where each of its variables was linearized.
    points: Vec<NavState>,
    /// The same information where they are linearized now, if that is elsewhere.
    moved: Message,
    is_moved: bool,
    // Scratch, kept for its room.
    shifts: Vec<StateVector>,
    information: Vec<f64>,
    right: Vec<f64>,
}

impl Prior {
    /// All that is known is one node's state.
    pub fn begin(&mut self, stamp: Stamp, state: NavState, information: &StateMatrix) {
        self.message.clear();
        self.message.include(stamp, NODE_TILES);
        self.message.lay_out();
        for column in 0..STATE_DIM {
            for row in column..STATE_DIM {
                *self.message.at(row, column) = information[(row, column)];
            }
        }
        self.points.clear();
        self.points.push(state);
        self.is_moved = false;
    }

    /// Swaps in the message of a node that leaves; `point` tells where a node is linearized.
    pub fn replace(&mut self, message: &mut Message, point: impl Fn(Stamp) -> NavState) {
        std::mem::swap(&mut self.message, message);
        self.is_moved = false;
        self.points.clear();
        self.points.extend(self.message.variables.iter().map(|variable| point(variable.stamp)));
    }

    /// Whether it speaks of the node at `stamp`.
    pub fn speaks_of(&self, stamp: Stamp) -> bool {
        self.message.variables.iter().any(|variable| variable.stamp == stamp)
    }

    /// The prior as a message over tangents at where its variables were linearized at the last `move_to`.
    pub fn message(&self) -> &Message {
        if self.is_moved { &self.moved } else { &self.message }
    }

    /// Moves the prior to where its variables are linearized now.
    ///
    /// With δ_prior = Δ + J δ, Δ from the prior's point to the present one and J = diag(Jr⁻¹(Δφ), I):
    /// Λ' = Jᵀ Λ J, η' = Jᵀ (η − Λ Δ).
    pub fn move_to(&mut self, linearization: impl Fn(Stamp) -> NavState) {
        self.shifts.clear();
        for (variable, point) in self.message.variables.iter().zip(&self.points) {
            self.shifts.push(linearization(variable.stamp).minus(point));
        }
        self.is_moved = self.shifts.iter().flat_map(StateVector::iter).any(|value| *value != 0.0);
        if !self.is_moved {
            return;
        }
        self.expand();
        let size = self.right.len();
        for (variable, shift) in self.message.variables.iter().zip(&self.shifts) {
            let first = variable.first * LANES;
            for (offset, value) in shift.iter().take(variable.tiles * LANES).enumerate() {
                let column = &self.information[(first + offset) * size..][..size];
                self.right.iter_mut().zip(column).for_each(|(sum, entry)| *sum -= entry * value);
            }
        }
        for (variable, shift) in self.message.variables.iter().zip(&self.shifts) {
            let first = variable.first * LANES + row::ROTATION;
            let turn: Vec3 = shift.fixed_rows::<3>(row::ROTATION).into_owned();
            let jacobian = So3::right_jacobian_inverse(&turn);
            for line in 0..size {
                transform(
                    &mut self.information,
                    [0, 1, 2].map(|axis| (first + axis) * size + line),
                    &jacobian,
                );
            }
            for line in 0..size {
                transform(&mut self.information, [0, 1, 2].map(|axis| line * size + first + axis), &jacobian);
            }
            transform(&mut self.right, [0, 1, 2].map(|axis| first + axis), &jacobian);
        }
        self.contract();
    }

    /// Both triangles of Λ, column by column, and η.
    fn expand(&mut self) {
        let size = self.message.side() * LANES;
        self.information.clear();
        self.information.resize(size * size, 0.0);
        for column in 0..size {
            for row in column..size {
                let value = *self.message.at(row, column);
                self.information[column * size + row] = value;
                self.information[row * size + column] = value;
            }
        }
        self.right.clear();
        self.right.extend_from_slice(self.message.right.as_flattened());
    }

    /// Back into tiles, as `moved`.
    fn contract(&mut self) {
        self.moved.variables.clear();
        self.moved.variables.extend_from_slice(&self.message.variables);
        self.moved.lay_out();
        let size = self.right.len();
        for column in 0..size {
            for row in column..size {
                *self.moved.at(row, column) = self.information[column * size + row];
            }
        }
        self.moved.right.as_flattened_mut().copy_from_slice(&self.right);
    }
}

/// v ← Jᵀ v for the three values at `places`.
fn transform(values: &mut [f64], places: [usize; 3], jacobian: &Mat3) {
    let before = Vec3::from(places.map(|place| values[place]));
    let after = jacobian.transpose() * before;
    for (place, value) in places.into_iter().zip(after.iter()) {
        values[place] = *value;
    }
}
