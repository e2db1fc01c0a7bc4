//! Elevation models of a cloud: the surface on a grid, its standard deviations, and the ground below plants.

use super::{
    MapError, Surface,
    dem::{CloudOptions, CloudStatistics, SurfacePoint, TriangulatedCloud},
    grid::{covering, rounded},
    ground::{GroundOptions, ground_surface},
    surface::HeightInterpolation,
};
use crate::raster::georeference::Crs;

/// The most cells of a surface, which is held in memory.
const MAX_CELLS: f64 = 4e8;

/// How an elevation model is made.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ElevationOptions {
    /// How points are triangulated.
    pub cloud: CloudOptions,
    /// Side of a cell, metres; `None`: half the median distance of neighbouring points.
    pub cell_m: Option<f64>,
    /// How the ground is found, where it is wanted.
    pub ground: Option<GroundOptions>,
}

/// An elevation model. All rasters have the grid of the surface.
#[derive(Debug, Clone)]
pub struct ElevationModel {
    /// The surface.
    pub surface: Surface,
    /// Standard deviations of its heights, metres, row by row; NaN where not known.
    pub sigmas_m: Vec<f32>,
    /// The ground below plants, where there is a surface.
    pub ground: Option<Surface>,
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
/// Fewer than three points, or all on one line; a grid of too many cells; a ground that cannot be found.
pub fn elevation_model(
    points: &[SurfacePoint],
    crs: Crs,
    options: &ElevationOptions,
) -> Result<ElevationModel, MapError> {
    let cloud = TriangulatedCloud::new(points, &options.cloud)?;
    // Two digits are enough to name it.
    let cell_m = options.cell_m.unwrap_or_else(|| rounded(0.5 * cloud.statistics.spacing_m, 2));
    let (grid, size) = covering(cloud.bounds_m(), cell_m, crs, MAX_CELLS)?;
    let (surface, sigmas_m) = cloud.surface(grid, size)?;
    let ground = match &options.ground {
        None => None,
        Some(how) => {
            let coarse = ground_surface(&cloud, how, &grid)?;
            let heights = (0..size[0] * size[1]).map(|k| {
                let at = grid.map([(k % size[0]) as f64, (k / size[0]) as f64]);
                let known = surface.heights_m[k].is_finite();
                coarse.at(at).filter(|_| known).map_or(f32::NAN, |z| z as f32)
            });
            let heights = heights.collect();
            Some(Surface::new(grid, size, heights, HeightInterpolation::Bilinear)?)
        }
    };
    Ok(ElevationModel { surface, sigmas_m, ground, statistics: cloud.statistics })
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
    fn the_ground_is_below_the_plants_and_ends_with_the_surface() {
        let options =
            ElevationOptions { ground: Some(GroundOptions::default()), ..Default::default() };
        let found = elevation_model(&points(), Crs::projected(32616), &options).unwrap();
        let ground = found.ground.as_ref().unwrap();
        assert_eq!(ground.georeference, found.surface.georeference);
        for (ground, surface) in ground.heights_m.iter().zip(&found.surface.heights_m) {
            assert_eq!(ground.is_finite(), surface.is_finite());
            assert!(ground.is_nan() || (ground - 5.0).abs() < 0.01, "{ground}");
        }
        let highest = found.surface.range_m()[1];
        assert!(highest > 5.3, "{highest}: plants are part of the surface");
        let sigmas = found.sorted_sigmas_m();
        assert!(sigmas.is_sorted() && *sigmas.last().unwrap() <= 0.0101);
        // Half the spacing of 2000 points on 100 m2, about .1 m, in two digits.
        let cell_m = found.surface.cell_m();
        assert!((0.05..0.15).contains(&cell_m) && rounded(cell_m, 2) == cell_m, "{cell_m}");
    }

    #[test]
    fn too_many_cells_are_refused() {
        let options = ElevationOptions { cell_m: Some(1e-4), ..Default::default() };
        let error = elevation_model(&points(), Crs::LOCAL, &options).unwrap_err();
        assert!(error.to_string().contains("cells of 0.0001 m"), "{error}");
    }
}
