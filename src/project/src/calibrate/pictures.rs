//! A photo of the board before and after its distortion is removed, corners marked in both.

use super::Calibration;
use image::{Rgb, RgbImage};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::images;
use rowgram_raster::overlay::draw_points;
use rowgram_survey::{
    camera::Lens,
    mapping::undistort::{Crop, Interpolation, ideal_camera, undistort},
};
use std::path::Path;

/// Writes both pictures, of the photo that shows the board largest; nothing where corners came
/// without photos.
///
/// # Errors
/// Where the photo cannot be read again or a picture cannot be written.
pub(super) fn write(
    folder: &Path,
    force: bool,
    outcome: &Calibration,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let extent = |k: usize| {
        let corners = &outcome.photos[k].corners;
        let span = |axis: usize| {
            let (low, high) = corners
                .iter()
                .map(|c| c.image_px[axis])
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| {
                    (low.min(x), high.max(x))
                });
            high - low
        };
        span(0) * span(1)
    };
    let with_file = outcome.used.iter().filter(|&&k| outcome.photos[k].path.is_some());
    let Some(&largest) = with_file.max_by(|&&a, &&b| extent(a).total_cmp(&extent(b))) else {
        return Ok(());
    };
    let photo = &outcome.photos[largest];
    let Some(path) = &photo.path else { return Ok(()) };
    let from = &outcome.solution.state.interior;
    let mut picture = images::read_colour(path)?;
    let to = match ideal_camera(from, Crop::Same, 1.0) {
        Ok(to) => to,
        Err(error) => {
            let message = format!("there is no picture of it without distortion: {error}");
            monitor.diagnostic(&Diagnostic::warning(
                "no-undistorted-picture",
                &photo.name,
                message,
            ));
            return Ok(());
        }
    };
    let (mut flat, _) = undistort(&picture, from, &to, Interpolation::Bicubic)
        .map_err(|error| Error::Argument(format!("{}: {error}", photo.name)))?;
    for corner in &photo.corners {
        mark(&mut picture, corner.image_px);
        if let Some(at) = from.unproject(corner.image_px).and_then(|ray| to.project(ray)) {
            mark(&mut flat, at);
        }
    }
    images::write_photo(&folder.join("before.png"), force, &picture)?;
    images::write_photo(&folder.join("after.png"), force, &flat)?;
    Ok(())
}

/// A cross of some pixels.
fn mark(picture: &mut RgbImage, at_px: [f64; 2]) {
    let reach_px = (picture.width().max(picture.height()) / 160).max(3);
    draw_points(picture, &[at_px], Rgb([213, 94, 0]), reach_px);
}
