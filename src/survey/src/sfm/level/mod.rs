//! Which way is down, where only a receiver tells places.
//!
//! Heights of receivers drift with air pressure, jump with the set of satellites, are constant or missing. Cameras whose
//! orientation a gimbal tells know better, those of a flight that looks down too, and so does a flight at constant height:
//!
//! ```text
//! axes       d_i       = (a, b) + R(k_i) m + e_i            m: how the camera hangs, a few degrees
//! flatness   h_i       = -a x_i - b y_i - c + f_i
//! receiver   z_i - h_i =  a x_i + b y_i + c + g(t_i) + r_i  g: none, a drift, or a jump
//! ```
//!
//! with `(a, b)` the slope by which the block is still off level, `d_i` the slopes of what each camera takes for the vertical (its
//! optical axis, where no gimbal tells better), `k_i` the headings,
//! `h_i` the heights of the cameras in the block, in metres, `z_i` those of the receiver, `t_i` the place in the flight. The
//! error `g` is the one with the least `n ln s^2 + misfit + p ln n` (G. Schwarz, "Estimating the dimension of a model",
//! Annals of Statistics 6, 1978), the prior slope of axes and flatness having heavy tails, because a camera may be mounted obliquely.

mod heights;
pub(super) mod plan;

pub use heights::HeightError;
use rowgram_optim::robust::median;

use super::{
    block::Block,
    georeference::{fixes_vertical, min_receiver_error_m},
};
use crate::{
    problems::adjustment::{ATTITUDE_BIAS_SIGMA_RAD, Alignment},
    scene::{CameraPosition, Pose, Reconstruction},
};
use heights::{HeightAccuracy, HeightFit, Sample, Slope, plane, review_heights, robust_sigma};
use nalgebra::{Matrix2, Matrix3, Matrix4, Rotation3, Vector2, Vector3, Vector4};
use plan::PlanFit;
use rowgram_optim::geometry::rotation;

/// Axes that differ from their middle by more than this in half of the photos are those of no flight that looks down.
const LOOKS_DOWN_RAD: f64 = 0.35;
/// How far from level a camera hangs in its mount.
const MOUNT_RAD: f64 = 0.05;
/// What the middle of many axes is still off by.
const AXES_RAD: f64 = 0.007;
/// How far from level a flight at constant height is.
const FLATNESS_RAD: f64 = 0.03;

/// A receiver's heights against a block that is level.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightReview {
    /// What is wrong with them.
    pub error: HeightError,
    /// From the least to the greatest of that error, metres.
    pub range_m: f64,
    /// By how much they scatter besides, at least their stated standard deviation, metres.
    pub sigma_m: f64,
    /// The angle by which they alone would have tilted the block, radians.
    pub tilt_rad: f64,
    /// That angle in standard deviations of what heights and all else say of the vertical.
    pub tilt_sigmas: f64,
    /// What is to be taken off them, photo by photo in the order of the block; 0 for photos without a height.
    pub correction_m: Vec<f64>,
    usual_m: f64,
}

impl HeightReview {
    /// What is to be taken off at a place in the flight, metres.
    pub fn error_m(&self, place: f64) -> f64 {
        self.error.at(place) - self.usual_m
    }
}

/// The vertical in each image's camera frame: as its gimbal tells it, else as if it looked straight down.
fn verticals(survey: &Reconstruction) -> Vec<[f64; 3]> {
    let up = [0.0, 0.0, 1.0];
    let mut verticals = vec![up; survey.images.len()];
    for observed in &survey.orientations {
        verticals[observed.image as usize] = rotation::rotate(observed.rotation, up);
    }
    verticals
}

/// The middle of what cameras take for the vertical, and the median angle from it; `None` without images.
pub fn mean_up(survey: &Reconstruction) -> Option<(Vector3<f64>, f64)> {
    let axes: Vec<Vector3<f64>> = survey
        .images
        .iter()
        .zip(verticals(survey))
        .map(|(image, vertical)| {
            let back = rotation::inverse(image.pose.rotation);
            Vector3::from(rotation::rotate(back, vertical))
        })
        .collect();
    let mut up = axes.iter().sum::<Vector3<f64>>();
    for _ in 0..5 {
        if up.norm() < 1e-9 {
            return None;
        }
        up.normalize_mut();
        let weight = |axis: &Vector3<f64>| 1.0 / axis.angle(&up).max(0.02);
        up = axes.iter().map(|axis| weight(axis) * axis).sum();
    }
    let up = up.try_normalize(1e-9)?;
    Some((up, median(axes.iter().map(|axis| axis.angle(&up)))?))
}

/// The angle between the vertical and the middle of the axes of a flight that looks down, radians.
pub fn tilt_rad(survey: &Reconstruction) -> Option<f64> {
    let (up, spread) = mean_up(survey)?;
    (spread < LOOKS_DOWN_RAD).then(|| up.angle(&Vector3::z()))
}

/// What the axes say of the slope; the survey's frame is nearly level.
fn slope_of_axes(survey: &Reconstruction) -> Slope {
    let rows: Vec<(Vector2<f64>, [f64; 2])> = survey
        .images
        .iter()
        .zip(verticals(survey))
        .map(|(image, vertical)| {
            let back = rotation::inverse(image.pose.rotation);
            let axis = rotation::rotate(back, vertical);
            let right = rotation::rotate(back, [1.0, 0.0, 0.0]);
            let length = right[0].hypot(right[1]).max(1e-9);
            let up = axis[2].max(0.2);
            (Vector2::new(axis[0] / up, axis[1] / up), [right[0] / length, right[1] / length])
        })
        .collect();
    let (mut x, mut sigma) = (Vector4::zeros(), MOUNT_RAD);
    let mut information = Matrix4::identity();
    for _ in 0..6 {
        information = Matrix4::zeros();
        (2..4).for_each(|k| information[(k, k)] = MOUNT_RAD.powi(-2));
        let mut sum = Vector4::zeros();
        let mut left = Vec::new();
        for (d, [c, s]) in &rows {
            let row = [Vector4::new(1.0, 0.0, *c, -s), Vector4::new(0.0, 1.0, *s, *c)];
            let off = [d[0] - row[0].dot(&x), d[1] - row[1].dot(&x)];
            left.extend(off);
            let weight = (2.0 * sigma / off[0].hypot(off[1]).max(1e-12)).min(1.0) / (sigma * sigma);
            for k in 0..2 {
                information += weight * row[k] * row[k].transpose();
                sum += weight * row[k] * d[k];
            }
        }
        x = information.try_inverse().map_or(x, |inverse| inverse * sum);
        sigma = robust_sigma(left.into_iter(), 2).max(0.005);
    }
    let covariance = information.try_inverse().unwrap_or_else(Matrix4::identity);
    let of_slope: Matrix2<f64> = covariance.fixed_view::<2, 2>(0, 0).into_owned();
    let information = of_slope.try_inverse().unwrap_or_else(Matrix2::identity);
    let has_gimbal = 2 * survey.orientations.len() > survey.images.len();
    let common_rad = if has_gimbal { ATTITUDE_BIAS_SIGMA_RAD[0] } else { AXES_RAD };
    Slope { value: Vector2::new(x[0], x[1]), information }.with_common_error(common_rad)
}

/// Positions of a survey as samples: height left between receiver and block, and the images' places.
fn samples(survey: &Reconstruction, places: &[f64], middle: [f64; 2]) -> Vec<Sample> {
    let sample = |position: &CameraPosition| {
        let image = position.image as usize;
        let centre = survey.images[image].pose.centre_m();
        Sample {
            plan: [centre[0] - middle[0], centre[1] - middle[1]],
            place: places[image],
            height: position.position_m[2] - centre[2],
        }
    };
    survey.positions.iter().map(sample).collect()
}

impl HeightAccuracy {
    /// Of positions with stated accuracies, where these say more of the vertical than cameras do; else as of any others.
    fn stated(survey: &Reconstruction) -> HeightAccuracy {
        let sigma_m = median(survey.positions.iter().map(|position| position.sigma_m[2]));
        let positions: Vec<[f64; 3]> = survey.positions.iter().map(|p| p.position_m).collect();
        let fixing = sigma_m.filter(|&sigma_m| fixes_vertical(sigma_m, &positions));
        fixing.map_or_else(HeightAccuracy::default, |sigma_m| HeightAccuracy {
            min_sigma_m: sigma_m,
            min_error_m: min_receiver_error_m(sigma_m, &positions),
        })
    }
}

fn middle(survey: &Reconstruction) -> [f64; 2] {
    let n = survey.images.len().max(1) as f64;
    let sum = survey.images.iter().map(|image| image.pose.centre_m());
    let sum = sum.fold([0.0; 2], |s, c| [s[0] + c[0], s[1] + c[1]]);
    sum.map(|v| v / n)
}

/// Brings a flight that looks down into the frame of its camera positions, level whatever their heights are. `places` says
/// for each image of the survey where in the flight it was taken, 0 to 1; `is_stated` whether the accuracies of its positions are
/// stated. `None`, and nothing changed, where it neither looks down nor has a gimbal that tells how it looks, or has too few positions.
pub fn level(
    survey: &mut Reconstruction,
    places: &[f64],
    is_stated: bool,
) -> Option<(Alignment, HeightReview)> {
    let (mut up, spread) = mean_up(survey)?;
    if spread > LOOKS_DOWN_RAD || survey.positions.len() < 2 {
        return None;
    }
    let start = survey.clone();
    let accuracy =
        if is_stated { HeightAccuracy::stated(survey) } else { HeightAccuracy::default() };
    let mut found = None;
    for _ in 0..4 {
        *survey = start.clone();
        let side = if up.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
        let e1 = up.cross(&side).normalize();
        let turn = Matrix3::from_rows(&[e1.transpose(), up.cross(&e1).transpose(), up.transpose()]);
        let pairs: Vec<([f64; 2], [f64; 2])> = survey
            .positions
            .iter()
            .map(|p| {
                let at = turn * Vector3::from(survey.images[p.image as usize].pose.centre_m());
                ([at.x, at.y], [p.position_m[0], p.position_m[1]])
            })
            .collect();
        let Some((fit, inside)) = PlanFit::robust(&pairs) else {
            *survey = start;
            return None;
        };
        let scale = fit.factor[0].hypot(fit.factor[1]);
        let heading = fit.factor[1].atan2(fit.factor[0]);
        let turn = *Rotation3::from_axis_angle(&Vector3::z_axis(), heading).matrix() * turn;
        survey.transform(scale, &turn, &Vector3::new(fit.shift[0], fit.shift[1], 0.0));
        let at = middle(survey);
        let heights = samples(survey, places, at);
        let prior = prior(survey, at);
        let review = review_heights(&heights, prior, &accuracy)?;
        let alone = plane(&heights);
        // The vertical in the frame of the start.
        let slope = review.slope;
        up = turn.transpose() * Vector3::new(slope[0], slope[1], 1.0).normalize();
        found = Some((pairs, fit, inside, review, alone, scale));
    }
    let (pairs, fit, inside, review, alone, scale) = found?;
    // Where most of the heights have it, as they are corrected: positions that are all off by the same have no weight, and the
    // plan alone hardly tells a tilt.
    let up_shift = review.constant + usual_error(survey, places, review.error);
    for image in &mut survey.images {
        let mut centre = image.pose.centre_m();
        centre[2] += up_shift;
        image.pose = Pose::from_centre(image.pose.rotation, centre);
    }
    survey.points.iter_mut().for_each(|point| point.position_m[2] += up_shift);
    let name = |k: usize| survey.images[survey.positions[k].image as usize].name.clone();
    let left: Vec<f64> = pairs.iter().map(|pair| fit.left(pair)).collect();
    let used: Vec<usize> = (0..pairs.len()).filter(|&k| inside[k]).collect();
    let squares: f64 = used.iter().map(|&k| left[k] * left[k]).sum();
    let alignment = Alignment {
        by: "camera positions",
        scale,
        used: used.iter().map(|&k| name(k)).collect(),
        misfits: (0..pairs.len()).filter(|&k| !inside[k]).map(|k| (name(k), left[k])).collect(),
        rmse_m: (squares / used.len().max(1) as f64).sqrt(),
    };
    let tilt = alone.as_ref().map_or([0.0; 2], |alone| tilt_against(alone, &review));
    let mut review = corrected(survey, places, review, tilt);
    if is_stated && !survey.orientations.is_empty() && review.error == HeightError::Constant {
        // Told heights and the gimbal are weighed in the adjustment.
        review.correction_m.fill(0.0);
    }
    Some((alignment, review))
}

/// What axes and flatness say of the slope of a frame.
fn prior(survey: &Reconstruction, middle: [f64; 2]) -> Slope {
    let axes = slope_of_axes(survey);
    let heights: Vec<Sample> = survey
        .images
        .iter()
        .map(|image| {
            let c = image.pose.centre_m();
            Sample { plan: [c[0] - middle[0], c[1] - middle[1]], place: 0.0, height: -c[2] }
        })
        .collect();
    let Some(flat) = plane(&heights) else { return axes };
    let flat = Slope { value: flat.slope, information: flat.information };
    let flat = flat.with_common_error(FLATNESS_RAD);
    let apart = axes.value - flat.value;
    let variance = axes.information.try_inverse().zip(flat.information.try_inverse());
    let agrees = variance
        .and_then(|(a, b)| (a + b).try_inverse())
        .is_none_or(|weight| apart.dot(&(weight * apart)) < 9.0);
    if agrees { axes.and(flat) } else { axes }
}

/// Heights of positions against a block that is level and in its place by something better. Their errors along the flight are
/// larger than `least_error_m`.
pub fn review_level(
    survey: &Reconstruction,
    places: &[f64],
    least_error_m: f64,
) -> Option<HeightReview> {
    if survey.positions.len() < 4 {
        return None;
    }
    let heights = samples(survey, places, middle(survey));
    let fixed = Slope { value: Vector2::zeros(), information: 1e12 * Matrix2::identity() };
    let accuracy = HeightAccuracy { min_error_m: least_error_m, ..HeightAccuracy::default() };
    let review = review_heights(&heights, fixed, &accuracy)?;
    if review.error == HeightError::Constant {
        return None;
    }
    Some(corrected(survey, places, review, [0.0; 2]))
}

/// The angle between the vertical of heights alone and that of heights and all else, radians, and in its standard deviations.
fn tilt_against(alone: &HeightFit, all: &HeightFit) -> [f64; 2] {
    let apart = alone.slope - all.slope;
    let covariance = |fit: &HeightFit| fit.information.try_inverse().unwrap_or_else(Matrix2::zeros);
    // All are the best of heights and the rest: the covariance of the difference is the difference of the covariances.
    let difference = covariance(alone) - covariance(all);
    let variance = apart.dot(&(difference * apart)) / apart.norm_squared().max(1e-300);
    let sigmas = if variance > 0.0 { apart.norm() / variance.sqrt() } else { 0.0 };
    [apart.norm().atan(), sigmas]
}

/// The error that most heights have, metres: the part of the flight that most of it agrees with is taken to be right.
fn usual_error(survey: &Reconstruction, places: &[f64], error: HeightError) -> f64 {
    let of = survey.positions.iter().map(|position| error.at(places[position.image as usize]));
    median(of).unwrap_or(0.0)
}

/// What is to be taken off the heights so that they say what the block does of the vertical.
fn corrected(
    survey: &Reconstruction,
    places: &[f64],
    fit: HeightFit,
    [tilt_rad, tilt_sigmas]: [f64; 2],
) -> HeightReview {
    let at = middle(survey);
    let mut heights = samples(survey, places, at);
    let errors: Vec<f64> = heights.iter().map(|sample| fit.error.at(sample.place)).collect();
    let usual = usual_error(survey, places, fit.error);
    for (sample, error) in heights.iter_mut().zip(&errors) {
        sample.height -= error - usual;
    }
    let rest = plane(&heights).map_or(Vector2::zeros(), |fit| fit.slope);
    let mut correction_m = vec![0.0; survey.images.len()];
    for ((position, sample), error) in survey.positions.iter().zip(&heights).zip(&errors) {
        let slope = rest[0] * sample.plan[0] + rest[1] * sample.plan[1];
        correction_m[position.image as usize] = error - usual + slope;
    }
    let most = errors.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let least = errors.iter().copied().fold(f64::INFINITY, f64::min);
    HeightReview {
        error: fit.error,
        range_m: (most - least).max(0.0),
        sigma_m: fit.sigma,
        tilt_rad,
        tilt_sigmas,
        correction_m,
        usual_m: usual,
    }
}

/// For each image where in the flight it was taken, 0 to 1.
pub fn places(order: &[usize], block: &Block<'_>) -> Vec<f64> {
    let mut places = vec![0.0; block.features.len()];
    let last = order.len().saturating_sub(1).max(1) as f64;
    for (rank, &image) in order.iter().enumerate() {
        if let Some(place) = places.get_mut(image) {
            *place = rank as f64 / last;
        }
    }
    places
}
