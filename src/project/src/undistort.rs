//! Photos as a camera without distortion would have taken them.

use super::photo_names;
use rayon::prelude::*;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Monitor},
};
use rowgram_files::{camera, images};
use rowgram_optim::output::{self, FileError};
use rowgram_survey::{
    camera::Camera,
    mapping::undistort::{Crop, Interpolation, ideal_camera, undistort},
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The format of a photo.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PhotoFormat {
    /// PNG.
    Png,
    /// JPEG.
    Jpg,
    /// TIFF.
    Tif,
}

rowgram_base::choices!(PhotoFormat: Png, Jpg, Tif);

/// How distortion is removed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UndistortOptions {
    /// What the new photos show.
    pub crop: Crop,
    /// New principal distance over the old one.
    pub scale: f64,
    /// How photos are read between their pixels.
    pub interpolation: Interpolation,
    /// Format of the new photos; that of the old ones where `None`.
    pub format: Option<PhotoFormat>,
}

impl Default for UndistortOptions {
    fn default() -> UndistortOptions {
        UndistortOptions {
            crop: Crop::Same,
            scale: 1.0,
            interpolation: Interpolation::Bicubic,
            format: None,
        }
    }
}

/// A photo without distortion.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UndistortedPhoto {
    /// The photo.
    pub image: PathBuf,
    /// The new photo.
    pub output: PathBuf,
    /// Its width, pixels.
    pub width_px: u32,
    /// Its height, pixels.
    pub height_px: u32,
    /// Pixels that the photo does not show.
    pub black_pixels: usize,
}

/// Photos without distortion.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UndistortOutcome {
    /// The camera of the new photos.
    pub camera: PathBuf,
    /// The photos in their order.
    pub photos: Vec<UndistortedPhoto>,
}

/// Name of the camera of the new photos.
pub const CAMERA: &str = "camera.toml";

/// Removes the distortion of the camera in `camera_path` from photos; the new ones keep their names and go to `folder`,
/// which is made if missing, with their camera.
///
/// # Errors
/// A camera or scale that cannot be used, photos of another size, outputs that are inputs or exist unless `force`, two
/// photos of one name, reading and writing.
pub fn undistort_photos(
    photos: &[PathBuf],
    camera_path: &Path,
    options: &UndistortOptions,
    folder: &Path,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<UndistortOutcome, Error> {
    let camera = camera::read(camera_path)?;
    let ideal = ideal_camera(&camera.interior, options.crop, options.scale)
        .map_err(|error| Error::Argument(format!("{}: {error}", camera_path.display())))?;
    let outputs = outputs(photos, options.format, folder)?;
    let new_camera = folder.join(CAMERA);
    let targets: Vec<&Path> = outputs.iter().chain([&new_camera]).map(PathBuf::as_path).collect();
    let inputs: Vec<&Path> = photos.iter().map(PathBuf::as_path).chain([camera_path]).collect();
    output::check_apart(&targets, &inputs, force)?;
    std::fs::create_dir_all(folder).map_err(|source| FileError::write(folder, source))?;
    let counter = Counter::new(monitor, "removing distortion", photos.len(), "photos");
    let photos = photos
        .par_iter()
        .zip(outputs)
        .map(|(image, output)| {
            let photo = images::read_colour(image)?;
            let (flat, black_pixels) =
                undistort(&photo, &camera.interior, &ideal, options.interpolation)
                    .map_err(|error| Error::Argument(format!("{}: {error}", image.display())))?;
            images::write_as_named(&output, force, &flat)?;
            counter.tick();
            Ok(UndistortedPhoto {
                image: image.clone(),
                output,
                width_px: flat.width(),
                height_px: flat.height(),
                black_pixels,
            })
        })
        .collect::<Vec<Result<UndistortedPhoto, Error>>>()
        .into_iter()
        .collect::<Result<Vec<_>, Error>>()?;
    camera::write(&new_camera, force, &Camera::new(&camera.name, ideal))?;
    Ok(UndistortOutcome { camera: new_camera, photos })
}

/// Where the photos go.
fn outputs(
    photos: &[PathBuf],
    format: Option<PhotoFormat>,
    folder: &Path,
) -> Result<Vec<PathBuf>, Error> {
    if folder.exists() && !folder.is_dir() {
        let path = folder.to_owned();
        return Err(FileError::Unusable { path, message: "it is no folder" }.into());
    }
    let mut outputs: Vec<PathBuf> = Vec::with_capacity(photos.len());
    for image in photos {
        let name = image
            .file_name()
            .ok_or_else(|| Error::Argument(format!("{}: expected a photo", image.display())))?;
        let mut to = folder.join(name);
        if let Some(format) = format {
            to.set_extension(format.to_string());
        }
        outputs.push(to);
    }
    photo_names::refuse_twins(photos, &outputs)?;
    Ok(outputs)
}
