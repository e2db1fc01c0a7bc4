//! GeoPackage: layers of geometries with attributes, in any coordinate reference system.
//!
//! A GeoPackage is an SQLite file with agreed tables; QGIS and GDAL open it as it is. [`write()`] makes one from
//! whole [`Layer`]s, atomically. The same layers give the same bytes: `last_change`, which the standard
//! asks for, is a fixed date.
//!
//! Coordinates are those of the layer's [`Crs`], x (east) before y (north). One with a code of the EPSG registry is named
//! by it; without a code the layer is in "undefined Cartesian" coordinates, which may be pixels.
//!
//! Reading and writing need the Cargo feature `geopackage` ([`IS_AVAILABLE`]).
//!
//! Reference: OGC GeoPackage Encoding Standard 12-128r18 (version 1.3); OGC 06-103r4 for well-known binary.

#[cfg(feature = "geopackage")]
mod sqlite;

use super::FileError;
use rowgram_raster::{georeference::Crs, polygon::Polygon};
use std::{collections::BTreeSet, path::Path};

/// Whether this build reads and writes GeoPackages: the Cargo feature `geopackage`.
pub const IS_AVAILABLE: bool = cfg!(feature = "geopackage");

/// What a build without GeoPackages says of a file.
#[cfg(not(feature = "geopackage"))]
pub(super) fn unavailable(path: &Path) -> FileError {
    let message =
        "this build has no GeoPackages; build with the Cargo feature geopackage, or use GeoJSON";
    FileError::Unusable { path: path.to_owned(), message }
}

/// Names of columns that every layer has.
const OWN: [&str; 2] = ["fid", "geom"];
/// What a layer's geometries are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GeometryKind {
    /// Places.
    Point,
    /// Lines of two points or more.
    LineString,
    /// Areas: outer rings and holes, each ring closed or not.
    Polygon,
}

/// A geometry, `[x, y]` in the layer's coordinates.
#[derive(Debug, Clone, PartialEq)]
pub enum Geometry {
    /// A place.
    Point([f64; 2]),
    /// A line.
    LineString(Vec<[f64; 2]>),
    /// The outer ring, then holes; of several parts one after the other, which are written as a `MultiPolygon`.
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
/// As [`write`](super::output::write); where two layers or columns have one name, a feature has another number of values or another
/// kind of geometry than its layer, or a coordinate is not finite; in a build without the feature `geopackage`.
pub fn write(path: &Path, force: bool, layers: &[Layer]) -> Result<(), FileError> {
    check(path, layers)?;
    #[cfg(feature = "geopackage")]
    return super::output::write_by_path(path, force, |temporary| {
        sqlite::fill(temporary, layers)
            .map_err(|error| FileError::write(path, std::io::Error::other(error)))
    });
    #[cfg(not(feature = "geopackage"))]
    return super::output::check(path, force).and(Err(unavailable(path)));
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

#[cfg(feature = "geopackage")]
impl Layer {
    /// What the standard calls its geometries; areas of one part and of several have no closer name in common.
    fn geometry_name(&self) -> &'static str {
        let mut all = self.features.iter().filter_map(|feature| feature.geometry.as_ref());
        if all.any(Geometry::is_multiple) { "GEOMETRY" } else { self.kind.name() }
    }
}

#[cfg(feature = "geopackage")]
impl GeometryKind {
    fn name(self) -> &'static str {
        match self {
            GeometryKind::Point => "POINT",
            GeometryKind::LineString => "LINESTRING",
            GeometryKind::Polygon => "POLYGON",
        }
    }
}

#[cfg(feature = "geopackage")]
/// Least and greatest x, least and greatest y.
struct Bounds([[f64; 2]; 2]);

#[cfg(feature = "geopackage")]
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

    /// The parts of an area, each an outer ring and its holes; nothing of others.
    fn parts(&self) -> Vec<Vec<Vec<[f64; 2]>>> {
        match self {
            Geometry::Polygon(rings) => {
                let parts = Polygon { rings: rings.clone() }.parts();
                parts.into_iter().map(|part| part.rings).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Whether it is an area of several parts.
    pub(super) fn is_multiple(&self) -> bool {
        self.parts().len() > 1
    }

    pub(super) fn points(&self) -> Box<dyn Iterator<Item = [f64; 2]> + '_> {
        match self {
            Geometry::Point(point) => Box::new(std::iter::once(*point)),
            Geometry::LineString(points) => Box::new(points.iter().copied()),
            Geometry::Polygon(rings) => Box::new(rings.iter().flatten().copied()),
        }
    }

    #[cfg(feature = "geopackage")]
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
        out.extend(self.well_known_binary());
        out
    }

    /// Well-known binary, little-endian.
    pub fn well_known_binary(&self) -> Vec<u8> {
        let mut out = vec![1];
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
            Geometry::Polygon(_) if self.is_multiple() => {
                let parts = self.parts();
                out.extend(6u32.to_le_bytes());
                out.extend(count(parts.len()));
                let binary = |part| Geometry::Polygon(part).well_known_binary();
                out.extend(parts.into_iter().flat_map(binary));
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

#[cfg(all(test, feature = "geopackage"))]
mod tests {
    use super::*;
    use rusqlite::Connection;

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
        vec![lines, areas]
    }

    #[test]
    fn areas_of_several_parts_are_multipolygons() {
        let square = |x: f64| vec![[x, 0.0], [x + 9.0, 0.0], [x + 9.0, 9.0], [x, 9.0]];
        let hole = vec![[2.0, 2.0], [4.0, 2.0], [4.0, 4.0], [2.0, 4.0]];
        let whole = Geometry::Polygon(vec![square(0.0), hole.clone()]);
        let parts = Geometry::Polygon(vec![square(0.0), hole, square(20.0)]);
        // Kind and number of rings or parts.
        let head = |of: &Geometry| [1, 5].map(|at| of.well_known_binary()[at]);
        assert_eq!([head(&whole), head(&parts)], [[3, 2], [6, 2]]);
        let mut layer = layers().swap_remove(1);
        assert_eq!(layer.geometry_name(), "POLYGON");
        layer.features[0].geometry = Some(parts);
        assert_eq!(layer.geometry_name(), "GEOMETRY");
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
