//! Gains that make overlapping photos agree.
//!
//! ```text
//! min  sum_ij n_ij (log g_i + log m_ij - log g_j - log m_ji)^2 / sigma^2  +  sum_i n_i (log g_i)^2 / tau^2
//! ```
//!
//! for each channel: `m_ij` is the mean of photo `i` over the `n_ij` sampled cells that photos `i` and `j` both
//! show; the second sum keeps the gains near 1. Quadratic, so one Cholesky factorisation. Reference: M. Brown
//! and D. G. Lowe, *Automatic panoramic image stitching using invariant features*, 2007.

use super::{
    MapError, paint::Gain, photo::DecodedPhoto, photo_cache::PhotoCache, select::PhotoSelector,
};
use crate::raster::undistort::Interpolation;
use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Relative standard deviation of a difference of means, and of a gain: values of the reference's order, which let exposure
/// differ and keep a block without much overlap from drifting.
const SIGMA: f64 = 0.04;
const TAU: f64 = 0.2;
/// Cells that are sampled, about: many for each pair of photos, and few against those of a mosaic.
const SAMPLES: f64 = 40_000.0;

/// Of the first photo's colours, of the second's, and how many cells.
type Sums = ([f64; 3], [f64; 3], f64);

/// Sums of colours over cells that two photos both show.
#[derive(Debug, Clone, Default)]
pub struct Overlaps {
    pairs: BTreeMap<(usize, usize), Sums>,
}

impl Overlaps {
    /// Adds one cell with the colours of two photos.
    pub fn add(&mut self, (i, first): (usize, [f32; 3]), (j, second): (usize, [f32; 3])) {
        let ((i, first), (j, second)) =
            if i < j { ((i, first), (j, second)) } else { ((j, second), (i, first)) };
        let (a, b, n) = self.pairs.entry((i, j)).or_default();
        for c in 0..3 {
            a[c] += f64::from(first[c]);
            b[c] += f64::from(second[c]);
        }
        *n += 1.0;
    }

    /// Samples a mosaic of `[width, height]` cells on a coarse grid.
    ///
    /// # Errors
    /// Photos that cannot be read.
    pub fn sample<E: Send>(
        selector: &PhotoSelector<'_>,
        [width, height]: [usize; 2],
        photos: &mut PhotoCache<'_, E>,
    ) -> Result<Overlaps, E> {
        let step = ((width * height) as f64 / SAMPLES).sqrt().ceil().max(1.0) as usize;
        let count = selector.views().len();
        let among: Vec<u32> = (0..count as u32).collect();
        let mut candidates = Vec::new();
        let mut wanted: Vec<Vec<(usize, [f32; 2])>> = vec![Vec::new(); count];
        let mut cells = 0;
        for v in (step / 2..height).step_by(step) {
            for u in (step / 2..width).step_by(step) {
                let Some(point) = selector.point_m(u, v) else { continue };
                selector.candidates(point, &among, &mut candidates);
                if candidates.len() >= 2 {
                    for candidate in &candidates {
                        let at = candidate.image_px.map(|value| value as f32);
                        wanted[candidate.view].push((cells, at));
                    }
                    cells += 1;
                }
            }
        }
        let mut colours: Vec<Vec<(usize, [f32; 3])>> = vec![Vec::new(); cells];
        let needed: Vec<usize> = (0..count).filter(|&k| !wanted[k].is_empty()).collect();
        photos.each_group(&needed, |photos| {
            for (k, photo) in photos.iter().enumerate() {
                let Some(photo) = photo else { continue };
                for &(cell, at) in &wanted[k] {
                    let colour = photo.at(at, Interpolation::Bilinear);
                    if DecodedPhoto::has_data(colour) {
                        let [r, g, b, _] = colour;
                        colours[cell].push((k, [r, g, b]));
                    }
                }
            }
        })?;
        let mut overlaps = Overlaps::default();
        for seen in &colours {
            for (i, &first) in seen.iter().enumerate() {
                seen[i + 1..].iter().for_each(|&second| overlaps.add(first, second));
            }
        }
        Ok(overlaps)
    }

    /// Number of pairs.
    pub fn pairs(&self) -> usize {
        self.pairs.len()
    }

    /// The gains of `count` photos; 1 for those that overlap with no other.
    ///
    /// # Errors
    /// Where the system cannot be solved.
    pub fn gains(&self, count: usize) -> Result<Vec<Gain>, MapError> {
        let mut gains = vec![[1.0; 3]; count];
        for channel in 0..3 {
            let mut normal = DMatrix::<f64>::zeros(count, count);
            let mut right = DVector::<f64>::zeros(count);
            for (&(i, j), (a, b, n)) in &self.pairs {
                // Black has no logarithm; half a grey value is as dark as a byte tells.
                let log = |sum: &[f64; 3]| (sum[channel] / n).max(0.5).ln();
                let weight = n / (SIGMA * SIGMA);
                let difference = log(a) - log(b);
                normal[(i, i)] += weight + n / (TAU * TAU);
                normal[(j, j)] += weight + n / (TAU * TAU);
                normal[(i, j)] -= weight;
                normal[(j, i)] -= weight;
                right[i] -= weight * difference;
                right[j] += weight * difference;
            }
            for i in 0..count {
                if normal[(i, i)] == 0.0 {
                    normal[(i, i)] = 1.0;
                }
            }
            let solution = normal
                .cholesky()
                .ok_or_else(|| MapError("the gains of the photos are not determined".into()))?
                .solve(&right);
            for (gain, log) in gains.iter_mut().zip(solution.iter()) {
                gain[channel] = log.exp() as f32;
            }
        }
        Ok(gains)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_of_different_exposure_agree_afterwards() {
        let exposure = [1.0, 1.1, 0.9];
        let mut overlaps = Overlaps::default();
        for k in 0..300 {
            let (i, j) = (k % 3, (k + 1) % 3);
            let grey = 80.0 + (k % 7) as f32;
            overlaps.add((i, [grey * exposure[i]; 3]), (j, [grey * exposure[j]; 3]));
        }
        let gains = overlaps.gains(4).unwrap();
        let after: Vec<f32> = (0..3).map(|k| gains[k][1] * exposure[k]).collect();
        // The prior towards 1 leaves (sigma/tau)^2 = 4 % of the differences.
        for pair in after.windows(2) {
            approx::assert_relative_eq!(pair[0], pair[1], max_relative = 0.01);
        }
        assert_eq!(gains[3], [1.0; 3]);
    }
}
