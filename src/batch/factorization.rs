//! The sparse Cholesky factorization of the normal equations, and what of the inverse lies on its pattern.
//!
//! Columns stay in the order of time. faer's simplicial kernels are plain loops on one thread: no vectors of a width
//! that depends on the processor, no fused operations, so all processors give the same bits.

use faer::MatMut;
use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::cholesky::llt::factor::LltError;
use faer::sparse::linalg::cholesky::simplicial::{
    SimplicialLltRef, SymbolicSimplicialCholesky, factorize_simplicial_numeric_llt,
    factorize_simplicial_numeric_llt_scratch, factorize_simplicial_symbolic_cholesky,
    factorize_simplicial_symbolic_cholesky_scratch, prefactorize_symbolic_cholesky,
    prefactorize_symbolic_cholesky_scratch,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, Par};

use super::BatchError;
use super::layout::{Equations, Layout};
use crate::lie::Mat6;
use crate::state::{STATE_DIM, StateVector};

/// L of H = L Lᵀ.
pub(super) struct Factorization {
    symbolic: SymbolicSimplicialCholesky<u32>,
    values: Vec<f64>,
    memory: MemBuffer,
    solution: Vec<f64>,
}

impl Factorization {
    /// Finds the pattern of L.
    pub fn new(layout: &Layout) -> Result<Self, BatchError> {
        let pattern = pattern(layout);
        let columns = pattern.ncols();
        let mut parents = vec![0_i32; columns];
        let mut counts = vec![0_u32; columns];
        let mut memory = MemBuffer::new(StackReq::any_of(&[
            prefactorize_symbolic_cholesky_scratch::<u32>(columns, layout.rows.len()),
            factorize_simplicial_symbolic_cholesky_scratch::<u32>(columns),
            factorize_simplicial_numeric_llt_scratch::<u32, f64>(columns),
        ]));
        let stack = MemStack::new(&mut memory);
        let tree = prefactorize_symbolic_cholesky(&mut parents, &mut counts, pattern, stack);
        if u32::try_from(counts.iter().map(|count| u64::from(*count)).sum::<u64>()).is_err() {
            return Err(BatchError::TooLarge);
        }
        let symbolic = factorize_simplicial_symbolic_cholesky(pattern, tree, &counts, stack)
            .map_err(|_| BatchError::TooLarge)?;
        let values = vec![0.0; symbolic.len_val()];
        Ok(Self { symbolic, values, memory, solution: vec![0.0; columns] })
    }

    /// Makes L; an error is the column at which H is not positive definite.
    pub fn factorize(&mut self, layout: &Layout, equations: &Equations) -> Result<(), usize> {
        let matrix = SparseColMatRef::new(pattern(layout), &equations.entries[..]);
        let stack = MemStack::new(&mut self.memory);
        factorize_simplicial_numeric_llt(&mut self.values, matrix, Default::default(), &self.symbolic, stack)
            .map(|_| ())
            .map_err(|LltError::NonPositivePivot { index }| index - 1)
    }

    /// δ of H δ = g.
    pub fn solve(&mut self, equations: &Equations) -> Vec<StateVector> {
        let numbers = equations.right.iter().flat_map(StateVector::iter);
        self.solution.iter_mut().zip(numbers).for_each(|(to, value)| *to = *value);
        let rows = self.solution.len();
        let right = MatMut::from_column_major_slice_mut(&mut self.solution, rows, 1);
        let factor = SimplicialLltRef::new(&self.symbolic, &self.values[..]);
        factor.solve_in_place_with_conj(Conj::No, right, Par::Seq, MemStack::new(&mut self.memory));
        self.solution.chunks_exact(STATE_DIM).map(StateVector::from_column_slice).collect()
    }

    /// Covariances of all poses, from the entries of Σ = H⁻¹ on the pattern of L (Takahashi, Fagan and Chin, 1973;
    /// Kaess and Dellaert, "Covariance recovery from a square root information matrix for data association", 2009,
    /// eqs. 14 and 15). With l the column j of L below its diagonal, on rows I, over the diagonal:
    ///
    ///   Σ_Ij = −Σ_II l,      Σ_jj = 1/L_jj² − lᵀ Σ_Ij,
    ///
    /// last column first. All of Σ_II lies on the pattern, and Σ takes the place of L.
    pub fn into_covariances(mut self) -> Vec<Mat6> {
        let (starts, rows) = (self.symbolic.col_ptr(), self.symbolic.row_idx());
        let values = &mut self.values;
        let mut below = Vec::new();
        let mut column = Vec::new();
        for index in (0..self.symbolic.ncols()).rev() {
            let range = starts[index] as usize + 1..starts[index + 1] as usize;
            let diagonal = values[range.start - 1];
            let others = &rows[range.clone()];
            below.clear();
            below.extend(values[range.clone()].iter().map(|value| value / diagonal));
            column.clear();
            column.resize(others.len(), 0.0);
            for (first, &other) in others.iter().enumerate() {
                // Entries of Σ in that column, on the diagonal and at the later rows of this one.
                let mut place = starts[other as usize] as usize;
                column[first] -= values[place] * below[first];
                for second in first + 1..others.len() {
                    while rows[place] < others[second] {
                        place += 1;
                    }
                    column[second] -= values[place] * below[first];
                    column[first] -= values[place] * below[second];
                }
            }
            let across: f64 = below.iter().zip(&column).map(|(factor, value)| factor * value).sum();
            values[range.start - 1] = 1.0 / (diagonal * diagonal) - across;
            values[range].copy_from_slice(&column);
        }
        let node = |first: &[u32]| {
            Mat6::from_fn(|row, column| {
                let (low, high) = (row.min(column), row.max(column));
                values[first[low] as usize + high - low]
            })
        };
        starts[..self.symbolic.ncols()].chunks_exact(STATE_DIM).map(node).collect()
    }
}

fn pattern(layout: &Layout) -> SymbolicSparseColMatRef<'_, u32> {
    let columns = layout.column_starts.len() - 1;
    SymbolicSparseColMatRef::new_checked(columns, columns, &layout.column_starts, None, &layout.rows)
}
