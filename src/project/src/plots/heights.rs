//! Heights of the canopy in plots, from the raster of the stage surface.

use rowgram_files::geotiff;
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::{
    plot_scatter::{HeightParts, PlotParts},
    plots::CanopyHeights,
};
use rowgram_raster::{
    georeference::{Georeference, Transfer},
    polygon::Polygon,
    window::Window,
};
use std::path::Path;

/// The heights in each of some areas, given in pixels of a raster that lies at `place`; `None` where an area has none.
///
/// # Errors
/// A raster that cannot be read.
pub(super) fn of_areas<'a>(
    path: &Path,
    place: Georeference,
    areas: impl Iterator<Item = &'a Polygon>,
) -> Result<Vec<Option<CanopyHeights>>, FileError> {
    let reader = geotiff::Reader::open(path)?;
    let own = reader.georeference().ok_or_else(|| {
        FileError::malformed(path, None, "it is not georeferenced; make it again: rowgram surface")
    })?;
    let size = [reader.width(), reader.height()];
    areas.map(|area| of_area(&reader, &own, size, &on_grid(area, place, own))).collect()
}

/// A polygon in pixels of another raster, which may be in another system.
fn on_grid(area: &Polygon, from: Georeference, to: Georeference) -> Polygon {
    let transfer = Transfer::between(&from.crs, &to.crs);
    let moved = |at: &[f64; 2]| to.pixel(transfer.at(from.map(*at))?);
    let rings = area.rings.iter().map(|ring| ring.iter().filter_map(moved).collect());
    Polygon { rings: rings.collect() }
}

fn of_area(
    reader: &geotiff::Reader,
    place: &Georeference,
    size: [usize; 2],
    area: &Polygon,
) -> Result<Option<CanopyHeights>, FileError> {
    let parts = PlotParts::of(area);
    let mut heights = HeightParts::default();
    let runs = area.runs(size[0], size[1]);
    for band in runs.chunk_by(|(v, _), (next, _)| v / geotiff::TILE == next / geotiff::TILE) {
        let u = band.iter().map(|(_, run)| run.start).min().unwrap_or(0);
        let right = band.iter().map(|(_, run)| run.end).max().unwrap_or(u);
        let (v, last) = (band[0].0, band[band.len() - 1].0);
        let window = Window { u, v, width: right - u, height: last + 1 - v };
        let values = reader.read_f32(window)?;
        for (row, run) in band {
            let first = (row - v) * window.width;
            for column in run.clone() {
                let part = parts.at([column as f64, *row as f64]);
                heights.add(part, values[first + column - u]);
            }
        }
    }
    Ok(CanopyHeights::of(&heights, place.gsd_m()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_files::geotiff::{Colour, Layout};
    use rowgram_raster::georeference::Crs;

    #[test]
    fn heights_are_those_of_the_cells_inside() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("chm.tif");
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::LOCAL);
        let layout = Layout {
            width: 20,
            height: 10,
            colour: Colour::Values,
            georeference: Some(place),
            nodata: Some(-9999.0),
        };
        // The height is the column in decimetres; the last row has none.
        let values: Vec<f32> =
            (0..200).map(|k| if k < 180 { 0.1 * (k % 20) as f32 } else { -9999.0 }).collect();
        geotiff::write::<f32, FileError>(&path, false, &layout, |writer| {
            writer.put(Window::whole(20, 10), &values)
        })
        .unwrap();
        // A raster with pixels half as large; columns 4 to 7 of the heights.
        let fine = Georeference::north_up([99.875, 200.125], 0.25, Crs::LOCAL);
        let ring = vec![[7.5, -0.5], [15.5, -0.5], [15.5, 19.5], [7.5, 19.5]];
        let away = vec![[900.0, 0.0], [910.0, 0.0], [910.0, 9.0]];
        let areas = [Polygon { rings: vec![ring] }, Polygon { rings: vec![away] }];
        let found = of_areas(&path, fine, areas.iter()).unwrap();
        let inside = found[0].unwrap();
        assert!((inside.mean_m.value - 0.55).abs() < 1e-6, "{inside:?}");
        // Heights are counted by the millimetre.
        assert!((inside.p95_m.value - 0.7).abs() < 1e-3, "{inside:?}");
        // Means of the four columns of parts are .4 to .7: their scatter is .129, over 16 parts .033.
        assert!((0.028..0.040).contains(&inside.mean_m.sd.unwrap()), "{inside:?}");
        // 36 cells of a quarter of a square metre.
        assert!((inside.area_m2.unwrap() - 9.0).abs() < 1e-9, "{inside:?}");
        assert!(found[1].is_none());
    }
}
