//! Labels of pixels in GeoTIFF files.

use super::{
    FileError,
    geotiff::{self, Colour, Layout},
};
use rowgram_raster::{
    components::Run,
    georeference::Georeference,
    window::{self, Window},
};
use std::path::Path;

/// Writes the labels `1..` of sets of pixels, 0 elsewhere, as a GeoTIFF of 32-bit numbers.
///
/// # Errors
/// As [`geotiff::write`].
pub fn write(
    path: &Path,
    force: bool,
    (width, height): (usize, usize),
    georeference: Option<Georeference>,
    sets: &[&[Run]],
) -> Result<(), FileError> {
    // Runs by bands, so that every band looks only at its own.
    let bands: Vec<window::Band> = window::bands(height, geotiff::TILE, 0).collect();
    let mut of_band: Vec<Vec<(Run, u32)>> = vec![Vec::new(); bands.len()];
    for (set, label) in sets.iter().zip(1..) {
        for run in *set {
            if let Some(list) = of_band.get_mut(run.v as usize / geotiff::TILE) {
                list.push((*run, label));
            }
        }
    }
    let layout = Layout { width, height, colour: Colour::Classes, georeference, nodata: Some(0.0) };
    geotiff::write::<u32, FileError>(path, force, &layout, |writer| {
        for (band, runs) in bands.iter().zip(of_band) {
            let mut labels = vec![0; width * band.rows.len()];
            for (run, label) in runs {
                let pixels = run.pixels(width);
                let above = band.rows.start * width;
                labels[pixels.start - above..pixels.end - above].fill(label);
            }
            writer.put(Window::rows(width, band.rows.clone()), &labels)?;
        }
        Ok(())
    })
}
