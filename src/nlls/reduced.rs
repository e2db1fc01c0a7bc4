//! How the reduced system is solved: by a factorisation or by iteration.

use super::{
    Linear,
    cholesky::{BlockMatrix, Cholesky, NotPositiveDefinite},
    conjugate::ConjugateGradients,
};

/// A solver of one pattern.
#[derive(Debug)]
pub(super) enum Reduced {
    Direct(Cholesky),
    Iterative(ConjugateGradients),
}

impl Reduced {
    /// Analyses the pattern of `matrix`; `tolerance` is that of an iteration.
    pub(super) fn analyze(matrix: &BlockMatrix, linear: Linear, tolerance: f64) -> Reduced {
        match linear {
            Linear::IterativeSchur => {
                Reduced::Iterative(ConjugateGradients::new(matrix, tolerance))
            }
            Linear::Dense | Linear::Sparse | Linear::Schur => {
                Reduced::Direct(Cholesky::analyze(matrix, linear == Linear::Dense))
            }
        }
    }

    /// Makes ready for the values of `matrix`, whose pattern is the one that was analysed.
    pub(super) fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        match self {
            Reduced::Direct(cholesky) => cholesky.factorize(matrix),
            Reduced::Iterative(iteration) => iteration.prepare(matrix),
        }
    }

    /// Solves for `columns` right-hand sides stored one after the other; `matrix` is the one that was
    /// factorised.
    pub(super) fn solve(&mut self, matrix: &BlockMatrix, rhs: &mut [f64], columns: usize) {
        match self {
            Reduced::Direct(cholesky) => cholesky.solve(rhs, columns),
            Reduced::Iterative(iteration) => {
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
            Reduced::Direct(cholesky) => Some(cholesky.selected_inverse(matrix)),
            Reduced::Iterative(_) => None,
        }
    }

    /// Products with the matrix that iterations made since this was last asked.
    pub(super) fn take_products(&mut self) -> u64 {
        match self {
            Reduced::Direct(_) => 0,
            Reduced::Iterative(iteration) => std::mem::take(&mut iteration.products),
        }
    }
}
