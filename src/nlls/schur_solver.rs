//! How the reduced system is solved: by a factorisation or by iteration.

use super::{
    LinearSolver,
    cholesky::{BlockMatrix, Cholesky, NotPositiveDefinite},
    conjugate::ConjugateGradients,
};

/// A solver of one pattern.
#[derive(Debug)]
pub(super) enum SchurSolver {
    Direct(Cholesky),
    Iterative(ConjugateGradients),
}

impl SchurSolver {
    /// Analyses the pattern of `matrix`; `tolerance` is that of an iteration.
    pub(super) fn analyze(
        matrix: &BlockMatrix,
        linear: LinearSolver,
        tolerance: f64,
    ) -> SchurSolver {
        match linear {
            LinearSolver::IterativeSchur => {
                SchurSolver::Iterative(ConjugateGradients::new(matrix, tolerance))
            }
            LinearSolver::Dense | LinearSolver::Sparse | LinearSolver::Schur => {
                SchurSolver::Direct(Cholesky::analyze(matrix, linear == LinearSolver::Dense))
            }
        }
    }

    /// Makes ready for the values of `matrix`, whose pattern is the one that was analysed.
    pub(super) fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        match self {
            SchurSolver::Direct(cholesky) => cholesky.factorize(matrix),
            SchurSolver::Iterative(iteration) => iteration.prepare(matrix),
        }
    }

    /// Solves for `columns` right-hand sides stored one after the other; `matrix` is the one that was
    /// factorised.
    pub(super) fn solve(&mut self, matrix: &BlockMatrix, rhs: &mut [f64], columns: usize) {
        match self {
            SchurSolver::Direct(cholesky) => cholesky.solve(rhs, columns),
            SchurSolver::Iterative(iteration) => {
                for column in rhs.chunks_mut(matrix.dimension().max(1)) {
                    iteration.solve(matrix, column);
                }
            }
        }
    }

    /// The blocks of the inverse where `matrix`, the one that was factorised, has any; `None` of an
    /// iteration, which factorises nothing.
    pub(super) fn selected_inverse(&self, matrix: &BlockMatrix) -> Option<BlockMatrix> {
        match self {
            SchurSolver::Direct(cholesky) => Some(cholesky.selected_inverse(matrix)),
            SchurSolver::Iterative(_) => None,
        }
    }

    /// Products with the matrix that iterations made since this was last asked.
    pub(super) fn take_products(&mut self) -> u64 {
        match self {
            SchurSolver::Direct(_) => 0,
            SchurSolver::Iterative(iteration) => std::mem::take(&mut iteration.products),
        }
    }
}
