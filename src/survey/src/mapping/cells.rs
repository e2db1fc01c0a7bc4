//! A block of cells of the map: their heights, and where a photo shows them, many at a time.
//!
//! ```text
//! (U, V, W) = R (X - C),   a = U / W,   b = V / W        for every cell
//! (u, v) = lens(a, b) ~ sum_mn c_mn a^m b^n,  m, n <= 2    with a rolling shutter: c_mn + c'_mn / W
//! ```
//!
//! Collinearity is computed for every cell. What the lens makes of it is so smooth over a block that a polynomial
//! through 3 x 3 (times 2) of its own positions stands for it. Between those, where such a polynomial is
//! furthest off, it is compared with the lens; where they differ by more than [`TOLERANCE_PX`], or
//! the lens has no answer, every cell goes through the lens itself.

use super::{Surface, View};
use rowgram_raster::georeference::Georeference;

/// Side of a block, cells.
pub(super) const SIDE: usize = 32;
/// Cells of a block.
pub(super) const CELLS: usize = SIDE * SIDE;
/// The last column and row.
const LAST: f64 = (SIDE - 1) as f64;
/// How far, pixels, a position may be from the lens's own where it is looked at; elsewhere in the block it is not
/// much more.
pub(super) const TOLERANCE_PX: f64 = 0.002;
/// Where, between -1, 0 and 1, a parabola through these is furthest off: the extremum of `s (s^2 - 1)`.
const FURTHEST: f64 = 0.577_350_269_189_625_8;
/// Column numbers.
const COLUMNS: [f64; SIDE] = {
    let mut columns = [0.0; SIDE];
    let mut i = 0;
    while i < SIDE {
        columns[i] = i as f64;
        i += 1;
    }
    columns
};

/// Coefficients of `1, s, s^2` (columns) and `1, t, t^2` (rows).
type Quadratic = [[f64; 3]; 3];
/// Image positions of a block; NaN where the cell is not shown.
pub(super) type Pixels = [[f32; 2]; CELLS];

/// Where in the image plane a photo is used: `least <= at <= most` and `at < below`, in columns and rows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub(super) least: [f64; 2],
    pub(super) most: [f64; 2],
    pub(super) below: [f64; 2],
}

impl Frame {
    #[inline(always)]
    pub(super) fn holds(&self, [u, v]: [f64; 2]) -> bool {
        // Not `&&`, so that it needs no branches.
        (u >= self.least[0])
            & (u <= self.most[0])
            & (u < self.below[0])
            & (v >= self.least[1])
            & (v <= self.most[1])
            & (v < self.below[1])
    }
}

/// A block of cells with their heights.
#[derive(Debug, Clone)]
pub(super) struct CellBlock {
    /// Position of the first cell, metres.
    corner_m: [f64; 2],
    per_column: [f64; 2],
    per_row: [f64; 2],
    /// Metres; row by row, [`SIDE`] apart; NaN where there is none.
    pub(super) z_m: [f64; CELLS],
    /// Least and greatest x, y and z.
    pub(super) bounds_m: [[f64; 2]; 3],
    /// Cells with a height.
    pub(super) known: usize,
    line: Vec<f64>,
}

impl CellBlock {
    pub(super) fn new() -> CellBlock {
        CellBlock {
            corner_m: [0.0; 2],
            per_column: [0.0; 2],
            per_row: [0.0; 2],
            z_m: [f64::NAN; CELLS],
            bounds_m: [[0.0; 2]; 3],
            known: 0,
            line: Vec::new(),
        }
    }

    /// Takes the block that begins at a cell. `to_surface` takes a cell to the surface's own grid.
    pub(super) fn fill(
        &mut self,
        first: [usize; 2],
        grid: &Georeference,
        surface: &Surface,
        to_surface: &[[f64; 3]; 2],
    ) {
        self.corner_m = grid.map(first.map(|n| n as f64));
        (self.per_column, self.per_row) = (grid.per_column, grid.per_row);
        let aligned = to_surface[0][2] == 0.0 && to_surface[1][1] == 0.0;
        if aligned {
            for (j, row) in self.z_m.chunks_exact_mut(SIDE).enumerate() {
                let v = to_surface[1][0] + to_surface[1][2] * (first[1] + j) as f64;
                let u = to_surface[0][0] + to_surface[0][1] * first[0] as f64;
                surface.row(v, u, to_surface[0][1], &mut self.line, row);
            }
        } else {
            for j in 0..SIDE {
                for i in 0..SIDE {
                    let cell = [(first[0] + i) as f64, (first[1] + j) as f64];
                    let at = to_surface.map(|[o, a, b]| o + a * cell[0] + b * cell[1]);
                    self.z_m[j * SIDE + i] = surface.at_pixel(at).unwrap_or(f64::NAN);
                }
            }
        }
        let mut z = [f64::INFINITY, f64::NEG_INFINITY];
        self.known = 0;
        for &height in &self.z_m {
            let known = height.is_finite();
            self.known += usize::from(known);
            z[0] = if known & (height < z[0]) { height } else { z[0] };
            z[1] = if known & (height > z[1]) { height } else { z[1] };
        }
        let range = |k: usize| {
            let of = [0.0, LAST].map(|i| {
                [0.0, LAST].map(|j| self.corner_m[k] + i * self.per_column[k] + j * self.per_row[k])
            });
            let of = of.as_flattened();
            [
                of.iter().copied().fold(f64::INFINITY, f64::min),
                of.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            ]
        };
        self.bounds_m = [range(0), range(1), z];
    }

    /// Puts all cells so many metres higher.
    pub(super) fn raise(&mut self, by_m: f64) {
        self.z_m.iter_mut().chain(&mut self.bounds_m[2]).for_each(|z| *z += by_m);
    }

    /// The point on the ground of a cell of the block.
    #[inline(always)]
    pub(super) fn point_m(&self, i: usize, j: usize) -> [f64; 3] {
        let at = |k: usize| {
            self.corner_m[k] + i as f64 * self.per_column[k] + j as f64 * self.per_row[k]
        };
        [at(0), at(1), self.z_m[j * SIDE + i]]
    }

    /// Writes where a photo shows the cells; returns how many it shows.
    pub(super) fn project(&self, view: &View, frame: &Frame, out: &mut Pixels) -> usize {
        if let Some(lens) = self.lens(view) {
            return pulp::Arch::new().dispatch(Projection { cells: self, lens, frame, out });
        }
        let mut shown = 0;
        for j in 0..SIDE {
            for i in 0..SIDE {
                let point = self.point_m(i, j);
                let at = match point[2].is_finite() {
                    true => view.pixel(point).filter(|at| frame.holds(*at)),
                    false => None,
                };
                shown += usize::from(at.is_some());
                out[j * SIDE + i] = at.map_or([f32::NAN; 2], |at| at.map(|value| value as f32));
            }
        }
        shown
    }

    /// The photo's polynomials for this block; `None` where they are not good enough.
    fn lens(&self, view: &View) -> Option<LocalLens> {
        let centre = view.centre_m();
        let [_, _, z] = self.bounds_m;
        let middle_m = 0.5 * (z[0] + z[1]);
        let rotation = view.rotation();
        let turn = |d: [f64; 3]| rotation.map(|row| row[0] * d[0] + row[1] * d[1] + row[2] * d[2]);
        let first = turn([
            self.corner_m[0] - centre[0],
            self.corner_m[1] - centre[1],
            middle_m - centre[2],
        ]);
        let along = turn([self.per_column[0], self.per_column[1], 0.0]);
        let down = turn([self.per_row[0], self.per_row[1], 0.0]);
        let up = turn([0.0, 0.0, 1.0]);
        // U / W and V / W over a box have their extrema at its corners.
        let mut range = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
        for corner in 0..8 {
            let i = if corner & 1 == 0 { 0.0 } else { LAST };
            let j = if corner & 2 == 0 { 0.0 } else { LAST };
            let h = if corner & 4 == 0 { z[0] } else { z[1] } - middle_m;
            let p: [f64; 3] =
                std::array::from_fn(|k| first[k] + i * along[k] + j * down[k] + h * up[k]);
            // In front of the camera is where W < 0.
            if p[2] > -1e-6 {
                return None;
            }
            let q = 1.0 / p[2];
            for (range, value) in range.iter_mut().zip([p[0] * q, p[1] * q, q]) {
                *range = [range[0].min(value), range[1].max(value)];
            }
        }
        let middle = range.map(|[low, high]| 0.5 * (low + high));
        let half = range.map(|[low, high]| (0.5 * (high - low)).max(1e-9));
        let exact = |s: f64, t: f64, r: f64| {
            let (a, b) = (middle[0] + s * half[0], middle[1] + t * half[1]);
            let w = 1.0 / (middle[2] + r * half[2]);
            view.image_px([a * w, b * w, w])
        };
        let at = |r: f64| -> Option<[Quadratic; 2]> {
            let mut values = [[[0.0; 3]; 3]; 2];
            for (n, t) in [-1.0, 0.0, 1.0].into_iter().enumerate() {
                for (m, s) in [-1.0, 0.0, 1.0].into_iter().enumerate() {
                    let at = exact(s, t, r)?;
                    (0..2).for_each(|k| values[k][n][m] = at[k]);
                }
            }
            Some(values.map(through))
        };
        let (constant, slope) = if view.has_rolling_shutter() {
            let (low, high) = (at(-1.0)?, at(1.0)?);
            let mix = |of: fn(f64, f64) -> f64| -> [Quadratic; 2] {
                std::array::from_fn(|k| {
                    std::array::from_fn(|n| {
                        std::array::from_fn(|m| of(low[k][n][m], high[k][n][m]))
                    })
                })
            };
            (mix(|a, b| 0.5 * (a + b)), Some(mix(|a, b| 0.5 * (b - a))))
        } else {
            (at(0.0)?, None)
        };
        for s in [-FURTHEST, FURTHEST] {
            for t in [-FURTHEST, FURTHEST] {
                let exact = exact(s, t, 0.0)?;
                let off = (0..2).map(|k| (value(&constant[k], s, t) - exact[k]).abs());
                if off.fold(0.0, f64::max) > TOLERANCE_PX {
                    return None;
                }
            }
        }
        Some(LocalLens { first, along, down, up, middle_m, middle, half, constant, slope })
    }
}

/// What takes the cells of a block into a photo.
struct LocalLens {
    /// The first cell at height `middle_m` in the camera frame; what a column, a row and a metre of height add.
    first: [f64; 3],
    along: [f64; 3],
    down: [f64; 3],
    up: [f64; 3],
    middle_m: f64,
    /// Of `U / W`, `V / W` and `1 / W`.
    middle: [f64; 3],
    half: [f64; 3],
    /// Of columns and rows.
    constant: [Quadratic; 2],
    slope: Option<[Quadratic; 2]>,
}

struct Projection<'a> {
    cells: &'a CellBlock,
    lens: LocalLens,
    frame: &'a Frame,
    out: &'a mut Pixels,
}

impl pulp::WithSimd for Projection<'_> {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> usize {
        let Projection { cells, lens, frame, out } = self;
        let inverse = lens.half.map(|half| 1.0 / half);
        let mut shown = 0u32;
        for j in 0..SIDE {
            let mut start = lens.first;
            for k in 0..3 {
                start[k] += j as f64 * lens.down[k];
            }
            let heights = &cells.z_m[j * SIDE..j * SIDE + SIDE];
            let out = &mut out[j * SIDE..j * SIDE + SIDE];
            for i in 0..SIDE {
                let h = heights[i] - lens.middle_m;
                let x = COLUMNS[i];
                let u = start[0] + x * lens.along[0] + h * lens.up[0];
                let v = start[1] + x * lens.along[1] + h * lens.up[1];
                let w = start[2] + x * lens.along[2] + h * lens.up[2];
                let q = 1.0 / w;
                let s = (u * q - lens.middle[0]) * inverse[0];
                let t = (v * q - lens.middle[1]) * inverse[1];
                let mut at = [value(&lens.constant[0], s, t), value(&lens.constant[1], s, t)];
                if let Some(slope) = &lens.slope {
                    let r = (q - lens.middle[2]) * inverse[2];
                    at[0] += r * value(&slope[0], s, t);
                    at[1] += r * value(&slope[1], s, t);
                }
                // A cell without a height has NaN here, and that is not inside.
                let inside = frame.holds(at);
                out[i][0] = if inside { at[0] as f32 } else { f32::NAN };
                out[i][1] = if inside { at[1] as f32 } else { f32::NAN };
                shown += u32::from(inside);
            }
        }
        shown as usize
    }
}

/// Whether all points of a box are farther from `other` than from `own`: the difference of the squared
/// distances is linear, so it is least at a corner.
pub(super) fn farther_everywhere(
    middle: &[f64; 3],
    half: &[f64; 3],
    own: [f64; 3],
    other: [f64; 3],
) -> bool {
    let squared = |c: [f64; 3]| (0..3).map(|k| (c[k] - middle[k]).powi(2)).sum::<f64>();
    let spread: f64 = (0..3).map(|k| 2.0 * (other[k] - own[k]).abs() * half[k]).sum();
    squared(other) - squared(own) > spread
}

/// The polynomial through values at -1, 0 and 1.
fn through(values: [[f64; 3]; 3]) -> Quadratic {
    let line = |[a, b, c]: [f64; 3]| [b, 0.5 * (c - a), 0.5 * (a + c) - b];
    let rows = values.map(line);
    let mut out = [[0.0; 3]; 3];
    for m in 0..3 {
        let column = line([rows[0][m], rows[1][m], rows[2][m]]);
        (0..3).for_each(|n| out[n][m] = column[n]);
    }
    out
}

#[inline(always)]
fn value(c: &Quadratic, s: f64, t: f64) -> f64 {
    let a = c[0][0] + s * (c[0][1] + s * c[0][2]);
    let b = c[1][0] + s * (c[1][1] + s * c[1][2]);
    let d = c[2][0] + s * (c[2][1] + s * c[2][2]);
    a + t * (b + t * d)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        scene::Pose,
    };
    use rowgram_optim::geometry::rotation;
    use rowgram_raster::georeference::Crs;

    /// A strong lens 15 m above relief of a metre.
    fn view(model: Model, values: &[f64], motion: Option<[f64; 6]>) -> View {
        let interior = Interior::new(model, [4000, 3000], values).unwrap();
        // Looking down, tilted by some degrees and turned.
        let turn = rotation::exp([0.06, -0.04, 0.7]);
        View::new("p", interior, Pose::from_centre(turn, [3.0, -2.0, 15.0]), motion)
    }

    fn relief() -> Surface {
        let place = Georeference::north_up([-40.0, 40.0], 0.4, Crs::LOCAL);
        let z = (0..200 * 200).map(|k| {
            let (i, j) = ((k % 200) as f32, (k / 200) as f32);
            if i == 120.0 && j > 90.0 {
                f32::NAN
            } else {
                0.5 * (0.3 * i).sin() + 0.5 * (0.17 * j).cos()
            }
        });
        Surface::new(place, [200, 200], z.collect()).unwrap()
    }

    #[test]
    fn a_block_is_projected_as_each_of_its_cells() {
        let brown = [2500.0, 1.0, 1990.0, 1510.0, -0.28, 0.1, 1e-3, -8e-4, 0.01, 0.0, 0.0, 0.0];
        let straight = [2500.0, 1.0, 1999.5, 1499.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let rolling = Some([0.004, -0.003, 0.002, 0.15, 0.02, -0.01]);
        let surface = relief();
        let whole = Frame { least: [-0.5; 2], most: [1e9; 2], below: [3999.5, 2999.5] };
        for (values, motion) in
            [(brown, None), (brown, rolling), (straight, None), (straight, rolling)]
        {
            let view = view(Model::Brown, &values, motion);
            let mut largest = 0.0f64;
            for gsd in [0.004, 0.02, 0.1] {
                let (mut polynomial, mut blocks) = (0, 0);
                let grid = Georeference::north_up([-12.0, 11.0], gsd, Crs::LOCAL);
                let at = |cell| surface.georeference.pixel(grid.map(cell)).unwrap();
                let (origin, right, below) = (at([0.0, 0.0]), at([1.0, 0.0]), at([0.0, 1.0]));
                let to_surface =
                    [0, 1].map(|k| [origin[k], right[k] - origin[k], below[k] - origin[k]]);
                let mut cells = CellBlock::new();
                let mut found = Box::new([[f32::NAN; 2]; CELLS]);
                let side = (24.0 / gsd) as usize;
                for (u, v) in (0..side)
                    .step_by(side / 7)
                    .flat_map(|v| (0..side).step_by(side / 7).map(move |u| (u, v)))
                {
                    cells.fill([u, v], &grid, &surface, &to_surface);
                    if cells.known == 0 {
                        continue;
                    }
                    blocks += 1;
                    polynomial += usize::from(cells.lens(&view).is_some());
                    let shown = cells.project(&view, &whole, &mut found);
                    let mut exactly = 0;
                    for (k, found) in found.iter().enumerate() {
                        let [x, y, z] = cells.point_m(k % SIDE, k / SIDE);
                        let exact = surface.at([x, y]);
                        assert_eq!(exact.is_some(), z.is_finite(), "{x} {y}");
                        let Some(height) = exact else { continue };
                        assert!((height - z).abs() < 1e-9, "{height} {z}");
                        let Some(exact) = view.pixel([x, y, z]) else {
                            assert!(found[0].is_nan());
                            continue;
                        };
                        exactly += 1;
                        for axis in 0..2 {
                            largest = largest.max((f64::from(found[axis]) - exact[axis]).abs());
                        }
                    }
                    assert_eq!(shown, exactly);
                }
                // Coarse blocks see too much of the lens; as fine as a map's cells are it must be fast.
                assert!(gsd > 0.01 || polynomial == blocks, "{polynomial} of {blocks} at {gsd} m");
            }
            // What the module promises, and single precision at 4000 px.
            assert!(largest < 0.01, "{largest} px");
        }
    }
}
