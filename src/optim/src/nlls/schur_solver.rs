//! How the reduced system is solved: by a factorisation or by iteration.

use super::{
    cholesky::{BlockMatrix, Cholesky, NotPositiveDefinite},
    conjugate::ConjugateGradients,
};

/// A solver of one pattern.
#[derive(Debug)]
pub(super) enum SchurSolver {
    Direct(Cholesky),
    /// Iteration over the matrix.
    Iterative(ConjugateGradients),
    /// Iteration over the points; the matrix holds the diagonal blocks only.
    Implicit(ConjugateGradients),
}

impl SchurSolver {
    /// Makes ready for the values of `matrix`, whose pattern is the one that was analysed.
    pub(super) fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        match self {
            SchurSolver::Direct(cholesky) => cholesky.factorize(matrix),
            SchurSolver::Iterative(iteration) | SchurSolver::Implicit(iteration) => {
                iteration.prepare(matrix)
            }
        }
    }

    /// Solves for one right-hand side; `matrix` is the one that was factorised, `product` that of the reduced system
    /// with a vector where there is no matrix of it.
    ///
    /// # Errors
    /// Where an iteration cannot make its first step.
    pub(super) fn solve(
        &mut self,
        matrix: &BlockMatrix,
        rhs: &mut [f64],
        product: impl FnMut(&[f64], &mut [f64]),
    ) -> Result<(), NotPositiveDefinite> {
        match self {
            SchurSolver::Direct(cholesky) => {
                cholesky.solve(rhs, 1);
                Ok(())
            }
            SchurSolver::Iterative(iteration) => {
                iteration.solve(matrix, rhs, |x, y| matrix.multiply(x, y))
            }
            SchurSolver::Implicit(iteration) => iteration.solve(matrix, rhs, product),
        }
    }

    /// The factorisation; `None` of an iteration, which factorises nothing.
    pub(super) fn cholesky(&mut self) -> Option<&mut Cholesky> {
        match self {
            SchurSolver::Direct(cholesky) => Some(cholesky),
            SchurSolver::Iterative(_) | SchurSolver::Implicit(_) => None,
        }
    }

    /// The blocks of the inverse where `matrix`, the one that was factorised, has any; `None` of an
    /// iteration.
    pub(super) fn selected_inverse(&self, matrix: &BlockMatrix) -> Option<BlockMatrix> {
        match self {
            SchurSolver::Direct(cholesky) => Some(cholesky.selected_inverse(matrix)),
            SchurSolver::Iterative(_) | SchurSolver::Implicit(_) => None,
        }
    }

    /// Products with the matrix that iterations made since this was last asked.
    pub(super) fn take_products(&mut self) -> u64 {
        match self {
            SchurSolver::Direct(_) => 0,
            SchurSolver::Iterative(iteration) | SchurSolver::Implicit(iteration) => {
                std::mem::take(&mut iteration.products)
            }
        }
    }
}
