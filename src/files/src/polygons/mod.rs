//! Polygons with names: plots, calibration regions. GeoJSON, shapefiles and GeoPackages.
//!
//! Each comes out in pixels of the raster that it is drawn over. Coordinates in another reference system than the
//! raster's are transformed; a GeoJSON file that states none is in longitude and latitude where the standard says so
//! (RFC 7946) and its numbers allow nothing else, otherwise in the raster's own. Where the raster has no place on the
//! map, coordinates are pixels (the centre of the top-left pixel at 0, 0). A polygon's name is its property `name`,
//! `plot` or `id`, else its number. Other properties come along as attributes. [`write()`] writes plots.
//!
//! A file without polygons, two polygons of one name, a ring that crosses itself and a polygon without area are refused: each
//! would give traits of something that nobody drew.

mod geojson;
#[cfg(feature = "geopackage")]
mod package;
mod shapes;
mod write;

pub use write::{Outline, projection, write};

use super::FileError;
use rowgram_raster::{
    crs,
    georeference::{CrsKind, Georeference},
    polygon::Polygon,
};
use serde_json::Value;
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

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

/// Properties that are a name, the first one first.
pub const NAMES: [&str; 3] = ["name", "plot", "id"];
/// Properties that are no attributes: the number of leaves, and numbers that programs give to rows.
const NO_ATTRIBUTES: [&str; 4] = ["leaves", "fid", "ogc_fid", "objectid"];

/// What the coordinates of a file are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stated {
    /// The file does not say.
    Nothing,
    /// Longitude and latitude, degrees.
    Degrees,
    /// A system of the EPSG registry.
    Epsg(u32),
}

impl Stated {
    /// A code of the registry; the usual geographic ones are degrees whatever their datum is, which differs by less
    /// than the outline of a plot is worth.
    fn code(epsg: u32) -> Stated {
        if matches!(epsg, 4326 | 4258 | 4269 | 4979) { Stated::Degrees } else { Stated::Epsg(epsg) }
    }
}

/// A polygon as a file has it.
struct Feature {
    /// Rings of map positions; holes are rings inside others.
    rings: Vec<Vec<[f64; 2]>>,
    properties: serde_json::Map<String, Value>,
    id: Option<Value>,
}

/// The endings of files that [`read`] understands, the usual one first.
pub const ENDINGS: [&str; 3] = ["geojson", "gpkg", "shp"];

/// The file of polygons named `stem` in a folder, where there is one.
pub fn find(folder: &Path, stem: &str) -> Option<PathBuf> {
    let files = ENDINGS.iter().map(|ending| folder.join(format!("{stem}.{ending}")));
    files.into_iter().find(|path| path.is_file())
}

/// All files that a file of polygons consists of, itself first.
pub fn files(path: &Path) -> Vec<PathBuf> {
    let mut files = vec![path.to_owned()];
    if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("shp")) {
        let beside = ["dbf", "shx", "prj"].map(|ending| path.with_extension(ending));
        files.extend(beside.into_iter().filter(|path| path.is_file()));
    }
    files
}

/// Reads the polygons of a file: `.gpkg`, `.shp`, else GeoJSON.
///
/// # Errors
/// Where the file cannot be read or is damaged, has a reference system that is not known, no polygon, two of one name, or
/// one that is no area: a ring of fewer than three points or one that crosses itself.
pub fn read(path: &Path, georeference: Option<&Georeference>) -> Result<Vec<Named>, FileError> {
    let (features, stated) = features(path)?;
    let malformed = |message| FileError::malformed(path, None, message);
    let to_map = to_map_of(georeference, stated, &features).map_err(malformed)?;
    all_named(features, georeference, &to_map).map_err(malformed)
}

/// Whether the polygons of a file can be used wherever they lie; how many there are.
///
/// # Errors
/// As [`read`], but for the reference system.
pub fn check(path: &Path) -> Result<usize, FileError> {
    let same: ToMap = Box::new(Ok);
    let named = all_named(features(path)?.0, None, &same);
    Ok(named.map_err(|message| FileError::malformed(path, None, message))?.len())
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

fn all_named(
    features: Vec<Feature>,
    place: Option<&Georeference>,
    to_map: &ToMap,
) -> Result<Vec<Named>, String> {
    if features.is_empty() {
        return Err("it has no polygons, expected one for each plot".to_owned());
    }
    let named: Vec<Named> = features
        .into_iter()
        .enumerate()
        .map(|(index, feature)| named(index, feature, place, to_map))
        .collect::<Result<_, _>>()?;
    let mut names = BTreeSet::new();
    match named.iter().find(|polygon| !names.insert(polygon.name.as_str())) {
        Some(Named { name, .. }) => Err(format!(
            "two polygons are named {name:?}, expected a name for each; parts of one plot belong into one MultiPolygon"
        )),
        None => Ok(named),
    }
}

type ToMap = Box<dyn Fn([f64; 2]) -> Result<[f64; 2], String>>;

/// How coordinates of a file become those of the raster's map.
fn to_map_of(
    place: Option<&Georeference>,
    stated: Stated,
    features: &[Feature],
) -> Result<ToMap, String> {
    let same: ToMap = Box::new(Ok);
    let Some(place) = place else {
        return match stated {
            Stated::Nothing => Ok(same),
            _ => Err(
                "it has a reference system and the raster has none: draw the polygons in pixels"
                    .into(),
            ),
        };
    };
    let in_degrees = |[x, y]: [f64; 2]| x.abs() <= 180.0 && y.abs() <= 90.0;
    let all_degrees =
        || features.iter().flat_map(|f| f.rings.iter().flatten()).all(|&p| in_degrees(p));
    let stated = match stated {
        Stated::Nothing
            if place.crs.epsg.is_some() && !in_degrees(place.origin) && all_degrees() =>
        {
            Stated::Degrees
        }
        stated => stated,
    };
    let known = |code| crs::Crs::from_epsg(code).map_err(|e| e.to_string());
    let to_degrees: ToMap = match stated {
        Stated::Nothing => return Ok(same),
        Stated::Epsg(code) if place.crs.epsg == Some(code) => return Ok(same),
        Stated::Degrees if place.crs.kind == CrsKind::Geographic => return Ok(same),
        Stated::Degrees => same,
        Stated::Epsg(code) => {
            let from = known(code)?;
            Box::new(move |[x, y]| {
                let [latitude, longitude] = from.to_wgs84(x, y).map_err(|e| e.to_string())?;
                Ok([longitude, latitude])
            })
        }
    };
    match (place.crs.kind, place.crs.epsg) {
        (CrsKind::Geographic, _) => Ok(to_degrees),
        (_, Some(code)) => {
            let onto = known(code)?;
            Ok(Box::new(move |p| {
                let [longitude, latitude] = to_degrees(p)?;
                onto.from_wgs84(latitude, longitude).map_err(|e| e.to_string())
            }))
        }
        (_, None) => Err(format!(
            "it is in {}, and the raster does not say its reference system",
            match stated {
                Stated::Epsg(code) => format!("EPSG:{code}"),
                _ => "longitude and latitude".to_owned(),
            }
        )),
    }
}

fn named(
    index: usize,
    feature: Feature,
    place: Option<&Georeference>,
    to_map: &ToMap,
) -> Result<Named, String> {
    // Names of fields of a table are in capitals with some programs.
    let property = |key: &str| {
        let found = feature.properties.iter().find(|(name, _)| name.eq_ignore_ascii_case(key));
        found.map(|(_, value)| value).filter(|value| !value.is_null())
    };
    let name = NAMES.into_iter().find_map(property).or(feature.id.as_ref());
    let name = match name {
        Some(Value::String(text)) => text.clone(),
        Some(Value::Null) | None => (index + 1).to_string(),
        Some(other) => other.to_string(),
    };
    let leaves = match property("leaves") {
        None => None,
        Some(value) => Some(value.as_f64().ok_or_else(|| {
            format!("feature {name}: its property leaves is {value}, expected a number")
        })?),
    };
    let own =
        |key: &str| NAMES.iter().chain(&NO_ATTRIBUTES).any(|other| other.eq_ignore_ascii_case(key));
    let attributes = feature
        .properties
        .iter()
        .filter(|(key, value)| {
            !own(key) && (value.is_string() || value.is_number() || value.is_boolean())
        })
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect();
    let mut polygon = Polygon::default();
    for ring in feature.rings {
        let mut points = Vec::with_capacity(ring.len());
        for position in ring {
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
        polygon.rings.push(points);
    }
    if let Some(at) = polygon.crossing() {
        let [x, y] = place.map_or(at, |place| place.map(at));
        return Err(format!(
            "feature {name}: its outline crosses itself at {x:.2}, {y:.2}, expected corners in their order around the plot"
        ));
    }
    if polygon.is_flat() {
        return Err(format!("feature {name}: its points lie on one line, expected an area"));
    }
    Ok(Named { name, polygon, leaves, attributes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;

    fn parse(text: &str, place: Option<&Georeference>) -> Result<Vec<Named>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.geojson");
        std::fs::write(&path, text).unwrap();
        read(&path, place).map_err(|error| error.to_string())
    }

    const PLOTS: &str = r#"{"type":"FeatureCollection",
        "crs":{"type":"name","properties":{"name":"urn:ogc:def:crs:EPSG::32616"}},"features":[
        {"type":"Feature","properties":{"name":"A","leaves":12},
         "geometry":{"type":"Polygon","coordinates":[[[100,200],[110,200],[110,190],[100,200]]]}},
        {"type":"Feature","id":7,"properties":null,
         "geometry":{"type":"MultiPolygon","coordinates":[[[[0,0,5],[1,0,5],[1,1,5]]]]}}]}"#;

    #[test]
    fn plots_are_named_and_in_pixels() {
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
        let plots = parse(PLOTS, Some(&place)).unwrap();
        assert_eq!((plots[0].name.as_str(), plots[0].leaves), ("A", Some(12.0)));
        assert_eq!(plots[0].polygon.rings, [[[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]]]);
        assert_eq!((plots[1].name.as_str(), plots[1].leaves), ("7", None));
        let unnamed = PLOTS.replace("\"crs\"", "\"other\"");
        assert_eq!(parse(&unnamed, None).unwrap()[0].polygon.rings[0][0], [100.0, 200.0]);
    }

    #[test]
    fn what_cannot_be_used_is_told() {
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32617));
        let error = parse(&PLOTS.replace("32616", "999999"), Some(&place)).unwrap_err();
        assert!(error.contains("EPSG:999999 is not a known"), "{error}");
        let nowhere = Georeference { crs: Crs::LOCAL, ..place };
        let error = parse(PLOTS, Some(&nowhere)).unwrap_err();
        assert!(error.contains("EPSG:32616") && error.contains("does not say"), "{error}");
        assert!(parse(PLOTS, None).unwrap_err().contains("in pixels"));
        let plots = PLOTS.replace("\"crs\"", "\"other\"");
        for (text, expected) in [
            ("", "expected GeoJSON"),
            ("{\"type\":\"Topology\"}", "expected GeoJSON"),
            (&plots.replace("12", "\"many\""), "expected a number"),
            (&plots.replace("[110,200],[110,190],", ""), "fewer than three points"),
            (&plots.replace("[110,200]", "[110]"), "fewer than two numbers"),
            (&plots.replace("MultiPolygon", "Point"), "expected GeoJSON"),
        ] {
            let error = parse(text, None).unwrap_err();
            assert!(error.contains(expected) && error.contains("plots.geojson"), "{error}");
        }
    }

    #[test]
    fn what_nobody_meant_to_draw_is_refused() {
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
        let square = "[[100,200],[110,200],[110,190],[100,200]]";
        for (text, expected) in [
            (
                PLOTS.replace(square, "[[100,200],[110,190],[110,200],[100,190],[100,200]]"),
                "crosses itself at 105.00, 195.00",
            ),
            (PLOTS.replace(square, "[[100,200],[105,195],[110,190],[100,200]]"), "on one line"),
            (PLOTS.replace("\"id\":7", "\"id\":\"A\""), "two polygons are named \"A\""),
            (r#"{"type":"FeatureCollection","features":[]}"#.to_owned(), "no polygons"),
        ] {
            let error = parse(&text, Some(&place)).unwrap_err();
            assert!(error.contains(expected) && error.contains("plots.geojson"), "{error}");
        }
    }

    #[test]
    fn properties_come_along_and_names_do_not() {
        let text = PLOTS.replace(
            "\"leaves\":12",
            "\"leaves\":12,\"genotype\":\"B73\",\"block\":2,\"fid\":9,\"note\":null",
        );
        let plots = parse(&text, None).unwrap_err();
        assert!(plots.contains("in pixels"), "{plots}");
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
        let plots = parse(&text, Some(&place)).unwrap();
        let kept: Vec<&str> = plots[0].attributes.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(kept, ["block", "genotype"]);
        assert!(plots[1].attributes.is_empty());
    }

    #[test]
    fn a_file_is_checked_without_a_map() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.geojson");
        std::fs::write(&path, PLOTS).unwrap();
        assert_eq!(check(&path).unwrap(), 2);
        std::fs::write(&path, PLOTS.replace("\"id\":7", "\"id\":\"A\"")).unwrap();
        assert!(check(&path).unwrap_err().to_string().contains("two polygons"));
    }

    /// The same corner of a field in three systems comes to the same pixel.
    #[test]
    fn other_systems_are_transformed() {
        let corner = [500_670.0, 4_480_143.0];
        let zone_16 = crs::Crs::from_epsg(32616).unwrap();
        let place = Georeference::north_up(corner, 0.02, Crs::projected(32616));
        let [latitude, longitude] = zone_16.to_wgs84(corner[0] + 1.0, corner[1] - 2.0).unwrap();
        let [x, y] = crs::Crs::from_epsg(32617).unwrap().from_wgs84(latitude, longitude).unwrap();
        let text = |crs: &str, x: f64, y: f64| {
            format!(
                r#"{{"type":"FeatureCollection"{crs},"features":[{{"type":"Feature","geometry":
                {{"type":"Polygon","coordinates":[[[{x},{y}],[{},{y}],[{x},{}],[{x},{y}]]]}}}}]}}"#,
                x + 1e-4,
                y + 1e-4
            )
        };
        let named = |code: &str| {
            format!(r#","crs":{{"type":"name","properties":{{"name":"urn:ogc:def:crs:{code}"}}}}"#)
        };
        for text in [
            text("", longitude, latitude),
            text(&named("OGC:1.3:CRS84"), longitude, latitude),
            text(&named("EPSG::4326"), longitude, latitude),
            text(&named("EPSG::32617"), x, y),
        ] {
            let [u, v] = parse(&text, Some(&place)).unwrap()[0].polygon.rings[0][0];
            assert!((u - 50.0).abs() < 0.01 && (v - 100.0).abs() < 0.01, "{u} {v}: {text}");
        }
    }

    #[test]
    fn a_shapefile_is_read() {
        use shapefile::{
            Point, Polygon, PolygonRing,
            dbase::{FieldValue, Record, TableWriterBuilder},
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.shp");
        let table = TableWriterBuilder::new()
            .add_character_field("PLOT".try_into().unwrap(), 20)
            .add_numeric_field("LEAVES".try_into().unwrap(), 10, 1);
        let mut writer = shapefile::Writer::from_path(&path, table).unwrap();
        let ring = [(100.0, 200.0), (100.0, 190.0), (110.0, 190.0), (100.0, 200.0)];
        let polygon = Polygon::new(PolygonRing::Outer(ring.map(|(x, y)| Point::new(x, y)).into()));
        let mut record = Record::default();
        record.insert("PLOT".into(), FieldValue::Character(Some("7 b".into())));
        record.insert("LEAVES".into(), FieldValue::Numeric(Some(12.0)));
        writer.write_shape_and_record(&polygon, &record).unwrap();
        drop(writer);
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
        let plots = read(&path, Some(&place)).unwrap();
        assert_eq!((plots[0].name.as_str(), plots[0].leaves), ("7 b", Some(12.0)));
        assert_eq!(plots[0].polygon.rings[0].len(), 3);
        assert!(plots[0].polygon.rings[0].contains(&[20.0, 20.0]));
        // Stated by name, in the words of ArcGIS.
        let projection = folder.path().join("plots.prj");
        std::fs::write(&projection, r#"PROJCS["WGS_1984_UTM_Zone_16N",GEOGCS["GCS_WGS_1984"]]"#)
            .unwrap();
        assert_eq!(read(&path, Some(&place)).unwrap(), plots);
        std::fs::write(&projection, r#"PROJCS["Mine",GEOGCS["GCS_WGS_1984"]]"#).unwrap();
        let error = read(&path, Some(&place)).unwrap_err().to_string();
        assert!(error.contains("plots.prj") && error.contains("Mine"), "{error}");
        std::fs::remove_file(folder.path().join("plots.dbf")).unwrap();
        assert!(read(&path, None).unwrap_err().to_string().contains("plots.shp"));
    }
}
