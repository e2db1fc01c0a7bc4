//! The residuals of one photo as a single factor of few rows.
//!
//! With `J` and `r` of all corners of a photo and `[J r]^T [J r] = U^T U` (Cholesky), the rows of `U`
//! have the same normal equations and the same sum of squares as those of the corners:
//!
//! ```text
//! U = [J' r'],   J'^T J' = J^T J,   J'^T r' = J^T r,   |r'| = |r|
//! ```
//!
//! 16 rows stand for the 96 of 48 corners, and the engine has a sixth of the work. It holds for plain
//! sums of squares only: a robust loss weighs each corner by itself.

use super::corners::{LensParameters, PosedLens};
use rowgram_optim::nlls::{Batch, BlockId, InfeasibleFactor, Values};
use std::ops::Range;

/// All photos of a flat board.
#[derive(Debug, Clone)]
pub(super) struct CondensedPhotos {
    lenses: LensParameters,
    /// Lens and pose of each photo, and which marks are its own.
    photos: Vec<([BlockId; 2], Range<usize>)>,
    marks: Vec<super::Mark>,
    rows: usize,
}

/// Rows and columns of `[J r]^T [J r]` at most: twelve of a lens, six of a pose, the residual.
const LARGEST: usize = 20;
/// Those of the usual lens of nine free parameters.
const USUAL: usize = 16;

impl CondensedPhotos {
    pub(super) fn new(
        lenses: LensParameters,
        photos: Vec<([BlockId; 2], Range<usize>)>,
        marks: Vec<super::Mark>,
    ) -> CondensedPhotos {
        let rows = lenses.free_count() + 7;
        CondensedPhotos { lenses, photos, marks, rows }
    }

    /// The squares of a photo, summed.
    fn squares(&self, factor: usize, x: Values<'_>, posed_lens: &PosedLens) -> Option<f64> {
        let (_, marks) = &self.photos[factor];
        let posed_lens = posed_lens.with_pose(x.block(self.photos[factor].0[1]));
        self.marks[marks.clone()].iter().try_fold(0.0, |sum, mark| {
            let r = posed_lens.residual(mark, 0.0)?;
            Some(sum + r[0] * r[0] + r[1] * r[1])
        })
    }

    /// `U` of a photo, written to residual and Jacobian.
    fn condense<const N: usize>(
        &self,
        factor: usize,
        x: Values<'_>,
        posed_lens: &PosedLens,
        residual: &mut [f64],
        jacobian: &mut [f64],
    ) -> Option<()> {
        let (blocks, marks) = &self.photos[factor];
        let posed_lens = posed_lens.with_pose(x.block(blocks[1]));
        let width = self.rows - 1;
        let mut product = Product::<N>([[0.0; N]; N]);
        let mut rows = [[0.0; N]; 2];
        for mark in &self.marks[marks.clone()] {
            let [first, second] = &mut rows;
            let (r, _) =
                posed_lens.linearize(mark, 0.0, [&mut first[..width], &mut second[..width]])?;
            first[width] = r[0];
            second[width] = r[1];
            if !(r[0].is_finite() && r[1].is_finite()) {
                return None;
            }
            product.add(&rows);
        }
        product.factorize(self.rows);
        for row in 0..self.rows {
            jacobian[row * width..(row + 1) * width].copy_from_slice(&product.0[row][..width]);
            residual[row] = product.0[row][width];
        }
        Some(())
    }
}

/// A symmetric matrix, its upper triangle.
struct Product<const N: usize>([[f64; N]; N]);

impl<const N: usize> Product<N> {
    /// Adds the products of two rows with themselves.
    #[inline(always)]
    fn add(&mut self, [a, b]: &[[f64; N]; 2]) {
        for i in 0..N {
            let (ai, bi) = (a[i], b[i]);
            // From the multiple of four before the diagonal, which is one loop without remainder.
            let start = i & !3;
            for (j, value) in self.0[i][start..].iter_mut().enumerate() {
                *value += ai * a[start + j] + bi * b[start + j];
            }
        }
    }

    /// `U` of the first `n` rows and columns, zero below its diagonal. A pivot that rounding has
    /// taken to nothing leaves a row of zeros: that direction has no curvature.
    fn factorize(&mut self, n: usize) {
        for k in 0..n {
            let diagonal = self.0[k][k];
            let mut pivot = diagonal;
            for above in 0..k {
                pivot -= self.0[above][k] * self.0[above][k];
            }
            if pivot <= f64::EPSILON * diagonal {
                self.0[k][..n].fill(0.0);
                continue;
            }
            let root = pivot.sqrt();
            let mut row = self.0[k];
            for above in 0..k {
                let factor = self.0[above][k];
                for j in k + 1..n {
                    row[j] -= factor * self.0[above][j];
                }
            }
            for value in &mut row[k + 1..n] {
                *value /= root;
            }
            row[..k].fill(0.0);
            row[k] = root;
            self.0[k] = row;
        }
    }
}

impl Batch for CondensedPhotos {
    fn len(&self) -> usize {
        self.photos.len()
    }

    fn rows(&self) -> usize {
        self.rows
    }

    fn blocks(&self, factor: usize) -> &[BlockId] {
        &self.photos[factor].0
    }

    fn squared_norms(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        squares: &mut [f64],
    ) -> Option<Result<(), InfeasibleFactor>> {
        let Some((first, _)) = self.photos.get(range.start) else { return Some(Ok(())) };
        let posed_lens = self.lenses.posed_lens(x.block(first[0]));
        for (out, factor) in squares.iter_mut().zip(range) {
            match self.squares(factor, x, &posed_lens) {
                Some(found) if found.is_finite() => *out = found,
                _ => return Some(Err(InfeasibleFactor(factor))),
            }
        }
        Some(Ok(()))
    }

    fn linearize(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        mut jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        let Some((first, _)) = self.photos.get(range.start) else { return Ok(()) };
        let posed_lens = self.lenses.posed_lens(x.block(first[0]));
        // The residual's rows come from the same factorisation as the Jacobian's.
        let own = self.rows - 1;
        debug_assert!(jacobian.is_none() || own == width);
        let (stride, mut unwanted) = (self.rows * own, Vec::new());
        if jacobian.is_none() {
            unwanted.resize(stride, 0.0);
        }
        for (k, factor) in range.enumerate() {
            let out = &mut residual[k * self.rows..(k + 1) * self.rows];
            let entries = match jacobian.as_deref_mut() {
                Some(all) => &mut all[k * stride..(k + 1) * stride],
                None => &mut unwanted[..],
            };
            let done = if self.rows <= USUAL {
                self.condense::<USUAL>(factor, x, &posed_lens, out, entries)
            } else {
                self.condense::<LARGEST>(factor, x, &posed_lens, out, entries)
            };
            if done.is_none() || !out[0].is_finite() {
                return Err(InfeasibleFactor(factor));
            }
        }
        Ok(())
    }
}
