//! Control in CSV files: ground points, their marks in images, camera positions, scale bars.
//!
//! Columns are found by name, in any order and among others; the first name of each list is the
//! one that is written.
//!
//! | file | columns |
//! |---|---|
//! | ground points | `label`, `easting_m`, `northing_m`, `height_m`; optional `sigma_x_m`, `sigma_y_m` or `Accuracy_Horizontal`, `sigma_z_m` or `Accuracy_Vertical`, `role` (control, check, tie; without one a label that begins with `CHK-` is a check point), `enabled` (0: a check point), `axes` (xyz, xy, z) |
//! | marks | `image`, `label`, `u_px`, `v_px`; optional `sigma_px`, `source` (`found` for those that a program found) |
//! | camera positions | `image`, `easting_m`, `northing_m`, `height_m`; optional standard deviations as above |
//! | scale bars | `from`, `to`, `length_m`; optional `sigma_m` |
//!
//! Columns may also have the names that other programs give them (`columns`), or none: then the first is the
//! name, and coordinates follow. Coordinates are metres in one mapping frame; degrees are read by [`read`], for a flight
//! whose frame is known. A point without a height is control in plan only. Images are matched by [`Names`].

mod marks;

pub use marks::{MarkRow, MarkSource, MarkTable, marks};

use super::{
    FileError,
    camera_positions::is_geographic,
    columns::{self, Coordinates, IMAGE, LABEL},
    image_names::Names,
    table::{Column, Table},
};
use rowgram_survey::scene::{
    Axes, CameraPosition, Excluded, ExcludedKind, GroundPoint, Role, ScaleBar,
};
use std::{collections::HashSet, path::Path};

/// What a point is for; other programs call it a type.
const ROLE: &[&str] = &["role", "type", "point_type", "gcp_type"];
/// Whether a point takes part. A point that is switched off in Metashape is a check point.
const ENABLED: &[&str] = &["enabled", "enable"];

/// Whether the name of a point says that it is a check point.
pub(super) fn is_check_name(name: &str) -> bool {
    name.get(..4).is_some_and(|begin| begin.eq_ignore_ascii_case("CHK-"))
}

/// What a word says that a point is for, and the coordinates that it says are known: `2D GCP`, `Check points`, `Checkpoint 3D`.
fn role_of(word: &str) -> Option<(Role, Axes)> {
    let letters = word.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase);
    let letters: String = letters.collect();
    let axes = if letters.contains("2d") { Axes::Xy } else { Axes::Xyz };
    let role = match letters.replace("2d", "").replace("3d", "").trim_end_matches('s') {
        check if check.starts_with("check") || check == "cp" => Role::Check,
        "control" | "gcp" | "controlpoint" | "groundcontrolpoint" => Role::Control,
        "tie" | "tiepoint" | "mtp" | "manualtiepoint" => Role::Tie,
        _ => return None,
    };
    Some((role, axes))
}

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
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Control {
    /// The words, where the file has any.
    pub crs: Option<String>,
    /// Whether positions are degrees instead of metres: latitude, longitude, height.
    pub geographic: bool,
    /// Whether the file itself says which coordinates of its points are known.
    pub has_axes: bool,
    /// The points.
    pub ground: Vec<GroundPoint>,
    /// Their marks, where the file has them.
    pub marks: Vec<NamedMark>,
    /// How columns were told where they have no names.
    pub choice: Option<String>,
}

impl Control {
    /// Heights that are all 0 were not measured: such points are control in plan only. Says whether there were any.
    pub fn drop_zero_heights(&mut self) -> bool {
        let with_height: Vec<f64> = (self.ground.iter())
            .filter(|point| point.axes == Axes::Xyz)
            .map(|point| point.position_m[2])
            .collect();
        let all_zero =
            !self.has_axes && with_height.len() > 1 && with_height.iter().all(|&z| z == 0.0);
        if all_zero {
            self.ground.iter_mut().for_each(|point| point.axes = Axes::Xy);
        }
        all_zero
    }
}

/// Reads ground points in metres.
///
/// # Errors
/// Missing columns, fields that are no numbers, names that are there twice, degrees given as metres.
pub fn ground_points(path: &Path, defaults: &Defaults) -> Result<Control, FileError> {
    let table = Table::read(path)?;
    let label = table.required("name of the point", LABEL)?;
    let coordinates = Coordinates::in_metres(&table)?;
    let ground = points(&table, label, &coordinates, defaults)?;
    let has_axes = table.column(&["axes"]).is_some();
    Ok(Control { crs: system(&table)?, has_axes, ground, ..Control::default() })
}

/// Reads ground points, in metres or degrees, from a table with a header or without one. `photos_deg` is about where photos
/// were taken, latitude and longitude, where they tell; `knows_system` whether the system of metres is known.
///
/// # Errors
/// As [`ground_points`], but for degrees.
pub fn read(
    path: &Path,
    defaults: &Defaults,
    photos_deg: Option<[f64; 2]>,
    knows_system: bool,
) -> Result<Control, FileError> {
    let table = Table::read(path)?;
    let crs = system(&table)?;
    let has_axes = table.column(&["axes"]).is_some();
    let (label, mut coordinates, choice) = if table.is_named() {
        let label = table.required("name of the point", LABEL)?;
        let mut coordinates = Coordinates::of(&table)?;
        if (knows_system || crs.is_some()) && coordinates.is_degrees {
            coordinates = Coordinates::in_metres(&table).unwrap_or(coordinates);
        }
        (label, coordinates, None)
    } else {
        let found = columns::unnamed(&table, photos_deg, true)?;
        (found.name, found.coordinates, Some(found.said(&table, &[])))
    };
    let geographic = coordinates.is_degrees;
    if geographic {
        // As points have it: latitude first.
        coordinates.plan.swap(0, 1);
    }
    let ground = points(&table, label, &coordinates, defaults)?;
    Ok(Control { crs, geographic, has_axes, ground, marks: Vec::new(), choice })
}

/// The words by which a table names a reference system in metres, or degrees of WGS84.
fn system(table: &Table) -> Result<Option<String>, FileError> {
    let Some(words) = table.system() else { return Ok(None) };
    is_geographic(words).map_err(|why| table.whole_fault(why))?;
    Ok(Some(words.to_owned()))
}

fn points(
    table: &Table,
    label: Column,
    coordinates: &Coordinates,
    defaults: &Defaults,
) -> Result<Vec<GroundPoint>, FileError> {
    let [role, axes, enabled] = [ROLE, &["axes"], ENABLED].map(|names| table.column(names));
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
        let (mut role, stated) = match word(role) {
            "" if is_check_name(&name) => (Role::Check, Axes::Xyz),
            "" => (Role::Control, Axes::Xyz),
            other => role_of(other).ok_or_else(|| {
                let title = role.map_or("role", |column| table.title(column));
                let message = format!(
                    "{title} is {other:?}, expected control, check or tie; rename the column where it says something else"
                );
                table.fault(row, message)
            })?,
        };
        match word(enabled).to_ascii_lowercase().as_str() {
            "" | "1" | "true" | "t" | "yes" | "y" | "on" => {}
            "0" | "false" | "f" | "no" | "n" | "off" if role == Role::Control => role = Role::Check,
            "0" | "false" | "f" | "no" | "n" | "off" => {}
            other => {
                return Err(table.fault(row, format!("enabled is {other:?}, expected 1 or 0")));
            }
        }
        let axes = match word(axes).to_ascii_lowercase().as_str() {
            "" => stated,
            "xyz" => Axes::Xyz,
            "xy" => Axes::Xy,
            "z" => Axes::Z,
            other => {
                return Err(table.fault(row, format!("axes is {other:?}, expected xyz, xy or z")));
            }
        };
        let ([x, y], height) = coordinates.position(table, row)?;
        let axes = match (height, axes) {
            (None, Axes::Z) => return Err(table.fault(row, format!("{name} has no height"))),
            (None, _) => Axes::Xy,
            (Some(_), axes) => axes,
        };
        points.push(GroundPoint {
            name,
            position_m: [x, y, height.unwrap_or(0.0)],
            sigma_m: coordinates.sigma(table, row, defaults.control_m)?,
            role,
            axes,
        });
    }
    Ok(points)
}

fn no_such_image(kind: ExcludedKind, image: &str, point: Option<&str>) -> Excluded {
    Excluded {
        kind,
        image: Some(image.to_owned()),
        point: point.map(str::to_owned),
        reason: "the block has no image of this name".into(),
    }
}

fn nothing_matches(aside: &[Excluded], names: &Names<'_>) -> String {
    let theirs = aside.first().and_then(|a| a.image.as_deref()).unwrap_or("none");
    let ours = names.first().unwrap_or("none");
    format!(
        "no row names an image of the block; the file has names like {theirs:?}, the block like {ours:?}"
    )
}

/// Camera positions of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPositions {
    /// Those of images of the block.
    pub found: Vec<CameraPosition>,
    /// Rows of images that are not in the block.
    pub aside: Vec<Excluded>,
    /// The words by which the table names its reference system.
    pub system: Option<String>,
}

/// Reads camera positions; those of images that are not in the block are set aside by name.
///
/// # Errors
/// Missing columns, fields that are no numbers, an image that is there twice, degrees, no image that
/// matches.
pub fn positions(
    path: &Path,
    names: &Names<'_>,
    defaults: &Defaults,
) -> Result<CameraPositions, FileError> {
    let table = Table::read(path)?;
    let image = table.required("image", IMAGE)?;
    let coordinates = Coordinates::in_metres(&table)?;
    let mut found = Vec::new();
    let mut aside = Vec::new();
    let mut seen = HashSet::new();
    for row in table.rows() {
        let name = table.text(row, image);
        let ([x, y], height) = coordinates.position(&table, row)?;
        let height = height.ok_or_else(|| table.fault(row, format!("{name} has no height")))?;
        let position_m = [x, y, height];
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
        return Err(table.whole_fault(nothing_matches(&aside, names)));
    }
    Ok(CameraPositions { found, aside, system: system(&table)? })
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
        let points = ground_points(&path, &Defaults::default()).unwrap().ground;
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
        let points = ground_points(&path, &Defaults::default()).unwrap().ground;
        let checks: Vec<&str> =
            points.iter().filter(|p| p.role == Role::Check).map(|p| p.name.as_str()).collect();
        assert_eq!(checks, ["CHK-B", "CHK-C"]);
        let points = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let read = ground_points(&path, &Defaults::default());
            read.map(|read| read.ground).map_err(|error| error.to_string())
        };
        for (word, role, axes) in [
            ("Check Point", Role::Check, Axes::Xyz),
            ("Check points", Role::Check, Axes::Xyz),
            ("Checkpoint 3D", Role::Check, Axes::Xyz),
            ("3D GCP", Role::Control, Axes::Xyz),
            ("2D GCP", Role::Control, Axes::Xy),
            ("Manual Tie Point", Role::Tie, Axes::Xyz),
        ] {
            let found =
                points(&format!("label,easting_m,northing_m,height_m,type\nA,1,2,3,{word}\n"));
            let point = found.unwrap().remove(0);
            assert_eq!((point.role, point.axes), (role, axes), "{word}");
        }
        let error =
            points("label,easting_m,northing_m,height_m,type\nA,1,2,3,cross\n").unwrap_err();
        assert!(error.contains("type is \"cross\"") && error.contains("line 2"), "{error}");
        let switched =
            "label,enable,easting_m,northing_m,height_m\nA,0,1,2,3\nchk-B,1,9,2,3\nC,true,5,2,3\n";
        let found: Vec<Role> = points(switched).unwrap().iter().map(|point| point.role).collect();
        assert_eq!(found, [Role::Check, Role::Check, Role::Control]);
        std::fs::write(&path, "label,easting_m,northing_m,height_m,role\nA,1,2,3,chek\n").unwrap();
        let error = ground_points(&path, &Defaults::default()).unwrap_err().to_string();
        assert!(error.contains("gcps.csv") && error.contains("chek"), "{error}");
    }

    #[test]
    fn numbered_points_may_have_a_code_behind_their_height() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gcps.csv");
        let text = "1,4480143.7,500671.98,182.09,GCP\n2,4480163.7,500691.98,182.19,GCP\n";
        std::fs::write(&path, text).unwrap();
        let found = read(&path, &Defaults::default(), None, true).unwrap().ground;
        let first = (found[0].name.as_str(), found[0].position_m);
        assert_eq!(first, ("1", [500_671.98, 4_480_143.7, 182.09]));
        // Coordinates with the name behind them are no numbered points.
        std::fs::write(&path, "500671.98,4480143.7,182.09,A\n500691.98,4480163.7,182.19,B\n")
            .unwrap();
        assert!(read(&path, &Defaults::default(), None, true).is_err());
    }
}
