//! Blocks with a frame of their own come into the frame of the map: by control points or camera
//! positions, each by its own similarity; then fragments are one block, tied by the tracks they share.

pub use super::positions::{PositionFit, weigh_positions};
use rowgram_optim::robust::median;

pub use super::control::{axes_exchanged, control_left_m};

pub use super::mark_reading::{MarkReading, MarkReview, WrongMark, review_marks};

use super::{
    block::Block,
    bundle::{BundleAdjustmentOptions, bundle_adjust},
    depth_outliers,
    level::{self, HeightReview},
    triangulate::TriangulationOptions,
    weak_control,
};
use crate::{
    problems::adjustment::{Alignment, align},
    scene::{
        CameraOrientation, CameraPosition, GroundObservation, GroundPoint, Reconstruction, Role,
    },
};
use nalgebra::{Matrix3, Vector3};
use rowgram_optim::{engine::SolveError, geometry::rotation, nlls::Loss};

/// What is known on the ground and in the air; images by their index in the block.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Known {
    /// Ground points.
    pub ground: Vec<GroundPoint>,
    /// Their marks.
    pub marks: Vec<GroundObservation>,
    /// Camera positions.
    pub positions: Vec<CameraPosition>,
    /// Camera orientations.
    pub orientations: Vec<CameraOrientation>,
    /// Names of control points that are never left out.
    pub keep: Vec<String>,
    /// Whether the accuracies of most positions were told.
    pub told_positions: bool,
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
    /// The heights of the camera positions against the block, where it could be brought level without them.
    pub heights: Option<HeightReview>,
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
        survey.orientations = self
            .orientations
            .iter()
            .filter_map(|known| Some(CameraOrientation { image: place(known.image)?, ..*known }))
            .collect();
    }

    /// Without anything on the ground.
    pub fn without_control(&mut self) {
        self.ground.clear();
        self.marks.clear();
        self.keep.clear();
    }

    /// Whether there are control points with all coordinates.
    pub fn has_control(&self) -> bool {
        self.ground.iter().any(|point| point.role == Role::Control)
    }
}

/// Positions whose second principal spread is below this share of the first do not tell a tilt about their line.
pub(in crate::sfm) const NEARLY_A_LINE: f64 = 0.1;

/// Standard deviations of some positions along their principal directions, the largest first, metres.
fn principal_spreads_m(positions: &[[f64; 3]]) -> [f64; 3] {
    let n = positions.len().max(1) as f64;
    let mean = positions.iter().map(|p| Vector3::from(*p)).sum::<Vector3<f64>>() / n;
    let mut moments = Matrix3::zeros();
    for p in positions {
        let d = Vector3::from(*p) - mean;
        moments += d * d.transpose() / n;
    }
    let mut values: Vec<f64> = moments.symmetric_eigenvalues().iter().copied().collect();
    values.sort_by(f64::total_cmp);
    [2, 1, 0].map(|k| values[k].max(0.0).sqrt())
}

/// Ratio of the second to the first principal spread of some positions.
pub(super) fn spread_across(positions: &[[f64; 3]]) -> f64 {
    let [first, second, _] = principal_spreads_m(positions);
    second / first.max(1e-150)
}

/// A tilt that told heights fix better than this is theirs: the optical axes of a flight tell it no better, radians.
const TILT_BY_AXES_RAD: f64 = 0.002;
/// A free block is bent by up to this share of its extent: positions that leave more than that and their accuracies are wrong.
const BENT: f64 = 0.02;
/// Told accuracies are exceeded by errors of up to so many of them.
const TOLD_RATIO: f64 = 10.0;

/// The smallest error, metres, that is the receiver's where its stated standard deviation is this: smaller ones bend a free block.
pub(super) fn min_receiver_error_m(sigma_m: f64, positions: &[[f64; 3]]) -> f64 {
    (TOLD_RATIO * sigma_m).max(BENT * principal_spreads_m(positions)[0])
}

/// Whether heights with this stated standard deviation fix the vertical better than the optical axes of a flight do.
pub(super) fn fixes_vertical(sigma_m: f64, positions: &[[f64; 3]]) -> bool {
    let [along, across, _] = principal_spreads_m(positions);
    let tilt_rad = sigma_m / (across * (positions.len() as f64).sqrt()).max(1e-9);
    positions.len() >= 4 && across >= NEARLY_A_LINE * along && tilt_rad <= TILT_BY_AXES_RAD
}

/// By positions whose told accuracies fix all of how a block lies, as those of a receiver with fixed ambiguities do: believed
/// whatever the cameras' axes say. `None`, and nothing changed, where they do not, or where positions and block contradict.
fn align_told(survey: &mut Reconstruction) -> Option<Alignment> {
    let positions: Vec<[f64; 3]> = survey.positions.iter().map(|p| p.position_m).collect();
    let sigma_m = median(survey.positions.iter().map(|p| p.sigma_m[2]))?;
    if !fixes_vertical(sigma_m, &positions) {
        return None;
    }
    let mut trial = survey.clone();
    let alignment = align(&mut trial)?;
    if alignment.rmse_m > min_receiver_error_m(sigma_m, &positions) {
        return None;
    }
    *survey = trial;
    Some(alignment)
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
    survey.transform(scale, &turn, &shift);
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

/// Brings a survey into the frame of what is known of it. Control that leaves a tilt open comes after positions.
fn georeference(
    survey: &mut Reconstruction,
    places: &[f64],
    told_positions: bool,
) -> Option<(Alignment, Option<HeightReview>)> {
    if weak_control::is_weak(survey) != Some(true) {
        return georeference_by_all(survey, places, told_positions);
    }
    let known = (std::mem::take(&mut survey.ground), std::mem::take(&mut survey.marks));
    let mut found = georeference_by_all(survey, places, told_positions);
    (survey.ground, survey.marks) = known;
    if let Some((alignment, _)) = &mut found {
        weak_control::settle(survey, alignment);
    }
    found
}

fn georeference_by_all(
    survey: &mut Reconstruction,
    places: &[f64],
    told_positions: bool,
) -> Option<(Alignment, Option<HeightReview>)> {
    let mut trial = survey.clone();
    let first = align(&mut trial);
    let by_positions = first.as_ref().is_none_or(|alignment| alignment.by == "camera positions");
    if by_positions
        && told_positions
        && let Some(alignment) = align_told(survey)
    {
        return Some((alignment, None));
    }
    if by_positions && let Some((alignment, review)) = level::level(survey, places, told_positions)
    {
        return Some((alignment, Some(review)));
    }
    let measured: Vec<[f64; 3]> = survey.positions.iter().map(|p| p.position_m).collect();
    if by_positions && measured.len() >= 2 && spread_across(&measured) < NEARLY_A_LINE {
        return Some((align_strip(survey)?, None));
    }
    let alignment = first?;
    *survey = trial;
    Some((alignment, None))
}

/// Places in the flight of some images of a block.
fn places_of(places: &[f64], order: &[usize]) -> Vec<f64> {
    order.iter().map(|&image| places.get(image).copied().unwrap_or(0.0)).collect()
}

/// Heights without stated accuracy that are off by less than this along a flight may be those of a bent block, metres.
const LEAST_HEIGHT_ERROR_M: f64 = 3.0;

/// Takes off camera positions what a review found in their heights; those of images that it did not see get what it
/// says of their place in the flight.
fn correct_heights(
    positions: &mut [CameraPosition],
    review: &HeightReview,
    order: &[usize],
    places: &[f64],
) {
    for position in positions {
        let image = position.image as usize;
        let known = order.iter().position(|&k| k == image).map(|k| review.correction_m[k]);
        let place = places.get(image).copied().unwrap_or(0.0);
        position.position_m[2] -= known.unwrap_or_else(|| review.error_m(place));
    }
}

/// Brings blocks into the frame of the map and makes them one; those that nothing places stay out. `flight` is the images
/// in the order in which they were taken.
///
/// `None` where there is no block at all.
pub fn join<'a>(
    mut blocks: Vec<Block<'a>>,
    known: &mut Known,
    flight: &[usize],
    demands: &TriangulationOptions,
) -> Option<Joined<'a>> {
    let places = level::places(flight, blocks.first()?);
    let mut alignments = Vec::new();
    let mut heights = None;
    for block in &mut blocks {
        let (mut survey, _, order) = block.reconstruction(None);
        known.attach(&mut survey, &order);
        let mut alignment = None;
        if let Some((found, review)) =
            georeference(&mut survey, &places_of(&places, &order), known.told_positions)
        {
            for (image, &index) in survey.images.iter().zip(&order) {
                block.poses[index] = Some(image.pose);
            }
            alignment = Some(found);
            if let (Some(review), None) = (review, &heights) {
                correct_heights(&mut known.positions, &review, &order, &places);
                heights = Some(review);
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
    let by = |what: &str| alignments.iter().flatten().any(|of| of.by.ends_with(what));
    let position_shift_m = if by("control points") {
        remove_common_offset(&block, &mut known.positions)
    } else {
        None
    };
    if alignments.iter().flatten().any(|of| of.by == "control points") {
        let (mut survey, _, order) = block.reconstruction(None);
        known.attach(&mut survey, &order);
        let stated_m = median(known.positions.iter().map(|position| position.sigma_m[2]));
        let stated_m = stated_m.filter(|_| known.told_positions);
        let least_m = stated_m.map_or(LEAST_HEIGHT_ERROR_M, |sigma_m| TOLD_RATIO * sigma_m);
        heights = level::review_level(&survey, &places_of(&places, &order), least_m);
        if let Some(review) = &heights {
            correct_heights(&mut known.positions, review, &order, &places);
        }
    }
    weak_control::fill_unknown_coordinates(&block, known);
    Some(Joined { block, alignments, georeferenced, position_shift_m, heights })
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
    let shift: [f64; 3] = std::array::from_fn(|k| median(left.iter().map(|d| d[k])).unwrap_or(0.0));
    for position in positions.iter_mut() {
        (0..3).for_each(|k| position.position_m[k] -= shift[k]);
    }
    Some(shift)
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
