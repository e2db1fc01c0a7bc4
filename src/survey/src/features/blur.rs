//! Separable Gaussian filters, `G(x) ~ exp(-x^2 / (2 sigma^2))`, over the frame of a tile.
//!
//! A frame is a tile of a picture with a margin around it; every filter leaves less of the margin
//! valid, and nothing has to be known about the picture's borders here. The pass along the rows and
//! the one across them go over panels of columns that stay in the cache. Four output rows are computed
//! together, so that an input row is loaded once for all four.

use pulp::{Simd, WithSimd};

/// Columns of a panel.
const PANEL: usize = 128;
/// Largest reach of a filter, in pixels.
pub(super) const MAX_RADIUS: usize = 13;
/// Output rows computed together; a filter may write this many rows less one too far.
const ROWS: usize = 4;
/// Columns of the widest register; a filter may write this many columns less one too far.
pub(super) const MAX_LANES: usize = 16;

/// A symmetric filter.
#[derive(Debug, Clone)]
pub(super) struct Kernel {
    pub(super) radius: usize,
    /// Weights of the centre and of the pixels 1, 2, ... away; zero beyond the radius.
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

/// What is to be filtered: a rectangle of a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window {
    /// Distance of the rows in memory.
    pub(super) stride: usize,
    /// First column and row.
    pub(super) from: (usize, usize),
    /// Columns and rows.
    pub(super) size: (usize, usize),
}

/// Filters the window of `input` into that of `output`.
///
/// The kernel's radius must be free around the window, and [`MAX_LANES`] columns and [`ROWS`] rows
/// more to its right and below.
pub(super) struct Blur<'a> {
    pub(super) kernel: &'a Kernel,
    pub(super) window: Window,
    pub(super) input: &'a [f32],
    pub(super) output: &'a mut [f32],
    /// Working memory.
    pub(super) lines: &'a mut Vec<f32>,
}

impl WithSimd for Blur<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // The radii of the scale space's own filters are compiled with their loops unrolled; weights
        // beyond the kernel's radius are zero.
        match self.kernel.radius {
            5 => panels::<S, 5>(simd, self),
            6 => panels::<S, 6>(simd, self),
            8 => panels::<S, 8>(simd, self),
            10 => panels::<S, 10>(simd, self),
            _ => panels::<S, MAX_RADIUS>(simd, self),
        }
    }
}

#[inline(always)]
fn panels<S: Simd, const R: usize>(simd: S, job: Blur<'_>) {
    let Blur { kernel, window, input, output, lines } = job;
    let Window { stride, from: (column, row), size: (width, height) } = window;
    let height = height.next_multiple_of(ROWS);
    lines.resize((height + 2 * R) * PANEL, 0.0);
    let mut done = 0;
    while done < width {
        let panel = PANEL.min((width - done).next_multiple_of(S::F32_LANES));
        for line in 0..height + 2 * R {
            let at = (row + line - R) * stride + column + done - R;
            let out = &mut lines[line * PANEL..][..panel];
            along_row::<S, R>(simd, &input[at..at + panel + 2 * R], kernel, out);
        }
        for line in (0..height).step_by(ROWS) {
            let out = &mut output[(row + line) * stride + column + done..];
            across_rows::<S, R>(simd, &lines[line * PANEL..], kernel, out, stride, panel);
        }
        done += panel;
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

/// [`ROWS`] output rows from `ROWS + 2 R` lines of a panel.
#[inline(always)]
fn across_rows<S: Simd, const R: usize>(
    simd: S,
    lines: &[f32],
    kernel: &Kernel,
    out: &mut [f32],
    stride: usize,
    width: usize,
) {
    // The weights from one end of the filter to the other.
    let mut taps = [simd.splat_f32s(0.0); 2 * MAX_RADIUS + 1];
    for (k, tap) in taps.iter_mut().enumerate().take(2 * R + 1) {
        *tap = simd.splat_f32s(kernel.weights[k.abs_diff(R)]);
    }
    let mut at = 0;
    while at < width {
        let mut sums = [simd.splat_f32s(0.0); ROWS];
        // Line `k` has tap `k - row` of output `row`: first come lines that the last rows do not have,
        // then those that all have, then those that the first rows do not have.
        for line in 0..ROWS - 1 {
            let value = load::<S>(&lines[line * PANEL..][..PANEL], at);
            for row in 0..=line {
                sums[row] = simd.mul_add_e_f32s(taps[line - row], value, sums[row]);
            }
        }
        for line in ROWS - 1..2 * R + 1 {
            let value = load::<S>(&lines[line * PANEL..][..PANEL], at);
            for row in 0..ROWS {
                sums[row] = simd.mul_add_e_f32s(taps[line - row], value, sums[row]);
            }
        }
        for line in 2 * R + 1..2 * R + ROWS {
            let value = load::<S>(&lines[line * PANEL..][..PANEL], at);
            for row in line - 2 * R..ROWS {
                sums[row] = simd.mul_add_e_f32s(taps[line - row], value, sums[row]);
            }
        }
        for (row, sum) in sums.iter().enumerate() {
            let place = &mut out[row * stride + at..][..S::F32_LANES];
            S::as_mut_simd_f32s(place).0[0] = *sum;
        }
        at += S::F32_LANES;
    }
}

// Every panel is a whole number of registers.
const _: () = assert!(PANEL.is_multiple_of(MAX_LANES));

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_filtered_window_is_the_double_sum() {
        let (stride, rows) = (240, 90);
        let input: Vec<f32> =
            (0..stride * rows).map(|k| ((k * k * 7 + k * 131) % 256) as f32).collect();
        for (sigma, size) in [(1.2262735, (150, 31)), (3.0900155, (129, 2)), (1.0, (1, 57))] {
            let kernel = Kernel::gaussian(sigma);
            let window = Window { stride, from: (17, 16), size };
            let mut output = vec![0.0; input.len()];
            let lines = &mut Vec::new();
            let (kernel, output) = (&kernel, &mut output);
            pulp::Arch::new().dispatch(Blur { kernel, window, input: &input, output, lines });
            let reach = kernel.radius as isize;
            assert!(reach <= MAX_RADIUS as isize);
            for (u, v) in [(0, 0), (size.0 - 1, size.1 - 1), (size.0 / 2, size.1 / 2)] {
                let centre = (16 + v) * stride + 17 + u;
                let mut expected = 0.0;
                for j in -reach..=reach {
                    for i in -reach..=reach {
                        let weight = |k: isize| f64::from(kernel.weights[k.unsigned_abs()]);
                        let at = centre as isize + j * stride as isize + i;
                        expected += weight(i) * weight(j) * f64::from(input[at as usize]);
                    }
                }
                // Sums of up to 27 products of single precision, twice, on values up to 256.
                assert!((f64::from(output[centre]) - expected).abs() < 1e-3);
            }
        }
    }
}
