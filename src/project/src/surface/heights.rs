//! Heights on a map that another program or sensor made: a GeoTIFF, or a cloud whose highest points stand for its cells.

use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{cloud::CloudReader, geotiff::Reader, memory};
use rowgram_optim::output::{FileError, name_of};
use rowgram_raster::{
    georeference::{Crs, CrsKind, Georeference, Transfer},
    window::{self, Window},
};
use rowgram_survey::mapping::grid::rounded;
use std::path::Path;

/// Heights, read window by window.
pub(super) struct Heights {
    /// Where the cells lie.
    pub(super) place: Georeference,
    /// Columns and rows.
    pub(super) size: [usize; 2],
    values: Values,
    screen: Screen,
}

enum Values {
    File(Box<Reader>),
    /// Of a cloud, metres; NaN where it has no point.
    Cells(Vec<f32>),
}

/// Whether a file is a point cloud, by its name.
pub(super) fn is_cloud(path: &Path) -> bool {
    let is = |ending: &str| path.extension().is_some_and(|own| own.eq_ignore_ascii_case(ending));
    is("las") || is("laz")
}

/// Side of the cells of a cloud, in distances of its points if they lay evenly: of points at random nine cells in ten have one.
const CELL_DISTANCES: f64 = 1.5;
/// Known neighbours, of eight, with which a cell without a point gets their mean: more than half. Not measured.
const NEIGHBOURS: usize = 5;
/// Positions of this many cells are interpolated between their ends: over so short a way two projections differ by a linear map.
const STEP: usize = 64;

impl Heights {
    /// Opens a raster.
    ///
    /// # Errors
    /// Names the file: no place on a map, colours.
    pub(super) fn raster(path: &Path) -> Result<Heights, FileError> {
        let reader = Reader::open(path)?;
        let fault = |message: &str| FileError::malformed(path, None, message);
        let Some(place) = reader.georeference() else {
            return Err(fault("it is not georeferenced; expected a GeoTIFF of heights"));
        };
        if reader.is_colour() || reader.bands() != 1 {
            return Err(fault("expected heights, which are one band"));
        }
        if place.pixel_m().is_none() {
            return Err(fault(
                "it does not say how large its cells are on the ground; expected a reference system",
            ));
        }
        let size = [reader.width(), reader.height()];
        Heights::screened(place, size, Values::File(Box::new(reader)))
    }

    /// Lays a cloud on cells, of which each takes its highest point; `cell_m` is their side where it is given. `map` is its system where the
    /// file does not say one.
    ///
    /// # Errors
    /// Names the file: no cloud, not in metres, more cells than memory.
    pub(super) fn cloud(
        path: &Path,
        cell_m: Option<f64>,
        map: Option<Crs>,
    ) -> Result<Heights, FileError> {
        let mut reader = CloudReader::open(path)?;
        let crs = cloud_crs(&reader, map, path)?;
        let [[west, east], [south, north]] = reader.bounds();
        let area = (east - west) * (north - south);
        let cell_m = match cell_m {
            Some(cell_m) => cell_m,
            None => rounded(CELL_DISTANCES * (area / reader.points() as f64).sqrt(), 3),
        };
        let count = |length: f64| (length / cell_m).floor() + 1.0;
        let [columns, rows] = [count(east - west), count(north - south)];
        if !(columns * rows).is_finite() || cell_m <= 0.0 {
            let message = format!(
                "its points lie within {:.3} x {:.3} m, which is no area",
                east - west,
                north - south
            );
            return Err(FileError::malformed(path, None, message));
        }
        let what = format!("{columns} x {rows} cells of {cell_m} m");
        memory::require(path, &what, (8.0 * columns * rows) as u64)?;
        let size = [columns as usize, rows as usize];
        let mut cells = vec![f32::NAN; size[0] * size[1]];
        reader.each(|point| {
            let [x, y, z] = point.position;
            let at = [(x - west) / cell_m, (north - y) / cell_m];
            if (0..2).all(|k| at[k] >= 0.0 && at[k] < size[k] as f64) {
                let cell = &mut cells[at[1] as usize * size[0] + at[0] as usize];
                *cell = cell.max(z as f32);
            }
        })?;
        let corner = [west + 0.5 * cell_m, north - 0.5 * cell_m];
        let place = Georeference::north_up(corner, cell_m, crs);
        Heights::screened(place, size, Values::Cells(filled(&cells, size)))
    }

    fn screened(
        place: Georeference,
        size: [usize; 2],
        values: Values,
    ) -> Result<Heights, FileError> {
        let mut heights = Heights { place, size, values, screen: Screen::default() };
        let mut counts = Counts::default();
        for band in window::bands(size[1], BAND, 0) {
            counts.add(&heights.window(Window::rows(size[0], band.rows))?);
        }
        heights.screen = counts.screen();
        Ok(heights)
    }

    /// Says which heights were left out.
    pub(super) fn warn(&self, path: &Path, monitor: &mut dyn Monitor) {
        let Screen { excluded, excluded_m: [lowest, highest], low_m, high_m, .. } = self.screen;
        if excluded == 0 {
            return;
        }
        let message = format!(
            "{excluded} of its cells ({lowest:.0} to {highest:.0} m) are far from all others, which are {low_m:.0} to {high_m:.0} m, and \
             are left out of heights and volume: heights beyond {GAP_M} m without any cell are no crop or tree, and 0 beyond \
             {ZERO_GAP_M} m stands for no height (assumed)"
        );
        let remedy = "state the value of cells without data in the file (gdal_edit.py -a_nodata)";
        let found = Diagnostic::warning("heights-implausible", name_of(path), message);
        monitor.diagnostic(&found.with_remedy(remedy));
    }

    /// The heights of a window, row by row, metres; NaN where there are none.
    ///
    /// # Errors
    /// A file that is damaged.
    pub(super) fn window(&self, window: Window) -> Result<Vec<f32>, FileError> {
        match &self.values {
            Values::File(reader) => {
                let mut values = reader.read_f32(window)?;
                // What stands for no height where a file does not say so.
                let is_none = |z: &f32| z.abs() > HIGHEST_M || self.screen.leaves_out(*z);
                values.iter_mut().filter(|z| is_none(z)).for_each(|z| *z = f32::NAN);
                Ok(values)
            }
            Values::Cells(cells) => {
                let rows = (window.v..window.v + window.height)
                    .flat_map(|v| &cells[v * self.size[0] + window.u..][..window.width]);
                let kept = |z: &f32| if self.screen.leaves_out(*z) { f32::NAN } else { *z };
                Ok(rows.map(kept).collect())
            }
        }
    }

    /// The heights at the cells of a window of another raster, linear between the nearest of those that are known; NaN where the nearest is
    /// not.
    ///
    /// # Errors
    /// A file that is damaged.
    pub(super) fn on(&self, place: &Georeference, window: Window) -> Result<Vec<f32>, FileError> {
        let at = self.positions(place, window);
        let reach = |k: usize| {
            let known = || at.iter().flatten().map(|at| at[k]);
            let (low, high) =
                known().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
            let end = self.size[k] as f64;
            let [first, last] =
                [low.floor(), high.floor() + 2.0].map(|x| x.clamp(0.0, end) as usize);
            (first, last.saturating_sub(first))
        };
        let ((u, width), (v, height)) = (reach(0), reach(1));
        if width == 0 || height == 0 {
            return Ok(vec![f32::NAN; at.len()]);
        }
        let values = self.window(Window { u, v, width, height })?;
        let node = |i: f64, j: f64| {
            let (i, j) = (i - u as f64, j - v as f64);
            let inside = i >= 0.0 && j >= 0.0 && i < width as f64 && j < height as f64;
            inside.then(|| values[j as usize * width + i as usize]).filter(|z| z.is_finite())
        };
        let between = |at: &Option<[f64; 2]>| {
            let Some([x, y]) = *at else { return f32::NAN };
            if node(x.round(), y.round()).is_none() {
                return f32::NAN;
            }
            let (mut sum, mut weights) = (0.0, 0.0);
            for (i, j) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                let near = [x.floor() + i, y.floor() + j];
                let weight = (1.0 - (x - near[0]).abs()) * (1.0 - (y - near[1]).abs());
                if let Some(z) = node(near[0], near[1]) {
                    sum += weight * f64::from(z);
                    weights += weight;
                }
            }
            (sum / weights) as f32
        };
        Ok(at.iter().map(between).collect())
    }

    /// Refuses heights that lie beside another raster.
    ///
    /// # Errors
    /// Names `path`, their file, and how far away they are.
    pub(super) fn require_on(
        &self,
        path: &Path,
        place: &Georeference,
        size: [usize; 2],
    ) -> Result<(), FileError> {
        let transfer = Transfer::between(&place.crs, &self.place.crs);
        let own = |[s, t]: [f64; 2]| {
            let at = place.map([s * size[0] as f64, t * size[1] as f64]);
            self.place.pixel(transfer.at(at)?)
        };
        let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(own);
        let is_on = |k: usize| {
            let at = || corners.iter().flatten().map(|at| at[k]);
            at().any(|x| x > 0.0) && at().any(|x| x < self.size[k] as f64)
        };
        if is_on(0) && is_on(1) {
            return Ok(());
        }
        let away = own([0.5, 0.5]).zip(self.place.pixel_m()).map(|(at, pixel_m)| {
            let off = [0, 1].map(|k| (at[k] - 0.5 * self.size[k] as f64) * pixel_m[k]);
            format!(", whose middle is {:.0} m away", off[0].hypot(off[1]))
        });
        let message = format!("it shows nothing of the orthomosaic{}", away.unwrap_or_default());
        Err(FileError::malformed(path, None, message))
    }

    /// Where the cells of a window of another raster are, in own cells.
    fn positions(&self, place: &Georeference, window: Window) -> Vec<Option<[f64; 2]>> {
        let transfer = Transfer::between(&place.crs, &self.place.crs);
        let exact = |u: f64, v: f64| self.place.pixel(transfer.at(place.map([u, v]))?);
        let mut found = vec![None; window.width * window.height];
        let starts = |length: usize| (0..length).step_by(STEP);
        for (row, column) in starts(window.height)
            .flat_map(|row| starts(window.width).map(move |column| (row, column)))
        {
            let ends = [column, column + STEP].map(|u| (window.u + u) as f64);
            let [above, below] =
                [row, row + STEP].map(|v| ends.map(|u| exact(u, (window.v + v) as f64)));
            let ([Some(a), Some(b)], [Some(c), Some(d)]) = (above, below) else { continue };
            for v in row..(row + STEP).min(window.height) {
                let t = (v - row) as f64 / STEP as f64;
                for u in column..(column + STEP).min(window.width) {
                    let s = (u - column) as f64 / STEP as f64;
                    found[v * window.width + u] = Some([0, 1].map(|k| {
                        (a[k] * (1.0 - s) + b[k] * s) * (1.0 - t)
                            + (c[k] * (1.0 - s) + d[k] * s) * t
                    }));
                }
            }
        }
        found
    }
}

/// Heights beyond this are none, metres: the deepest sea and the highest mountain are within it.
const HIGHEST_M: f32 = 12_000.0;

/// Heights that are separated from most others by as many metres without any cell are none: crops, trees and slopes have cells at the heights between.
/// Assumed.
const GAP_M: i32 = 30;
/// The same of cells of exactly 0, which some programs write for no height.
const ZERO_GAP_M: i32 = 5;
/// Rows of a surface that are in memory together.
pub(super) const BAND: usize = 256;

/// Which heights are left out.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Screen {
    low_m: f32,
    high_m: f32,
    without_zero: bool,
    /// The number of those left out, the lowest and the highest.
    excluded: u64,
    excluded_m: [f32; 2],
}

impl Default for Screen {
    fn default() -> Screen {
        let [low_m, high_m] = [f32::NEG_INFINITY, f32::INFINITY];
        Screen { low_m, high_m, without_zero: false, excluded: 0, excluded_m: [0.0; 2] }
    }
}

impl Screen {
    fn leaves_out(&self, z: f32) -> bool {
        z < self.low_m || z > self.high_m || self.without_zero && z == 0.0
    }
}

/// How many cells have heights of each metre, those of exactly 0 apart.
struct Counts {
    /// From -[`HIGHEST_M`] on.
    by_metre: Vec<u64>,
    zeros: u64,
}

impl Default for Counts {
    fn default() -> Counts {
        Counts { by_metre: vec![0; 2 * HIGHEST_M as usize + 1], zeros: 0 }
    }
}

impl Counts {
    fn add(&mut self, heights: &[f32]) {
        for z in heights.iter().filter(|z| z.is_finite()) {
            match *z == 0.0 {
                true => self.zeros += 1,
                false => {
                    let place = (z + HIGHEST_M) as usize;
                    self.by_metre[place.min(2 * HIGHEST_M as usize)] += 1;
                }
            }
        }
    }

    /// Keeps the heights without a gap of which there are most.
    fn screen(&self) -> Screen {
        let counts = (-(HIGHEST_M as i32)..).zip(self.by_metre.iter().copied());
        let metres: Vec<(i32, u64)> = counts.filter(|(_, count)| *count > 0).collect();
        let cells = |of: &[(i32, u64)]| of.iter().map(|(_, count)| count).sum::<u64>();
        let groups = metres.chunk_by(|(a, _), (b, _)| b - a <= GAP_M);
        let Some(kept) = groups.max_by_key(|of| cells(of)) else { return Screen::default() };
        let (mut first, mut last) = (kept[0].0, kept[kept.len() - 1].0);
        let near_zero = -1 - ZERO_GAP_M..=ZERO_GAP_M;
        let without_zero = self.zeros > 0 && !kept.iter().any(|(at, _)| near_zero.contains(at));
        if self.zeros > 0 && !without_zero {
            (first, last) = (first.min(0), last.max(0));
        }
        let zeros = if without_zero { self.zeros } else { 0 };
        let others = metres.iter().map(|(at, _)| *at).filter(|at| !(first..=last).contains(at));
        let others = others.chain(without_zero.then_some(0)).map(|at| at as f32);
        let lowest = others.clone().reduce(f32::min).unwrap_or(0.0);
        let highest = others.reduce(f32::max).unwrap_or(0.0);
        Screen {
            low_m: first as f32,
            high_m: (last + 1) as f32,
            without_zero,
            excluded: cells(&metres) - cells(kept) + zeros,
            excluded_m: [lowest, highest],
        }
    }
}

/// The system of a cloud in metres.
///
/// # Errors
/// One that is in degrees or feet.
pub(super) fn cloud_crs(
    reader: &CloudReader,
    map: Option<Crs>,
    path: &Path,
) -> Result<Crs, FileError> {
    let crs = reader.crs().or(map).unwrap_or(Crs::LOCAL);
    match crs.kind {
        CrsKind::Projected => Ok(crs),
        _ => {
            let message = "its coordinates are not in metres; save it in a projected reference system in metres";
            Err(FileError::malformed(path, None, message))
        }
    }
}

/// Cells without a point among neighbours that have one get their mean.
fn filled(cells: &[f32], [width, height]: [usize; 2]) -> Vec<f32> {
    let mut filled = cells.to_vec();
    for (at, value) in filled.iter_mut().enumerate().filter(|(_, value)| value.is_nan()) {
        let (u, v) = (at % width, at / width);
        let (mut sum, mut count) = (0.0f64, 0);
        for j in v.saturating_sub(1)..(v + 2).min(height) {
            for z in &cells[j * width + u.saturating_sub(1)..j * width + (u + 2).min(width)] {
                if z.is_finite() {
                    sum += f64::from(*z);
                    count += 1;
                }
            }
        }
        if count >= NEIGHBOURS {
            *value = (sum / count as f64) as f32;
        }
    }
    filled
}

/// Opens heights of either kind.
///
/// # Errors
/// As [`Heights::raster`] and [`Heights::cloud`].
pub(super) fn open(path: &Path, cell_m: Option<f64>, map: Option<Crs>) -> Result<Heights, Error> {
    Ok(if is_cloud(path) { Heights::cloud(path, cell_m, map)? } else { Heights::raster(path)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_far_from_all_others_are_left_out() {
        let screen = |heights: &[f32]| {
            let mut counts = Counts::default();
            counts.add(heights);
            counts.screen()
        };
        // Missing cells may be more than half.
        let found = screen(&[0.0, 0.0, 0.0, 0.0, 180.4, f32::NAN, 182.0, 900.0]);
        assert_eq!((found.excluded, found.excluded_m), (5, [0.0, 900.0]));
        let is_out = [0.0, 180.4, 182.0, 900.0, -5.0, 180.0].map(|z| found.leaves_out(z));
        assert_eq!(is_out, [true, false, false, true, true, false]);
        // Trees, a slope, a field at the sea, heights over the ground.
        for all in [&[10.0, 35.0, 60.0][..], &[0.0, -0.4, 0.8, 2.5], &[0.0, 4.0], &[0.0, 0.0]] {
            let found = screen(all);
            assert_eq!((found.excluded, all.iter().any(|z| found.leaves_out(*z))), (0, false));
        }
    }
}
