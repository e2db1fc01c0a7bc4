//! Rasters whose pixels are oblong on the ground, read as ones with square pixels.

use rowgram_raster::{georeference::Georeference, window::Window};

/// Ratio of the sides of a pixel up to which it counts as square: lengths are then within a quarter of a percent.
const SQUARE: f64 = 1.005;
/// Ratio beyond which no survey has pixels: what says so is damaged.
const LARGEST: f64 = 100.0;

/// The size of a raster as stored and as it is shown. The finer side of its pixels is the side of those that are shown, so
/// that nothing is lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Square {
    stored: [usize; 2],
    shown: [usize; 2],
}

impl Square {
    /// Of a raster of so many columns and rows; and its place with square pixels.
    ///
    /// # Errors
    /// Pixels that are lines.
    pub(crate) fn of(
        stored: [usize; 2],
        place: Option<Georeference>,
    ) -> Result<(Square, Option<Georeference>), String> {
        let same = Ok((Square { stored, shown: stored }, place));
        let Some((place, [width_m, height_m])) = place.and_then(|of| Some((of, of.pixel_m()?)))
        else {
            return same;
        };
        let side_m = width_m.min(height_m);
        let ratio = [width_m / side_m, height_m / side_m];
        let largest = ratio[0].max(ratio[1]);
        if !largest.is_finite() || largest <= SQUARE {
            return same;
        }
        if largest > LARGEST {
            return Err(format!(
                "its georeference is damaged: pixels of {width_m:.3e} x {height_m:.3e} m on the ground"
            ));
        }
        let shown =
            [0, 1].map(|axis| (stored[axis] as f64 * ratio[axis]).round().max(1.0) as usize);
        let steps = [0, 1].map(|axis| stored[axis] as f64 / shown[axis] as f64);
        // The corner of the raster stays where it is.
        let origin = place.map(steps.map(|step| 0.5 * step - 0.5));
        let scaled = |step: [f64; 2], by: f64| step.map(|x| x * by);
        let place = Georeference {
            origin,
            per_column: scaled(place.per_column, steps[0]),
            per_row: scaled(place.per_row, steps[1]),
            ..place
        };
        Ok((Square { stored, shown }, Some(place)))
    }

    /// Columns and rows that are shown.
    pub(crate) fn shown(&self) -> [usize; 2] {
        self.shown
    }

    /// Whether pixels are oblong.
    pub(crate) fn is_oblong(&self) -> bool {
        self.stored != self.shown
    }

    /// Columns and rows that are shown of another picture of the same raster: an overview, a mask.
    pub(crate) fn shown_of(&self, stored: [usize; 2]) -> [usize; 2] {
        if !self.is_oblong() {
            return stored;
        }
        [0, 1].map(|axis| {
            let ratio = self.shown[axis] as f64 / self.stored[axis] as f64;
            (stored[axis] as f64 * ratio).round().max(1.0) as usize
        })
    }

    /// For each column (axis 0) or row (1) that is shown of a picture with so many stored ones: the stored one.
    pub(crate) fn source(&self, stored: [usize; 2], axis: usize) -> impl Fn(usize) -> usize {
        let (of, shown) = (stored[axis], self.shown_of(stored)[axis]);
        move |at: usize| {
            ((at as f64 + 0.5) * of as f64 / shown as f64).floor().min(of as f64 - 1.0) as usize
        }
    }

    /// The samples of a window; `read` gives those of a window as stored.
    ///
    /// # Errors
    /// As `read`.
    pub(crate) fn read<T: Clone, E>(
        &self,
        stored: [usize; 2],
        window: Window,
        read: impl Fn(Window) -> Result<Vec<T>, E>,
    ) -> Result<Vec<T>, E> {
        let shown = self.shown_of(stored);
        let is_inside = window.u + window.width <= shown[0] && window.v + window.height <= shown[1];
        if !self.is_oblong() || !is_inside || window.pixels() == 0 {
            return read(window);
        }
        let (column, row) = (self.source(stored, 0), self.source(stored, 1));
        let columns: Vec<usize> = (window.u..window.u + window.width).map(column).collect();
        let rows: Vec<usize> = (window.v..window.v + window.height).map(row).collect();
        let (u, v) = (columns[0], rows[0]);
        let (width, height) = (columns[columns.len() - 1] + 1 - u, rows[rows.len() - 1] + 1 - v);
        let samples = read(Window { u, v, width, height })?;
        let bands = samples.len() / (width * height);
        let mut found = Vec::with_capacity(window.pixels() * bands);
        for row in rows {
            let line = &samples[(row - v) * width * bands..][..width * bands];
            for &column in &columns {
                found.extend_from_slice(&line[(column - u) * bands..][..bands]);
            }
        }
        Ok(found)
    }
}
