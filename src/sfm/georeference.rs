//! Blocks with a frame of their own come into the frame of the map: by control points or camera
//! positions, each by its own similarity; then fragments are one block, tied by the tracks they share.

pub use super::control::{MarkReview, WrongMark, axes_exchanged, control_left_m, review_marks};

use super::{
    block::Block,
    bundle::{BundleAdjustmentOptions, bundle_adjust},
    depth_outliers,
    rolling_shutter::keep_feasible_marks,
    triangulate::TriangulationOptions,
};
use crate::{
    engine::SolveError,
    geometry::rotation,
    nlls::Loss,
    problems::adjustment::{Alignment, align},
    scene::{CameraPosition, GroundObservation, GroundPoint, Pose, Reconstruction, Role},
};
use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::Serialize;

/// What is known on the ground and in the air; images by their index in the block.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Known {
    /// Ground points.
    pub ground: Vec<GroundPoint>,
    /// Their marks.
    pub marks: Vec<GroundObservation>,
    /// Camera positions.
    pub positions: Vec<CameraPosition>,
}

/// What came of bringing blocks into one frame.
#[derive(Debug)]
pub struct Joined<'a> {
    /// All images that have a place in the common frame.
    pub block: Block<'a>,
    /// How each of the blocks was brought into it; `None` for one that could not be, and for all
    /// where nothing is known on the ground or in the air: then the first is the frame.
    pub alignments: Vec<Option<Alignment>>,
    /// Whether the frame is that of the map.
    pub georeferenced: bool,
    /// The shift of all camera positions against the control that was taken off them, metres.
    pub position_shift_m: Option<[f64; 3]>,
}

impl Known {
    /// What of it is about the images that a survey has, with its images' indices in the block.
    pub fn attach(&self, survey: &mut Reconstruction, order: &[usize]) {
        let place = |image: u32| order.iter().position(|&k| k == image as usize).map(|k| k as u32);
        survey.ground.clone_from(&self.ground);
        survey.marks = self
            .marks
            .iter()
            .filter_map(|mark| Some(GroundObservation { image: place(mark.image)?, ..*mark }))
            .collect();
        survey.positions = self
            .positions
            .iter()
            .filter_map(|position| {
                Some(CameraPosition { image: place(position.image)?, ..*position })
            })
            .collect();
    }

    /// Whether there are control points with all coordinates.
    pub fn has_control(&self) -> bool {
        self.ground.iter().any(|point| point.role == Role::Control)
    }
}

/// Below this share of the spread along the flight the spread across it does not tell where down is.
const NEARLY_A_LINE: f64 = 0.1;

/// Ratio of the second to the first principal spread of some positions.
fn spread_across(positions: &[[f64; 3]]) -> f64 {
    let n = positions.len().max(1) as f64;
    let mean = positions.iter().map(|p| Vector3::from(*p)).sum::<Vector3<f64>>() / n;
    let mut moments = Matrix3::zeros();
    for p in positions {
        let d = Vector3::from(*p) - mean;
        moments += d * d.transpose();
    }
    let mut values: Vec<f64> = moments.symmetric_eigenvalues().iter().copied().collect();
    values.sort_by(f64::total_cmp);
    (values[1].max(0.0) / values[2].max(1e-300)).sqrt()
}

/// One strip: its positions give scale, place and heading, and the mean optical axis is down.
fn align_strip(survey: &mut Reconstruction) -> Option<Alignment> {
    let pairs: Vec<(Vector3<f64>, Vector3<f64>)> = survey
        .positions
        .iter()
        .map(|p| {
            let centre = survey.images[p.image as usize].pose.centre_m();
            (centre.into(), p.position_m.into())
        })
        .collect();
    if pairs.len() < 2 {
        return None;
    }
    let n = pairs.len() as f64;
    let from = pairs.iter().map(|p| p.0).sum::<Vector3<f64>>() / n;
    let to = pairs.iter().map(|p| p.1).sum::<Vector3<f64>>() / n;
    // Upwards: against the mean of the optical axes.
    let mut up = Vector3::zeros();
    for image in &survey.images {
        let back = rotation::inverse(image.pose.rotation);
        up += Vector3::from(rotation::rotate(back, [0.0, 0.0, 1.0]));
    }
    let along = |side: usize, mean: Vector3<f64>| {
        let mut moments = Matrix3::zeros();
        for pair in &pairs {
            let d = if side == 0 { pair.0 } else { pair.1 } - mean;
            moments += d * d.transpose();
        }
        let eigen = moments.symmetric_eigen();
        let k = eigen.eigenvalues.imax();
        (eigen.eigenvectors.column(k).into_owned(), eigen.eigenvalues[k])
    };
    let (mut x, spread_from) = along(0, from);
    let (mut y, spread_to) = along(1, to);
    let agreement: f64 = pairs.iter().map(|p| x.dot(&(p.0 - from)) * y.dot(&(p.1 - to))).sum();
    if agreement < 0.0 {
        x = -x;
    }
    // The heading is what counts: the line of flight may climb.
    let z_to = Vector3::z() - y * y.z;
    let z_from = up - x * x.dot(&up);
    if z_to.norm() < 0.2 || z_from.norm() < 0.2 * up.norm() || spread_from <= 0.0 {
        return None;
    }
    let frame = |first: Vector3<f64>, third: Vector3<f64>| {
        let third = third.normalize();
        Matrix3::from_columns(&[first, third.cross(&first), third])
    };
    y = y.normalize();
    let turn = frame(y, z_to) * frame(x, z_from).transpose();
    let scale = (spread_to / spread_from).sqrt();
    let shift = to - scale * (turn * from);
    apply(survey, scale, &turn, &shift);
    let residuals: Vec<f64> =
        pairs.iter().map(|p| (scale * (turn * p.0) + shift - p.1).norm()).collect();
    let rmse_m = (residuals.iter().map(|r| r * r).sum::<f64>() / n).sqrt();
    let used =
        survey.positions.iter().map(|p| survey.images[p.image as usize].name.clone()).collect();
    Some(Alignment {
        by: "camera positions along a strip",
        scale,
        used,
        misfits: Vec::new(),
        rmse_m,
    })
}

fn apply(survey: &mut Reconstruction, scale: f64, turn: &Matrix3<f64>, shift: &Vector3<f64>) {
    let q = super::resection::quaternion(&Rotation3::from_matrix_unchecked(*turn).into_inner());
    for image in &mut survey.images {
        let centre = scale * (turn * Vector3::from(image.pose.centre_m())) + shift;
        let turned = rotation::multiply(image.pose.rotation, rotation::inverse(q));
        image.pose = Pose::from_centre(rotation::normalize(turned), centre.into());
    }
    for point in &mut survey.points {
        point.position_m = (scale * (turn * Vector3::from(point.position_m)) + shift).into();
    }
}

/// Brings a survey into the frame of what is known of it.
fn georeference(survey: &mut Reconstruction) -> Option<Alignment> {
    let mut trial = survey.clone();
    let first = align(&mut trial);
    let by_positions = first.as_ref().is_none_or(|alignment| alignment.by == "camera positions");
    let measured: Vec<[f64; 3]> = survey.positions.iter().map(|p| p.position_m).collect();
    if by_positions && measured.len() >= 2 && spread_across(&measured) < NEARLY_A_LINE {
        return align_strip(survey);
    }
    let alignment = first?;
    *survey = trial;
    Some(alignment)
}

/// Brings blocks into the frame of the map and makes them one; those that nothing places stay out.
///
/// `None` where there is no block at all.
pub fn join<'a>(
    mut blocks: Vec<Block<'a>>,
    known: &mut Known,
    demands: &TriangulationOptions,
) -> Option<Joined<'a>> {
    let mut alignments = Vec::new();
    for block in &mut blocks {
        let (mut survey, _, order) = block.reconstruction(None);
        known.attach(&mut survey, &order);
        let alignment = georeference(&mut survey);
        if alignment.is_some() {
            for (image, &index) in survey.images.iter().zip(&order) {
                block.poses[index] = Some(image.pose);
            }
        }
        alignments.push(alignment);
    }
    let georeferenced = alignments.iter().any(Option::is_some);
    let mut whole: Option<Block<'a>> = None;
    for (block, alignment) in blocks.into_iter().zip(&alignments) {
        let placed = alignment.is_some() || !georeferenced && whole.is_none();
        if !placed {
            continue;
        }
        match &mut whole {
            None => whole = Some(block),
            Some(whole) => {
                for (pose, other) in whole.poses.iter_mut().zip(block.poses) {
                    *pose = pose.or(other);
                }
            }
        }
    }
    let mut block = whole?;
    block.points.fill(None);
    block.used.fill(false);
    retriangulate_and_filter(&mut block, demands);
    let control = alignments.iter().flatten().any(|alignment| alignment.by == "control points");
    let position_shift_m =
        if control { remove_common_offset(&block, &mut known.positions) } else { None };
    Some(Joined { block, alignments, georeferenced, position_shift_m })
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// A receiver's positions have a common error (and heights of another datum than the control's),
/// which control tells.
fn remove_common_offset(block: &Block<'_>, positions: &mut [CameraPosition]) -> Option<[f64; 3]> {
    let left: Vec<[f64; 3]> = positions
        .iter()
        .filter_map(|p| {
            let centre = block.poses[p.image as usize]?.centre_m();
            Some(std::array::from_fn(|k| p.position_m[k] - centre[k]))
        })
        .collect();
    if left.len() < 3 {
        return None;
    }
    let shift: [f64; 3] = std::array::from_fn(|k| median(left.iter().map(|d| d[k]).collect()));
    for position in positions.iter_mut() {
        (0..3).for_each(|k| position.position_m[k] -= shift[k]);
    }
    Some(shift)
}

/// From so many control points on these fix where a block is.
const FIXED_BY: usize = 3;

/// Camera positions against the block.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PositionFit {
    /// Standard deviations that the block suggests, horizontal and vertical, metres.
    pub sigma_m: [f64; 2],
    /// Over how many photos errors stay alike, horizontally and vertically.
    pub together: [f64; 2],
    /// Images whose positions are far out, with the distance, metres.
    pub outliers: Vec<(u32, f64)>,
}

/// Over how many of its values a series stays alike: the integrated autocorrelation `1 + 2 sum rho_k`, up to the first
/// lag at which it is gone.
///
/// Reference: C. J. Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7 (1992).
fn correlation_length(series: &[Vec<f64>]) -> f64 {
    let longest = series.iter().map(Vec::len).max().unwrap_or(0);
    let at_lag = |lag: usize| -> f64 {
        let product = |values: &Vec<f64>| {
            values.iter().zip(values.iter().skip(lag)).map(|(a, b)| a * b).sum::<f64>()
        };
        series.iter().map(product).sum()
    };
    let variance = at_lag(0);
    let shares = (1..longest / 2).map(|lag| at_lag(lag) / variance.max(f64::MIN_POSITIVE));
    1.0 + 2.0 * shares.take_while(|&share| share > 0.0).sum::<f64>()
}

/// How camera positions whose accuracy nobody has told fit the block: robust standard deviations, and
/// positions that are beyond five of them, which are taken out.
///
/// Errors of a receiver drift: neighbours have nearly the same one, and together they would outweigh control that fixes the
/// block far better. Where there is control, standard deviations are made larger by the root of how long errors stay
/// alike. `told` are those that somebody has told, image by image.
pub fn weigh_positions(
    block: &Block<'_>,
    known: &mut Known,
    told: &[Option<[f64; 3]>],
) -> Option<PositionFit> {
    let left = |position: &CameraPosition| -> Option<[f64; 3]> {
        let centre = block.poses[position.image as usize]?.centre_m();
        Some(std::array::from_fn(|k| position.position_m[k] - centre[k]))
    };
    let all: Vec<[f64; 3]> = known.positions.iter().filter_map(left).collect();
    if all.len() < 4 {
        return None;
    }
    let scale = |axes: &[usize]| {
        let values = all.iter().flat_map(|d| axes.iter().map(|&k| d[k].abs())).collect();
        (1.4826 * median(values)).max(0.01)
    };
    let sigma_m = [scale(&[0, 1]), scale(&[2])];
    let mut outliers = Vec::new();
    for position in &mut known.positions {
        if let Some(&Some(sigma_m)) = told.get(position.image as usize) {
            position.sigma_m = sigma_m;
            continue;
        }
        position.sigma_m = [sigma_m[0], sigma_m[0], sigma_m[1]];
        if let Some(d) = left(position) {
            let far = (0..3).any(|k| d[k].abs() > 5.0 * position.sigma_m[k]);
            if far {
                let distance = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
                outliers.push((position.image, distance));
            }
        }
    }
    known.positions.retain(|p| !outliers.iter().any(|(image, _)| *image == p.image));
    let mut together = [1.0; 2];
    if known.ground.iter().filter(|point| point.role == Role::Control).count() >= FIXED_BY {
        let mut ordered: Vec<(u32, [f64; 3])> =
            known.positions.iter().filter_map(|p| Some((p.image, left(p)?))).collect();
        ordered.sort_by_key(|(image, _)| *image);
        let axis = |k: usize| -> Vec<f64> {
            let mean = ordered.iter().map(|(_, d)| d[k]).sum::<f64>() / ordered.len().max(1) as f64;
            ordered.iter().map(|(_, d)| d[k] - mean).collect()
        };
        together = [correlation_length(&[axis(0), axis(1)]), correlation_length(&[axis(2)])];
        for position in &mut known.positions {
            for (k, sigma) in position.sigma_m.iter_mut().enumerate() {
                *sigma *= together[usize::from(k == 2)].sqrt();
            }
        }
    }
    Some(PositionFit { sigma_m, together, outliers })
}

/// Adjusts a block with what is known, without judging it, and renews its points.
///
/// # Errors
/// Where the block cannot be evaluated.
pub fn adjust(
    block: &mut Block<'_>,
    known: &Known,
    tie_sigma_px: f64,
    demands: &TriangulationOptions,
    iterations: u64,
) -> Result<(), SolveError> {
    forget_lost(block, known);
    let (mut survey, tracks, order) = block.reconstruction(None);
    known.attach(&mut survey, &order);
    survey.tie_sigma_px = tie_sigma_px;
    keep_feasible_marks(&mut survey);
    let options =
        BundleAdjustmentOptions { loss: Loss::SoftL1(2.0), iterations, cost_tolerance: 1e-6 };
    let free = survey.images.len();
    bundle_adjust(&mut survey, free, &options)?;
    block.take(&survey, &tracks, &order);
    retriangulate_and_filter(block, demands);
    Ok(())
}

/// The fewest places in an image that tell its pose.
const LEAST_SEEN: usize = 3;

/// Images that have lost their points leave the block: nothing says any more where they are.
fn forget_lost(block: &mut Block<'_>, known: &Known) {
    for image in 0..block.poses.len() {
        let seen = block.tracks.in_image(image).iter().filter(|(track, place)| {
            block.used[*place as usize] && block.points[*track as usize].is_some()
        });
        let marks = known.marks.iter().filter(|mark| mark.image as usize == image);
        if block.poses[image].is_some() && seen.count() + marks.count() < LEAST_SEEN {
            tracing::debug!("image {} has lost its points, and leaves the block", image + 1);
            block.forget(image);
        }
    }
}

/// Goes through all tracks as [`Block::retriangulate`] does, and leaves out the points that stand alone.
pub fn retriangulate_and_filter(block: &mut Block<'_>, demands: &TriangulationOptions) {
    let all = block.all_tracks();
    let points = block.retriangulate(&all, demands);
    let alone = depth_outliers::remove_depth_outliers(block);
    tracing::debug!("{alone} of {points} points stand alone: left out");
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn errors_that_drift_are_alike_for_as_long_as_they_do() {
        // Of a first-order autoregression, (1 + phi) / (1 - phi) on average.
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for (phi, expected) in [(0.0, 1.0), (0.5, 3.0), (0.9, 19.0)] {
            let mut series = || {
                let mut value = 0.0;
                let step = |_| {
                    value = phi * value + rng.random_range(-1.0..1.0);
                    value
                };
                (0..3000).map(step).collect::<Vec<f64>>()
            };
            let found = correlation_length(&[series(), series()]);
            assert!((found / expected - 1.0).abs() < 0.35, "{phi}: {found}");
        }
        // Too short to tell, or all the same.
        assert_eq!(correlation_length(&[vec![1.0, -1.0]]), 1.0);
        assert_eq!(correlation_length(&[vec![0.0; 20]]), 1.0);
        assert_eq!(correlation_length(&[]), 1.0);
    }
}
