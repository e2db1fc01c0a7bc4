//! `OUTPUT.json`: the photos behind a mosaic, with poses and lenses, so that its pixels can be followed back.

use super::Setting;
use crate::{
    camera::Camera,
    error::Error,
    io::{FileError, output},
    mapping::{View, paint::Gain},
    problems::adjustment::Pose,
    raster::georeference::Georeference,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A photo.
#[derive(Serialize, Deserialize)]
struct Photo {
    name: String,
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
            path: absolute(&setting.paths[k]),
            camera: index,
            rotation: view.pose.rotation,
            translation_m: view.pose.translation,
            motion: view.motion,
            gain: gains.map(|gains| gains[k]),
        });
    }
    let dem = setting.args.dem.clone();
    let dem = dem.or_else(|| setting.args.input.results().map(|folder| folder.join("dem.tif")));
    let record = Record {
        version: 1,
        epsg: grid.crs.epsg,
        width_px: size[0],
        height_px: size[1],
        gsd_m: grid.per_column[0],
        dem: dem.map(|path| absolute(&path)),
        above_m: setting.above_m,
        rules: setting.args.rules(),
        cameras,
        photos,
    };
    output::write(&path(output), setting.args.force, |out| {
        serde_json::to_writer_pretty(&mut *out, &record)?;
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
    let paths = record.photos.into_iter().map(|photo| photo.path).collect();
    Ok((views, paths, record.dem, record.above_m))
}
