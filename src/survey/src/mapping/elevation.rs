//! Elevation models of a cloud: the surface on a grid and its standard deviations.

use super::{
    MapError, Surface,
    continuation::continue_heights,
    dem::{CloudOptions, CloudStatistics, SurfacePoint, TriangulatedCloud},
    grid::{covering, rounded},
    view::Bounds,
};
use rowgram_raster::georeference::Crs;

/// The most cells of a surface, which is held in memory.
const MAX_CELLS: f64 = 4e8;

/// How an elevation model is made.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ElevationOptions {
    /// How points are triangulated.
    pub cloud: CloudOptions,
    /// Side of a cell, metres; `None`: half the median distance of neighbouring points.
    pub cell_m: Option<f64>,
    /// Where the surface goes on beyond its points.
    pub extent: Extent,
}

/// How far a surface goes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Extent {
    /// As far as its points.
    #[default]
    Points,
    /// So many metres beyond the bounds of its points.
    Beyond(f64),
    /// At least over these bounds.
    Over(Bounds),
}

impl Extent {
    fn bounds_m(self, points_m: Bounds) -> Bounds {
        std::array::from_fn(|k| {
            let [low, high] = points_m[k];
            match self {
                Extent::Points => points_m[k],
                Extent::Beyond(metres) => [low - metres, high + metres],
                Extent::Over(bounds) => [low.min(bounds[k][0]), high.max(bounds[k][1])],
            }
        })
    }
}

/// An elevation model. All rasters have the grid of the surface.
#[derive(Debug, Clone)]
pub struct ElevationModel {
    /// The surface.
    pub surface: Surface,
    /// Standard deviations of its heights, metres, row by row; NaN where not known, as beyond the points.
    pub sigmas_m: Vec<f32>,
    /// Cells with a height beyond the points and in their gaps.
    pub continued_cells: usize,
    /// What became of the points.
    pub statistics: CloudStatistics,
}

impl ElevationModel {
    /// The known standard deviations in ascending order, metres.
    pub fn sorted_sigmas_m(&self) -> Vec<f32> {
        let mut known: Vec<f32> = self.sigmas_m.iter().copied().filter(|s| s.is_finite()).collect();
        known.sort_by(f32::total_cmp);
        known
    }
}

/// The elevation model of some points.
///
/// # Errors
/// Fewer than three points, or all on one line; a grid of too many cells.
pub fn elevation_model(
    points: &[SurfacePoint],
    crs: Crs,
    options: &ElevationOptions,
) -> Result<ElevationModel, MapError> {
    let cloud = TriangulatedCloud::new(points, &options.cloud)?;
    // Two digits are enough to name it.
    let cell_m = options.cell_m.unwrap_or_else(|| rounded(0.5 * cloud.statistics.spacing_m, 2));
    let bounds_m = options.extent.bounds_m(cloud.bounds_m());
    let (grid, size) = covering(bounds_m, cell_m, crs, MAX_CELLS)?;
    let (mut surface, sigmas_m) = cloud.surface(grid, size)?;
    let mut continued_cells = 0;
    if options.extent != Extent::Points {
        let mut heights = surface.heights_m;
        continued_cells = continue_heights(&mut heights, size);
        surface = Surface::new(grid, size, heights)?;
    }
    Ok(ElevationModel { surface, sigmas_m, continued_cells, statistics: cloud.statistics })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A level of 5 m with plants of half a metre on every fourth point, 10 m x 10 m.
    fn points() -> Vec<SurfacePoint> {
        (0..2000)
            .map(|k| {
                let at = |ratio: f64| 10.0 * (f64::from(k) * ratio).fract();
                let plant = if k % 4 == 0 { 0.5 } else { 0.0 };
                let position_m = [at(0.754_877_666), at(0.569_840_291), 5.0 + plant];
                SurfacePoint { position_m, sigma_z_m: 0.01 }
            })
            .collect()
    }

    #[test]
    fn plants_are_part_of_the_surface() {
        let options = ElevationOptions::default();
        let found = elevation_model(&points(), Crs::projected(32616), &options).unwrap();
        let highest = found.surface.range_m()[1];
        assert!(highest > 5.3, "{highest}: plants are part of the surface");
        let sigmas = found.sorted_sigmas_m();
        assert!(sigmas.is_sorted() && *sigmas.last().unwrap() <= 0.0101);
        // Half the spacing of 2000 points on 100 m2, about .1 m, in two digits.
        let cell_m = found.surface.cell_m();
        assert!((0.05..0.15).contains(&cell_m) && rounded(cell_m, 2) == cell_m, "{cell_m}");
    }

    #[test]
    fn a_surface_goes_on_beyond_its_points_where_it_is_told_to() {
        let with = |extent| ElevationOptions { extent, cell_m: Some(0.2), ..Default::default() };
        let found = |extent| elevation_model(&points(), Crs::LOCAL, &with(extent)).unwrap();
        let plain = found(Extent::Points);
        assert_eq!(plain.continued_cells, 0);
        for extent in [Extent::Beyond(3.0), Extent::Over([[-3.0, 13.0], [-3.0, 13.0]])] {
            let more = found(extent);
            let [[left, right], _] = more.surface.bounds_m();
            assert!(left < -2.5 && right > 12.5, "{left} {right}");
            assert!(more.surface.heights_m.iter().all(|z| z.is_finite()));
            let known = |of: &ElevationModel| of.sigmas_m.iter().filter(|s| s.is_finite()).count();
            assert_eq!(known(&more), known(&plain), "standard deviations end with the points");
            assert!(more.continued_cells + known(&more) == more.surface.heights_m.len());
            for at in [[-2.0, 5.0], [12.0, -2.0]] {
                let z = more.surface.at(at).unwrap();
                assert!((5.0..5.5).contains(&z), "{z}");
            }
            let inside = [5.03, 4.97];
            let (a, b) = (plain.surface.at(inside).unwrap(), more.surface.at(inside).unwrap());
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }

    #[test]
    fn too_many_cells_are_refused() {
        let options = ElevationOptions { cell_m: Some(1e-4), ..Default::default() };
        let error = elevation_model(&points(), Crs::LOCAL, &options).unwrap_err();
        assert!(error.to_string().contains("cells of 0.0001 m"), "{error}");
    }
}
