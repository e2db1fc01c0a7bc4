//! Colours of a window, from the photos that were selected for it.
//!
//! ```text
//! colour = f_k(photo_k(u_k))                                           without feathering
//! colour = sum_k w_k f_k(photo_k(u_k)) / sum_k w_k                     with it
//! w_k = max(0, 1 - s_k / F) e_k^2,   e_k = min(1, border_k / 32 px)
//! ```
//!
//! `s_k` is how far, in plan, the cell lies on the other side of the seam towards photo `k` (0 for the photo of the cell),
//! `F` the width of the feathering, so that on a seam both sides weigh alike and a distance `F` from it
//! one photo is alone. `e_k` fades a photo out towards its own border, where seams end. `f_k` corrects the colours of a photo.

use super::{
    colour_correction::ColourCorrection,
    photo::DecodedPhoto,
    select::{CellSources, PhotoSelector},
};
use crate::mapping::undistort::Interpolation;
use rayon::prelude::*;
use rowgram_raster::window::Window;

/// Pixels along a photo's border over which it fades out.
const EDGE_PX: f64 = 32.0;

/// Paints the cells whose photo is among `photos` (by index; `None` for those that are not in memory) into
/// red, green, blue, alpha. Cells of other photos are left as they are.
pub fn paint(
    sources: &CellSources,
    photos: &[Option<&DecodedPhoto>],
    corrections: Option<&[ColourCorrection]>,
    interpolation: Interpolation,
    rgba: &mut [[u8; 4]],
) {
    let width = sources.window.width;
    let rows = sources.source.par_chunks(width).zip(sources.pixel.par_chunks(width));
    rgba.par_chunks_mut(width).zip(rows).for_each(|(out, (source, pixel))| {
        // Cells side by side from one photo are painted together.
        let mut start = 0;
        while start < source.len() {
            let mut end = start + 1;
            while end < source.len() && source[end] == source[start] {
                end += 1;
            }
            let run = start..end;
            start = end;
            let Some(k) = (source[run.start] as usize).checked_sub(1) else { continue };
            if let Some(photo) = photos[k] {
                let correction = corrections.map(|of| &of[k]);
                photo.colours(&pixel[run.clone()], interpolation, correction, &mut out[run]);
            }
        }
    });
}

/// Sums of a window that is feathered.
#[derive(Debug, Clone)]
pub struct Blend {
    window: Window,
    sums: Vec<[f32; 4]>,
}

impl Blend {
    /// Nothing yet.
    pub fn new(window: Window) -> Blend {
        Blend { window, sums: vec![[0.0; 4]; window.pixels()] }
    }

    /// The photos that have a weight in a window, by index.
    pub fn photos(
        selector: &PhotoSelector<'_>,
        sources: &CellSources,
        feather_m: f64,
    ) -> Vec<usize> {
        let window = sources.window;
        let among = selector.within(window);
        let count = selector.views().len();
        let rows = sources.source.par_chunks(window.width).enumerate();
        let used = rows
            .map(|(j, source)| {
                let mut used = vec![false; count];
                for (i, &source) in source.iter().enumerate().filter(|(_, source)| **source > 0) {
                    let own = source as usize - 1;
                    used[own] = true;
                    let Some(point) = selector.point_m(window.u + i, window.v + j) else {
                        continue;
                    };
                    for k in among.iter().map(|&k| k as usize).filter(|&k| k != own) {
                        used[k] = used[k] || selector.to_seam_m(point, own, k) < feather_m;
                    }
                }
                used
            })
            .reduce(
                || vec![false; count],
                |mut all, used| {
                    all.iter_mut().zip(used).for_each(|(a, b)| *a |= b);
                    all
                },
            );
        (0..count).filter(|&k| used[k]).collect()
    }

    /// Adds the photos that are in memory; each is to be added once.
    pub fn add(
        &mut self,
        selector: &PhotoSelector<'_>,
        sources: &CellSources,
        photos: &[Option<&DecodedPhoto>],
        corrections: Option<&[ColourCorrection]>,
        (interpolation, feather_m): (Interpolation, f64),
    ) {
        let window = self.window;
        let among = selector.within(window);
        let width = window.width;
        let rows = sources.source.par_chunks(width);
        let prepared: Option<Vec<_>> =
            corrections.map(|of| of.iter().map(ColourCorrection::prepared).collect());
        self.sums.par_chunks_mut(width).zip(rows).enumerate().for_each(|(j, (sums, source))| {
            for (i, sum) in sums.iter_mut().enumerate() {
                if source[i] == 0 {
                    continue;
                }
                let own = source[i] as usize - 1;
                let Some(point) = selector.point_m(window.u + i, window.v + j) else { continue };
                // Sums in the order of the photos, however many are in memory at a time.
                for k in among.iter().map(|&k| k as usize) {
                    let Some(photo) = photos[k] else { continue };
                    let away = if k == own { 0.0 } else { selector.to_seam_m(point, own, k) };
                    if away >= feather_m {
                        continue;
                    }
                    let Some(at) = selector.shown_by(k, point) else { continue };
                    let size = selector.views()[k].interior.size_px();
                    let border = (0..2)
                        .map(|a| (at[a] + 0.5).min(f64::from(size[a]) - 0.5 - at[a]))
                        .fold(EDGE_PX, f64::min);
                    // Never 0 for a photo that may be the only one.
                    let edge = (border / EDGE_PX).max(1e-3);
                    let at = at.map(|value| value as f32);
                    let mut colour = photo.at(at, interpolation);
                    if !DecodedPhoto::has_data(colour) {
                        continue;
                    }
                    if let Some(prepared) = &prepared {
                        prepared[k].apply(at, &mut colour);
                    }
                    let weight = ((1.0 - away / feather_m) * edge * edge) as f32;
                    for c in 0..3 {
                        sum[c] += weight * colour[c];
                    }
                    sum[3] += weight;
                }
            }
        });
    }

    /// The colours; transparent where no photo was added.
    pub fn finish(&self, rgba: &mut [[u8; 4]]) {
        for (out, sum) in rgba.iter_mut().zip(&self.sums) {
            if sum[3] > 0.0 {
                let byte = |c: usize| (sum[c] / sum[3] + 0.5).clamp(0.0, 255.0) as u8;
                *out = [byte(0), byte(1), byte(2), 255];
            }
        }
    }
}
