//! Photos that are assigned to cells of a map before the selection of photos is asked: whole plots from one photo.
//!
//! An assigned photo is taken where it shows the cell as the options of the selector ask; elsewhere the selector chooses.

use super::{
    cells::{CELLS, CellBlock, Pixels, SIDE},
    select::{CellSources, PhotoSelector},
};
use rayon::prelude::*;
use rowgram_raster::{polygon::Polygon, window::Window};
use std::ops::Range;

/// Cells between the points of an outline at which it is asked whether a photo shows them; as a block of cells, within which positions in photos
/// are interpolated.
const OUTLINE_STEP: f64 = 32.0;

/// The photos that are assigned to cells, by the number of the photo plus 1; 0 where none is.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Assignment {
    /// Of each row of the map the columns of plots, ascending and disjoint.
    plots: Vec<Vec<(Range<usize>, u32)>>,
}

/// The photo that shows a plot as a whole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlotPhoto {
    /// Its index.
    pub view: usize,
    /// Angle between the line of sight to the middle of the plot and the vertical, radians.
    pub angle_rad: f64,
}

impl Assignment {
    /// Whether no cell has an assigned photo.
    pub fn is_empty(&self) -> bool {
        self.plots.iter().all(Vec::is_empty)
    }

    /// The photos of the block of cells that begins at `first`; whether there is any.
    fn block(&self, first: [usize; 2], out: &mut [u32; CELLS]) -> bool {
        out.fill(0);
        for (j, row) in out.chunks_exact_mut(SIDE).enumerate() {
            let Some(runs) = self.plots.get(first[1] + j) else { break };
            let begin = runs.partition_point(|(run, _)| run.end <= first[0]);
            let end = first[0] + SIDE;
            for (run, photo) in runs[begin..].iter().take_while(|(run, _)| run.start < end) {
                row[run.start.max(first[0]) - first[0]..run.end.min(end) - first[0]].fill(*photo);
            }
        }
        out.iter().any(|&photo| photo > 0)
    }
}

impl PhotoSelector<'_> {
    /// For plots, polygons in cells of a map of `[width, height]` cells: each is assigned the photo that shows its whole outline and
    /// has the least cost of selection, averaged over the outline; where other things hide the plot is not asked. A cell of two plots goes with the one that begins farther left.
    pub fn whole_plots(
        &self,
        [width, height]: [usize; 2],
        plots: &[&Polygon],
    ) -> (Assignment, Vec<Option<PlotPhoto>>) {
        let photos: Vec<Option<PlotPhoto>> =
            plots.par_iter().map(|plot| self.photo_of_plot(plot)).collect();
        let mut rows: Vec<Vec<(Range<usize>, u32)>> = vec![Vec::new(); height];
        for (plot, photo) in plots.iter().zip(&photos) {
            let Some(photo) = photo else { continue };
            for (row, run) in plot.runs(width, height) {
                rows[row].push((run, photo.view as u32 + 1));
            }
        }
        for runs in &mut rows {
            runs.sort_by_key(|(run, photo)| (run.start, run.end, *photo));
            let mut end = 0;
            for (run, _) in runs.iter_mut() {
                run.start = run.start.max(end).min(run.end);
                end = end.max(run.end);
            }
            runs.retain(|(run, _)| !run.is_empty());
        }
        (Assignment { plots: rows }, photos)
    }

    fn photo_of_plot(&self, plot: &Polygon) -> Option<PlotPhoto> {
        let outline = outline(plot);
        let bound = |axis: usize| {
            let low = outline.iter().map(|at| at[axis]).fold(f64::INFINITY, f64::min);
            let high = outline.iter().map(|at| at[axis]).fold(f64::NEG_INFINITY, f64::max);
            (low.max(0.0) as usize, (high.max(0.0) as usize).saturating_add(1))
        };
        let ((left, right), (top, bottom)) = (bound(0), bound(1));
        let window = Window { u: left, v: top, width: right - left, height: bottom - top };
        // Where the surface ends there is nothing to show.
        let at = |[u, v]: [f64; 2]| {
            self.point_m(u.max(0.0).round() as usize, v.max(0.0).round() as usize)
        };
        let points: Vec<[f64; 3]> = outline.into_iter().filter_map(at).collect();
        if points.is_empty() {
            return None;
        }
        let mean_cost = |k: usize| {
            let view = &self.views[k];
            let frame = self.frame(view);
            points.iter().try_fold(0.0, |sum, &point| {
                view.pixel(point).filter(|at| frame.holds(*at))?;
                Some(sum + self.cost(view, point)?)
            })
        };
        let costs = self.within(window).into_iter().map(|k| k as usize);
        let costs = costs.filter_map(|k| Some((mean_cost(k)?, k)));
        let (_, view) = costs.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))?;
        let n = points.len() as f64;
        let middle = [0, 1, 2].map(|k| points.iter().map(|point| point[k]).sum::<f64>() / n);
        let centre = self.views[view].centre_m();
        let plan = (centre[0] - middle[0]).hypot(centre[1] - middle[1]);
        Some(PlotPhoto { view, angle_rad: plan.atan2(centre[2] - middle[2]) })
    }

    /// Gives the cells of a window, which begins at a multiple of 32 of them, the photos that are assigned to them.
    pub fn assign(&self, assignment: &Assignment, sources: &mut CellSources) {
        let CellSources { window, source, pixel, passed_over } = sources;
        let Window { u: left, v: top, width, .. } = *window;
        debug_assert!(left.is_multiple_of(SIDE) && top.is_multiple_of(SIDE), "blocks are whole");
        let strip = (width * SIDE).max(1);
        source
            .par_chunks_mut(strip)
            .zip(pixel.par_chunks_mut(strip))
            .zip(passed_over.par_chunks_mut(strip))
            .enumerate()
            .for_each_init(Scratch::new, |scratch, (n, ((source, pixel), passed_over))| {
                for u in (0..width).step_by(SIDE) {
                    if !assignment.block([left + u, top + n * SIDE], &mut scratch.assigned) {
                        continue;
                    }
                    let columns = SIDE.min(width - u);
                    let rows = source.len() / width;
                    let has_another = |at: usize| {
                        let own = source[at / SIDE * width + u + at % SIDE];
                        scratch.assigned[at] > 0 && scratch.assigned[at] != own
                    };
                    let cells = (0..rows * SIDE).filter(|at| at % SIDE < columns);
                    let mut open: Vec<usize> = cells.filter(|&at| has_another(at)).collect();
                    if !open.is_empty() {
                        let first = [left + u, top + n * SIDE];
                        scratch.cells.fill(first, &self.grid, self.surface, &self.to_surface);
                    }
                    while let Some(&at) = open.first() {
                        let photo = scratch.assigned[at];
                        self.show(photo as usize - 1, scratch);
                        open.retain(|&at| {
                            if scratch.assigned[at] != photo {
                                return true;
                            }
                            if !scratch.shown[at][0].is_nan() {
                                let to = at / SIDE * width + u + at % SIDE;
                                source[to] = photo;
                                pixel[to] = scratch.shown[at];
                                passed_over[to] = false;
                            }
                            false
                        });
                    }
                }
            });
    }

    /// Where a photo shows the cells of a block as the options ask; NaN elsewhere.
    fn show(&self, photo: usize, scratch: &mut Scratch) {
        let Scratch { cells, assigned, shown } = scratch;
        let view = &self.views[photo];
        cells.project(view, &self.frame(view), shown);
        for at in (0..CELLS).filter(|&at| assigned[at] as usize == photo + 1) {
            let point = cells.point_m(at % SIDE, at / SIDE);
            let is_allowed = self.cost(view, point).is_some()
                && self.options.visibility_m.is_none_or(|tolerance_m| {
                    self.surface.is_visible(point, view.centre_m(), tolerance_m)
                });
            if !is_allowed {
                shown[at] = [f32::NAN; 2];
            }
        }
    }
}

/// Points along the rings of a polygon.
fn outline(plot: &Polygon) -> Vec<[f64; 2]> {
    let mut points = Vec::new();
    for ring in &plot.rings {
        for (k, &a) in ring.iter().enumerate() {
            let b = ring[(k + 1) % ring.len()];
            let parts = ((b[0] - a[0]).hypot(b[1] - a[1]) / OUTLINE_STEP).ceil().max(1.0);
            let at = |n: usize| [0, 1].map(|k| a[k] + n as f64 / parts * (b[k] - a[k]));
            points.extend((0..parts as usize).map(at));
        }
    }
    points
}

/// Working memory of a block.
struct Scratch {
    cells: CellBlock,
    assigned: Box<[u32; CELLS]>,
    shown: Box<Pixels>,
}

impl Scratch {
    fn new() -> Scratch {
        Scratch {
            cells: CellBlock::new(),
            assigned: Box::new([0; CELLS]),
            shown: Box::new([[f32::NAN; 2]; CELLS]),
        }
    }
}
