//! Shapefiles: `.shp` with `.dbf`, and `.prj` (or `.qpj` of QGIS) and `.cpg` where there are any.

use super::{Feature, Rings, Shape, systems::Stated};
use encoding_rs::{Encoding, WINDOWS_1252};
use rowgram_optim::output::FileError;
use rowgram_raster::polygon::Polygon;
use serde_json::{Map, Value};
use shapefile::{
    Point, PolygonRing, Reader, ShapeReader,
    dbase::{
        FieldValue, ReaderBuilder, Record,
        encoding::{DynEncoding, EncodingRs, Unicode},
    },
};
use std::path::Path;

/// The polygons of a file, and what its coordinates are.
pub(super) fn read(path: &Path) -> Result<(Vec<Feature>, Stated), FileError> {
    std::fs::metadata(path).map_err(|error| FileError::read(path, error))?;
    let mut features = Vec::new();
    for (shape, record) in records(path)? {
        let polygons = match &shape {
            shapefile::Shape::Polygon(polygon) => parts(polygon.rings(), |p: &Point| [p.x, p.y]),
            shapefile::Shape::PolygonM(polygon) => parts(polygon.rings(), |p| [p.x, p.y]),
            shapefile::Shape::PolygonZ(polygon) => parts(polygon.rings(), |p| [p.x, p.y]),
            _ => Vec::new(),
        };
        let shape = match (polygons.is_empty(), &shape) {
            (false, _) => Shape::Polygons(polygons),
            (true, shapefile::Shape::NullShape) => Shape::NoArea("has no geometry".to_owned()),
            (true, other) => Shape::NoArea(format!("is a {}", other.shapetype())),
        };
        let properties = record.into_iter().map(|(name, field)| (name, value(field)));
        features.push(Feature { shape, properties: properties.collect::<Map<_, _>>(), id: None });
    }
    // QGIS wrote a second description with codes for a while.
    for ending in ["qpj", "prj"] {
        let projection = path.with_extension(ending);
        match std::fs::read(&projection) {
            Ok(text) => {
                let text = String::from_utf8_lossy(&text);
                let stated = Stated::well_known_text(text.trim_start_matches('\u{feff}').trim());
                let stated = stated.map_err(|why| {
                    let message =
                        format!("{why}; save the file in the system of the map, or as GeoJSON");
                    FileError::malformed(&projection, None, message)
                })?;
                return Ok((features, stated));
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => return Err(FileError::read(&projection, error)),
        }
    }
    Ok((features, Stated::Nothing))
}

/// Shapes and rows of the table. Texts are in the encoding of the `.cpg` file; without one in UTF-8, else in Windows-1252,
/// which holds Latin-1.
fn records(path: &Path) -> Result<Vec<(shapefile::Shape, Record)>, FileError> {
    let malformed = |error: shapefile::Error| {
        let message = format!("{error}; expected a shapefile with its .shx and .dbf beside it");
        FileError::malformed(path, None, message)
    };
    let with = |encoding: DynEncoding| {
        let table = ReaderBuilder::new().with_encoding(encoding).open(path.with_extension("dbf"));
        let table = table.map_err(shapefile::Error::DbaseError)?;
        Reader::new(ShapeReader::from_path(path)?, table).read()
    };
    if let Some(encoding) = stated_encoding(path)? {
        return with(EncodingRs::from(encoding).into()).map_err(malformed);
    }
    match with(Unicode.into()) {
        Err(shapefile::Error::DbaseError(_)) => {
            with(EncodingRs::from(WINDOWS_1252).into()).map_err(malformed)
        }
        other => other.map_err(malformed),
    }
}

/// The encoding that a `.cpg` file names: `UTF-8`, `ISO-8859-1`, `1252`, `ANSI 1252`, `88591`.
fn stated_encoding(path: &Path) -> Result<Option<&'static Encoding>, FileError> {
    let file = path.with_extension("cpg");
    let Ok(bytes) = std::fs::read(&file) else { return Ok(None) };
    let text = String::from_utf8_lossy(&bytes).trim_start_matches('\u{feff}').trim().to_lowercase();
    let digits: String = text.chars().filter(char::is_ascii_digit).collect();
    let label = match digits.as_str() {
        "65001" => "utf-8".to_owned(),
        _ if digits.len() == 4 && digits.starts_with("125") => format!("windows-{digits}"),
        _ if digits.starts_with("8859") && digits.len() > 4 => format!("iso-8859-{}", &digits[4..]),
        _ => text.clone(),
    };
    match Encoding::for_label(label.as_bytes()) {
        Some(encoding) => Ok(Some(encoding)),
        None if text.is_empty() => Ok(None),
        None => {
            let message =
                format!("the encoding {text:?} is not known, expected one such as UTF-8 or 1252");
            Err(FileError::malformed(&file, None, message))
        }
    }
}

/// Outlines with their holes.
fn parts<P>(rings: &[PolygonRing<P>], position: impl Fn(&P) -> [f64; 2]) -> Vec<Rings> {
    let points = |ring: &PolygonRing<P>| ring.points().iter().map(&position).collect::<Vec<_>>();
    let is_outer = |ring: &&PolygonRing<P>| matches!(ring, PolygonRing::Outer(_));
    let mut parts: Vec<Rings> =
        rings.iter().filter(is_outer).map(|ring| vec![points(ring)]).collect();
    for ring in rings.iter().filter(|ring| !is_outer(ring)) {
        let hole = points(ring);
        let holds = |part: &&mut Rings| {
            let shell = Polygon { rings: vec![part[0].clone()] };
            !shell.inside(&hole).is_empty()
        };
        match parts.iter_mut().find(holds) {
            Some(part) => part.push(hole),
            // Programs that do not care for the sense of rings write outlines like this.
            None => parts.push(vec![hole]),
        }
    }
    parts
}

fn value(field: FieldValue) -> Value {
    match field {
        FieldValue::Character(text) => text.map(|t| t.trim().to_owned()).into(),
        FieldValue::Memo(text) => text.into(),
        // A number without fraction is a name without fraction.
        FieldValue::Numeric(Some(x)) if x.fract() == 0.0 && x.abs() < 9e15 => (x as i64).into(),
        FieldValue::Numeric(x) => x.into(),
        FieldValue::Float(x) => x.into(),
        FieldValue::Integer(x) => x.into(),
        FieldValue::Double(x) | FieldValue::Currency(x) => x.into(),
        FieldValue::Logical(x) => x.into(),
        FieldValue::Date(_) | FieldValue::DateTime(_) => Value::Null,
    }
}
