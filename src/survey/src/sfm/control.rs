//! Marks and coordinates on the ground against the block's own geometry.

use super::{
    block::Block,
    georeference::Known,
    triangulate::{TriangulationOptions, View, error_px, triangulate},
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
        let views: Vec<View<'_>> = marks
            .filter_map(|mark| {
                let pose = block.pose_at(mark.image as usize, mark.image_px[1])?;
                let lens = block.lens(mark.image as usize);
                Some(View { pose, lens, image_px: mark.image_px })
            })
            .collect();
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

/// Marks that the block contradicts, by the distances from where the others of their point put them.
#[derive(Debug, Clone, PartialEq)]
pub struct WrongMark {
    /// Index of the image.
    pub image: u32,
    /// Index of the ground point.
    pub ground: u32,
    /// Distance, pixels; infinite where no two marks of the point agree.
    pub error_px: f64,
}

/// How many marks of a block fit and which do not, `scale` times what they are.
fn marks_that_fit(
    block: &Block<'_>,
    known: &Known,
    scale: f64,
    demands: &TriangulationOptions,
) -> (usize, Vec<WrongMark>) {
    let (mut fitting, mut wrong) = (0, Vec::new());
    for ground in 0..known.ground.len() {
        let mut marks = Vec::new();
        let mut views = Vec::new();
        for mark in known.marks.iter().filter(|mark| mark.ground as usize == ground) {
            let image_px = mark.image_px.map(|v| (v + 0.5) * scale - 0.5);
            if let Some(pose) = block.pose_at(mark.image as usize, image_px[1]) {
                views.push(View { pose, lens: block.lens(mark.image as usize), image_px });
                marks.push(*mark);
            }
        }
        if views.len() < 2 {
            continue;
        }
        match triangulate(&views, demands) {
            Some((point, fits)) => {
                for (k, fits) in fits.into_iter().enumerate() {
                    if fits {
                        fitting += 1;
                    } else {
                        let error_px = error_px(&views[k], point).unwrap_or(f64::INFINITY);
                        wrong.push(WrongMark {
                            image: marks[k].image,
                            ground: ground as u32,
                            error_px,
                        });
                    }
                }
            }
            None => wrong.extend(marks.iter().map(|mark| WrongMark {
                image: mark.image,
                ground: ground as u32,
                error_px: f64::INFINITY,
            })),
        }
    }
    (fitting, wrong)
}

/// What is wrong with the marks of a block.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkReview {
    /// The factor that the marks were multiplied with: 1 unless they are those of resized images.
    pub scale: f64,
    /// How many fit.
    pub fitting: usize,
    /// Those that do not; they were taken out, unless nothing of their point agrees.
    pub wrong: Vec<WrongMark>,
}

/// Looks through the marks by the block's own geometry, which needs no coordinates: marks of images
/// of another size are brought to that of the photos, wrong ones are taken out.
pub fn review_marks(
    block: &Block<'_>,
    known: &mut Known,
    scales: &[f64],
    demands: &TriangulationOptions,
) -> MarkReview {
    let (mut fitting, mut wrong) = marks_that_fit(block, known, 1.0, demands);
    let mut scale = 1.0;
    for &other in scales {
        let (more, rest) = marks_that_fit(block, known, other, demands);
        // Some marks fit by chance: another size must explain clearly more.
        if more > 2 * fitting && more >= 4 {
            (fitting, wrong, scale) = (more, rest, other);
        }
    }
    if scale != 1.0 {
        for mark in &mut known.marks {
            mark.image_px = mark.image_px.map(|v| (v + 0.5) * scale - 0.5);
        }
    }
    let out: std::collections::BTreeSet<(u32, u32)> = wrong
        .iter()
        .filter(|mark| mark.error_px.is_finite())
        .map(|mark| (mark.image, mark.ground))
        .collect();
    known.marks.retain(|mark| !out.contains(&(mark.image, mark.ground)));
    MarkReview { scale, fitting, wrong }
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
