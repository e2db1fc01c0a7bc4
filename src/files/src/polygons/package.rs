//! Polygons of a GeoPackage: its tables by SQL, geometries as the standard's header and well-known binary.
//!
//! Reference: OGC GeoPackage Encoding Standard 12-128r18; OGC 06-103r4 for well-known binary.

use super::{Feature, Rings, Shape, systems::Stated};
use rowgram_optim::output::FileError;
use rusqlite::{Connection, OpenFlags, types::ValueRef};
use serde_json::{Map, Value};
use std::path::Path;

/// The polygons of a file, and what its coordinates are.
pub(super) fn read(path: &Path) -> Result<(Vec<Feature>, Stated), FileError> {
    std::fs::metadata(path).map_err(|error| FileError::read(path, error))?;
    let malformed = |message: String| FileError::malformed(path, None, message);
    let sql = |error: rusqlite::Error| malformed(format!("{error}; expected a GeoPackage"));
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let file = Connection::open_with_flags(path, flags).map_err(sql)?;
    // Functions that a file of somebody else calls from its definitions are not run.
    file.execute_batch("PRAGMA trusted_schema = OFF").map_err(sql)?;
    for table in ["gpkg_geometry_columns", "gpkg_spatial_ref_sys"] {
        expect_table(&file, table).map_err(sql)?.map_err(malformed)?;
    }
    let layer = layer(&file, path).map_err(sql)?.map_err(malformed)?;
    expect_table(&file, &layer.table).map_err(sql)?.map_err(malformed)?;
    let stated = stated(&file, layer.system).map_err(sql)?.map_err(malformed)?;
    let columns = columns(&file, &layer.table).map_err(sql)?.map_err(malformed)?;
    let quoted = |name: &str| format!("\"{}\"", name.replace('"', "\"\""));
    let listed: Vec<String> = columns.iter().map(|name| quoted(name)).collect();
    let query = format!("SELECT {} FROM {}", listed.join(", "), quoted(&layer.table));
    let mut select = file.prepare(&query).map_err(sql)?;
    let mut rows = select.query([]).map_err(sql)?;
    let mut features = Vec::new();
    while let Some(row) = rows.next().map_err(sql)? {
        let shape = Shape::NoArea("has no geometry".to_owned());
        let mut feature = Feature { shape, properties: Map::new(), id: None };
        for (k, column) in columns.iter().enumerate() {
            let value = row.get_ref(k).map_err(sql)?;
            if *column == layer.geometry {
                let ValueRef::Blob(bytes) = value else { continue };
                feature.shape = geometry(bytes)
                    .map_err(|what| malformed(format!("feature {}: {what}", features.len() + 1)))?;
            } else {
                feature.properties.insert(column.clone(), plain(value));
            }
        }
        features.push(feature);
    }
    Ok((features, stated))
}

/// Refuses what is computed when it is read: a view may have no end.
fn expect_table(file: &Connection, name: &str) -> rusqlite::Result<Result<(), String>> {
    let mut select = file.prepare(
        "SELECT type FROM pragma_table_list WHERE schema = 'main' AND name = ?1 COLLATE NOCASE",
    )?;
    let kind = select.query_map([name], |row| row.get::<_, String>(0))?.next().transpose()?;
    Ok(match kind.as_deref() {
        Some("table") => Ok(()),
        Some(kind) => {
            let message = format!(
                "{name:?} is a {kind}, expected a table: export the layer to a new GeoPackage"
            );
            Err(message)
        }
        None => Err(format!("it has no table {name:?}; expected a GeoPackage")),
    })
}

/// The names of the columns of a table.
fn columns(file: &Connection, table: &str) -> rusqlite::Result<Result<Vec<String>, String>> {
    let mut select = file.prepare("SELECT name FROM pragma_table_xinfo(?1) WHERE hidden <> 1")?;
    let mut rows = select.query([table])?;
    let mut names = Vec::new();
    while let Some(row) = rows.next()? {
        let bytes = row.get_ref(0)?.as_bytes().unwrap_or_default();
        let Ok(name) = std::str::from_utf8(bytes) else {
            let name = String::from_utf8_lossy(bytes);
            return Ok(Err(format!("the name of column {name:?} of {table:?} is not UTF-8")));
        };
        names.push(name.to_owned());
    }
    Ok(Ok(names))
}

struct LayerOfPolygons {
    table: String,
    geometry: String,
    system: i64,
}

/// The only layer of polygons, or the one with the name of the file.
fn layer(file: &Connection, path: &Path) -> rusqlite::Result<Result<LayerOfPolygons, String>> {
    let mut select = file.prepare(
        "SELECT table_name, column_name, srs_id FROM gpkg_geometry_columns \
         WHERE upper(geometry_type_name) IN ('POLYGON', 'MULTIPOLYGON', 'GEOMETRY', 'SURFACE', \
         'CURVEPOLYGON', 'MULTISURFACE') ORDER BY table_name",
    )?;
    let layers = select.query_map([], |row| {
        Ok(LayerOfPolygons { table: row.get(0)?, geometry: row.get(1)?, system: row.get(2)? })
    })?;
    let mut layers = layers.collect::<rusqlite::Result<Vec<_>>>()?;
    if layers.is_empty() {
        return Ok(Err("it has no layer of polygons".to_owned()));
    }
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().to_lowercase());
    let named = layers.iter().position(|layer| Some(layer.table.to_lowercase()) == stem);
    Ok(match (named, layers.len()) {
        (Some(k), _) => Ok(layers.swap_remove(k)),
        (None, 1) => Ok(layers.swap_remove(0)),
        _ => {
            let names: Vec<&str> = layers.iter().map(|layer| layer.table.as_str()).collect();
            Err(format!(
                "it has several layers of polygons ({}), expected one, or one with the name of the file",
                names.join(", ")
            ))
        }
    })
}

fn stated(file: &Connection, system: i64) -> rusqlite::Result<Result<Stated, String>> {
    if system <= 0 {
        // Undefined Cartesian coordinates, or undefined degrees.
        return Ok(Ok(if system == 0 { Stated::Degrees } else { Stated::Nothing }));
    }
    let mut select = file.prepare(
        "SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?1",
    )?;
    let row = |row: &rusqlite::Row<'_>| {
        Ok((row.get::<_, String>(0)?, row.get::<_, i64>(1)?, row.get::<_, String>(2)?))
    };
    let found = select.query_map([system], row)?.next().transpose()?;
    Ok(match found {
        Some((who, code, _)) if who.eq_ignore_ascii_case("EPSG") => {
            Ok(u32::try_from(code).map_or(Stated::Nothing, Stated::code))
        }
        Some((_, _, text)) if text.contains('[') => Stated::well_known_text(&text),
        _ => Ok(Stated::Nothing),
    })
}

fn plain(value: ValueRef<'_>) -> Value {
    match value {
        ValueRef::Integer(x) => x.into(),
        ValueRef::Real(x) => x.into(),
        ValueRef::Text(text) => String::from_utf8_lossy(text).into_owned().into(),
        ValueRef::Null | ValueRef::Blob(_) => Value::Null,
    }
}

/// A geometry with its header.
fn geometry(bytes: &[u8]) -> Result<Shape, String> {
    let header = bytes.get(..8).filter(|header| header.starts_with(b"GP"));
    let flags = header.ok_or("its geometry does not begin as one of a GeoPackage")?[3];
    let bounds = match flags >> 1 & 7 {
        0 => 0,
        1 => 32,
        2 | 3 => 48,
        4 => 64,
        other => return Err(format!("its geometry has bounds of kind {other}, which is none")),
    };
    let rest = bytes.get(8 + bounds..).ok_or("its geometry ends early")?;
    let mut polygons = Vec::new();
    // Empty ones have no rings to read.
    if flags & 16 == 0
        && let Some(other) = (Reader { bytes: rest, little: true }).shape(&mut polygons, 0)?
    {
        return Ok(Shape::NoArea(format!("is a {other}")));
    }
    polygons.retain(|rings: &Rings| !rings.is_empty());
    Ok(match polygons.is_empty() {
        true => Shape::NoArea("has an empty geometry".to_owned()),
        false => Shape::Polygons(polygons),
    })
}

/// Well-known binary.
struct Reader<'a> {
    bytes: &'a [u8],
    little: bool,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (first, rest) = self.bytes.split_first_chunk::<N>().ok_or("its geometry ends early")?;
        self.bytes = rest;
        let mut first = *first;
        if !self.little {
            first.reverse();
        }
        Ok(first)
    }

    fn count(&mut self, least_bytes: usize) -> Result<usize, String> {
        let count = u32::from_le_bytes(self.take()?) as usize;
        match count.checked_mul(least_bytes) {
            Some(needed) if needed <= self.bytes.len() => Ok(count),
            _ => Err(format!("its geometry has {count} parts and ends before them")),
        }
    }

    /// Adds its polygons; gives the name of what is none.
    fn shape(
        &mut self,
        polygons: &mut Vec<Rings>,
        depth: usize,
    ) -> Result<Option<&'static str>, String> {
        self.little = self.take::<1>()?[0] != 0;
        let code = u32::from_le_bytes(self.take()?);
        // Thousands say which of Z and M follow x and y.
        let extra = match code / 1000 {
            0 => 0,
            1 | 2 => 1,
            3 => 2,
            _ => return Err(format!("its geometry is of kind {code}, expected polygons")),
        };
        match code % 1000 {
            1 | 4 => Ok(Some("point")),
            2 | 5 => Ok(Some("line")),
            3 => {
                let mut rings = Vec::new();
                for _ in 0..self.count(4)? {
                    let mut ring = Vec::new();
                    for _ in 0..self.count(8 * (2 + extra))? {
                        let mut number = || Ok::<_, String>(f64::from_le_bytes(self.take()?));
                        ring.push([number()?, number()?]);
                        (0..extra).try_for_each(|_| number().map(drop))?;
                    }
                    rings.push(ring);
                }
                polygons.push(rings);
                Ok(None)
            }
            6 if depth == 0 => {
                for _ in 0..self.count(5)? {
                    self.shape(polygons, 1)?;
                }
                Ok(None)
            }
            _ => Err(format!("its geometry is of kind {code}, expected polygons")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpkg::{self, Column, ColumnKind, Geometry, GeometryKind, Layer};
    use rowgram_raster::georeference::Crs;

    fn layer_of(name: &str, rings: Vec<Vec<[f64; 2]>>) -> Layer {
        let values = vec![gpkg::Value::Text("A 1".into()), gpkg::Value::Real(12.0)];
        Layer {
            name: name.into(),
            description: String::new(),
            kind: GeometryKind::Polygon,
            crs: Some(Crs::projected(32616)),
            columns: vec![
                Column::new("plot", ColumnKind::Text),
                Column::new("leaves", ColumnKind::Real),
            ],
            features: vec![
                gpkg::Feature { geometry: Some(Geometry::Polygon(rings)), values: values.clone() },
                gpkg::Feature { geometry: None, values },
            ],
        }
    }

    #[test]
    fn what_was_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.gpkg");
        let ring = vec![[1.0, 2.0], [5.0, 2.0], [5.0, 9.5], [1.0, 2.0]];
        let hole = vec![[2.0, 3.0], [3.0, 3.0], [3.0, 4.0], [2.0, 3.0]];
        gpkg::write(&path, false, &[layer_of("any", vec![ring.clone(), hole.clone()])]).unwrap();
        let (features, stated) = read(&path).unwrap();
        assert_eq!(stated, Stated::Epsg(32616));
        assert_eq!(features[0].shape, Shape::Polygons(vec![vec![ring.clone(), hole]]));
        assert_eq!(features[1].shape, Shape::NoArea("has no geometry".to_owned()));
        assert_eq!(features[0].properties["plot"], "A 1");
        // Of several layers the one with the file's name.
        let two = [layer_of("other", vec![ring.clone()]), layer_of("Plots", vec![ring])];
        gpkg::write(&path, true, &two).unwrap();
        assert_eq!(read(&path).unwrap().0.len(), 2);
        let elsewhere = folder.path().join("both.gpkg");
        std::fs::rename(&path, &elsewhere).unwrap();
        let error = read(&elsewhere).err().unwrap().to_string();
        assert!(error.contains("both.gpkg") && error.contains("Plots, other"), "{error}");
        std::fs::write(&path, "no database, but long enough to be looked at").unwrap();
        assert!(read(&path).err().unwrap().to_string().contains("expected a GeoPackage"));
    }

    #[test]
    fn a_layer_without_end_and_a_column_without_a_readable_name_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.gpkg");
        let ring = vec![[1.0, 2.0], [5.0, 2.0], [5.0, 9.5], [1.0, 2.0]];
        gpkg::write(&path, false, &[layer_of("plots", vec![ring])]).unwrap();
        let whole = std::fs::read(&path).unwrap();

        let endless = "ALTER TABLE plots RENAME TO other;
            CREATE VIEW plots AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n)
            SELECT k AS fid, other.geom AS geom, 'x' AS plot FROM n, other";
        Connection::open(&path).unwrap().execute_batch(endless).unwrap();
        let error = read(&path).err().unwrap().to_string();
        assert!(error.contains("\"plots\" is a view"), "{error}");

        let mut bytes = whole;
        while let Some(at) = bytes.windows(6).position(|word| word == b"leaves") {
            bytes[at..at + 6].copy_from_slice(b"\xFF\xFEaves");
        }
        std::fs::write(&path, bytes).unwrap();
        let error = read(&path).err().unwrap().to_string();
        assert!(error.contains("is not UTF-8") && error.contains("plots.gpkg"), "{error}");
    }

    /// Both byte orders, Z and M, several polygons; and none of their beginnings.
    #[test]
    fn well_known_binary_of_others() {
        for little in [true, false] {
            for (kind, extra) in [(0u32, 0), (1000, 1), (2000, 1), (3000, 2)] {
                let mut bytes = b"GP\0\0\0\0\0\0".to_vec();
                let whole = |n: u32| if little { n.to_le_bytes() } else { n.to_be_bytes() };
                let real = |x: f64| if little { x.to_le_bytes() } else { x.to_be_bytes() };
                let polygon = |bytes: &mut Vec<u8>| {
                    bytes.push(u8::from(little));
                    bytes.extend(whole(kind + 3));
                    bytes.extend(whole(1));
                    bytes.extend(whole(3));
                    for [x, y] in [[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]] {
                        bytes.extend(real(x));
                        bytes.extend(real(y));
                        (0..extra).for_each(|_| bytes.extend(real(-1.0)));
                    }
                };
                bytes.push(u8::from(little));
                bytes.extend(whole(kind + 6));
                bytes.extend(whole(2));
                polygon(&mut bytes);
                polygon(&mut bytes);
                let ring = vec![[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]];
                let expected = Shape::Polygons(vec![vec![ring.clone()], vec![ring]]);
                assert_eq!(geometry(&bytes).unwrap(), expected);
                for end in 0..bytes.len() {
                    assert!(geometry(&bytes[..end]).is_err(), "{end}");
                }
            }
        }
    }
}
