//! Extrema of the difference of Gaussians in space and scale, refined to fractions of a pixel.
//!
//! `D_s = L_(s+1) - L_s`. A pixel is a candidate where `|D_s|` exceeds a threshold and no one of its 26
//! neighbours in space and scale is beyond it. Around a candidate `D` is replaced by its quadratic
//! expansion; its stationary point `x = -H^-1 g` is the key point, where it lies within half a pixel
//! and half a scale of the pixel (else the neighbour is tried, up to five times). Those of low contrast
//! `|D + g^T x / 2|` and those on edges, `tr(H)^2 / det(H) >= (r + 1)^2 / r`, are dropped.
//! Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, sections 3 and 4.

use super::{
    FeatureOptions,
    pyramid::{BASE_SIGMA_PX, BORDER, Frames, LAYERS, SCALES, TILE, Tile},
};
use pulp::{Simd, WithSimd};

/// Differences in an octave.
const DIFFERENCES: usize = SCALES + 2;
/// How often a neighbour is tried.
const MAX_MOVES: usize = 5;
/// How far from the candidate the key point may be, in pixels along rows and columns; beyond it the
/// expansion says nothing about the candidate.
pub(super) const REACH: usize = 4;

/// A refined extremum, in the pixels of its octave.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Extremum {
    pub(super) octave: u8,
    /// Layer whose gradients describe it, 1 to 3.
    pub(super) layer: u8,
    /// The pixel.
    pub(super) column: u32,
    pub(super) row: u32,
    /// The fraction of a pixel and of a scale to add.
    pub(super) offset: [f32; 3],
    /// Contrast, grey values taken as 0 to 1.
    pub(super) response: f32,
}

impl Extremum {
    /// Position in the pixels of the octave.
    pub(super) fn position(&self) -> (f32, f32) {
        (self.column as f32 + self.offset[0], self.row as f32 + self.offset[1])
    }

    /// Blur at which it was found, in pixels of the octave.
    pub(super) fn sigma(&self) -> f32 {
        let scale = (f32::from(self.layer) + self.offset[2]) / SCALES as f32;
        BASE_SIGMA_PX as f32 * scale.exp2()
    }
}

/// Columns of a tile.
const WIDTH: usize = TILE.0;

/// What one row of a tile has in one difference; column 0 is one to the left of the tile.
#[derive(Clone)]
struct Line {
    value: [f32; WIDTH + 2],
    /// Largest and smallest of the pixel and its left and right neighbours.
    high: [f32; WIDTH],
    low: [f32; WIDTH],
}

/// Working memory of the search.
pub(super) struct Lines {
    /// Three rows of each difference, row `v` at `v % 3`.
    ring: Vec<[Line; 3]>,
    /// Largest and smallest of 3 x 3 pixels in each difference.
    extremes: Vec<[[f32; WIDTH]; 2]>,
}

impl Lines {
    pub(super) fn new() -> Lines {
        let empty = Line { value: [0.0; WIDTH + 2], high: [0.0; WIDTH], low: [0.0; WIDTH] };
        Lines {
            ring: vec![[empty.clone(), empty.clone(), empty]; DIFFERENCES],
            extremes: vec![[[0.0; WIDTH]; 2]; DIFFERENCES],
        }
    }
}

/// Appends the extrema of a tile.
pub(super) struct Scan<'a> {
    pub(super) tile: &'a Tile,
    pub(super) frames: &'a mut Frames,
    pub(super) octave: u8,
    pub(super) options: &'a FeatureOptions,
    pub(super) found: &'a mut Vec<Extremum>,
}

impl WithSimd for Scan<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        scan(self);
    }
}

#[inline(always)]
fn scan(job: Scan<'_>) {
    let Scan { tile, frames, octave, options, found } = job;
    let Frames { layers, scan: Lines { ring, extremes }, .. } = frames;
    let threshold = (0.5 * options.contrast_threshold / SCALES as f32 * 255.0).floor();
    // One column after another of the tile may be a candidate, as far as it is not at the border.
    let (left, top) = tile.from;
    let first = BORDER.saturating_sub(left);
    let last = tile.size.0.min((tile.whole.0 - BORDER).saturating_sub(left));
    let first_row = top.max(BORDER);
    let last_row = (top + tile.size.1).min(tile.whole.1 - BORDER);
    let mut flags = [0u8; WIDTH];
    for row in first_row.saturating_sub(1)..=last_row {
        if first_row >= last_row || first >= last {
            break;
        }
        for d in 0..DIFFERENCES {
            let at = tile.place(left, row) - 1;
            let line = &mut ring[d][row % 3];
            subtract(&layers[d + 1][at..], &layers[d][at..], line);
        }
        if row <= first_row {
            continue;
        }
        for d in 0..DIFFERENCES {
            let [high, low] = &mut extremes[d];
            extreme_of_three(&ring[d], high, low);
        }
        let row = row - 1;
        for layer in 1..=SCALES {
            flag(&ring[layer][row % 3], &extremes[layer - 1..layer + 2], threshold, &mut flags);
            for (word, eight) in flags.as_chunks::<8>().0.iter().enumerate() {
                if *eight == [0; 8] {
                    continue;
                }
                for k in 0..8 {
                    let column = 8 * word + k;
                    if eight[k] != 0 && (first..last).contains(&column) {
                        let start = [left + column, row, layer];
                        found.extend(refine(tile, layers, octave, start, options));
                    }
                }
            }
        }
    }
}

/// The difference of two rows and the extremes of three pixels in it.
#[inline(always)]
fn subtract(upper: &[f32], lower: &[f32], line: &mut Line) {
    for ((value, &upper), &lower) in line.value.iter_mut().zip(upper).zip(lower) {
        *value = upper - lower;
    }
    for k in 0..WIDTH {
        let (left, middle, right) = (line.value[k], line.value[k + 1], line.value[k + 2]);
        line.high[k] = larger(larger(left, middle), right);
        line.low[k] = smaller(smaller(left, middle), right);
    }
}

#[inline(always)]
fn extreme_of_three(lines: &[Line; 3], high: &mut [f32; WIDTH], low: &mut [f32; WIDTH]) {
    let [a, b, c] = lines;
    for k in 0..WIDTH {
        high[k] = larger(larger(a.high[k], b.high[k]), c.high[k]);
        low[k] = smaller(smaller(a.low[k], b.low[k]), c.low[k]);
    }
}

/// Sets the flags of the candidates among one row's pixels.
#[inline(always)]
fn flag(line: &Line, extremes: &[[[f32; WIDTH]; 2]], threshold: f32, flags: &mut [u8; WIDTH]) {
    let [[high_0, low_0], [high_1, low_1], [high_2, low_2]] = extremes else { return };
    for k in 0..WIDTH {
        let value = line.value[k + 1];
        let high = larger(larger(high_0[k], high_1[k]), high_2[k]);
        let low = smaller(smaller(low_0[k], low_1[k]), low_2[k]);
        let maximum = (value > threshold) & (value >= high);
        let minimum = (value < -threshold) & (value <= low);
        flags[k] = u8::from(maximum | minimum);
    }
}

/// One instruction, unlike `f32::max`, which minds NaN.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The 27 differences around a place of a frame, as `[scale][row][column]`.
fn neighbourhood(layers: &[Vec<f32>; LAYERS], layer: usize, place: usize) -> [[[f32; 3]; 3]; 3] {
    std::array::from_fn(|scale| {
        let (lower, upper) = (&layers[layer + scale - 1], &layers[layer + scale]);
        std::array::from_fn(|v| {
            let at = place + v * Tile::STRIDE - Tile::STRIDE - 1;
            std::array::from_fn(|u| upper[at + u] - lower[at + u])
        })
    })
}

/// Moves a candidate (column, row, layer) to the stationary point of its quadratic expansion, and
/// judges it.
fn refine(
    tile: &Tile,
    layers: &[Vec<f32>; LAYERS],
    octave: u8,
    start: [usize; 3],
    options: &FeatureOptions,
) -> Option<Extremum> {
    // Grey values are 0 to 255, contrast is measured where they are 0 to 1.
    const SCALE: f32 = 1.0 / 255.0;
    let [mut column, mut row, mut layer] = start;
    for _ in 0..MAX_MOVES {
        let d = neighbourhood(layers, layer, tile.place(column, row));
        let centre = d[1][1][1];
        let gradient = [
            (d[1][1][2] - d[1][1][0]) * 0.5 * SCALE,
            (d[1][2][1] - d[1][0][1]) * 0.5 * SCALE,
            (d[2][1][1] - d[0][1][1]) * 0.5 * SCALE,
        ];
        let twice = 2.0 * centre;
        let xx = (d[1][1][2] + d[1][1][0] - twice) * SCALE;
        let yy = (d[1][2][1] + d[1][0][1] - twice) * SCALE;
        let ss = (d[2][1][1] + d[0][1][1] - twice) * SCALE;
        let xy = (d[1][2][2] - d[1][2][0] - d[1][0][2] + d[1][0][0]) * 0.25 * SCALE;
        let xs = (d[2][1][2] - d[2][1][0] - d[0][1][2] + d[0][1][0]) * 0.25 * SCALE;
        let ys = (d[2][2][1] - d[2][0][1] - d[0][2][1] + d[0][0][1]) * 0.25 * SCALE;
        let offset = solve([[xx, xy, xs], [xy, yy, ys], [xs, ys, ss]], gradient)?.map(|x| -x);
        if offset.iter().all(|x| x.abs() < 0.5) {
            let slope: f32 = (0..3).map(|k| gradient[k] * offset[k]).sum();
            let response = (centre * SCALE + 0.5 * slope).abs();
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let edge = options.edge_threshold;
            let kept = response * SCALES as f32 >= options.contrast_threshold
                && determinant > 0.0
                && trace * trace * edge < (edge + 1.0) * (edge + 1.0) * determinant;
            return kept.then_some(Extremum {
                octave,
                layer: layer as u8,
                column: column as u32,
                row: row as u32,
                offset,
                response,
            });
        }
        let moved = |from: usize, by: f32, low: usize, high: usize| {
            // A step beyond any picture becomes the type's limit and is refused like any other.
            let to = (from as i64).saturating_add(by.round_ties_even() as i64);
            (low as i64..high as i64).contains(&to).then_some(to as usize)
        };
        let near = |start: usize, whole: usize| {
            (BORDER.max(start.saturating_sub(REACH)), (whole - BORDER).min(start + REACH + 1))
        };
        let (left, right) = near(start[0], tile.whole.0);
        let (top, bottom) = near(start[1], tile.whole.1);
        column = moved(column, offset[0], left, right)?;
        row = moved(row, offset[1], top, bottom)?;
        layer = moved(layer, offset[2], 1, SCALES + 1)?;
    }
    None
}

/// Solves `A x = b` by elimination with pivoting; `None` where `A` is singular.
fn solve(mut a: [[f32; 3]; 3], mut b: [f32; 3]) -> Option<[f32; 3]> {
    for k in 0..3 {
        let pivot = (k..3).max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs()))?;
        if a[pivot][k].abs() < f32::EPSILON * f32::EPSILON {
            return None;
        }
        a.swap(k, pivot);
        b.swap(k, pivot);
        for i in k + 1..3 {
            let factor = a[i][k] / a[k][k];
            for j in k..3 {
                a[i][j] -= factor * a[k][j];
            }
            b[i] -= factor * b[k];
        }
    }
    for k in (0..3).rev() {
        for j in k + 1..3 {
            b[k] -= a[k][j] * b[j];
        }
        b[k] /= a[k][k];
    }
    b.iter().all(|x| x.is_finite()).then_some(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_equations_are_solved_with_pivoting() {
        let x = solve([[0.0, 2.0, 1.0], [1.0, 0.0, -1.0], [3.0, 1.0, 1.0]], [7.0, -2.0, 8.0]);
        let x = x.unwrap();
        for (got, expected) in x.iter().zip([1.0, 2.0, 3.0]) {
            assert!((got - expected).abs() < 1e-5, "{x:?}");
        }
        assert_eq!(solve([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]], [1.0; 3]), None);
        assert_eq!(solve([[0.0; 3]; 3], [1.0; 3]), None);
    }
}
