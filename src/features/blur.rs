//! Separable Gaussian filters, `G(x) ~ exp(-x^2 / (2 sigma^2))`, over layers of a scale space.
//!
//! The picture goes on beyond its border as its mirror image about the outermost pixel centres
//! (`dcb|abcd|cba`). A layer is cut into bands of rows for the threads and these into tiles that stay
//! in the cache between the pass along the rows and the one across them. Four output rows are
//! computed together, so that an input row is loaded once for all four.

use super::pyramid::{LANE_MULTIPLE, Layer};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// Rows of one task.
const BAND: usize = 256;
/// Columns of one tile.
const TILE: usize = 256;
/// Largest reach of a filter, in pixels.
const MAX_RADIUS: usize = 16;
/// Output rows computed together.
const ROWS: usize = 4;

/// One half of a symmetric filter: the weight of the centre and of the pixels `1..=radius` away.
#[derive(Debug, Clone)]
pub(super) struct Kernel {
    pub(super) radius: usize,
    weights: [f32; MAX_RADIUS + 1],
}

impl Kernel {
    /// The Gaussian of standard deviation `sigma_px`, cut off at four of them.
    pub(super) fn gaussian(sigma_px: f64) -> Kernel {
        let size = (8.0 * sigma_px + 1.0).round_ties_even() as usize | 1;
        let radius = (size / 2).min(MAX_RADIUS);
        let value = |x: usize| (-0.5 * (x as f64 / sigma_px).powi(2)).exp();
        let sum: f64 = value(0) + 2.0 * (1..=radius).map(value).sum::<f64>();
        let weights =
            std::array::from_fn(|x| if x <= radius { (value(x) / sum) as f32 } else { 0.0 });
        Kernel { radius, weights }
    }
}

/// Where a filter gets its input rows from.
pub(super) trait Rows: Sync {
    /// Width and height, in pixels.
    fn size(&self) -> (usize, usize);

    /// Pixels `from..from + out.len()` of row `row`; columns may lie outside, by mirroring.
    fn read(&self, row: usize, from: isize, out: &mut [f32]);
}

/// The pixel that stands at `index` when a line of `length` pixels is continued by mirroring.
pub(super) fn mirror(index: isize, length: usize) -> usize {
    let last = length as isize - 1;
    if last <= 0 {
        return 0;
    }
    let folded = index.rem_euclid(2 * last);
    folded.min(2 * last - folded) as usize
}

impl Rows for Layer {
    fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn read(&self, row: usize, from: isize, out: &mut [f32]) {
        let line = &self.data[row * self.stride..][..self.width];
        copy_mirrored(line, from, out);
    }
}

/// Copies `line` continued by mirroring.
pub(super) fn copy_mirrored(line: &[f32], from: isize, out: &mut [f32]) {
    let width = line.len() as isize;
    let first = (-from).clamp(0, out.len() as isize);
    let last = (width - from).clamp(first, out.len() as isize);
    let (left, rest) = out.split_at_mut(first as usize);
    let (inside, right) = rest.split_at_mut((last - first) as usize);
    if !inside.is_empty() {
        inside.copy_from_slice(&line[(from + first) as usize..][..inside.len()]);
    }
    for (k, value) in left.iter_mut().enumerate() {
        *value = line[mirror(from + k as isize, line.len())];
    }
    for (k, value) in right.iter_mut().enumerate() {
        *value = line[mirror(from + last + k as isize, line.len())];
    }
}

/// Filters `input` into `output`, which has its size.
pub(super) fn blur(input: &impl Rows, kernel: &Kernel, output: &mut Layer) {
    let stride = output.stride;
    output.data.par_chunks_mut(BAND * stride).enumerate().for_each(|(band, rows)| {
        let band = Band { input, kernel, first_row: band * BAND, stride, rows };
        pulp::Arch::new().dispatch(band);
    });
}

/// A band of output rows.
struct Band<'a, I: Rows> {
    input: &'a I,
    kernel: &'a Kernel,
    first_row: usize,
    stride: usize,
    rows: &'a mut [f32],
}

impl<I: Rows> WithSimd for Band<'_, I> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // The radii of the scale space's own filters are compiled with their loops unrolled.
        match self.kernel.radius {
            5 => band::<S, I, 5>(simd, self),
            6 => band::<S, I, 6>(simd, self),
            8 => band::<S, I, 8>(simd, self),
            10 => band::<S, I, 10>(simd, self),
            13 => band::<S, I, 13>(simd, self),
            // Weights beyond the kernel's radius are zero.
            _ => band::<S, I, MAX_RADIUS>(simd, self),
        }
    }
}

#[inline(always)]
fn band<S: Simd, I: Rows, const R: usize>(simd: S, band: Band<'_, I>) {
    let Band { input, kernel, first_row, stride, rows } = band;
    let (_, height) = input.size();
    let count = rows.len() / stride;
    let mut buffer = vec![0.0f32; (count + 2 * R) * TILE];
    let mut segment = [0.0f32; TILE + 2 * MAX_RADIUS];
    let mut from = 0;
    while from < stride {
        let width = TILE.min(stride - from);
        for line in 0..count + 2 * R {
            let row = mirror((first_row + line) as isize - R as isize, height);
            let segment = &mut segment[..width + 2 * R];
            input.read(row, from as isize - R as isize, segment);
            along_row::<S, R>(simd, segment, kernel, &mut buffer[line * TILE..][..width]);
        }
        let mut row = 0;
        while row < count {
            let lines = &buffer[row * TILE..];
            let out = &mut rows[row * stride..];
            if count - row >= ROWS {
                across_rows::<S, R, ROWS>(simd, lines, kernel, out, stride, from, width);
                row += ROWS;
            } else {
                across_rows::<S, R, 1>(simd, lines, kernel, out, stride, from, width);
                row += 1;
            }
        }
        from += width;
    }
}

/// `out[x] = w_0 in[x + R] + sum_k w_k (in[x + R - k] + in[x + R + k])`.
#[inline(always)]
fn along_row<S: Simd, const R: usize>(simd: S, input: &[f32], kernel: &Kernel, out: &mut [f32]) {
    let (out, _) = S::as_mut_simd_f32s(out);
    for (block, out) in out.iter_mut().enumerate() {
        let window = &input[block * S::F32_LANES..][..S::F32_LANES + 2 * R];
        let mut sum = simd.mul_f32s(simd.splat_f32s(kernel.weights[0]), load::<S>(window, R));
        for k in 1..=R {
            let pair = simd.add_f32s(load::<S>(window, R - k), load::<S>(window, R + k));
            sum = simd.mul_add_e_f32s(simd.splat_f32s(kernel.weights[k]), pair, sum);
        }
        *out = sum;
    }
}

#[inline(always)]
fn load<S: Simd>(values: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&values[at..at + S::F32_LANES]).0[0]
}

/// `N` output rows from `N + 2 R` lines of a tile.
#[inline(always)]
fn across_rows<S: Simd, const R: usize, const N: usize>(
    simd: S,
    lines: &[f32],
    kernel: &Kernel,
    out: &mut [f32],
    stride: usize,
    from: usize,
    width: usize,
) {
    let mut at = 0;
    while at < width {
        let mut sums = [simd.splat_f32s(0.0); N];
        for line in 0..N + 2 * R {
            let value = load::<S>(&lines[line * TILE..][..TILE], at);
            for (row, sum) in sums.iter_mut().enumerate() {
                // Output `row` has its centre at line `row + R`.
                let distance = (row + R).abs_diff(line);
                if distance <= R {
                    let weight = simd.splat_f32s(kernel.weights[distance]);
                    *sum = simd.mul_add_e_f32s(weight, value, *sum);
                }
            }
        }
        for (row, sum) in sums.iter().enumerate() {
            let place = &mut out[row * stride + from + at..][..S::F32_LANES];
            S::as_mut_simd_f32s(place).0[0] = *sum;
        }
        at += S::F32_LANES;
    }
}

// Every tile is a whole number of registers.
const _: () = assert!(TILE.is_multiple_of(LANE_MULTIPLE));

#[cfg(test)]
mod tests {
    use super::*;

    fn direct(input: &Layer, kernel: &Kernel, u: usize, v: usize) -> f64 {
        let weight = |k: isize| f64::from(kernel.weights[k.unsigned_abs()]);
        let reach = kernel.radius as isize;
        let mut sum = 0.0;
        for j in -reach..=reach {
            for i in -reach..=reach {
                let row = mirror(v as isize + j, input.height);
                let column = mirror(u as isize + i, input.width);
                sum += weight(i) * weight(j) * f64::from(input.at(column, row));
            }
        }
        sum
    }

    #[test]
    fn a_blurred_layer_is_the_double_sum_of_its_mirrored_continuation() {
        for (width, height, sigma) in [
            (300, 270, 1.2262735),
            (37, 21, 3.0900155),
            (5, 3, 1.5),
            (1, 1, 2.0),
            (40, 1, 1.9465878),
        ] {
            let mut input = Layer::new(width, height);
            for v in 0..height {
                for u in 0..width {
                    let value = (u * u * 7 + v * 131 + u * v * 3) % 256;
                    input.data[v * input.stride + u] = value as f32;
                }
            }
            let kernel = Kernel::gaussian(sigma);
            let mut output = Layer::new(width, height);
            blur(&input, &kernel, &mut output);
            for v in (0..height).step_by(7).chain([height - 1]) {
                for u in (0..width).step_by(13).chain([width - 1]) {
                    let expected = direct(&input, &kernel, u, v);
                    let got = f64::from(output.at(u, v));
                    // Sums of 27 products of single precision, twice, on values up to 256.
                    assert!((got - expected).abs() < 1e-3, "{width}x{height} {u} {v}");
                }
            }
        }
    }

    #[test]
    fn mirroring_turns_about_the_outermost_pixels() {
        let line: Vec<usize> = (-4..8).map(|x| mirror(x, 4)).collect();
        assert_eq!(line, [2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1]);
        assert_eq!((mirror(-3, 1), mirror(9, 1)), (0, 0));
    }
}
