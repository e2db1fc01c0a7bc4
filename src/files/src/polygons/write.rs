//! Plots as files: GeoJSON, GeoPackage, shapefile, by the ending of the name.
//!
//! All have the property `plot` and the attributes in their order. Coordinates are those of the map; the file says which
//! (`crs` of GeoJSON, the reference system of the layer, `.prj`). Names of fields of a shapefile have ten letters at most.

use crate::gpkg::{self, Column, ColumnKind, Feature, Geometry, GeometryKind, Layer};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{
    georeference::{Crs, CrsKind},
    polygon as area,
};
use serde_json::{Map, Value, json};
use shapefile::{
    Point, Polygon, PolygonRing, ShapeWriter,
    dbase::{FieldName, FieldValue, Record, TableWriterBuilder},
};
use std::{collections::BTreeSet, io::Cursor, path::Path};

/// The property that has the name of a plot.
pub const NAME: &str = "plot";

/// A plot, region or panel to be written; its name is the property [`NAME`].
#[derive(Debug, Clone, PartialEq)]
pub struct Outline {
    /// Its name.
    pub name: String,
    /// Its rings, map coordinates.
    pub rings: Vec<Vec<[f64; 2]>>,
    /// Attributes: the same names in the same order for every plot. Null where a plot has none.
    pub attributes: Vec<(String, Value)>,
}

/// Writes plots to `.geojson`, `.gpkg` or `.shp` (with `.dbf`, `.shx` and `.prj` beside it).
///
/// # Errors
/// Another ending, a file that exists unless `force`, a build without GeoPackages, and writing.
pub fn write(
    path: &Path,
    force: bool,
    plots: &[Outline],
    crs: Option<Crs>,
) -> Result<(), FileError> {
    output::expect_ending(path, &super::ENDINGS)?;
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    match ending.as_deref() {
        Some("gpkg") => package(path, force, plots, crs),
        Some("shp") => shapes(path, force, plots, crs),
        _ => geojson(path, force, plots, crs),
    }
}

fn closed(ring: &[[f64; 2]], crs: Option<Crs>) -> Vec<[f64; 2]> {
    let kind = crs.map_or(CrsKind::Unknown, |crs| crs.kind);
    ring.iter().chain(ring.first()).map(|&at| kind.rounded(at)).collect()
}

/// The geometry of a plot in GeoJSON, from its closed rings: a `MultiPolygon` where it has several parts.
pub fn geometry(rings: &[Vec<[f64; 2]>]) -> Value {
    let parts = area::Polygon { rings: rings.to_vec() }.parts();
    let mut parts: Vec<_> = parts.into_iter().map(|part| part.rings).collect();
    match parts.len() {
        1 => json!({"type": "Polygon", "coordinates": parts.swap_remove(0)}),
        _ => json!({"type": "MultiPolygon", "coordinates": parts}),
    }
}

fn geojson(path: &Path, force: bool, plots: &[Outline], crs: Option<Crs>) -> Result<(), FileError> {
    let feature = |plot: &Outline| {
        let mut properties = Map::from_iter([(NAME.to_owned(), plot.name.clone().into())]);
        properties.extend(plot.attributes.iter().cloned());
        let rings: Vec<_> = plot.rings.iter().map(|ring| closed(ring, crs)).collect();
        json!({
            "type": "Feature",
            "properties": properties,
            "geometry": geometry(&rings),
        })
    };
    write_features(path, force, plots.iter().map(feature).collect(), crs)
}

/// Writes features of GeoJSON with the system of their coordinates.
///
/// # Errors
/// As [`output::write`].
pub fn write_features(
    path: &Path,
    force: bool,
    features: Vec<Value>,
    crs: Option<Crs>,
) -> Result<(), FileError> {
    let mut collection = json!({"type": "FeatureCollection", "features": features});
    if let Some(crs) = crs.and_then(crs_member) {
        collection["crs"] = crs;
    }
    output::write(path, force, |out| writeln!(out, "{collection}"))
}

/// What a collection says of its system.
pub(crate) fn crs_member(crs: Crs) -> Option<Value> {
    let name = format!("urn:ogc:def:crs:EPSG::{}", crs.epsg?);
    Some(json!({"type": "name", "properties": {"name": name}}))
}

/// Names of the attributes, and whether each is a number in every plot that has one.
fn columns(plots: &[Outline]) -> Vec<(String, bool)> {
    let Some(first) = plots.first() else { return Vec::new() };
    let is_number = |k: usize| {
        let values = || plots.iter().filter_map(|plot| plot.attributes.get(k));
        values().all(|(_, value)| value.is_number() || value.is_null())
            && values().any(|(_, value)| value.is_number())
    };
    first.attributes.iter().enumerate().map(|(k, (name, _))| (name.clone(), is_number(k))).collect()
}

fn text(value: &Value) -> Option<String> {
    match value {
        Value::Null => None,
        Value::String(text) => Some(text.clone()),
        other => Some(other.to_string()),
    }
}

fn package(path: &Path, force: bool, plots: &[Outline], crs: Option<Crs>) -> Result<(), FileError> {
    let own = columns(plots);
    let kind = |is_number| if is_number { ColumnKind::Real } else { ColumnKind::Text };
    let columns = std::iter::once(Column::new("plot", ColumnKind::Text))
        .chain(own.iter().map(|(name, is_number)| Column::new(name, kind(*is_number))));
    let feature = |plot: &Outline| {
        let values = plot.attributes.iter().zip(&own).map(|((_, value), (_, is_number))| {
            match (is_number, value.as_f64()) {
                (true, Some(number)) => gpkg::Value::Real(number),
                _ => text(value).map_or(gpkg::Value::Null, gpkg::Value::Text),
            }
        });
        let name = gpkg::Value::Text(plot.name.clone());
        let rings = plot.rings.iter().map(|ring| closed(ring, crs)).collect();
        Feature {
            geometry: Some(Geometry::Polygon(rings)),
            values: std::iter::once(name).chain(values).collect(),
        }
    };
    let layer = Layer {
        name: "plots".to_owned(),
        description: "Plots".to_owned(),
        kind: GeometryKind::Polygon,
        crs,
        columns: columns.collect(),
        features: plots.iter().map(feature).collect(),
    };
    gpkg::write(path, force, &[layer])
}

/// Letters of the name of a field, and bytes of a text.
const FIELD_LETTERS: usize = 10;
const FIELD_BYTES: usize = 254;

fn shapes(path: &Path, force: bool, plots: &[Outline], crs: Option<Crs>) -> Result<(), FileError> {
    for ending in ["dbf", "shx", "prj"] {
        output::check(&path.with_extension(ending), force)?;
    }
    output::check(path, force)?;
    let failed = |error: &dyn std::fmt::Display| {
        FileError::write(path, std::io::Error::other(error.to_string()))
    };
    let own = columns(plots);
    let mut taken = BTreeSet::from(["plot".to_owned()]);
    let fields: Vec<String> = own.iter().map(|(name, _)| field(name, &mut taken)).collect();
    let name_of = |name: &str| FieldName::try_from(name).map_err(|error| failed(&error));
    let longest = |k: Option<usize>| {
        let texts = plots.iter().map(|plot| match k {
            None => plot.name.len(),
            Some(k) => text(&plot.attributes[k].1).map_or(0, |text| text.len()),
        });
        texts.max().unwrap_or(1).clamp(1, FIELD_BYTES) as u8
    };
    let mut table = TableWriterBuilder::new().add_character_field(name_of("plot")?, longest(None));
    for (k, ((_, is_number), name)) in own.iter().zip(&fields).enumerate() {
        table = match is_number {
            true => table.add_numeric_field(name_of(name)?, 20, 6),
            false => table.add_character_field(name_of(name)?, longest(Some(k))),
        };
    }
    let [mut shp, mut shx, mut dbf] = [(); 3].map(|()| Cursor::new(Vec::new()));
    let mut writer = shapefile::Writer::new(
        ShapeWriter::with_shx(&mut shp, &mut shx),
        table.build_with_dest(&mut dbf),
    );
    for plot in plots {
        let mut record = Record::default();
        record.insert("plot".to_owned(), FieldValue::Character(Some(plot.name.clone())));
        for ((name, (_, is_number)), (_, value)) in fields.iter().zip(&own).zip(&plot.attributes) {
            let value = match is_number {
                true => FieldValue::Numeric(value.as_f64()),
                false => FieldValue::Character(text(value)),
            };
            record.insert(name.clone(), value);
        }
        let ring = |(k, ring): (usize, &Vec<[f64; 2]>)| {
            let points = closed(ring, crs).into_iter().map(|[x, y]| Point::new(x, y)).collect();
            if k == 0 { PolygonRing::Outer(points) } else { PolygonRing::Inner(points) }
        };
        let parts = area::Polygon { rings: plot.rings.clone() }.parts();
        let rings = parts.iter().flat_map(|part| part.rings.iter().enumerate().map(ring));
        let polygon = Polygon::with_rings(rings.collect());
        writer.write_shape_and_record(&polygon, &record).map_err(|error| failed(&error))?;
    }
    drop(writer);
    let parts =
        [("dbf", undated(dbf.into_inner())), ("shx", shx.into_inner()), ("shp", shp.into_inner())];
    for (ending, bytes) in parts {
        output::write(&path.with_extension(ending), force, |out| out.write_all(&bytes))?;
    }
    match crs.and_then(projection) {
        Some(text) => {
            output::write(&path.with_extension("prj"), force, |out| out.write_all(text.as_bytes()))
        }
        None => {
            // One that is there says another system.
            let old = path.with_extension("prj");
            match std::fs::remove_file(&old) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    Err(FileError::write(&old, error))
                }
                _ => Ok(()),
            }
        }
    }
}

/// The table with a fixed date of its last change: the same plots give the same bytes.
fn undated(mut table: Vec<u8>) -> Vec<u8> {
    if let Some(date) = table.get_mut(1..4) {
        date.copy_from_slice(&[70, 1, 1]);
    }
    table
}

/// The first ten letters of a name, with a number at the end where they are taken.
fn field(name: &str, taken: &mut BTreeSet<String>) -> String {
    let plain: String = name.chars().filter(char::is_ascii).collect();
    let plain = if plain.is_empty() { "field".to_owned() } else { plain };
    let cut = |length: usize| plain.chars().take(length).collect::<String>();
    let numbered = (2..100).map(|k: u32| format!("{}{k}", cut(FIELD_LETTERS - 2)));
    let name = std::iter::once(cut(FIELD_LETTERS))
        .chain(numbered)
        .find(|name| !taken.contains(&name.to_lowercase()))
        .unwrap_or_else(|| format!("f{}", taken.len()));
    taken.insert(name.to_lowercase());
    name
}

/// A family of UTM zones: first and last zone, code of zone 0, names of datum, ellipsoid and its numbers, and the southern
/// hemisphere.
type Zones = (std::ops::RangeInclusive<u32>, u32, [&'static str; 3], bool);

const ZONES: [Zones; 5] = [
    (1..=60, 32600, ["WGS_1984", "WGS_1984", "6378137.0,298.257223563"], false),
    (1..=60, 32700, ["WGS_1984", "WGS_1984", "6378137.0,298.257223563"], true),
    (1..=23, 26900, ["North_American_1983", "GRS_1980", "6378137.0,298.257222101"], false),
    (28..=38, 25800, ["ETRS_1989", "GRS_1980", "6378137.0,298.257222101"], false),
    (48..=58, 28300, ["GDA_1994", "GRS_1980", "6378137.0,298.257222101"], true),
];

/// Well-known text of a system as ArcGIS has it: UTM zones, and degrees on WGS84; `None` for others, which have no `.prj`.
pub fn projection(crs: Crs) -> Option<String> {
    let code = crs.epsg?;
    let geographic = |[datum, ellipsoid, numbers]: [&str; 3], name: &str| {
        format!(
            "GEOGCS[\"GCS_{name}\",DATUM[\"D_{datum}\",SPHEROID[\"{ellipsoid}\",{numbers}]],\
             PRIMEM[\"Greenwich\",0.0],UNIT[\"Degree\",0.0174532925199433]]"
        )
    };
    if code == 4326 {
        return Some(geographic(ZONES[0].2, "WGS_1984"));
    }
    let (_, base, datum, is_south) =
        ZONES.iter().find(|(zones, base, ..)| code > *base && zones.contains(&(code - base)))?;
    let zone = code - base;
    // The projected systems of North America have a shorter name than their datum.
    let name = if datum[0] == "North_American_1983" { "NAD_1983" } else { datum[0] };
    let (letter, northing) = if *is_south { ('S', 10_000_000) } else { ('N', 0) };
    let basis = geographic(*datum, datum[0]);
    Some(format!(
        "PROJCS[\"{name}_UTM_Zone_{zone}{letter}\",{basis},PROJECTION[\"Transverse_Mercator\"],\
         PARAMETER[\"False_Easting\",500000.0],PARAMETER[\"False_Northing\",{northing}.0],\
         PARAMETER[\"Central_Meridian\",{}.0],PARAMETER[\"Scale_Factor\",0.9996],\
         PARAMETER[\"Latitude_Of_Origin\",0.0],UNIT[\"Meter\",1.0]]",
        6 * i64::from(zone) - 183
    ))
}

#[cfg(test)]
mod tests {
    use super::{super::read, *};
    use rowgram_raster::georeference::Georeference;

    fn plots() -> Vec<Outline> {
        let ring = |x: f64| vec![[x, 200.0], [x + 4.0, 200.0], [x + 4.0, 190.0], [x, 190.0]];
        let plot = |name: &str, x: f64, genotype: Value, dose: Value| Outline {
            name: name.to_owned(),
            rings: vec![ring(x)],
            attributes: vec![("genotype".into(), genotype), ("nitrogen_dose_kg".into(), dose)],
        };
        vec![
            plot("101", 500_000.0, "B73 x Mo17".into(), 120.5.into()),
            plot("102", 500_004.0, Value::Null, 0.0.into()),
        ]
    }

    #[test]
    fn what_is_written_is_read_back_from_every_format() {
        let folder = tempfile::tempdir().unwrap();
        let crs = Crs::projected(32616);
        let place = Georeference::north_up([500_000.0, 200.0], 0.5, crs);
        for name in ["a.geojson", "a.gpkg", "a.shp"] {
            if name == "a.gpkg" && !cfg!(feature = "geopackage") {
                continue;
            }
            let path = folder.path().join(name);
            write(&path, false, &plots(), Some(crs)).unwrap();
            let found = read(&path, Some(&place)).unwrap();
            let names: Vec<&str> = found.iter().map(|plot| plot.name.as_str()).collect();
            assert_eq!(names, ["101", "102"], "{name}");
            assert_eq!(found[0].polygon.pixels(), 160, "{name}");
            let value = |plot: usize, key: &str| {
                let found = found[plot].attributes.iter().find(|(name, _)| name.starts_with(key));
                found.map(|(_, value)| value.clone())
            };
            assert_eq!(value(0, "genotype"), Some("B73 x Mo17".into()), "{name}");
            assert_eq!(value(0, "nitrogen").and_then(|x| x.as_f64()), Some(120.5), "{name}");
            assert_eq!(value(1, "genotype").filter(|x| x != ""), None, "{name}");
            assert!(matches!(write(&path, false, &plots(), None), Err(FileError::Exists { .. })));
            let bytes = std::fs::read(&path).unwrap();
            write(&path, true, &plots(), Some(crs)).unwrap();
            assert!(bytes == std::fs::read(&path).unwrap(), "{name}: the same plots, other bytes");
        }
        let error = write(&folder.path().join("a.kml"), false, &plots(), None).unwrap_err();
        assert!(error.to_string().contains(".geojson or .gpkg or .shp"), "{error}");
        // Nothing of the drafts stays; a shapefile is four files.
        let expected = 5 + usize::from(cfg!(feature = "geopackage"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), expected);
    }

    #[test]
    fn names_of_fields_are_told_apart() {
        let mut taken = BTreeSet::from(["plot".to_owned()]);
        let names = ["nitrogen_dose_kg", "nitrogen_dose_lb", "ä", "Plot"];
        let fields: Vec<String> = names.iter().map(|name| field(name, &mut taken)).collect();
        assert_eq!(fields, ["nitrogen_d", "nitrogen2", "field", "Plot2"]);
    }
}
