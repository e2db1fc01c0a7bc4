//! Shapefiles: `.shp` with `.dbf`, and `.prj` (or `.qpj` of QGIS) and `.cpg` where there are any.

use super::{Feature, Rings, Shape, systems::Stated};
use encoding_rs::{Encoding, WINDOWS_1252};
use rowgram_optim::output::FileError;
use rowgram_raster::polygon::Polygon;
use serde_json::{Map, Value};
use shapefile::{
    Point, PolygonRing, ShapeReader,
    dbase::{
        self, FieldValue, ReaderBuilder, Record,
        encoding::{DynEncoding, EncodingRs, Unicode},
    },
};
use std::{
    fs::File,
    io::BufReader,
    path::{Path, PathBuf},
};

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
    let projection = ["qpj", "prj"].into_iter().find_map(|ending| beside(path, ending));
    if let Some(projection) = projection {
        let text = std::fs::read(&projection).map_err(|e| FileError::read(&projection, e))?;
        let text = String::from_utf8_lossy(&text);
        let stated = Stated::well_known_text(text.trim_start_matches('\u{feff}').trim());
        let stated = stated.map_err(|why| {
            let message = format!("{why}; save the file in the system of the map, or as GeoJSON");
            FileError::malformed(&projection, None, message)
        })?;
        return Ok((features, stated));
    }
    Ok((features, Stated::Nothing))
}

/// The file beside a shapefile with an ending, in small letters or capitals.
pub(super) fn beside(path: &Path, ending: &str) -> Option<PathBuf> {
    let capitals = ending.to_uppercase();
    let named = [ending, &capitals].map(|ending| path.with_extension(ending));
    named.into_iter().find(|path| path.is_file())
}

/// Shapes and rows of the table, without those that were deleted. Texts are in the encoding of the `.cpg` file; without one in UTF-8, else in
/// Windows-1252, which holds Latin-1.
fn records(path: &Path) -> Result<Vec<(shapefile::Shape, Record)>, FileError> {
    let Some(table) = beside(path, "dbf") else {
        let message = "there is no table beside it, expected a .dbf file of the same name";
        return Err(FileError::malformed(path, None, message));
    };
    let deleted = deleted_rows(&table)?;
    let shapes = shapes(path).map_err(|error| {
        let message = format!("it or its index (.shx) is cut off or damaged: {error}");
        FileError::malformed(path, None, message)
    })?;
    if shapes.len() != deleted.len() {
        let message = format!(
            "it has {} rows for the {} shapes of {}: save the file again",
            deleted.len(),
            shapes.len(),
            path.display()
        );
        return Err(FileError::malformed(&table, None, message));
    }
    let rows = |encoding: DynEncoding| -> Result<Vec<Record>, dbase::Error> {
        ReaderBuilder::new().with_encoding(encoding).open(&table)?.read()
    };
    let rows = match stated_encoding(path)? {
        Some(encoding) => rows(EncodingRs::from(encoding).into()),
        None => rows(Unicode.into()).or_else(|_| rows(EncodingRs::from(WINDOWS_1252).into())),
    };
    let rows = rows.map_err(|error| FileError::malformed(&table, None, error.to_string()))?;
    let shapes = shapes.into_iter().zip(deleted).filter(|(_, is_deleted)| !is_deleted);
    Ok(shapes.map(|(shape, _)| shape).zip(rows).collect())
}

/// The shapes, by the index where there is one: a shape that has grown may stand at the end of the file.
fn shapes(path: &Path) -> Result<Vec<shapefile::Shape>, shapefile::Error> {
    let open = |path: &Path| File::open(path).map(BufReader::new);
    let Some(index) = beside(path, "shx") else { return ShapeReader::new(open(path)?)?.read() };
    let mut reader = ShapeReader::with_shx(open(path)?, open(&index)?)?;
    (0..reader.shape_count()?).filter_map(|k| reader.read_nth_shape(k)).collect()
}

/// Which rows of a table are deleted: editors leave them in the file.
fn deleted_rows(table: &Path) -> Result<Vec<bool>, FileError> {
    let bytes = crate::memory::read_file(table)?;
    let number = |at: usize, size: usize| {
        let bytes = bytes.get(at..at + size)?;
        Some(bytes.iter().rev().fold(0, |sum, &byte| 256 * sum + usize::from(byte)))
    };
    let header = number(4, 4).zip(number(8, 2)).zip(number(10, 2));
    let deleted = header.and_then(|((count, first), length)| {
        (0..count).map(|row| Some(*bytes.get(first + row * length)? == b'*')).collect()
    });
    deleted.ok_or_else(|| FileError::malformed(table, None, "it is cut off"))
}

/// The encoding that a `.cpg` file names: `UTF-8`, `ISO-8859-1`, `1252`, `ANSI 1252`, `88591`.
fn stated_encoding(path: &Path) -> Result<Option<&'static Encoding>, FileError> {
    let Some(file) = beside(path, "cpg") else { return Ok(None) };
    let bytes = std::fs::read(&file).map_err(|error| FileError::read(&file, error))?;
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
        FieldValue::Date(date) => date.map(|date| date.to_string()).into(),
        FieldValue::DateTime(time) => time.date().to_string().into(),
    }
}
