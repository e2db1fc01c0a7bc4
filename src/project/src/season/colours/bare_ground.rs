//! Squares of ground without leaf on the map of a date, in the frame of the season.

use crate::season::register::DateMap;
use rowgram_base::error::Error;
use rowgram_files::{geotiff::Reader, rasters::BAND_ROWS};
use rowgram_raster::{
    srgb::linear_light,
    window::{self, Window},
};
use rowgram_survey::problems::map_transform::MapTransform;
use serde::{Deserialize, Serialize};

/// Side of a square: its middle half is a mean over some hundred pixels, and leaf is a hand away from it.
const BLOCK_M: f64 = 0.3;
/// The least pixels along a side.
const MIN_BLOCK_PX: f64 = 12.0;
/// Squares along each axis beyond which every second, third, ... one is looked at.
const MAX_ALONG: f64 = 1000.0;
/// Bytes from which on a pixel may be saturated, and up to which it is black.
const BRIGHT: u8 = 250;
const BLACK: u8 = 3;

/// The side of squares for maps of about this resolution.
pub(super) fn block_m(gsd_m: f64) -> f64 {
    BLOCK_M.max(MIN_BLOCK_PX * gsd_m)
}

/// The squares of a map.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Ground {
    /// Their side, metres.
    pub(super) block_m: f64,
    /// Column and row from the origin of the frame, and the mean linear light; sorted.
    pub(super) squares: Vec<([i32; 2], [f64; 3])>,
}

impl Ground {
    /// Places, metres, of the squares that another map has, too, with their light here and there.
    pub(super) fn shared(&self, other: &Ground) -> Vec<([f64; 2], [f64; 3], [f64; 3])> {
        let find = |at: &[i32; 2]| {
            let k = other.squares.binary_search_by(|(key, _)| key.cmp(at)).ok()?;
            Some(other.squares[k].1)
        };
        let place = |at: &[i32; 2]| at.map(|k| (f64::from(k) + 0.5) * self.block_m);
        let own = self.squares.iter();
        own.filter_map(|(at, light)| Some((place(at), *light, find(at)?))).collect()
    }
}

#[derive(Clone, Copy, Default)]
struct Sum {
    light: [f64; 3],
    pixels: u32,
    /// Whether it has leaf, a gap, or pixels that are saturated or black.
    is_unusable: bool,
}

/// The squares of a map whose light is known.
///
/// # Errors
/// A map or mask that cannot be read.
pub(super) fn sample(
    map: &DateMap,
    transform: &MapTransform,
    block_m: f64,
) -> Result<Ground, Error> {
    let (width, height) = map.size;
    let corners = [[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]]
        .map(|at| transform.apply(map.place.map(at.map(|x| x as f64))));
    let bound = |axis: usize, pick: fn(f64, f64) -> f64| {
        corners.iter().map(|corner| corner[axis]).reduce(pick).unwrap_or(0.0)
    };
    let low = [0, 1].map(|axis| (bound(axis, f64::min) / block_m).floor());
    let high = [0, 1].map(|axis| (bound(axis, f64::max) / block_m).floor());
    // Maps of one field look at the same squares, as steps count from the origin of the frame.
    let step = [0, 1].map(|axis| ((high[axis] - low[axis]) / MAX_ALONG).ceil().max(1.0));
    let step = step[0].max(step[1]).log2().ceil().exp2();
    let first = low.map(|x| (x / step).floor() as i32);
    let count = [0, 1].map(|axis| ((high[axis] / step).floor() as i32 - first[axis] + 1) as usize);
    let mut sums = vec![Sum::default(); count[0] * count[1]];
    let light: [f64; 256] = std::array::from_fn(|byte| linear_light(byte as f64));
    let (picture, mask) = (Reader::open_with(&map.ortho, &map.reading)?, Reader::open(&map.mask)?);
    let mut pixels_of_block = 0.0f64;
    for band in window::bands(height, BAND_ROWS, 0) {
        let at = Window::rows(width, band.rows.clone());
        let (rgb, gaps) = picture.read_rgb_and_gaps(at)?;
        let leaf = mask.read::<u8>(at)?;
        for (k, pixel) in rgb.pixels().enumerate() {
            let (u, v) = (k % width, band.rows.start + k / width);
            let place = transform.apply(map.place.map([u as f64, v as f64])).map(|x| x / block_m);
            let block = place.map(f64::floor);
            if block.iter().any(|x| x.rem_euclid(step) != 0.0) {
                continue;
            }
            let [i, j] = [0, 1].map(|a| ((block[a] / step) as i64 - i64::from(first[a])) as usize);
            let Some(sum) = sums.get_mut(j * count[0] + i).filter(|_| i < count[0]) else {
                continue;
            };
            let is_gap = gaps.as_ref().is_some_and(|gaps| gaps[k]);
            if leaf[k] != 0 || is_gap {
                sum.is_unusable = true;
            }
            let inner = (0..2).all(|a| (0.25..0.75).contains(&(place[a] - block[a])));
            if !inner {
                continue;
            }
            let is_bright = pixel.0.iter().any(|&value| value >= BRIGHT);
            if is_bright || pixel.0.iter().all(|&value| value <= BLACK) {
                sum.is_unusable = true;
            }
            for (sum, &value) in sum.light.iter_mut().zip(&pixel.0) {
                *sum += light[usize::from(value)];
            }
            sum.pixels += 1;
        }
    }
    for sum in &sums {
        pixels_of_block = pixels_of_block.max(f64::from(sum.pixels));
    }
    let is_whole = |sum: &Sum| !sum.is_unusable && f64::from(sum.pixels) > 0.7 * pixels_of_block;
    let mut squares: Vec<([i32; 2], [f64; 3])> = sums
        .iter()
        .enumerate()
        .filter(|(_, sum)| is_whole(sum))
        .map(|(k, sum)| {
            let [i, j] = [k % count[0], k / count[0]];
            let at = [first[0] + i as i32, first[1] + j as i32].map(|x| x * step as i32);
            (at, sum.light.map(|light| light / f64::from(sum.pixels)))
        })
        .collect();
    squares.sort_by_key(|(at, _)| *at);
    Ok(Ground { block_m, squares })
}
