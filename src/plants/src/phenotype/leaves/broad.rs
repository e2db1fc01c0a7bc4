//! Broad leaves as leaves: the parts of [`broad_leaves`] with their axes.

use super::{Leaf, LeafOptions, Leaves};
use crate::phenotype::{
    broad_leaves::{BroadLeaves, broad_leaves},
    principal_axis::{main_axis_rad, middle},
};
use rayon::prelude::*;
use rowgram_optim::robust::median;
use rowgram_raster::{Mask, components::Run};

/// Points of an axis.
const POINTS: usize = 9;

/// The broad leaves of a mask.
pub(super) fn find(mask: &Mask, options: &LeafOptions) -> Leaves {
    let BroadLeaves { labels, count } = broad_leaves(mask);
    let mut runs: Vec<Vec<Run>> = vec![Vec::new(); count as usize];
    for (v, row) in labels.chunks(mask.width.max(1)).enumerate() {
        let (v, mut start) = (v as u32, 0);
        for chunk in row.chunk_by(|a, b| a == b) {
            let end = start + chunk.len() as u32;
            if let Some(leaf) = chunk[0].checked_sub(1) {
                runs[leaf as usize].push(Run { v, start, end });
            }
            start = end;
        }
    }
    let mut leaves: Vec<Leaf> = runs.into_par_iter().map(measured).collect();
    leaves.retain(|leaf| leaf.area_px >= options.min_pixels.max(1));
    let usual_width_px = median(leaves.iter().map(Leaf::max_width_px)).unwrap_or(0.0);
    Leaves { leaves, usual_width_px, is_broad: true }
}

/// A leaf with its principal axis; the width at a point of it is the area of the strip around it over the strip's length.
fn measured(runs: Vec<Run>) -> Leaf {
    let pixels = || runs.iter().flat_map(Run::places);
    let area_px = pixels().count();
    let centre = middle(pixels());
    let (sin, cos) = main_axis_rad([pixels()]).sin_cos();
    let along = |p: [f64; 2]| (p[0] - centre[0]) * cos + (p[1] - centre[1]) * sin;
    // A pixel reaches half a pixel to either side of its centre.
    let (from, to) =
        pixels().map(along).fold((f64::MAX, f64::MIN), |(from, to), t| (from.min(t), to.max(t)));
    let (from, length_px) = (from - 0.5, to - from + 1.0);
    let strip = length_px / POINTS as f64;
    let mut areas = [0.0; POINTS];
    for p in pixels() {
        areas[(((along(p) - from) / strip) as usize).min(POINTS - 1)] += 1.0;
    }
    let point = |k: usize| {
        let t = from + length_px * k as f64 / (POINTS - 1) as f64;
        [centre[0] + t * cos, centre[1] + t * sin]
    };
    Leaf {
        axis_px: (0..POINTS).map(point).collect(),
        width_px: areas.iter().map(|area| area / strip).collect(),
        length_px,
        area_px,
        runs,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::leaves::{LeafShape, find};

    /// Rosettes of seven elliptic leaves, 36 x 18 px.
    fn rosette() -> Mask {
        Mask::from_fn(120, 120, |u, v| {
            let (x, y) = (u as f64 - 60.0, v as f64 - 60.0);
            (0..7).any(|leaf| {
                let (sin, cos) = (std::f64::consts::TAU * f64::from(leaf) / 7.0 + 0.2).sin_cos();
                let (along, across) = (x * cos + y * sin - 30.0, y * cos - x * sin);
                (along / 18.0).powi(2) + (across / 9.0).powi(2) < 1.0
                    || (across.abs() < 1.5 && (-30.0..0.0).contains(&along))
            })
        })
    }

    #[test]
    fn leaves_of_a_rosette_are_found_without_being_told() {
        let mask = rosette();
        let found = find(&mask, &LeafOptions::default());
        assert!((7..=8).contains(&found.leaves.len()), "{} of 7 leaves", found.leaves.len());
        assert!((found.usual_width_px - 18.0).abs() < 2.5, "width {}", found.usual_width_px);
        let area: usize = found.leaves.iter().map(|leaf| leaf.area_px).sum();
        assert_eq!(area, mask.count());
        let blades =
            find(&mask, &LeafOptions { shape: LeafShape::Blade, ..LeafOptions::default() });
        assert_ne!(blades, found);
    }

    #[test]
    fn leaves_as_large_as_crowns_are_too_large() {
        let found = find(&rosette(), &LeafOptions::default());
        assert!(found.is_broad && !found.are_too_large(0.01) && found.are_too_large(0.03));
        let ribbon = Mask::from_fn(200, 40, |u, v| (20..180).contains(&u) && (15..25).contains(&v));
        let found = find(&ribbon, &LeafOptions::default());
        assert!(!found.is_broad && !found.are_too_large(0.008) && found.are_too_large(0.02));
    }

    #[test]
    fn a_single_pixel_is_a_leaf_of_length_one() {
        let leaf = measured(vec![Run { v: 4, start: 3, end: 4 }]);
        assert_eq!((leaf.area_px, leaf.length_px), (1, 1.0));
        assert!(leaf.axis_px.iter().all(|p| (p[0] - 3.0).abs() < 0.6 && (p[1] - 4.0).abs() < 0.6));
    }
}
