//! Check points: intersected from their marks with the adjusted cameras, and compared.

use super::{
    problem::{AdjustmentProblem, measurement},
    rays::{Rays, prepared, rays},
    reprojection::DATA,
    statistics::Statistics,
};
use crate::camera::Lens;
use crate::scene::{GroundObservation, Reconstruction, Role};
use nalgebra::{Matrix3, Vector3};
use rowgram_optim::geometry::rotation;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// A check point after the adjustment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CheckPoint {
    /// Index of the ground point.
    pub ground: usize,
    /// In how many images it is marked.
    pub rays: usize,
    /// Where its marks put it, metres.
    pub position_m: [f64; 3],
    /// That minus the given coordinates, metres.
    pub error_m: [f64; 3],
    /// Covariance of the intersected position for a variance factor of 1, square metres.
    pub covariance_m2: [[f64; 3]; 3],
}

/// The errors along one axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AxisError {
    /// How many points.
    pub count: usize,
    /// Mean error, metres.
    pub mean_m: f64,
    /// Root mean square error, metres.
    pub rmse_m: f64,
    /// Confidence interval of that for normal errors without bias, metres.
    pub interval_m: [f64; 2],
}

/// Root mean square error of some errors with its confidence interval, by chi-square.
pub fn rmse(errors_m: &[f64], confidence: f64) -> Option<AxisError> {
    let n = errors_m.len() as f64;
    let chi = ChiSquared::new(n).ok().filter(|_| n > 0.0)?;
    let squares: f64 = errors_m.iter().map(|e| e * e).sum();
    let tail = 0.5 * (1.0 - confidence);
    Some(AxisError {
        count: errors_m.len(),
        mean_m: errors_m.iter().sum::<f64>() / n,
        rmse_m: (squares / n).sqrt(),
        interval_m: [
            (squares / chi.inverse_cdf(1.0 - tail)).sqrt(),
            (squares / chi.inverse_cdf(tail)).sqrt(),
        ],
    })
}

/// Where the rays of some marks come nearest to each other, by the poses of `reconstruction`; `None` where they
/// are parallel or a mark has no ray.
pub(crate) fn nearest_to_rays(
    reconstruction: &Reconstruction,
    marks: &[GroundObservation],
) -> Option<[f64; 3]> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for mark in marks {
        let image = &reconstruction.images[mark.image as usize];
        let ray = reconstruction.cameras[image.camera].interior.unproject(mark.image_px)?;
        let ray = Vector3::from(rotation::rotate(rotation::inverse(image.pose.rotation), ray));
        let across = Matrix3::identity() - ray * ray.transpose();
        normal += across;
        right += across * Vector3::from(image.pose.centre_m());
    }
    if normal.symmetric_eigenvalues().min() < 1e-9 * marks.len() as f64 {
        return None;
    }
    normal.try_inverse().map(|inverse| (inverse * right).into())
}

/// Intersects all check points of `reconstruction` with the values `x` of `adjustment`.
pub fn check_points(
    reconstruction: &Reconstruction,
    adjustment: &AdjustmentProblem,
    x: &[f64],
    statistics: &Statistics,
) -> Vec<CheckPoint> {
    let mut adjusted = reconstruction.clone();
    adjustment.update(x, &mut adjusted);
    let checks =
        (0..reconstruction.ground.len()).filter(|&k| reconstruction.ground[k].role == Role::Check);
    checks.filter_map(|ground| intersect(&adjusted, adjustment, x, statistics, ground)).collect()
}

fn intersect(
    reconstruction: &Reconstruction,
    adjustment: &AdjustmentProblem,
    x: &[f64],
    statistics: &Statistics,
    ground: usize,
) -> Option<CheckPoint> {
    let marks: Vec<GroundObservation> = reconstruction
        .marks
        .iter()
        .filter(|mark| mark.ground as usize == ground)
        .copied()
        .collect();
    if marks.len() < 2 {
        return None;
    }
    let measurements: Vec<(usize, usize, [f64; DATA])> = marks
        .iter()
        .map(|mark| {
            let sigma_px = mark.sigma_px * adjustment.mark_sigma_factor;
            measurement(reconstruction, mark.image, mark.image_px, sigma_px)
        })
        .collect();
    let start = nearest_to_rays(reconstruction, &marks)?;
    let mut at: [f64; 3] = std::array::from_fn(|k| start[k] - adjustment.origin_m[k]);
    let linearize = |at: [f64; 3]| -> Rays {
        let of = |image, camera| prepared(adjustment, x, image, camera);
        rays(adjustment, of, at, &measurements)
    };
    // The intersection is close to linear: a few steps are plenty.
    for _ in 0..10 {
        let found = linearize(at);
        let normal = found.by_point.transpose() * &found.by_point;
        let step = normal.cholesky()?.solve(&(found.by_point.transpose() * &found.residual));
        (0..3).for_each(|k| at[k] -= step[k]);
        if step.norm() < 1e-9 {
            break;
        }
    }
    if at.iter().any(|v| !v.is_finite()) {
        return None;
    }
    let (covariance, _) = linearize(at).covariances(&statistics.clustered)?;
    let position_m: [f64; 3] = std::array::from_fn(|k| at[k] + adjustment.origin_m[k]);
    let given = reconstruction.ground[ground].position_m;
    Some(CheckPoint {
        ground,
        rays: marks.len(),
        position_m,
        error_m: std::array::from_fn(|k| position_m[k] - given[k]),
        covariance_m2: std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)])),
    })
}
