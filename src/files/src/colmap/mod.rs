//! COLMAP's sparse models, as text and binary: `cameras`, `images`, `points3D`.
//!
//! COLMAP has the centre of the top-left pixel at (0.5, 0.5) and a camera frame with `y` down and
//! `z` forward; both are converted here and nowhere else. Its lens models are Brown's or the
//! equidistant fisheye with entries left out, or are fitted by one of these (`fitted`); a lens of ours is written as the
//! smallest that holds it.
//!
//! Reference: <https://colmap.github.io/format.html>.

mod binary;
mod fitted;
mod text;

use super::{
    FileError,
    model::{Feature, Model, as_brown, from_computer_vision, names_once, to_computer_vision},
    words::Fault,
};
use fitted::Fitted;
use rowgram_optim::geometry::rotation;
use rowgram_survey::{
    camera::{Camera, Interior, Lens, Model as LensModel},
    scene::{Image, Observation, Reconstruction, TiePoint},
};
use std::{
    collections::{HashMap, HashSet},
    path::Path,
};

/// Where COLMAP's pixel origin is from ours.
const HALF_PX: f64 = 0.5;

/// Which of the two forms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// `*.txt`.
    Text,
    /// `*.bin`.
    Binary,
}

impl Form {
    fn extension(self) -> &'static str {
        match self {
            Form::Text => "txt",
            Form::Binary => "bin",
        }
    }
}

/// Which form of a model a folder holds, if any; binary before text, as COLMAP does.
pub fn find(folder: &Path) -> Option<Form> {
    [Form::Binary, Form::Text].into_iter().find(|form| {
        ["cameras", "images", "points3D"]
            .iter()
            .all(|name| folder.join(format!("{name}.{}", form.extension())).is_file())
    })
}

/// One of COLMAP's lens models: its number, name and parameters.
#[derive(Debug, Clone, Copy)]
struct Kind {
    id: i32,
    name: &'static str,
    model: LensModel,
    /// Places of COLMAP's parameters among ours; [`FX`] and [`FY`] need more than a place.
    places: &'static [usize],
}

const FX: usize = 100;
const FY: usize = 101;

/// From the smallest up; a lens is written as the first that holds it.
const KINDS: [Kind; 11] = [
    Kind { id: 0, name: "SIMPLE_PINHOLE", model: LensModel::Brown, places: &[0, 2, 3] },
    Kind { id: 2, name: "SIMPLE_RADIAL", model: LensModel::Brown, places: &[0, 2, 3, 4] },
    Kind { id: 3, name: "RADIAL", model: LensModel::Brown, places: &[0, 2, 3, 4, 5] },
    Kind { id: 1, name: "PINHOLE", model: LensModel::Brown, places: &[FX, FY, 2, 3] },
    Kind { id: 4, name: "OPENCV", model: LensModel::Brown, places: &[FX, FY, 2, 3, 4, 5, 6, 7] },
    Kind {
        id: 6,
        name: "FULL_OPENCV",
        model: LensModel::Brown,
        places: &[FX, FY, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11],
    },
    Kind { id: 8, name: "SIMPLE_RADIAL_FISHEYE", model: LensModel::Fisheye, places: &[0, 2, 3, 4] },
    Kind { id: 9, name: "RADIAL_FISHEYE", model: LensModel::Fisheye, places: &[0, 2, 3, 4, 5] },
    Kind {
        id: 5,
        name: "OPENCV_FISHEYE",
        model: LensModel::Fisheye,
        places: &[FX, FY, 2, 3, 4, 5, 6, 7],
    },
    // Never written: those above hold them too.
    Kind { id: -1, name: "SIMPLE_FISHEYE", model: LensModel::Fisheye, places: &[0, 2, 3] },
    Kind { id: -1, name: "FISHEYE", model: LensModel::Fisheye, places: &[FX, FY, 2, 3] },
];

/// A lens model that can be read.
#[derive(Debug, Clone, Copy)]
enum ReadKind {
    /// One of ours.
    Ours(Kind),
    /// One that the nearest of ours stands for.
    Fitted(Fitted),
}

impl ReadKind {
    fn named(name: &str) -> Option<ReadKind> {
        let ours = KINDS.iter().find(|kind| kind.name == name).copied().map(ReadKind::Ours);
        ours.or_else(|| Fitted::named(name).map(ReadKind::Fitted))
    }

    fn numbered(number: i32) -> Option<ReadKind> {
        let numbered = |kind: &&Kind| kind.id == number && number >= 0;
        let ours = KINDS.iter().find(numbered).copied().map(ReadKind::Ours);
        ours.or_else(|| Fitted::numbered(number).map(ReadKind::Fitted))
    }

    fn name(&self) -> &'static str {
        match self {
            ReadKind::Ours(kind) => kind.name,
            ReadKind::Fitted(kind) => kind.name(),
        }
    }

    /// Its number in binary files, which COLMAP knows for those of ours that are written.
    fn id(&self) -> i32 {
        match self {
            ReadKind::Ours(kind) => kind.id,
            ReadKind::Fitted(_) => -1,
        }
    }

    /// How many parameters it has.
    fn count(&self) -> usize {
        match self {
            ReadKind::Ours(kind) => kind.places.len(),
            ReadKind::Fitted(kind) => kind.count(),
        }
    }
}

impl Kind {
    /// Our values from COLMAP's parameters.
    fn values(&self, parameters: &[f64]) -> Vec<f64> {
        let mut values = vec![0.0; self.model.parameters().len()];
        values[1] = 1.0;
        for (&place, &value) in self.places.iter().zip(parameters) {
            match place {
                FX => values[0] = value,
                FY => values[1] = value / values[0],
                2 | 3 => values[place] = value - HALF_PX,
                place => values[place] = value,
            }
        }
        values
    }

    /// COLMAP's parameters from our values; `None` where they cannot hold them.
    fn parameters(&self, model: LensModel, values: &[f64]) -> Option<Vec<f64>> {
        let held = |place: usize| {
            self.places.contains(&place)
                || (place < 2 && self.places.contains(&FX))
                || values[place] == if place == 1 { 1.0 } else { 0.0 }
        };
        if model != self.model || !(0..values.len()).all(held) {
            return None;
        }
        let of = |&place: &usize| match place {
            FX => values[0],
            FY => values[0] * values[1],
            2 | 3 => values[place] + HALF_PX,
            place => values[place],
        };
        Some(self.places.iter().map(of).collect())
    }
}

/// A camera as COLMAP has it.
struct CameraRow {
    id: u32,
    kind: ReadKind,
    size: [u64; 2],
    parameters: Vec<f64>,
}

/// An image as COLMAP has it, pixels already ours.
struct ImageRow {
    id: u32,
    rotation: rotation::Quaternion,
    translation: [f64; 3],
    camera: u32,
    name: String,
    features: Vec<Feature>,
}

/// A point as COLMAP has it, without its track, which the images hold too.
struct PointRow {
    id: u64,
    position: [f64; 3],
    colour: [u8; 3],
}

/// Reads the model in a folder.
///
/// # Errors
/// Where there is none, a file is damaged, or a lens is none of ours.
pub fn read(folder: &Path) -> Result<Model, FileError> {
    let Some(form) = find(folder) else {
        return Err(FileError::malformed(
            folder,
            None,
            "no COLMAP model here: expected cameras, images and points3D, .bin or .txt",
        ));
    };
    let bytes = |name: &str| {
        let path = folder.join(format!("{name}.{}", form.extension()));
        crate::memory::read_file(&path).map(|bytes| (path, bytes))
    };
    let (cameras_at, cameras) = bytes("cameras")?;
    let (images_at, images) = bytes("images")?;
    let (points_at, points) = bytes("points3D")?;
    let at = |path: &Path, (line, message): Fault| FileError::malformed(path, line, message);
    let cameras = match form {
        Form::Text => text::cameras(&cameras),
        Form::Binary => binary::cameras(&cameras),
    }
    .map_err(|fault| at(&cameras_at, fault))?;
    let images = match form {
        Form::Text => text::images(&images),
        Form::Binary => binary::images(&images),
    }
    .map_err(|fault| at(&images_at, fault))?;
    let points = match form {
        Form::Text => text::points(&points),
        Form::Binary => binary::points(&points),
    }
    .map_err(|fault| at(&points_at, fault))?;
    let found = cameras_of(cameras).map_err(|message| at(&cameras_at, (None, message)))?;
    join(found, images, points).map_err(|message| at(&images_at, (None, message)))
}

fn cameras_of(rows: Vec<CameraRow>) -> Result<(Vec<Camera>, Vec<u32>), String> {
    let (mut cameras, mut ids) = (Vec::new(), Vec::new());
    for row in rows {
        let named = |message: String| format!("camera {}: {message}", row.id);
        let size = row.size.map(|n| u32::try_from(n).unwrap_or(0));
        if row.parameters.len() != row.kind.count() {
            return Err(named(format!(
                "{} has {} parameters, {} were given",
                row.kind.name(),
                row.kind.count(),
                row.parameters.len()
            )));
        }
        cameras.push(match row.kind {
            ReadKind::Ours(kind) => {
                let interior = Interior::new(kind.model, size, &kind.values(&row.parameters))
                    .map_err(|error| named(error.to_string()))?;
                Camera::new(&format!("camera {}", row.id), interior)
            }
            ReadKind::Fitted(kind) => {
                let (interior, rms_px) = kind.fit(size, &row.parameters).map_err(named)?;
                let (model, id) = (interior.model().word(), row.id);
                let name = format!("camera {id} ({} as {model}, rms {rms_px:.4} px)", kind.name());
                Camera::new(&name, interior)
            }
        });
        if ids.contains(&row.id) {
            return Err(named("its number is there twice, expected each once".into()));
        }
        ids.push(row.id);
    }
    Ok((cameras, ids))
}

fn join(
    (cameras, camera_ids): (Vec<Camera>, Vec<u32>),
    images: Vec<ImageRow>,
    points: Vec<PointRow>,
) -> Result<Model, String> {
    let mut model = Model {
        survey: Reconstruction { cameras, tie_sigma_px: 1.0, ..Reconstruction::default() },
        camera_ids,
        features: Vec::new(),
    };
    let mut places: HashMap<u64, u32> = HashMap::with_capacity(points.len());
    for row in points {
        if places.insert(row.id, places.len() as u32).is_some() {
            return Err(format!("point {} is there twice", row.id));
        }
        model.survey.points.push(TiePoint {
            id: row.id,
            position_m: row.position,
            colour: row.colour,
        });
    }
    let mut numbers = HashSet::new();
    for row in images {
        if !numbers.insert(row.id) {
            return Err(format!("image {}: its number {} is there twice", row.name, row.id));
        }
        let camera = model.camera_ids.iter().position(|&id| id == row.camera);
        let camera = camera.ok_or_else(|| {
            format!("image {}: its camera {} is not among the cameras", row.name, row.camera)
        })?;
        let norm: f64 = row.rotation.iter().map(|v| v * v).sum();
        if !(norm.is_finite() && norm > 1e-12) {
            return Err(format!("image {}: its rotation is no quaternion", row.name));
        }
        let image = model.survey.images.len() as u32;
        for feature in &row.features {
            if let Some(id) = feature.point {
                let point = *places.get(&id).ok_or_else(|| {
                    format!("image {}: point {id} is not among the points", row.name)
                })?;
                let image_px = feature.image_px;
                model.survey.observations.push(Observation { image, point, image_px });
            }
        }
        model.survey.images.push(Image {
            name: row.name,
            id: row.id,
            camera,
            pose: from_computer_vision(rotation::normalize(row.rotation), row.translation),
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        });
        model.features.push(row.features);
    }
    names_once(&model.survey)?;
    Ok(model)
}

/// Writes a model into a folder that exists: three files.
///
/// # Errors
/// A lens that COLMAP has no model for; otherwise as [`super::output::write`].
pub fn write(folder: &Path, model: &Model, form: Form, force: bool) -> Result<(), FileError> {
    let rows = rows(model).map_err(|message| FileError::malformed(folder, None, message))?;
    let tracks = tracks(model, &rows.1);
    let path = |name: &str| folder.join(format!("{name}.{}", form.extension()));
    for name in ["cameras", "images", "points3D"] {
        super::output::check(&path(name), force)?;
    }
    let (cameras, images, points) = match form {
        Form::Text => text::write(&rows, &model.survey, &tracks),
        Form::Binary => binary::write(&rows, &model.survey, &tracks),
    };
    for (name, bytes) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        super::output::write(&path(name), force, |out| out.write_all(&bytes))?;
    }
    Ok(())
}

type Rows = (Vec<CameraRow>, Vec<ImageRow>);

fn rows(model: &Model) -> Result<Rows, String> {
    let survey = &model.survey;
    let ids: Vec<u32> = if model.camera_ids.len() == survey.cameras.len() {
        model.camera_ids.clone()
    } else {
        (1..=survey.cameras.len() as u32).collect()
    };
    let cameras = survey.cameras.iter().zip(&ids).map(|(camera, &id)| {
        let interior = &camera.interior;
        let (lens, values) = match as_brown(interior) {
            Some(values) => (LensModel::Brown, values.to_vec()),
            None => (interior.model(), interior.values().to_vec()),
        };
        let found = KINDS
            .iter()
            .find_map(|kind| kind.parameters(lens, &values).map(|parameters| (*kind, parameters)));
        let (kind, parameters) = found.ok_or_else(|| {
            format!(
                "camera {:?}: COLMAP has no lens like the {} model; write camera.toml beside a block in another format",
                camera.name,
                lens.word()
            )
        })?;
        let kind = ReadKind::Ours(kind);
        Ok(CameraRow { id, kind, size: interior.size_px().map(u64::from), parameters })
    });
    let cameras = cameras.collect::<Result<Vec<_>, String>>()?;
    let features = model.features_to_write();
    let images = survey.images.iter().zip(features).map(|(image, features)| {
        let (rotation, translation) = to_computer_vision(&image.pose);
        ImageRow {
            id: image.id,
            rotation,
            translation,
            camera: ids[image.camera],
            name: image.name.clone(),
            features,
        }
    });
    Ok((cameras, images.collect()))
}

/// Per point: image numbers and places among their features.
fn tracks(model: &Model, images: &[ImageRow]) -> Vec<Vec<(u32, u32)>> {
    let points = &model.survey.points;
    let places: HashMap<u64, usize> =
        points.iter().enumerate().map(|(place, point)| (point.id, place)).collect();
    let mut tracks = vec![Vec::new(); points.len()];
    for image in images {
        for (k, feature) in image.features.iter().enumerate() {
            if let Some(place) = feature.point.and_then(|id| places.get(&id)) {
                tracks[*place].push((image.id, k as u32));
            }
        }
    }
    tracks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_and_images_are_there_once() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |cameras: &str, images: &str| {
            for (name, text) in [("cameras", cameras), ("images", images), ("points3D", "")] {
                std::fs::write(folder.path().join(format!("{name}.txt")), text).unwrap();
            }
            read(folder.path()).map(drop).map_err(|error| error.to_string())
        };
        let camera = "1 SIMPLE_PINHOLE 40 30 50 20 15\n";
        let images = "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 1 0 0 1 b.jpg\n\n";
        assert_eq!(refused(camera, images), Ok(()));
        for (cameras, images, part) in [
            (camera.repeat(2), images.to_owned(), "camera 1: its number is there twice"),
            (camera.to_owned(), images.replace("2 1 0", "1 1 0"), "its number 1 is there twice"),
            (camera.to_owned(), images.replace("b.jpg", "a.jpg"), "two images are called"),
        ] {
            let error = refused(&cameras, &images).unwrap_err();
            assert!(error.contains(part), "{error}");
        }
    }
}
