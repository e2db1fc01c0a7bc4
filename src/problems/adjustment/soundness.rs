//! What no survey may have: numbers that are none, names that are there twice, indices of nothing.

use super::screening::SurveyError;
use crate::camera::Lens;
use crate::scene::Reconstruction;
use std::collections::HashSet;

/// Refuses what cannot be.
///
/// # Errors
/// Names what is wrong.
pub(super) fn check(survey: &Reconstruction) -> Result<(), SurveyError> {
    let fail = |message: String| Err(SurveyError(message));
    let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
    if survey.images.is_empty() {
        return fail("there are no images".into());
    }
    if !(survey.tie_sigma_px > 0.0 && survey.tie_sigma_px.is_finite()) {
        return fail(format!(
            "the standard deviation of tie points is {} px, expected a positive number",
            survey.tie_sigma_px
        ));
    }
    if !finite(&survey.lever_arm_m) {
        return fail("the lever arm is not finite".into());
    }
    for camera in &survey.cameras {
        let there = camera.interior.values().len();
        let given = [
            ("free", camera.free.len()),
            ("standard_deviations", camera.standard_deviations.len()),
            ("expected", camera.expected.as_ref().map_or(there, Vec::len)),
        ];
        if let Some((what, count)) = given.into_iter().find(|(_, count)| *count != there) {
            return fail(format!(
                "camera {}: {what} has {count} entries, expected one for each of its {there} parameters",
                camera.name
            ));
        }
        if camera.expected.as_ref().is_some_and(|expected| !finite(expected)) {
            return fail(format!("camera {}: what is expected of it is not finite", camera.name));
        }
    }
    let mut names = HashSet::new();
    for image in &survey.images {
        if image.camera >= survey.cameras.len() {
            return fail(format!("image {}: there is no camera {}", image.name, image.camera));
        }
        if !names.insert(&image.name) {
            return fail(format!("two images are called {}", image.name));
        }
        let q = image.pose.rotation;
        let norm: f64 = q.iter().map(|v| v * v).sum();
        let motions = [image.motion, image.expected_motion];
        if !(finite(&q) && finite(&image.pose.translation) && finite(motions.as_flattened())) {
            return fail(format!("image {}: its pose or its motion is not finite", image.name));
        }
        if (norm - 1.0).abs() > 1e-6 {
            return fail(format!(
                "image {}: its rotation has length {}, a unit quaternion was expected",
                image.name,
                norm.sqrt()
            ));
        }
    }
    for point in &survey.points {
        if !finite(&point.position_m) {
            return fail(format!("tie point {}: its position is not finite", point.id));
        }
    }
    for o in &survey.observations {
        if o.image as usize >= survey.images.len() || o.point as usize >= survey.points.len() {
            return fail(format!(
                "an observation names image {}, point {}; there are {} and {}",
                o.image,
                o.point,
                survey.images.len(),
                survey.points.len()
            ));
        }
        if !finite(&o.image_px) {
            return fail(format!(
                "tie point {} in image {}: its position is not finite",
                survey.points[o.point as usize].id, survey.images[o.image as usize].name
            ));
        }
    }
    check_ground(survey)
}

fn check_ground(survey: &Reconstruction) -> Result<(), SurveyError> {
    let fail = |message: String| Err(SurveyError(message));
    let positive = |values: &[f64]| values.iter().all(|v| v.is_finite() && *v > 0.0);
    let mut names = HashSet::new();
    for point in &survey.ground {
        let name = &point.name;
        if !names.insert(name) {
            return fail(format!("two ground points are called {name}"));
        }
        if point.position_m.iter().any(|v| !v.is_finite()) {
            return fail(format!("ground point {name}: its coordinates are not finite"));
        }
        if !positive(&point.sigma_m) {
            return fail(format!(
                "ground point {name}: its standard deviations are {:?} m, expected positive numbers",
                point.sigma_m
            ));
        }
    }
    let mut seen = HashSet::new();
    for mark in &survey.marks {
        let (image, ground) = (mark.image as usize, mark.ground as usize);
        if image >= survey.images.len() || ground >= survey.ground.len() {
            return fail(format!(
                "a mark names image {image}, ground point {ground}, which are not there"
            ));
        }
        let (image, ground) = (&survey.images[image].name, &survey.ground[ground].name);
        if mark.image_px.iter().any(|v| !v.is_finite()) {
            return fail(format!("the mark of {ground} in image {image} is not finite"));
        }
        if !positive(&[mark.sigma_px]) {
            return fail(format!(
                "the mark of {ground} in image {image} has the standard deviation {} px, expected a positive number",
                mark.sigma_px
            ));
        }
        if !seen.insert((mark.image, mark.ground)) {
            return fail(format!(
                "ground point {ground} is marked twice in image {image}; keep one of the marks"
            ));
        }
    }
    let mut seen = HashSet::new();
    for position in &survey.positions {
        let Some(image) = survey.images.get(position.image as usize) else {
            return fail(format!(
                "a camera position names image {}, which is not there",
                position.image
            ));
        };
        if position.position_m.iter().any(|v| !v.is_finite()) || !positive(&position.sigma_m) {
            return fail(format!(
                "the camera position of image {} must be finite, its standard deviations positive",
                image.name
            ));
        }
        if !seen.insert(position.image) {
            return fail(format!("image {} has two camera positions", image.name));
        }
    }
    for bar in &survey.scale_bars {
        let there = bar.ends.iter().all(|&end| (end as usize) < survey.ground.len());
        if !there || bar.ends[0] == bar.ends[1] || !positive(&[bar.length_m, bar.sigma_m]) {
            return fail(
                "a scale bar needs two ground points, a positive length and standard deviation"
                    .into(),
            );
        }
    }
    if let Some(shutter) = survey.rolling_shutter {
        let rate = shutter.sigma_rate_rad_s;
        let timing = positive(&[shutter.readout_s, shutter.sigma_velocity_m_s]);
        let turning = rate.is_finite() && rate >= 0.0;
        if !timing || !turning {
            return fail("a rolling shutter needs a positive readout time and standard deviation of the velocity, and one of 0 or more for the rate of turn".into());
        }
    }
    Ok(())
}
