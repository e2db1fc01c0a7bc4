//! What single photos found, judged by all of them: rays of one target meet in a point, and the points of all targets are off
//! their surveyed places by the same shift, that grows at most linearly over the block.
//!
//! ```text
//! X_t = S_t + d + D (S_t - mean S) + e_t
//! ```
//!
//! `S` are surveyed places, `X` those of the block, whose frame may be metres off where only GNSS holds it.

use super::search::Candidate;
use crate::{
    camera::Lens,
    mapping::View as PhotoView,
    scene::Reconstruction,
    sfm::triangulate::{TriangulationOptions, View, error_px, triangulate},
};
use nalgebra::{Matrix3, Matrix3x1, SMatrix};
use rowgram_optim::robust;

/// A candidate of a target in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sight {
    pub(super) image: usize,
    pub(super) candidate: Candidate,
    /// Where its ray meets the ground, less the surveyed place, metres.
    pub(super) offset_m: [f64; 2],
}

/// A target in the block.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Located {
    pub(super) position_m: [f64; 3],
    /// Indices of the candidates that show it, one of an image.
    pub(super) members: Vec<usize>,
}

/// Where the ray of a pixel meets a level, less a place.
pub(super) fn offset_m(view: &PhotoView, at_px: [f64; 2], place_m: [f64; 3]) -> Option<[f64; 2]> {
    let (from, direction) = view.ray(at_px)?;
    let reach = (place_m[2] - from[2]) / direction[2];
    (reach.is_finite() && reach > 0.0)
        .then(|| [0, 1].map(|k| from[k] + reach * direction[k] - place_m[k]))
}

fn apart(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The shift in plan that most targets in most images agree with, to `tolerance_m`, and the sum of the scores that do.
pub(super) fn common_shift(targets: &[Vec<Sight>], tolerance_m: f64) -> Option<([f64; 2], f64)> {
    // What agrees in one image of one target counts once.
    let support = |shift: [f64; 2]| {
        let mut sum = 0.0;
        for sights in targets {
            let mut of_image: Option<(usize, f64)> = None;
            for sight in sights {
                if of_image.is_some_and(|(image, _)| image != sight.image) {
                    sum += of_image.take().map_or(0.0, |(_, score)| score);
                }
                let best = of_image.map_or(0.0, |(_, score)| score);
                let off = apart(sight.offset_m, shift) / tolerance_m;
                // Nearer ones count more, so that the middle of a cluster wins.
                let score = (1.0 - off * off).max(0.0) * sight.candidate.fit.score;
                of_image = Some((sight.image, best.max(score)));
            }
            sum += of_image.map_or(0.0, |(_, score)| score);
        }
        sum
    };
    let mut best: Option<([f64; 2], f64)> = None;
    for sight in targets.iter().flatten() {
        let sum = support(sight.offset_m);
        if best.is_none_or(|(_, most)| sum > most) {
            best = Some((sight.offset_m, sum));
        }
    }
    let (mut shift, mut sum) = best?;
    for _ in 0..3 {
        let near = targets.iter().flatten().filter(|s| apart(s.offset_m, shift) < tolerance_m);
        let near: Vec<[f64; 2]> = near.map(|sight| sight.offset_m).collect();
        let middle = |k: usize| robust::median(near.iter().map(|offset| offset[k]));
        let (Some(x), Some(y)) = (middle(0), middle(1)) else { break };
        let next = support([x, y]);
        if next <= sum {
            break;
        }
        (shift, sum) = ([x, y], next);
    }
    Some((shift, sum))
}

/// Pairs of candidates from which a target's place is tried, at most, the best first: bounds the time where many photos show a target.
const MAX_PAIRS: usize = 400;
/// Rays that are more nearly parallel do not determine a place, radians (1.7 degrees; assumed).
const MIN_ANGLE_RAD: f64 = 0.03;

/// The place that the rays of most images meet in.
pub(super) fn locate(
    reconstruction: &Reconstruction,
    sights: &[Sight],
    tolerance_px: f64,
) -> Option<Located> {
    let views: Vec<View<'_>> = sights
        .iter()
        .map(|sight| {
            let image_px = sight.candidate.fit.centre_px;
            let camera = reconstruction.images[sight.image].camera;
            View {
                pose: reconstruction.pose_at(sight.image, image_px[1]),
                lens: &reconstruction.cameras[camera].interior,
                image_px,
            }
        })
        .collect();
    let demands = TriangulationOptions { tolerance_px, min_angle_rad: MIN_ANGLE_RAD };
    let score = |k: usize| sights[k].candidate.fit.score;
    // The best of each image that is near enough.
    let members = |point: [f64; 3]| {
        let mut members: Vec<usize> = Vec::new();
        for k in 0..sights.len() {
            let Some(off) = error_px(&views[k], point).filter(|&off| off <= tolerance_px) else {
                continue;
            };
            match members.last().copied().filter(|&last| sights[last].image == sights[k].image) {
                Some(last) if error_px(&views[last], point).is_some_and(|other| off < other) => {
                    members.pop();
                    members.push(k);
                }
                Some(_) => {}
                None => members.push(k),
            }
        }
        members
    };
    let mut pairs: Vec<(usize, usize)> = (1..sights.len())
        .flat_map(|j| (0..j).map(move |i| (i, j)))
        .filter(|&(i, j)| sights[i].image != sights[j].image)
        .collect();
    pairs.sort_by(|a, b| {
        (score(b.0) + score(b.1)).total_cmp(&(score(a.0) + score(a.1))).then(a.cmp(b))
    });
    let mut best: Option<(f64, Vec<usize>)> = None;
    for (i, j) in pairs.into_iter().take(MAX_PAIRS) {
        let Some((point, _)) = triangulate(&[views[i], views[j]], &demands) else { continue };
        let found = members(point);
        let sum: f64 = found.iter().map(|&k| score(k)).sum();
        if found.len() >= 2 && best.as_ref().is_none_or(|(most, _)| sum > *most) {
            best = Some((sum, found));
        }
    }
    let (_, chosen) = best?;
    let of: Vec<View<'_>> = chosen.iter().map(|&k| views[k]).collect();
    let (position_m, _) = triangulate(&of, &demands)?;
    let members = members(position_m);
    (members.len() >= 2).then_some(Located { position_m, members })
}

/// How far a measurement is from where the block has the target, pixels.
pub(super) fn residual_px(
    reconstruction: &Reconstruction,
    image: usize,
    image_px: [f64; 2],
    position_m: [f64; 3],
) -> Option<f64> {
    let lens = &reconstruction.cameras[reconstruction.images[image].camera].interior;
    let [u, v] = lens.project(reconstruction.pose_at(image, image_px[1]).to_camera(position_m))?;
    Some((u - image_px[0]).hypot(v - image_px[1]))
}

/// How the block differs from the survey.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FrameOffset {
    middle_m: [f64; 2],
    /// For each coordinate: the shift, and its change with easting and northing.
    terms: [[f64; 3]; 3],
    /// Standard deviation of what is left, metres.
    pub(super) sigma_m: f64,
}

/// Targets from which on the difference may change over the block: its three terms and two more.
const MIN_FOR_SLOPE: usize = 5;

impl FrameOffset {
    /// Whether targets of this size agree about it. Where a block without control is bent by more than its targets are wide, anything that looks like
    /// a target agrees: on Swindale, aligned by its camera positions alone, a scatter of 1.0 and 1.2 sizes let grass be measured. The limit is below
    /// these two; it was not chosen by an experiment.
    pub(super) fn is_consistent(&self, size_m: f64) -> bool {
        const MAX_SCATTER_SIZES: f64 = 0.5;
        self.sigma_m <= MAX_SCATTER_SIZES * size_m
    }

    /// The same shift everywhere.
    pub(super) fn constant(shift_m: [f64; 3], sigma_m: f64) -> FrameOffset {
        FrameOffset { middle_m: [0.0; 2], terms: shift_m.map(|d| [d, 0.0, 0.0]), sigma_m }
    }

    /// Of places and their differences, robustly (iteratively reweighted least squares, Cauchy weights).
    pub(super) fn of(places: &[([f64; 3], [f64; 3])]) -> Option<FrameOffset> {
        let middle = |k: usize| robust::median(places.iter().map(|(at, _)| at[k]));
        let middle_m = [middle(0)?, middle(1)?];
        let shift = |k: usize| robust::median(places.iter().map(|(_, d)| d[k]));
        let mut offset = FrameOffset::constant([shift(0)?, shift(1)?, shift(2)?], 0.0);
        offset.middle_m = middle_m;
        for _ in 0..8 {
            let left: Vec<f64> = places.iter().map(|(at, d)| offset.deviation_m(*at, *d)).collect();
            offset.sigma_m = robust::median(left.iter().copied()).unwrap_or(0.0).max(1e-3);
            if places.len() < MIN_FOR_SLOPE {
                break;
            }
            let mut normal = Matrix3::zeros();
            let mut right = SMatrix::<f64, 3, 3>::zeros();
            for ((at, d), left) in places.iter().zip(&left) {
                let row = Matrix3x1::new(1.0, at[0] - middle_m[0], at[1] - middle_m[1]);
                let weight = 1.0 / (1.0 + (left / (2.0 * offset.sigma_m)).powi(2));
                normal += weight * row * row.transpose();
                right += weight * row * SMatrix::<f64, 1, 3>::from_row_slice(d);
            }
            // Targets in a line do not determine a slope across it.
            let Some(terms) = normal.cholesky().map(|of| of.solve(&right)) else { break };
            offset.terms = std::array::from_fn(|k| std::array::from_fn(|i| terms[(i, k)]));
        }
        Some(offset)
    }

    /// At a surveyed place.
    pub(super) fn at_m(&self, at_m: [f64; 3]) -> [f64; 3] {
        let [x, y] = [0, 1].map(|k| at_m[k] - self.middle_m[k]);
        self.terms.map(|[constant, east, north]| constant + east * x + north * y)
    }

    /// What is left of a difference, metres.
    pub(super) fn deviation_m(&self, at_m: [f64; 3], difference_m: [f64; 3]) -> f64 {
        let expected = self.at_m(at_m);
        (0..3).map(|k| (difference_m[k] - expected[k]).powi(2)).sum::<f64>().sqrt()
    }

    /// In the middle.
    pub(super) fn shift_m(&self) -> [f64; 3] {
        self.terms.map(|terms| terms[0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shift_that_grows_over_the_block_is_found_beside_a_wrong_target() {
        let places: Vec<([f64; 3], [f64; 3])> = (0..9)
            .map(|k| {
                let at = [f64::from(k % 3) * 40.0, f64::from(k / 3) * 30.0, 2.0];
                let wrong = if k == 4 { 3.0 } else { 0.0 };
                (at, [2.0 + 0.001 * at[0], -1.0 + wrong, 5.0 - 0.002 * at[1]])
            })
            .collect();
        let offset = FrameOffset::of(&places).unwrap();
        for (k, (at, d)) in places.iter().enumerate() {
            let left = offset.deviation_m(*at, *d);
            assert!(if k == 4 { left > 2.5 } else { left < 0.05 }, "{k}: {left}");
        }
    }
}
