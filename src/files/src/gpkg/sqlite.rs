//! The SQLite file of a GeoPackage: its tables, reference systems and rows.

use super::{Bounds, ColumnKind, Feature, Geometry, Layer, Value};
use rowgram_raster::georeference::{Crs, CrsKind};
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
const WGS84: &str = "GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563,\
    AUTHORITY[\"EPSG\",\"7030\"]],AUTHORITY[\"EPSG\",\"6326\"]],PRIMEM[\"Greenwich\",0,\
    AUTHORITY[\"EPSG\",\"8901\"]],UNIT[\"degree\",0.0174532925199433,AUTHORITY[\"EPSG\",\"9122\"]],\
    AUTHORITY[\"EPSG\",\"4326\"]]";

/// Makes the file.
pub(super) fn fill(path: &Path, layers: &[Layer]) -> rusqlite::Result<()> {
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
    let mut columns = vec![
        "fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL".to_owned(),
        format!("geom {}", layer.geometry_name()),
    ];
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
        "INSERT INTO gpkg_contents VALUES (?1, 'features', ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
        params![
            layer.name,
            layer.description,
            LAST_CHANGE,
            known(x[0]),
            known(y[0]),
            known(x[1]),
            known(y[1]),
            system
        ],
    )?;
    connection.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?1, 'geom', ?2, ?3, 0, 0)",
        params![layer.name, layer.geometry_name(), system],
    )?;
    let places: Vec<String> = (1..layer.columns.len() + 3).map(|k| format!("?{k}")).collect();
    let insert = format!("INSERT INTO {table} VALUES ({})", places.join(", "));
    let mut insert = connection.prepare(&insert)?;
    for (number, feature) in (1i64..).zip(&layer.features) {
        put_feature(&mut insert, number, feature, system)?;
    }
    Ok(())
}

fn put_feature(
    insert: &mut Statement<'_>,
    number: i64,
    feature: &Feature,
    system: i64,
) -> rusqlite::Result<()> {
    let geometry = feature.geometry.as_ref().map(|geometry| geometry.blob(system as i32));
    let mut values: Vec<&dyn ToSql> = vec![&number, &geometry];
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
