//! Orthority's interior parameter files.
//!
//! ```yaml
//! Name:
//!   type: brown            # pinhole, brown, opencv or fisheye
//!   im_size: [640, 1152]
//!   focal_len: 120.0       # one or two numbers, in the unit of sensor_size; without that, of the larger side
//!   sensor_size: [92.16, 165.888]
//!   cx: 0.0                # from the image's centre, in units of the larger side
//!   cy: 0.0
//!   k1: 0.0                # the terms of the type
//! ```
//!
//! Only this shape of YAML is read: names, and below each `key: value` with numbers, lists of numbers and words.
//! Reference: <https://orthority.readthedocs.io/en/latest/file_formats/oty_int_param.html>.

use super::{FileError, words::Fault};
use rowgram_survey::camera::{Camera, Interior, Model, image_centre_px};
use std::{collections::BTreeMap, path::Path};

/// Reads the cameras of a file.
///
/// # Errors
/// Names the file, and the line or the camera.
pub fn read(path: &Path) -> Result<Vec<Camera>, FileError> {
    let text = crate::memory::read_text(path)?;
    parse(&text).map_err(|(line, message)| FileError::malformed(path, line, message))
}

fn parse(text: &str) -> Result<Vec<Camera>, Fault> {
    let mut cameras: Vec<(String, BTreeMap<String, String>)> = Vec::new();
    for (k, line) in text.lines().enumerate() {
        let line = line.split(" #").next().unwrap_or_default().trim_end();
        if line.trim().is_empty() || line.starts_with('#') || line == "---" {
            continue;
        }
        let fault = |message: String| (Some(k + 1), message);
        let (key, value) = line
            .rsplit_once(": ")
            .or_else(|| line.strip_suffix(':').map(|key| (key, "")))
            .ok_or_else(|| fault(format!("{line:?}, expected \"key: value\"")))?;
        let indented = line.starts_with([' ', '\t']);
        match (indented, cameras.last_mut()) {
            (false, _) if value.is_empty() => {
                cameras.push((key.trim_matches(['"', '\'']).to_owned(), BTreeMap::new()));
            }
            (true, Some((_, values))) => {
                values.insert(key.trim().to_owned(), value.trim().to_owned());
            }
            _ => return Err(fault(format!("{line:?}, expected the name of a camera and a colon"))),
        }
    }
    if cameras.is_empty() {
        return Err((None, "it holds no camera".into()));
    }
    cameras
        .into_iter()
        .map(|(name, values)| {
            let interior = interior(&values)
                .map_err(|message| (None, format!("camera {name:?}: {message}")))?;
            Ok(Camera::new(&name, interior))
        })
        .collect()
}

fn interior(values: &BTreeMap<String, String>) -> Result<Interior, String> {
    let numbers = |key: &str| -> Result<Option<Vec<f64>>, String> {
        let Some(text) = values.get(key) else { return Ok(None) };
        let list = text.trim_matches(['[', ']']).split(',');
        let parsed: Option<Vec<f64>> = list.map(|n| n.trim().parse().ok()).collect();
        parsed.map(Some).ok_or_else(|| format!("{key} is {text:?}, expected numbers"))
    };
    let two = |key: &str| -> Result<Option<[f64; 2]>, String> {
        match numbers(key)?.as_deref() {
            None => Ok(None),
            Some(&[a]) => Ok(Some([a, a])),
            Some(&[a, b]) => Ok(Some([a, b])),
            Some(_) => Err(format!("{key}: expected one or two numbers")),
        }
    };
    let term = |key: &str| Ok::<f64, String>(two(key)?.map_or(0.0, |v| v[0]));
    let size = two("im_size")?.ok_or("expected im_size")?;
    let size_px = size.map(|n| n as u32);
    let focal = two("focal_len")?.ok_or("expected focal_len")?;
    let larger = size[0].max(size[1]);
    let f = match two("sensor_size")? {
        Some(sensor) => [0, 1].map(|k| focal[k] * size[k] / sensor[k]),
        None => focal.map(|f| f * larger),
    };
    let centre = image_centre_px(size_px);
    let principal = [centre[0] + larger * term("cx")?, centre[1] + larger * term("cy")?];
    let mut list = vec![f[0], f[1] / f[0], principal[0], principal[1]];
    let kind = values.get("type").map_or("", String::as_str);
    let (model, terms): (Model, &[&str]) = match kind {
        "pinhole" => (Model::Brown, &["", "", "", "", "", "", "", ""]),
        "brown" => (Model::Brown, &["k1", "k2", "p1", "p2", "k3", "", "", ""]),
        "opencv" => (Model::Brown, &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]),
        "fisheye" => (Model::Fisheye, &["k1", "k2", "k3", "k4"]),
        other => {
            return Err(format!("type {other:?}, expected pinhole, brown, opencv or fisheye"));
        }
    };
    for prism in ["s1", "s2", "s3", "s4", "tx", "ty"] {
        if term(prism)? != 0.0 {
            return Err(format!("{prism} is not 0; lenses with prism or tilt terms are not known"));
        }
    }
    for name in terms {
        list.push(if name.is_empty() { 0.0 } else { term(name)? });
    }
    Interior::new(model, size_px, &list).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_survey::camera::Lens;

    #[test]
    fn the_documented_shape_is_read() {
        let text = "DMC:\n    type: pinhole\n    im_size: [640, 1152]\n    focal_len: 120.0\n    \
                    sensor_size: [92.16, 165.888]\n    cx: 0.0\n    cy: 0.0\n\
                    \"dji 0.66\":\n  type: brown\n  im_size: [1368, 912]\n  focal_len: 0.5\n  cx: 0.01\n  k1: -0.2 # barrel\n";
        let cameras = parse(text).unwrap();
        assert_eq!((cameras.len(), cameras[1].name.as_str()), (2, "dji 0.66"));
        let values = cameras[0].interior.values();
        approx::assert_relative_eq!(values[0], 120.0 / 0.144, epsilon = 1e-9);
        assert_eq!(values[2..4], [319.5, 575.5]);
        let values = cameras[1].interior.values();
        assert_eq!((values[0], values[4]), (684.0, -0.2));
        approx::assert_relative_eq!(values[2], 683.5 + 13.68, epsilon = 1e-9);
        assert!(parse("a:\n  type: egg\n  im_size: [3, 3]\n  focal_len: 1\n").is_err());
    }
}
