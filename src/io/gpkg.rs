//! GeoPackage: layers of geometries with attributes, in any coordinate reference system.
//!
//! A GeoPackage is an SQLite file with agreed tables; QGIS and GDAL open it as it is. [`write()`] makes one from
//! whole [`Layer`]s, atomically. The same layers give the same bytes: `last_change`, which the standard
//! asks for, is a fixed date.
//!
//! Coordinates are those of the layer's [`Crs`], x (east) before y (north). One with a code of the EPSG registry is named
//! by it; without a code the layer is in "undefined Cartesian" coordinates, which may be pixels.
//!
//! Reference: OGC GeoPackage Encoding Standard 12-128r18 (version 1.3); OGC 06-103r4 for well-known binary.

use super::{FileError, output};
use crate::raster::georeference::{Crs, CrsKind};
use rusqlite::{Connection, Statement, params, types::ToSql};
use std::{collections::BTreeSet, path::Path};

/// `GPKG` as the standard has it in the header of the file.
const APPLICATION_ID: i64 = 0x4750_4B47;
/// Version 1.3.0.
const USER_VERSION: i64 = 10_300;
/// Undefined Cartesian and undefined geographic coordinates.
const CARTESIAN: i64 = -1;
const GEOGRAPHIC: i64 = 0;
const LAST_CHANGE: &str = "1970-01-01T00:00:00.000Z";
/// Names of columns that every layer has.
const OWN: [&str; 2] = ["fid", "geom"];
const WGS84: &str = "GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563,\
    AUTHORITY[\"EPSG\",\"7030\"]],AUTHORITY[\"EPSG\",\"6326\"]],PRIMEM[\"Greenwich\",0,\
    AUTHORITY[\"EPSG\",\"8901\"]],UNIT[\"degree\",0.0174532925199433,AUTHORITY[\"EPSG\",\"9122\"]],\
    AUTHORITY[\"EPSG\",\"4326\"]]";

/// What a layer's geometries are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GeometryKind {
    /// Places.
    Point,
    /// Lines of two points or more.
    LineString,
    /// Areas: an outer ring and holes, each ring closed or not.
    Polygon,
    /// No geometry: a table of attributes.
    None,
}

/// A geometry, `[x, y]` in the layer's coordinates.
#[derive(Debug, Clone, PartialEq)]
pub enum Geometry {
    /// A place.
    Point([f64; 2]),
    /// A line.
    LineString(Vec<[f64; 2]>),
    /// The outer ring, then holes.
    Polygon(Vec<Vec<[f64; 2]>>),
}

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColumnKind {
    /// Whole numbers.
    Integer,
    /// Numbers.
    Real,
    /// Text.
    Text,
}

/// A column; units belong into its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Column {
    /// Its name.
    pub name: String,
    /// What it holds.
    pub kind: ColumnKind,
}

impl Column {
    /// A column.
    pub fn new(name: &str, kind: ColumnKind) -> Column {
        Column { name: name.to_owned(), kind }
    }
}

/// A value of an attribute.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Not known.
    Null,
    /// A whole number.
    Integer(i64),
    /// A number; one that is not finite is written as not known.
    Real(f64),
    /// Text.
    Text(String),
}

/// A geometry, or none, with its attributes.
#[derive(Debug, Clone, PartialEq)]
pub struct Feature {
    /// Where it is.
    pub geometry: Option<Geometry>,
    /// One value for each column.
    pub values: Vec<Value>,
}

/// A table of features.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// Name of the table and of the layer.
    pub name: String,
    /// What it shows, for a person.
    pub description: String,
    /// What its geometries are.
    pub kind: GeometryKind,
    /// Their coordinates; `None`: undefined Cartesian ones, such as pixels.
    pub crs: Option<Crs>,
    /// Attributes, in order.
    pub columns: Vec<Column>,
    /// The features, in order; the first one gets the number (`fid`) 1.
    pub features: Vec<Feature>,
}

/// Writes layers into a new GeoPackage.
///
/// # Errors
/// As [`output::write`]; where two layers or columns have one name, a feature has another number of values or another
/// kind of geometry than its layer, or a coordinate is not finite.
pub fn write(path: &Path, force: bool, layers: &[Layer]) -> Result<(), FileError> {
    check(path, layers)?;
    output::write_by_path(path, force, |temporary| {
        fill(temporary, layers)
            .map_err(|error| FileError::write(path, std::io::Error::other(error)))
    })
}

fn check(path: &Path, layers: &[Layer]) -> Result<(), FileError> {
    let fault = |message: String| {
        Err(FileError::write(path, std::io::Error::new(std::io::ErrorKind::InvalidInput, message)))
    };
    let mut names = BTreeSet::new();
    for layer in layers {
        let name = &layer.name;
        let lower = name.to_lowercase();
        if name.is_empty() || ["gpkg_", "sqlite_"].iter().any(|own| lower.starts_with(own)) {
            return fault(format!("a layer cannot have the name {name:?}"));
        }
        if !names.insert(lower) {
            return fault(format!("two layers have the name {name:?}"));
        }
        let mut columns: BTreeSet<String> = OWN.map(str::to_owned).into();
        if let Some(double) = layer.columns.iter().find(|c| !columns.insert(c.name.to_lowercase()))
        {
            return fault(format!("layer {name:?} has two columns {:?}", double.name));
        }
        for (number, feature) in layer.features.iter().enumerate() {
            if feature.values.len() != layer.columns.len() {
                return fault(format!(
                    "feature {number} of layer {name:?} has {} values for {} columns",
                    feature.values.len(),
                    layer.columns.len()
                ));
            }
            if let Some(geometry) = &feature.geometry {
                if geometry.kind() != layer.kind {
                    return fault(format!(
                        "feature {number} of layer {name:?} is a {:?}, its layer holds {:?}",
                        geometry.kind(),
                        layer.kind
                    ));
                }
                if geometry.points().any(|[x, y]| !(x.is_finite() && y.is_finite())) {
                    return fault(format!(
                        "feature {number} of layer {name:?} has a coordinate that is no finite number"
                    ));
                }
            }
        }
    }
    Ok(())
}

fn fill(path: &Path, layers: &[Layer]) -> rusqlite::Result<()> {
    let mut connection = Connection::open(path)?;
    // A file that fails half-way never gets its name, so it needs no journal.
    connection.execute_batch(&format!(
        "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF;
         PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {USER_VERSION};"
    ))?;
    let transaction = connection.transaction()?;
    transaction.execute_batch(TABLES)?;
    let mut systems = BTreeSet::new();
    put_system(&transaction, "Undefined Cartesian", CARTESIAN, "NONE", CARTESIAN, "undefined")?;
    put_system(&transaction, "Undefined geographic", GEOGRAPHIC, "NONE", GEOGRAPHIC, "undefined")?;
    put_system(&transaction, "WGS 84", 4326, "EPSG", 4326, WGS84)?;
    systems.extend([CARTESIAN, GEOGRAPHIC, 4326]);
    for layer in layers {
        let system = system(layer.crs);
        if systems.insert(system) {
            let (name, definition) = named(system);
            put_system(&transaction, &name, system, "EPSG", system, &definition)?;
        }
        put_layer(&transaction, layer, system)?;
    }
    transaction.commit()?;
    connection.close().map_err(|(_, error)| error)
}

/// The tables of the standard.
const TABLES: &str = "
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
";

fn put_system(
    connection: &Connection,
    name: &str,
    id: i64,
    organization: &str,
    code: i64,
    definition: &str,
) -> rusqlite::Result<()> {
    connection
        .execute(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?1, ?2, ?3, ?4, ?5, NULL)",
            params![name, id, organization, code, definition],
        )
        .map(drop)
}

/// The number of a coordinate reference system within the file.
fn system(crs: Option<Crs>) -> i64 {
    match crs {
        Some(Crs { epsg: Some(code), .. }) => i64::from(code),
        Some(Crs { kind: CrsKind::Geographic, .. }) => GEOGRAPHIC,
        _ => CARTESIAN,
    }
}

/// Name and definition of a code. Programs look codes of the registry up; the text is for those that cannot.
fn named(code: i64) -> (String, String) {
    let (zone, south) = (code % 100, code / 100 == 327);
    if !(code / 100 == 326 || south) || !(1..=60).contains(&zone) {
        return (format!("EPSG:{code}"), "undefined".to_owned());
    }
    let (letter, northing) = if south { ("S", 10_000_000) } else { ("N", 0) };
    let name = format!("WGS 84 / UTM zone {zone}{letter}");
    let definition = format!(
        "PROJCS[\"{name}\",{WGS84},PROJECTION[\"Transverse_Mercator\"],PARAMETER[\"latitude_of_origin\",0],\
         PARAMETER[\"central_meridian\",{}],PARAMETER[\"scale_factor\",0.9996],PARAMETER[\"false_easting\",500000],\
         PARAMETER[\"false_northing\",{northing}],UNIT[\"metre\",1,AUTHORITY[\"EPSG\",\"9001\"]],\
         AXIS[\"Easting\",EAST],AXIS[\"Northing\",NORTH],AUTHORITY[\"EPSG\",\"{code}\"]]",
        6 * zone - 183
    );
    (name, definition)
}

/// A name as SQL has it.
fn quoted(name: &str) -> String {
    format!("\"{}\"", name.replace('"', "\"\""))
}

fn put_layer(connection: &Connection, layer: &Layer, system: i64) -> rusqlite::Result<()> {
    let table = quoted(&layer.name);
    let placed = layer.kind != GeometryKind::None;
    let mut columns = vec!["fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL".to_owned()];
    if placed {
        columns.push(format!("geom {}", layer.kind.name()));
    }
    columns.extend(layer.columns.iter().map(|column| {
        let kind = match column.kind {
            ColumnKind::Integer => "INTEGER",
            ColumnKind::Real => "DOUBLE",
            ColumnKind::Text => "TEXT",
        };
        format!("{} {kind}", quoted(&column.name))
    }));
    connection.execute_batch(&format!("CREATE TABLE {table} ({});", columns.join(", ")))?;
    let mut bounds = Bounds::EMPTY;
    for point in
        layer.features.iter().filter_map(|f| f.geometry.as_ref()).flat_map(Geometry::points)
    {
        bounds.add(point);
    }
    let [x, y] = bounds.0;
    let known = |value: f64| value.is_finite().then_some(value);
    connection.execute(
        "INSERT INTO gpkg_contents VALUES (?1, ?2, ?1, ?3, ?4, ?5, ?6, ?7, ?8, ?9)",
        params![
            layer.name,
            if placed { "features" } else { "attributes" },
            layer.description,
            LAST_CHANGE,
            known(x[0]),
            known(y[0]),
            known(x[1]),
            known(y[1]),
            placed.then_some(system)
        ],
    )?;
    if placed {
        connection.execute(
            "INSERT INTO gpkg_geometry_columns VALUES (?1, 'geom', ?2, ?3, 0, 0)",
            params![layer.name, layer.kind.name(), system],
        )?;
    }
    let count = layer.columns.len() + usize::from(placed);
    let places: Vec<String> = (0..count).map(|k| format!("?{}", k + 2)).collect();
    let insert = match places.is_empty() {
        true => format!("INSERT INTO {table} VALUES (?1)"),
        false => format!("INSERT INTO {table} VALUES (?1, {})", places.join(", ")),
    };
    let mut insert = connection.prepare(&insert)?;
    for (number, feature) in (1i64..).zip(&layer.features) {
        put_feature(&mut insert, number, feature, placed, system)?;
    }
    Ok(())
}

fn put_feature(
    insert: &mut Statement<'_>,
    number: i64,
    feature: &Feature,
    placed: bool,
    system: i64,
) -> rusqlite::Result<()> {
    let geometry = feature.geometry.as_ref().map(|geometry| geometry.blob(system as i32));
    let mut values: Vec<&dyn ToSql> = vec![&number];
    if placed {
        values.push(&geometry);
    }
    values.extend(feature.values.iter().map(|value| -> &dyn ToSql {
        match value {
            Value::Integer(value) => value,
            Value::Real(value) if value.is_finite() => value,
            Value::Text(value) => value,
            Value::Null | Value::Real(_) => &rusqlite::types::Null,
        }
    }));
    insert.execute(&values[..]).map(drop)
}

impl GeometryKind {
    fn name(self) -> &'static str {
        match self {
            GeometryKind::Point => "POINT",
            GeometryKind::LineString => "LINESTRING",
            GeometryKind::Polygon => "POLYGON",
            GeometryKind::None => "",
        }
    }
}

/// Least and greatest x, least and greatest y.
struct Bounds([[f64; 2]; 2]);

impl Bounds {
    const EMPTY: Bounds = Bounds([[f64::INFINITY, f64::NEG_INFINITY]; 2]);

    fn add(&mut self, point: [f64; 2]) {
        for ([low, high], value) in self.0.iter_mut().zip(point) {
            (*low, *high) = (low.min(value), high.max(value));
        }
    }
}

impl Geometry {
    /// What it is.
    pub fn kind(&self) -> GeometryKind {
        match self {
            Geometry::Point(_) => GeometryKind::Point,
            Geometry::LineString(_) => GeometryKind::LineString,
            Geometry::Polygon(_) => GeometryKind::Polygon,
        }
    }

    fn points(&self) -> Box<dyn Iterator<Item = [f64; 2]> + '_> {
        match self {
            Geometry::Point(point) => Box::new(std::iter::once(*point)),
            Geometry::LineString(points) => Box::new(points.iter().copied()),
            Geometry::Polygon(rings) => Box::new(rings.iter().flatten().copied()),
        }
    }

    /// The standard's header and well-known binary, little-endian.
    fn blob(&self, system: i32) -> Vec<u8> {
        let mut out = b"GP\0".to_vec();
        // Little-endian; bounds but for a point, which is its own; bit 4 says that it is empty.
        let empty = self.points().next().is_none();
        let bounded = !empty && self.kind() != GeometryKind::Point;
        out.push(1 | if bounded { 2 } else { 0 } | if empty { 16 } else { 0 });
        out.extend(system.to_le_bytes());
        if bounded {
            let mut bounds = Bounds::EMPTY;
            self.points().for_each(|point| bounds.add(point));
            out.extend(bounds.0.as_flattened().iter().flat_map(|value| value.to_le_bytes()));
        }
        out.push(1);
        let count = |n: usize| (n as u32).to_le_bytes();
        let put = |out: &mut Vec<u8>, points: &[[f64; 2]]| {
            out.extend(points.as_flattened().iter().flat_map(|value| value.to_le_bytes()));
        };
        match self {
            Geometry::Point(point) => {
                out.extend(1u32.to_le_bytes());
                put(&mut out, &[*point]);
            }
            Geometry::LineString(points) => {
                out.extend(2u32.to_le_bytes());
                out.extend(count(points.len()));
                put(&mut out, points);
            }
            Geometry::Polygon(rings) => {
                out.extend(3u32.to_le_bytes());
                out.extend(count(rings.len()));
                for ring in rings {
                    let open = ring.first() != ring.last();
                    out.extend(count(ring.len() + usize::from(open)));
                    put(&mut out, ring);
                    if open {
                        put(&mut out, &ring[..1]);
                    }
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layers() -> Vec<Layer> {
        let columns = vec![
            Column::new("count", ColumnKind::Integer),
            Column::new("length_m", ColumnKind::Real),
            Column::new("na\"me", ColumnKind::Text),
        ];
        let values = |n: i64, x: f64, text: &str| {
            vec![Value::Integer(n), Value::Real(x), Value::Text(text.to_owned())]
        };
        let lines = Layer {
            name: "leaves".into(),
            description: "axes".into(),
            kind: GeometryKind::LineString,
            crs: Some(Crs::projected(32616)),
            columns: columns.clone(),
            features: vec![
                Feature {
                    geometry: Some(Geometry::LineString(vec![[1.0, 2.0], [4.0, -3.0]])),
                    values: values(7, 0.25, "a'b"),
                },
                Feature { geometry: None, values: values(8, f64::NAN, "") },
            ],
        };
        let square = vec![[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]];
        let areas = Layer {
            name: "plots".into(),
            kind: GeometryKind::Polygon,
            crs: None,
            columns: Vec::new(),
            features: vec![Feature {
                geometry: Some(Geometry::Polygon(vec![square])),
                values: Vec::new(),
            }],
            ..lines.clone()
        };
        let table = Layer {
            name: "counts".into(),
            kind: GeometryKind::None,
            features: vec![Feature { geometry: None, values: values(1, 2.0, "x") }],
            ..lines.clone()
        };
        vec![lines, areas, table]
    }

    #[test]
    fn layers_are_read_back_and_bytes_are_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gpkg");
        write(&path, false, &layers()).unwrap();
        assert!(matches!(write(&path, false, &layers()), Err(FileError::Exists { .. })));
        let first = std::fs::read(&path).unwrap();
        write(&path, true, &layers()).unwrap();
        assert!(first == std::fs::read(&path).unwrap(), "the same layers, other bytes");
        assert_eq!(&first[68..72], b"GPKG");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no litter");
        let file = Connection::open(&path).unwrap();
        let row = |sql: &str| -> Vec<rusqlite::types::Value> {
            file.query_row(sql, [], |row| {
                (0..row.as_ref().column_count()).map(|k| row.get(k)).collect()
            })
            .unwrap()
        };
        use rusqlite::types::Value as Sql;
        assert_eq!(
            row(
                "SELECT data_type, min_x, max_x, min_y, max_y, srs_id FROM gpkg_contents WHERE table_name = 'leaves'"
            ),
            [
                Sql::Text("features".into()),
                Sql::Real(1.0),
                Sql::Real(4.0),
                Sql::Real(-3.0),
                Sql::Real(2.0),
                Sql::Integer(32616)
            ]
        );
        assert_eq!(
            row("SELECT count, length_m, \"na\"\"me\" FROM leaves WHERE fid = 1"),
            [Sql::Integer(7), Sql::Real(0.25), Sql::Text("a'b".into())]
        );
        assert_eq!(row("SELECT geom, length_m FROM leaves WHERE fid = 2"), [Sql::Null, Sql::Null]);
        let Sql::Blob(blob) = &row("SELECT geom FROM leaves WHERE fid = 1")[0] else { panic!() };
        let real = |at: usize| f64::from_le_bytes(blob[at..at + 8].try_into().unwrap());
        assert_eq!(&blob[..4], b"GP\0\x03");
        assert_eq!(i32::from_le_bytes(blob[4..8].try_into().unwrap()), 32616);
        assert_eq!([8, 16, 24, 32].map(real), [1.0, 4.0, -3.0, 2.0]);
        assert_eq!(blob[40..49], [1, 2, 0, 0, 0, 2, 0, 0, 0]);
        assert_eq!([49, 57, 65, 73].map(real), [1.0, 2.0, 4.0, -3.0]);
        let Sql::Blob(ring) = &row("SELECT geom FROM plots")[0] else { panic!() };
        // Header, bounds, kind, one ring, which was closed.
        assert_eq!(ring.len(), 40 + 5 + 4 + 4 + 4 * 16);
        assert_eq!(row("SELECT count(*) FROM counts"), [Sql::Integer(1)]);
        assert_eq!(
            row("SELECT srs_id FROM gpkg_geometry_columns WHERE table_name = 'plots'"),
            [Sql::Integer(-1)]
        );
        assert_eq!(row("PRAGMA integrity_check"), [Sql::Text("ok".into())]);
        assert_eq!(row("SELECT count(*) FROM pragma_foreign_key_check"), [Sql::Integer(0)]);
    }

    #[test]
    fn what_does_not_fit_is_refused_with_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gpkg");
        let refused = |change: fn(&mut Vec<Layer>), words: &str| {
            let mut layers = layers();
            change(&mut layers);
            let error = write(&path, false, &layers).unwrap_err().to_string();
            assert!(error.contains(words) && error.contains("a.gpkg"), "{error}");
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        };
        refused(|layers| layers[1].name = "LEAVES".into(), "two layers");
        refused(|layers| layers[0].name = "gpkg_x".into(), "gpkg_x");
        refused(|layers| layers[0].columns[1].name = "Fid".into(), "two columns");
        refused(|layers| drop(layers[0].features[0].values.pop()), "2 values for 3 columns");
        refused(|layers| layers[0].kind = GeometryKind::Point, "its layer holds Point");
        refused(
            |layers| {
                layers[0].features[0].geometry = Some(Geometry::LineString(vec![[f64::NAN; 2]]))
            },
            "no finite number",
        );
    }
}
