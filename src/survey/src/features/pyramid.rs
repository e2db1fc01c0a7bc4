//! The scale space: layers of growing blur, in octaves of halving size.
//!
//! Layer `s` of octave `o` has the blur `1.6 * 2^(s/3)` in its own pixels, `s = 0..=5`; the base of the
//! next octave is every second pixel of layer 3, whose blur is twice that of the base. The photo is
//! taken to have a blur of 0.5 px already.
//!
//! With doubling, octave 0 has twice the photo's size, and its pixel `(x, y)` stands at `(x, y) / 2` in the
//! photo: even pixels are the photo's, odd ones the mean of their neighbours. So positions found there
//! carry no shift. [`Upscale::HalfPixel`](super::Upscale::HalfPixel) interpolates at `(x - 0.5) / 2`
//! but keeps `x / 2` as the position, as OpenCV does by default: everything is found a quarter of a pixel
//! too far right and down.
//!
//! No layer exists as a whole in single precision: an octave is made tile by tile, each with a margin
//! from which its pixels can be blurred and compared without its neighbours. What stays are the
//! layers that describe features, with 1/256 of a grey value, and the base of the next octave.

use super::{
    FeatureOptions,
    blur::{Blur, Kernel, MAX_LANES, Window},
    detect::{self, Extremum},
    photo::{Grid, LONGEST, Rows},
};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use std::sync::Mutex;

/// Scales per octave at which extrema are looked for.
pub(super) const SCALES: usize = 3;
/// Layers of an octave.
pub(super) const LAYERS: usize = SCALES + 3;
/// Blur of the base of an octave, in its pixels.
pub(super) const BASE_SIGMA_PX: f64 = 1.6;
/// Blur that a photo has to begin with.
const PHOTO_SIGMA_PX: f64 = 0.5;
/// Pixels at the border of each layer where nothing is looked for.
pub(super) const BORDER: usize = 5;
/// Columns and rows of a tile, even.
pub(super) const TILE: (usize, usize) = (512, 256);
/// Side of the blocks that extrema are ordered by.
const BLOCK: u32 = 128;
/// Pixels kept around a tile; the filters take up to 48 of them and the search 5.
const MARGIN: usize = 56;
/// Distance of a frame's rows.
const STRIDE: usize = TILE.0 + 2 * MARGIN + MAX_LANES;

/// A layer that describes features: 256 times the grey values, row by row, and after the last pixel
/// some that may be read without looking.
#[derive(Debug, Clone, Default)]
pub(super) struct Layer {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) data: Vec<u16>,
}

impl Layer {
    pub(super) fn new(width: usize, height: usize) -> Layer {
        Layer { width, height, data: vec![0; width * height + 2 * MAX_LANES] }
    }
}

/// The layers of an octave that describe features: 1, 2 and 3.
pub(super) type Octave = [Layer; SCALES];

/// The filters between the layers, and the margins that stay valid behind them.
#[derive(Debug)]
struct Filters {
    /// From the photo to layer 0, then from each layer to the next.
    kernels: [Kernel; LAYERS],
    /// Valid pixels around a tile in each layer.
    margins: [usize; LAYERS],
}

impl Filters {
    fn new(enlarged: u32) -> Filters {
        let step = 2.0f64.powf(1.0 / SCALES as f64);
        let kernels = std::array::from_fn(|layer| {
            if layer == 0 {
                let have = PHOTO_SIGMA_PX * f64::from(enlarged);
                Kernel::gaussian((BASE_SIGMA_PX.powi(2) - have.powi(2)).max(0.01).sqrt())
            } else {
                let before = BASE_SIGMA_PX * step.powi(layer as i32 - 1);
                Kernel::gaussian(before * (step * step - 1.0).sqrt())
            }
        });
        let mut margins = [detect::REACH + 1; LAYERS];
        for layer in (1..LAYERS).rev() {
            margins[layer - 1] = margins[layer] + kernels[layer].radius;
        }
        debug_assert!(margins[0] + kernels[0].radius <= MARGIN, "{margins:?}");
        Filters { kernels, margins }
    }
}

/// Working memory of a thread: the layers of one tile.
pub(super) struct Frames {
    pub(super) layers: [Vec<f32>; LAYERS],
    lines: Vec<f32>,
    pub(super) scan: detect::Lines,
}

impl Frames {
    fn new() -> Frames {
        let length = STRIDE * (TILE.1 + 2 * MARGIN);
        Frames {
            layers: std::array::from_fn(|_| vec![0.0; length]),
            lines: Vec::new(),
            scan: detect::Lines::new(),
        }
    }
}

/// Where a tile lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tile {
    /// First column and row in the octave.
    pub(super) from: (usize, usize),
    /// Columns and rows.
    pub(super) size: (usize, usize),
    /// Columns and rows of the octave.
    pub(super) whole: (usize, usize),
}

impl Tile {
    /// Distance of the rows of a frame.
    pub(super) const STRIDE: usize = STRIDE;

    /// Place in a frame of a pixel of the octave; it must be within the margin.
    #[inline(always)]
    pub(super) fn place(&self, column: usize, row: usize) -> usize {
        (row + MARGIN - self.from.1) * STRIDE + column + MARGIN - self.from.0
    }
}

/// Makes the octaves one after the other.
pub(super) struct Pyramid<'a> {
    options: &'a FeatureOptions,
    filters: Filters,
    pool: Mutex<Vec<Frames>>,
}

/// What an octave gives.
pub(super) struct Made {
    pub(super) layers: Octave,
    pub(super) extrema: Vec<Extremum>,
    /// Base of the next octave.
    pub(super) next: Grid,
}

/// Where the results of a row of tiles go.
struct Strip<'a> {
    first_row: usize,
    layers: [&'a mut [u16]; SCALES],
    next: &'a mut [f32],
}

impl<'a> Pyramid<'a> {
    pub(super) fn new(options: &'a FeatureOptions) -> Pyramid<'a> {
        let filters = Filters::new(options.upscale.factor());
        Pyramid { options, filters, pool: Mutex::new(Vec::new()) }
    }

    /// Makes octave `octave` from the photo (the first) or from its base; `None` where it would be too
    /// small for anything to be found.
    pub(super) fn octave(&self, source: &impl Rows, octave: u8) -> Option<Made> {
        let (width, height) = source.size();
        if width.min(height) <= 2 * BORDER {
            return None;
        }
        let mut layers: Octave = std::array::from_fn(|_| Layer::new(width, height));
        let mut next = Grid { width: width / 2, height: height / 2, data: Vec::new() };
        next.data = vec![0.0; next.width * next.height];
        let [first, second, third] =
            layers.each_mut().map(|layer| &mut layer.data[..width * height]);
        let rows = TILE.1;
        let mut halves = next.data.chunks_mut(rows / 2 * (width / 2));
        let strips: Vec<Strip<'_>> = first
            .chunks_mut(rows * width)
            .zip(second.chunks_mut(rows * width))
            .zip(third.chunks_mut(rows * width))
            .enumerate()
            .map(|(index, ((first, second), third))| Strip {
                first_row: index * rows,
                layers: [first, second, third],
                // The last row of an odd number may have no half.
                next: halves.next().unwrap_or_default(),
            })
            .collect();
        let found: Vec<Vec<Extremum>> = strips
            .into_par_iter()
            .map(|strip| {
                let pooled = self.pool.lock().ok().and_then(|mut pool| pool.pop());
                let mut frames = pooled.unwrap_or_else(Frames::new);
                let found = work(self, source, octave, strip, &mut frames);
                if let Ok(mut pool) = self.pool.lock() {
                    pool.push(frames);
                }
                found
            })
            .collect();
        let mut extrema = found.concat();
        // Those that are near each other in memory are described one after the other.
        extrema
            .sort_unstable_by_key(|e| (e.row / BLOCK, e.column / BLOCK, e.layer, e.row, e.column));
        // Neighbouring candidates may end in the same pixel.
        extrema.dedup_by_key(|e| (e.layer, e.row, e.column));
        Some(Made { layers, extrema, next })
    }
}

/// Finds the extrema of a row of tiles, and keeps its layers.
fn work(
    pyramid: &Pyramid<'_>,
    source: &impl Rows,
    octave: u8,
    mut strip: Strip<'_>,
    frames: &mut Frames,
) -> Vec<Extremum> {
    let whole = source.size();
    let mut found = Vec::new();
    let rows = TILE.1.min(whole.1 - strip.first_row);
    let simd = pulp::Arch::new();
    let mut column = 0;
    while column < whole.0 {
        let size = (TILE.0.min(whole.0 - column), rows);
        let tile = Tile { from: (column, strip.first_row), size, whole };
        fill(&pyramid.filters, source, octave, &tile, frames);
        let options = pyramid.options;
        simd.dispatch(detect::Scan { tile: &tile, frames, octave, options, found: &mut found });
        simd.dispatch(Keep { tile: &tile, frames, strip: &mut strip });
        column += size.0;
    }
    found
}

/// Makes the layers of a tile.
fn fill(filters: &Filters, source: &impl Rows, octave: u8, tile: &Tile, frames: &mut Frames) {
    let Frames { layers, lines, .. } = frames;
    let window = |margin: usize| Window {
        stride: STRIDE,
        from: (MARGIN - margin, MARGIN - margin),
        size: (tile.size.0 + 2 * margin, tile.size.1 + 2 * margin),
    };
    // The photo is blurred into layer 0, any other octave begins with it.
    let start = if octave == 0 { LAYERS - 1 } else { 0 };
    let margin = filters.margins[0] + if octave == 0 { filters.kernels[0].radius } else { 0 };
    let (width, height) = window(margin).size;
    let first = (MARGIN - margin) * STRIDE + MARGIN - margin;
    let from = [tile.from.0, tile.from.1].map(|x| x as isize - margin as isize);
    let out = &mut layers[start][first..];
    let simd = pulp::Arch::new();
    simd.dispatch(Read { source, from, size: (width, height), out });
    let [zero, .., last] = layers;
    if octave == 0 {
        let (kernel, window) = (&filters.kernels[0], window(filters.margins[0]));
        simd.dispatch(Blur { kernel, window, input: last, output: zero, lines });
    }
    for layer in 1..LAYERS {
        let (before, after) = layers.split_at_mut(layer);
        let (kernel, window) = (&filters.kernels[layer], window(filters.margins[layer]));
        let (input, output) = (&before[layer - 1], &mut after[0]);
        simd.dispatch(Blur { kernel, window, input, output, lines });
    }
}

/// Reads the rectangle `size` from `from` on into a frame.
struct Read<'a, R: Rows> {
    source: &'a R,
    from: [isize; 2],
    size: (usize, usize),
    out: &'a mut [f32],
}

impl<R: Rows> WithSimd for Read<'_, R> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for line in 0..self.size.1 {
            let out = &mut self.out[line * STRIDE..][..self.size.0];
            self.source.read(self.from[1] + line as isize, self.from[0], out);
        }
    }
}

/// Puts what is needed later into the octave.
struct Keep<'a, 's> {
    tile: &'a Tile,
    frames: &'a Frames,
    strip: &'a mut Strip<'s>,
}

impl WithSimd for Keep<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Keep { tile, frames, strip } = self;
        let (width, rows) = tile.size;
        for (layer, out) in frames.layers[1..=SCALES].iter().zip(&mut strip.layers) {
            for row in 0..rows {
                let at = tile.place(tile.from.0, tile.from.1 + row);
                let out = &mut out[row * tile.whole.0 + tile.from.0..][..width];
                for (out, &value) in out.iter_mut().zip(&layer[at..at + width]) {
                    // Adding 1.5 * 2^23 leaves the rounded number in the lowest bits.
                    *out = (value * 256.0 + 12_582_912.0).to_bits() as u16;
                }
            }
        }
        let half = tile.whole.0 / 2;
        if half == 0 {
            return;
        }
        for (row, out) in strip.next.chunks_exact_mut(half).enumerate() {
            let at = tile.place(tile.from.0, tile.from.1 + 2 * row);
            let out = &mut out[tile.from.0 / 2..half.min((tile.from.0 + width) / 2)];
            for (out, pair) in out.iter_mut().zip(frames.layers[SCALES][at..].chunks_exact(2)) {
                *out = pair[0];
            }
        }
    }
}

const _: () = assert!(TILE.0.is_multiple_of(2) && TILE.1.is_multiple_of(2));
const _: () = assert!(TILE.0 + 2 * MARGIN <= LONGEST);
