//! A shutter that reads its rows one after the other while the camera flies: the block grows without it
//! (over flat ground it is nearly an affinity of all photos, which their poses and points share), but as soon
//! as control and camera positions fix the ground, it pulls at them.
//!
//! ```text
//! P = R X + t + tau s       tau: share of the readout, -1/2 .. 1/2;   s = -R d l
//! ```
//!
//! `d` is the direction in which an image flew, by the images before and after it, `l` the way of one readout:
//! one number for all images that fly equally fast. Every image has its own shift about that.

use super::{block::Block, georeference::Known};
use crate::{
    camera::Lens,
    engine::SolveError,
    geometry::rotation,
    nlls::{Loss, Options as Engine, solve},
    problems::adjustment::{Mark, Posed, RollingShutter, Settings, Survey},
};
use nalgebra::Vector3;

/// What a rolling shutter does to a block.
#[derive(Debug, Clone, PartialEq)]
pub struct Drift {
    /// How far a camera flies while one photo is read, metres.
    pub way_m: f64,
    /// The same on the ground, pixels.
    pub way_px: f64,
    /// Standard deviation of single images about it, metres.
    pub spread_m: f64,
    /// By how much it lowers the cost, in units of the variance factor.
    pub gain: f64,
    /// Images whose direction is known.
    pub images: usize,
    /// The shift of every image while it is read, in its camera frame; metres.
    pub shifts_m: Vec<[f64; 3]>,
}

/// Standard deviation of shifts of which nothing is known yet, as a share of the distance of the ground.
const ANY: f64 = 0.02;
/// Standard deviation of single images about the common way, as a share of it.
const GUSTS: f64 = 0.1;
/// The fewest images whose direction must be known.
const LEAST_IMAGES: usize = 6;
/// The gain that each of the new numbers must be worth.
const WORTH: f64 = 4.0;
/// The common way must be this many times its standard deviation.
const SURE: f64 = 5.0;
/// And longer than this on the ground, pixels.
const LEAST_PX: f64 = 0.5;
/// Pieces of the flight are straight where they turn by less than this, as a cosine.
const STRAIGHT: f64 = 0.87;

/// Unit vectors along which images flew, in the world; `centres_m` in the order of the flight. `None` where
/// an image has no neighbour on a straight piece.
pub fn directions(centres_m: &[[f64; 3]]) -> Vec<Option<[f64; 3]>> {
    let pieces: Vec<Option<Vector3<f64>>> = centres_m
        .windows(2)
        .map(|pair| (Vector3::from(pair[1]) - Vector3::from(pair[0])).try_normalize(1e-9))
        .collect();
    let straight = |k: usize| -> Option<Vector3<f64>> {
        let own = pieces[k]?;
        let along = |other: Option<&Option<Vector3<f64>>>| {
            other.copied().flatten().is_some_and(|other| own.dot(&other) > STRAIGHT)
        };
        (along(k.checked_sub(1).and_then(|k| pieces.get(k))) || along(pieces.get(k + 1)))
            .then_some(own)
    };
    (0..centres_m.len())
        .map(|k| {
            let before = k.checked_sub(1).and_then(straight);
            let after = if k < pieces.len() { straight(k) } else { None };
            let sum = before.unwrap_or_default() + after.unwrap_or_default();
            sum.try_normalize(1e-9).map(Into::into)
        })
        .collect()
}

/// The drift of a georeferenced block; `flight` holds its images in the order in which they were taken.
/// `None` where nothing speaks for one (unless somebody is `certain` that there is), or too few images for it
/// to be told.
///
/// # Errors
/// Where the block cannot be evaluated.
pub fn find(
    block: &Block<'_>,
    known: &Known,
    flight: &[usize],
    tie_sigma_px: f64,
    readout_s: f64,
    certain: bool,
) -> Result<Option<Drift>, SolveError> {
    let (mut survey, _, order) = block.survey(None);
    known.attach(&mut survey, &order);
    survey.tie_sigma_px = tie_sigma_px;
    keep_feasible_marks(&mut survey);
    let place = |image: usize| order.iter().position(|&k| k == image);
    let flown: Vec<usize> = flight.iter().filter_map(|&image| place(image)).collect();
    let centres: Vec<[f64; 3]> = flown.iter().map(|&k| survey.images[k].pose.centre_m()).collect();
    let mut along: Vec<Option<[f64; 3]>> = vec![None; survey.images.len()];
    flown.iter().zip(directions(&centres)).for_each(|(&k, direction)| along[k] = direction);
    let images = along.iter().flatten().count();
    let (Some(distance_m), true) = (distance_m(&survey), images >= LEAST_IMAGES) else {
        return Ok(None);
    };
    let still = settle(&mut survey.clone())?;
    let mut moving = survey;
    let shutter = |sigma_m: f64| RollingShutter {
        readout_s,
        sigma_velocity_m_s: sigma_m / readout_s,
        sigma_rate_rad_s: 0.0,
    };
    moving.rolling_shutter = Some(shutter(ANY * distance_m));
    let mut cost = settle(&mut moving)?;
    let (mut way_m, mut spread_m) = common(&moving, &along);
    for _ in 0..3 {
        for (image, direction) in moving.images.iter_mut().zip(&along) {
            let flown = direction.unwrap_or_default().map(|v| -v * way_m);
            let shift = rotation::rotate(image.pose.rotation, flown);
            image.motion[3..].copy_from_slice(&shift);
        }
        let sigma_m = (GUSTS * way_m.abs()).max(1e-4 * distance_m);
        moving.rolling_shutter = Some(shutter(sigma_m));
        cost = settle(&mut moving)?;
        (way_m, spread_m) = common(&moving, &along);
    }
    let freedom = moving.observations.len() as f64 * 2.0
        - 3.0 * moving.points.len() as f64
        - 9.0 * moving.images.len() as f64;
    let variance = (2.0 * cost / freedom.max(1.0)).max(1e-12);
    let gain = 2.0 * (still - cost) / variance;
    let principal_distance_px =
        moving.cameras.iter().map(|c| c.interior.principal_distance_px()).fold(0.0, f64::max);
    let way_px = way_m * principal_distance_px / distance_m;
    let deviation = spread_m / (images as f64).sqrt();
    let sure = certain
        || gain > WORTH * 3.0 * moving.images.len() as f64
            && way_m > SURE * deviation
            && way_px > LEAST_PX;
    tracing::debug!(
        "rolling shutter: {way_m:.3} m ({way_px:.1} px) +- {spread_m:.3} in a readout, gain {gain:.0}{}",
        if sure { "" } else { ", not enough" }
    );
    let mut shifts_m = vec![[0.0; 3]; block.poses.len()];
    for (image, &index) in moving.images.iter().zip(&order) {
        shifts_m[index] = [image.motion[3], image.motion[4], image.motion[5]];
    }
    Ok(sure.then_some(Drift { way_m, way_px, spread_m, gain, images, shifts_m }))
}

/// Puts a drift into a block, so that all that is done with it knows of it.
pub fn adopt(block: &mut Block<'_>, drift: &Drift, readout_s: f64) {
    for (motion, shift) in block.motions.iter_mut().zip(&drift.shifts_m) {
        *motion = [0.0, 0.0, 0.0, shift[0], shift[1], shift[2]];
    }
    block.shutter = Some(RollingShutter {
        readout_s,
        sigma_velocity_m_s: (GUSTS * drift.way_m.abs()).max(drift.spread_m) / readout_s,
        sigma_rate_rad_s: 0.0,
    });
}

/// Mean and standard deviation of the ways that images flew along their directions, metres.
fn common(survey: &Survey, along: &[Option<[f64; 3]>]) -> (f64, f64) {
    let ways: Vec<f64> = survey
        .images
        .iter()
        .zip(along)
        .filter_map(|(image, direction)| {
            let shift = [image.motion[3], image.motion[4], image.motion[5]];
            let world = rotation::rotate(rotation::inverse(image.pose.rotation), shift);
            Some(-Vector3::from(world).dot(&Vector3::from((*direction)?)))
        })
        .collect();
    let n = ways.len().max(1) as f64;
    let mean = ways.iter().sum::<f64>() / n;
    let squares: f64 = ways.iter().map(|way| (way - mean).powi(2)).sum();
    (mean, (squares / (n - 1.0).max(1.0)).sqrt())
}

/// Median distance of points from the cameras that see them, metres.
fn distance_m(survey: &Survey) -> Option<f64> {
    let mut all: Vec<f64> = survey
        .observations
        .iter()
        .step_by(5)
        .map(|o| {
            let pose = survey.images[o.image as usize].pose;
            -pose.to_camera(survey.points[o.point as usize].position_m)[2]
        })
        .collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().filter(|&distance| distance > 0.0)
}

/// Marks in images that do not show the point would end an adjustment before it begins.
pub(super) fn keep_feasible_marks(survey: &mut Survey) {
    let feasible = |mark: &Mark| {
        let image = &survey.images[mark.image as usize];
        let point = survey.ground[mark.ground as usize].position_m;
        survey.cameras[image.camera].interior.project(image.pose.to_camera(point)).is_some()
    };
    survey.marks = survey.marks.iter().copied().filter(feasible).collect();
}

fn settle(survey: &mut Survey) -> Result<f64, SolveError> {
    let settings = Settings { tie_loss: Loss::SoftL1(2.0), ..Settings::default() };
    let posed = Posed::new(survey, &settings)?;
    let mut x = posed.problem.start();
    let engine = Engine { cost_tolerance: 1e-6, ..Engine::default() };
    let summary = solve(&posed.problem, &mut x, &engine, 30)?;
    posed.update(&x, survey);
    Ok(summary.final_cost)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strips_have_directions_and_turns_have_none() {
        let mut centres: Vec<[f64; 3]> = (0..4).map(|k| [10.0 * f64::from(k), 0.0, 30.0]).collect();
        centres.extend((0..4).map(|k| [30.0 - 10.0 * f64::from(k), 20.0, 30.0]));
        let found = directions(&centres);
        for (k, direction) in found.iter().enumerate() {
            let x = if k < 4 { 1.0 } else { -1.0 };
            assert_eq!(*direction, Some([x, 0.0, 0.0]), "{k}");
        }
        assert_eq!(directions(&centres[..1]), [None]);
        assert_eq!(directions(&centres[..2]), [None, None], "two images may be a turn");
    }
}
