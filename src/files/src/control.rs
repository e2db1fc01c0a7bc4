//! Control in CSV files: ground points, their marks in images, camera positions, scale bars.
//!
//! Columns are found by name, in any order and among others; the first name of each list is the
//! one that is written.
//!
//! | file | columns |
//! |---|---|
//! | ground points | `label`, `easting_m`, `northing_m`, `height_m`; optional `sigma_x_m`, `sigma_y_m` or `Accuracy_Horizontal`, `sigma_z_m` or `Accuracy_Vertical`, `role` (control, check, tie; without one a label that begins with `CHK-` is a check point), `axes` (xyz, xy, z) |
//! | marks | `image`, `label`, `u_px`, `v_px`; optional `sigma_px` |
//! | camera positions | `image`, `easting_m`, `northing_m`, `height_m`; optional standard deviations as above |
//! | scale bars | `from`, `to`, `length_m`; optional `sigma_m` |
//!
//! Coordinates are metres in one mapping frame; degrees are refused. An image is matched by its
//! whole name, or else by its name without folder and extension where only one image has it.

use super::{
    FileError,
    table::{Column, Row, Table},
};
use rowgram_survey::scene::{
    Axes, CameraPosition, Excluded, ExcludedKind, GroundObservation, GroundPoint, Image, Role,
    ScaleBar,
};
use std::{
    collections::{HashMap, HashSet},
    path::Path,
};

const LABEL: &[&str] = &["label", "name", "point", "gcp", "id"];
const IMAGE: &[&str] = &["image", "image_name", "filename", "file"];
const EASTING: &[&str] = &["easting_m", "easting", "x_m", "x", "east"];
const NORTHING: &[&str] = &["northing_m", "northing", "y_m", "y", "north"];
const HEIGHT: &[&str] = &["height_m", "height", "z_m", "z", "elevation", "up"];
const DEGREES: &[&str] = &["lat", "latitude", "lon", "longitude", "lng"];

/// Standard deviations where a file has none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Defaults {
    /// Of a mark, pixels.
    pub mark_px: f64,
    /// Of a ground point's coordinates, metres.
    pub control_m: f64,
    /// Of a camera position's coordinates, metres.
    pub position_m: f64,
}

impl Default for Defaults {
    fn default() -> Defaults {
        Defaults { mark_px: 0.5, control_m: 0.02, position_m: 5.0 }
    }
}

/// The columns of coordinates and their standard deviations.
struct Coordinates {
    place: [Column; 3],
    sigma: [Option<Column>; 3],
}

impl Coordinates {
    fn of(table: &Table) -> Result<Coordinates, FileError> {
        let found = [table.column(EASTING), table.column(NORTHING)];
        if found.iter().any(Option::is_none) && table.column(DEGREES).is_some() {
            return Err(table.whole_fault(
                "the coordinates are latitude and longitude in degrees; expected easting_m, northing_m, height_m in metres: transform them into the mapping frame first".into(),
            ));
        }
        let horizontal =
            |own: &str| table.column(&[own, "sigma_xy_m", "accuracy_horizontal", "sigma_m"]);
        Ok(Coordinates {
            place: [
                table.required("easting", EASTING)?,
                table.required("northing", NORTHING)?,
                table.required("height", HEIGHT)?,
            ],
            sigma: [
                horizontal("sigma_x_m"),
                horizontal("sigma_y_m"),
                table.column(&["sigma_z_m", "accuracy_vertical", "sigma_m"]),
            ],
        })
    }

    fn position(&self, table: &Table, row: &Row) -> Result<[f64; 3], FileError> {
        let [x, y, z] = self.place.map(|column| table.number(row, column));
        Ok([x?, y?, z?])
    }

    fn sigma(&self, table: &Table, row: &Row, default: f64) -> Result<[f64; 3], FileError> {
        let [x, y, z] = self.sigma.map(|column| table.positive_or(row, column, default));
        Ok([x?, y?, z?])
    }
}

/// Positions that can only be degrees: all within a degree of each other and within a globe's
/// range, which a survey in metres is not unless it is smaller than a metre.
fn look_like_degrees(positions: &[[f64; 3]]) -> bool {
    let spread = |k: usize| {
        let values = positions.iter().map(|p| p[k]);
        values.clone().fold(f64::MIN, f64::max) - values.fold(f64::MAX, f64::min)
    };
    let range = |k: usize, most: f64| positions.iter().all(|p| p[k].abs() <= most);
    positions.len() >= 2
        && (range(0, 180.0) && range(1, 90.0) || range(0, 90.0) && range(1, 180.0))
        && spread(0) < 1.0
        && spread(1) < 1.0
}

const DEGREES_AS_METRES: &str = "the coordinates look like degrees: all are within one unit of each other; expected metres in the mapping frame";

/// Reads ground points.
///
/// # Errors
/// Missing columns, fields that are no numbers, names that are there twice, degrees given as metres.
pub fn ground_points(path: &Path, defaults: &Defaults) -> Result<Vec<GroundPoint>, FileError> {
    let table = Table::read(path)?;
    let label = table.required("name of the point", LABEL)?;
    let coordinates = Coordinates::of(&table)?;
    let (role, axes) = (table.column(&["role"]), table.column(&["axes"]));
    let mut points = Vec::new();
    let mut names = HashSet::new();
    for row in table.rows() {
        let name = table.text(row, label).to_owned();
        if name.is_empty() {
            return Err(table.fault(row, "the point has no name".into()));
        }
        if !names.insert(name.clone()) {
            return Err(table.fault(row, format!("{name} is there twice")));
        }
        let word = |column: Option<Column>| column.map_or("", |c| table.text(row, c));
        let role = match word(role).to_ascii_lowercase().as_str() {
            "" if name.starts_with("CHK-") => Role::Check,
            "" | "control" | "gcp" => Role::Control,
            "check" => Role::Check,
            "tie" => Role::Tie,
            other => {
                let message = format!("role is {other:?}, expected control, check or tie");
                return Err(table.fault(row, message));
            }
        };
        let axes = match word(axes).to_ascii_lowercase().as_str() {
            "" | "xyz" => Axes::Xyz,
            "xy" => Axes::Xy,
            "z" => Axes::Z,
            other => {
                return Err(table.fault(row, format!("axes is {other:?}, expected xyz, xy or z")));
            }
        };
        points.push(GroundPoint {
            name,
            position_m: coordinates.position(&table, row)?,
            sigma_m: coordinates.sigma(&table, row, defaults.control_m)?,
            role,
            axes,
        });
    }
    let positions: Vec<[f64; 3]> = points.iter().map(|point| point.position_m).collect();
    if look_like_degrees(&positions) {
        return Err(table.whole_fault(DEGREES_AS_METRES.into()));
    }
    Ok(points)
}

/// Finds images by what other files call them.
pub struct Names<'a> {
    whole: HashMap<&'a str, usize>,
    /// By stem in lower case; none where several have it.
    stems: HashMap<String, Option<usize>>,
}

fn stem(name: &str) -> String {
    let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
    file.rsplit_once('.').map_or(file, |(stem, _)| stem).to_ascii_lowercase()
}

impl<'a> Names<'a> {
    /// The names of `images`.
    pub fn new(images: &'a [Image]) -> Names<'a> {
        let mut names = Names { whole: HashMap::new(), stems: HashMap::new() };
        for (k, image) in images.iter().enumerate() {
            names.whole.insert(&image.name, k);
            names.stems.entry(stem(&image.name)).and_modify(|k| *k = None).or_insert(Some(k));
        }
        names
    }

    /// The place of the image of this name: as it stands, or alone with its stem.
    pub fn find(&self, name: &str) -> Option<u32> {
        let whole = self.whole.get(name).copied();
        whole.or_else(|| self.stems.get(&stem(name)).copied().flatten()).map(|k| k as u32)
    }
}

fn no_such_image(kind: ExcludedKind, image: &str, point: Option<&str>) -> Excluded {
    Excluded {
        kind,
        image: Some(image.to_owned()),
        point: point.map(str::to_owned),
        reason: "the block has no image of this name".into(),
    }
}

/// Reads marks; those in images that are not in the block are set aside by name.
///
/// # Errors
/// Missing columns, fields that are no numbers, a ground point that is not there or is marked twice
/// in one image, no image that matches.
pub fn marks(
    path: &Path,
    images: &[Image],
    ground: &[GroundPoint],
    defaults: &Defaults,
) -> Result<(Vec<GroundObservation>, Vec<Excluded>), FileError> {
    let table = Table::read(path)?;
    let image = table.required("image", IMAGE)?;
    let label = table.required("name of the point", LABEL)?;
    let u = table.required("column in the image", &["u_px", "u", "x_px", "px"])?;
    let v = table.required("row in the image", &["v_px", "v", "y_px", "py"])?;
    let sigma = table.column(&["sigma_px"]);
    let names = Names::new(images);
    let points: HashMap<&str, u32> =
        ground.iter().enumerate().map(|(k, point)| (point.name.as_str(), k as u32)).collect();
    let mut found = Vec::new();
    let mut aside = Vec::new();
    let mut lines: HashMap<(u32, u32), usize> = HashMap::new();
    for row in table.rows() {
        let label = table.text(row, label);
        let Some(&ground) = points.get(label) else {
            let message = format!("there is no ground point {label:?}");
            return Err(table.fault(row, message));
        };
        let name = table.text(row, image);
        let mark = GroundObservation {
            image: 0,
            ground,
            image_px: [table.number(row, u)?, table.number(row, v)?],
            sigma_px: table.positive_or(row, sigma, defaults.mark_px)?,
        };
        let Some(image) = names.find(name) else {
            aside.push(no_such_image(ExcludedKind::Mark, name, Some(label)));
            continue;
        };
        if let Some(line) = lines.insert((image, ground), row.line) {
            let message = format!("{label} is marked twice in {name}, first in line {line}");
            return Err(table.fault(row, message));
        }
        found.push(GroundObservation { image, ..mark });
    }
    if found.is_empty() {
        return Err(table.whole_fault(nothing_matches(&aside, images)));
    }
    Ok((found, aside))
}

fn nothing_matches(aside: &[Excluded], images: &[Image]) -> String {
    let theirs = aside.first().and_then(|a| a.image.as_deref()).unwrap_or("none");
    let ours = images.first().map_or("none", |image| image.name.as_str());
    format!(
        "no row names an image of the block; the file has names like {theirs:?}, the block like {ours:?}"
    )
}

/// Reads camera positions; those of images that are not in the block are set aside by name.
///
/// # Errors
/// Missing columns, fields that are no numbers, an image that is there twice, degrees, no image that
/// matches.
pub fn positions(
    path: &Path,
    images: &[Image],
    defaults: &Defaults,
) -> Result<(Vec<CameraPosition>, Vec<Excluded>), FileError> {
    let table = Table::read(path)?;
    let image = table.required("image", IMAGE)?;
    let coordinates = Coordinates::of(&table)?;
    let names = Names::new(images);
    let mut found = Vec::new();
    let mut aside = Vec::new();
    let mut seen = HashSet::new();
    for row in table.rows() {
        let name = table.text(row, image);
        let position_m = coordinates.position(&table, row)?;
        let sigma_m = coordinates.sigma(&table, row, defaults.position_m)?;
        match names.find(name) {
            None => aside.push(no_such_image(ExcludedKind::CameraPosition, name, None)),
            Some(image) if seen.insert(image) => {
                found.push(CameraPosition { image, position_m, sigma_m });
            }
            Some(_) => return Err(table.fault(row, format!("{name} is there twice"))),
        }
    }
    if found.is_empty() {
        return Err(table.whole_fault(nothing_matches(&aside, images)));
    }
    let given: Vec<[f64; 3]> = found.iter().map(|position| position.position_m).collect();
    if look_like_degrees(&given) {
        return Err(table.whole_fault(DEGREES_AS_METRES.into()));
    }
    Ok((found, aside))
}

/// Reads scale bars.
///
/// # Errors
/// Missing columns, fields that are no positive numbers, ground points that are not there.
pub fn scale_bars(path: &Path, ground: &[GroundPoint]) -> Result<Vec<ScaleBar>, FileError> {
    let table = Table::read(path)?;
    let ends = [table.required("first end", &["from"])?, table.required("second end", &["to"])?];
    let length = table.required("length", &["length_m"])?;
    let sigma = table.column(&["sigma_m"]);
    let mut bars = Vec::new();
    for row in table.rows() {
        let mut places = [0; 2];
        for (place, end) in places.iter_mut().zip(ends) {
            let name = table.text(row, end);
            let found = ground.iter().position(|point| point.name == name);
            *place = found
                .ok_or_else(|| table.fault(row, format!("there is no ground point {name:?}")))?
                as u32;
        }
        if places[0] == places[1] {
            return Err(table.fault(row, "both ends are the same point".into()));
        }
        bars.push(ScaleBar {
            ends: places,
            length_m: table.positive_or(row, Some(length), f64::NAN)?,
            sigma_m: table.positive_or(row, sigma, 0.001)?,
        });
    }
    Ok(bars)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_what_its_role_says_and_else_what_its_name_does() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gcps.csv");
        let rows = [
            ("A", "", Role::Control),
            ("CHK-B", "", Role::Check),
            ("CHK-C", "control", Role::Control),
            ("D", "check", Role::Check),
            ("E", "Tie", Role::Tie),
        ];
        let mut text = "label,easting_m,northing_m,height_m,role\n".to_owned();
        for (k, (name, role, _)) in rows.iter().enumerate() {
            text += &format!("{name},{},4480143.2,182.1,{role}\n", 500_670 + 20 * k);
        }
        std::fs::write(&path, &text).unwrap();
        let points = ground_points(&path, &Defaults::default()).unwrap();
        let found: Vec<Role> = points.iter().map(|point| point.role).collect();
        assert_eq!(found, rows.map(|(.., role)| role));
        // Without the column names alone tell.
        let text = text.replace(",role", "").replace(",Tie", ",").replace(",check", ",");
        let bare: String = text
            .replace(",control", ",")
            .lines()
            .map(|line| format!("{}\n", line.trim_end_matches(',')))
            .collect();
        std::fs::write(&path, bare).unwrap();
        let points = ground_points(&path, &Defaults::default()).unwrap();
        let checks: Vec<&str> =
            points.iter().filter(|p| p.role == Role::Check).map(|p| p.name.as_str()).collect();
        assert_eq!(checks, ["CHK-B", "CHK-C"]);
        std::fs::write(&path, "label,easting_m,northing_m,height_m,role\nA,1,2,3,chek\n").unwrap();
        let error = ground_points(&path, &Defaults::default()).unwrap_err().to_string();
        assert!(error.contains("gcps.csv") && error.contains("chek"), "{error}");
    }
}
