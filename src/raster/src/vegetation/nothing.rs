//! Pixels that show nothing: the flat surround of a mosaic, also after lossy compression.
//!
//! Blocks of 4 x 4 pixels that are black throughout (no channel above 28: compression leaves noise) or white
//! (no channel below 253) belong to the surround where they are connected to the border of the picture and are at least
//! 0.1 % of it. It is grown by two blocks: compression bleeds into it and out of it.

use crate::{Mask, components, window::Band};
use image::RgbImage;
use rayon::prelude::*;
use std::ops::Range;

/// Side of a block, in pixels.
const BLOCK: usize = 4;
/// Largest value of black and least value of white.
const FLAT: (u8, u8) = (28, 253);
/// Least share of the picture.
const LEAST: f64 = 0.001;
/// Blocks by which the surround grows.
const GROWN: usize = 2;

/// Which blocks of a picture are flat, gathered band by band.
pub struct SurroundFinder {
    columns: usize,
    rows: usize,
    /// Of each block: [`BLACK`], [`WHITE`] or neither.
    flat: Vec<u8>,
}

/// Kinds of flat blocks.
const BLACK: u8 = 1;
const WHITE: u8 = 2;

impl SurroundFinder {
    /// Bands begin at multiples of so many rows.
    pub const ROWS: usize = BLOCK;

    /// For a picture of so many columns and rows.
    pub fn new((width, height): (usize, usize)) -> SurroundFinder {
        let (columns, rows) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        SurroundFinder { columns, rows, flat: Vec::with_capacity(columns * rows) }
    }

    /// Looks at the next band, from the top; `photo` has the rows that are seen.
    pub fn add(&mut self, band: &Band, photo: &RgbImage) {
        debug_assert_eq!(self.flat.len(), band.rows.start / BLOCK * self.columns);
        debug_assert!(band.rows.start.is_multiple_of(BLOCK));
        let skip = band.rows.start - band.seen.start;
        let of_row = |row: usize| {
            let first = skip + row * BLOCK;
            flat_blocks(photo, first..(first + BLOCK).min(skip + band.rows.len()))
        };
        let rows = (0..band.rows.len().div_ceil(BLOCK)).into_par_iter();
        self.flat.par_extend(rows.flat_map_iter(of_row));
    }

    /// The surround, when all bands have been seen; `None` if there is none.
    pub fn finish(self) -> Option<Surround> {
        let SurroundFinder { columns, rows, flat } = self;
        let least = LEAST * flat.len() as f64;
        let mut surround = Mask { width: columns, height: rows, data: Vec::new() };
        for kind in [BLACK, WHITE] {
            if flat.iter().filter(|&&of| of == kind).count() as f64 <= least {
                continue;
            }
            let mask = Mask {
                width: columns,
                height: rows,
                data: flat.iter().map(|&of| u8::from(of == kind)).collect(),
            };
            for part in components::parts(&mask) {
                let w = part.window;
                let outside =
                    w.u == 0 || w.v == 0 || w.u + w.width == columns || w.v + w.height == rows;
                if outside && part.pixels as f64 > least {
                    surround.data.resize(flat.len(), 0);
                    for run in &part.runs {
                        let at = run.v * columns;
                        surround.data[at + run.start..at + run.end].fill(1);
                    }
                }
            }
        }
        (!surround.data.is_empty()).then(|| Surround { blocks: grow(&surround) })
    }
}

/// The flat surround of a picture.
pub struct Surround {
    blocks: Mask,
}

impl Surround {
    /// Whether it holds a pixel.
    pub fn contains(&self, u: usize, v: usize) -> bool {
        self.blocks.get(u / BLOCK, v / BLOCK)
    }

    /// Of the pixels of some rows of `width` columns: 1 outside it, 0 within.
    pub fn outside(&self, rows: Range<usize>, width: usize) -> Vec<u8> {
        let mut outside = Vec::with_capacity(rows.len() * width);
        for v in rows {
            let blocks = self.blocks.row(v / BLOCK);
            outside.extend((0..width).map(|u| 1 - blocks[u / BLOCK]));
        }
        outside
    }
}

/// The surround of a picture; `None` if it has none.
pub fn border(photo: &RgbImage) -> Option<Surround> {
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let mut finder = SurroundFinder::new((width, height));
    finder.add(&Band { rows: 0..height, seen: 0..height }, photo);
    finder.finish()
}

/// The kinds of a row of blocks that has these rows of the picture.
fn flat_blocks(photo: &RgbImage, rows: Range<usize>) -> Vec<u8> {
    let width = photo.width() as usize;
    let mut range = vec![(u8::MAX, 0_u8); width.div_ceil(BLOCK)];
    for v in rows {
        let line = &photo.as_raw()[3 * v * width..3 * (v + 1) * width];
        for (range, bytes) in range.iter_mut().zip(line.chunks(3 * BLOCK)) {
            for &byte in bytes {
                *range = (range.0.min(byte), range.1.max(byte));
            }
        }
    }
    let kind = |(least, most): (u8, u8)| {
        if most <= FLAT.0 {
            BLACK
        } else if least >= FLAT.1 {
            WHITE
        } else {
            0
        }
    };
    range.into_iter().map(kind).collect()
}

fn grow(mask: &Mask) -> Mask {
    Mask::from_fn(mask.width, mask.height, |u, v| {
        let near = |at: usize, size: usize| at.saturating_sub(GROWN)..(at + GROWN + 1).min(size);
        near(v, mask.height).any(|v| near(u, mask.width).any(|u| mask.get(u, v)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn noisy_black_surround_is_found_and_dark_middle_is_not() {
        let photo = RgbImage::from_fn(200, 160, |u, v| {
            let noise = ((u * 7 + v * 13) % 17) as u8;
            let middle = (80..100).contains(&u) && (60..90).contains(&v);
            if u < 60 || middle { Rgb([noise, noise + 9, noise]) } else { Rgb([120, 100, 80]) }
        });
        let border = border(&photo).unwrap();
        let shows = |u, v| !border.contains(u, v);
        assert!(!shows(3, 100) && !shows(59, 0) && !shows(67, 80));
        assert!(shows(90, 75) && shows(69, 80) && shows(150, 20));
    }

    #[test]
    fn a_photo_without_surround_has_none() {
        assert!(border(&RgbImage::from_pixel(50, 40, Rgb([90, 80, 70]))).is_none());
        assert!(border(&RgbImage::new(0, 0)).is_none());
        let white = border(&RgbImage::from_pixel(50, 40, Rgb([255; 3]))).unwrap();
        assert_eq!(white.outside(0..40, 50), [0; 2000]);
    }
}
