//! `OUTPUT.json`: the photos behind a mosaic, with poses and lenses, so that its pixels can be followed back.

use super::Setting;
use crate::{
    camera::Camera,
    error::Error,
    io::{FileError, output},
    mapping::{View, paint::Gain},
    raster::georeference::Georeference,
    scene::Pose,
};
use serde::{Deserialize, Serialize};
use std::path::{Component, Path, PathBuf};

/// A photo.
#[derive(Serialize, Deserialize)]
struct Photo {
    name: String,
    /// From the folder of the record where both are of one project.
    path: PathBuf,
    /// Index of the camera.
    camera: usize,
    /// `camera_from_world`: unit quaternion and translation, metres.
    rotation: [f64; 4],
    translation_m: [f64; 3],
    /// With a rolling shutter.
    motion: Option<[f64; 6]>,
    gain: Option<[f32; 3]>,
}

/// All of it.
#[derive(Serialize, Deserialize)]
struct Record {
    version: u32,
    epsg: Option<u32>,
    width_px: usize,
    height_px: usize,
    gsd_m: f64,
    /// As the photos.
    dem: Option<PathBuf>,
    /// How far above it the map was drawn.
    #[serde(default)]
    above_m: f64,
    rules: crate::mapping::select::Rules,
    /// Each as a `camera.toml`.
    cameras: Vec<String>,
    /// In the order of the numbers in the provenance raster.
    photos: Vec<Photo>,
}

/// Where it is.
pub(super) fn path(output: &Path) -> PathBuf {
    output.with_extension("json")
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
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

/// Writes it.
///
/// # Errors
/// As [`output::write`].
pub(super) fn write(
    output: &Path,
    setting: &Setting<'_>,
    grid: &Georeference,
    size: [usize; 2],
    gains: Option<&[Gain]>,
) -> Result<(), Error> {
    let record = path(output);
    let folder = output::folder_of(&record);
    let mut cameras: Vec<String> = Vec::new();
    let mut photos = Vec::new();
    for (k, view) in setting.views.iter().enumerate() {
        let camera = Camera::new("camera", view.interior).to_toml();
        let index = cameras.iter().position(|other| *other == camera).unwrap_or_else(|| {
            cameras.push(camera);
            cameras.len() - 1
        });
        photos.push(Photo {
            name: view.name.clone(),
            path: stored(folder, &setting.paths[k]),
            camera: index,
            rotation: view.pose.rotation,
            translation_m: view.pose.translation,
            motion: view.motion,
            gain: gains.map(|gains| gains[k]),
        });
    }
    let dem = setting.args.dem.clone();
    let dem = dem.or_else(|| setting.args.input.results().map(|folder| folder.join("dem.tif")));
    let held = Record {
        version: 1,
        epsg: grid.crs.epsg,
        width_px: size[0],
        height_px: size[1],
        gsd_m: grid.per_column[0],
        dem: dem.map(|path| stored(folder, &path)),
        above_m: setting.above_m,
        rules: setting.args.rules(),
        cameras,
        photos,
    };
    output::write(&record, setting.args.force, |out| {
        serde_json::to_writer_pretty(&mut *out, &held)?;
        writeln!(out)
    })?;
    Ok(())
}

/// Photos with their files, the file of the surface, and how far above it the map was drawn, metres.
pub(super) type Behind = (Vec<View>, Vec<PathBuf>, Option<PathBuf>, f64);

/// The photos behind a mosaic and the file of its surface.
///
/// # Errors
/// Where the file is not there or not of this form.
pub(super) fn read(output: &Path) -> Result<Behind, Error> {
    let path = path(output);
    let text = std::fs::read_to_string(&path).map_err(|e| FileError::read(&path, e))?;
    let record: Record = serde_json::from_str(&text)
        .map_err(|e| FileError::malformed(&path, e.line(), e.to_string()))?;
    let fault = |message: String| FileError::malformed(&path, None, message);
    let cameras = record
        .cameras
        .iter()
        .map(|text| Camera::from_toml(text).map_err(|error| fault(error.to_string())))
        .collect::<Result<Vec<Camera>, FileError>>()?;
    let mut views = Vec::new();
    for photo in &record.photos {
        let camera = cameras
            .get(photo.camera)
            .ok_or_else(|| fault(format!("photo {:?} has no camera", photo.name)))?;
        let pose = Pose { rotation: photo.rotation, translation: photo.translation_m };
        views.push(View::new(&photo.name, camera.interior, pose, photo.motion));
    }
    let folder = output::folder_of(&path);
    let paths = record.photos.iter().map(|photo| found(folder, &photo.path)).collect();
    let dem = record.dem.map(|dem| found(folder, &dem));
    Ok((views, paths, dem, record.above_m))
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
