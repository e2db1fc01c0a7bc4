//! Polygons with names: plots, calibration regions. GeoJSON, shapefiles and GeoPackages.
//!
//! Each comes out in pixels of the raster that it is drawn over. Coordinates in another reference system than the
//! raster's are transformed (`systems`); where the size of the raster is known and nothing lies on it, the file is refused with
//! the likely cause. Where the raster has no place on the map, coordinates are pixels (the centre of the top-left pixel at
//! 0, 0). A polygon's name comes from the first usual property that is there and unique (`names`), else it is its number.
//! Other properties come along as attributes. [`write()`] writes plots.
//!
//! A file without polygons, two polygons of one name, a ring that crosses itself and a polygon without area are refused: each
//! would give traits of something that nobody drew. What has no area (no geometry, a point, a line) is left out and named.

mod geojson;
mod names;
#[cfg(feature = "geopackage")]
mod package;
mod shapes;
mod systems;
mod write;

pub use names::NAMES;
pub(crate) use write::crs_member;
pub use write::{NAME, Outline, geometry, projection, write, write_features};

use super::FileError;
use rowgram_raster::{georeference::Georeference, polygon::Polygon};
use serde_json::Value;
use std::path::{Path, PathBuf};
use systems::{Stated, ToMap};

/// A named polygon, in pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Named {
    /// Its name.
    pub name: String,
    /// Its rings, pixels.
    pub polygon: Polygon,
    /// Its number of leaves, where the property `leaves` says it.
    pub leaves: Option<f64>,
    /// Its other properties by name: texts, numbers, truth values.
    pub attributes: Vec<(String, Value)>,
}

/// The polygons of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// The polygons in their order.
    pub polygons: Vec<Named>,
    /// What was chosen and what was left out, for people.
    pub notes: Vec<String>,
}

/// What polygons are drawn over, and how they are named.
#[derive(Debug, Clone, Copy, Default)]
pub struct Drawn<'a> {
    /// Where the raster lies.
    pub place: Option<&'a Georeference>,
    /// Its columns and rows; where they are given, a file nothing of which lies on the raster is refused.
    pub size: Option<(usize, usize)>,
    /// The property that has the names; found where it is not given.
    pub key: Option<&'a str>,
}

/// Closed rings of map positions.
type Rings = Vec<Vec<[f64; 2]>>;

/// What a feature of a file has for a shape.
#[derive(Debug, PartialEq)]
enum Shape {
    /// Polygons, each an outline and its holes.
    Polygons(Vec<Rings>),
    /// No area; what it is.
    NoArea(String),
}

/// A feature as a file has it.
struct Feature {
    shape: Shape,
    properties: serde_json::Map<String, Value>,
    id: Option<Value>,
}

impl Feature {
    /// Its positions.
    fn positions(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        let polygons = match &self.shape {
            Shape::Polygons(polygons) => &polygons[..],
            Shape::NoArea(_) => &[],
        };
        polygons.iter().flatten().flatten().copied()
    }
}

/// The endings of files that [`read`] understands, the usual one first.
pub const ENDINGS: [&str; 4] = ["geojson", "gpkg", "shp", "json"];
/// Those of other files of polygons.
pub const UNREAD_ENDINGS: [&str; 9] =
    ["kml", "kmz", "gml", "dxf", "fgb", "tab", "mif", "geojsonl", "zip"];

/// The files in a folder that are named `stem` and have one of these endings, in the order of the endings.
pub fn find(folder: &Path, stem: &str, endings: &[&str]) -> Vec<PathBuf> {
    let wanted = endings.iter().map(|ending| format!("{stem}.{ending}"));
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut files: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    files.sort();
    let is_named = |path: &&PathBuf, name: &String| {
        path.file_name().is_some_and(|of| of.eq_ignore_ascii_case(name.as_str())) && path.is_file()
    };
    wanted.filter_map(|name| files.iter().find(|path| is_named(path, &name)).cloned()).collect()
}

/// The files beside a shapefile that are there.
pub(crate) fn shapefile_parts(path: &Path) -> Vec<PathBuf> {
    let beside = ["dbf", "shx", "prj", "qpj", "cpg"];
    beside.iter().filter_map(|ending| shapes::beside(path, ending)).collect()
}

/// Reads the polygons of a file: `.gpkg`, `.shp`, else GeoJSON.
///
/// # Errors
/// As [`read_layer`], but for polygons that lie elsewhere.
pub fn read(path: &Path, georeference: Option<&Georeference>) -> Result<Vec<Named>, FileError> {
    Ok(read_layer(path, Drawn { place: georeference, ..Drawn::default() })?.polygons)
}

/// Reads the polygons of a file, and what there is to say of it.
///
/// # Errors
/// Where the file cannot be read or is damaged, has a reference system that is not known, no polygon, two of one name, or
/// one that is no area: a ring of fewer than three points or one that crosses itself; where none lies on the raster.
pub fn read_layer(path: &Path, drawn: Drawn<'_>) -> Result<Layer, FileError> {
    let (features, stated) = features(path)?;
    let malformed = |message| FileError::malformed(path, None, message);
    let to_map = systems::to_map(drawn.place, &stated, &features).map_err(malformed)?;
    let read = layer(&features, drawn, &to_map);
    let Some(size) = drawn.size else { return read.map_err(malformed) };
    match read {
        Ok(layer) if layer.polygons.iter().any(|of| touches(&of.polygon, size)) => Ok(layer),
        // Places that a projection does not reach, and places beside the raster, may have the same cause; what is wrong wherever they lie
        // has another.
        other => {
            let same: ToMap = Box::new(Ok);
            layer(&features, Drawn { key: drawn.key, ..Drawn::default() }, &same)
                .map_err(malformed)?;
            let cause = systems::misfit(drawn.place, size, &stated, &features);
            Err(malformed(match (other, cause) {
                (_, Some(cause)) => cause,
                (Err(message), None) => message,
                (Ok(_), None) => "none of its polygons lies on the map".to_owned(),
            }))
        }
    }
}

/// Whether the polygons of a file can be used wherever they lie.
///
/// # Errors
/// As [`read_layer`], but for the reference system.
pub fn check(path: &Path, key: Option<&str>) -> Result<Layer, FileError> {
    let same: ToMap = Box::new(Ok);
    let read = layer(&features(path)?.0, Drawn { key, ..Drawn::default() }, &same);
    read.map_err(|message| FileError::malformed(path, None, message))
}

/// Whether a file states where its polygons lie, or has degrees, which need no statement.
///
/// # Errors
/// As [`read_layer`], where the file is damaged.
pub fn is_placed(path: &Path) -> Result<bool, FileError> {
    let (features, stated) = features(path)?;
    let mut positions = features.iter().flat_map(Feature::positions);
    Ok(stated != Stated::Nothing || positions.all(systems::in_degrees))
}

/// Whether two polygons share an area, looked for at 32 x 32 places of what their boxes share: what is narrower than that is an inexact border.
fn overlap(a: &Polygon, b: &Polygon) -> bool {
    const PLACES: usize = 32;
    let Some((a_box, b_box)) = a.bounds().zip(b.bounds()) else { return false };
    let low = [0, 1].map(|k| a_box[0][k].max(b_box[0][k]));
    let high = [0, 1].map(|k| a_box[1][k].min(b_box[1][k]));
    let at = |k: usize, n: usize| low[k] + (n as f64 + 0.5) / PLACES as f64 * (high[k] - low[k]);
    let places: Vec<[f64; 2]> =
        (0..PLACES * PLACES).map(|n| [at(0, n % PLACES), at(1, n / PLACES)]).collect();
    let shared = low[0] < high[0] && low[1] < high[1];
    let within_a: Vec<[f64; 2]> = match shared {
        true => a.inside(&places).into_iter().map(|n| places[n]).collect(),
        false => Vec::new(),
    };
    !b.inside(&within_a).is_empty()
}

/// Whether the box around a polygon meets a raster.
fn touches(polygon: &Polygon, (width, height): (usize, usize)) -> bool {
    let Some([low, high]) = polygon.bounds() else { return false };
    let size = [width as f64, height as f64];
    (0..2).all(|axis| high[axis] > -0.5 && low[axis] < size[axis] - 0.5)
}

fn features(path: &Path) -> Result<(Vec<Feature>, Stated), FileError> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match ending.as_deref() {
        Some("shp") => shapes::read(path),
        #[cfg(feature = "geopackage")]
        Some("gpkg") => package::read(path),
        #[cfg(not(feature = "geopackage"))]
        Some("gpkg") => Err(super::gpkg::unavailable(path)),
        _ => geojson::read(path),
    }
}

fn layer(features: &[Feature], drawn: Drawn<'_>, to_map: &ToMap) -> Result<Layer, String> {
    let mut notes = Vec::new();
    let names = names::of(features, drawn.key, &mut notes)?;
    let mut polygons = Vec::with_capacity(features.len());
    for (feature, name) in features.iter().zip(names.texts) {
        match &feature.shape {
            Shape::NoArea(what) => notes.push(format!("feature {name} {what} and is left out")),
            Shape::Polygons(parts) => {
                let of = Outlines { name: &name, place: drawn.place, to_map };
                let polygon = of.polygon(parts, &mut notes)?;
                let (leaves, attributes) = names::properties(feature, &name, names.key.as_deref())?;
                polygons.push(Named { name, polygon, leaves, attributes });
            }
        }
    }
    if polygons.is_empty() {
        let left_out: String = notes.iter().map(|note| format!("; {note}")).collect();
        return Err(format!("it has no polygons, expected one for each plot{left_out}"));
    }
    Ok(Layer { polygons, notes })
}

/// How the rings of a feature become a polygon in pixels.
struct Outlines<'a> {
    name: &'a str,
    place: Option<&'a Georeference>,
    to_map: &'a ToMap,
}

impl Outlines<'_> {
    fn polygon(&self, parts: &[Rings], notes: &mut Vec<String>) -> Result<Polygon, String> {
        let Outlines { name, place, .. } = self;
        let mut whole = Vec::<Polygon>::with_capacity(parts.len());
        for part in parts {
            let rings = part.iter().map(|ring| self.ring(ring));
            let mut rings = rings.collect::<Result<Vec<_>, _>>()?.into_iter();
            let Some(outline) = rings.next() else { continue };
            let shell = Polygon { rings: vec![outline] };
            let mut polygon = shell.clone();
            for hole in rings {
                // A hole beside its outline would add its area.
                if shell.inside(&hole).is_empty() {
                    notes.push(format!(
                        "feature {name}: a hole lies outside of its outline and is left out"
                    ));
                } else {
                    polygon.rings.push(hole);
                }
            }
            if whole.iter().any(|other| overlap(other, &polygon)) {
                return Err(format!(
                    "feature {name}: two of its parts lie over each other, expected parts beside each other; dissolve them into one"
                ));
            }
            whole.push(polygon);
        }
        let polygon = Polygon { rings: whole.into_iter().flat_map(|part| part.rings).collect() };
        if let Some(at) = polygon.crossing() {
            let [x, y] = place.map_or(at, |place| place.map(at));
            return Err(format!(
                "feature {name}: its outline crosses itself at {x:.2}, {y:.2}, expected corners in their order around the plot"
            ));
        }
        if polygon.is_flat() {
            return Err(format!("feature {name}: its points lie on one line, expected an area"));
        }
        Ok(polygon)
    }

    fn ring(&self, ring: &[[f64; 2]]) -> Result<Vec<[f64; 2]>, String> {
        let Outlines { name, place, to_map } = self;
        let mut points = Vec::with_capacity(ring.len());
        for &position in ring {
            let position = to_map(position).map_err(|e| format!("feature {name}: {e}"))?;
            let point = match place {
                None => Some(position),
                Some(place) => place.pixel(position),
            };
            points.push(point.ok_or("the raster has no area on the map")?);
        }
        if points.first() == points.last() {
            points.pop();
        }
        if points.len() < 3 {
            return Err(format!("feature {name}: a ring has fewer than three points"));
        }
        if !points.iter().flatten().all(|x: &f64| x.is_finite()) {
            return Err(format!("feature {name}: a position is no finite number"));
        }
        Ok(points)
    }
}

#[cfg(test)]
mod tests;
