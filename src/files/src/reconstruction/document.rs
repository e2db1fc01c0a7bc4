//! `reconstruction.json` as serde sees it: one record per line, images and ground points by their names.

use super::{FORMAT, VERSION};
use rowgram_survey::{
    camera::{Camera, Correlation, Interior, Lens, Model},
    scene::{
        Accuracy, CameraOrientation, CameraPosition, CameraSigma, Excluded, GroundObservation,
        GroundPoint, Image, Pose, PoseSigma, Reconstruction, ReferenceFrame, RollingShutter,
        ScaleBar,
    },
};
use serde::{Deserialize, Serialize};
use std::{
    collections::{BTreeMap, HashMap},
    fmt::Write as _,
};

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Document {
    pub(super) format: String,
    pub(super) version: u32,
    reference: ReferenceFrame,
    pub(super) tie_point_count: usize,
    pub(super) tie_observation_count: usize,
    tie_sigma_px: f64,
    lever_arm_m: [f64; 3],
    rolling_shutter: Option<RollingShutter>,
    /// Absent where nothing was adjusted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sigma0: Option<f64>,
    cameras: Vec<CameraRecord>,
    images: Vec<ImageRecord>,
    ground_points: Vec<GroundPoint>,
    marks: Vec<MarkRecord>,
    camera_positions: Vec<PositionRecord>,
    /// Absent where there are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    camera_orientations: Vec<OrientationRecord>,
    scale_bars: Vec<BarRecord>,
    excluded: Vec<Excluded>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraRecord {
    name: String,
    model: Model,
    width_px: u32,
    height_px: u32,
    parameters: BTreeMap<String, f64>,
    free: Vec<String>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    standard_deviations: BTreeMap<String, f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    expected: Option<BTreeMap<String, f64>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    correlation: Option<Correlation>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    accuracy: Option<CameraSigma>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ImageRecord {
    name: String,
    id: u32,
    /// Index of its camera.
    camera: usize,
    rotation_wxyz: [f64; 4],
    translation_m: [f64; 3],
    #[serde(default, skip_serializing_if = "is_still")]
    motion: [f64; 6],
    #[serde(default, skip_serializing_if = "is_still")]
    expected_motion: [f64; 6],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    accuracy: Option<PoseSigma>,
}

fn is_still(motion: &[f64; 6]) -> bool {
    motion.iter().all(|v| v.to_bits() == 0)
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct MarkRecord {
    image: String,
    point: String,
    image_px: [f64; 2],
    sigma_px: f64,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PositionRecord {
    image: String,
    position_m: [f64; 3],
    sigma_m: [f64; 3],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OrientationRecord {
    image: String,
    rotation_wxyz: [f64; 4],
    sigma_rad: [f64; 3],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BarRecord {
    from: String,
    to: String,
    length_m: f64,
    sigma_m: f64,
}

impl CameraRecord {
    fn of(camera: &Camera, accuracy: Option<&CameraSigma>) -> CameraRecord {
        let parameters = camera.interior.parameters();
        let named = |values: &[f64]| -> BTreeMap<String, f64> {
            parameters.iter().zip(values).map(|(p, v)| (p.name.to_owned(), *v)).collect()
        };
        let sigmas = parameters.iter().zip(&camera.standard_deviations);
        let free = parameters.iter().zip(&camera.free).filter(|(_, free)| **free);
        let [width_px, height_px] = camera.interior.size_px();
        CameraRecord {
            name: camera.name.clone(),
            model: camera.interior.model(),
            width_px,
            height_px,
            parameters: named(camera.interior.values()),
            free: free.map(|(parameter, _)| parameter.name.to_owned()).collect(),
            standard_deviations: sigmas
                .filter_map(|(parameter, sigma)| Some((parameter.name.to_owned(), (*sigma)?)))
                .collect(),
            expected: camera.expected.as_deref().map(named),
            correlation: camera.correlation.clone(),
            accuracy: accuracy.cloned(),
        }
    }

    fn camera(&self) -> Result<Camera, String> {
        let wrong = |why: String| format!("camera {:?}: {why}", self.name);
        let all = |key: &str, table: &BTreeMap<String, f64>| -> Result<Vec<f64>, String> {
            self.known(key, table.keys()).map_err(wrong)?;
            self.model
                .parameters()
                .iter()
                .map(|parameter| {
                    let value = table.get(parameter.name).copied();
                    value.ok_or_else(|| wrong(format!("{key}: {} is missing", parameter.name)))
                })
                .collect()
        };
        let size_px = [self.width_px, self.height_px];
        let interior = Interior::new(self.model, size_px, &all("parameters", &self.parameters)?)
            .map_err(|e| wrong(format!("parameters: {e}")))?;
        let mut camera = Camera::new(&self.name, interior);
        camera.set_free(&self.free).map_err(|e| wrong(format!("free: {e}")))?;
        self.known("standard_deviations", self.standard_deviations.keys()).map_err(wrong)?;
        for (parameter, sigma) in
            self.model.parameters().iter().zip(&mut camera.standard_deviations)
        {
            *sigma = self.standard_deviations.get(parameter.name).copied();
        }
        camera.expected = match &self.expected {
            Some(expected) => Some(all("expected", expected)?),
            None => None,
        };
        camera.correlation.clone_from(&self.correlation);
        Ok(camera)
    }

    fn known<'k>(
        &self,
        key: &str,
        mut names: impl Iterator<Item = &'k String>,
    ) -> Result<(), String> {
        match names.find(|name| self.model.place(name).is_none()) {
            Some(name) => {
                Err(format!("{key}: the {} model has no parameter {name:?}", self.model.word()))
            }
            None => Ok(()),
        }
    }
}

/// The places of names.
fn places<'n>(names: impl Iterator<Item = &'n str>) -> HashMap<&'n str, u32> {
    names.zip(0..).collect()
}

fn found(places: &HashMap<&str, u32>, what: &str, name: &str, by: &str) -> Result<u32, String> {
    places.get(name).copied().ok_or_else(|| format!("{by}: there is no {what} {name:?}"))
}

impl Document {
    pub(super) fn of(scene: &Reconstruction) -> Result<Document, String> {
        let image = |k: u32, by: &str| match scene.images.get(k as usize) {
            Some(image) => Ok(image.name.clone()),
            None => Err(format!("{by}: there is no image with index {k}")),
        };
        let ground = |k: u32, by: &str| match scene.ground.get(k as usize) {
            Some(point) => Ok(point.name.clone()),
            None => Err(format!("{by}: there is no ground point with index {k}")),
        };
        let accuracy = scene.accuracy.as_ref();
        if let Some(known) = accuracy
            && (known.images.len(), known.cameras.len(), known.points_m.len())
                != (scene.images.len(), scene.cameras.len(), scene.points.len())
        {
            return Err(
                "accuracy: expected an entry for every image, camera and tie point".to_owned()
            );
        }
        let of_image = |k: usize| accuracy.map(|accuracy| accuracy.images[k]);
        let of_camera = |k: usize| accuracy.map(|accuracy| &accuracy.cameras[k]);
        let images = scene.images.iter().enumerate().map(|(k, image)| ImageRecord {
            name: image.name.clone(),
            id: image.id,
            camera: image.camera,
            rotation_wxyz: image.pose.rotation,
            translation_m: image.pose.translation,
            motion: image.motion,
            expected_motion: image.expected_motion,
            accuracy: of_image(k),
        });
        let marks = scene.marks.iter().map(|mark| {
            Ok(MarkRecord {
                image: image(mark.image, "marks")?,
                point: ground(mark.ground, "marks")?,
                image_px: mark.image_px,
                sigma_px: mark.sigma_px,
            })
        });
        let positions = scene.positions.iter().map(|position| {
            Ok(PositionRecord {
                image: image(position.image, "camera positions")?,
                position_m: position.position_m,
                sigma_m: position.sigma_m,
            })
        });
        let orientations = scene.orientations.iter().map(|known| {
            Ok(OrientationRecord {
                image: image(known.image, "camera orientations")?,
                rotation_wxyz: known.rotation,
                sigma_rad: known.sigma_rad,
            })
        });
        let bars = scene.scale_bars.iter().map(|bar| {
            Ok(BarRecord {
                from: ground(bar.ends[0], "scale bars")?,
                to: ground(bar.ends[1], "scale bars")?,
                length_m: bar.length_m,
                sigma_m: bar.sigma_m,
            })
        });
        Ok(Document {
            format: FORMAT.to_owned(),
            version: VERSION,
            reference: scene.reference.clone(),
            tie_point_count: scene.points.len(),
            tie_observation_count: scene.observations.len(),
            tie_sigma_px: scene.tie_sigma_px,
            lever_arm_m: scene.lever_arm_m,
            rolling_shutter: scene.rolling_shutter,
            sigma0: accuracy.map(|accuracy| accuracy.sigma0),
            cameras: (0..scene.cameras.len())
                .map(|k| CameraRecord::of(&scene.cameras[k], of_camera(k)))
                .collect(),
            images: images.collect(),
            ground_points: scene.ground.clone(),
            marks: marks.collect::<Result<_, String>>()?,
            camera_positions: positions.collect::<Result<_, String>>()?,
            camera_orientations: orientations.collect::<Result<_, String>>()?,
            scale_bars: bars.collect::<Result<_, String>>()?,
            excluded: scene.excluded.clone(),
        })
    }

    /// The reconstruction, without its tie points.
    pub(super) fn scene(self) -> Result<Reconstruction, String> {
        let images = places(self.images.iter().map(|image| image.name.as_str()));
        let ground = places(self.ground_points.iter().map(|point| point.name.as_str()));
        if images.len() != self.images.len() {
            return Err("images: two of them have the same name".to_owned());
        }
        if ground.len() != self.ground_points.len() {
            return Err("ground_points: two of them have the same name".to_owned());
        }
        let cameras: Vec<Camera> =
            self.cameras.iter().map(CameraRecord::camera).collect::<Result<_, String>>()?;
        if let Some(image) = self.images.iter().find(|image| image.camera >= cameras.len()) {
            let (name, camera) = (&image.name, image.camera);
            return Err(format!("image {name:?}: there is no camera with index {camera}"));
        }
        let accuracy = match self.sigma0 {
            None => None,
            Some(sigma0) => Some(Accuracy {
                sigma0,
                images: self
                    .images
                    .iter()
                    .map(|image| {
                        let missing = || format!("image {:?}: accuracy is missing", image.name);
                        image.accuracy.ok_or_else(missing)
                    })
                    .collect::<Result<_, String>>()?,
                cameras: self
                    .cameras
                    .iter()
                    .map(|camera| camera.accuracy.clone().unwrap_or_default())
                    .collect(),
                points_m: Vec::new(),
            }),
        };
        let marks = self.marks.iter().map(|mark| {
            Ok(GroundObservation {
                image: found(&images, "image", &mark.image, "marks")?,
                ground: found(&ground, "ground point", &mark.point, "marks")?,
                image_px: mark.image_px,
                sigma_px: mark.sigma_px,
            })
        });
        let positions = self.camera_positions.iter().map(|position| {
            Ok(CameraPosition {
                image: found(&images, "image", &position.image, "camera_positions")?,
                position_m: position.position_m,
                sigma_m: position.sigma_m,
            })
        });
        let orientations = self.camera_orientations.iter().map(|known| {
            Ok(CameraOrientation {
                image: found(&images, "image", &known.image, "camera_orientations")?,
                rotation: known.rotation_wxyz,
                sigma_rad: known.sigma_rad,
            })
        });
        let bars = self.scale_bars.iter().map(|bar| {
            let end = |name: &str| found(&ground, "ground point", name, "scale_bars");
            Ok(ScaleBar {
                ends: [end(&bar.from)?, end(&bar.to)?],
                length_m: bar.length_m,
                sigma_m: bar.sigma_m,
            })
        });
        Ok(Reconstruction {
            reference: self.reference,
            cameras,
            images: self
                .images
                .iter()
                .map(|image| Image {
                    name: image.name.clone(),
                    id: image.id,
                    camera: image.camera,
                    pose: Pose { rotation: image.rotation_wxyz, translation: image.translation_m },
                    motion: image.motion,
                    expected_motion: image.expected_motion,
                })
                .collect(),
            points: Vec::new(),
            observations: Vec::new(),
            tie_sigma_px: self.tie_sigma_px,
            marks: marks.collect::<Result<_, String>>()?,
            positions: positions.collect::<Result<_, String>>()?,
            orientations: orientations.collect::<Result<_, String>>()?,
            scale_bars: bars.collect::<Result<_, String>>()?,
            ground: self.ground_points,
            lever_arm_m: self.lever_arm_m,
            rolling_shutter: self.rolling_shutter,
            accuracy,
            excluded: self.excluded,
        })
    }

    /// As text: a record of a list takes one line.
    pub(super) fn text(&self) -> Result<String, String> {
        let failed = |e: serde_json::Error| e.to_string();
        let value = serde_json::to_value(self).map_err(failed)?;
        let serde_json::Value::Object(entries) = value else { return Ok(String::new()) };
        let mut text = String::from("{\n");
        // The order of the definition, not of the alphabet.
        let (first, last): (Vec<_>, Vec<_>) =
            entries.iter().partition(|(_, value)| !is_list(value));
        let head = ["format", "version", "reference"];
        let rank = |key: &str| head.iter().position(|name| *name == key).unwrap_or(head.len());
        let mut ordered: Vec<_> = first.into_iter().chain(last).collect();
        ordered.sort_by_key(|(key, _)| rank(key));
        for (k, (key, value)) in ordered.iter().enumerate() {
            let end = if k + 1 < ordered.len() { "," } else { "" };
            match value.as_array().filter(|_| is_list(value)) {
                Some(records) if !records.is_empty() => {
                    let lines: Vec<String> =
                        records.iter().map(|record| format!("    {record}")).collect();
                    let _ = writeln!(text, "  \"{key}\": [\n{}\n  ]{end}", lines.join(",\n"));
                }
                _ => {
                    let _ = writeln!(text, "  \"{key}\": {value}{end}");
                }
            }
        }
        text.push_str("}\n");
        // What is not finite has become null.
        serde_json::from_str::<Document>(&text)
            .map_err(|e| format!("a number is not finite: {}", super::message(&text, &e)))?;
        Ok(text)
    }
}

/// Whether a value is a list of records.
fn is_list(value: &serde_json::Value) -> bool {
    value.as_array().is_some_and(|all| all.iter().all(serde_json::Value::is_object))
}
