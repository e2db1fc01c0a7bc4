//! The descriptor: 4 x 4 histograms of 8 gradient directions in a square around the key point.
//!
//! The square is turned to the key point's direction and has cells of 3 times its blur. A gradient is
//! weighted by its length and by a Gaussian of half the square's side, and shared linearly between
//! the neighbouring cells and directions. The 128 numbers `h` are cut at 0.2 `|h|_2`; then
//! - [`Norm::L2`]: `512 h / |h|_2`, Lowe 2004, section 6;
//! - [`Norm::Root`]: `512 sqrt(h / |h|_1)`, Arandjelovic and Zisserman, "Three things everyone should
//!   know to improve object retrieval", CVPR 2012,
//!
//! rounded to bytes, larger numbers becoming 255.

use super::{DESCRIPTOR_LENGTH, Norm, blur::MAX_LANES, gradient, pyramid::Layer};
use pulp::{Simd, WithSimd};

/// Cells on a side.
const CELLS: usize = 4;
/// Directions.
const BINS: usize = 8;
/// Side of a cell as a multiple of the key point's blur.
const CELL_FACTOR: f32 = 3.0;
/// Cells on a side with the rim that takes the shares of samples at the border.
const RIM: usize = CELLS + 2;
/// Numbers of a histogram; two neighbouring cells are contiguous.
const LENGTH: usize = RIM * RIM * BINS;
/// Histograms that are filled in turn, so that one sample need not wait for the last.
const COPIES: usize = 4;
/// Two cells next to each other.
const PAIR: usize = 2 * BINS;
/// Most samples of a row: the blur is at most 1.6 * 2^(3.5 / 3) pixels, the reach 38.
const ROW: usize = 96;

/// Describes one key point on its layer.
pub(super) struct Describe<'a> {
    pub(super) layer: &'a Layer,
    /// The nearest pixel.
    pub(super) column: usize,
    pub(super) row: usize,
    /// Blur in pixels of the layer.
    pub(super) sigma_px: f32,
    /// Direction, from the column axis towards the top.
    pub(super) angle_deg: f32,
    pub(super) norm: Norm,
    pub(super) out: &'a mut [u8],
}

impl WithSimd for Describe<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let histogram = histogram(&self);
        finish(&histogram, self.norm, self.out);
    }
}

/// Samples of one row of the layer.
struct Samples {
    /// Where in the histogram the first of two cells begins.
    place: [u32; ROW],
    /// Direction in bins, from 0 to 8.
    direction: [f32; ROW],
    /// Share of the second column of cells.
    second: [f32; ROW],
    /// Weight for the first and for the second row of cells.
    weight: [[f32; ROW]; 2],
}

#[inline(always)]
fn histogram(job: &Describe<'_>) -> [f32; DESCRIPTOR_LENGTH] {
    let layer = job.layer;
    let cell = CELL_FACTOR * job.sigma_px;
    let diagonal = cell * std::f32::consts::SQRT_2 * (CELLS + 1) as f32 * 0.5;
    let radius = diagonal.round_ties_even().clamp(0.0, (ROW / 2 - 1) as f32) as usize;
    let (sine, cosine) = job.angle_deg.to_radians().sin_cos();
    let (sine, cosine) = (sine / cell, cosine / cell);
    // exp(-d^2 / (2 s^2)) with s two cells is a product over rows and columns.
    // Column `j` from the key point has its weight at `j + radius`.
    let mut weights = [0.0f32; ROW];
    for (k, weight) in weights.iter_mut().enumerate().take(2 * radius + 1) {
        let away = k as f32 - radius as f32;
        *weight = (-(away * away) / (cell * cell * (CELLS * CELLS) as f32 * 0.5)).exp();
    }
    let first_row = job.row.saturating_sub(radius).max(1);
    let last_row = (job.row + radius).min(layer.height - 2);
    let mut copies = [[0.0f32; LENGTH]; COPIES];
    let mut samples = Samples {
        place: [0; ROW],
        direction: [0.0; ROW],
        second: [0.0; ROW],
        weight: [[0.0; ROW]; 2],
    };
    for row in first_row..=last_row {
        let down = row as f32 - job.row as f32;
        // Cell coordinates are `slope * j + start` at `j` columns from the key point; the columns
        // where both are within -1 and 4 are one interval.
        let starts = [down * cosine + 1.5, -down * sine + 1.5];
        let (mut from, mut to) = (-(radius as f32), radius as f32);
        for (slope, start) in [(sine, starts[0]), (cosine, starts[1])] {
            if slope.abs() > 1e-6 {
                let (a, b) = ((-1.0 - start) / slope, (CELLS as f32 - start) / slope);
                from = from.max(a.min(b).floor());
                to = to.min(a.max(b).ceil());
            } else if !(-1.0..CELLS as f32).contains(&start) {
                to = from - 1.0;
            }
        }
        let first = (job.column as f32 + from).max(1.0) as usize;
        let last = (job.column as f32 + to).min((layer.width - 2) as f32);
        if last < first as f32 || to < from {
            continue;
        }
        let count = (last as usize + 1 - first).min(ROW);
        // Whole registers; what is beyond the row's last sample gets no weight.
        let padded = count.next_multiple_of(MAX_LANES);
        let at = row * layer.width + first;
        let data = &layer.data;
        let (left, right) = (&data[at - 1..][..padded], &data[at + 1..][..padded]);
        let above = &data[at - layer.width..][..padded];
        let below = &data[at + layer.width..][..padded];
        let across = weights[row + radius - job.row];
        let turned = job.angle_deg * (1.0 / 360.0);
        let centre = first as f32 - job.column as f32;
        let mut along = [0.0f32; ROW];
        along[..count].copy_from_slice(&weights[first + radius - job.column..][..count]);
        for k in 0..padded {
            let dx = f32::from(right[k]) - f32::from(left[k]);
            let dy = f32::from(above[k]) - f32::from(below[k]);
            let j = centre + k as f32;
            let cell_row = j * sine + starts[0];
            let cell_column = j * cosine + starts[1];
            let inside = (cell_row > -1.0)
                & (cell_row < CELLS as f32)
                & (cell_column > -1.0)
                & (cell_column < CELLS as f32);
            let length = (dx * dx + dy * dy).sqrt() * (along[k] * across);
            let length = if inside { length } else { 0.0 };
            let direction = gradient::turn(dy, dx) - turned;
            let direction = if direction < 0.0 { direction + 1.0 } else { direction };
            let (r, c) = (gradient::floor(cell_row), gradient::floor(cell_column));
            samples.second[k] = cell_column - c as f32;
            let below = length * (cell_row - r as f32);
            samples.weight[0][k] = length - below;
            samples.weight[1][k] = below;
            samples.direction[k] = direction * BINS as f32;
            let place = ((r + 1) * RIM as i32 + c + 1) * BINS as i32;
            samples.place[k] = if inside { place as u32 } else { 0 };
        }
        add(&samples, count, &mut copies);
    }
    gather(&copies)
}

/// Adds the samples of a row to the histograms.
#[inline(always)]
fn add(samples: &Samples, count: usize, copies: &mut [[f32; LENGTH]; COPIES]) {
    for k in 0..count {
        let place = samples.place[k] as usize;
        let (direction, second) = (samples.direction[k], samples.second[k]);
        let (upper, lower) = (samples.weight[0][k], samples.weight[1][k]);
        let histogram = &mut copies[k % COPIES];
        let mut share = [0.0f32; PAIR];
        for b in 0..PAIR {
            let apart = (direction - (b % BINS) as f32).abs();
            let around = BINS as f32 - apart;
            let apart = if around < apart { around } else { apart };
            let near = 1.0 - apart;
            let near = if near > 0.0 { near } else { 0.0 };
            let column = if b < BINS { 1.0 - second } else { second };
            share[b] = near * column;
        }
        let cells = &mut histogram[place..place + RIM * BINS + PAIR];
        for b in 0..PAIR {
            cells[b] += upper * share[b];
        }
        for b in 0..PAIR {
            cells[RIM * BINS + b] += lower * share[b];
        }
    }
}

/// The sum of the copies without the rim.
#[inline(always)]
fn gather(copies: &[[f32; LENGTH]; COPIES]) -> [f32; DESCRIPTOR_LENGTH] {
    let mut numbers = [0.0; DESCRIPTOR_LENGTH];
    for row in 0..CELLS {
        let from = ((row + 1) * RIM + 1) * BINS;
        let out = &mut numbers[row * CELLS * BINS..][..CELLS * BINS];
        for copy in copies {
            for (out, value) in out.iter_mut().zip(&copy[from..][..CELLS * BINS]) {
                *out += value;
            }
        }
    }
    numbers
}

/// Cuts, normalises and rounds.
#[inline(always)]
fn finish(numbers: &[f32; DESCRIPTOR_LENGTH], norm: Norm, out: &mut [u8]) {
    let square: f32 = numbers.iter().map(|x| x * x).sum();
    let limit = 0.2 * square.sqrt();
    let mut cut = [0.0f32; DESCRIPTOR_LENGTH];
    for (cut, &number) in cut.iter_mut().zip(numbers) {
        *cut = if number < limit { number } else { limit };
    }
    let scale = 512.0;
    match norm {
        Norm::L2 => {
            let length = cut.iter().map(|x| x * x).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
            for x in &mut cut {
                *x *= scale / length;
            }
        }
        Norm::Root => {
            let sum = cut.iter().sum::<f32>().max(f32::MIN_POSITIVE);
            for x in &mut cut {
                *x = scale * (*x / sum).sqrt();
            }
        }
    }
    for (out, &x) in out.iter_mut().zip(&cut) {
        *out = gradient::round(if x < 255.0 { x } else { 255.0 }) as u8;
    }
}
