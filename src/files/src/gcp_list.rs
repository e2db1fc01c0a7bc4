//! Control in the forms of other programs: OpenDroneMap's `gcp_list.txt`, OpenSfM's
//! `ground_control_points.json`, and tables of geographic camera positions.
//!
//! `gcp_list.txt`: a first line that names the coordinate reference system, then per mark
//! `x y z u v image [name]`, separated by blanks or tabs; a name that begins with `CHK-` is a check
//! point. Without names, marks with the same coordinates are one point.

use super::{FileError, control::Defaults, photo::Geotag, table::Table};
use rowgram_survey::scene::{Axes, GroundPoint, Role};
use std::path::Path;

/// A mark that is not yet joined to an image.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedMark {
    /// What the file calls the image.
    pub image: String,
    /// Index of the ground point.
    pub ground: usize,
    /// Pixels.
    pub image_px: [f64; 2],
    /// Its line.
    pub line: usize,
}

/// Control with the words that name its reference system.
#[derive(Debug, Clone, PartialEq)]
pub struct Control {
    /// The words, where the file has any.
    pub crs: Option<String>,
    /// The points, where they are degrees instead of metres: latitude, longitude, height.
    pub geographic: bool,
    /// The points.
    pub ground: Vec<GroundPoint>,
    /// Their marks.
    pub marks: Vec<NamedMark>,
}

/// Reads a `gcp_list.txt`.
///
/// # Errors
/// Lines that are none; names the line and what was expected.
pub fn read(path: &Path, defaults: &Defaults) -> Result<Control, FileError> {
    let text = std::fs::read_to_string(path).map_err(|e| FileError::read(path, e))?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    parse(text, defaults).map_err(|(line, message)| FileError::malformed(path, line, message))
}

fn parse(text: &str, defaults: &Defaults) -> Result<Control, (usize, String)> {
    let mut control =
        Control { crs: None, geographic: false, ground: Vec::new(), marks: Vec::new() };
    let mut places: Vec<[f64; 3]> = Vec::new();
    for (k, line) in text.lines().enumerate() {
        let (number, line) = (k + 1, line.trim());
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if control.crs.is_none() {
            control.crs = Some(line.to_owned());
            control.geographic = line.contains("+proj=longlat")
                || line.eq_ignore_ascii_case("EPSG:4326")
                || line.eq_ignore_ascii_case("WGS84");
            continue;
        }
        let fields: Vec<&str> = line.split_whitespace().collect();
        if fields.len() < 6 {
            let message =
                format!("expected `x y z u v image [name]`, found {} fields", fields.len());
            return Err((number, message));
        }
        let value = |at: usize| -> Result<f64, (usize, String)> {
            fields[at].parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| {
                (
                    number,
                    format!("{:?} is no number; expected `x y z u v image [name]`", fields[at]),
                )
            })
        };
        let position = [value(0)?, value(1)?, value(2)?];
        let name = fields.get(6).map(|name| (*name).to_owned());
        let known = (0..places.len()).find(|&at| match &name {
            Some(name) => control.ground[at].name == *name,
            None => places[at] == position,
        });
        let ground = match known {
            Some(at) if places[at] != position => {
                let message = format!("{} has other coordinates here", control.ground[at].name);
                return Err((number, message));
            }
            Some(at) => at,
            None => {
                let at = places.len();
                places.push(position);
                let name = name.unwrap_or_else(|| format!("gcp{:02}", at + 1));
                let check = name.starts_with("CHK-");
                control.ground.push(GroundPoint {
                    role: if check { Role::Check } else { Role::Control },
                    name,
                    position_m: position,
                    sigma_m: [defaults.control_m; 3],
                    axes: Axes::Xyz,
                });
                at
            }
        };
        let image_px = [value(3)?, value(4)?];
        control.marks.push(NamedMark {
            image: fields[5].to_owned(),
            ground,
            image_px,
            line: number,
        });
    }
    if control.marks.is_empty() {
        return Err((
            1,
            "no marks; expected a line for the reference system and lines `x y z u v image [name]`"
                .into(),
        ));
    }
    Ok(control)
}

/// Reads OpenSfM's `ground_control_points.json`: points with `lla` or `position`, observations with
/// normalised `projection`, which `size_px` of an image turns into pixels.
///
/// # Errors
/// Where the file is no such file; names the point.
pub fn read_opensfm(
    path: &Path,
    defaults: &Defaults,
    size_px: impl Fn(&str) -> Option<[u32; 2]>,
) -> Result<Control, FileError> {
    let text = std::fs::read_to_string(path).map_err(|e| FileError::read(path, e))?;
    let file: serde_json::Value = serde_json::from_str(&text)
        .map_err(|e| FileError::malformed(path, e.line(), e.to_string()))?;
    let wrong = |message: String| FileError::malformed(path, None, message);
    let points = file["points"]
        .as_array()
        .ok_or_else(|| wrong("expected an object with a list \"points\"".into()))?;
    let mut control =
        Control { crs: None, geographic: false, ground: Vec::new(), marks: Vec::new() };
    for (k, point) in points.iter().enumerate() {
        let name = point["id"].as_str().map_or_else(|| format!("point {k}"), str::to_owned);
        let triple = |value: &serde_json::Value, keys: [&str; 3]| -> Option<[f64; 3]> {
            let list = match value.as_array() {
                Some(list) => list.iter().map(serde_json::Value::as_f64).collect(),
                None => keys.iter().map(|key| value[*key].as_f64()).collect::<Option<Vec<f64>>>(),
            }?;
            <[f64; 3]>::try_from(list).ok()
        };
        let geographic = triple(&point["lla"], ["latitude", "longitude", "altitude"])
            .or_else(|| triple(&point["position"], ["latitude", "longitude", "altitude"]));
        let position_m = match geographic {
            Some(lla) => {
                control.geographic = true;
                lla
            }
            None => triple(&point["position"], ["x", "y", "z"]).ok_or_else(|| {
                wrong(format!("{name}: expected \"position\" with latitude, longitude, altitude"))
            })?,
        };
        let check = point["role"].as_str().is_some_and(|role| role.contains("metrics"));
        control.ground.push(GroundPoint {
            name: name.clone(),
            position_m,
            sigma_m: [defaults.control_m; 3],
            role: if check { Role::Check } else { Role::Control },
            axes: Axes::Xyz,
        });
        for seen in point["observations"].as_array().into_iter().flatten() {
            let image = seen["shot_id"].as_str().unwrap_or_default().to_owned();
            let at = seen["projection"]
                .as_array()
                .and_then(|list| Some([list.first()?.as_f64()?, list.get(1)?.as_f64()?]));
            let at = at.ok_or_else(|| {
                wrong(format!("{name} in {image:?}: expected \"projection\": [x, y]"))
            })?;
            let Some([width, height]) = size_px(&image).map(|size| size.map(f64::from)) else {
                // Joined later, where what has no image is named.
                control.marks.push(NamedMark { image, ground: k, image_px: at, line: 0 });
                continue;
            };
            let larger = width.max(height);
            let image_px =
                [at[0] * larger + 0.5 * (width - 1.0), at[1] * larger + 0.5 * (height - 1.0)];
            control.marks.push(NamedMark { image, ground: k, image_px, line: 0 });
        }
    }
    Ok(control)
}

/// Reads a table of geographic camera positions: an image's name, latitude, longitude, height.
/// Columns by name; a file without a header has them in that order (as `geo.txt`, where longitude comes
/// first, is not).
///
/// # Errors
/// Missing columns, numbers that are none, degrees beyond the globe.
pub fn geolocation(path: &Path) -> Result<Vec<(String, Geotag)>, FileError> {
    let table = Table::read(path)?;
    let image = table.required("image", &["image_name", "image", "filename", "file", "label"])?;
    let latitude = table.required("latitude", &["lat", "latitude", "latitude_deg"])?;
    let longitude = table.required("longitude", &["lon", "longitude", "lng", "longitude_deg"])?;
    let height = table.column(&[
        "gps_height",
        "height_m",
        "height",
        "altitude",
        "alt",
        "altitude_m",
        "ellipsoidal_height_m",
    ]);
    let horizontal =
        table.column(&["sigma_xy_m", "accuracy_horizontal", "sigma_m", "horizontal_m"]);
    let vertical = table.column(&["sigma_z_m", "accuracy_vertical", "sigma_m", "vertical_m"]);
    let mut found = Vec::new();
    for row in table.rows() {
        let (lat, lon) = (table.number(row, latitude)?, table.number(row, longitude)?);
        if lat.abs() > 90.0 || lon.abs() > 180.0 {
            let message = format!("latitude {lat}, longitude {lon} is no place on the globe");
            return Err(table.fault(row, message));
        }
        let height_m = match height {
            Some(column) if !table.text(row, column).is_empty() => Some(table.number(row, column)?),
            _ => None,
        };
        let sigma = [
            table.positive_or(row, horizontal, f64::NAN)?,
            table.positive_or(row, vertical, f64::NAN)?,
        ];
        let sigma_m =
            (!sigma[0].is_nan() && !sigma[1].is_nan()).then_some([sigma[0], sigma[0], sigma[1]]);
        let tag = Geotag { latitude_deg: lat, longitude_deg: lon, height_m, sigma_m };
        found.push((table.text(row, image).to_owned(), tag));
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_of_control_points_is_read() {
        let text = "EPSG:32611\n# a comment\n1.0 2.0 3.0 10.5 20.5 a.jpg p1\n4 5 6 1 2 b.jpg CHK-q\n\n1.0\t2.0\t3.0\t11\t21\tb.jpg\tp1\n";
        let found = parse(text, &Defaults::default()).unwrap();
        assert_eq!(found.crs.as_deref(), Some("EPSG:32611"));
        assert_eq!(found.ground.len(), 2);
        assert_eq!(found.ground[1].role, Role::Check);
        assert_eq!(found.marks.iter().map(|m| m.ground).collect::<Vec<_>>(), [0, 1, 0]);
        let (line, message) = parse("EPSG:1\n1 2 x 4 5 a.jpg\n", &Defaults::default()).unwrap_err();
        assert!(line == 2 && message.contains("\"x\" is no number"), "{message}");
        let (line, message) =
            parse("EPSG:1\n1 2 3 4 5 a p\n1 2 4 4 5 b p\n", &Defaults::default()).unwrap_err();
        assert!(line == 3 && message.contains("other coordinates"), "{message}");
    }
}
