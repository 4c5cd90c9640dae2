//! Tiles of 4 × 4 numbers: the grain of all dense work of the smoother.
//!
//! Every operation is written lane by lane over four numbers of a column, so that a compiler makes one vector
//! instruction of it where there is one; the order of sums is the same with and without.

#![allow(
    clippy::needless_range_loop,
    reason = "rows, columns and lanes are numbers here, as in the equations"
)]

/// Rows and columns of a tile.
pub(super) const LANES: usize = 4;

/// Four numbers of a vector.
pub(super) type Quad = [f64; LANES];

/// Sixteen numbers of a matrix, column by column.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(32))]
pub(super) struct Tile(pub [Quad; LANES]);

impl Tile {
    pub const ZERO: Self = Self([[0.0; LANES]; LANES]);
    pub const IDENTITY: Self =
        Self([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);

    /// `self + other`, in place.
    #[inline(always)]
    pub fn add(&mut self, other: &Self) {
        for (column, added) in self.0.iter_mut().zip(&other.0) {
            for lane in 0..LANES {
                column[lane] += added[lane];
            }
        }
    }

    /// `self − a bᵀ`.
    #[inline(always)]
    pub fn minus_product(mut self, a: &Self, b: &Self) -> Self {
        for (column, factors) in a.0.iter().zip(&b.0) {
            for (target, factor) in self.0.iter_mut().zip(factors) {
                for lane in 0..LANES {
                    target[lane] -= column[lane] * factor;
                }
            }
        }
        self
    }

    /// `self − Σ a bᵀ` over a row of tiles.
    #[inline(always)]
    pub fn minus_products<const N: usize>(mut self, a: &[Self; N], b: &[Self; N]) -> Self {
        // A loop: a fold is a function of its own, which is not compiled for the wide instructions of its caller.
        for (a, b) in a.iter().zip(b) {
            self = self.minus_product(a, b);
        }
        self
    }

    /// `self + a bᵀ` of two vectors.
    #[inline(always)]
    pub fn plus_outer(mut self, a: &Quad, b: &Quad) -> Self {
        for (target, factor) in self.0.iter_mut().zip(b) {
            for lane in 0..LANES {
                target[lane] += a[lane] * factor;
            }
        }
        self
    }

    /// `vector − self x`.
    #[inline(always)]
    pub fn taken_from(&self, mut vector: Quad, x: &Quad) -> Quad {
        for (column, factor) in self.0.iter().zip(x) {
            for lane in 0..LANES {
                vector[lane] -= column[lane] * factor;
            }
        }
        vector
    }

    /// The lower L with L Lᵀ = `self`, of which the lower half is read, and 1/diagonal; `None` if some pivot is
    /// not a positive number.
    #[inline(always)]
    pub fn cholesky(&self) -> Option<(Self, Quad)> {
        let mut lower = Self::ZERO;
        let mut scales = [0.0; LANES];
        let mut rest = *self;
        for pivot in 0..LANES {
            let diagonal = rest.0[pivot][pivot];
            if !(diagonal > 0.0 && diagonal.is_finite()) {
                return None;
            }
            let scale = 1.0 / diagonal.sqrt();
            scales[pivot] = scale;
            for row in pivot..LANES {
                lower.0[pivot][row] = rest.0[pivot][row] * scale;
            }
            for column in pivot + 1..LANES {
                for row in column..LANES {
                    rest.0[column][row] -= lower.0[pivot][row] * lower.0[pivot][column];
                }
            }
        }
        Some((lower, scales))
    }

    /// `self L⁻ᵀ`, given L and 1/diagonal.
    #[inline(always)]
    pub fn times_inverse_transpose(mut self, lower: &Self, scales: &Quad) -> Self {
        for column in 0..LANES {
            let mut sum = self.0[column];
            for before in 0..column {
                for lane in 0..LANES {
                    sum[lane] -= self.0[before][lane] * lower.0[before][column];
                }
            }
            for lane in 0..LANES {
                sum[lane] *= scales[column];
            }
            self.0[column] = sum;
        }
        self
    }

    /// L⁻¹ `x` for a lower `self`.
    #[inline(always)]
    pub fn solve_lower(&self, mut x: Quad, scales: &Quad) -> Quad {
        for row in 0..LANES {
            x[row] *= scales[row];
            for below in row + 1..LANES {
                x[below] -= self.0[row][below] * x[row];
            }
        }
        x
    }

    /// L⁻ᵀ `x` for a lower `self`.
    #[inline(always)]
    pub fn solve_lower_transpose(&self, mut x: Quad, scales: &Quad) -> Quad {
        for row in (0..LANES).rev() {
            for below in row + 1..LANES {
                x[row] -= self.0[row][below] * x[below];
            }
            x[row] *= scales[row];
        }
        x
    }
}

/// Number of tiles in the lower half of a square of `side` tiles.
pub(super) const fn lower_len(side: usize) -> usize {
    side * (side + 1) / 2
}
