//! A point and the rays that intersect in it: its covariance and that of what is left of the rays'
//! residuals, given the covariance of the cameras. With the Jacobians `A` by cameras and `B` by the
//! point, and `N = B^T B`, the point's is `N^-1 + N^-1 B^T A C A^T B N^-1`.

use super::{
    inverse::SelectedInverse,
    posed::Posed,
    reprojection::{DATA, LENS},
};
use crate::nlls::{BlockId, PairFactor};
use nalgebra::{DMatrix, DVector};

/// What intersecting rays need: Jacobians by cameras and lenses side by side, by the point, and
/// which columns are whose.
pub(super) struct Rays {
    pub(super) residual: DVector<f64>,
    by_kept: DMatrix<f64>,
    pub(super) by_point: DMatrix<f64>,
    columns: Vec<(BlockId, usize)>,
}

/// What is prepared of an image and its camera at `x`, for [`rays`].
pub(super) fn prepared<F: PairFactor<2, K, LENS, 3, Q, DATA>, const K: usize, const Q: usize>(
    posed: &Posed,
    x: &[f64],
    image: usize,
    camera: usize,
) -> [f64; Q] {
    let (kept, lens) = (posed.images[image], posed.lenses[camera]);
    F::prepare(posed.problem.values(x, kept), posed.problem.values(x, lens))
}

/// Linearises measurements of one point: image, camera, data. `prepared` gives what is prepared of an
/// image and its camera; for many points it is worth keeping, because a lens is looked through for
/// the range in which it is one to one.
pub(super) fn rays<F: PairFactor<2, K, LENS, 3, Q, DATA>, const K: usize, const Q: usize>(
    posed: &Posed,
    prepared: impl Fn(usize, usize) -> [f64; Q],
    point: [f64; 3],
    measurements: &[(usize, usize, [f64; DATA])],
) -> Rays {
    let mut columns: Vec<(BlockId, usize)> = measurements
        .iter()
        .flat_map(|&(image, camera, _)| [(posed.images[image], K), (posed.lenses[camera], LENS)])
        .collect();
    columns.sort_unstable();
    columns.dedup();
    let starts: Vec<usize> = columns
        .iter()
        .scan(0, |at, (_, dim)| {
            *at += dim;
            Some(*at - dim)
        })
        .collect();
    let start = |block: BlockId| {
        columns.binary_search_by_key(&block, |(block, _)| *block).map_or(0, |k| starts[k])
    };
    let rows = 2 * measurements.len();
    let width = columns.iter().map(|(_, dim)| dim).sum();
    let mut rays = Rays {
        residual: DVector::zeros(rows),
        by_kept: DMatrix::zeros(rows, width),
        by_point: DMatrix::zeros(rows, 3),
        columns: Vec::new(),
    };
    for (k, &(image, camera, data)) in measurements.iter().enumerate() {
        let (kept, lens) = (posed.images[image], posed.lenses[camera]);
        let found = F::linearize(&prepared(image, camera), &point, &data);
        for row in 0..2 {
            rays.residual[2 * k + row] = found.residual[row];
            for j in 0..K {
                rays.by_kept[(2 * k + row, start(kept) + j)] += found.by_kept[row][j];
            }
            for j in 0..LENS {
                rays.by_kept[(2 * k + row, start(lens) + j)] += found.by_shared[row][j];
            }
            for j in 0..3 {
                rays.by_point[(2 * k + row, j)] = found.by_point[row][j];
            }
        }
    }
    rays.columns = columns;
    rays
}

impl Rays {
    /// The covariance of the point, and of what is left of the residuals, given that of the
    /// cameras. `None` where the rays do not determine the point.
    pub(super) fn covariances(
        &self,
        inverse: &SelectedInverse,
    ) -> Option<(DMatrix<f64>, DMatrix<f64>)> {
        let b = &self.by_point;
        let v = b.transpose() * b;
        let factor = v.cholesky()?;
        let among = inverse.among(&self.columns);
        let coupling = b.transpose() * &self.by_kept;
        let own = factor.inverse();
        let through = &own * &coupling;
        let point = &own + &through * &among * through.transpose();
        let rest = &self.by_kept - b * &through;
        let hat = b * &own * b.transpose() + &rest * &among * rest.transpose();
        Some((point, hat))
    }
}
