//! Heights on a grid, and straight lines through them.
//!
//! Between the centres of its cells the surface is bilinear; where a height that is needed is not known there is no surface.

use super::MapError;
use rowgram_raster::georeference::{CrsKind, Georeference};

/// Rounding may put a position on the border a hair outside, in cells.
const ROUNDING_CELLS: f64 = 1e-6;

/// A height for each cell of a grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Where the grid lies.
    pub georeference: Georeference,
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Metres, row by row; NaN where not known.
    pub heights_m: Vec<f32>,
    range_m: [f64; 2],
}

impl Surface {
    /// A surface of `width * height` heights, row by row.
    ///
    /// # Errors
    /// Where the numbers do not fit, no height is known, the map is in degrees or the grid has no area.
    pub fn new(
        georeference: Georeference,
        [width, height]: [usize; 2],
        heights_m: Vec<f32>,
    ) -> Result<Surface, MapError> {
        if heights_m.len() != width * height {
            return Err(MapError(format!(
                "{} heights for {width} x {height} cells",
                heights_m.len()
            )));
        }
        if matches!(
            georeference.crs.kind,
            CrsKind::Geographic | CrsKind::Feet | CrsKind::SurveyFeet
        ) {
            return Err(MapError(
                "its coordinates are degrees, expected metres: reproject it to a projected coordinate \
                 reference system (for example with gdalwarp -t_srs EPSG:<UTM zone>)"
                    .into(),
            ));
        }
        if georeference.pixel([0.0, 0.0]).is_none() {
            return Err(MapError("its cells have no area on the map".into()));
        }
        let known = heights_m.iter().filter(|z| z.is_finite()).map(|&z| f64::from(z));
        let range_m = known
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], z| [low.min(z), high.max(z)]);
        if range_m[0] > range_m[1] {
            return Err(MapError("none of its cells has a height".into()));
        }
        Ok(Surface { georeference, width, height, heights_m, range_m })
    }

    /// The least and the greatest height, metres.
    pub fn range_m(&self) -> [f64; 2] {
        self.range_m
    }

    /// The surface so many metres higher.
    pub fn raised(mut self, by_m: f64) -> Surface {
        self.heights_m.iter_mut().for_each(|z| *z += by_m as f32);
        self.range_m = self.range_m.map(|z| z + by_m);
        self
    }

    /// Side of a cell, metres.
    pub fn cell_m(&self) -> f64 {
        let g = &self.georeference;
        let side = |v: [f64; 2]| v[0].hypot(v[1]);
        side(g.per_column).min(side(g.per_row))
    }

    /// Least and greatest x and y over the outermost cells' centres, metres.
    pub fn bounds_m(&self) -> [[f64; 2]; 2] {
        let (right, below) = ((self.width - 1) as f64, (self.height - 1) as f64);
        let corners = [[0.0, 0.0], [right, 0.0], [0.0, below], [right, below]]
            .map(|corner| self.georeference.map(corner));
        let over = |axis: usize, pick: fn(f64, f64) -> f64, start: f64| {
            corners.iter().map(|c| c[axis]).fold(start, pick)
        };
        [0, 1].map(|k| [over(k, f64::min, f64::INFINITY), over(k, f64::max, f64::NEG_INFINITY)])
    }

    /// The height at a position of the map.
    pub fn at(&self, position_m: [f64; 2]) -> Option<f64> {
        self.at_pixel(self.georeference.pixel(position_m)?)
    }

    /// Bilinear heights along a row of its own grid, at the columns `first + step k`, NaN where there is none;
    /// `line` is working memory.
    pub(super) fn row(&self, v: f64, first: f64, step: f64, line: &mut Vec<f64>, out: &mut [f64]) {
        let (right, below) = ((self.width - 1) as f64, (self.height - 1) as f64);
        let last = first + step * (out.len() as f64 - 1.0);
        let (least, most) = (first.min(last), first.max(last));
        if !(v >= -ROUNDING_CELLS
            && v <= below + ROUNDING_CELLS
            && most >= -ROUNDING_CELLS
            && least <= right + ROUNDING_CELLS)
        {
            out.fill(f64::NAN);
            return;
        }
        let v = v.clamp(0.0, below);
        let j = v as usize;
        let t = v - j as f64;
        // The columns that are needed, between the two rows.
        let from = least.clamp(0.0, right) as usize;
        let to = (most.clamp(0.0, right) as usize + 2).min(self.width);
        let of = |j: usize| &self.heights_m[j * self.width + from..j * self.width + to];
        line.clear();
        if t > 0.0 {
            line.extend(of(j).iter().zip(of((j + 1).min(self.height - 1))).map(|(&a, &b)| {
                let (a, b) = (f64::from(a), f64::from(b));
                a + t * (b - a)
            }));
        } else {
            line.extend(of(j).iter().map(|&z| f64::from(z)));
        }
        // Beside the last column, where its weight is 0.
        line.push(f64::NAN);
        let between = Between {
            line,
            first: first - from as f64,
            step,
            right: [-(from as f64), right - from as f64],
        };
        for (n, out) in out.chunks_mut(LANES).enumerate() {
            pulp::Arch::new().dispatch(InChunk { between: &between, start: n * LANES, out });
        }
    }

    /// The height at a position of its own grid, the centre of the first cell being (0, 0).
    #[inline]
    pub fn at_pixel(&self, [u, v]: [f64; 2]) -> Option<f64> {
        let (right, below) = ((self.width - 1) as f64, (self.height - 1) as f64);
        if !(u >= -ROUNDING_CELLS
            && v >= -ROUNDING_CELLS
            && u <= right + ROUNDING_CELLS
            && v <= below + ROUNDING_CELLS)
        {
            return None;
        }
        let (u, v) = (u.clamp(0.0, right), v.clamp(0.0, below));
        let (i, j) = (u as usize, v as usize);
        let (s, t) = (u - i as f64, v - j as f64);
        let (i1, j1) = ((i + 1).min(self.width - 1), (j + 1).min(self.height - 1));
        let z = |i: usize, j: usize| f64::from(self.heights_m[j * self.width + i]);
        let mut top = z(i, j);
        let mut bottom = top;
        // A neighbour whose weight is 0 need not be known.
        if t > 0.0 {
            bottom = z(i, j1);
        }
        if s > 0.0 {
            top += s * (z(i1, j) - top);
            if t > 0.0 {
                bottom += s * (z(i1, j1) - bottom);
            }
        }
        let value = if t > 0.0 { top + t * (bottom - top) } else { top };
        value.is_finite().then_some(value)
    }

    /// Where a ray from above first meets the surface. `direction` need not be of length 1.
    pub fn intersect_ray(&self, from_m: [f64; 3], direction: [f64; 3]) -> Option<[f64; 3]> {
        let [dx, dy, dz] = direction;
        if dz >= 0.0 {
            return None;
        }
        let along = |s: f64| [from_m[0] + s * dx, from_m[1] + s * dy, from_m[2] + s * dz];
        let above = |s: f64| {
            let p = along(s);
            self.at([p[0], p[1]]).map(|z| p[2] - z)
        };
        let margin = 1e-6 * (1.0 + self.range_m[1].abs());
        let start = ((self.range_m[1] + margin - from_m[2]) / dz).max(0.0);
        let end = (self.range_m[0] - margin - from_m[2]) / dz;
        if end <= start {
            return None;
        }
        let plan = dx.hypot(dy) * (end - start);
        let steps = (2.0 * plan / self.cell_m()).ceil().clamp(1.0, 1e6) as usize;
        let mut last: Option<f64> = None;
        for k in 0..=steps {
            let s = start + (end - start) * k as f64 / steps as f64;
            match above(s) {
                Some(gap) if gap <= 0.0 => {
                    // From outside, or from a hole, below the surface: it was not met from above.
                    let (mut high, mut low) = (last?, s);
                    for _ in 0..60 {
                        let middle = 0.5 * (high + low);
                        match above(middle) {
                            Some(gap) if gap <= 0.0 => low = middle,
                            _ => high = middle,
                        }
                    }
                    return Some(along(low));
                }
                gap => last = gap.map(|_| s),
            }
        }
        None
    }

    /// Whether nothing of the surface stands between a point of it and a camera, by steps of a cell.
    /// What stands less than `tolerance_m` above the line of sight hides nothing.
    pub fn is_visible(&self, point_m: [f64; 3], camera_m: [f64; 3], tolerance_m: f64) -> bool {
        let way: [f64; 3] = std::array::from_fn(|k| camera_m[k] - point_m[k]);
        let plan = way[0].hypot(way[1]);
        let cell = self.cell_m();
        if way[2] <= 0.0 || plan < cell {
            return way[2] > 0.0;
        }
        let clear = ((self.range_m[1] - point_m[2]) / way[2]).min(1.0);
        let steps = (clear * plan / cell).floor() as usize;
        (1..=steps).all(|k| {
            let s = k as f64 * cell / plan;
            let at = [point_m[0] + s * way[0], point_m[1] + s * way[1]];
            self.at(at).is_none_or(|z| z <= point_m[2] + s * way[2] + tolerance_m)
        })
    }
}

/// Positions that are computed together.
const LANES: usize = 32;

/// What heights along a row are read from.
struct Between<'a> {
    line: &'a [f64],
    first: f64,
    step: f64,
    /// Positions of the surface's first and last column.
    right: [f64; 2],
}

struct InChunk<'a> {
    between: &'a Between<'a>,
    start: usize,
    out: &'a mut [f64],
}

impl pulp::WithSimd for InChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Between { line, first, step, right: [left, right] } = *self.between;
        let (mut share, mut outside) = ([0.0f64; LANES], [0.0f64; LANES]);
        let mut column = [0i32; LANES];
        for k in 0..LANES {
            let at = first + step * (self.start + k) as f64;
            let inside = (at >= left - ROUNDING_CELLS) & (at <= right + ROUNDING_CELLS);
            outside[k] = if inside { 0.0 } else { f64::NAN };
            let at = at.max(left).min(right).max(0.0);
            column[k] = at as i32;
            share[k] = at - f64::from(column[k]);
        }
        let (mut here, mut next) = ([0.0f64; LANES], [0.0f64; LANES]);
        let last = line.len() - 2;
        for k in 0..LANES {
            let at = (column[k] as usize).min(last);
            (here[k], next[k]) = (line[at], line[at + 1]);
        }
        for k in 0..LANES {
            // A neighbour whose weight is 0 need not be known.
            let between = here[k] + share[k] * (next[k] - here[k]);
            here[k] = outside[k] + if share[k] == 0.0 { here[k] } else { between };
        }
        let n = self.out.len();
        self.out.copy_from_slice(&here[..n]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;

    fn slope() -> Surface {
        let place = Georeference::north_up([100.0, 200.0], 2.0, Crs::LOCAL);
        let heights = (0..20 * 30).map(|k| (k % 20) as f32 * 0.5 - (k / 20) as f32 * 0.25);
        Surface::new(place, [20, 30], heights.collect()).unwrap()
    }

    #[test]
    fn a_plane_is_a_plane_between_its_cells() {
        let surface = slope();
        let [x, y] = [107.3, 171.1];
        let expected = (x - 100.0) / 2.0 * 0.5 - (200.0 - y) / 2.0 * 0.25;
        approx::assert_abs_diff_eq!(surface.at([x, y]).unwrap(), expected, epsilon = 1e-9);
        assert_eq!(surface.at([99.0, 180.0]), None, "outside");
    }

    #[test]
    fn what_is_not_known_is_no_surface() {
        let mut surface = slope();
        surface.heights_m[5 * 20 + 5] = f32::NAN;
        let at = |u, v| surface.at_pixel([u, v]);
        assert_eq!((at(4.5, 5.0), at(5.0, 5.0), at(5.5, 4.5)), (None, None, None));
        // Beside it 2 x 2 heights are known.
        approx::assert_abs_diff_eq!(at(3.5, 5.0).unwrap(), 1.75 - 1.25, epsilon = 1e-9);
        approx::assert_abs_diff_eq!(at(4.0, 5.0).unwrap(), 2.0 - 1.25, epsilon = 1e-9);
    }

    #[test]
    fn rays_meet_the_plane_and_walls_hide() {
        let surface = slope();
        let met = surface.intersect_ray([110.0, 180.0, 50.0], [0.1, -0.05, -1.0]).unwrap();
        approx::assert_abs_diff_eq!(surface.at([met[0], met[1]]).unwrap(), met[2], epsilon = 1e-6);
        assert_eq!(surface.intersect_ray([110.0, 180.0, 50.0], [0.0, 0.1, 1.0]), None);
        let mut wall = slope();
        for row in 0..30 {
            wall.heights_m[row * 20 + 10] = 30.0;
        }
        let wall = Surface::new(wall.georeference, [20, 30], wall.heights_m).unwrap();
        let point = [110.0, 180.0, wall.at([110.0, 180.0]).unwrap()];
        assert!(!wall.is_visible(point, [140.0, 180.0, 40.0], 0.1));
        assert!(wall.is_visible(point, [90.0, 180.0, 40.0], 0.1));
        assert!(wall.is_visible(point, [112.0, 180.0, 400.0], 0.1));
    }

    #[test]
    fn degrees_and_emptiness_are_refused() {
        let crs = Crs::geographic(4326);
        let place = Georeference::north_up([9.0, 48.0], 1e-5, crs);
        let error = Surface::new(place, [1, 1], vec![1.0]).unwrap_err();
        assert!(error.to_string().contains("degrees"), "{error}");
        let place = Georeference::north_up([0.0; 2], 1.0, Crs::LOCAL);
        let error = Surface::new(place, [1, 1], vec![f32::NAN]).unwrap_err();
        assert!(error.to_string().contains("none of its cells"), "{error}");
    }
}
