//! Where photos show surveyed points, for somebody who marks them, and how far marks are from one another.
//!
//! The rays of two marks of a point or more meet at its place in the block. The others are expected where the survey has them, moved by what
//! block and survey differ by at those places (the median), at the height of the tie points around them.

use crate::{
    mapping::View as PhotoView,
    scene::{GroundObservation, GroundPoint, Reconstruction},
    sfm::triangulate::{TriangulationOptions, View, error_px, triangulate},
};
use rayon::prelude::*;
use rowgram_optim::robust;

/// Tie points whose heights tell that of the ground at a target.
const HEIGHT_POINTS: usize = 15;
/// Marks of one point that are nearer to where their rays meet agree.
const TOLERANCE_PX: f64 = 10.0;
/// Rays that are more nearly parallel do not determine a place, radians.
const MIN_ANGLE_RAD: f64 = 0.01;

/// A point in a photo that should show it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedMark {
    /// Index of the image.
    pub image: usize,
    /// Where it should be, pixels.
    pub image_px: [f64; 2],
    /// How many pixels a metre has there.
    pub px_per_m: f64,
}

/// What a block says of points and marks.
#[derive(Debug, Clone, PartialEq)]
pub struct ExpectedMarks {
    /// For each point the photos that should show it, in their order.
    pub of_points: Vec<Vec<ExpectedMark>>,
    /// For each mark how far it is from where all marks of its point put it, pixels; `None` where they do not determine that.
    pub residuals_px: Vec<Option<f64>>,
}

/// The surveyed points at the height that the block has there.
pub fn on_the_ground(reconstruction: &Reconstruction, points: &[GroundPoint]) -> Vec<[f64; 3]> {
    let ties = &reconstruction.points;
    let place = |point: &GroundPoint| {
        let [x, y, z] = point.position_m;
        let mut near: Vec<(f64, f64)> = ties
            .iter()
            .map(|tie| {
                let [tx, ty, tz] = tie.position_m;
                ((tx - x).powi(2) + (ty - y).powi(2), tz)
            })
            .collect();
        let count = near.len().min(HEIGHT_POINTS);
        if count > 0 && count < near.len() {
            near.select_nth_unstable_by(count - 1, |a, b| a.0.total_cmp(&b.0));
        }
        let height = robust::median(near[..count].iter().map(|(_, height)| *height));
        [x, y, height.unwrap_or(z)]
    };
    points.par_iter().map(place).collect()
}

/// Where the photos show points, of which `grounds` are the places [`on_the_ground`], from the block and the marks that there are.
pub fn expected_marks(
    reconstruction: &Reconstruction,
    views: &[PhotoView],
    grounds: &[[f64; 3]],
    marks: &[GroundObservation],
) -> ExpectedMarks {
    let ray = |mark: &GroundObservation| {
        let camera = reconstruction.images[mark.image as usize].camera;
        View {
            pose: reconstruction.pose_at(mark.image as usize, mark.image_px[1]),
            lens: &reconstruction.cameras[camera].interior,
            image_px: mark.image_px,
        }
    };
    let demands = TriangulationOptions { tolerance_px: TOLERANCE_PX, min_angle_rad: MIN_ANGLE_RAD };
    let located: Vec<Option<[f64; 3]>> = (0..grounds.len())
        .map(|ground| {
            let own = marks.iter().filter(|mark| mark.ground as usize == ground);
            let rays: Vec<View<'_>> = own.map(ray).collect();
            triangulate(&rays, &demands).map(|(place, _)| place)
        })
        .collect();
    let offset: [f64; 3] = std::array::from_fn(|axis| {
        let known = located.iter().zip(grounds);
        robust::median(known.filter_map(|(at, ground)| Some(at.as_ref()?[axis] - ground[axis])))
            .unwrap_or(0.0)
    });
    let expected = |(at, ground): (&Option<[f64; 3]>, &[f64; 3])| -> Vec<ExpectedMark> {
        let place = at.unwrap_or_else(|| std::array::from_fn(|k| ground[k] + offset[k]));
        let of = |(image, view): (usize, &PhotoView)| {
            let image_px = view.pixel(place)?;
            let [east, north] = [[0.5, 0.0], [0.0, 0.5]].map(|[x, y]| {
                let side =
                    |sign: f64| view.seen_px([place[0] + sign * x, place[1] + sign * y, place[2]]);
                Some([side(1.0)?, side(-1.0)?])
            });
            let length = |[a, b]: [[f64; 2]; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
            let px_per_m = 0.5 * (length(east?) + length(north?));
            Some(ExpectedMark { image, image_px, px_per_m })
        };
        views.iter().enumerate().filter_map(of).collect()
    };
    let residual = |mark: &GroundObservation| {
        located[mark.ground as usize].and_then(|place| error_px(&ray(mark), place))
    };
    ExpectedMarks {
        of_points: located.iter().zip(grounds).map(expected).collect(),
        residuals_px: marks.iter().map(residual).collect(),
    }
}
