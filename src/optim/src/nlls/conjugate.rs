//! Preconditioned conjugate gradients on the (reduced) normal equations.
//!
//! `S d = b` is solved to a share `eta` of the first residual, both in the norm `sqrt(r^T M^-1 r)`, with
//! `M` the diagonal blocks of `S`: one block for each camera. A step then needs products with `S` instead of
//! a factorisation, whose fill grows faster than `S` does; and far from the optimum a step need not be exact.
//!
//! The model's decrease is told without the residual `e = S d - b` that is left: started at zero, the iterate
//! lies in the space to which `e` is orthogonal, so `d^T e = 0` as for an exact step.
//!
//! Reference: S. Agarwal, N. Snavely, S. M. Seitz, R. Szeliski, "Bundle adjustment in the large", ECCV 2010.

use super::{
    cholesky::{BlockMatrix, NotPositiveDefinite},
    elimination::{backward_solve, factor_in_place, forward_solve, inner},
};

/// Most products with the matrix for one solution.
const MAX_PRODUCTS: usize = 500;

/// The preconditioner and the vectors of the iteration.
#[derive(Debug)]
pub(super) struct ConjugateGradients {
    /// `eta`.
    pub(super) tolerance: f64,
    /// Cholesky factors of the diagonal blocks, row-major, one after the other.
    factors: Vec<f64>,
    residual: Vec<f64>,
    preconditioned: Vec<f64>,
    direction: Vec<f64>,
    product: Vec<f64>,
    /// Products with the matrix so far.
    pub(super) products: u64,
}

impl ConjugateGradients {
    pub(super) fn new(matrix: &BlockMatrix, tolerance: f64) -> ConjugateGradients {
        let n = matrix.dimension();
        let squares = (0..matrix.block_count()).map(|block| matrix.dim(block).pow(2)).sum();
        ConjugateGradients {
            tolerance,
            factors: vec![0.0; squares],
            residual: vec![0.0; n],
            preconditioned: vec![0.0; n],
            direction: vec![0.0; n],
            product: vec![0.0; n],
            products: 0,
        }
    }

    /// Factorises the diagonal blocks of `matrix`.
    pub(super) fn prepare(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        let mut at = 0;
        for block in 0..matrix.block_count() {
            let dim = matrix.dim(block);
            let values = &matrix.values[matrix.value_ptr[matrix.column_ptr[block]]..][..dim * dim];
            let factor = &mut self.factors[at..at + dim * dim];
            for i in 0..dim {
                for j in 0..=i {
                    factor[i * dim + j] = values[j * dim + i];
                }
            }
            factor_in_place(factor, dim)?;
            at += dim * dim;
        }
        Ok(())
    }

    /// Replaces `b` by an approximate solution of `A d = b`; `multiply(d, out)` says what `A d` is, and `matrix` holds
    /// its diagonal blocks.
    ///
    /// # Errors
    /// Where rounding or a NaN lets not even the first direction descend: a step of nothing would pass for the solution.
    pub(super) fn solve(
        &mut self,
        matrix: &BlockMatrix,
        b: &mut [f64],
        mut multiply: impl FnMut(&[f64], &mut [f64]),
    ) -> Result<(), NotPositiveDefinite> {
        self.residual.copy_from_slice(b);
        b.fill(0.0);
        self.precondition(matrix);
        self.direction.copy_from_slice(&self.preconditioned);
        let mut square = inner(&self.residual, &self.preconditioned);
        let enough = self.tolerance * self.tolerance * square;
        for product in 0..MAX_PRODUCTS {
            if square <= enough {
                return Ok(());
            }
            if square.is_nan() {
                return if product == 0 { Err(NotPositiveDefinite(None)) } else { Ok(()) };
            }
            multiply(&self.direction, &mut self.product);
            self.products += 1;
            let curvature = inner(&self.direction, &self.product);
            // Rounding has eaten the definiteness: what there is so far, if anything, is a descent direction.
            if curvature <= 0.0 || curvature.is_nan() {
                return if product == 0 { Err(NotPositiveDefinite(None)) } else { Ok(()) };
            }
            let length = square / curvature;
            for k in 0..b.len() {
                b[k] += length * self.direction[k];
                self.residual[k] -= length * self.product[k];
            }
            self.precondition(matrix);
            let before = square;
            square = inner(&self.residual, &self.preconditioned);
            let conjugate = square / before;
            for (p, z) in self.direction.iter_mut().zip(&self.preconditioned) {
                *p = z + conjugate * *p;
            }
        }
        Ok(())
    }

    /// `preconditioned = M^-1 residual`.
    fn precondition(&mut self, matrix: &BlockMatrix) {
        self.preconditioned.copy_from_slice(&self.residual);
        let mut at = 0;
        for block in 0..matrix.block_count() {
            let dim = matrix.dim(block);
            let factor = &self.factors[at..at + dim * dim];
            let part = &mut self.preconditioned[matrix.starts[block]..matrix.starts[block + 1]];
            forward_solve(factor, dim, part);
            backward_solve(factor, dim, part);
            at += dim * dim;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of blocks of 1 to 3.
    fn ring(blocks: usize) -> BlockMatrix {
        let dims: Vec<usize> = (0..blocks).map(|k| 1 + k % 3).collect();
        let mut columns: Vec<Vec<u32>> =
            (0..blocks).map(|c| (c..blocks.min(c + 3)).map(|r| r as u32).collect()).collect();
        columns[0].push(blocks as u32 - 1);
        let mut matrix = BlockMatrix::new(&dims, &columns);
        for (k, v) in matrix.values.iter_mut().enumerate() {
            *v = 0.3 * ((k * 7919 % 101) as f64 / 101.0 - 0.5);
        }
        let n = matrix.dimension();
        matrix.add_to_diagonal(&(0..n).map(|k| 2.0 + (k % 7) as f64).collect::<Vec<_>>());
        matrix
    }

    #[test]
    fn the_solution_is_as_good_as_the_tolerance_and_conjugate_to_what_is_left() {
        let matrix = ring(40);
        let n = matrix.dimension();
        let x: Vec<f64> = (0..n).map(|k| (k as f64).sin()).collect();
        let mut b = vec![0.0; n];
        matrix.multiply(&x, &mut b);
        for (tolerance, within) in [(1e-12, 1e-10), (1e-2, 0.1)] {
            let mut found = b.clone();
            let mut solver = ConjugateGradients::new(&matrix, tolerance);
            solver.prepare(&matrix).unwrap();
            solver.solve(&matrix, &mut found, |x, y| matrix.multiply(x, y)).unwrap();
            let error = found.iter().zip(&x).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(error < within, "{tolerance}: {error}");
            assert!(inner(&found, &solver.residual).abs() < 1e-10 * inner(&found, &b));
        }
        let mut exact = ConjugateGradients::new(&matrix, 1e-12);
        exact.prepare(&matrix).unwrap();
        exact.solve(&matrix, &mut b.clone(), |x, y| matrix.multiply(x, y)).unwrap();
        assert!(exact.products as usize <= n);
    }

    #[test]
    fn an_indefinite_block_is_refused() {
        let mut matrix = ring(10);
        let at = matrix.value_ptr[matrix.column_ptr[4]];
        matrix.values[at] = -1.0;
        let mut solver = ConjugateGradients::new(&matrix, 0.1);
        assert_eq!(solver.prepare(&matrix), Err(NotPositiveDefinite(None)));
    }

    #[test]
    fn a_matrix_along_which_nothing_descends_is_refused_and_not_solved_by_zero() {
        let matrix = ring(10);
        let mut solver = ConjugateGradients::new(&matrix, 0.1);
        solver.prepare(&matrix).unwrap();
        let mut b = vec![1.0; matrix.dimension()];
        let negative = |x: &[f64], y: &mut [f64]| {
            matrix.multiply(x, y);
            y.iter_mut().for_each(|v| *v = -*v);
        };
        assert_eq!(solver.solve(&matrix, &mut b, negative), Err(NotPositiveDefinite(None)));
        let mut b = vec![f64::NAN; matrix.dimension()];
        let product = |x: &[f64], y: &mut [f64]| matrix.multiply(x, y);
        assert_eq!(solver.solve(&matrix, &mut b, product), Err(NotPositiveDefinite(None)));
        let mut b = vec![0.0; matrix.dimension()];
        assert_eq!(solver.solve(&matrix, &mut b, product), Ok(()));
    }
}
