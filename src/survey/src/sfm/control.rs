//! Marks and coordinates on the ground against the block's own geometry.

use super::{
    block::Block,
    georeference::Known,
    triangulate::{TriangulationOptions, View, triangulate},
};
use crate::{
    camera::Lens,
    problems::adjustment::align,
    scene::{Axes, Role},
};
use nalgebra::Vector3;
use rowgram_optim::geometry::rotation;

/// How far each control point is from where its marks put it, metres: its place among the ground
/// points, and the distance along the coordinates that are known; of a point that one image shows, and
/// whose coordinates are all known, the distance from that ray.
pub fn control_left_m(block: &Block<'_>, known: &Known) -> Vec<(usize, f64)> {
    let demands = TriangulationOptions { tolerance_px: 50.0, min_angle_rad: 0.01 };
    let mut found = Vec::new();
    for (ground, point) in known.ground.iter().enumerate() {
        if point.role != Role::Control {
            continue;
        }
        let marks = known.marks.iter().filter(|mark| mark.ground as usize == ground);
        let views: Vec<View<'_>> =
            marks.filter_map(|mark| block.view(mark.image, mark.image_px)).collect();
        if let ([view], Axes::Xyz) = (views.as_slice(), point.axes) {
            if let Some(ray) = view.lens.unproject(view.image_px) {
                let at = Vector3::from(view.pose.to_camera(point.position_m));
                let ray = Vector3::from(ray);
                found.push((ground, at.cross(&ray).norm() / ray.norm()));
            }
        } else if let Some((at, _)) = triangulate(&views, &demands) {
            let squares =
                point.axes.indices().iter().map(|&k| (at[k] - point.position_m[k]).powi(2));
            found.push((ground, squares.sum::<f64>().sqrt()));
        }
    }
    found
}

/// Whether control has X and Y exchanged: as given it turns the block upside down or does not fit,
/// exchanged it fits and the cameras look down.
pub fn axes_exchanged(block: &Block<'_>, known: &Known) -> bool {
    let quality = |exchange: bool| -> Option<(f64, f64)> {
        let (mut survey, _, order) = block.reconstruction(None);
        let mut known = known.clone();
        known.positions.clear();
        if exchange {
            known.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
        }
        known.attach(&mut survey, &order);
        let alignment = align(&mut survey)?;
        let up: f64 = survey
            .images
            .iter()
            .map(|image| {
                rotation::rotate(rotation::inverse(image.pose.rotation), [0.0, 0.0, 1.0])[2]
            })
            .sum();
        let share = alignment.used.len() as f64
            / (alignment.used.len() + alignment.misfits.len()).max(1) as f64;
        Some((alignment.rmse_m / share, up / survey.images.len() as f64))
    };
    match (quality(false), quality(true)) {
        (Some((rmse, up)), Some((other_rmse, other_up))) => {
            other_up > 0.5 && (up < -0.5 && other_rmse < 3.0 * rmse || other_rmse < 0.1 * rmse)
        }
        _ => false,
    }
}
