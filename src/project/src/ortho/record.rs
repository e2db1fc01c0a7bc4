//! `ortho.json`: the photos behind an orthophoto, with poses and lenses, so that its pixels can be followed back.

use crate::record::absolute;
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use rowgram_survey::{
    camera::Camera,
    mapping::{
        View, colour_balance::BalancedPhotos, colour_correction::ColourCorrection,
        select::SelectionOptions,
    },
    scene::Pose,
};
use serde::{Deserialize, Serialize};
use std::{
    ops::Range,
    path::{Component, Path, PathBuf},
};

/// The version of the format.
const VERSION: u32 = 4;

/// A photo behind an orthophoto.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotoRecord {
    /// Its name in the reconstruction.
    pub name: String,
    /// Its file; relative to the folder of the record where both are of one project.
    pub path: PathBuf,
    /// Index of the camera.
    pub camera: usize,
    /// Rotation of `camera_from_world`: unit quaternion, scalar part first.
    pub rotation: [f64; 4],
    /// Translation of `camera_from_world`, metres.
    pub translation_m: [f64; 3],
    /// With a rolling shutter: rotation vector (radians) and shift (metres) of the camera frame during the readout.
    pub motion: Option<[f64; 6]>,
    /// What its linear light was multiplied by; the inverse undoes it.
    pub colour: Option<ColourCorrection>,
    /// Standard deviations of the logarithms of the gains, red, green, blue.
    pub log_gain_sigma: Option<[f64; 3]>,
}

/// The photos behind an orthophoto, and how it was made of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OrthophotoRecord {
    /// Version of the format.
    pub version: u32,
    /// EPSG code of the mapping frame, where it has one.
    pub epsg: Option<u32>,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Side of a pixel, metres.
    pub gsd_m: f64,
    /// The surface; relative to the folder of the record where both are of one project.
    pub dem: PathBuf,
    /// How far above it the map is drawn, metres.
    pub canopy_height_m: f64,
    /// How photos were chosen for cells.
    pub selection: SelectionOptions,
    /// Each camera as a `camera.toml`.
    pub cameras: Vec<String>,
    /// In the order of the numbers in the provenance raster.
    pub photos: Vec<PhotoRecord>,
}

/// The record of an orthophoto.
pub(crate) fn path(orthophoto: &Path) -> PathBuf {
    orthophoto.with_extension("json")
}

/// Steps up from a record within which everything is of its project, and moves with it: `PROJECT/rowgram/ortho`.
const UP: usize = 2;

/// A path as the record holds it: from the record's folder within its project, else absolute.
fn stored(folder: &Path, path: &Path) -> PathBuf {
    let (folder, path) = (absolute(folder), absolute(path));
    let within = folder
        .ancestors()
        .take(UP + 1)
        .enumerate()
        .find_map(|(up, above)| path.strip_prefix(above).ok().map(|inside| (up, inside)));
    match within {
        Some((up, inside)) => std::iter::repeat_n(Path::new(".."), up).chain([inside]).collect(),
        None => path,
    }
}

/// The other way; steps up are taken by name, for a folder may be a link to another place.
fn found(folder: &Path, path: &Path) -> PathBuf {
    let mut at = absolute(folder);
    for part in path.components() {
        match part {
            Component::ParentDir => {
                at.pop();
            }
            part => at.push(part),
        }
    }
    at
}

/// The photos of `which`, with their cameras, as a record holds them.
pub(super) fn photos_of(
    orthophoto: &Path,
    which: &Range<usize>,
    views: &[View],
    files: &[PathBuf],
    balance: Option<&BalancedPhotos>,
) -> (Vec<String>, Vec<PhotoRecord>) {
    let record = path(orthophoto);
    let folder = output::folder_of(&record);
    let mut cameras: Vec<String> = Vec::new();
    let mut photos = Vec::new();
    for k in which.clone() {
        let view = &views[k];
        let camera = Camera::new("camera", view.interior).to_toml();
        let index = cameras.iter().position(|other| *other == camera).unwrap_or_else(|| {
            cameras.push(camera);
            cameras.len() - 1
        });
        photos.push(PhotoRecord {
            name: view.name.clone(),
            path: stored(folder, &files[k]),
            camera: index,
            rotation: view.pose.rotation,
            translation_m: view.pose.translation,
            motion: view.motion,
            colour: balance.map(|balance| balance.corrections[k]),
            log_gain_sigma: balance.map(|balance| balance.log_gain_sigmas[k]),
        });
    }
    (cameras, photos)
}

impl OrthophotoRecord {
    /// The version that this program writes.
    pub const VERSION: u32 = VERSION;

    /// Writes it beside an orthophoto; `dem` is taken relative to it.
    ///
    /// # Errors
    /// As [`output::write`].
    pub(super) fn write(mut self, orthophoto: &Path, force: bool) -> Result<(), Error> {
        let record = path(orthophoto);
        self.dem = stored(output::folder_of(&record), &self.dem);
        Ok(output::write_json(&record, force, &self)?)
    }

    /// Reads the record of an orthophoto; its paths become absolute.
    ///
    /// # Errors
    /// Where the file is not there or not of this form.
    pub fn read(orthophoto: &Path) -> Result<OrthophotoRecord, Error> {
        let path = path(orthophoto);
        let text = std::fs::read_to_string(&path).map_err(|e| FileError::read(&path, e))?;
        let mut record: OrthophotoRecord = serde_json::from_str(&text)
            .map_err(|e| FileError::malformed(&path, e.line(), e.to_string()))?;
        if record.version != VERSION {
            let message = format!(
                "its version is {}, expected {VERSION}; make the orthophoto again",
                record.version
            );
            return Err(FileError::malformed(&path, None, message).into());
        }
        let folder = output::folder_of(&path);
        record.dem = found(folder, &record.dem);
        record.photos.iter_mut().for_each(|photo| photo.path = found(folder, &photo.path));
        Ok(record)
    }

    /// Its photos, posed, with their lenses.
    ///
    /// # Errors
    /// A camera that is not one; names the record of `orthophoto`.
    pub fn views(&self, orthophoto: &Path) -> Result<Vec<View>, Error> {
        let path = path(orthophoto);
        let fault = |message: String| FileError::malformed(&path, None, message);
        let cameras = self
            .cameras
            .iter()
            .map(|text| Camera::from_toml(text).map_err(|error| fault(error.to_string())))
            .collect::<Result<Vec<Camera>, FileError>>()?;
        let view = |photo: &PhotoRecord| {
            let camera = cameras
                .get(photo.camera)
                .ok_or_else(|| fault(format!("photo {:?} has no camera", photo.name)))?;
            let pose = Pose { rotation: photo.rotation, translation: photo.translation_m };
            Ok(View::new(&photo.name, camera.interior, pose, photo.motion))
        };
        self.photos.iter().map(view).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_one_project_move_with_it_and_others_stay_where_they_are() {
        let folder = Path::new("/field/rowgram/ortho");
        for (path, expected) in [
            ("/field/rowgram/dem/dem.tif", "../dem/dem.tif"),
            ("/field/rowgram/ortho/dem.tif", "dem.tif"),
            ("/field/images/a b.jpg", "../../images/a b.jpg"),
            ("/fields/images/a.jpg", "/fields/images/a.jpg"),
            ("/photos/a.jpg", "/photos/a.jpg"),
        ] {
            let held = stored(folder, Path::new(path));
            assert_eq!(held, Path::new(expected));
            assert_eq!(found(folder, &held), Path::new(path));
        }
    }
}
