//! A point and the rays that intersect in it: its covariance and that of what is left of the rays'
//! residuals, given the covariance of the cameras. With the Jacobians `A` by cameras and `B` by the
//! point, and `N = B^T B`, the point's is `N^-1 + N^-1 B^T A C A^T B N^-1`.

use super::{
    inverse::SelectedInverse,
    problem::AdjustmentProblem,
    reprojection::{DATA, PreparedImage},
};
use nalgebra::{DMatrix, DVector};
use rowgram_optim::nlls::BlockId;

/// What intersecting rays need: residuals, and Jacobians by the point and, ray by ray, by the image and
/// by its lens, each two rows.
pub(super) struct Rays {
    pub(super) residual: DVector<f64>,
    pub(super) by_point: DMatrix<f64>,
    pub(super) jacobian_camera: Vec<[(BlockId, Vec<f64>); 2]>,
}

/// What is prepared of an image and its camera at `x`, for [`rays`].
pub(super) fn prepared(
    adjustment: &AdjustmentProblem,
    x: &[f64],
    image: usize,
    camera: usize,
) -> PreparedImage {
    let (kept, lens) = (adjustment.images[image], adjustment.lenses[camera]);
    let problem = &adjustment.problem;
    adjustment.shutter.prepare(problem.values(x, kept), problem.values(x, lens))
}

/// Linearises measurements of one point: image, camera, data. `prepared` gives what is prepared of an
/// image and its camera; for many points it is worth keeping, because a lens is looked through for
/// the range in which it is one to one.
pub(super) fn rays(
    adjustment: &AdjustmentProblem,
    prepared: impl Fn(usize, usize) -> PreparedImage,
    point: [f64; 3],
    measurements: &[(usize, usize, [f64; DATA])],
) -> Rays {
    let rows = 2 * measurements.len();
    let mut rays = Rays {
        residual: DVector::zeros(rows),
        by_point: DMatrix::zeros(rows, 3),
        jacobian_camera: Vec::with_capacity(measurements.len()),
    };
    for (k, &(image, camera, data)) in measurements.iter().enumerate() {
        let found = adjustment.shutter.linearize(&prepared(image, camera), &point, &data);
        for row in 0..2 {
            rays.residual[2 * k + row] = found.residual[row];
            for j in 0..3 {
                rays.by_point[(2 * k + row, j)] = found.by_point[row][j];
            }
        }
        rays.jacobian_camera.push([
            (adjustment.images[image], found.by_image),
            (adjustment.lenses[camera], found.by_lens),
        ]);
    }
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
        let own = (b.transpose() * b).cholesky()?.inverse();
        let by_residual = &own * b.transpose();
        let carried = self.carried(inverse);
        let point = &own + &by_residual * &carried * by_residual.transpose();
        let within = b * &by_residual;
        let rest = DMatrix::identity(b.nrows(), b.nrows()) - &within;
        let hat = within + &rest * carried * rest.transpose();
        Some((point, hat))
    }

    /// `A C A^T`.
    fn carried(&self, inverse: &SelectedInverse) -> DMatrix<f64> {
        let count = self.jacobian_camera.len();
        let mut out = DMatrix::zeros(2 * count, 2 * count);
        for (k, first) in self.jacobian_camera.iter().enumerate() {
            for (l, second) in self.jacobian_camera[..=k].iter().enumerate() {
                let mut sum = [[0.0; 2]; 2];
                for (a, by_a) in first {
                    for (b, by_b) in second {
                        inverse.accumulate_covariance((*a, by_a), (*b, by_b), &mut sum);
                    }
                }
                for i in 0..2 {
                    for j in 0..2 {
                        out[(2 * k + i, 2 * l + j)] = sum[i][j];
                        out[(2 * l + j, 2 * k + i)] = sum[i][j];
                    }
                }
            }
        }
        out
    }
}
