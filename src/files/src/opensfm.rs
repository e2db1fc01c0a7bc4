//! OpenSfM's `reconstruction.json` with the `tracks.csv` that holds its measurements.
//!
//! Poses are `camera_from_world` as rotation vectors, the camera frame having `y` down and `z` forward.
//! Positions and lenses are normalised: from the image centre, in units of the larger side. Which
//! lens a camera has is its `projection_type`: `perspective`, `simple_radial`, `radial`, `brown`, `fisheye`,
//! `fisheye_opencv`; others are refused by name.
//!
//! A file may hold several reconstructions; the largest is taken, the others are counted.
//!
//! Reference: <https://opensfm.org/docs/dataset.html>.

use super::{
    FileError,
    model::{Model, as_brown, from_computer_vision, names_once, to_computer_vision},
    output,
};
use rowgram_optim::geometry::rotation;
use rowgram_survey::{
    camera::{Camera, Interior, Lens, Model as LensModel},
    scene::{Image, Observation, Reconstruction, TiePoint},
};
use serde_json::{Map, Value, json};
use std::{collections::HashMap, path::Path};

/// Reads a reconstruction and the measurements in `tracks` of its points in its images.
///
/// # Errors
/// Where a file cannot be read or is no such file; names the camera, shot or point, or the line.
pub fn read(path: &Path, tracks: &Path) -> Result<Model, FileError> {
    let mut model = read_poses(path)?;
    let text = crate::memory::read_text(tracks)?;
    measurements(&text, &mut model)
        .map_err(|(line, message)| FileError::malformed(tracks, line, message))?;
    Ok(model)
}

/// Reads cameras and poses only; points and their measurements need not be there.
///
/// # Errors
/// As [`read`].
pub fn read_poses(path: &Path) -> Result<Model, FileError> {
    let text = crate::memory::read_text(path)?;
    let file: Value = serde_json::from_str(&text)
        .map_err(|e| FileError::malformed(path, e.line(), e.to_string()))?;
    parse(&file).map_err(|message| FileError::malformed(path, None, message))
}

fn parse(file: &Value) -> Result<Model, String> {
    let all = file.as_array().ok_or("expected a list of reconstructions")?;
    let size = |r: &&Value| r["shots"].as_object().map_or(0, Map::len);
    let reconstruction =
        all.iter().rev().max_by_key(size).ok_or("the file holds no reconstruction")?;
    if all.len() > 1 {
        let others: usize = all.iter().map(|other| size(&other)).sum();
        let (others, shots) = (others - size(&reconstruction), size(&reconstruction));
        tracing::warn!(
            "the file holds {} reconstructions: the largest is taken, of {shots} shots; {others} shots of the others are left out",
            all.len()
        );
    }
    let object = |key: &str| {
        reconstruction[key].as_object().ok_or_else(|| format!("expected an object {key:?}"))
    };
    let mut model = Model {
        survey: Reconstruction { tie_sigma_px: 1.0, ..Reconstruction::default() },
        ..Model::default()
    };
    let mut cameras: HashMap<&str, usize> = HashMap::new();
    for (name, camera) in object("cameras")? {
        let interior = lens(camera).map_err(|message| format!("camera {name:?}: {message}"))?;
        cameras.insert(name, model.survey.cameras.len());
        model.survey.cameras.push(Camera::new(name, interior));
    }
    for (k, (name, shot)) in object("shots")?.iter().enumerate() {
        let wrong = |message: String| format!("shot {name:?}: {message}");
        let camera = shot["camera"].as_str().unwrap_or_default();
        let camera = *cameras
            .get(camera)
            .ok_or_else(|| wrong(format!("its camera {camera:?} is not among the cameras")))?;
        let rotation = rotation::exp(vector(shot, "rotation").map_err(wrong)?);
        let translation = vector(shot, "translation").map_err(wrong)?;
        model.survey.images.push(Image {
            name: name.clone(),
            id: k as u32,
            camera,
            pose: from_computer_vision(rotation, translation),
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        });
    }
    let none = Map::new();
    for (name, point) in reconstruction["points"].as_object().unwrap_or(&none) {
        let wrong = |message: String| format!("point {name:?}: {message}");
        let id = name.parse().map_err(|_| wrong("expected a number as its name".into()))?;
        let position_m = vector(point, "coordinates").map_err(wrong)?;
        let colour = vector(point, "color").unwrap_or([0.0; 3]).map(|c| c.clamp(0.0, 255.0) as u8);
        model.survey.points.push(TiePoint { id, position_m, colour });
    }
    Ok(model)
}

fn vector(of: &Value, key: &str) -> Result<[f64; 3], String> {
    let list = of[key].as_array().filter(|list| list.len() == 3);
    let list = list.ok_or_else(|| format!("expected three numbers {key:?}"))?;
    let mut out = [0.0; 3];
    for (to, value) in out.iter_mut().zip(list) {
        *to = value
            .as_f64()
            .filter(|v| v.is_finite())
            .ok_or_else(|| format!("{key:?} holds {value}, expected a finite number"))?;
    }
    Ok(out)
}

/// The larger side: what positions are normalised by.
fn unit_px(size_px: [u32; 2]) -> f64 {
    f64::from(size_px[0].max(size_px[1]))
}

fn lens(camera: &Value) -> Result<Interior, String> {
    let size = |key: &str| {
        camera[key]
            .as_u64()
            .and_then(|n| u32::try_from(n).ok())
            .ok_or_else(|| format!("expected a number of pixels {key:?}"))
    };
    let size_px = [size("width")?, size("height")?];
    let number = |key: &str| -> Result<f64, String> {
        camera[key].as_f64().ok_or_else(|| match &camera[key] {
            Value::Null => format!("expected a number {key:?}"),
            other => format!("{key:?} is {other}, expected a number"),
        })
    };
    let or_zero = |key: &str| if camera[key].is_null() { Ok(0.0) } else { number(key) };
    let unit = unit_px(size_px);
    let centre = rowgram_survey::camera::image_centre_px(size_px);
    let kind = camera["projection_type"].as_str().unwrap_or("perspective");
    let model = match kind {
        "perspective" | "simple_radial" | "radial" | "brown" => LensModel::Brown,
        "fisheye" | "fisheye_opencv" => LensModel::Fisheye,
        other => {
            return Err(format!(
                "the projection type {other:?} is not supported, expected perspective, simple_radial, radial, brown, fisheye or fisheye_opencv"
            ));
        }
    };
    let (fx, fy) = match kind {
        "perspective" | "fisheye" => (number("focal")?, number("focal")?),
        _ => (number("focal_x")?, number("focal_y")?),
    };
    let principal = [centre[0] + unit * or_zero("c_x")?, centre[1] + unit * or_zero("c_y")?];
    let start = [unit * fx, if fx == fy { 1.0 } else { fy / fx }, principal[0], principal[1]];
    let terms: &[&str] = match model {
        LensModel::Fisheye => &["k1", "k2", "k3", "k4"],
        _ => &["k1", "k2", "p1", "p2", "k3"],
    };
    let mut rest = terms.iter().map(|key| or_zero(key)).collect::<Result<Vec<f64>, String>>()?;
    rest.resize(model.parameters().len() - start.len(), 0.0);
    let values = [start.to_vec(), rest].concat();
    Interior::new(model, size_px, &values).map_err(|error| error.to_string())
}

/// Adds what `tracks.csv` says of points and images that are there.
fn measurements(text: &str, model: &mut Model) -> Result<(), (Option<usize>, String)> {
    let survey = &mut model.survey;
    let images: HashMap<&str, u32> =
        survey.images.iter().enumerate().map(|(k, i)| (i.name.as_str(), k as u32)).collect();
    let points: HashMap<u64, u32> =
        survey.points.iter().enumerate().map(|(k, p)| (p.id, k as u32)).collect();
    let mut found = Vec::new();
    for (k, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with("OPENSFM_TRACKS_VERSION") {
            continue;
        }
        let fields: Vec<&str> = line.split('\t').collect();
        if fields.len() < 5 {
            let message = format!("expected at least five columns, found {}", fields.len());
            return Err((Some(k + 1), message));
        }
        let number = |field: &str| -> Result<f64, (Option<usize>, String)> {
            let value = field.trim().parse::<f64>().ok().filter(|v| v.is_finite());
            value.ok_or_else(|| (Some(k + 1), format!("{field:?}, expected a finite number")))
        };
        let track: u64 = fields[1].trim().parse().map_err(|_| {
            (Some(k + 1), format!("the track is {:?}, expected a number", fields[1]))
        })?;
        let normalised = [number(fields[3])?, number(fields[4])?];
        // Tracks of other images, and those that were not triangulated.
        if let (Some(&image), Some(&point)) = (images.get(fields[0]), points.get(&track)) {
            found.push((image, point, normalised));
        }
    }
    for (image, point, [x, y]) in found {
        let size_px = survey.cameras[survey.images[image as usize].camera].interior.size_px();
        let [cu, cv] = rowgram_survey::camera::image_centre_px(size_px);
        let unit = unit_px(size_px);
        let image_px = [cu + unit * x, cv + unit * y];
        survey.observations.push(Observation { image, point, image_px });
    }
    if survey.observations.is_empty() {
        return Err((
            None,
            "no track is one of the reconstruction's points in one of its shots".into(),
        ));
    }
    Ok(())
}

/// Writes a reconstruction and its measurements.
///
/// # Errors
/// A lens that the format cannot hold; otherwise as [`output::write`].
pub fn write(path: &Path, tracks: &Path, model: &Model, force: bool) -> Result<(), FileError> {
    output::check(tracks, force)?;
    names_once(&model.survey).map_err(|message| FileError::malformed(path, None, message))?;
    let file = to_value(model).map_err(|message| FileError::malformed(path, None, message))?;
    output::write_json(path, force, &file)?;
    let survey = &model.survey;
    output::write(tracks, force, |out| {
        writeln!(out, "OPENSFM_TRACKS_VERSION_v2")?;
        let mut features = vec![0usize; survey.images.len()];
        for o in &survey.observations {
            let image = &survey.images[o.image as usize];
            let point = &survey.points[o.point as usize];
            let size_px = survey.cameras[image.camera].interior.size_px();
            let [cu, cv] = rowgram_survey::camera::image_centre_px(size_px);
            let unit = unit_px(size_px);
            let at = [(o.image_px[0] - cu) / unit, (o.image_px[1] - cv) / unit];
            let feature = &mut features[o.image as usize];
            let [r, g, b] = point.colour;
            writeln!(
                out,
                "{}\t{}\t{feature}\t{}\t{}\t0.001\t{r}\t{g}\t{b}\t-1\t-1",
                image.name, point.id, at[0], at[1]
            )?;
            *feature += 1;
        }
        Ok(())
    })
}

fn to_value(model: &Model) -> Result<Value, String> {
    let survey = &model.survey;
    let mut cameras = Map::new();
    let mut names: Vec<String> = Vec::new();
    for (k, camera) in survey.cameras.iter().enumerate() {
        let plain = !camera.name.is_empty() && !cameras.contains_key(&camera.name);
        let name = if plain { camera.name.clone() } else { format!("camera {}", k + 1) };
        let value = of_lens(&camera.interior).ok_or_else(|| {
            format!(
                "camera {:?}: OpenSfM has no lens that holds this {} one",
                camera.name,
                camera.interior.model().word()
            )
        })?;
        cameras.insert(name.clone(), value);
        names.push(name);
    }
    let mut shots = Map::new();
    for image in &survey.images {
        let (rotation, translation) = to_computer_vision(&image.pose);
        shots.insert(
            image.name.clone(),
            json!({
                "rotation": rotation::log(rotation),
                "translation": translation,
                "camera": names[image.camera],
            }),
        );
    }
    let points: Map<String, Value> = survey
        .points
        .iter()
        .map(|point| {
            let colour = point.colour.map(f64::from);
            (point.id.to_string(), json!({ "coordinates": point.position_m, "color": colour }))
        })
        .collect();
    Ok(json!([{ "cameras": cameras, "shots": shots, "points": points }]))
}

fn of_lens(interior: &Interior) -> Option<Value> {
    let size_px = interior.size_px();
    let unit = unit_px(size_px);
    let centre = rowgram_survey::camera::image_centre_px(size_px);
    let mut value = json!({ "width": size_px[0], "height": size_px[1] });
    let mut put = |key: &str, number: f64| value[key] = json!(number);
    match (interior.model(), as_brown(interior)) {
        (_, Some(v)) if v[9..].iter().all(|&k| k == 0.0) => {
            let simple = v[1] == 1.0 && v[2] == centre[0] && v[3] == centre[1];
            let kind = if simple && v[6..9].iter().all(|&k| k == 0.0) {
                put("focal", v[0] / unit);
                "perspective"
            } else {
                put("focal_x", v[0] / unit);
                put("focal_y", v[0] * v[1] / unit);
                put("c_x", (v[2] - centre[0]) / unit);
                put("c_y", (v[3] - centre[1]) / unit);
                put("p1", v[6]);
                put("p2", v[7]);
                put("k3", v[8]);
                "brown"
            };
            put("k1", v[4]);
            put("k2", v[5]);
            value["projection_type"] = json!(kind);
        }
        (LensModel::Fisheye, _) => {
            let v = interior.values();
            let simple = v[1] == 1.0 && v[2] == centre[0] && v[3] == centre[1];
            let kind = if simple && v[6] == 0.0 && v[7] == 0.0 {
                put("focal", v[0] / unit);
                "fisheye"
            } else {
                put("focal_x", v[0] / unit);
                put("focal_y", v[0] * v[1] / unit);
                put("c_x", (v[2] - centre[0]) / unit);
                put("c_y", (v[3] - centre[1]) / unit);
                put("k3", v[6]);
                put("k4", v[7]);
                "fisheye_opencv"
            };
            put("k1", v[4]);
            put("k2", v[5]);
            value["projection_type"] = json!(kind);
        }
        _ => return None,
    }
    Some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lens_that_cannot_be_read_is_refused_by_its_term_or_projection() {
        let camera = |kind: &str, k1: Value| {
            let camera = json!({ "projection_type": kind, "width": 40, "height": 30, "focal": 0.9, "k1": k1 });
            lens(&camera)
        };
        assert_eq!(camera("perspective", json!(-0.1)).unwrap().value("k1"), Some(-0.1));
        assert_eq!(camera("fisheye", Value::Null).unwrap().value("k1"), Some(0.0));
        let error = camera("perspective", json!("-0.1")).unwrap_err();
        assert!(error.contains("\"k1\" is \"-0.1\""), "{error}");
        for kind in ["spherical", "dual"] {
            let error = camera(kind, json!(0.0)).unwrap_err();
            assert!(error.contains(kind) && error.contains("expected perspective"), "{error}");
        }
    }
}
