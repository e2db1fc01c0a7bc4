//! From matches to oriented pairs, and the principal distance where nobody knows it.

use super::{
    block::{Features, Pair},
    relative::{Correspondence, Ray, RelativePoseOptions, Solver, estimate, vector},
};
use crate::camera::{Camera, Interior, Lens};
use rayon::prelude::*;

/// Matches of two images, as they come from comparing descriptors.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PairMatches {
    /// Indices of the images, ascending.
    pub images: [u32; 2],
    /// Which features match, `[in the first, in the second]`.
    pub matches: Vec<[u32; 2]>,
}

/// How pairs are oriented.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeometricVerificationOptions {
    /// Which minimal solver.
    pub solver: Solver,
    /// Distance from co-planarity up to which a match is right, pixels.
    pub tolerance_px: f64,
    /// A pair with fewer right matches is none.
    pub min_inliers: usize,
    /// A pair with a smaller share of right matches is none.
    pub min_share: f64,
    /// The most samples of each solver for a pair.
    pub max_samples: usize,
    /// Seed of all sampling.
    pub seed: u64,
}

impl Default for GeometricVerificationOptions {
    fn default() -> GeometricVerificationOptions {
        GeometricVerificationOptions {
            solver: Solver::Auto,
            tolerance_px: 4.0,
            min_inliers: 15,
            min_share: 0.1,
            max_samples: 3000,
            seed: 1,
        }
    }
}

/// Rays of all features of an image, free of distortion; none where the lens has none.
pub fn rays(features: &Features, lens: &Interior) -> Vec<Option<Ray>> {
    features
        .positions_px
        .iter()
        .map(|&position| {
            let [x, y, z] = lens.unproject(position)?;
            (z < -1e-3).then(|| [x / -z, y / -z])
        })
        .collect()
}

/// Rays of all features of all images.
pub(super) fn all_rays(features: &[Features], cameras: &[Camera]) -> Vec<Vec<Option<Ray>>> {
    let of = |one: &Features| rays(one, &cameras[one.camera].interior);
    features.par_iter().map(of).collect()
}

/// The principal distance of the finer of two photos, which decides what a pixel is.
pub(super) fn finer_px(cameras: [&Camera; 2]) -> f64 {
    let [a, b] = cameras.map(|camera| camera.interior.principal_distance_px());
    a.max(b)
}

/// Orients one pair; `None` where too few matches agree.
pub(super) fn orient_matched(
    matched: &PairMatches,
    [first, second]: [&[Option<Ray>]; 2],
    principal_distance_px: f64,
    verifying: &GeometricVerificationOptions,
) -> Option<Pair> {
    let mut places = Vec::with_capacity(matched.matches.len());
    let mut correspondences = Vec::with_capacity(matched.matches.len());
    for (k, [a, b]) in matched.matches.iter().enumerate() {
        if let (Some(first), Some(second)) = (first[*a as usize], second[*b as usize]) {
            places.push(k);
            correspondences.push(Correspondence { first, second });
        }
    }
    let options = RelativePoseOptions {
        solver: verifying.solver,
        tolerance: verifying.tolerance_px / principal_distance_px,
        min_inliers: verifying.min_inliers,
        max_samples: verifying.max_samples,
        ..RelativePoseOptions::default()
    };
    let [a, b] = matched.images;
    let seed =
        verifying.seed ^ (u64::from(a) << 32 | u64::from(b)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let found = estimate(&correspondences, &options, seed)?;
    let share = found.inliers.len() as f64 / correspondences.len() as f64;
    if share < verifying.min_share {
        return None;
    }
    let mut angles: Vec<f64> = found
        .inliers
        .iter()
        .map(|&k| {
            let c = &correspondences[k as usize];
            (found.pose.rotation * vector(c.first)).angle(&vector(c.second))
        })
        .collect();
    angles.sort_by(f64::total_cmp);
    Some(Pair {
        images: matched.images,
        matches: found.inliers.iter().map(|&k| matched.matches[places[k as usize]]).collect(),
        pose: found.pose,
        solver: found.solver,
        angle_rad: angles[angles.len() / 2],
    })
}

/// Orients all pairs, in the order in which they come; those of which too few matches agree are
/// left out. `tell` is called for each.
pub fn orient_pairs(
    features: &[Features],
    cameras: &[Camera],
    matched: &[PairMatches],
    verifying: &GeometricVerificationOptions,
    tell: &(dyn Fn() + Sync),
) -> Vec<Pair> {
    let rays = all_rays(features, cameras);
    let oriented: Vec<Option<Pair>> = matched
        .par_iter()
        .map(|matched| {
            let [a, b] = matched.images.map(|k| k as usize);
            let c = finer_px([a, b].map(|k| &cameras[features[k].camera]));
            let pair = orient_matched(matched, [&rays[a], &rays[b]], c, verifying);
            tell();
            pair
        })
        .collect();
    oriented.into_iter().flatten().collect()
}

/// How much of the matches of some pairs agrees with each of some lenses: the mean share of right
/// matches, oriented by five points. Of pairs with very many matches a few hundred speak for all.
pub fn shares_by_lens(
    features: &[Features],
    matched: &[PairMatches],
    lenses: &[Interior],
    verifying: &GeometricVerificationOptions,
) -> Vec<f64> {
    let five = GeometricVerificationOptions {
        solver: Solver::FivePoint,
        max_samples: ENOUGH_SAMPLES,
        ..*verifying
    };
    // Only what is matched is sent through every lens.
    let few: Vec<(PairMatches, [Features; 2])> = matched
        .iter()
        .map(|pair| {
            let step = pair.matches.len().div_ceil(ENOUGH_MATCHES).max(1);
            let of_side = |side: usize| {
                let positions = &features[pair.images[side] as usize].positions_px;
                let kept = pair.matches.iter().step_by(step);
                let positions_px = kept.map(|m| positions[m[side] as usize]).collect();
                Features { positions_px, ..Features::default() }
            };
            let features = [of_side(0), of_side(1)];
            let matches = (0..features[0].positions_px.len() as u32).map(|k| [k, k]).collect();
            (PairMatches { images: pair.images, matches }, features)
        })
        .collect();
    lenses
        .par_iter()
        .map(|lens| {
            let share = |(pair, features): &(PairMatches, [Features; 2])| {
                let of = [0, 1].map(|side| rays(&features[side], lens));
                let c = lens.principal_distance_px();
                orient_matched(pair, [&of[0], &of[1]], c, &five)
                    .map_or(0.0, |found| found.matches.len() as f64 / pair.matches.len() as f64)
            };
            few.iter().map(share).sum::<f64>() / few.len().max(1) as f64
        })
        .collect()
}

/// Matches of a pair by which lenses are compared.
const ENOUGH_MATCHES: usize = 250;
/// Samples of each; a lens under which that many find nothing is the wrong one.
const ENOUGH_SAMPLES: usize = 300;
