//! Control that does not fix all of how a block lies: one or two points, points nearly in one line, points in plan only.
//!
//! Then the camera positions and the direction in which the cameras look bring the block level; control shifts it, and turns
//! and scales it in the plan where it is wide enough.

use super::{
    block::Block,
    georeference::{Known, NEARLY_A_LINE, spread_across},
    level::plan::PlanFit,
    triangulate::{TriangulationOptions, View, triangulate},
};
use crate::{
    problems::adjustment::{Alignment, nearest_to_rays},
    scene::{Axes, GroundObservation, Reconstruction, Role},
};
use nalgebra::{Rotation3, Vector3};
use rowgram_optim::robust::median;

/// Points farther apart than this share of the flight's extent tell its scale and heading better than a receiver does.
const WIDE: f64 = 0.3;

/// A control point where its marks put it.
struct Seen {
    name: String,
    at: [f64; 3],
    position_m: [f64; 3],
    axes: Axes,
}

fn seen(survey: &Reconstruction) -> Vec<Seen> {
    let mut found = Vec::new();
    for (k, point) in survey.ground.iter().enumerate() {
        let marks: Vec<GroundObservation> =
            survey.marks.iter().filter(|mark| mark.ground as usize == k).copied().collect();
        if point.role == Role::Control
            && marks.len() >= 2
            && let Some(at) = nearest_to_rays(survey, &marks)
        {
            let (name, position_m) = (point.name.clone(), point.position_m);
            found.push(Seen { name, at, position_m, axes: point.axes });
        }
    }
    found
}

/// Whether control leaves a tilt of the block open; `None` where there is no control that any marks show.
pub(in crate::sfm) fn is_weak(survey: &Reconstruction) -> Option<bool> {
    let seen = seen(survey);
    let whole = seen.iter().filter(|point| point.axes == Axes::Xyz);
    let positions: Vec<[f64; 3]> = whole.map(|point| point.position_m).collect();
    let is_line = positions.len() < 3 || spread_across(&positions) < NEARLY_A_LINE;
    (!seen.is_empty()).then_some(is_line)
}

fn extent_m(of: impl Iterator<Item = [f64; 3]>) -> f64 {
    let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for at in of {
        for k in 0..2 {
            least[k] = least[k].min(at[k]);
            most[k] = most[k].max(at[k]);
        }
    }
    (most[0] - least[0]).hypot(most[1] - least[1])
}

/// Brings a block that is level to its control, as far as that goes.
pub(super) fn settle(survey: &mut Reconstruction, alignment: &mut Alignment) {
    let seen = seen(survey);
    let in_plan: Vec<&Seen> = seen.iter().filter(|point| point.axes != Axes::Z).collect();
    let plan = |p: &[f64; 3]| [p[0], p[1]];
    let pairs: Vec<([f64; 2], [f64; 2])> =
        in_plan.iter().map(|point| (plan(&point.at), plan(&point.position_m))).collect();
    let flight_m = extent_m(survey.images.iter().map(|image| image.pose.centre_m()));
    let wide = extent_m(in_plan.iter().map(|point| point.position_m)) > WIDE * flight_m;
    let fit = if wide { PlanFit::robust(&pairs).map(|(fit, _)| fit) } else { None };
    let axis = |k: usize| median(pairs.iter().map(|(p, q)| q[k] - p[k])).unwrap_or(0.0);
    let fit = fit.unwrap_or(PlanFit { factor: [1.0, 0.0], shift: [axis(0), axis(1)] });
    let scale = fit.factor[0].hypot(fit.factor[1]);
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), fit.factor[1].atan2(fit.factor[0]));
    let heights = seen.iter().filter(|point| point.axes != Axes::Xy);
    let left: Vec<f64> = heights.map(|point| point.position_m[2] - scale * point.at[2]).collect();
    let up = if left.is_empty() {
        // The middle of the cameras stays as high as it was.
        let heights = survey.images.iter().map(|image| image.pose.centre_m()[2]);
        median(heights).map_or(0.0, |middle| (1.0 - scale) * middle)
    } else {
        median(left).unwrap_or(0.0)
    };
    survey.transform(scale, turn.matrix(), &Vector3::new(fit.shift[0], fit.shift[1], up));
    let squares: f64 = pairs.iter().map(|pair| fit.left(pair).powi(2)).sum();
    alignment.by = "camera positions and control points";
    alignment.scale *= scale;
    alignment.used = seen.into_iter().map(|point| point.name).collect();
    alignment.misfits.clear();
    alignment.rmse_m = (squares / pairs.len().max(1) as f64).sqrt();
}

/// Gives the coordinates of ground points that are not known the values that the block gives them, which is where their
/// adjustment begins.
pub(super) fn fill_unknown_coordinates(block: &Block<'_>, known: &mut Known) {
    let heights: Vec<f64> = block.points.iter().flatten().map(|point| point[2]).collect();
    let usual = median(heights).unwrap_or(0.0);
    let demands = TriangulationOptions { tolerance_px: 50.0, min_angle_rad: 0.01 };
    for ground in 0..known.ground.len() {
        let axes = known.ground[ground].axes;
        if axes == Axes::Xyz {
            continue;
        }
        let marks = known.marks.iter().filter(|mark| mark.ground as usize == ground);
        let views: Vec<View<'_>> =
            marks.filter_map(|mark| block.view(mark.image, mark.image_px)).collect();
        let at = triangulate(&views, &demands).map(|(at, _)| at);
        let point = &mut known.ground[ground];
        for k in (0..3).filter(|k| !axes.indices().contains(k)) {
            match at {
                Some(at) => point.position_m[k] = at[k],
                None if k == 2 => point.position_m[k] = usual,
                None => {}
            }
        }
    }
}
