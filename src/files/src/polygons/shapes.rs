//! Shapefiles: `.shp` with `.dbf`, and `.prj` where there is one.

use super::{Feature, Stated};
use rowgram_optim::output::FileError;
use serde_json::{Map, Value};
use shapefile::{Point, PolygonRing, Shape, dbase::FieldValue};
use std::path::Path;

/// The polygons of a file, and what its coordinates are.
pub(super) fn read(path: &Path) -> Result<(Vec<Feature>, Stated), FileError> {
    let malformed = |message: String| FileError::malformed(path, None, message);
    std::fs::metadata(path).map_err(|error| FileError::read(path, error))?;
    let shapes = shapefile::read(path).map_err(|error| {
        malformed(format!("{error}; expected a shapefile with its .shx and .dbf beside it"))
    })?;
    let mut features = Vec::with_capacity(shapes.len());
    for (index, (shape, record)) in shapes.into_iter().enumerate() {
        let rings = match shape {
            Shape::Polygon(polygon) => rings(polygon.rings(), |p: &Point| [p.x, p.y]),
            Shape::PolygonM(polygon) => rings(polygon.rings(), |p| [p.x, p.y]),
            Shape::PolygonZ(polygon) => rings(polygon.rings(), |p| [p.x, p.y]),
            Shape::NullShape => continue,
            other => {
                let kind = other.shapetype();
                return Err(malformed(format!(
                    "shape {} is a {kind}, expected polygons",
                    index + 1
                )));
            }
        };
        let properties = record.into_iter().map(|(name, field)| (name, value(field)));
        features.push(Feature { rings, properties: properties.collect::<Map<_, _>>(), id: None });
    }
    let projection = path.with_extension("prj");
    let stated = match std::fs::read_to_string(&projection) {
        Ok(text) => stated(&text).ok_or_else(|| {
            let name = text.split('"').nth(1).unwrap_or("nothing");
            let message = format!(
                "its system is {name}, expected one with an EPSG code, a UTM zone, or degrees; \
                 save the file in the system of the map, or as GeoJSON"
            );
            FileError::malformed(&projection, None, message)
        })?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Stated::Nothing,
        Err(error) => return Err(FileError::read(&projection, error)),
    };
    Ok((features, stated))
}

fn rings<P>(rings: &[PolygonRing<P>], position: impl Fn(&P) -> [f64; 2]) -> Vec<Vec<[f64; 2]>> {
    rings.iter().map(|ring| ring.points().iter().map(&position).collect()).collect()
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

/// The system that well-known text names: by its own code, or as a UTM zone in the words of ArcGIS.
fn stated(text: &str) -> Option<Stated> {
    let text = text.trim();
    // The code of the whole is the last one; those before it are of its parts.
    if let Some((_, code)) = text.rsplit_once("AUTHORITY[\"EPSG\",\"")
        && text.ends_with("]]")
        && let Some(code) = code.split('"').next()?.parse().ok()
        && code_of_whole(text)
    {
        return Some(Stated::code(code));
    }
    if text.starts_with("GEOGCS") {
        return Some(Stated::Degrees);
    }
    let name = text.strip_prefix("PROJCS[\"")?.split('"').next()?;
    let (datum, zone) = name.split_once("_UTM_Zone_")?;
    let (number, hemisphere) = zone.split_at_checked(zone.len().checked_sub(1)?)?;
    let number: u32 = number.parse().ok().filter(|n| (1..=60).contains(n))?;
    let base = match (datum, hemisphere) {
        ("WGS_1984", "N") => 32600,
        ("WGS_1984", "S") => 32700,
        ("NAD_1983", "N") => 26900,
        ("ETRS_1989", "N") => 25800,
        ("GDA_1994" | "GDA94", "S") => 28300,
        _ => return None,
    };
    Some(Stated::Epsg(base + number))
}

/// Whether the last code stands at the end of the text, not inside of one of its parts.
fn code_of_whole(text: &str) -> bool {
    let Some(at) = text.rfind("AUTHORITY[") else { return false };
    let depth = text[..at].chars().fold(0, |depth, c| match c {
        '[' => depth + 1,
        ']' => depth - 1,
        _ => depth,
    });
    depth == 1
}
