//! Rectangles of a raster, for work that does not hold all of it at once.
//!
//! A raster of `width x height` pixels is covered by bands of whole rows; work whose result at a pixel
//! depends on pixels up to `halo` away is done on a band grown by `halo` rows, and only the rows of the
//! band itself are kept. The result is then that of the whole raster, whatever the bands.

use std::ops::Range;

/// A rectangle of pixels: columns `u..u + width`, rows `v..v + height`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Window {
    /// First column.
    pub u: usize,
    /// First row.
    pub v: usize,
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
}

impl Window {
    /// All of a raster.
    pub fn whole(width: usize, height: usize) -> Window {
        Window { u: 0, v: 0, width, height }
    }

    /// Whole rows of a raster.
    pub fn rows(width: usize, rows: Range<usize>) -> Window {
        Window { u: 0, v: rows.start, width, height: rows.len() }
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// The columns.
    pub fn columns(&self) -> Range<usize> {
        self.u..self.u + self.width
    }

    /// The rows.
    pub fn row_range(&self) -> Range<usize> {
        self.v..self.v + self.height
    }
}

/// A band of rows and the rows around it that its work looks at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Band {
    /// The rows whose results are kept.
    pub rows: Range<usize>,
    /// The rows that are looked at: `halo` more on either side, where there are any.
    pub seen: Range<usize>,
}

/// The bands of `band_rows` rows (the last may have fewer) that cover `height` rows, from the top.
pub fn bands(height: usize, band_rows: usize, halo: usize) -> impl Iterator<Item = Band> {
    let band_rows = band_rows.max(1);
    (0..height.div_ceil(band_rows)).map(move |band| {
        let rows = band * band_rows..((band + 1) * band_rows).min(height);
        let seen = rows.start.saturating_sub(halo)..(rows.end + halo).min(height);
        Band { rows, seen }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_cover_all_rows_once_and_see_their_halo() {
        for (height, band_rows, halo) in [(10, 4, 2), (1, 5, 9), (0, 3, 1), (12, 4, 0), (7, 0, 1)] {
            let all: Vec<Band> = bands(height, band_rows, halo).collect();
            let rows: Vec<usize> = all.iter().flat_map(|band| band.rows.clone()).collect();
            assert_eq!(rows, (0..height).collect::<Vec<_>>());
            for band in &all {
                assert_eq!(band.seen.start, band.rows.start.saturating_sub(halo));
                assert_eq!(band.seen.end, (band.rows.end + halo).min(height));
            }
        }
    }
}
