//! Rasters, pictures and tables of the stage, from tiles that are in memory one at a time.

use super::{CANOPY, GROUND, GROUND_SIGMA, SIGMA, SURFACE, SurfaceOutcome};
use crate::{dem::NODATA, figures, map_figures};
use rowgram_base::error::Error;
use rowgram_files::{
    cloud::{CloudPoint, LazWriter},
    geotiff::{self, Colour, Layout, Writer},
    qgis,
};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{georeference::Georeference, window::Window};
use rowgram_survey::mapping::{
    Surface,
    dense::{
        AreaGround, DenseTile, HeightCounts, Pass, Tile, TileStore,
        area::{TILE, starts},
    },
    orientation_sigma::OrientationSigma,
};
use std::path::Path;

// Tiles are written whole.
const _: () = assert!(TILE.is_multiple_of(geotiff::TILE));
/// Width of the classes in which heights of the canopy are counted, metres.
const HEIGHT_CLASS_M: f64 = 1e-3;
/// The same of standard deviations.
const SIGMA_CLASS_M: f64 = 1e-4;

/// The area, its ground, and how far heights were looked for.
pub(super) struct Found<'a> {
    pub(super) area: Tile,
    pub(super) place: &'a Georeference,
    pub(super) ground: &'a AreaGround,
    pub(super) range_m: f64,
    pub(super) orientation: Option<&'a OrientationSigma>,
}

/// Writes everything into the folder of the stage.
pub(super) fn write(
    found: &Found<'_>,
    store: &mut dyn TileStore<Error>,
    folder: &Path,
) -> Result<SurfaceOutcome, Error> {
    let pictures = folder.join("figures");
    std::fs::create_dir_all(&pictures).map_err(|e| FileError::write(&pictures, e))?;
    let mut rasters = Rasters::begin(found, folder)?;
    let mut sums = Sums::new(found);
    for (number, start) in starts(&found.area, TILE).into_iter().enumerate() {
        let Some(tile) = store.load(Pass::Fine, number)? else {
            let message = "a tile of the surface that was matched is gone; run the stage again";
            return Err(FileError::read(folder, std::io::Error::other(message)).into());
        };
        let planes = Planes::new(tile, found);
        rasters.put(start, &planes)?;
        sums.add(start, &planes, found);
    }
    rasters.finish()?;
    sums.draw(found, &pictures)?;
    if found.ground.terrain.is_some() {
        let style = qgis::Style::Raster { range: [0.0, sums.top_m()], quantity: "m" };
        qgis::write(&folder.join("chm.qml"), true, &style)?;
    }
    Ok(sums.outcome(found))
}

/// Writes every cell with a height as a point; its intensity is the confidence in it.
pub(super) fn cloud(
    found: &Found<'_>,
    store: &mut dyn TileStore<Error>,
    path: &Path,
) -> Result<(), Error> {
    let [x, y] = found.area.place_m(0, found.area.size[1].saturating_sub(1));
    let level_m = found.ground.terrain.as_ref().and_then(|terrain| terrain.at_m([x, y]));
    output::write_seekable(path, true, |file| {
        let mut writer =
            LazWriter::begin(file, path, &found.place.crs, [x, y, level_m.unwrap_or(0.0)])?;
        for number in 0..starts(&found.area, TILE).len() {
            let Some(of) = store.load(Pass::Fine, number)? else { continue };
            let width = of.tile.size[0];
            for (at, &top) in of.surface_m.iter().enumerate().filter(|(_, top)| top.is_finite()) {
                let [x, y] = of.tile.place_m(at % width, at / width);
                let point =
                    CloudPoint { position_m: [x, y, f64::from(top)], colour: of.colour[at] };
                writer.put(&point, of.confidence[at])?;
            }
        }
        Ok(writer.finish()?)
    })
}

/// A tile with the ground below it.
struct Planes {
    tile: DenseTile,
    ground_m: Vec<f32>,
    ground_sigma_m: Vec<f32>,
    canopy_m: Vec<f32>,
}

impl Planes {
    fn new(mut tile: DenseTile, found: &Found<'_>) -> Planes {
        let width = tile.tile.size[0];
        // Matching and orientation are independent of each other.
        let with_orientation = |sigma_m: f64, place_m: [f64; 2]| match found.orientation {
            Some(orientation) => orientation.combined_with(sigma_m, place_m),
            None => sigma_m,
        };
        for (at, sigma) in tile.sigma_m.iter_mut().enumerate().filter(|(_, of)| of.is_finite()) {
            let place = tile.tile.place_m(at % width, at / width);
            *sigma = with_orientation(f64::from(*sigma), place) as f32;
        }
        let Some(terrain) = &found.ground.terrain else {
            let [ground_m, ground_sigma_m, canopy_m] = [const { Vec::new() }; 3];
            return Planes { tile, ground_m, ground_sigma_m, canopy_m };
        };
        // The ground is known where photos show something; beyond it is a guess.
        let on_grid = |of: &dyn Fn([f64; 2]) -> Option<f64>| -> Vec<f32> {
            let cell = |at: usize| {
                let value = of(tile.tile.place_m(at % width, at / width));
                value.filter(|_| tile.photos[at] >= 2).map_or(f32::NAN, |value| value as f32)
            };
            (0..tile.surface_m.len()).map(cell).collect()
        };
        let ground_m = on_grid(&|place| terrain.at_m(place));
        let finite = |sigma: &f64| sigma.is_finite();
        let ground_sigma_m = on_grid(&|place| {
            let sigma = terrain.sigma_at_m(place).filter(finite);
            sigma.map(|sigma| with_orientation(sigma, place))
        });
        // Not `max`, which takes zero for what is not known.
        let above = |(top, ground): (&f32, &f32)| if top < ground { 0.0 } else { top - ground };
        let canopy_m = tile.surface_m.iter().zip(&ground_m).map(above).collect();
        Planes { tile, ground_m, ground_sigma_m, canopy_m }
    }
}

/// The rasters that are being written.
struct Rasters {
    heights: Vec<Writer<f32>>,
    bytes: Vec<Writer<u8>>,
}

impl Rasters {
    fn begin(found: &Found<'_>, folder: &Path) -> Result<Rasters, Error> {
        let layout = |nodata: Option<f64>| Layout {
            width: found.area.size[0],
            height: found.area.size[1],
            colour: Colour::Values,
            georeference: Some(*found.place),
            nodata,
        };
        let below: &[&str] = match found.ground.terrain {
            Some(_) => &[GROUND, GROUND_SIGMA, CANOPY],
            None => &[],
        };
        let height =
            |name: &&str| Writer::begin(&folder.join(name), true, &layout(Some(f64::from(NODATA))));
        let heights = [SURFACE, SIGMA].iter().chain(below).map(height).collect::<Result<_, _>>()?;
        let byte = |name: &str| Writer::begin(&folder.join(name), true, &layout(None));
        Ok(Rasters { heights, bytes: vec![byte("confidence.tif")?, byte("photos.tif")?] })
    }

    fn put(&mut self, [u, v]: [usize; 2], of: &Planes) -> Result<(), FileError> {
        let [width, height] = of.tile.tile.size;
        let window = Window { u, v, width, height };
        let heights =
            [&of.tile.surface_m, &of.tile.sigma_m, &of.ground_m, &of.ground_sigma_m, &of.canopy_m];
        for (writer, values) in self.heights.iter_mut().zip(heights) {
            let known: Vec<f32> =
                values.iter().map(|&z| if z.is_finite() { z } else { NODATA }).collect();
            writer.put(window, &known)?;
        }
        for (writer, values) in self.bytes.iter_mut().zip([&of.tile.confidence, &of.tile.photos]) {
            writer.put(window, values)?;
        }
        Ok(())
    }

    fn finish(self) -> Result<(), FileError> {
        self.heights.into_iter().try_for_each(Writer::finish)?;
        self.bytes.into_iter().try_for_each(Writer::finish)
    }
}

/// What is summed over the tiles: numbers, small pictures, profiles.
struct Sums {
    size: [usize; 2],
    seen: usize,
    with_height: usize,
    canopy: HeightCounts,
    surface_sigma: HeightCounts,
    orientation_sigma: HeightCounts,
    ground_sigma: HeightCounts,
    /// Every so-manieth cell is in the pictures.
    step: usize,
    small: [usize; 2],
    surface_m: Vec<f32>,
    canopy_m: Vec<f32>,
    /// Surface and ground along the middle row and the middle column.
    row_m: Vec<[f32; 2]>,
    column_m: Vec<[f32; 2]>,
}

impl Sums {
    fn new(found: &Found<'_>) -> Sums {
        let size = found.area.size;
        let step = figures::step(size[0], size[1]);
        let small = size.map(|n| n.div_ceil(step));
        let empty = vec![f32::NAN; small[0] * small[1]];
        Sums {
            size,
            seen: 0,
            with_height: 0,
            canopy: HeightCounts::new(HEIGHT_CLASS_M),
            surface_sigma: HeightCounts::new(SIGMA_CLASS_M),
            orientation_sigma: HeightCounts::new(SIGMA_CLASS_M),
            ground_sigma: HeightCounts::new(SIGMA_CLASS_M),
            step,
            small,
            surface_m: empty.clone(),
            canopy_m: empty,
            row_m: vec![[f32::NAN; 2]; size[0]],
            column_m: vec![[f32::NAN; 2]; size[1]],
        }
    }

    fn add(&mut self, start: [usize; 2], of: &Planes, found: &Found<'_>) {
        let width = of.tile.tile.size[0];
        let middle = self.size.map(|n| n / 2);
        for at in 0..of.tile.surface_m.len() {
            let [u, v] = [start[0] + at % width, start[1] + at / width];
            let top = of.tile.surface_m[at];
            if of.tile.photos[at] >= 2 {
                self.seen += 1;
                self.with_height += usize::from(top.is_finite());
            }
            let below = of.ground_m.get(at).copied().unwrap_or(f32::NAN);
            let canopy = of.canopy_m.get(at).copied().unwrap_or(f32::NAN);
            self.canopy.add(f64::from(canopy));
            self.surface_sigma.add(f64::from(of.tile.sigma_m[at]));
            if let Some(orientation) = found.orientation.filter(|_| top.is_finite()) {
                let place = of.tile.tile.place_m(at % width, at / width);
                self.orientation_sigma.add(orientation.at_m(place));
            }
            if let Some(&sigma) = of.ground_sigma_m.get(at) {
                self.ground_sigma.add(f64::from(sigma));
            }
            if u.is_multiple_of(self.step) && v.is_multiple_of(self.step) {
                let to = v / self.step * self.small[0] + u / self.step;
                (self.surface_m[to], self.canopy_m[to]) = (top, canopy);
            }
            if v == middle[1] {
                self.row_m[u] = [top, below];
            }
            if u == middle[0] {
                self.column_m[v] = [top, below];
            }
        }
    }

    /// Where the colours of the height of the canopy end.
    fn top_m(&self) -> f64 {
        self.canopy.percentile_m(0.995).unwrap_or(0.0).max(0.05)
    }

    fn outcome(&self, found: &Found<'_>) -> SurfaceOutcome {
        let has_ground = found.ground.terrain.is_some();
        let percentile = |share| self.canopy.percentile_m(share);
        SurfaceOutcome {
            surface: SURFACE.into(),
            ground: has_ground.then(|| GROUND.into()),
            canopy: has_ground.then(|| CANOPY.into()),
            cloud: None,
            width_px: self.size[0],
            height_px: self.size[1],
            cell_m: found.area.cell_m,
            epsg: found.place.crs.epsg,
            range_m: found.range_m,
            layer_m: found.ground.layer_m,
            cells_seen: self.seen,
            cells_with_height: self.with_height,
            median_surface_sigma_m: self.surface_sigma.percentile_m(0.5),
            median_orientation_sigma_m: self.orientation_sigma.percentile_m(0.5),
            median_ground_sigma_m: self.ground_sigma.percentile_m(0.5),
            canopy_percentiles_m: percentile(0.5)
                .zip(percentile(0.95))
                .zip(percentile(0.99))
                .map(|((a, b), c)| [a, b, c]),
            canopy_picture_to_m: has_ground.then(|| self.top_m()),
        }
    }

    fn draw(&self, found: &Found<'_>, folder: &Path) -> Result<(), Error> {
        // Cells of the picture are `step` times as far apart.
        let place = Georeference {
            per_column: found.place.per_column.map(|c| c * self.step as f64),
            per_row: found.place.per_row.map(|c| c * self.step as f64),
            ..*found.place
        };
        let surface = Surface::new(place, self.small, self.surface_m.clone())?;
        map_figures::draw_surface(folder, &surface)?;
        if found.ground.terrain.is_some() {
            map_figures::draw_canopy(folder, self.small, &self.canopy_m, self.top_m())?;
            self.profile(found, folder)?;
        }
        Ok(())
    }

    /// Surface and ground along the middle row of the map, drawn, and along its middle row and column as a table.
    fn profile(&self, found: &Found<'_>, folder: &Path) -> Result<(), Error> {
        let [width, height] = self.size;
        let text =
            |value: f32| if value.is_finite() { format!("{value:.4}") } else { String::new() };
        let mut csv = String::from("direction,x_m,y_m,surface_m,ground_m\n");
        let along = self.row_m.iter().enumerate().map(|(u, of)| ("east", [u, height / 2], of));
        let across = self.column_m.iter().enumerate().map(|(v, of)| ("south", [width / 2, v], of));
        for (direction, [u, v], &[top, below]) in along.chain(across) {
            let [x, y] = found.area.place_m(u, v);
            let (top, below) = (text(top), text(below));
            csv += &format!("{direction},{x:.4},{y:.4},{top},{below}\n");
        }
        let line = |which: usize| -> Vec<(f64, f64)> {
            let cells = self.row_m.iter().map(|of| of[which]).enumerate();
            let known = cells.filter(|(_, z)| z.is_finite());
            known.map(|(u, z)| (u as f64 * found.area.cell_m, f64::from(z))).collect()
        };
        let svg = figures::profile(&line(0), &line(1))
            .map_err(|e| FileError::write(folder, std::io::Error::other(e.to_string())))?;
        Ok(figures::write_drawing(folder, "profile.svg", true, &svg, &csv)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;
    use rowgram_survey::mapping::dense::area::TilesInMemory;

    #[test]
    fn the_cloud_has_every_cell_with_a_height() {
        let place = Georeference::north_up([500_000.0, 4_480_000.0], 0.02, Crs::projected(32616));
        let area = Tile { corner_m: place.origin, cell_m: 0.02, size: [3, 2] };
        let mut tile = DenseTile {
            tile: area,
            surface_m: vec![200.0, f32::NAN, 200.25, 199.5, 200.0, f32::NAN],
            confidence: vec![10, 0, 255, 0, 30, 0],
            photos: vec![2; 6],
            sigma_m: vec![0.01; 6],
            colour: vec![[1, 2, 3]; 6],
        };
        tile.colour[2] = [255, 0, 128];
        let mut store = TilesInMemory::default();
        let tiles: &mut dyn TileStore<Error> = &mut store;
        tiles.save(Pass::Fine, 0, &tile).unwrap();
        let ground = AreaGround { terrain: None, layer_m: 0.01 };
        let found = Found { area, place: &place, ground: &ground, range_m: 1.0, orientation: None };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("dsm.laz");
        cloud(&found, &mut store, &path).unwrap();
        let mut reader = las::Reader::from_path(&path).unwrap();
        let points: Vec<las::Point> = reader.points().map(Result::unwrap).collect();
        assert_eq!(points.len(), 4);
        let third = &points[1];
        let [x, y] = area.place_m(2, 0);
        assert!((third.x - x).abs() < 1e-4 && (third.y - y).abs() < 1e-4, "{third:?}");
        assert!((third.z - 200.25).abs() < 1e-4, "{third:?}");
        assert_eq!(third.intensity, 255 * 257);
        let colour = third.color.unwrap();
        assert_eq!((colour.red, colour.blue), (255 * 257, 128 * 257));
        assert!((points[2].z - 199.5).abs() < 1e-4, "{points:?}");
    }
}
