//! Which photo a cell of the map takes its colour from.
//!
//! ```text
//! k = argmin d_k(P),   P = (X, Y, Z(X, Y)),   d_k = |C_k - P|          over the photos that show P
//! ```
//!
//! is the paper's rule. Where two photos would show it equally well is the seam. Its
//! distance from the cell, in plan, is `(d_j^2 - d_k^2) / 2 |C_j - C_k|_xy`, with `j` the nearest of the others that
//! show the cell: exactly so where cameras fly at one height over level ground.
//!
//! Cells are looked at in blocks: a photo whose distance from the middle of a block exceeds the best one's by
//! more than the block's size cannot win in it. Ties go to the photo that comes first. Nothing depends on
//! how a map is divided into windows.

use super::{
    Surface, View,
    cells::{CELLS, CellBlock, Frame, Pixels, SIDE, farther_everywhere},
};
use rayon::prelude::*;
use rowgram_raster::{georeference::Georeference, window::Window};
use serde::{Deserialize, Serialize};

/// What decides.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct SelectionOptions {
    /// The largest angle between the line of sight and the vertical, radians.
    pub max_angle_rad: Option<f64>,
    /// Photos from which the surface itself hides the cell do not show it; how far, metres, it may stand
    /// above the line of sight.
    pub visibility_m: Option<f64>,
    /// Pixels along the border of a photo that are not used.
    pub border_px: f64,
}

/// The photos of a window's cells, row by row.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CellSources {
    /// The window.
    pub window: Window,
    /// The number of the photo plus 1; 0 where there is none.
    pub source: Vec<u32>,
    /// The pixel in that photo.
    pub pixel: Vec<[f32; 2]>,
    /// Whether a photo that is better by the rule shows the cell's place, but has no data there or is hidden from it by the surface.
    pub passed_over: Vec<bool>,
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
pub struct PhotoSelector<'a> {
    pub(super) views: &'a [View],
    pub(super) reach: Vec<super::view::Bounds>,
    pub(super) surface: &'a Surface,
    pub(super) grid: Georeference,
    pub(super) options: SelectionOptions,
    pub(super) to_surface: [[f64; 3]; 2],
}

impl<'a> PhotoSelector<'a> {
    /// For a map on `grid`.
    pub fn new(
        views: &'a [View],
        surface: &'a Surface,
        grid: Georeference,
        options: SelectionOptions,
    ) -> PhotoSelector<'a> {
        let range_m = surface.range_m();
        let reach = views.par_iter().map(|view| view.footprint_between_m(range_m)).collect();
        // Cells to positions in the surface's own grid, in one step.
        let at =
            |cell: [f64; 2]| surface.georeference.pixel(grid.map(cell)).unwrap_or([f64::NAN; 2]);
        let (origin, right, below) = (at([0.0, 0.0]), at([1e4, 0.0]), at([0.0, 1e4]));
        let to_surface = [0, 1]
            .map(|k| [origin[k], (right[k] - origin[k]) * 1e-4, (below[k] - origin[k]) * 1e-4]);
        PhotoSelector { views, reach, surface, grid, options, to_surface }
    }

    /// The photos.
    pub fn views(&self) -> &[View] {
        self.views
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
        let overlaps = |bounds: &super::view::Bounds| {
            (0..2).all(|k| bounds[k][0] <= range[k][1] && bounds[k][1] >= range[k][0])
        };
        (0..self.views.len() as u32).filter(|&k| overlaps(&self.reach[k as usize])).collect()
    }

    /// What a photo costs as the source of a point; `None` where the angle forbids it.
    #[inline]
    pub(super) fn cost(&self, view: &View, point_m: [f64; 3]) -> Option<f64> {
        let c = view.centre_m();
        let d: [f64; 3] = std::array::from_fn(|k| c[k] - point_m[k]);
        let plan = d[0] * d[0] + d[1] * d[1];
        let squared = plan + d[2] * d[2];
        if let Some(limit) = self.options.max_angle_rad {
            let allowed = d[2] > 0.0 && plan.sqrt() <= d[2] * limit.tan();
            if !allowed {
                return None;
            }
        }
        Some(squared)
    }

    #[inline]
    fn shown(&self, view: &View, point_m: [f64; 3]) -> Option<[f64; 2]> {
        let at = view.pixel(point_m)?;
        if self.options.border_px > 0.0 {
            let size = view.interior.size_px().map(f64::from);
            let border = self.options.border_px - 0.5;
            let inside = (0..2).all(|k| at[k] >= border && at[k] <= size[k] - 1.0 - border);
            if !inside {
                return None;
            }
        }
        match self.options.visibility_m {
            Some(tolerance_m)
                if !self.surface.is_visible(point_m, view.centre_m(), tolerance_m) =>
            {
                None
            }
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
    pub fn sources(&self, window: Window) -> CellSources {
        let mut sources = CellSources { window, ..CellSources::default() };
        self.sources_into(window, &mut sources);
        sources
    }

    /// As [`PhotoSelector::sources`], into memory that is there.
    pub fn sources_into(&self, window: Window, out: &mut CellSources) {
        let among = self.within(window);
        let width = window.width;
        out.window = window;
        out.source.clear();
        out.source.resize(window.pixels(), 0);
        out.pixel.resize(window.pixels(), [f32::NAN; 2]);
        out.passed_over.clear();
        out.passed_over.resize(window.pixels(), false);
        // Blocks lie on a grid of their own, so that nothing depends on the window.
        let head = ((SIDE - window.v % SIDE) % SIDE).min(window.height) * width;
        let (first_source, source) = out.source.split_at_mut(head);
        let (first_pixel, pixel) = out.pixel.split_at_mut(head);
        let (first_passed, passed) = out.passed_over.split_at_mut(head);
        let below = window.v + head / width.max(1);
        let strip = |scratch: &mut Scratch, top: usize, (source, pixel, passed): Rows<'_>| {
            let rows = top % SIDE..top % SIDE + source.len() / width.max(1);
            let mut left = window.u - window.u % SIDE;
            while left < window.u + width {
                let columns = window.u.max(left)..(window.u + width).min(left + SIDE);
                self.block([left, top - top % SIDE], &among, scratch);
                for (j, row) in rows.clone().enumerate() {
                    let from = row * SIDE + columns.start - left;
                    let to = j * width + columns.start - window.u;
                    let n = columns.len();
                    source[to..to + n].copy_from_slice(&scratch.source[from..from + n]);
                    pixel[to..to + n].copy_from_slice(&scratch.pixel[from..from + n]);
                    (0..n).for_each(|k| passed[to + k] = scratch.hidden[from + k].is_finite());
                }
                left += SIDE;
            }
        };
        if head > 0 {
            strip(&mut Scratch::new(), window.v, (first_source, first_pixel, first_passed));
        }
        let rows = (width * SIDE).max(1);
        source
            .par_chunks_mut(rows)
            .zip(pixel.par_chunks_mut(rows))
            .zip(passed.par_chunks_mut(rows))
            .enumerate()
            .for_each_init(Scratch::new, |scratch, (n, ((source, pixel), passed))| {
                strip(scratch, below + n * SIDE, (source, pixel, passed));
            });
    }

    /// Chooses for the cells of one block.
    fn block(&self, first: [usize; 2], among: &[u32], scratch: &mut Scratch) {
        let Scratch { cells, order, source, pixel, shown, best, costs, hidden } = scratch;
        source.fill(0);
        hidden.fill(f64::INFINITY);
        cells.fill(first, &self.grid, self.surface, &self.to_surface);
        if cells.known == 0 {
            pixel.fill([f32::NAN; 2]);
            return;
        }
        let middle = cells.bounds_m.map(|[low, high]| 0.5 * (low + high));
        let half = cells.bounds_m.map(|[low, high]| 0.5 * (high - low));
        let radius = half.iter().map(|h| h * h).sum::<f64>().sqrt();
        order.clear();
        order.extend(among.iter().map(|&k| {
            let c = self.views[k as usize].centre_m();
            let squared: f64 = (0..3).map(|i| (c[i] - middle[i]).powi(2)).sum();
            (squared.sqrt(), k)
        }));
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        // The only photo so far, and whether costs were needed.
        let mut owner: Option<usize> = None;
        let mut compared = false;
        let mut painted = 0;
        // A rule that asks each cell, and whether `pixel` has been written.
        let simple = self.options.max_angle_rad.is_none() && self.options.visibility_m.is_none();
        let mut projected = false;
        for &(distance, k) in order.iter() {
            let view = &self.views[k as usize];
            if painted == cells.known {
                // The largest distance from a cell to its photo, and no less than that.
                let hopeless = match owner {
                    Some(own) => {
                        order.iter().find(|o| o.1 as usize == own).map_or(0.0, |o| o.0) + radius
                    }
                    None => {
                        best.iter().copied().filter(|c| c.is_finite()).fold(0.0, f64::max).sqrt()
                    }
                };
                if distance > hopeless + radius * (1.0 + 1e-9) + 1e-9 {
                    break;
                }
                if let Some(own) = owner
                    && farther_everywhere(
                        &middle,
                        &half,
                        self.views[own].centre_m(),
                        view.centre_m(),
                    )
                {
                    continue;
                }
            }
            if painted == 0 && simple {
                painted = cells.project(view, &self.frame(view), pixel);
                projected = true;
                if painted > 0 {
                    for at in 0..CELLS {
                        source[at] = if pixel[at][0].is_nan() { 0 } else { k + 1 };
                    }
                    owner = Some(k as usize);
                }
                continue;
            }
            if cells.project(view, &self.frame(view), shown) == 0 {
                continue;
            }
            if !projected {
                pixel.fill([f32::NAN; 2]);
                projected = true;
            }
            if !compared {
                best.fill(f64::INFINITY);
                if let Some(own) = owner {
                    self.costs(cells, own, costs);
                    for ((best, cost), source) in
                        best.iter_mut().zip(costs.iter()).zip(source.iter())
                    {
                        *best = if *source > 0 { *cost } else { f64::INFINITY };
                    }
                }
                compared = true;
            }
            self.costs(cells, k as usize, costs);
            for at in 0..CELLS {
                let (cost, least) = (costs[at], best[at]);
                let better =
                    cost < least || (cost == least && cost.is_finite() && k + 1 < source[at]);
                if !better || shown[at][0].is_nan() {
                    continue;
                }
                if let Some(tolerance_m) = self.options.visibility_m {
                    let point = cells.point_m(at % SIDE, at / SIDE);
                    if !self.surface.is_visible(point, view.centre_m(), tolerance_m) {
                        hidden[at] = hidden[at].min(cost);
                        continue;
                    }
                }
                painted += usize::from(source[at] == 0);
                owner = None;
                source[at] = k + 1;
                pixel[at] = shown[at];
                best[at] = cost;
            }
        }
        if !projected {
            pixel.fill([f32::NAN; 2]);
        }
        // What was hidden counts where it would have been better than what was found.
        if compared {
            for (hidden, best) in hidden.iter_mut().zip(best.iter()) {
                if *hidden >= *best {
                    *hidden = f64::INFINITY;
                }
            }
        }
    }

    /// What a photo costs for each cell; infinite where the angle forbids it, or there is no height.
    fn costs(&self, cells: &CellBlock, k: usize, out: &mut [f64; CELLS]) {
        let view = &self.views[k];
        for j in 0..SIDE {
            for i in 0..SIDE {
                let point = cells.point_m(i, j);
                out[j * SIDE + i] =
                    self.cost(view, point).filter(|c| c.is_finite()).unwrap_or(f64::INFINITY);
            }
        }
    }

    /// The part of a photo that is used.
    pub(super) fn frame(&self, view: &View) -> Frame {
        let size = view.interior.size_px().map(f64::from);
        let border = self.options.border_px - 0.5;
        Frame {
            least: [border.max(-0.5); 2],
            most: size.map(|n| if border > -0.5 { n - 1.0 - border } else { n }),
            below: size.map(|n| n - 0.5),
        }
    }
}

/// Rows of a window that are being filled: photos, pixels, whether one was passed over.
type Rows<'a> = (&'a mut [u32], &'a mut [[f32; 2]], &'a mut [bool]);

/// Working memory of a block.
struct Scratch {
    cells: CellBlock,
    order: Vec<(f64, u32)>,
    source: Box<[u32; CELLS]>,
    pixel: Box<Pixels>,
    shown: Box<Pixels>,
    best: Box<[f64; CELLS]>,
    costs: Box<[f64; CELLS]>,
    /// The least cost of a photo from which the surface hides the cell; infinite where that is not better than the photo of the cell.
    hidden: Box<[f64; CELLS]>,
}

impl Scratch {
    fn new() -> Scratch {
        Scratch {
            cells: CellBlock::new(),
            order: Vec::new(),
            source: Box::new([0; CELLS]),
            pixel: Box::new([[f32::NAN; 2]; CELLS]),
            shown: Box::new([[f32::NAN; 2]; CELLS]),
            best: Box::new([f64::INFINITY; CELLS]),
            costs: Box::new([f64::INFINITY; CELLS]),
            hidden: Box::new([f64::INFINITY; CELLS]),
        }
    }
}
