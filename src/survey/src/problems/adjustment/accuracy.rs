//! How well cameras and points are known, from blocks of the inverse.

use super::{inverse::SelectedInverse, problem::AdjustmentProblem, reprojection::LENS};
use crate::camera::Lens;
use crate::scene::{Accuracy, CameraSigma, PoseSigma, Reconstruction};
use nalgebra::{DMatrix, Matrix3, SymmetricEigen};
use rowgram_optim::{
    geometry::{cross, rotation},
    nlls::BlockId,
};
use serde::Serialize;

/// How well an image's exterior orientation is known, for a variance factor of 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ImageAccuracy {
    /// Covariance of the projection centre, square metres, mapping frame.
    pub centre_m2: [[f64; 3]; 3],
    /// Standard deviations of omega, phi, kappa, radians.
    pub angles_rad: [f64; 3],
}

/// How well a point is known, for a variance factor of 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PointAccuracy {
    /// Covariance, square metres, mapping frame.
    pub covariance_m2: [[f64; 3]; 3],
}

impl ImageAccuracy {
    /// Semi-axes of the error ellipsoid of the centre: standard deviations in metres, the largest first.
    pub fn ellipsoid(&self) -> [f64; 3] {
        let eigen = SymmetricEigen::new(Matrix3::from_fn(|i, j| self.centre_m2[i][j]));
        let mut axes: [f64; 3] = eigen.eigenvalues.map(|value| value.max(0.0).sqrt()).into();
        axes.sort_by(|a, b| b.total_cmp(a));
        axes
    }
}

/// How well a camera's interior orientation is known, for a variance factor of 1.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InteriorAccuracy {
    /// Index of the camera.
    pub camera: usize,
    /// The free parameters.
    pub names: Vec<&'static str>,
    /// Their values.
    pub values: Vec<f64>,
    /// Their standard deviations: where errors of neighbouring measurements are found to be alike, those
    /// that this makes; never less than `independent`.
    pub standard_deviations: Vec<f64>,
    /// Their standard deviations if every measurement were an observation of its own.
    pub independent: Vec<f64>,
    /// Their correlations, row by row.
    pub correlation: Vec<Vec<f64>>,
}

pub(super) fn array3(m: &DMatrix<f64>) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
}

pub(super) fn image(
    adjustment: &AdjustmentProblem,
    x: &[f64],
    inverse: &SelectedInverse,
    block: BlockId,
) -> ImageAccuracy {
    let dim = adjustment.problem.dimension(block);
    let c = inverse.among(&[(block, dim)]);
    let values = adjustment.problem.values(x, block);
    let r = rotation::matrix([values[0], values[1], values[2], values[3]]);
    let world = |k: usize| [r[0][k], r[1][k], r[2][k]];
    // The centre moves by -R^T s.
    let centre_m2 = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let (a, b) = (world(i), world(j));
            let terms = (0..9).map(|k| a[k / 3] * c[(3 + k / 3, 3 + k % 3)] * b[k % 3]);
            terms.sum()
        })
    });
    // Row k of R^T changes by w x row.
    let m = [world(0), world(1), world(2)];
    let mut by_turn = [[0.0; 3]; 3];
    for axis in 0..3 {
        let mut w = [0.0; 3];
        w[axis] = 1.0;
        let d = m.map(|row| cross(w, row));
        by_turn[0][axis] =
            (m[1][2] * d[2][2] - m[2][2] * d[1][2]) / (m[1][2].powi(2) + m[2][2].powi(2));
        by_turn[1][axis] = d[0][2] / (1.0 - m[0][2].powi(2)).sqrt();
        by_turn[2][axis] =
            (m[0][1] * d[0][0] - m[0][0] * d[0][1]) / (m[0][1].powi(2) + m[0][0].powi(2));
    }
    let angles_rad = by_turn.map(|by| {
        let terms = (0..9).map(|k| by[k / 3] * c[(k / 3, k % 3)] * by[k % 3]);
        terms.sum::<f64>().max(0.0).sqrt()
    });
    ImageAccuracy { centre_m2, angles_rad }
}

pub(super) fn interior(
    reconstruction: &Reconstruction,
    adjustment: &AdjustmentProblem,
    inverse: &SelectedInverse,
    camera: usize,
) -> Option<InteriorAccuracy> {
    let c = inverse.among(&[(adjustment.lenses[camera], LENS)]);
    let described = &reconstruction.cameras[camera];
    let free: Vec<usize> = (0..described.free.len()).filter(|&k| described.free[k]).collect();
    if free.is_empty() {
        return None;
    }
    let sigma: Vec<f64> = free.iter().map(|&k| c[(k, k)].max(0.0).sqrt()).collect();
    let correlation = free
        .iter()
        .enumerate()
        .map(|(i, &a)| {
            let entry = |(j, &b): (usize, &usize)| {
                if i == j { 1.0 } else { c[(a, b)] / (sigma[i] * sigma[j]) }
            };
            free.iter().enumerate().map(entry).collect()
        })
        .collect();
    let values = described.interior.values();
    Some(InteriorAccuracy {
        camera,
        names: free.iter().map(|&k| described.interior.parameters()[k].name).collect(),
        values: free.iter().map(|&k| values[k]).collect(),
        standard_deviations: sigma.clone(),
        independent: sigma,
        correlation,
    })
}

impl super::Adjusted {
    /// How well everything that was adjusted is known, in the order of [`super::Adjusted::reconstruction`].
    pub fn accuracy(&self) -> Accuracy {
        let statistics = &self.statistics;
        let sigma0 = statistics.sigma0;
        let images = statistics.images.iter().map(|image| PoseSigma {
            centre_m: [0, 1, 2].map(|k| sigma0 * image.centre_m2[k][k].max(0.0).sqrt()),
            angles_rad: image.angles_rad.map(|angle| sigma0 * angle),
        });
        let mut cameras = vec![CameraSigma::default(); self.reconstruction.cameras.len()];
        for interior in &statistics.interiors {
            cameras[interior.camera] = CameraSigma {
                names: interior.names.iter().map(|name| (*name).to_owned()).collect(),
                sigmas: interior.standard_deviations.iter().map(|sigma| sigma * sigma0).collect(),
                correlation: symmetric(&interior.correlation),
            };
        }
        let points = statistics
            .points
            .iter()
            .map(|point| [0, 1, 2].map(|k| sigma0 * point.covariance_m2[k][k].max(0.0).sqrt()));
        Accuracy { sigma0, images: images.collect(), cameras, points_m: points.collect() }
    }
}

/// Without what rounding has left asymmetric.
fn symmetric(matrix: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut out = matrix.to_vec();
    for i in 0..out.len() {
        for j in 0..i {
            out[j][i] = out[i][j];
        }
    }
    out
}
