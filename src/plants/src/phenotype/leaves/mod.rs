//! Each single leaf of a mask, by slices across it (stroke width transform).
//!
//! 1. `edges`: where the mask ends, with the gradient angle `G` there, to fractions of a pixel.
//! 2. `slices`: stretches from an edge A along its gradient to the opposite edge B, accepted where
//!    `|G_A - G_B + pi| < T_a`; the leaf's direction there is `theta = (G_A + G_B)/2 mod pi`.
//! 3. `segments`: adjacent slices whose directions differ by less than `T_b`.
//! 4. `split`: segments whose width says that they are two leaves.
//! 5. `bridge`: segments that face each other across a gap and differ by less than `T_c` are one leaf.
//! 6. Every pixel that is left belongs to the leaf that it is nearest to within the plant.
//!
//! Steps 1 to 3 and 5 with [`Bridging::Greedy`] are the paper's; [`LeafOptions::paper`] does just these.
//! That is for blades. Broad leaves are found by [`super::broad_leaves`]; which of the two a mask shows is seen from how compact
//! its parts are.
//!
//! All is done for each connected part of the mask on its own (`part`); the only number they
//! share is the usual width of a leaf, a median over all slices.
//!
//! Lengths in pixels here; a ground sampling distance makes them metres where the raster has one.
//!
//! Reference: Ribera et al., KDD 2016 workshop; Epshtein, Ofek, Wexler, CVPR 2010.

mod axis;
mod bridge;
mod broad;
mod edges;
mod part;
mod plants;
mod segments;
mod slices;
mod split;

use crate::phenotype::broad_leaves;
pub use plants::assign;
use rowgram_optim::robust::median;
use rowgram_raster::{
    Mask,
    components::{self, Part, Run},
};

use axis::Axis;
use part::{Local, PAD};
use rayon::prelude::*;
use segments::{Across, NONE, Segment};
use serde::{Deserialize, Serialize};
use std::{collections::VecDeque, f64::consts::PI};

/// What leaves look like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LeafShape {
    /// Found from the mask.
    Auto,
    /// Blades: long, with edges that are nearly parallel.
    Blade,
    /// Broad leaves, as those of rosettes.
    Broad,
}

rowgram_base::choices!(LeafShape: Auto, Blade, Broad);

/// How segments are joined across gaps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Bridging {
    /// Not at all.
    None,
    /// The shortest gap first, each on its own.
    Greedy,
    /// All gaps at once, by the best matching.
    Global,
}

rowgram_base::choices!(Bridging: None, Greedy, Global);

rowgram_base::options! {
    /// What decides which pixels are one leaf.
    pub struct LeafOptions in "leaves", main [shape] {
        /// Leaf shape: blade, measured by slices across the leaf; broad, parts of the plant between constrictions;
        /// auto decides from the mask.
        pub shape: LeafShape = LeafShape::Auto;
        /// How far the gradients at the two edges of a slice may be from opposite (T_a of the paper, 36 degrees).
        pub edge_angle_rad: f64 = PI / 5.0, limits between(0.0, PI);
        /// How far the directions of adjacent slices of one segment may differ (T_b of the paper, 22.5 degrees).
        pub slice_angle_rad: f64 = PI / 8.0, limits between(0.0, PI);
        /// How far the directions at the two ends of a gap may differ (T_c of the paper, 30 degrees).
        pub gap_angle_rad: f64 = PI / 6.0, limits between(0.0, PI);
        /// How segments are joined across gaps: all gaps at once (global), the shortest first (greedy), or not at all (none).
        pub bridging: Bridging = Bridging::Global;
        /// Let bridges that bend cost more; global bridging only.
        pub curvature: bool = true;
        /// Split segments that are wide enough for two leaves.
        pub split: bool = true;
        /// Cost from which two ends are not bridged; of global bridging only. Of the pairs of ends that the other rules allow one
        /// in seven is one leaf, and more bridges join opposite leaves of a plant; a crossing at a right angle costs some 0.7.
        pub bridge_cost: f64 = 0.8, limits NON_NEGATIVE;
        /// Width from which two leaves lie side by side, in typical leaf widths.
        pub double_width_ratio: f64 = 1.5, limits POSITIVE;
        /// Longest gap that is bridged, in typical leaf widths.
        pub longest_gap_ratio: f64 = 6.0, limits NON_NEGATIVE;
        /// Widest slice, in typical leaf widths, plus four pixels.
        pub widest_slice_ratio: f64 = 1.2, limits NON_NEGATIVE;
        /// Typical leaf width; estimated from the mask where not set.
        pub leaf_width_px: Option<f64> = None, limits between(0.5, 10000.0), example "8.0";
        /// Leaves of fewer pixels are left out.
        pub min_pixels: usize = 1;
    }
}

impl Copy for LeafOptions {}

impl LeafOptions {
    /// The paper's method and nothing more.
    pub fn paper() -> LeafOptions {
        LeafOptions {
            bridging: Bridging::Greedy,
            curvature: false,
            split: false,
            shape: LeafShape::Blade,
            ..LeafOptions::default()
        }
    }
}

/// One leaf.
#[derive(Debug, Clone, PartialEq)]
pub struct Leaf {
    /// Its pixels, by rows.
    pub runs: Vec<Run>,
    /// Its axis from end to end, `[u, v]` in pixels.
    pub axis_px: Vec<[f64; 2]>,
    /// The full width at each point of the axis, pixels.
    pub width_px: Vec<f64>,
    /// Length of the axis, pixels.
    pub length_px: f64,
    /// Number of pixels.
    pub area_px: usize,
}

impl Leaf {
    /// Mean width along the axis, pixels.
    pub fn mean_width_px(&self) -> f64 {
        self.width_px.iter().sum::<f64>() / self.width_px.len().max(1) as f64
    }

    /// Largest width, pixels.
    pub fn max_width_px(&self) -> f64 {
        self.width_px.iter().copied().fold(0.0, f64::max)
    }

    /// Direction of the axis, radians in [0, pi), from the picture's `u` axis towards its `v` axis. The outermost sixths
    /// do not count: they follow the corners of the ends.
    pub fn angle_rad(&self) -> f64 {
        let count = self.axis_px.len();
        let skip = count / 6;
        match (self.axis_px.get(skip), self.axis_px.get(count.wrapping_sub(1 + skip))) {
            (Some(a), Some(b)) if a != b => (b[1] - a[1]).atan2(b[0] - a[0]).rem_euclid(PI),
            _ => 0.0,
        }
    }

    /// The middle of the axis.
    pub fn middle_px(&self) -> [f64; 2] {
        self.axis_px.get(self.axis_px.len() / 2).copied().unwrap_or_default()
    }
}

/// The leaves of a mask.
#[derive(Debug, Clone, PartialEq)]
pub struct Leaves {
    /// By the first pixels of their parts; leaf `n` has the label `n + 1`.
    pub leaves: Vec<Leaf>,
    /// The usual width of a leaf, pixels; 0 where there is none.
    pub usual_width_px: f64,
    /// Whether they were found as broad leaves.
    pub is_broad: bool,
}

/// Widest and longest leaf of field crops, metres, blades and broad leaves: maize and sorghum reach 0.13 and 1.2, cabbage and squash 0.4 and 0.5.
const LARGEST_M: [(f64, f64); 2] = [(0.15, 1.5), (0.4, 0.6)];

impl Leaves {
    /// Median length, pixels; `None` without leaves.
    pub fn median_length_px(&self) -> Option<f64> {
        median(self.leaves.iter().map(|leaf| leaf.length_px))
    }

    /// Whether leaves are wider or longer than those of field crops where pixels are `gsd_m` wide: then they are canopies, lawns or crowns,
    /// in which no single leaf is seen.
    pub fn are_too_large(&self, gsd_m: f64) -> bool {
        let (width_m, length_m) = LARGEST_M[usize::from(self.is_broad)];
        let length_px = self.median_length_px().unwrap_or(0.0);
        gsd_m * self.usual_width_px > width_m || gsd_m * length_px > length_m
    }
}

/// The longest walk across a leaf before its usual width is known, pixels.
const LONGEST_PX: f64 = 128.0;
/// Smoothing before it is known.
const FIRST_SIGMA_PX: f64 = 1.0;
/// Classes of the histogram of slice widths per pixel.
const CLASSES_PER_PX: f64 = 16.0;

/// Finds the leaves of a mask.
///
/// The result does not depend on the number of threads.
pub fn find(mask: &Mask, options: &LeafOptions) -> Leaves {
    let is_broad = match options.shape {
        LeafShape::Auto => broad_leaves::is_broad(mask),
        shape => shape == LeafShape::Broad,
    };
    if is_broad {
        return broad::find(mask, options);
    }
    let parts = components::parts(mask);
    let usual_width_px =
        options.leaf_width_px.unwrap_or_else(|| usual_width(&parts, options.edge_angle_rad));
    let leaves = parts
        .par_iter()
        .map(|part| of_part(part, options, usual_width_px))
        .collect::<Vec<_>>()
        .into_iter()
        .flatten()
        .filter(|leaf| leaf.area_px >= options.min_pixels)
        .collect();
    Leaves { leaves, usual_width_px, is_broad: false }
}

/// The median of the widths of all slices, pixels.
fn usual_width(parts: &[Part], t_a: f64) -> f64 {
    let classes = (LONGEST_PX * CLASSES_PER_PX) as usize + 1;
    let histogram = parts
        .par_iter()
        .map(|part| {
            let local = Local::of(part);
            let found = slices(&local, &numbers(&local), t_a, LONGEST_PX, FIRST_SIGMA_PX);
            let mut histogram = vec![0u64; classes];
            for slice in &found.all {
                histogram[((slice.width * CLASSES_PER_PX) as usize).min(classes - 1)] += 1;
            }
            histogram
        })
        .reduce(
            || vec![0; classes],
            |mut a, b| {
                a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
                a
            },
        );
    let half = histogram.iter().sum::<u64>().div_ceil(2);
    let mut below = 0;
    let median = histogram.iter().position(|&count| {
        below += count;
        count > 0 && below >= half
    });
    median.map_or(0.0, |class| (class as f64 + 0.5) / CLASSES_PER_PX)
}

/// The place of each local pixel among the part's pixels.
fn numbers(local: &Local) -> Vec<u32> {
    let mut number = vec![NONE; local.mask.len()];
    for (n, &pixel) in local.pixels.iter().enumerate() {
        number[pixel as usize] = n as u32;
    }
    number
}

fn slices(
    local: &Local,
    number: &[u32],
    t_a: f64,
    longest_px: f64,
    sigma_px: f64,
) -> slices::Slices {
    let edges = edges::Edges::of(local, sigma_px);
    slices::find(local, &edges, number, t_a, longest_px)
}

/// Direction and width of the leaf at each pixel of a part.
fn measure(local: &Local, number: &[u32], options: &LeafOptions, usual_px: f64) -> Across {
    // The rounding of both edges to pixels does not shrink with the leaf.
    let widest_px = options.widest_slice_ratio * usual_px + 4.0;
    let sigma_px = edges::sigma_px(usual_px);
    let found = slices(local, number, options.edge_angle_rad, widest_px + 3.0, sigma_px);
    Across::of(local.pixels.len(), &found, widest_px)
}

fn of_part(part: &Part, options: &LeafOptions, usual_px: f64) -> Vec<Leaf> {
    let local = Local::of(part);
    let number = numbers(&local);
    let across = measure(&local, &number, options, usual_px);
    let mut segments = segments::merge(&local, &across, &number, options.slice_angle_rad);
    if options.split {
        let widths_px = [usual_px, options.double_width_ratio * usual_px];
        segments = split::split(&local, &across, &number, segments, widths_px);
    }
    if segments.is_empty() {
        // Too small for a slice: still a leaf.
        let axis = Axis::of(&local, &across, &number, &local.pixels);
        segments.push(Segment { pixels: local.pixels.clone(), axis });
    }
    let rules = bridge::Rules {
        t_c: options.gap_angle_rad,
        limit_px: (options.longest_gap_ratio * usual_px).max(2.0),
        bridging: options.bridging,
        curvature: options.curvature,
        most: options.bridge_cost,
    };
    let mut owner = vec![NONE; local.pixels.len()];
    for (segment, at) in segments.iter().zip(0..) {
        for &pixel in &segment.pixels {
            owner[number[pixel as usize] as usize] = at;
        }
    }
    let owners = bridge::Owners { number: &number, of: &owner };
    let chains = bridge::chains(&local, &owners, &segments, &rules);
    let mut leaf_of = vec![NONE; segments.len()];
    let mut leaves = Vec::with_capacity(chains.len());
    for (leaf, chain) in chains.iter().enumerate() {
        let mut axis = Axis::default();
        for &(segment, reversed) in chain {
            axis.append(&segments[segment].axis, reversed);
            leaf_of[segment] = leaf as u32;
        }
        leaves.push(axis);
    }
    for owner in owner.iter_mut().filter(|owner| **owner != NONE) {
        *owner = leaf_of[*owner as usize];
    }
    spread(&local, &number, &mut owner);
    finish(&local, &owner, leaves)
}

/// Gives every pixel without an owner to the nearest one, step by step.
fn spread(local: &Local, number: &[u32], owner: &mut [u32]) {
    let mut queue: VecDeque<u32> =
        (0..owner.len() as u32).filter(|&n| owner[n as usize] != NONE).collect();
    while let Some(n) = queue.pop_front() {
        for neighbour in local.neighbours(local.pixels[n as usize]) {
            let m = number[neighbour as usize];
            if m != NONE && owner[m as usize] == NONE {
                owner[m as usize] = owner[n as usize];
                queue.push_back(m);
            }
        }
    }
}

fn finish(local: &Local, owner: &[u32], mut axes: Vec<Axis>) -> Vec<Leaf> {
    let mut owned = vec![Vec::new(); axes.len()];
    for (&pixel, &leaf) in local.pixels.iter().zip(owner) {
        if leaf != NONE {
            owned[leaf as usize].push(pixel);
        }
    }
    for (axis, pixels) in axes.iter_mut().zip(&owned) {
        axis.reach_to(pixels.iter().map(|&pixel| local.at(pixel)));
    }
    let [left, top] = local.origin;
    let moved = |axis: &Axis| -> Vec<[f64; 2]> {
        axis.points.iter().map(|p| [p[0] + left as f64, p[1] + top as f64]).collect()
    };
    let mut leaves: Vec<Leaf> = axes
        .iter()
        .map(|axis| Leaf {
            runs: Vec::new(),
            axis_px: moved(axis),
            width_px: axis.widths.clone(),
            length_px: axis.length(),
            area_px: 0,
        })
        .collect();
    for (leaf, pixels) in leaves.iter_mut().zip(&owned) {
        leaf.area_px = pixels.len();
        for &pixel in pixels {
            let u = (i64::from(pixel) % local.width as i64 + left) as u32;
            let v = (i64::from(pixel) / local.width as i64 + top) as u32;
            match leaf.runs.last_mut() {
                Some(run) if run.v == v && run.end == u => run.end += 1,
                _ => leaf.runs.push(Run { v, start: u, end: u + 1 }),
            }
        }
    }
    debug_assert!(local.height > 2 * PAD || leaves.is_empty());
    leaves
}

#[cfg(test)]
mod tests;
