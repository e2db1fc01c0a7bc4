//! A plot cut out of a photo along its own sides.
//!
//! The frame of a plot is the smallest rectangle around it (one of its sides lies on a side of the convex hull; G. Toussaint,
//! *Solving geometric problems with the rotating calipers*, 1983), with the long side along the columns and the columns running
//! east. Its cells are squares on the map. Each is taken from the photo by the collinearity equations at the height of the
//! surface, so the picture is an orthophoto of the plot from this photo alone.

use super::{Surface, View, photo::DecodedPhoto};
use crate::mapping::undistort::Interpolation;
use image::{Rgb, RgbImage};
use rowgram_raster::{
    Mask,
    georeference::{Crs, Georeference},
};

/// The grid of cells along a plot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlotFrame {
    /// Where the cells are.
    pub georeference: Georeference,
    /// Cells along the long side.
    pub width: usize,
    /// Cells along the short side.
    pub height: usize,
}

impl PlotFrame {
    /// The frame around positions on the map, with a margin on all sides; `None` where they enclose no area.
    ///
    /// `cell` and `margin` are in the units of the map.
    pub fn around(points: &[[f64; 2]], margin: f64, cell: f64, crs: Crs) -> Option<PlotFrame> {
        let hull = convex_hull(points);
        let sides = (0..hull.len()).map(|k| {
            let (a, b) = (hull[k], hull[(k + 1) % hull.len()]);
            let length = (b[0] - a[0]).hypot(b[1] - a[1]);
            [(b[0] - a[0]) / length, (b[1] - a[1]) / length]
        });
        let bounds = |[x, y]: [f64; 2]| {
            let along = |p: &[f64; 2]| p[0] * x + p[1] * y;
            let across = |p: &[f64; 2]| p[1] * x - p[0] * y;
            [range(hull.iter().map(along)), range(hull.iter().map(across))]
        };
        let area = |[a, b]: [[f64; 2]; 2]| (a[1] - a[0]) * (b[1] - b[0]);
        let mut direction = sides.min_by(|a, b| area(bounds(*a)).total_cmp(&area(bounds(*b))))?;
        let [along, across] = bounds(direction);
        if along[1] - along[0] < across[1] - across[0] {
            direction = [-direction[1], direction[0]];
        }
        if direction[0] < 0.0 || (direction[0] == 0.0 && direction[1] < 0.0) {
            direction = direction.map(|x| -x);
        }
        let [along, across] = bounds(direction).map(|[low, high]| [low - margin, high + margin]);
        if area([along, across]).partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
            return None;
        }
        // A side of a whole number of cells has that many, whatever rounding does.
        let cells = |[low, high]: [f64; 2]| ((high - low) / cell - 1e-6).ceil().max(1.0);
        let [columns, rows] = [along, across].map(cells);
        // Cells that stick out do so on both sides alike; rows run from the high end of the short side.
        let first = [
            0.5 * (along[0] + along[1] - (columns - 1.0) * cell),
            0.5 * (across[0] + across[1] + (rows - 1.0) * cell),
        ];
        let [x, y] = direction;
        let georeference = Georeference {
            origin: [first[0] * x - first[1] * y, first[0] * y + first[1] * x],
            per_column: [cell * x, cell * y],
            per_row: [cell * y, -cell * x],
            crs,
        };
        Some(PlotFrame { georeference, width: columns as usize, height: rows as usize })
    }

    /// Map positions of the outer corners of the corner cells.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let (u, v) = (self.width as f64 - 0.5, self.height as f64 - 0.5);
        [[-0.5, -0.5], [u, -0.5], [u, v], [-0.5, v]].map(|at| self.georeference.map(at))
    }

    /// Whether a photo shows all of it: its corners at the height of the surface. The map is in metres.
    pub fn is_inside(&self, view: &View, surface: &Surface) -> bool {
        let shown = |[x, y]: [f64; 2]| surface.at([x, y]).and_then(|z| view.pixel([x, y, z]));
        self.corners().into_iter().all(|corner| shown(corner).is_some())
    }

    /// The picture from a photo, and which cells have a colour. The map is in metres.
    pub fn draw(
        &self,
        photo: &DecodedPhoto,
        view: &View,
        surface: &Surface,
        interpolation: Interpolation,
    ) -> (RgbImage, Mask) {
        let mut picture = RgbImage::new(self.width as u32, self.height as u32);
        let mut shown = Mask::from_fn(self.width, self.height, |_, _| false);
        for v in 0..self.height {
            for u in 0..self.width {
                let [x, y] = self.georeference.map([u as f64, v as f64]);
                let Some(at) = surface.at([x, y]).and_then(|z| view.pixel([x, y, z])) else {
                    continue;
                };
                let colour = photo.at(at.map(|x| x as f32), interpolation);
                if DecodedPhoto::has_data(colour) {
                    let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
                    let rgb = [byte(colour[0]), byte(colour[1]), byte(colour[2])];
                    picture.put_pixel(u as u32, v as u32, Rgb(rgb));
                    shown.data[v * self.width + u] = 1;
                }
            }
        }
        (picture, shown)
    }
}

fn range(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| [low.min(x), high.max(x)])
}

/// Corners of the convex hull, counter-clockwise; fewer than three where there is no area (A. M. Andrew's monotone chain).
fn convex_hull(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut sorted: Vec<[f64; 2]> =
        points.iter().copied().filter(|p| p.iter().all(|x| x.is_finite())).collect();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    sorted.dedup();
    let turn = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    };
    let mut hull: Vec<[f64; 2]> = Vec::new();
    let mut chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let base = hull.len();
        for point in points {
            while hull.len() >= base + 2
                && turn(hull[hull.len() - 2], hull[hull.len() - 1], point) <= 0.0
            {
                hull.pop();
            }
            hull.push(point);
        }
        // The last point begins the other chain.
        hull.pop();
    };
    chain(&mut sorted.iter().copied());
    chain(&mut sorted.iter().rev().copied());
    hull
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    /// A rectangle of 6 m by 2 m that is turned by 30 degrees.
    fn turned() -> (Vec<[f64; 2]>, [f64; 2]) {
        let (sin, cos) = 30_f64.to_radians().sin_cos();
        let corners = [[0.0, 0.0], [6.0, 0.0], [6.0, 2.0], [0.0, 2.0], [3.0, 1.0], [3.0, 0.0]];
        let at = |[a, b]: [f64; 2]| [100.0 + a * cos - b * sin, 50.0 + a * sin + b * cos];
        (corners.map(at).to_vec(), [cos, sin])
    }

    #[test]
    fn a_frame_lies_along_its_plot() {
        let (points, direction) = turned();
        let frame = PlotFrame::around(&points, 0.0, 0.1, Crs::LOCAL).unwrap();
        assert_eq!((frame.width, frame.height), (60, 20));
        let [x, y] = frame.georeference.per_column;
        assert_abs_diff_eq!(x, 0.1 * direction[0], epsilon = 1e-12);
        assert_abs_diff_eq!(y, 0.1 * direction[1], epsilon = 1e-12);
        // The top-left corner is the one on the left of the walk along the columns.
        let corners = frame.corners();
        for (corner, expected) in corners.iter().zip([points[3], points[2], points[1], points[0]]) {
            assert_abs_diff_eq!(corner[0], expected[0], epsilon = 1e-9);
            assert_abs_diff_eq!(corner[1], expected[1], epsilon = 1e-9);
        }
        let wide = PlotFrame::around(&points, 0.55, 0.1, Crs::LOCAL).unwrap();
        assert_eq!((wide.width, wide.height), (71, 31));
    }

    #[test]
    fn what_has_no_area_has_no_frame() {
        for points in [
            vec![],
            vec![[0.0, 0.0]],
            vec![[0.0, 0.0], [1.0, 1.0]],
            vec![[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]],
            vec![[f64::NAN, 0.0], [1.0, f64::INFINITY], [0.0, 1.0]],
        ] {
            assert_eq!(PlotFrame::around(&points, 0.0, 0.1, Crs::LOCAL), None, "{points:?}");
        }
    }
}
