//! Colours of the leaf pixels of areas.

use rowgram_files::rasters::Source;
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::plot_scatter::{ColourParts, PlotParts};
use rowgram_raster::{Mask, polygon::Polygon, srgb::LightScale};
use std::ops::Range;

/// Rows of the orthomosaic that are read at a time.
const BAND_ROWS: usize = 512;

/// The sum of the colours of the leaf pixels of each area, by part, their light in this scale. `None` where the picture has no colours or another size than
/// the mask.
///
/// # Errors
/// A damaged picture.
pub(super) fn of_leaves(
    source: &Source,
    (mask, light): (&Mask, LightScale),
    areas: &[&Polygon],
) -> Result<Option<Vec<ColourParts>>, FileError> {
    if !source.is_photo() || source.size() != (mask.width, mask.height) {
        return Ok(None);
    }
    let runs: Vec<Vec<(usize, Range<usize>)>> =
        areas.iter().map(|area| area.runs(mask.width, mask.height)).collect();
    let parts: Vec<PlotParts> = areas.iter().map(|area| PlotParts::of(area)).collect();
    let mut sums = vec![ColourParts::default(); runs.len()];
    for first in (0..mask.height).step_by(BAND_ROWS) {
        let rows = first..(first + BAND_ROWS).min(mask.height);
        let (mut picture, gaps) = source.rgb_and_gaps(rows.clone())?;
        light.convert(&mut picture);
        for ((sum, runs), parts) in sums.iter_mut().zip(&runs).zip(&parts) {
            // The runs of an area are sorted by row.
            let begin = runs.partition_point(|(v, _)| *v < rows.start);
            for (v, run) in runs[begin..].iter().take_while(|(v, _)| *v < rows.end) {
                let leaf = mask.row(*v);
                for u in run.clone().filter(|&u| leaf[u] != 0) {
                    let row = v - first;
                    if gaps.as_ref().is_some_and(|gaps| gaps[row * mask.width + u]) {
                        continue;
                    }
                    let part = parts.at([u as f64, *v as f64]);
                    sum.0[part].add(picture.get_pixel(u as u32, row as u32).0);
                }
            }
        }
    }
    Ok(Some(sums))
}
