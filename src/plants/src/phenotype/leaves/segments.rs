//! Segments: adjacent slices of similar direction.
//!
//! A plant pixel takes direction and width from the narrowest slices through it (within a third of the
//! narrowest), which at a crossing are those of the leaf that is seen whole. Neighbouring pixels whose
//! directions differ by less than `T_b` (mod pi) belong to one segment.

use super::{
    axis::Axis,
    part::Local,
    slices::{Slices, tilt},
};
use rowgram_base::disjoint_sets::DisjointSets;

/// Number of no pixel, no segment.
pub(super) const NONE: u32 = u32::MAX;

/// Slices that are wider than the narrowest through a pixel by this factor say nothing about it.
const SIMILAR: f64 = 4.0 / 3.0;

/// Direction and width of the leaf at each plant pixel; NaN where no slice passes.
pub(super) struct Across {
    pub(super) theta: Vec<f32>,
    pub(super) width: Vec<f32>,
}

impl Across {
    /// From the slices not wider than `widest_px`.
    pub(super) fn of(pixels: usize, slices: &Slices, widest_px: f64) -> Across {
        let mut narrowest = vec![f64::INFINITY; pixels];
        let used = || slices.all.iter().filter(|slice| slice.width <= widest_px);
        for slice in used() {
            for &pixel in &slices.walked[slice.first as usize..slice.end as usize] {
                let width = &mut narrowest[pixel as usize];
                *width = width.min(slice.width);
            }
        }
        // Directions without sense are averaged at twice the angle.
        let mut sums = vec![[0.0; 4]; pixels];
        for slice in used() {
            let (sin, cos) = (2.0 * slice.theta).sin_cos();
            for &pixel in &slices.walked[slice.first as usize..slice.end as usize] {
                if slice.width <= SIMILAR * narrowest[pixel as usize] {
                    let sum = &mut sums[pixel as usize];
                    for (sum, term) in sum.iter_mut().zip([cos, sin, slice.width, 1.0]) {
                        *sum += term;
                    }
                }
            }
        }
        let some = |sum: &[f64; 4], value: f64| if sum[3] > 0.0 { value as f32 } else { f32::NAN };
        Across {
            theta: sums.iter().map(|sum| some(sum, 0.5 * sum[1].atan2(sum[0]))).collect(),
            width: sums.iter().map(|sum| some(sum, sum[2] / sum[3])).collect(),
        }
    }
}

/// A set of pixels with one axis.
#[derive(Debug, Clone)]
pub(super) struct Segment {
    /// Local pixels, ascending.
    pub(super) pixels: Vec<u32>,
    pub(super) axis: Axis,
}

/// The segments of a part, ordered by their first pixels.
///
/// A set of pixels that is not longer than wide has no direction of its own and is no segment.
pub(super) fn merge(local: &Local, across: &Across, number: &[u32], t_b: f64) -> Vec<Segment> {
    let mut sets = DisjointSets::new(local.pixels.len());
    for (n, &pixel) in local.pixels.iter().enumerate() {
        // The four neighbours that come before it.
        for &other in &local.neighbours(pixel)[..4] {
            let m = number[other as usize];
            if m == NONE {
                continue;
            }
            let (a, b) = (across.theta[n], across.theta[m as usize]);
            // NaN is similar to nothing.
            if tilt(f64::from(a), f64::from(b)) < t_b {
                sets.join(n, m as usize);
            }
        }
    }
    let mut members: Vec<Vec<u32>> = Vec::new();
    let mut place = vec![NONE; local.pixels.len()];
    for (n, &pixel) in local.pixels.iter().enumerate() {
        if across.theta[n].is_nan() {
            continue;
        }
        let root = sets.root(n);
        if place[root] == NONE {
            place[root] = members.len() as u32;
            members.push(Vec::new());
        }
        members[place[root] as usize].push(pixel);
    }
    let long = |segment: &Segment| segment.axis.length() >= segment.axis.mean_width();
    members
        .into_iter()
        .filter(|pixels| pixels.len() >= 3)
        .map(|pixels| {
            let axis = Axis::of(local, across, number, &pixels);
            Segment { pixels, axis }
        })
        .filter(long)
        .collect()
}
