//! Control in the forms of other programs: OpenDroneMap's `gcp_list.txt` and OpenSfM's
//! `ground_control_points.json`.
//!
//! `gcp_list.txt`: a first line that names the coordinate reference system, then per mark
//! `x y z u v image [name]`, separated by blanks or tabs; a name that begins with `CHK-` is a check
//! point. Without names, marks with the same coordinates are one point. In a geographic system `x` is the longitude. A height
//! that is `NaN` makes a point control in plan only.

use super::{
    FileError,
    camera_positions::is_geographic,
    columns::latitude_first,
    control::{Control, Defaults, NamedMark, is_check_name},
    table::read_text,
};
use rowgram_survey::scene::{Axes, GroundPoint, Role};
use std::path::Path;

/// Reads a `gcp_list.txt`.
///
/// # Errors
/// Lines that are none; names the line and what was expected.
pub fn read(
    path: &Path,
    defaults: &Defaults,
    photos_deg: Option<[f64; 2]>,
) -> Result<Control, FileError> {
    let text = read_text(path)?;
    let mut control = parse(&text, defaults)
        .map_err(|(line, message)| FileError::malformed(path, line, message))?;
    if control.geographic {
        latitude_before_longitude(&mut control, photos_deg);
    }
    Ok(control)
}

/// Brings degrees into the order latitude, longitude, and says how they were taken.
fn latitude_before_longitude(control: &mut Control, photos_deg: Option<[f64; 2]>) {
    let pairs: Vec<[f64; 2]> =
        control.ground.iter().map(|p| [p.position_m[0], p.position_m[1]]).collect();
    let latitude_first = latitude_first(&pairs, photos_deg, false);
    if !latitude_first {
        control.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
    }
    let order = if latitude_first { ["latitude", "longitude"] } else { ["longitude", "latitude"] };
    control.choice = Some(format!("its coordinates are read as {}, {}", order[0], order[1]));
}

fn parse(text: &str, defaults: &Defaults) -> Result<Control, (usize, String)> {
    let mut control = Control::default();
    let mut places: Vec<[f64; 3]> = Vec::new();
    for (k, line) in text.lines().enumerate() {
        let (number, line) = (k + 1, line.trim());
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if control.crs.is_none() {
            control.crs = Some(line.to_owned());
            control.geographic = is_geographic(line).map_err(|why| (number, why))?;
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
        let no_height = fields[2].eq_ignore_ascii_case("nan");
        let position = [value(0)?, value(1)?, if no_height { 0.0 } else { value(2)? }];
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
                let check = is_check_name(&name);
                control.ground.push(GroundPoint {
                    role: if check { Role::Check } else { Role::Control },
                    name,
                    position_m: position,
                    sigma_m: [defaults.control_m; 3],
                    axes: if no_height { Axes::Xy } else { Axes::Xyz },
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
    let text = crate::memory::read_text(path)?;
    let file: serde_json::Value = serde_json::from_str(&text)
        .map_err(|e| FileError::malformed(path, e.line(), e.to_string()))?;
    let wrong = |message: String| FileError::malformed(path, None, message);
    let points = file["points"]
        .as_array()
        .ok_or_else(|| wrong("expected an object with a list \"points\"".into()))?;
    let mut control = Control::default();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_of_control_points_is_read() {
        let text = "EPSG:32611\n# a comment\n1.0 2.0 3.0 10.5 20.5 a.jpg p1\n4 5 6 1 2 b.jpg chk-q\n\n1.0\t2.0\t3.0\t11\t21\tb.jpg\tp1\n";
        let found = parse(text, &Defaults::default()).unwrap();
        assert_eq!(found.crs.as_deref(), Some("EPSG:32611"));
        assert_eq!(found.ground.len(), 2);
        assert_eq!(found.ground[1].role, Role::Check);
        assert_eq!(found.marks.iter().map(|m| m.ground).collect::<Vec<_>>(), [0, 1, 0]);
        let (line, message) = parse("EPSG:1\n1 2 x 4 5 a.jpg\n", &Defaults::default()).unwrap_err();
        assert!(line == 2 && message.contains("\"x\" is no number"), "{message}");
        let (line, message) =
            parse("EPSG:4314\n1 2 3 4 5 a.jpg\n", &Defaults::default()).unwrap_err();
        assert!(line == 1 && message.contains("transform them to WGS84"), "{message}");
        let (line, message) =
            parse("EPSG:1\n1 2 3 4 5 a p\n1 2 4 4 5 b p\n", &Defaults::default()).unwrap_err();
        assert!(line == 3 && message.contains("other coordinates"), "{message}");
    }
}
