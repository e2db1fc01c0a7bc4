//! How well lenses are known where errors of neighbouring measurements are alike.
//!
//! `C = (J^T J)^-1` takes every measurement for an observation of its own. What is matched on the same patch of a
//! field is not: the same leaves, shadows and slopes displace all of it together. Summed over a patch before they
//! are squared, the residuals say by how much a parameter would move if that patch were another (a sandwich estimator
//! with clusters; A. C. Cameron and D. L. Miller, *A practitioner's guide to cluster-robust inference*, 2015):
//!
//! ```text
//! C' = sum_g s_g s_g^T + sigma_0^2 (C - sum_t W_t W_t^T),   s_g = sum_(t in g) W_t v_t,   W_t = C_lens A_t^T (I - B_t N_t^-1 B_t^T)
//! ```
//!
//! with tie points `t`, patches `g`, and the Jacobians `A` by cameras and `B` by the point; what is left of `C` comes
//! from everything that is no tie point, each of which counts on its own. The same sum tells where some measurements are
//! less exact than others, towards the corners of an image for example, which one standard deviation for all hides.

use super::{
    accuracy::InteriorAccuracy,
    inverse::SelectedInverse,
    problem::{AdjustmentProblem, Group, Settings, measurement},
    rays::{Rays, prepared, rays},
    reprojection::{LENS, PreparedImage},
};
use crate::scene::Reconstruction;
use nalgebra::{DMatrix, SMatrix, SVector};
use rayon::prelude::*;
use rowgram_optim::robust::median;
use std::{array, collections::BTreeMap};

type OfLens = SMatrix<f64, LENS, LENS>;
type Shift = SVector<f64, LENS>;

/// A patch is a square in plan; its side is this share of the distance from the images to their points in the middle.
const PATCH: f64 = 0.13;
/// Fewer patches than this tell no spread.
const LEAST_PATCHES: usize = 40;
/// Points whose share of the independent part is summed at once, so that sums keep their order.
const CHUNK: usize = 512;

/// What a tie point does to a lens.
struct Part {
    patch: [i64; 2],
    shift: Shift,
}

/// A reconstruction and its adjustment.
type At<'a> = (&'a Reconstruction, &'a AdjustmentProblem, &'a Settings, &'a [f64]);

/// Makes standard deviations of lenses as large as patches say. Returns by how much variances are larger on average than
/// those of independent measurements, which survey statistics call the design effect of clusters (L. Kish, *Survey
/// sampling*, 1965); 1 where patches do not say.
pub(super) fn widen_by_clusters(
    (reconstruction, adjustment, settings, x): At<'_>,
    inverse: &SelectedInverse,
    sigma0: f64,
    interiors: &mut [InteriorAccuracy],
) -> f64 {
    if interiors.is_empty() || reconstruction.observations.is_empty() {
        return 1.0;
    }
    let mut of_points = vec![Vec::new(); reconstruction.points.len()];
    for (k, o) in reconstruction.observations.iter().enumerate() {
        of_points[o.point as usize].push(k);
    }
    let sigma_px = reconstruction.tie_sigma_px * settings.factor(Group::TiePoints);
    let side_m = PATCH * typical_distance_m(reconstruction);
    let tracks = Tracks { reconstruction, adjustment, x, inverse, of_points, sigma_px, side_m };
    let mut effects: Vec<f64> = Vec::new();
    for interior in interiors {
        let Some(variances) = tracks.covariance(interior.camera, sigma0) else { continue };
        let free = &reconstruction.cameras[interior.camera].free;
        let free = (0..free.len()).filter(|&k| free[k]);
        for (sigma, k) in interior.standard_deviations.iter_mut().zip(free) {
            if *sigma > 0.0 {
                effects.push(variances[k].max(0.0) / (*sigma * *sigma));
            }
            *sigma = sigma.max(variances[k].max(0.0).sqrt());
        }
    }
    (effects.iter().sum::<f64>() / effects.len().max(1) as f64).max(1.0)
}

/// The tie points of a reconstruction, each with its measurements.
struct Tracks<'a> {
    reconstruction: &'a Reconstruction,
    adjustment: &'a AdjustmentProblem,
    x: &'a [f64],
    inverse: &'a SelectedInverse,
    of_points: Vec<Vec<usize>>,
    sigma_px: f64,
    side_m: f64,
}

impl Tracks<'_> {
    /// The diagonal of `C'` of the lens of `camera` over `sigma0^2`; `None` where there are too few patches.
    fn covariance(&self, camera: usize, sigma0: f64) -> Option<[f64; LENS]> {
        let (reconstruction, adjustment) = (self.reconstruction, self.adjustment);
        let lens = adjustment.lenses[camera];
        let with = |block, dim| self.inverse.between((lens, LENS), (block, dim));
        let dimension = |image| adjustment.problem.dimension(image);
        let of_images: Vec<DMatrix<f64>> =
            adjustment.images.iter().map(|&image| with(image, dimension(image))).collect();
        let of_lenses: Vec<DMatrix<f64>> =
            adjustment.lenses.iter().map(|&other| with(other, LENS)).collect();
        let images: Vec<PreparedImage> = reconstruction
            .images
            .iter()
            .enumerate()
            .map(|(image, of)| prepared(adjustment, self.x, image, of.camera))
            .collect();
        let own = |k: &usize| {
            let image = reconstruction.observations[*k].image as usize;
            reconstruction.images[image].camera == camera
        };
        let chunks: Vec<(Vec<Part>, OfLens)> = self
            .of_points
            .par_chunks(CHUNK)
            .enumerate()
            .map(|(chunk, tracks)| {
                let (mut parts, mut independent) = (Vec::new(), OfLens::zeros());
                for (k, track) in tracks.iter().enumerate() {
                    // Others are not coupled with the lens, or only through many images.
                    if !track.iter().any(own) {
                        continue;
                    }
                    let point = chunk * CHUNK + k;
                    let measurements: Vec<_> = track
                        .iter()
                        .map(|&k| {
                            let o = &reconstruction.observations[k];
                            measurement(reconstruction, o.image, o.image_px, self.sigma_px)
                        })
                        .collect();
                    let at = adjustment.problem.values(self.x, adjustment.points[point]);
                    let at = [at[0], at[1], at[2]];
                    let rays = rays(adjustment, |image, _| images[image], at, &measurements);
                    let by = |ray: usize| {
                        let (image, camera, _) = measurements[ray];
                        [&of_images[image], &of_lenses[camera]]
                    };
                    if let Some((shift, alone)) = influence(&rays, by) {
                        independent += alone;
                        let [x, y, _] = reconstruction.points[point].position_m;
                        let patch = [x, y].map(|v| (v / self.side_m).floor() as i64);
                        parts.push(Part { patch, shift });
                    }
                }
                (parts, independent)
            })
            .collect();
        let mut patches: BTreeMap<[i64; 2], Shift> = BTreeMap::new();
        let mut independent = OfLens::zeros();
        for (parts, alone) in chunks {
            independent += alone;
            for part in parts {
                *patches.entry(part.patch).or_insert_with(Shift::zeros) += part.shift;
            }
        }
        if patches.len() < LEAST_PATCHES {
            return None;
        }
        let correction = patches.len() as f64 / (patches.len() as f64 - 1.0);
        let mut clustered = OfLens::zeros();
        patches.values().for_each(|shift| clustered += correction * shift * shift.transpose());
        let whole = &of_lenses[camera];
        let scale = 1.0 / (sigma0 * sigma0);
        Some(array::from_fn(|k| scale * clustered[(k, k)] + whole[(k, k)] - independent[(k, k)]))
    }
}

/// `W v` and `W W^T` of a point's rays; `None` where they do not determine it.
fn influence<'c>(
    rays: &Rays,
    by: impl Fn(usize) -> [&'c DMatrix<f64>; 2],
) -> Option<(Shift, OfLens)> {
    let count = rays.jacobian_camera.len();
    let mut gain: Vec<[Shift; 2]> = vec![[Shift::zeros(); 2]; count];
    for (ray, (gain, kept)) in gain.iter_mut().zip(&rays.jacobian_camera).enumerate() {
        for (covariance, (_, jacobian)) in by(ray).into_iter().zip(kept) {
            for (gain, row) in gain.iter_mut().zip(jacobian.chunks_exact(covariance.ncols())) {
                for (column, weight) in covariance.column_iter().zip(row) {
                    *gain += column * *weight;
                }
            }
        }
    }
    let b = &rays.by_point;
    let own = (b.transpose() * b).cholesky()?.inverse();
    let (mut shift, mut alone) = (Shift::zeros(), OfLens::zeros());
    let mut through = SMatrix::<f64, LENS, 3>::zeros();
    let mut residual = SVector::<f64, 3>::zeros();
    for (row, gain) in gain.as_flattened().iter().enumerate() {
        let v = rays.residual[row];
        shift += gain * v;
        alone += gain * gain.transpose();
        for axis in 0..3 {
            through.column_mut(axis).axpy(b[(row, axis)], gain, 1.0);
            residual[axis] += b[(row, axis)] * v;
        }
    }
    let own = SMatrix::<f64, 3, 3>::from_fn(|i, j| own[(i, j)]);
    Some((shift - through * (own * residual), alone - through * own * through.transpose()))
}

/// How far points are from the images that see them, in the middle, metres.
fn typical_distance_m(reconstruction: &Reconstruction) -> f64 {
    let centres: Vec<[f64; 3]> =
        reconstruction.images.iter().map(|image| image.pose.centre_m()).collect();
    let distances = reconstruction.observations.iter().map(|o| {
        let (a, b) =
            (centres[o.image as usize], reconstruction.points[o.point as usize].position_m);
        (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
    });
    median(distances).unwrap_or(1.0)
}
