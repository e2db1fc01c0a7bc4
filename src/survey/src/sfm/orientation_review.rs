//! Orientations that a gimbal or an inertial unit tells, against those of a block: what all have in common, how much single ones
//! scatter, and which of them, or whether all, are wrong.
//!
//! ```text
//! e_i = log(Q^T R_i^T exp(-b) R_i0)
//! ```
//!
//! with the rotation `R_i` from the block's frame to the camera, `R_i0` the observed one from the mapping frame, `Q` from the mapping
//! frame to that of the block, and `b` how the camera hangs in its mount, as in
//! [`crate::problems::adjustment`]. `Q` is free: for a block in the mapping frame it is what an inertial unit is off level and a
//! compass from north, with as much as they may be off anyway for comparison. Iterated least squares with Huber's weights;
//! radians, about the axes of the mapping frame (east, north, up).

use super::{block::Block, georeference::Known};
use crate::{
    problems::adjustment::{ATTITUDE_BIAS_SIGMA_RAD, BORESIGHT_SIGMA_RAD},
    scene::{CameraOrientation, Reconstruction},
};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Vector2, Vector3};
use rowgram_optim::{
    geometry::rotation::{self, Quaternion},
    robust::{median, sigma_of_errors},
};
use serde::{Deserialize, Serialize};

/// Fewer orientations than this are not compared with a block. This and the next four are first choices, tried on synthetic flights only.
const MIN_ORIENTATIONS: usize = 4;
/// An orientation that is off by more standard deviations than this is wrong.
const OUTLIER_SIGMAS: f64 = 5.0;
/// Orientations that scatter by more than this many of their stated standard deviations belong to something else.
const SCATTER_RATIO: f64 = 5.0;
/// With more than this share of them wrong, none is believed.
const MAX_WRONG_SHARE: f64 = 1.0 / 3.0;
/// Starts that are tried for the turn of a block, at most.
const MAX_STARTS: usize = 100;

/// Orientations that take part in an adjustment, at its solution. Level is about east and north.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OrientationSummary {
    /// How many take part.
    pub photos: usize,
    /// What all are off by against the adjusted block, about east, north and up, degrees.
    pub mean_correction_deg: [f64; 3],
    /// By how much each camera hangs from where its gimbal points, degrees; 0 for a camera without orientations.
    pub mount_deg: Vec<f64>,
    /// Root mean square of what is left about east and north, each, degrees.
    pub level_rms_deg: f64,
    /// Root mean square of what is left of headings, degrees.
    pub heading_rms_deg: f64,
    /// Standard deviation that single ones have in the adjustment about east and north, degrees.
    pub level_sigma_deg: f64,
    /// Standard deviation that single headings have in the adjustment, degrees.
    pub heading_sigma_deg: f64,
    /// How far all together contradict the level of the block, in standard deviations.
    pub contradiction_sigmas: f64,
}

/// What was found of orientations before an adjustment.
#[derive(Debug, Clone, PartialEq)]
pub struct OrientationReview {
    /// How many were compared.
    pub compared: usize,
    /// Images whose orientations are far out, with the angle, radians.
    pub outliers: Vec<(u32, f64)>,
    /// How they scatter about east and north and in heading, radians.
    pub scatter_rad: [f64; 2],
    /// Whether none of them is to be believed.
    pub is_contradiction: bool,
}

/// An image's rotation in the block and the observed one.
struct Pairing<'a> {
    rotation: Quaternion,
    camera: usize,
    observed: &'a CameraOrientation,
}

struct Fit {
    turn: Quaternion,
    /// Covariance of the turn about east and north.
    level_covariance: Matrix2<f64>,
    /// Of each camera.
    mounts: Vec<Vector3<f64>>,
    left: Vec<Vector3<f64>>,
    /// About east and north, and in heading.
    scatter_rad: [f64; 2],
}

fn angle(v: [f64; 3]) -> f64 {
    Vector3::from(v).norm()
}

/// `R_i^T exp(-b) R_i0`.
fn turn_of_observed(pairing: &Pairing<'_>, mount: Vector3<f64>) -> Quaternion {
    let hung = rotation::multiply(rotation::exp((-mount).into()), pairing.observed.rotation);
    rotation::multiply(rotation::inverse(pairing.rotation), hung)
}

/// The turn of one of the images that is nearest to those of half of them.
fn start(pairings: &[Pairing<'_>]) -> Quaternion {
    let turns: Vec<Quaternion> =
        pairings.iter().map(|pairing| turn_of_observed(pairing, Vector3::zeros())).collect();
    let every = turns.len().div_ceil(MAX_STARTS);
    let spread = |turn: &Quaternion| {
        let back = rotation::inverse(*turn);
        let apart =
            turns.iter().map(|other| angle(rotation::log(rotation::multiply(back, *other))));
        median(apart).unwrap_or(f64::INFINITY)
    };
    let starts = turns.iter().step_by(every).map(|turn| (spread(turn), *turn));
    starts.min_by(|a, b| a.0.total_cmp(&b.0)).map_or([1.0, 0.0, 0.0, 0.0], |(_, turn)| turn)
}

fn scatter(left: &[Vector3<f64>], stated: [f64; 2]) -> [f64; 2] {
    let level = left.iter().flat_map(|e| [e[0], e[1]]);
    let heading = left.iter().map(|e| e[2]);
    [
        sigma_of_errors(level).unwrap_or(0.0).max(stated[0]),
        sigma_of_errors(heading).unwrap_or(0.0).max(stated[1]),
    ]
}

/// Medians of the stated standard deviations, about east and in heading.
fn stated_sigmas_rad(pairings: &[Pairing<'_>]) -> [f64; 2] {
    [0, 2].map(|k| median(pairings.iter().map(|p| p.observed.sigma_rad[k])).unwrap_or(0.0))
}

/// Fits what orientations have in common.
fn fit(pairings: &[Pairing<'_>], cameras: usize) -> Option<Fit> {
    let stated = stated_sigmas_rad(pairings);
    let mut turn = start(pairings);
    let mut level_covariance = Matrix2::zeros();
    let mut mounts = vec![Vector3::zeros(); cameras];
    let n = 3 + 3 * cameras;
    let errors = |turn: Quaternion, mounts: &[Vector3<f64>]| -> Vec<Vector3<f64>> {
        let back = rotation::inverse(turn);
        let of = |p: &Pairing<'_>| {
            rotation::log(rotation::multiply(back, turn_of_observed(p, mounts[p.camera]))).into()
        };
        pairings.iter().map(of).collect()
    };
    let mut left = errors(turn, &mounts);
    for _ in 0..10 {
        let sigma = scatter(&left, stated);
        let mut normal = DMatrix::<f64>::zeros(n, n);
        let mut sum = DVector::<f64>::zeros(n);
        for (pairing, e) in pairings.iter().zip(&left) {
            let weights = Vector3::new(sigma[0], sigma[0], sigma[1]).map(|s| s.powi(-2));
            let far = e.component_mul(&weights.map(f64::sqrt)).norm();
            let huber = (2.0 / far.max(1e-12)).min(1.0);
            let back =
                rotation::multiply(rotation::inverse(turn), rotation::inverse(pairing.rotation));
            let rows = rotation::matrix(back);
            let by_mount = Matrix3::from_fn(|r, c| rows[r][c]);
            let mut j = DMatrix::<f64>::zeros(3, n);
            j.view_mut((0, 0), (3, 3)).fill_with_identity();
            j.view_mut((0, 3 + 3 * pairing.camera), (3, 3)).copy_from(&by_mount);
            let weighted =
                DMatrix::from_diagonal(&DVector::from_column_slice((huber * weights).as_slice()))
                    * &j;
            normal += j.transpose() * &weighted;
            sum += weighted.transpose() * DVector::from_column_slice(e.as_slice());
        }
        for (camera, mount) in mounts.iter().enumerate() {
            for k in 0..3 {
                let at = 3 + 3 * camera + k;
                normal[(at, at)] += BORESIGHT_SIGMA_RAD.powi(-2);
                sum[at] -= mount[k] * BORESIGHT_SIGMA_RAD.powi(-2);
            }
        }
        let factor = normal.cholesky()?;
        let step = factor.solve(&sum);
        level_covariance = factor.inverse().fixed_view::<2, 2>(0, 0).into_owned();
        turn = rotation::normalize(rotation::multiply(
            turn,
            rotation::exp([step[0], step[1], step[2]]),
        ));
        for (camera, mount) in mounts.iter_mut().enumerate() {
            *mount += step.fixed_rows::<3>(3 + 3 * camera);
        }
        left = errors(turn, &mounts);
    }
    let scatter_rad = scatter(&left, [0.0; 2]);
    Some(Fit { turn, level_covariance, mounts, left, scatter_rad })
}

/// Compares orientations with a block in any frame: takes out those that are wrong, all where they contradict it, and gives the
/// others the standard deviation with which they scatter where that is larger than the stated one.
pub fn review_orientations(block: &Block<'_>, known: &mut Known) -> Option<OrientationReview> {
    let pairings: Vec<Pairing<'_>> = known
        .orientations
        .iter()
        .filter_map(|observed| {
            let rotation = (*block.poses.get(observed.image as usize)?)?.rotation;
            let camera = block.features[observed.image as usize].camera;
            Some(Pairing { rotation, camera, observed })
        })
        .collect();
    if pairings.len() < MIN_ORIENTATIONS {
        return None;
    }
    let fit = fit(&pairings, block.cameras.len())?;
    let stated = stated_sigmas_rad(&pairings);
    let sigma: [f64; 2] = std::array::from_fn(|k| fit.scatter_rad[k].max(stated[k]));
    let wrong = pairings.iter().zip(&fit.left).filter(|(_, e)| {
        e[0].hypot(e[1]) > OUTLIER_SIGMAS * sigma[0] || e[2].abs() > OUTLIER_SIGMAS * sigma[1]
    });
    let outliers: Vec<(u32, f64)> = wrong.map(|(p, e)| (p.observed.image, e.norm())).collect();
    let compared = pairings.len();
    let is_contradiction = outliers.len() as f64 > MAX_WRONG_SHARE * compared as f64
        || (0..2).any(|k| fit.scatter_rad[k] > SCATTER_RATIO * stated[k]);
    let larger: [f64; 2] = std::array::from_fn(|k| (sigma[k] / stated[k].max(1e-9)).max(1.0));
    if is_contradiction {
        known.orientations.clear();
    }
    known
        .orientations
        .retain(|observed| !outliers.iter().any(|(image, _)| *image == observed.image));
    for observed in &mut known.orientations {
        for (k, sigma) in observed.sigma_rad.iter_mut().enumerate() {
            *sigma *= larger[usize::from(k == 2)];
        }
    }
    let scatter_rad = fit.scatter_rad;
    Some(OrientationReview { compared, outliers, scatter_rad, is_contradiction })
}

/// The orientations of an adjusted block in the mapping frame.
pub fn summarize_orientations(scene: &Reconstruction) -> Option<OrientationSummary> {
    let pairings: Vec<Pairing<'_>> = scene
        .orientations
        .iter()
        .map(|observed| {
            let image = &scene.images[observed.image as usize];
            Pairing { rotation: image.pose.rotation, camera: image.camera, observed }
        })
        .collect();
    if pairings.is_empty() {
        return None;
    }
    let fit = fit(&pairings, scene.cameras.len())?;
    let count = pairings.len() as f64;
    let stated = stated_sigmas_rad(&pairings);
    let common = Vector3::from(rotation::log(fit.turn));
    let mean = |square: &dyn Fn(&Vector3<f64>) -> f64| {
        (fit.left.iter().map(square).sum::<f64>() / count).sqrt().to_degrees()
    };
    let level = Vector2::new(common[0], common[1]);
    let expected = fit.level_covariance + ATTITUDE_BIAS_SIGMA_RAD[0].powi(2) * Matrix2::identity();
    let weight = expected.try_inverse().unwrap_or_else(Matrix2::zeros);
    Some(OrientationSummary {
        photos: pairings.len(),
        mean_correction_deg: common.map(f64::to_degrees).into(),
        mount_deg: fit.mounts.iter().map(|mount| mount.norm().to_degrees()).collect(),
        level_rms_deg: mean(&|e| 0.5 * (e[0] * e[0] + e[1] * e[1])),
        heading_rms_deg: mean(&|e| e[2] * e[2]),
        level_sigma_deg: stated[0].to_degrees(),
        heading_sigma_deg: stated[1].to_degrees(),
        contradiction_sigmas: level.dot(&(weight * level)).sqrt(),
    })
}
