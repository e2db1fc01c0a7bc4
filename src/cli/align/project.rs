//! A project folder: which photos, what their files say, what is known on the ground.

use super::{Finding, ground};
use crate::{
    camera::{Camera, Interior, Model},
    crs::{Crs, LocalPlane},
    error::Error,
    io::{
        FileError,
        checkpoint::Fingerprint,
        control::{self, Defaults},
        gcp_list,
        photo::{self, Geotag, Metadata},
    },
    scene::{HorizontalFrame, Image, LengthUnit, Pose, ReferenceFrame, VerticalFrame},
    sfm::georeference::Known,
};
use rayon::prelude::*;
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

/// One photo.
pub(super) struct Photo {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) metadata: Metadata,
    pub(super) size_px: [u32; 2],
    /// Mark of the file's bytes.
    pub(super) content: u64,
    /// Index of its camera.
    pub(super) camera: usize,
}

/// Where the coordinates of a project live.
pub(super) enum Frame {
    /// A reference system that somebody named, or that the control can only be in.
    Map(Box<Crs>),
    /// That of the control, which nobody named.
    Unnamed,
    /// A plane at a place on the ellipsoid.
    Local(LocalPlane),
    /// None: nothing is known on the ground or in the air.
    Free,
}

impl Frame {
    /// As the reconstruction's file has it.
    pub(super) fn reference(&self, georeferenced: bool, has_control: bool) -> ReferenceFrame {
        if !georeferenced {
            return ReferenceFrame::default();
        }
        ReferenceFrame {
            horizontal: match self {
                Frame::Map(crs) => HorizontalFrame::from(&**crs),
                Frame::Unnamed => HorizontalFrame::Unnamed,
                Frame::Local(plane) => HorizontalFrame::from(plane),
                Frame::Free => HorizontalFrame::Free,
            },
            vertical: if has_control {
                VerticalFrame::ControlPoints
            } else {
                VerticalFrame::CameraPositions
            },
            unit: LengthUnit::Metre,
        }
    }

    /// What files and people call it.
    pub(super) fn name(&self) -> String {
        match self {
            Frame::Map(crs) => crs.name().to_owned(),
            Frame::Unnamed => "that of the control points (not named)".to_owned(),
            Frame::Local(plane) => {
                let [lat, lon, _] = plane.origin();
                format!("local east, north, up at latitude {lat:.7}, longitude {lon:.7} (WGS84)")
            }
            Frame::Free => "free (no scale, no north)".to_owned(),
        }
    }
}

/// Everything that is known before a photo is looked at.
pub(super) struct Project {
    /// Its folder, as it was given.
    pub(super) name: String,
    pub(super) photos: Vec<Photo>,
    /// The cameras at their start, and where their principal distance comes from; `None` where it is
    /// only a guess.
    pub(super) cameras: Vec<(Camera, Option<String>)>,
    pub(super) frame: Frame,
    pub(super) known: Known,
    /// Which photos told the accuracy of their position.
    pub(super) told: Vec<bool>,
    /// Horizontal positions for the choice of neighbours, metres; NaN where there is none.
    pub(super) plan_m: Vec<[f64; 2]>,
    /// Photos that are left out, and why.
    pub(super) left_out: Vec<(String, String)>,
}

impl Project {
    /// The photos in the order in which they were taken, as far as they tell: by moment, then by name.
    pub(super) fn flight(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.photos.len()).collect();
        order.sort_by(|&a, &b| {
            let (a, b) = (&self.photos[a], &self.photos[b]);
            a.metadata.moment.cmp(&b.metadata.moment).then(a.name.cmp(&b.name))
        });
        order
    }
}

/// Where things are, and what the command line says about them.
pub(super) struct Sources<'a> {
    pub(super) root: &'a Path,
    pub(super) crs: Option<&'a str>,
    pub(super) control: Option<&'a Path>,
    pub(super) marks: Option<&'a Path>,
    pub(super) geolocation: Option<&'a Path>,
    pub(super) camera: Option<&'a Path>,
    pub(super) check: &'a [String],
    pub(super) use_positions: bool,
    pub(super) model: Model,
    pub(super) defaults: Defaults,
}

const EXTENSIONS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

fn list(root: &Path) -> Result<Vec<PathBuf>, Error> {
    let images = root.join("images");
    let folder = if images.is_dir() { images } else { root.to_owned() };
    let entries = std::fs::read_dir(&folder).map_err(|e| FileError::read(&folder, e))?;
    let mut found = Vec::new();
    for entry in entries {
        let path = entry.map_err(|e| FileError::read(&folder, e))?.path();
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        let hidden = path.file_name().and_then(|n| n.to_str()).is_none_or(|n| n.starts_with('.'));
        if path.is_file()
            && !hidden
            && EXTENSIONS.contains(&extension.to_ascii_lowercase().as_str())
        {
            found.push(path);
        }
    }
    found.sort();
    if found.len() < 3 {
        let message = format!(
            "{} photos (JPEG, PNG, TIFF) here or in images/; at least 3 are needed",
            found.len()
        );
        return Err(FileError::malformed(&folder, None, message).into());
    }
    Ok(found)
}

/// The size of a picture without decoding it.
fn size_of(bytes: &[u8]) -> Option<[u32; 2]> {
    let reader = image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format().ok()?;
    let (width, height) = reader.into_dimensions().ok()?;
    (width > 0 && height > 0).then_some([width, height])
}

/// Reads everything that is known beforehand.
///
/// # Errors
/// A folder without photos, control that cannot be read, a reference system that is none.
pub(super) fn inspect(
    sources: &Sources<'_>,
    findings: &mut Vec<Finding>,
) -> Result<Project, Error> {
    let paths = list(sources.root)?;
    let read: Vec<Result<Photo, (String, String)>> =
        paths.par_iter().map(|path| open(path)).collect();
    let mut photos: Vec<Photo> = Vec::new();
    let mut left_out = Vec::new();
    let mut seen: HashMap<u64, String> = HashMap::new();
    for photo in read {
        match photo {
            Err(fault) => left_out.push(fault),
            Ok(photo) => match seen.get(&photo.content) {
                Some(other) => {
                    let reason = format!("it is the same file as {other}");
                    left_out.push((photo.name.clone(), reason));
                }
                None => {
                    seen.insert(photo.content, photo.name.clone());
                    photos.push(photo);
                }
            },
        }
    }
    let cameras = cameras(&mut photos, sources, findings)?;
    let tags = geotags(&photos, sources, findings)?;
    let (frame, known, told) = ground::read(&photos, &tags, sources, findings)?;
    let plan_m = ground::plan_m(&tags);
    let name = sources.root.display().to_string();
    Ok(Project { name, photos, cameras, frame, known, told, plan_m, left_out })
}

fn open(path: &Path) -> Result<Photo, (String, String)> {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let bytes = match std::fs::read(path) {
        Ok(bytes) => bytes,
        Err(error) => return Err((name, format!("it cannot be read: {error}"))),
    };
    let Some(size_px) = size_of(&bytes) else {
        return Err((name, "it is no picture that can be read".into()));
    };
    Ok(Photo {
        path: path.to_owned(),
        name,
        metadata: photo::parse(&bytes),
        size_px,
        content: Fingerprint::new().bytes(&bytes).finish(),
        camera: 0,
    })
}

/// Photos of one make, model, size and focal length share a camera.
fn cameras(
    photos: &mut [Photo],
    sources: &Sources<'_>,
    findings: &mut Vec<Finding>,
) -> Result<Vec<(Camera, Option<String>)>, Error> {
    let given = match sources.camera {
        Some(path) => Some((path, crate::io::camera::read(path)?)),
        None => None,
    };
    let mut groups: Vec<(String, [u32; 2])> = Vec::new();
    let mut cameras = Vec::new();
    // A photo without metadata has the camera of the others of its size, if there is one.
    let described: Vec<(usize, [u32; 2])> = photos
        .iter()
        .enumerate()
        .filter(|(_, p)| p.metadata.focal_mm.is_some() || p.metadata.focal_35mm.is_some())
        .map(|(k, p)| (k, p.size_px))
        .collect();
    let mut adopted = Vec::new();
    for k in 0..photos.len() {
        let size_px = photos[k].size_px;
        let own = photos[k].metadata.focal_mm.is_some() || photos[k].metadata.focal_35mm.is_some();
        let adopts = described.iter().find(|(_, size)| *size == size_px);
        let like = match (own, adopts) {
            (false, Some((other, _))) => {
                adopted.push(photos[k].name.clone());
                *other
            }
            _ => k,
        };
        let metadata = &photos[like].metadata;
        let label = match metadata.focal_mm.or(metadata.focal_35mm) {
            Some(focal) => format!("{} {} {focal:.3} mm", metadata.make, metadata.model),
            None => format!("{} {} unknown camera", metadata.make, metadata.model),
        };
        let label = label.trim().to_owned();
        let key = (label.clone(), size_px);
        let place = groups.iter().position(|group| *group == key);
        let place = match place {
            Some(place) => place,
            None => {
                groups.push(key);
                cameras.push(start(&label, size_px, metadata, sources.model, given.as_ref())?);
                groups.len() - 1
            }
        };
        photos[k].camera = place;
    }
    if !adopted.is_empty() && adopted.len() < photos.len() {
        findings.push(Finding::new(
            &adopted.join(", "),
            "no camera data in the file; taken as photos of the camera of the others of that size",
        ));
    }
    for (camera, source) in &cameras {
        if source.is_none() {
            findings.push(Finding::new(
                &camera.name,
                "the files do not tell the focal length; it is looked for",
            ));
        }
    }
    Ok(cameras)
}

fn start(
    label: &str,
    size_px: [u32; 2],
    metadata: &Metadata,
    model: Model,
    given: Option<&(&Path, Camera)>,
) -> Result<(Camera, Option<String>), Error> {
    if let Some((path, camera)) = given {
        if camera.interior.size_px() != size_px {
            let message = format!(
                "it is for images of {:?} pixels, these are {size_px:?}",
                camera.interior.size_px()
            );
            return Err(FileError::malformed(path, None, message).into());
        }
        return Ok((camera.clone(), Some(path.display().to_string())));
    }
    let found = metadata.principal_distance_px(size_px);
    let [width, height] = size_px.map(f64::from);
    let c = found.map_or(1.2 * width.max(height), |(c, _)| c);
    let mut camera = camera_at(label, model, size_px, c)?;
    // What the maker says of a focal length is good to a few per cent.
    camera.standard_deviations[0] = Some(if found.is_some() { 0.05 * c } else { 0.3 * c });
    Ok((camera, found.map(|(_, source)| source.to_owned())))
}

/// A camera without distortion.
pub(super) fn camera_at(
    name: &str,
    model: Model,
    size_px: [u32; 2],
    principal_distance_px: f64,
) -> Result<Camera, Error> {
    let mut values: Vec<f64> = (0..model.parameters().len())
        .map(|place| model.default_value(place, size_px).unwrap_or(0.0))
        .collect();
    values[0] = principal_distance_px;
    let interior = Interior::new(model, size_px, &values)
        .map_err(|e| Error::Argument(format!("camera {name}: {e}")))?;
    Ok(Camera::new(name, interior))
}

/// Positions by file or by EXIF.
fn geotags(
    photos: &[Photo],
    sources: &Sources<'_>,
    findings: &mut Vec<Finding>,
) -> Result<Vec<Option<Geotag>>, Error> {
    let mut tags: Vec<Option<Geotag>> = photos.iter().map(|photo| photo.metadata.geotag).collect();
    let beside = sources.root.join("geolocation.csv");
    let path =
        sources.geolocation.map(Path::to_owned).or_else(|| beside.is_file().then_some(beside));
    if let Some(path) = path {
        let rows = gcp_list::geolocation(&path)?;
        let stand_ins = stand_ins(photos);
        let names = control::Names::new(&stand_ins);
        let mut unmatched = Vec::new();
        for (name, tag) in rows {
            match names.find(&name) {
                Some(k) => tags[k as usize] = Some(tag),
                None => unmatched.push(name),
            }
        }
        if let Some(first) = unmatched.first() {
            findings.push(Finding::new(
                &path.display().to_string(),
                &format!("{} rows name no photo, the first {first:?}", unmatched.len()),
            ));
        }
    }
    let missing: Vec<&str> = photos
        .iter()
        .zip(&tags)
        .filter(|(_, tag)| tag.is_none())
        .map(|(photo, _)| photo.name.as_str())
        .collect();
    if !missing.is_empty() && missing.len() < photos.len() {
        findings.push(Finding::new(&missing.join(", "), "no position in the file"));
    }
    Ok(tags)
}

/// Images that carry no more than their names, to match other names against.
pub(super) fn stand_ins(photos: &[Photo]) -> Vec<Image> {
    let pose = Pose { rotation: crate::geometry::rotation::IDENTITY, translation: [0.0; 3] };
    let image = |photo: &Photo| Image {
        name: photo.name.clone(),
        id: 0,
        camera: photo.camera,
        pose,
        motion: [0.0; 6],
        expected_motion: [0.0; 6],
    };
    photos.iter().map(image).collect()
}
