//! What no reconstruction may have: numbers that are not finite, duplicate names, indices out of range.

use super::validation::InvalidReconstruction;
use crate::camera::Lens;
use crate::scene::{Image, Reconstruction};
use std::collections::HashSet;

/// Refuses inconsistent input.
///
/// # Errors
/// Names what is wrong.
pub(super) fn check(reconstruction: &Reconstruction) -> Result<(), InvalidReconstruction> {
    let fail = |message: String| Err(InvalidReconstruction(message));
    let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
    if reconstruction.images.is_empty() {
        return fail("there are no images".into());
    }
    if !(reconstruction.tie_sigma_px > 0.0 && reconstruction.tie_sigma_px.is_finite()) {
        return fail(format!(
            "the standard deviation of tie points is {} px, expected a positive number",
            reconstruction.tie_sigma_px
        ));
    }
    if !finite(&reconstruction.lever_arm_m) {
        return fail("the lever arm is not finite".into());
    }
    for camera in &reconstruction.cameras {
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
    for image in &reconstruction.images {
        if image.camera >= reconstruction.cameras.len() {
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
    for point in &reconstruction.points {
        if !finite(&point.position_m) {
            return fail(format!("tie point {}: its position is not finite", point.id));
        }
    }
    for o in &reconstruction.observations {
        if o.image as usize >= reconstruction.images.len()
            || o.point as usize >= reconstruction.points.len()
        {
            return fail(format!(
                "an observation names image {}, point {}; there are {} and {}",
                o.image,
                o.point,
                reconstruction.images.len(),
                reconstruction.points.len()
            ));
        }
        if !finite(&o.image_px) {
            return fail(format!(
                "tie point {} in image {}: its position is not finite",
                reconstruction.points[o.point as usize].id,
                reconstruction.images[o.image as usize].name
            ));
        }
    }
    check_ground(reconstruction)
}

fn check_ground(reconstruction: &Reconstruction) -> Result<(), InvalidReconstruction> {
    let fail = |message: String| Err(InvalidReconstruction(message));
    let positive = |values: &[f64]| values.iter().all(|v| v.is_finite() && *v > 0.0);
    let mut names = HashSet::new();
    for point in &reconstruction.ground {
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
    for mark in &reconstruction.marks {
        let (image, ground) = (mark.image as usize, mark.ground as usize);
        if image >= reconstruction.images.len() || ground >= reconstruction.ground.len() {
            return fail(format!(
                "a mark names image {image}, ground point {ground}, which are not there"
            ));
        }
        let (image, ground) =
            (&reconstruction.images[image].name, &reconstruction.ground[ground].name);
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
    for position in &reconstruction.positions {
        let Some(image) = reconstruction.images.get(position.image as usize) else {
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
    for known in &reconstruction.orientations {
        let Some(image) = reconstruction.images.get(known.image as usize) else {
            return fail(format!(
                "a camera orientation names image {}, which is not there",
                known.image
            ));
        };
        if known.rotation.iter().any(|v| !v.is_finite()) || !positive(&known.sigma_rad) {
            return fail(format!(
                "the camera orientation of image {} must be finite, its standard deviations positive",
                image.name
            ));
        }
    }
    for bar in &reconstruction.scale_bars {
        let there = bar.ends.iter().all(|&end| (end as usize) < reconstruction.ground.len());
        if !there || bar.ends[0] == bar.ends[1] || !positive(&[bar.length_m, bar.sigma_m]) {
            return fail(
                "a scale bar needs two ground points, a positive length and standard deviation"
                    .into(),
            );
        }
    }
    if let Some(shutter) = reconstruction.rolling_shutter {
        if !positive(&[shutter.readout_s, shutter.sigma_velocity_m_s]) {
            return fail("a rolling shutter needs a positive readout time and standard deviation of the velocity".into());
        }
        let rotates = |image: &&Image| {
            [image.motion, image.expected_motion].iter().any(|motion| motion[..3] != [0.0; 3])
        };
        if let Some(image) = reconstruction.images.iter().find(rotates) {
            return fail(format!(
                "image {}: its motion has a rotation during readout; an adjustment estimates shifts only",
                image.name
            ));
        }
    }
    Ok(())
}
