//! Where the cells of a mosaic come from: what is stored of it, and what follows from that.
//!
//! ```text
//! stored:  k, passed over        computed:  (u, v) = u_k(X, Y, Z(X, Y)),   angle to C_k,   distance to the seam
//! ```
//!
//! A number of a photo is the same over large areas, so that it needs next to no room; its pixel is collinearity with poses and lenses
//! that the record of the mosaic holds, to the last digit.

use super::select::{CellSources, PhotoSelector};
use rayon::prelude::*;
use rowgram_raster::window::Window;

/// Samples of a stored cell: number of the photo; 1 where a photo that the rule prefers was passed over, because the surface hides the
/// cell from it or it has no data there, else 0.
pub const BANDS: usize = 2;
/// What stands for no photo.
pub const NO_PHOTO: u16 = u16::MAX;

/// Samples of a cell with all that is known: number of the photo, column and row in it, angle between line of sight and vertical
/// (degrees), distance to the seam (metres).
pub const FULL_BANDS: usize = 5;
/// What stands for no photo, and for no seam, in those.
pub const NONE: f32 = -1.0;

/// What is stored of the sources of a window.
pub(super) fn compact(sources: &CellSources) -> Vec<u16> {
    let mut out = vec![0; BANDS * sources.source.len()];
    let cells = out.as_chunks_mut::<BANDS>().0.iter_mut();
    for ((cell, &source), &passed_over) in cells.zip(&sources.source).zip(&sources.passed_over) {
        cell[0] = (source as u16).wrapping_sub(1);
        cell[1] = u16::from(passed_over && source > 0);
    }
    out
}

/// All that is known of the cells of a window, from the stored numbers of their photos.
pub fn full(selector: &PhotoSelector<'_>, window: Window, stored: &[u16]) -> Vec<f32> {
    let source: Vec<u32> = stored
        .as_chunks::<BANDS>()
        .0
        .iter()
        .map(|cell| u32::from(cell[0].wrapping_add(1)))
        .collect();
    let sources = CellSources { window, source, ..CellSources::default() };
    let seams = selector.seams_m(&sources);
    let mut out = vec![NONE; window.pixels() * FULL_BANDS];
    out.par_chunks_mut(window.width * FULL_BANDS).enumerate().for_each(|(j, row)| {
        for (i, cell) in row.chunks_exact_mut(FULL_BANDS).enumerate() {
            let at = j * window.width + i;
            let Some(own) = (sources.source[at] as usize).checked_sub(1) else { continue };
            let Some(view) = selector.views().get(own) else { continue };
            let Some(point) = selector.point_m(window.u + i, window.v + j) else { continue };
            let Some([u, v]) = view.seen_px(point) else { continue };
            let centre = view.centre_m();
            let plan = (centre[0] - point[0]).hypot(centre[1] - point[1]);
            let angle = plan.atan2(centre[2] - point[2]).to_degrees();
            // Where no other photo shows the cell there is no seam.
            let seam = if seams[at].is_finite() { seams[at] } else { NONE };
            cell.copy_from_slice(&[own as f32, u as f32, v as f32, angle as f32, seam]);
        }
    });
    out
}
