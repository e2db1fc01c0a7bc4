//! Rasters, pictures and tables of the stage, from parts of the map that are in memory one at a time.

use super::{
    CANOPY, CONFIDENCE, GROUND, GROUND_SIGMA, SIGMA, SURFACE, SurfaceOutcome, ground::Ground,
};
use crate::{dem::NODATA, figures, map_figures};
use rowgram_base::error::Error;
use rowgram_files::{
    cloud::{CloudPoint, LazWriter},
    geotiff::{self, Colour, Layout, Writer},
    qgis,
};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{
    georeference::Georeference,
    height_counts::{HEIGHT_CLASS_M, HeightCounts},
    window::Window,
};
use rowgram_survey::mapping::{
    Surface,
    dense::{
        DenseTile,
        area::{TILE, starts},
    },
    orientation_sigma::OrientationSigma,
};
use std::path::Path;

// Parts are written whole.
const _: () = assert!(TILE.is_multiple_of(geotiff::TILE));
/// Width of the classes in which standard deviations are counted, metres.
const SIGMA_CLASS_M: f64 = 1e-4;

/// The cells of a surface, its ground, and how it was matched.
pub(super) struct Found<'a> {
    pub(super) place: &'a Georeference,
    pub(super) size: [usize; 2],
    pub(super) ground: &'a Ground,
    /// Side of a cell on the ground, metres.
    pub(super) cell_m: f64,
    /// `None` where the surface comes from elsewhere.
    pub(super) matching: Option<Matching<'a>>,
}

/// How a surface was matched.
#[derive(Clone, Copy)]
pub(super) struct Matching<'a> {
    /// How far heights were looked for, metres.
    pub(super) range_m: f64,
    /// Distance of the layers that were compared, metres.
    pub(super) layer_m: f64,
    pub(super) orientation: Option<&'a OrientationSigma>,
}

/// What is known of the cells of a part of a surface.
pub(super) enum SurfacePart {
    Matched(DenseTile),
    /// Heights from elsewhere, metres; NaN where there are none.
    Given(Vec<f32>),
}

/// Writes everything into the folder of the stage; `load` has the parts by number, in the order of [`starts`].
pub(super) fn write(
    found: &Found<'_>,
    load: &mut dyn FnMut(usize, Window) -> Result<SurfacePart, Error>,
    folder: &Path,
) -> Result<SurfaceOutcome, Error> {
    let pictures = folder.join("figures");
    std::fs::create_dir_all(&pictures).map_err(|e| FileError::write(&pictures, e))?;
    let mut rasters = Rasters::begin(found, folder)?;
    let mut sums = Sums::new(found);
    for (number, window) in windows(found.size).enumerate() {
        let planes = Planes::new(load(number, window)?, window, found)?;
        rasters.put(&planes)?;
        sums.add(&planes);
    }
    rasters.finish()?;
    sums.draw(found, &pictures)?;
    if found.ground.is_known() {
        let style = qgis::Style::Raster { range: [0.0, sums.top_m()], quantity: "m" };
        qgis::write(&folder.join("chm.qml"), true, &style)?;
    }
    Ok(sums.outcome(found))
}

/// The parts of a map of so many columns and rows.
fn windows([columns, rows]: [usize; 2]) -> impl Iterator<Item = Window> {
    starts([columns, rows], TILE).into_iter().map(move |[u, v]| {
        let [width, height] = [TILE.min(columns - u), TILE.min(rows - v)];
        Window { u, v, width, height }
    })
}

/// Writes every cell with a height as a point; its intensity is the confidence in it.
pub(super) fn cloud(
    found: &Found<'_>,
    load: &mut dyn FnMut(usize, Window) -> Result<DenseTile, Error>,
    path: &Path,
) -> Result<(), Error> {
    let last = Window { u: 0, v: found.size[1].saturating_sub(1), width: 1, height: 1 };
    let [x, y] = found.place.map([0.0, last.v as f64]);
    let [ground_m, _] = found.ground.on(found.place, last)?;
    let level_m = ground_m.first().map(|&z| f64::from(z)).filter(|z| z.is_finite());
    output::write_seekable(path, true, |file| {
        let mut writer =
            LazWriter::begin(file, path, &found.place.crs, [x, y, level_m.unwrap_or(0.0)])?;
        for (number, window) in windows(found.size).enumerate() {
            let of = load(number, window)?;
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

/// A part with the ground below it; what is not known of any cell is empty.
struct Planes {
    window: Window,
    surface_m: Vec<f32>,
    sigma_m: Vec<f32>,
    ground_m: Vec<f32>,
    ground_sigma_m: Vec<f32>,
    canopy_m: Vec<f32>,
    confidence: Vec<u8>,
    photos: Vec<u8>,
    /// What orientation leaves of heights unknown.
    orientation_m: Vec<f32>,
}

impl Planes {
    fn new(part: SurfacePart, window: Window, found: &Found<'_>) -> Result<Planes, Error> {
        let place = |at: usize| {
            found
                .place
                .map([window.u + at % window.width, window.v + at / window.width].map(|c| c as f64))
        };
        let [ground_m, ground_sigma_m] = found.ground.on(found.place, window)?;
        let (surface_m, sigma_m, confidence, photos) = match part {
            SurfacePart::Matched(tile) => {
                (tile.surface_m, tile.sigma_m, tile.confidence, tile.photos)
            }
            SurfacePart::Given(surface_m) => (surface_m, Vec::new(), Vec::new(), Vec::new()),
        };
        let (canopy_m, orientation_m) = (Vec::new(), Vec::new());
        let mut planes = Planes {
            window,
            surface_m,
            sigma_m,
            ground_m,
            ground_sigma_m,
            canopy_m,
            confidence,
            photos,
            orientation_m,
        };
        if found.ground.has_sigma() {
            // A fit is known where something is seen; beyond it is a guess.
            for at in 0..planes.ground_m.len() {
                if !planes.is_seen(at) {
                    (planes.ground_m[at], planes.ground_sigma_m[at]) = (f32::NAN, f32::NAN);
                }
            }
        }
        if let Some(orientation) = found.matching.and_then(|matching| matching.orientation) {
            planes.add_orientation(|at| orientation.at_m(place(at)));
        }
        // Not `max`, which takes zero for what is not known.
        let above = |(top, ground): (&f32, &f32)| if top < ground { 0.0 } else { top - ground };
        planes.canopy_m = planes.surface_m.iter().zip(&planes.ground_m).map(above).collect();
        Ok(planes)
    }

    /// Adds what orientation leaves unknown to the standard deviations: matching and orientation are independent of each other.
    fn add_orientation(&mut self, at_m: impl Fn(usize) -> f64) {
        self.orientation_m = vec![f32::NAN; self.surface_m.len()];
        for (at, orientation_m) in self.orientation_m.iter_mut().enumerate() {
            let mut sigmas = [self.sigma_m.get_mut(at), self.ground_sigma_m.get_mut(at)];
            if sigmas.iter().flatten().all(|sigma| !sigma.is_finite()) {
                continue;
            }
            let own = at_m(at);
            *orientation_m = own as f32;
            for sigma in sigmas.iter_mut().flatten().filter(|sigma| sigma.is_finite()) {
                let matched = f64::from(**sigma);
                **sigma = (matched * matched + own * own).sqrt() as f32;
            }
        }
    }

    /// Whether two photos show a cell, or a surface that was given has a height there.
    fn is_seen(&self, at: usize) -> bool {
        match self.photos.get(at) {
            Some(&photos) => photos >= 2,
            None => self.surface_m[at].is_finite(),
        }
    }

    /// Rasters of heights, as [`Rasters::begin`] has them.
    fn heights(&self) -> [&Vec<f32>; 5] {
        [&self.surface_m, &self.sigma_m, &self.ground_m, &self.ground_sigma_m, &self.canopy_m]
    }
}

/// The rasters that are being written.
struct Rasters {
    heights: [Option<Writer<f32>>; 5],
    bytes: [Option<Writer<u8>>; 2],
}

impl Rasters {
    fn begin(found: &Found<'_>, folder: &Path) -> Result<Rasters, Error> {
        let layout = |nodata: Option<f64>| Layout {
            width: found.size[0],
            height: found.size[1],
            colour: Colour::Values,
            georeference: Some(*found.place),
            nodata,
        };
        let (is_matched, ground) = (found.matching.is_some(), found.ground);
        let height = |name: &str, is_there: bool| {
            let layout = layout(Some(f64::from(NODATA)));
            is_there.then(|| Writer::begin(&folder.join(name), true, &layout)).transpose()
        };
        let byte = |name: &str| {
            is_matched.then(|| Writer::begin(&folder.join(name), true, &layout(None))).transpose()
        };
        let heights = [
            height(SURFACE, true)?,
            height(SIGMA, is_matched)?,
            height(GROUND, ground.is_known())?,
            height(GROUND_SIGMA, ground.has_sigma())?,
            height(CANOPY, ground.is_known())?,
        ];
        Ok(Rasters { heights, bytes: [byte(CONFIDENCE)?, byte("photos.tif")?] })
    }

    fn put(&mut self, of: &Planes) -> Result<(), FileError> {
        for (writer, values) in self.heights.iter_mut().zip(of.heights()) {
            let Some(writer) = writer else { continue };
            let known: Vec<f32> =
                values.iter().map(|&z| if z.is_finite() { z } else { NODATA }).collect();
            writer.put(of.window, &known)?;
        }
        for (writer, values) in self.bytes.iter_mut().zip([&of.confidence, &of.photos]) {
            if let Some(writer) = writer {
                writer.put(of.window, values)?;
            }
        }
        Ok(())
    }

    fn finish(self) -> Result<(), FileError> {
        self.heights.into_iter().flatten().try_for_each(Writer::finish)?;
        self.bytes.into_iter().flatten().try_for_each(Writer::finish)
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
    ground_m: Vec<f32>,
    canopy_m: Vec<f32>,
    /// Surface and ground along the middle row and the middle column.
    row_m: Vec<[f32; 2]>,
    column_m: Vec<[f32; 2]>,
}

impl Sums {
    fn new(found: &Found<'_>) -> Sums {
        let size = found.size;
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
            ground_m: empty.clone(),
            canopy_m: empty,
            row_m: vec![[f32::NAN; 2]; size[0]],
            column_m: vec![[f32::NAN; 2]; size[1]],
        }
    }

    fn add(&mut self, of: &Planes) {
        let Window { u, v, width, .. } = of.window;
        let middle = self.size.map(|n| n / 2);
        for at in 0..of.surface_m.len() {
            let [u, v] = [u + at % width, v + at / width];
            let top = of.surface_m[at];
            if of.is_seen(at) {
                self.seen += 1;
                self.with_height += usize::from(top.is_finite());
            }
            let or_none = |values: &[f32]| values.get(at).copied().unwrap_or(f32::NAN);
            let (below, canopy) = (or_none(&of.ground_m), or_none(&of.canopy_m));
            self.canopy.add(f64::from(canopy));
            self.surface_sigma.add(f64::from(or_none(&of.sigma_m)));
            if top.is_finite() {
                self.orientation_sigma.add(f64::from(or_none(&of.orientation_m)));
            }
            self.ground_sigma.add(f64::from(or_none(&of.ground_sigma_m)));
            if u.is_multiple_of(self.step) && v.is_multiple_of(self.step) {
                let to = v / self.step * self.small[0] + u / self.step;
                (self.surface_m[to], self.ground_m[to], self.canopy_m[to]) = (top, below, canopy);
            }
            if v == middle[1] {
                self.row_m[u] = [top, below];
            }
            if u == middle[0] {
                self.column_m[v] = [top, below];
            }
        }
    }

    /// How far the surface is above the ground at the places of the pictures, metres, sorted; below it where negative.
    fn above_m(&self) -> Vec<f32> {
        let both = self.surface_m.iter().zip(&self.ground_m);
        let mut above: Vec<f32> =
            both.map(|(top, ground)| top - ground).filter(|z| z.is_finite()).collect();
        above.sort_by(f32::total_cmp);
        above
    }

    /// Where the colours of the height of the canopy end.
    fn top_m(&self) -> f64 {
        self.canopy.percentile_m(0.995).unwrap_or(0.0).max(0.05)
    }

    fn outcome(&self, found: &Found<'_>) -> SurfaceOutcome {
        let has_ground = found.ground.is_known();
        let percentile = |share| self.canopy.percentile_m(share);
        SurfaceOutcome {
            surface: SURFACE.into(),
            ground: has_ground.then(|| GROUND.into()),
            canopy: has_ground.then(|| CANOPY.into()),
            cloud: None,
            width_px: self.size[0],
            height_px: self.size[1],
            cell_m: found.cell_m,
            epsg: found.place.crs.epsg,
            given: None,
            range_m: found.matching.map(|of| of.range_m),
            layer_m: found.matching.map(|of| of.layer_m),
            cells_seen: self.seen,
            cells_with_height: self.with_height,
            median_surface_sigma_m: self.surface_sigma.percentile_m(0.5),
            median_orientation_sigma_m: self.orientation_sigma.percentile_m(0.5),
            median_ground_sigma_m: self.ground_sigma.percentile_m(0.5),
            canopy_percentiles_m: percentile(0.5)
                .zip(percentile(0.95))
                .zip(percentile(0.99))
                .map(|((a, b), c)| [a, b, c]),
            above_ground_m: shares(&self.above_m()),
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
        if found.ground.is_known() {
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
            let [x, y] = found.place.map([u as f64, v as f64]);
            let (top, below) = (text(top), text(below));
            csv += &format!("{direction},{x:.4},{y:.4},{top},{below}\n");
        }
        let line = |which: usize| -> Vec<(f64, f64)> {
            let cells = self.row_m.iter().map(|of| of[which]).enumerate();
            let known = cells.filter(|(_, z)| z.is_finite());
            known.map(|(u, z)| (u as f64 * found.cell_m, f64::from(z))).collect()
        };
        let draw = |svg: &mut String| figures::profile(svg, &line(0), &line(1));
        Ok(figures::write_drawing(folder, "profile.svg", true, draw, &csv)?)
    }
}

/// What a twentieth and a half of sorted values do not exceed.
fn shares(sorted: &[f32]) -> Option<[f64; 2]> {
    let at = |share: f64| sorted.get((share * sorted.len() as f64) as usize).map(|&z| f64::from(z));
    at(0.05).zip(at(0.5)).map(|(low, middle)| [low, middle])
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;
    use rowgram_survey::mapping::dense::{Margin, Tile};

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
            margin: Margin::unknown([3, 2]),
        };
        tile.colour[2] = [255, 0, 128];
        let ground = Ground::Unknown;
        let matching = Some(Matching { range_m: 1.0, layer_m: 0.01, orientation: None });
        let found =
            Found { place: &place, size: area.size, ground: &ground, cell_m: 0.02, matching };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("dsm.laz");
        cloud(&found, &mut |_, _| Ok(tile.clone()), &path).unwrap();
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
