//! Pixels that show nothing: the flat surround of a mosaic, also after lossy compression.
//!
//! Blocks of 4 x 4 pixels that are black throughout (no channel above 28: compression leaves noise) or white
//! (no channel below 253) belong to the surround where they are connected to the border of the picture and are at least
//! 0.1 % of it. It is grown by two blocks: compression bleeds into it and out of it.

use crate::raster::{Mask, components};
use image::RgbImage;
use rayon::prelude::*;

/// Side of a block, in pixels.
const BLOCK: usize = 4;
/// Largest value of black and least value of white.
const FLAT: (u8, u8) = (28, 253);
/// Least share of the picture.
const LEAST: f64 = 0.001;
/// Blocks by which the surround grows.
const GROWN: usize = 2;

/// The surround (1) of a picture; `None` if it has none.
pub fn border(photo: &RgbImage) -> Option<Mask> {
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let (columns, rows) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
    if columns == 0 || rows == 0 {
        return None;
    }
    let flat: Vec<u8> =
        (0..rows).into_par_iter().flat_map_iter(|row| flat_blocks(photo, row)).collect();
    let mut surround = vec![0; flat.len()];
    for kind in [1, 2] {
        let mask = Mask {
            width: columns,
            height: rows,
            data: flat.iter().map(|&f| u8::from(f == kind)).collect(),
        };
        if mask.count() as f64 <= LEAST * flat.len() as f64 {
            continue;
        }
        for part in components::parts(&mask) {
            let w = part.window;
            let outside =
                w.u == 0 || w.v == 0 || w.u + w.width == columns || w.v + w.height == rows;
            if outside && part.pixels as f64 > LEAST * flat.len() as f64 {
                for run in &part.runs {
                    surround[run.v * columns + run.start..run.v * columns + run.end].fill(1);
                }
            }
        }
    }
    if !surround.contains(&1) {
        return None;
    }
    let blocks = grow(&Mask { width: columns, height: rows, data: surround });
    Some(Mask::from_fn(width, height, |u, v| blocks.get(u / BLOCK, v / BLOCK)))
}

/// Of the blocks of one row: 1 black, 2 white, 0 neither.
fn flat_blocks(photo: &RgbImage, row: usize) -> Vec<u8> {
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let mut range = vec![(u8::MAX, 0_u8); width.div_ceil(BLOCK)];
    for v in row * BLOCK..((row + 1) * BLOCK).min(height) {
        let line = &photo.as_raw()[3 * v * width..3 * (v + 1) * width];
        for (range, bytes) in range.iter_mut().zip(line.chunks(3 * BLOCK)) {
            for &byte in bytes {
                *range = (range.0.min(byte), range.1.max(byte));
            }
        }
    }
    let kind = |(least, most): (u8, u8)| {
        if most <= FLAT.0 {
            1
        } else if least >= FLAT.1 {
            2
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
        assert!(border.get(3, 100) && border.get(59, 0) && border.get(67, 80));
        assert!(!border.get(90, 75) && !border.get(69, 80) && !border.get(150, 20));
    }

    #[test]
    fn a_photo_without_surround_has_none() {
        assert!(border(&RgbImage::from_pixel(50, 40, Rgb([90, 80, 70]))).is_none());
        assert!(border(&RgbImage::new(0, 0)).is_none());
        let white = border(&RgbImage::from_pixel(50, 40, Rgb([255; 3]))).unwrap();
        assert_eq!(white.count(), 2000);
    }
}
