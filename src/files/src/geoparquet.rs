//! GeoParquet: a layer of geometries with attributes as columns, for pandas, R and data bases.
//!
//! A GeoParquet file is a Parquet file with one column of well-known binary and a word about it in its metadata. Coordinates are
//! WGS84, longitude before latitude, degrees: the system that every reader takes where none is named. A layer whose
//! coordinates cannot be brought there (pixels, a system without a known definition) keeps its own, and says that they are
//! undefined. Columns are written whole, without compression; the same layer gives the same bytes.
//!
//! Writing needs the Cargo feature `geoparquet` ([`IS_AVAILABLE`]).
//!
//! Reference: GeoParquet 1.1.0 (OGC); Apache Parquet format 2; OGC 06-103r4 for well-known binary.

#[cfg(feature = "geoparquet")]
use super::gpkg::{ColumnKind, Geometry, GeometryKind, Value};
use super::{FileError, gpkg::Layer};
#[cfg(feature = "geoparquet")]
use rowgram_raster::{
    crs::Crs,
    georeference::{self, CrsKind},
};
use std::path::Path;

/// Whether this build writes GeoParquet: the Cargo feature `geoparquet`.
pub const IS_AVAILABLE: bool = cfg!(feature = "geoparquet");

/// Writes a layer.
///
/// # Errors
/// As [`write`](super::output::write); in a build without the feature `geoparquet`.
#[cfg(not(feature = "geoparquet"))]
pub fn write(path: &Path, force: bool, _: &Layer) -> Result<(), FileError> {
    super::output::check(path, force)?;
    let message =
        "this build writes no GeoParquet; build with the Cargo feature geoparquet, or use GeoJSON";
    Err(FileError::Unusable { path: path.to_owned(), message })
}

/// Writes a layer.
///
/// # Errors
/// As [`write`](super::output::write).
#[cfg(feature = "geoparquet")]
pub fn write(path: &Path, force: bool, layer: &Layer) -> Result<(), FileError> {
    super::output::check(path, force)?;
    let bytes = encode(layer).map_err(|e| FileError::write(path, std::io::Error::other(e)))?;
    super::output::write(path, force, |out| out.write_all(&bytes))
}

#[cfg(feature = "geoparquet")]
fn encode(layer: &Layer) -> parquet::errors::Result<Vec<u8>> {
    use parquet::{
        data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type},
        file::{metadata::KeyValue, properties::WriterProperties, writer::SerializedFileWriter},
        schema::parser::parse_message_type,
    };
    use std::sync::Arc;
    let (geometries, is_wgs84) = on_ellipsoid(layer);
    let about = about(layer.kind, &geometries, is_wgs84);
    let about = KeyValue::new("geo".to_owned(), about.to_string());
    let properties = WriterProperties::builder()
        .set_created_by(concat!("rowgram ", env!("CARGO_PKG_VERSION")).to_owned())
        .set_key_value_metadata(Some(vec![about]));
    let schema = Arc::new(parse_message_type(&schema(layer))?);
    let mut writer = SerializedFileWriter::new(Vec::new(), schema, Arc::new(properties.build()))?;
    let mut group = writer.next_row_group()?;
    // A value is written where the definition level is 1, and is not known where it is 0.
    for number in 0..layer.columns.len() {
        let Some(mut column) = group.next_column()? else { break };
        let values = || layer.features.iter().map(|feature| &feature.values[number]);
        match layer.columns[number].kind {
            ColumnKind::Integer => {
                let known = |value: &Value| match value {
                    Value::Integer(value) => Some(*value),
                    _ => None,
                };
                let (values, levels) = with_levels(values().map(known));
                column.typed::<Int64Type>().write_batch(&values, Some(&levels), None)?;
            }
            ColumnKind::Real => {
                let known = |value: &Value| match value {
                    Value::Real(value) => Some(*value).filter(|value| value.is_finite()),
                    Value::Integer(value) => Some(*value as f64),
                    _ => None,
                };
                let (values, levels) = with_levels(values().map(known));
                column.typed::<DoubleType>().write_batch(&values, Some(&levels), None)?;
            }
            ColumnKind::Text => {
                let known = |value: &Value| match value {
                    Value::Text(value) => Some(ByteArray::from(value.as_str())),
                    _ => None,
                };
                let (values, levels) = with_levels(values().map(known));
                column.typed::<ByteArrayType>().write_batch(&values, Some(&levels), None)?;
            }
        }
        column.close()?;
    }
    if let Some(mut column) = group.next_column()? {
        let binary = |geometry: &Option<Geometry>| {
            geometry.as_ref().map(|geometry| ByteArray::from(geometry.well_known_binary()))
        };
        let (values, levels) = with_levels(geometries.iter().map(binary));
        column.typed::<ByteArrayType>().write_batch(&values, Some(&levels), None)?;
        column.close()?;
    }
    group.close()?;
    writer.into_inner()
}

#[cfg(feature = "geoparquet")]
fn with_levels<T>(values: impl Iterator<Item = Option<T>>) -> (Vec<T>, Vec<i16>) {
    let mut levels = Vec::new();
    let known = values.inspect(|value| levels.push(i16::from(value.is_some()))).flatten().collect();
    (known, levels)
}

/// The columns in the language of Parquet; a name there is one word.
#[cfg(feature = "geoparquet")]
fn schema(layer: &Layer) -> String {
    let word = |name: &str| -> String {
        name.chars().map(|c| if c.is_alphanumeric() || c == '_' { c } else { '_' }).collect()
    };
    let mut text = String::from("message layer {\n");
    for column in &layer.columns {
        let name = word(&column.name);
        text += &match column.kind {
            ColumnKind::Integer => format!("  optional int64 {name};\n"),
            ColumnKind::Real => format!("  optional double {name};\n"),
            ColumnKind::Text => format!("  optional binary {name} (UTF8);\n"),
        };
    }
    text + "  optional binary geometry;\n}"
}

/// What the standard asks to be said of the geometries.
#[cfg(feature = "geoparquet")]
fn about(kind: GeometryKind, geometries: &[Option<Geometry>], is_wgs84: bool) -> serde_json::Value {
    let name = match kind {
        GeometryKind::Point => "Point",
        GeometryKind::LineString => "LineString",
        GeometryKind::Polygon => "Polygon",
    };
    let mut names = vec![name];
    if geometries.iter().flatten().any(Geometry::is_multiple) {
        names.push("MultiPolygon");
    }
    let mut column = serde_json::json!({"encoding": "WKB", "geometry_types": names});
    let points = || geometries.iter().flatten().flat_map(|geometry| geometry.points());
    if points().next().is_some() {
        let least = |axis: usize| points().map(|at| at[axis]).fold(f64::INFINITY, f64::min);
        let most = |axis: usize| points().map(|at| at[axis]).fold(f64::NEG_INFINITY, f64::max);
        column["bbox"] = serde_json::json!([least(0), least(1), most(0), most(1)]);
    }
    if !is_wgs84 {
        // Without the key readers take WGS84.
        column["crs"] = serde_json::Value::Null;
    }
    serde_json::json!({
        "version": "1.1.0",
        "primary_column": "geometry",
        "columns": {"geometry": column},
    })
}

/// The geometries in WGS84, longitude first; as they are, and false, where that is not known.
#[cfg(feature = "geoparquet")]
fn on_ellipsoid(layer: &Layer) -> (Vec<Option<Geometry>>, bool) {
    let own = || layer.features.iter().map(|feature| feature.geometry.clone()).collect();
    let Some(georeference::Crs { kind, epsg: Some(code), .. }) = layer.crs else {
        return (own(), false);
    };
    if kind == CrsKind::Geographic {
        return (own(), code == 4326);
    }
    let Ok(crs) = Crs::from_epsg(code) else { return (own(), false) };
    let moved = |[x, y]: [f64; 2]| -> Option<[f64; 2]> {
        let [latitude, longitude] = crs.to_wgs84(x, y).ok()?;
        // A hundredth of a millimetre.
        Some([longitude, latitude].map(|degrees| (degrees * 1e10).round() / 1e10))
    };
    let all = |points: &[[f64; 2]]| points.iter().map(|&at| moved(at)).collect::<Option<Vec<_>>>();
    let geometry = |geometry: &Geometry| -> Option<Geometry> {
        Some(match geometry {
            Geometry::Point(at) => Geometry::Point(moved(*at)?),
            Geometry::LineString(points) => Geometry::LineString(all(points)?),
            Geometry::Polygon(rings) => {
                Geometry::Polygon(rings.iter().map(|ring| all(ring)).collect::<Option<Vec<_>>>()?)
            }
        })
    };
    let found: Option<Vec<Option<Geometry>>> = layer
        .features
        .iter()
        .map(|feature| feature.geometry.as_ref().map_or(Some(None), |of| geometry(of).map(Some)))
        .collect();
    found.map_or_else(|| (own(), false), |found| (found, true))
}

#[cfg(feature = "geoparquet")]
#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpkg::{Column, Feature};
    use parquet::{
        file::reader::{FileReader, SerializedFileReader},
        record::RowAccessor,
    };

    fn layer(crs: Option<georeference::Crs>) -> Layer {
        let ring =
            vec![[500_000.0, 4_480_000.0], [500_010.0, 4_480_000.0], [500_010.0, 4_480_005.0]];
        let feature = |name: Value, plants: Value, cover: f64, geometry| Feature {
            geometry,
            values: vec![name, plants, Value::Real(cover)],
        };
        Layer {
            name: "plots".into(),
            description: String::new(),
            kind: GeometryKind::Polygon,
            crs,
            columns: vec![
                Column::new("plot", ColumnKind::Text),
                Column::new("plants", ColumnKind::Integer),
                Column::new("canopy cover", ColumnKind::Real),
            ],
            features: vec![
                feature(
                    Value::Text("Süd 1".into()),
                    Value::Integer(7),
                    0.25,
                    Some(Geometry::Polygon(vec![ring])),
                ),
                feature(Value::Null, Value::Null, f64::NAN, None),
            ],
        }
    }

    fn read(path: &Path) -> (SerializedFileReader<std::fs::File>, serde_json::Value) {
        let reader = SerializedFileReader::new(std::fs::File::open(path).unwrap()).unwrap();
        let metadata = reader.metadata().file_metadata().key_value_metadata().unwrap().clone();
        let geo = metadata.iter().find(|pair| pair.key == "geo").unwrap().value.clone().unwrap();
        (reader, serde_json::from_str(&geo).unwrap())
    }

    #[test]
    fn a_layer_is_read_back_in_degrees() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.parquet");
        write(&path, false, &layer(Some(georeference::Crs::projected(32616)))).unwrap();
        let (reader, geo) = read(&path);
        assert_eq!(geo["columns"]["geometry"]["geometry_types"][0], "Polygon");
        assert!(geo["columns"]["geometry"].get("crs").is_none(), "{geo}");
        let bounds = geo["columns"]["geometry"]["bbox"].as_array().unwrap();
        // Zone 16 has its meridian at 87 degrees west.
        assert!((bounds[0].as_f64().unwrap() + 87.0).abs() < 1e-9, "{geo}");
        assert!((bounds[1].as_f64().unwrap() - 40.47).abs() < 0.01, "{geo}");
        let rows: Vec<_> = reader.get_row_iter(None).unwrap().map(Result::unwrap).collect();
        assert_eq!(rows.len(), 2);
        assert_eq!(
            (rows[0].get_string(0).unwrap().as_str(), rows[0].get_long(1).unwrap()),
            ("Süd 1", 7)
        );
        assert_eq!(rows[0].get_double(2).unwrap(), 0.25);
        // Header, one ring of four points.
        assert_eq!(rows[0].get_bytes(3).unwrap().len(), 1 + 4 + 4 + 4 + 4 * 16);
        assert!((0..4).all(|k| rows[1].get_string(k).is_err() && rows[1].get_long(k).is_err()));
        let again = folder.path().join("again.parquet");
        write(&again, false, &layer(Some(georeference::Crs::projected(32616)))).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
        assert!(write(&again, false, &layer(None)).is_err(), "what is there is not replaced");
    }

    #[test]
    fn pixels_are_no_degrees() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.parquet");
        write(&path, false, &layer(None)).unwrap();
        let (_, geo) = read(&path);
        assert!(geo["columns"]["geometry"]["crs"].is_null());
        assert!(geo["columns"]["geometry"].get("crs").is_some(), "unknown has to be said");
        assert_eq!(geo["columns"]["geometry"]["bbox"][0], 500_000.0);
    }
}
