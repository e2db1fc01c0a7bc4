//! Which photo a cell of the map takes its colour from.
//!
//! ```text
//! k = argmin d_k(P),   P = (X, Y, Z(X, Y)),   d_k = |C_k - P|          over the photos that show P
//! ```
//!
//! is the paper's rule; instead of the distance the view angle from the vertical or the ground sampling
//! distance may decide. Where two photos would show it equally well is the seam. Under the paper's rule its
//! distance from the cell, in plan, is `(d_j^2 - d_k^2) / 2 |C_j - C_k|_xy`, with `j` the nearest of the others that
//! show the cell: exactly so where cameras fly at one height over level ground.
//!
//! Cells are looked at in blocks: a photo whose distance from the middle of a block exceeds the best one's by
//! more than the block's size cannot win in it. Ties go to the photo that comes first. Nothing depends on
//! how a map is divided into windows.

use super::{Surface, View};
use crate::raster::{georeference::Georeference, window::Window};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Side of the blocks, cells.
const BLOCK: usize = 16;

/// Which of the photos that show a cell is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Choice {
    /// The one whose camera is closest.
    #[default]
    Closest,
    /// The one that looks most straight down.
    Nadir,
    /// The one with the smallest ground sampling distance.
    Gsd,
}

/// What decides.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Rules {
    /// Which of several.
    pub choice: Choice,
    /// The largest angle between the line of sight and the vertical, radians.
    pub max_angle_rad: Option<f64>,
    /// Photos from which the surface itself hides the cell do not show it; how far, metres, it may stand
    /// above the line of sight.
    pub visibility_m: Option<f64>,
    /// Pixels along the border of a photo that are not used.
    pub border_px: f64,
}

/// The photos of a window's cells, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Sources {
    /// The window.
    pub window: Window,
    /// The number of the photo plus 1; 0 where there is none.
    pub source: Vec<u32>,
    /// The pixel in that photo.
    pub pixel: Vec<[f32; 2]>,
}

/// A photo as a source for a cell.
#[derive(Debug, Clone, Copy)]
pub struct Candidate {
    /// Index of the photo.
    pub view: usize,
    /// The smaller, the better.
    pub cost: f64,
    /// The pixel.
    pub image_px: [f64; 2],
}

/// What is needed to choose photos for the cells of a map.
pub struct Selector<'a> {
    views: &'a [View],
    reach: Vec<super::view::Bounds>,
    surface: &'a Surface,
    grid: Georeference,
    rules: Rules,
    to_surface: [[f64; 3]; 2],
}

impl<'a> Selector<'a> {
    /// For a map on `grid`.
    pub fn new(
        views: &'a [View],
        surface: &'a Surface,
        grid: Georeference,
        rules: Rules,
    ) -> Selector<'a> {
        let range_m = surface.range_m();
        let reach = views.par_iter().map(|view| view.reach_m(range_m)).collect();
        // Cells to positions in the surface's own grid, in one step.
        let at =
            |cell: [f64; 2]| surface.georeference.pixel(grid.map(cell)).unwrap_or([f64::NAN; 2]);
        let (origin, right, below) = (at([0.0, 0.0]), at([1e4, 0.0]), at([0.0, 1e4]));
        let to_surface = [0, 1]
            .map(|k| [origin[k], (right[k] - origin[k]) * 1e-4, (below[k] - origin[k]) * 1e-4]);
        Selector { views, reach, surface, grid, rules, to_surface }
    }

    /// The photos.
    pub fn views(&self) -> &[View] {
        self.views
    }

    /// What decides.
    pub fn rules(&self) -> &Rules {
        &self.rules
    }

    /// The point on the ground of a cell.
    #[inline]
    pub fn point_m(&self, u: usize, v: usize) -> Option<[f64; 3]> {
        let (u, v) = (u as f64, v as f64);
        let at = self.to_surface.map(|[o, a, b]| o + a * u + b * v);
        let z = self.surface.at_pixel(at)?;
        let [x, y] = self.grid.map([u, v]);
        Some([x, y, z])
    }

    /// The photos that may reach some cells, by their reach on the map.
    pub fn within(&self, window: Window) -> Vec<u32> {
        let (u, v) = (window.u as f64, window.v as f64);
        let (right, below) = (u + window.width as f64 - 1.0, v + window.height as f64 - 1.0);
        let corners =
            [[u, v], [right, v], [u, below], [right, below]].map(|corner| self.grid.map(corner));
        let range = [0, 1].map(|k| {
            let of = corners.map(|c| c[k]);
            [
                of.iter().copied().fold(f64::INFINITY, f64::min),
                of.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            ]
        });
        let meets = |bounds: &super::view::Bounds| {
            (0..2).all(|k| bounds[k][0] <= range[k][1] && bounds[k][1] >= range[k][0])
        };
        (0..self.views.len() as u32).filter(|&k| meets(&self.reach[k as usize])).collect()
    }

    /// What a photo costs as the source of a point; `None` where the angle forbids it.
    #[inline]
    fn cost(&self, view: &View, point_m: [f64; 3]) -> Option<f64> {
        let c = view.centre_m();
        let d: [f64; 3] = std::array::from_fn(|k| c[k] - point_m[k]);
        let plan = d[0] * d[0] + d[1] * d[1];
        let squared = plan + d[2] * d[2];
        if let Some(limit) = self.rules.max_angle_rad {
            let allowed = d[2] > 0.0 && plan.sqrt() <= d[2] * limit.tan();
            if !allowed {
                return None;
            }
        }
        Some(match self.rules.choice {
            Choice::Closest => squared,
            Choice::Nadir => {
                if d[2] <= 0.0 {
                    return None;
                }
                plan / (d[2] * d[2])
            }
            Choice::Gsd => {
                // The area of ground in a pixel grows with the obliqueness.
                let cosine = (d[2] / squared.sqrt()).max(1e-3);
                let f = view.interior.principal_distance_px();
                squared / (f * f * cosine)
            }
        })
    }

    #[inline]
    fn shown(&self, view: &View, point_m: [f64; 3]) -> Option<[f64; 2]> {
        let at = view.pixel(point_m)?;
        if self.rules.border_px > 0.0 {
            let size = view.interior.size_px().map(f64::from);
            let border = self.rules.border_px - 0.5;
            let inside = (0..2).all(|k| at[k] >= border && at[k] <= size[k] - 1.0 - border);
            if !inside {
                return None;
            }
        }
        match self.rules.visibility_m {
            Some(tolerance_m) if !self.surface.sees(point_m, view.centre_m(), tolerance_m) => None,
            _ => Some(at),
        }
    }

    /// All photos that show a point, the best first.
    pub fn candidates(&self, point_m: [f64; 3], among: &[u32], out: &mut Vec<Candidate>) {
        out.clear();
        for &k in among {
            let view = &self.views[k as usize];
            let Some(cost) = self.cost(view, point_m) else { continue };
            if let Some(image_px) = self.shown(view, point_m) {
                out.push(Candidate { view: k as usize, cost, image_px });
            }
        }
        out.sort_by(|a, b| a.cost.total_cmp(&b.cost).then(a.view.cmp(&b.view)));
    }

    /// Distance in plan from a cell to the seam between its photo and another, metres; at least 0.
    pub fn to_seam_m(&self, point_m: [f64; 3], own: usize, other: usize) -> f64 {
        let (a, b) = (self.views[own].centre_m(), self.views[other].centre_m());
        let squared = |c: [f64; 3]| (0..3).map(|k| (c[k] - point_m[k]).powi(2)).sum::<f64>();
        let apart = (a[0] - b[0]).hypot(a[1] - b[1]).max(1e-9);
        ((squared(b) - squared(a)) / (2.0 * apart)).abs()
    }

    /// The photo of each cell of a window.
    pub fn sources(&self, window: Window) -> Sources {
        let among = self.within(window);
        let width = window.width;
        let mut source = vec![0; window.pixels()];
        let mut pixel = vec![[f32::NAN; 2]; window.pixels()];
        source
            .par_chunks_mut(width * BLOCK)
            .zip(pixel.par_chunks_mut(width * BLOCK))
            .enumerate()
            .for_each_init(Vec::new, |order, (strip, (source, pixel))| {
                let rows = source.len() / width.max(1);
                for left in (0..width).step_by(BLOCK) {
                    let block = Window {
                        u: window.u + left,
                        v: window.v + strip * BLOCK,
                        width: BLOCK.min(width - left),
                        height: rows,
                    };
                    self.block(block, &among, order, |i, j, k, at| {
                        source[j * width + left + i] = k + 1;
                        pixel[j * width + left + i] = at.map(|value| value as f32);
                    });
                }
            });
        Sources { window, source, pixel }
    }

    /// Chooses for the cells of one block; `found(column, row, photo, pixel)`.
    fn block(
        &self,
        block: Window,
        among: &[u32],
        order: &mut Vec<(f64, u32)>,
        mut found: impl FnMut(usize, usize, u32, [f64; 2]),
    ) {
        let mut points = [[f64::NAN; 3]; BLOCK * BLOCK];
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
        for j in 0..block.height {
            for i in 0..block.width {
                if let Some(point) = self.point_m(block.u + i, block.v + j) {
                    points[j * BLOCK + i] = point;
                    for (k, [low, high]) in bounds.iter_mut().enumerate() {
                        (*low, *high) = (low.min(point[k]), high.max(point[k]));
                    }
                }
            }
        }
        if bounds[0][0] > bounds[0][1] {
            return;
        }
        let middle = bounds.map(|[low, high]| 0.5 * (low + high));
        let radius: f64 =
            bounds.iter().map(|[low, high]| (0.5 * (high - low)).powi(2)).sum::<f64>().sqrt();
        let by_distance = self.rules.choice == Choice::Closest;
        order.clear();
        order.extend(among.iter().map(|&k| {
            let c = self.views[k as usize].centre_m();
            let squared: f64 = (0..3).map(|i| (c[i] - middle[i]).powi(2)).sum();
            (squared.sqrt(), k)
        }));
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for j in 0..block.height {
            for i in 0..block.width {
                let point = points[j * BLOCK + i];
                if point[2].is_nan() {
                    continue;
                }
                let mut best: Option<(f64, u32, [f64; 2])> = None;
                // The least distance from the block's middle of a photo that can no longer win.
                let mut hopeless = f64::INFINITY;
                for &(distance, k) in order.iter() {
                    if distance > hopeless {
                        break;
                    }
                    let view = &self.views[k as usize];
                    let Some(cost) = self.cost(view, point) else { continue };
                    let better = best.is_none_or(|(least, first, _)| {
                        cost < least || (cost == least && k < first)
                    });
                    if better && let Some(at) = self.shown(view, point) {
                        best = Some((cost, k, at));
                        if by_distance {
                            hopeless = cost.sqrt() + radius * (1.0 + 1e-9) + 1e-9;
                        }
                    }
                }
                if let Some((_, k, at)) = best {
                    found(i, j, k, at);
                }
            }
        }
    }
}
