//! The ground below plants: the lower envelope of a cloud.
//!
//! ```text
//! min_z  sum_c n_c rho(d_c - z_c)  +  lambda sum |z_a - 2 z_b + z_c|,      rho(r) = q max(r, 0) + (1 - q) max(-r, 0)
//! ```
//!
//! over the heights `z` of a coarse grid. `d_c` is the `q`-quantile of the `n_c` points in grid cell `c`; the loss is
//! the quantile's own, so points above the ground pull less than points below it. The second differences run
//! along rows, columns and both diagonals: their sum of sizes wants a ground of few even pieces, and lets it
//! break where the points say so. A linear programme, solved exactly by [`rowgram_optim::convex::envelope`].

use super::{MapError, Surface, dem::TriangulatedCloud, surface::HeightInterpolation};
use rowgram_optim::convex::envelope::{Datum, lower_envelope};
use rowgram_raster::georeference::Georeference;

/// How the ground is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundOptions {
    /// Side of the coarse grid, metres: larger than a plant.
    pub cell_m: f64,
    /// Which share of the points lies below the ground, through noise.
    pub quantile: f64,
    /// How much a break of the ground costs, in points.
    pub smoothness: f64,
}

impl Default for GroundOptions {
    fn default() -> GroundOptions {
        GroundOptions { cell_m: 1.0, quantile: 0.1, smoothness: 2.0 }
    }
}

/// The most cells of the coarse grid.
const MAX_CELLS: usize = 40_000;

/// The ground as a surface on a coarse grid of its own.
///
/// # Errors
/// Where the grid would have too many cells, or the programme cannot be solved.
pub fn ground_surface(
    cloud: &TriangulatedCloud,
    options: &GroundOptions,
    place: &Georeference,
) -> Result<Surface, MapError> {
    let [[left, right], [bottom, top]] = cloud.bounds_m();
    let side = options.cell_m;
    let count = |low: f64, high: f64| ((high - low) / side).ceil() as usize + 2;
    let (width, height) = (count(left, right), count(bottom, top));
    if width * height > MAX_CELLS {
        return Err(MapError(format!(
            "the ground would have {width} x {height} cells of {side} m, at most {MAX_CELLS} are solved; give larger ones"
        )));
    }
    // The first cell's centre lies half a cell outside, so that every point is between centres.
    let origin = [left - 0.5 * side, top + 0.5 * side];
    let coarse = Georeference::north_up(origin, side, place.crs);
    let mut heights: Vec<Vec<f64>> = vec![Vec::new(); width * height];
    for [x, y, z] in cloud.points_m() {
        let u = (((x - origin[0]) / side).round() as usize).min(width - 1);
        let v = (((origin[1] - y) / side).round() as usize).min(height - 1);
        heights[v * width + u].push(z);
    }
    let data: Vec<Datum> = heights
        .iter_mut()
        .enumerate()
        .filter(|(_, z)| !z.is_empty())
        .map(|(cell, z)| {
            z.sort_by(f64::total_cmp);
            let rank = (options.quantile * (z.len() - 1) as f64).floor() as usize;
            Datum { cell, value: z[rank], weight: z.len() as f64 }
        })
        .collect();
    let solution = lower_envelope([width, height], &data, options.quantile, options.smoothness)
        .map_err(|error| MapError(format!("the ground: {error}")))?;
    let heights = solution.into_iter().map(|z| z as f32).collect();
    Surface::new(coarse, [width, height], heights, HeightInterpolation::Bilinear)
}
