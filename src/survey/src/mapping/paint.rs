//! Colours of a window, from the photos that were selected for it.

use super::{colour_correction::ColourCorrection, photo::DecodedPhoto, select::CellSources};
use crate::mapping::undistort::Interpolation;
use rayon::prelude::*;

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
