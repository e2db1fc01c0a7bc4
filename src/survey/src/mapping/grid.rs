//! Grids of products: which part of the mapping frame they cover, and with how many cells.

use super::{MapError, Surface, View, view::Bounds};
use rowgram_optim::robust::median;
use rowgram_raster::georeference::{Crs, Georeference};

/// What photos show of a surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// Least and greatest x and y, metres; `None` where no photo shows any of it.
    pub bounds_m: Option<Bounds>,
    /// Indices of the photos that show none of it.
    pub outside: Vec<usize>,
    /// Indices of the photos that show more than the surface.
    pub partly_outside: Vec<usize>,
}

/// What photos show of a surface.
pub fn coverage(views: &[View], surface: &Surface) -> Coverage {
    let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    let (mut outside, mut partly_outside) = (Vec::new(), Vec::new());
    for (k, view) in views.iter().enumerate() {
        let Some((footprint, whole)) = view.footprint_m(surface) else {
            outside.push(k);
            continue;
        };
        if !whole {
            partly_outside.push(k);
        }
        for (all, own) in bounds.iter_mut().zip(footprint) {
            *all = [all[0].min(own[0]), all[1].max(own[1])];
        }
    }
    let bounds_m = (outside.len() < views.len()).then_some(bounds);
    Coverage { bounds_m, outside, partly_outside }
}

/// Median ground sampling distance of photos, metres per pixel; `None` where the middle of none shows the surface.
pub fn median_gsd_m(views: &[View], surface: &Surface) -> Option<f64> {
    median(views.iter().filter_map(|view| view.gsd_m(surface)))
}

/// A number with so many significant digits, so that people can name it.
pub fn rounded(value: f64, digits: usize) -> f64 {
    let before_exponent = digits.saturating_sub(1);
    format!("{value:.before_exponent$e}").parse().unwrap_or(value)
}

/// The grid, north up, that covers an area with cells whose borders lie on multiples of their side.
///
/// # Errors
/// Where that would be more than `max_cells` cells.
pub fn covering(
    [x, y]: Bounds,
    cell_m: f64,
    crs: Crs,
    max_cells: f64,
) -> Result<(Georeference, [usize; 2]), MapError> {
    let span = |[low, high]: [f64; 2]| {
        let first = (low / cell_m).floor();
        (first, (high / cell_m).ceil() - first)
    };
    let ((left, columns), (bottom, rows)) = (span(x), span(y));
    let cells = columns * rows;
    if cells.is_nan() || cells > max_cells {
        return Err(MapError(format!(
            "the raster would have {columns:.0} x {rows:.0} cells of {cell_m} m, at most {max_cells:.0} are possible; choose larger cells or a smaller area"
        )));
    }
    let origin = [(left + 0.5) * cell_m, (bottom + rows - 0.5) * cell_m];
    let size = [columns.max(1.0) as usize, rows.max(1.0) as usize];
    Ok((Georeference::north_up(origin, cell_m, crs), size))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        scene::Pose,
    };

    #[test]
    fn cells_lie_on_multiples_of_their_side_and_cover_the_area() {
        let (grid, size) = covering([[10.3, 11.1], [-2.9, -2.1]], 0.25, Crs::LOCAL, 1e6).unwrap();
        assert_eq!(size, [4, 4]);
        assert_eq!(grid.origin, [10.375, -2.125]);
        // The outer borders.
        let corner = grid.map([-0.5, 3.5]);
        assert_eq!(corner, [10.25, -3.0]);
        let error = covering([[0.0, 1e4], [0.0, 1e4]], 0.001, Crs::LOCAL, 1e11).unwrap_err();
        assert!(error.to_string().contains("10000000 x 10000000 cells of 0.001 m"), "{error}");
        let nothing = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        assert!(covering(nothing, 0.1, Crs::LOCAL, 1e6).is_err());
    }

    #[test]
    fn numbers_are_rounded_to_significant_digits() {
        assert_eq!(rounded(0.012_345, 3), 0.0123);
        assert_eq!(rounded(1234.5, 2), 1200.0);
        assert_eq!(rounded(0.0996, 2), 0.1);
    }

    #[test]
    fn photos_beyond_the_surface_are_told_from_those_partly_on_it() {
        let values = [100.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let interior = Interior::new(Model::Smac, [100, 100], &values).unwrap();
        let at = |x: f64| {
            let pose = Pose::from_centre([1.0, 0.0, 0.0, 0.0], [x, 0.0, 10.0]);
            View::new("p", interior, pose, None)
        };
        // 10 m x 10 m on the ground each, on a surface from -20 m to 20 m.
        let views = [at(0.0), at(18.0), at(100.0)];
        let place = Georeference::north_up([-20.0, 20.0], 1.0, Crs::LOCAL);
        let surface = Surface::new(place, [41, 41], vec![0.0; 41 * 41]).unwrap();
        let found = coverage(&views, &surface);
        assert_eq!((found.outside, found.partly_outside), (vec![2], vec![1]));
        let [[left, right], [bottom, top]] = found.bounds_m.unwrap();
        approx::assert_abs_diff_eq!(left, -5.0, epsilon = 0.01);
        // The photo that ends beyond the surface is bounded by what both cover.
        approx::assert_abs_diff_eq!(right, 20.0, epsilon = 1e-9);
        assert!(bottom <= -5.0 + 0.01 && top >= 5.0 - 0.01);
        assert_eq!(coverage(&views[2..], &surface).bounds_m, None);
        approx::assert_abs_diff_eq!(median_gsd_m(&views, &surface).unwrap(), 0.1, epsilon = 1e-6);
        assert_eq!(median_gsd_m(&views[2..], &surface), None);
    }
}
