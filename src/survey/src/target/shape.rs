//! Whether a place of a picture is the corner of a chessboard, by what a ring around it shows:
//! dark, bright, dark, bright, with the borders on two nearly straight lines.

use super::grey::Grey;
use std::f64::consts::{PI, TAU};

/// A candidate: where dark and bright meet twice.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Corner {
    /// Column and row, in pixels of the level on which it was found.
    pub(super) at: [f64; 2],
    /// Angles of the four edges, ascending, in radians from `u` towards `v`.
    pub(super) edges: [f64; 4],
    /// Whether it becomes brighter when edge 0 is crossed towards larger angles; the others
    /// alternate.
    pub(super) first_rises: bool,
    /// Difference between the brightest and the darkest place of the ring.
    pub(super) contrast: f64,
}

impl Corner {
    /// Whether it becomes brighter when `edge` is crossed towards larger angles.
    #[inline]
    pub(super) fn rises(&self, edge: usize) -> bool {
        edge.is_multiple_of(2) == self.first_rises
    }

    /// The edge nearest to `angle`, and how far off it is.
    #[inline]
    pub(super) fn nearest_edge(&self, angle: f64) -> (usize, f64) {
        let mut nearest = (0, f64::INFINITY);
        for (k, edge) in self.edges.iter().enumerate() {
            let off = difference(*edge, angle);
            if off < nearest.1 {
                nearest = (k, off);
            }
        }
        nearest
    }
}

/// The angle between two directions, from 0 to pi.
#[inline]
pub(super) fn difference(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(TAU);
    d.min(TAU - d)
}

/// Places on a ring.
const SAMPLES: usize = 32;
/// Less difference than this between bright and dark is noise, in grey values.
const MIN_CONTRAST: f64 = 10.0;
/// The narrowest sector: a board that is seen at some 75 degrees from straight on.
const MIN_SECTOR_RAD: f64 = 0.24;
/// How far from a straight line two opposite edges may be: blur, noise, a wide lens.
const MAX_BEND_RAD: f64 = 0.5;

/// Rings of directions, made once.
#[derive(Debug)]
pub(super) struct Ring([[f64; 2]; SAMPLES]);

impl Ring {
    pub(super) fn new() -> Ring {
        Ring(std::array::from_fn(|k| {
            let (sine, cosine) = (TAU * k as f64 / SAMPLES as f64).sin_cos();
            [cosine, sine]
        }))
    }

    /// The corner at `at`, if a ring of `radius_px` around it looks like one.
    pub(super) fn corner(&self, picture: &Grey, at: [f64; 2], radius_px: f64) -> Option<Corner> {
        let mut values = [0.0; SAMPLES];
        for (value, direction) in values.iter_mut().zip(&self.0) {
            *value = picture
                .sample([at[0] + radius_px * direction[0], at[1] + radius_px * direction[1]])?;
        }
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let contrast = high - low;
        if contrast < MIN_CONTRAST {
            return None;
        }
        let middle = 0.5 * (low + high);
        let mut edges = [0.0; 4];
        let mut first_rises = false;
        let mut count = 0;
        for k in 0..SAMPLES {
            let (here, next) = (values[k] - middle, values[(k + 1) % SAMPLES] - middle);
            if (here >= 0.0) == (next >= 0.0) {
                continue;
            }
            if count == 4 {
                return None;
            }
            if count == 0 {
                first_rises = next >= 0.0;
            }
            edges[count] = (k as f64 + here / (here - next)) * TAU / SAMPLES as f64;
            count += 1;
        }
        if count != 4 {
            return None;
        }
        let narrow = (0..4).any(|k| {
            let sector = (edges[(k + 1) % 4] - edges[k]).rem_euclid(TAU);
            sector < MIN_SECTOR_RAD
        });
        let bent = (0..2).any(|k| (edges[k + 2] - edges[k] - PI).abs() > MAX_BEND_RAD);
        if !evenly_lit(&values, middle) {
            return None;
        }
        // The place itself is on the border, between bright and dark.
        let centre = (picture.sample(at)? - middle).abs();
        if narrow || bent || centre > 0.45 * contrast {
            return None;
        }
        Some(Corner { at, edges, first_rises, contrast })
    }
}

/// Whether the two bright sectors are alike and the two dark ones: where a third tone meets two,
/// at the rim of a board for instance, they are not.
fn evenly_lit(values: &[f64; SAMPLES], middle: f64) -> bool {
    let first = (0..SAMPLES)
        .find(|&k| (values[k] >= middle) != (values[(k + SAMPLES - 1) % SAMPLES] >= middle))
        .unwrap_or(0);
    // The mean of each run between two changes.
    let mut means = [0.0; 4];
    let (mut sector, mut sum, mut count) = (0, 0.0, 0.0);
    for k in first..first + SAMPLES {
        let (value, next) = (values[k % SAMPLES], values[(k + 1) % SAMPLES]);
        sum += value;
        count += 1.0;
        if (value >= middle) != (next >= middle) {
            means[sector % 4] = sum / count;
            (sector, sum, count) = (sector + 1, 0.0, 0.0);
        }
    }
    let (a, b) = (means[0].min(means[2]), means[0].max(means[2]));
    let (c, d) = (means[1].min(means[3]), means[1].max(means[3]));
    let (gap, span) = if a > c { (a - d, b - c) } else { (c - b, d - a) };
    gap > MIN_EVENNESS * span
}

/// The least share of the whole span of the four sectors that must lie between bright and dark.
const MIN_EVENNESS: f64 = 0.5;

/// Most candidates of a level that are looked at, the strongest of them.
const MAX_SADDLES: usize = 60_000;
/// Most that may pass; a board has some hundred.
const MAX_CORNERS: usize = 4_000;

/// The corners of a picture, in the order of their rows.
pub(super) fn corners(blurred: &Grey, ring: &Ring) -> Vec<Corner> {
    use rayon::prelude::*;
    let response = blurred.saddle_response();
    let (width, height) = (blurred.width, blurred.height);
    let margin = 4;
    if width <= 2 * margin || height <= 2 * margin {
        return Vec::new();
    }
    // A step of contrast c, blurred by s, has mixed second differences up to c / (2 pi s^2).
    let least = (0.3 * MIN_CONTRAST / (TAU * 1.25 * 1.25)).powi(2) as f32;
    let mut saddles: Vec<(f32, u32)> = (margin..height - margin)
        .into_par_iter()
        .flat_map_iter(|v| {
            let response = &response;
            (margin..width - margin).filter_map(move |u| {
                let at = v * width + u;
                let value = response[at];
                (value > least && is_maximum(response, width, at)).then_some((value, at as u32))
            })
        })
        .collect();
    if saddles.len() > MAX_SADDLES {
        saddles.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        saddles.truncate(MAX_SADDLES);
        saddles.sort_by_key(|saddle| saddle.1);
    }
    let mut found: Vec<Corner> = saddles
        .par_iter()
        .filter_map(|&(_, at)| {
            let at = saddle_point(blurred, at as usize % width, at as usize / width)?;
            RADII_PX.iter().find_map(|&radius| ring.corner(blurred, at, radius))
        })
        .collect();
    if found.len() > MAX_CORNERS {
        let mut order: Vec<usize> = (0..found.len()).collect();
        order.sort_by(|&a, &b| found[b].contrast.total_cmp(&found[a].contrast).then(a.cmp(&b)));
        order.truncate(MAX_CORNERS);
        order.sort_unstable();
        found = order.into_iter().map(|k| found[k]).collect();
    }
    found
}

/// Rings that are tried: large ones give better angles, small squares need small ones.
const RADII_PX: [f64; 3] = [5.0, 3.5, 2.5];

/// Whether no value within two pixels is larger; of equal ones the first counts.
fn is_maximum(response: &[f32], width: usize, at: usize) -> bool {
    let value = response[at];
    for dv in 0..5 {
        let start = at + dv * width - 2 * width - 2;
        for (du, &other) in response[start..start + 5].iter().enumerate() {
            let before = (dv, du) < (2, 2);
            if other > value || (before && other == value) {
                return false;
            }
        }
    }
    true
}

/// The stationary point of the second-order expansion at a pixel, if it is near.
fn saddle_point(picture: &Grey, u: usize, v: usize) -> Option<[f64; 2]> {
    let value =
        |du: usize, dv: usize| f64::from(picture.data[(v + dv - 1) * picture.width + u + du - 1]);
    let gradient = [0.5 * (value(2, 1) - value(0, 1)), 0.5 * (value(1, 2) - value(1, 0))];
    let xx = value(0, 1) - 2.0 * value(1, 1) + value(2, 1);
    let yy = value(1, 0) - 2.0 * value(1, 1) + value(1, 2);
    let xy = 0.25 * (value(0, 0) - value(2, 0) - value(0, 2) + value(2, 2));
    let determinant = xx * yy - xy * xy;
    if determinant >= 0.0 {
        return None;
    }
    let du = -(yy * gradient[0] - xy * gradient[1]) / determinant;
    let dv = -(xx * gradient[1] - xy * gradient[0]) / determinant;
    (du.abs() <= 1.5 && dv.abs() <= 1.5).then_some([u as f64 + du, v as f64 + dv])
}
