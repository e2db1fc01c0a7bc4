//! Pixels that show nothing: the flat surround of a mosaic, also after lossy compression.
//!
//! Blocks of 4 x 4 pixels that are black throughout (no channel above 28: compression leaves noise) or white
//! (no channel below 253) belong to the surround where they are connected to the border of the picture and are at least
//! 0.1 % of it. Where its edge is noisy it is grown by two blocks, because compression bleeds into it and out of it; where
//! it is exactly black or white up to its edge, it ends with the last such pixel.

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
/// Share of the blocks at its edge that have to be exactly black or white for a surround that no
/// compression has changed: all are but those beside dark soil. JPEG changes nearly all of them. A guess between, not searched for.
const MIN_EXACT_SHARE: f64 = 0.9;

/// Which blocks of a picture are flat, gathered band by band.
pub struct SurroundFinder {
    columns: usize,
    rows: usize,
    /// Of each block: [`BLACK`], [`WHITE`] or neither.
    flat: Vec<u8>,
    /// Of each block: which of its pixels are exactly black or white, row by row.
    exact: Vec<u16>,
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
        let (flat, exact) =
            (Vec::with_capacity(columns * rows), Vec::with_capacity(columns * rows));
        SurroundFinder { columns, rows, flat, exact }
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
        let blocks: Vec<(u8, u16)> = rows.flat_map_iter(of_row).collect();
        self.flat.extend(blocks.iter().map(|block| block.0));
        self.exact.extend(blocks.iter().map(|block| block.1));
    }

    /// The surround, when all bands have been seen; `None` if there is none.
    pub fn finish(self) -> Option<Surround> {
        let SurroundFinder { columns, rows, flat, exact } = self;
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
                        surround.data[run.pixels(columns)].fill(1);
                    }
                }
            }
        }
        if surround.data.is_empty() {
            return None;
        }
        let grown = grow(&surround);
        let ends_exactly = ends_exactly(&surround, &exact);
        let ring = grown.data.iter().zip(&surround.data);
        let pixels = ring.zip(exact).map(|((&grown, &core), exact)| match (grown, core) {
            (0, _) => 0,
            (_, 0) if ends_exactly => exact,
            _ => u16::MAX,
        });
        Some(Surround { columns, pixels: pixels.collect() })
    }
}

/// Whether the blocks at the edge of a surround are exactly black or white.
fn ends_exactly(surround: &Mask, exact: &[u16]) -> bool {
    let (mut edge, mut count) = (0_usize, 0_usize);
    for v in 0..surround.height {
        for u in 0..surround.width {
            let near = [(u.wrapping_sub(1), v), (u + 1, v), (u, v.wrapping_sub(1)), (u, v + 1)];
            let is_field = |&(u, v): &(usize, usize)| {
                u < surround.width && v < surround.height && !surround.get(u, v)
            };
            if surround.get(u, v) && near.iter().any(is_field) {
                edge += 1;
                count += usize::from(exact[v * surround.width + u] == u16::MAX);
            }
        }
    }
    count as f64 >= MIN_EXACT_SHARE * edge as f64
}

/// The flat surround of a picture.
pub struct Surround {
    /// Blocks in a row.
    columns: usize,
    /// Of each block: which of its pixels belong to the surround, row by row.
    pixels: Vec<u16>,
}

impl Surround {
    /// Whether it holds a pixel.
    pub fn contains(&self, u: usize, v: usize) -> bool {
        let block = self.pixels[v / BLOCK * self.columns + u / BLOCK];
        block >> bit(u, v) & 1 != 0
    }

    /// Of the pixels of some rows of `width` columns: 1 outside it, 0 within.
    pub fn outside(&self, rows: Range<usize>, width: usize) -> Vec<u8> {
        let mut outside = Vec::with_capacity(rows.len() * width);
        for v in rows {
            let blocks = &self.pixels[v / BLOCK * self.columns..][..self.columns];
            outside.extend((0..width).map(|u| u8::from(blocks[u / BLOCK] >> bit(u, v) & 1 == 0)));
        }
        outside
    }
}

/// The place of a pixel in its block.
fn bit(u: usize, v: usize) -> usize {
    v % BLOCK * BLOCK + u % BLOCK
}

/// The kinds of a row of blocks that has these rows of the picture, and which of their pixels are exactly black or white.
/// What a block lacks at the border of the picture counts as exact.
fn flat_blocks(photo: &RgbImage, rows: Range<usize>) -> Vec<(u8, u16)> {
    let width = photo.width() as usize;
    let mut range = vec![(u8::MAX, 0_u8); width.div_ceil(BLOCK)];
    let mut other = vec![0_u16; range.len()];
    for (row, v) in rows.enumerate() {
        let line = &photo.as_raw()[3 * v * width..3 * (v + 1) * width];
        for ((range, other), pixels) in range.iter_mut().zip(&mut other).zip(line.chunks(3 * BLOCK))
        {
            for (column, pixel) in pixels.chunks_exact(3).enumerate() {
                let (least, most) =
                    (pixel[0].min(pixel[1]).min(pixel[2]), pixel[0].max(pixel[1]).max(pixel[2]));
                *range = (range.0.min(least), range.1.max(most));
                *other |= u16::from(most > 0 && least < 255) << bit(column, row);
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
    range.into_iter().map(kind).zip(other.into_iter().map(|other| !other)).collect()
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

    fn border(photo: &RgbImage) -> Option<Surround> {
        let (width, height) = (photo.width() as usize, photo.height() as usize);
        let mut finder = SurroundFinder::new((width, height));
        finder.add(&Band { rows: 0..height, seen: 0..height }, photo);
        finder.finish()
    }

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
    fn an_exact_surround_ends_with_its_last_pixel() {
        let photo = RgbImage::from_fn(201, 163, |u, v| {
            if u < 61 || v >= 131 { Rgb([0; 3]) } else { Rgb([120, 100, 80]) }
        });
        let border = border(&photo).unwrap();
        for (u, v, is_in) in [(60, 80, true), (61, 80, false), (100, 131, true), (100, 130, false)]
        {
            assert_eq!(border.contains(u, v), is_in, "{u} {v}");
        }
        let outside: usize = border.outside(0..163, 201).iter().map(|&of| usize::from(of)).sum();
        assert_eq!(outside, 140 * 131);
    }

    #[test]
    fn a_photo_without_surround_has_none() {
        assert!(border(&RgbImage::from_pixel(50, 40, Rgb([90, 80, 70]))).is_none());
        assert!(border(&RgbImage::new(0, 0)).is_none());
        let white = border(&RgbImage::from_pixel(50, 40, Rgb([255; 3]))).unwrap();
        assert_eq!(white.outside(0..40, 50), [0; 2000]);
    }
}
