//! Plants of one component: its pixels cut into as many groups as it holds plants.
//!
//! ```text
//! min sum_i min_p |z_i - x_p|^2
//! ```
//!
//! by Lloyd's descent, started from quantiles along the longest axis of the component.

use crate::phenotype::principal_axis::{main_axis_rad, middle as middle_of};
use rowgram_raster::components::{Part, Run};

/// Most pixels that the descent looks at; larger components are thinned.
const PIXELS: usize = 4000;

/// The middles of `plants` groups of the pixels of a component, in pixels, along the longest axis.
pub fn split(part: &Part, plants: usize) -> Vec<[f64; 2]> {
    let step = part.pixels.div_ceil(PIXELS).max(1);
    let places = part.runs.iter().flat_map(Run::places);
    let pixels: Vec<[f64; 2]> = places.step_by(step).collect();
    let plants = plants.min(pixels.len());
    let middle = middle_of(pixels.iter().copied());
    if plants <= 1 {
        return vec![middle; plants];
    }
    let (sin, cos) = main_axis_rad([pixels.iter().copied()]).sin_cos();
    let along = |z: &[f64; 2]| (z[0] - middle[0]) * cos + (z[1] - middle[1]) * sin;
    let mut sorted = pixels.clone();
    sorted.sort_by(|a, b| along(a).total_cmp(&along(b)));
    let group = |p: usize| p * sorted.len() / plants..(p + 1) * sorted.len() / plants;
    let mut centres: Vec<[f64; 2]> =
        (0..plants).map(|p| middle_of(sorted[group(p)].iter().copied())).collect();
    for _ in 0..30 {
        let mut sums = vec![[0.0; 3]; centres.len()];
        for z in &pixels {
            let sum = &mut sums[nearest(&centres, z)];
            *sum = [sum[0] + z[0], sum[1] + z[1], sum[2] + 1.0];
        }
        let mut moved = 0.0_f64;
        for (centre, sum) in centres.iter_mut().zip(sums).filter(|(_, sum)| sum[2] > 0.0) {
            let next = [sum[0] / sum[2], sum[1] / sum[2]];
            moved = moved.max((next[0] - centre[0]).hypot(next[1] - centre[1]));
            *centre = next;
        }
        if moved < 0.01 {
            break;
        }
    }
    centres.sort_by(|a, b| along(a).total_cmp(&along(b)));
    centres
}

fn nearest(centres: &[[f64; 2]], z: &[f64; 2]) -> usize {
    let squared = |c: &[f64; 2]| (c[0] - z[0]).powi(2) + (c[1] - z[1]).powi(2);
    let closer = |best, p| if squared(&centres[p]) < squared(&centres[best]) { p } else { best };
    (1..centres.len()).fold(0, closer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::{Mask, components};

    /// The only component of discs in a picture.
    fn discs(places: &[[f64; 2]]) -> Part {
        let mask = Mask::from_fn(50, 30, |u, v| {
            let apart = |p: &[f64; 2]| (u as f64 - p[0]).hypot(v as f64 - p[1]);
            places.iter().any(|p| apart(p) <= 6.0)
        });
        let mut parts = components::parts(&mask);
        assert_eq!(parts.len(), 1);
        parts.remove(0)
    }

    #[test]
    fn touching_discs_are_told_apart() {
        let places = [[10.0, 10.0], [20.0, 12.0], [31.0, 9.0]];
        let found = split(&discs(&places), 3);
        for (found, place) in found.iter().zip(places) {
            assert!(
                (found[0] - place[0]).hypot(found[1] - place[1]) < 0.5,
                "{found:?}, expected {place:?}"
            );
        }
    }

    #[test]
    fn one_plant_stands_in_the_middle() {
        assert_eq!(split(&discs(&[[20.0, 11.0]]), 1), [[20.0, 11.0]]);
        let mut pixel = discs(&[[10.0, 10.0]]);
        pixel.runs = vec![Run { v: 1, start: 1, end: 2 }];
        pixel.pixels = 1;
        assert_eq!(split(&pixel, 5), [[1.0; 2]]);
        pixel.runs.clear();
        assert!(split(&pixel, 2).is_empty());
    }
}
