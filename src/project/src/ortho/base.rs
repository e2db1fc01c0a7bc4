//! The surface that photos are drawn on: that of the tie points, with heights of the dense surface where it has none.

use crate::dem::{read_surface, write_heights};
use rowgram_base::error::Error;
use rowgram_files::geotiff::{Reader, TILE};
use rowgram_optim::{output::FileError, robust};
use rowgram_raster::{
    georeference::Georeference,
    window::{Window, bands},
};
use std::path::{Path, PathBuf};

/// The part of a cell that has to have dense heights of some confidence for their mean to stand for it.
/// Chosen by looking at the orthomosaic (`rowgram ortho`) of one wood, seen by photos of two thirds of overlap (Brighton in
/// docs/accuracy.md): with half it is full of small holes, with no limit its border is drawn at wrong heights.
const MIN_SHARE: f64 = 0.25;

/// Writes `to`, the surface `base` with its empty cells filled by means of the heights of a dense surface, and gives their number; without
/// any nothing is written. `dense` are the files of its heights and of the confidence in them. From the means the median difference of both
/// surfaces is taken, so that a canopy is as high over the filled cells as over those beside them.
///
/// # Errors
/// Rasters that cannot be read or written.
pub(super) fn fill(base: &Path, dense: &[PathBuf; 2], to: &Path) -> Result<usize, Error> {
    let mut surface = read_surface(base)?;
    let size = [surface.width, surface.height];
    let means = means(dense, &surface.georeference, size)?;
    let both = surface.heights_m.iter().zip(&means).map(|(own, mean)| f64::from(mean - own));
    let Some(apart_m) = robust::median(both.filter(|apart_m| apart_m.is_finite())) else {
        return Ok(0);
    };
    let mut filled = 0;
    for (own, mean) in surface.heights_m.iter_mut().zip(&means) {
        if own.is_nan() && mean.is_finite() {
            *own = mean - apart_m as f32;
            filled += 1;
        }
    }
    if filled > 0 {
        write_heights(to, &surface.georeference, size, &surface.heights_m, true)?;
    }
    Ok(filled)
}

/// The mean heights of a dense surface in the cells of a raster; NaN where less than [`MIN_SHARE`] of a cell has any of confidence.
fn means(
    [heights, confidence]: &[PathBuf; 2],
    place: &Georeference,
    [columns, rows]: [usize; 2],
) -> Result<Vec<f32>, Error> {
    let (reader, confidence) = (Reader::open(heights)?, Reader::open(confidence)?);
    let (width, height) = (reader.width(), reader.height());
    let fault = |message: &str| FileError::malformed(heights, None, message);
    let own = reader.georeference().ok_or_else(|| fault("it is not georeferenced"))?;
    let pixel = |u: usize, v: usize| {
        let at = place.pixel(own.map([u as f64, v as f64]));
        at.ok_or_else(|| fault("the surface of the tie points has no area"))
    };
    // Both have the frame of the project, and columns along x.
    let column_of: Vec<f64> =
        (0..width).map(|u| Ok(pixel(u, 0)?[0].round())).collect::<Result<_, FileError>>()?;
    let mut sums = vec![(0.0f64, 0usize); columns * rows];
    for band in bands(height, TILE, 0) {
        let window = Window::rows(width, band.rows.clone());
        let (values, known) = (reader.read_f32(window)?, confidence.read_f32(window)?);
        let lines = values.chunks_exact(width).zip(known.chunks_exact(width));
        for (v, (line, known)) in band.rows.zip(lines) {
            let row = pixel(0, v)?[1].round();
            if !(0.0..rows as f64).contains(&row) {
                continue;
            }
            let cells = &mut sums[row as usize * columns..][..columns];
            for ((&column, &z), &known) in column_of.iter().zip(line).zip(known) {
                if z.is_finite() && known > 0.0 && (0.0..columns as f64).contains(&column) {
                    let (sum, count) = &mut cells[column as usize];
                    *sum += f64::from(z);
                    *count += 1;
                }
            }
        }
    }
    let side = |of: [f64; 2]| of[0].hypot(of[1]);
    let per_cell =
        side(place.per_column) * side(place.per_row) / (side(own.per_column) * side(own.per_row));
    let mean = |&(sum, count): &(f64, usize)| match count as f64 >= MIN_SHARE * per_cell.max(1.0) {
        true => (sum / count as f64) as f32,
        false => f32::NAN,
    };
    Ok(sums.iter().map(mean).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;

    #[test]
    fn gaps_are_filled_at_the_height_of_what_is_around() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let [base, heights_of, confidence, to] =
            ["dem.tif", "dsm.tif", "confidence.tif", "filled.tif"].map(path);
        let dense = [heights_of, confidence];
        // Cells of 1 m, and of 0.25 m that end before the last column; 0.5 m higher, as plants are.
        let plane = |[x, y]: [f64; 2]| 100.0 + 0.1 * x - 0.2 * y;
        let coarse = Georeference::north_up([0.5, 9.5], 1.0, Crs::projected(32616));
        let fine = Georeference::north_up([0.125, 9.875], 0.25, Crs::projected(32616));
        let heights = |place: &Georeference, size: [usize; 2], by_m: f64, gaps: &[[usize; 2]]| {
            let cells = (0..size[1]).flat_map(|v| (0..size[0]).map(move |u| [u, v]));
            let height = |at: [usize; 2]| match gaps.contains(&at) {
                true => f32::NAN,
                false => (plane(place.map(at.map(|c| c as f64))) + by_m) as f32,
            };
            cells.map(height).collect::<Vec<f32>>()
        };
        let gaps = [[3, 4], [4, 4], [9, 2], [6, 7]];
        let coarse_m = heights(&coarse, [10, 10], 0.0, &gaps);
        write_heights(&base, &coarse, [10, 10], &coarse_m, false).unwrap();
        // The second gap has no dense heights, the third is guessed.
        let unseen: Vec<[usize; 2]> =
            (16..20).flat_map(|u| (16..20).map(move |v| [u, v])).collect();
        let fine_m = heights(&fine, [36, 40], 0.5, &unseen);
        write_heights(&dense[0], &fine, [36, 40], &fine_m, false).unwrap();
        let is_guessed = |at: usize| (24..28).contains(&(at % 36)) && (28..32).contains(&(at / 36));
        let known: Vec<f32> = (0..fine_m.len()).map(|at| f32::from(!is_guessed(at))).collect();
        write_heights(&dense[1], &fine, [36, 40], &known, false).unwrap();
        assert_eq!(fill(&base, &dense, &to).unwrap(), 1);
        let filled = read_surface(&to).unwrap();
        for (at, z) in filled.heights_m.iter().enumerate() {
            let at = [at % 10, at / 10];
            let expected = plane(coarse.map(at.map(|c| c as f64)));
            let is_empty = [[4, 4], [9, 2], [6, 7]].contains(&at);
            assert_eq!(z.is_nan(), is_empty, "{at:?}");
            assert!(is_empty || (f64::from(*z) - expected).abs() < 1e-4, "{at:?} {z} {expected}");
        }
        // Where nothing is empty nothing is written.
        std::fs::remove_file(&to).unwrap();
        write_heights(&base, &coarse, [10, 10], &heights(&coarse, [10, 10], 0.0, &[]), true)
            .unwrap();
        assert_eq!(fill(&base, &dense, &to).unwrap(), 0);
        assert!(!to.exists());
    }
}
