//! Single leaves as a table (CSV) and in a mapping frame (GeoPackage, GeoJSON), with the same columns.
//!
//! | column | |
//! |---|---|
//! | `leaf` | its label, from 1 |
//! | `u_px`, `v_px` | middle of its axis in the raster |
//! | `length_px` | length of its axis |
//! | `mean_width_px`, `max_width_px` | its width across the axis |
//! | `area_px` | its pixels |
//! | `angle_deg` | direction of its axis, 0 to 180, from the raster's `u` axis towards its `v` axis |
//! | `hue_deg` | mean hue, 0 to 360; empty without colours |
//! | `plant` | number of its plant, from 1; empty without plants |
//! | `length_m`, `mean_width_m`, `max_width_m`, `area_m2` | the same in metres, where the raster has a ground sampling distance |
//! | `x`, `y` | middle of its axis in the mapping frame, where the raster is georeferenced |
//!
//! A GeoJSON feature also has `width_profile_px`, the width at each point of the axis. The table of plants has the columns
//! `plant` (from 1), `u_px`, `v_px` and `leaves`, the number of its leaves.

use super::{
    FileError,
    gpkg::{self, Column, ColumnKind, Feature, Geometry, GeometryKind, Layer},
    output, polygons,
};
use rowgram_plants::phenotype::leaves::Leaf;
use rowgram_raster::georeference::{CrsKind, Georeference};
use serde_json::{Map, Value, json};
use std::path::Path;

/// What is written of each leaf.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// The leaves.
    pub leaves: &'a [Leaf],
    /// Mean hue of each, degrees; `None` without colours.
    pub hues: Option<&'a [Option<f64>]>,
    /// Plant of each, from 0; `None` without plants.
    pub owners: Option<&'a [Option<usize>]>,
    /// Ground sampling distance, metres per pixel.
    pub gsd_m: Option<f64>,
    /// Place of the raster in the mapping frame.
    pub georeference: Option<Georeference>,
}

impl Rows<'_> {
    /// Names and values of one leaf, in the order of the columns.
    fn row(&self, index: usize) -> Vec<(&'static str, Option<f64>)> {
        self.values(&self.leaves[index], index)
    }

    /// The names, which do not need a leaf.
    fn names(&self) -> Vec<&'static str> {
        let none = Leaf {
            runs: Vec::new(),
            axis_px: Vec::new(),
            width_px: Vec::new(),
            length_px: 0.0,
            area_px: 0,
        };
        self.values(&none, usize::MAX).into_iter().map(|(name, _)| name).collect()
    }

    fn values(&self, leaf: &Leaf, index: usize) -> Vec<(&'static str, Option<f64>)> {
        let [u, v] = leaf.middle_px();
        let rounded = |value: f64, digits: i32| {
            let scale = 10f64.powi(digits);
            Some((value * scale).round() / scale)
        };
        let (mean, max) = (leaf.mean_width_px(), leaf.max_width_px());
        let mut row = vec![
            ("leaf", Some(index as f64 + 1.0)),
            ("u_px", rounded(u, 2)),
            ("v_px", rounded(v, 2)),
            ("length_px", rounded(leaf.length_px, 2)),
            ("mean_width_px", rounded(mean, 2)),
            ("max_width_px", rounded(max, 2)),
            ("area_px", Some(leaf.area_px as f64)),
            ("angle_deg", rounded(leaf.angle_rad().to_degrees(), 1)),
            (
                "hue_deg",
                self.hues.and_then(|hues| *hues.get(index)?).and_then(|hue| rounded(hue, 1)),
            ),
            (
                "plant",
                self.owners.and_then(|owners| *owners.get(index)?).map(|plant| plant as f64 + 1.0),
            ),
        ];
        if let Some(gsd) = self.gsd_m {
            row.extend([
                ("length_m", rounded(leaf.length_px * gsd, 5)),
                ("mean_width_m", rounded(mean * gsd, 5)),
                ("max_width_m", rounded(max * gsd, 5)),
                ("area_m2", rounded(leaf.area_px as f64 * gsd * gsd, 7)),
            ]);
        }
        if let Some(place) = &self.georeference {
            let [x, y] = place.crs.kind.rounded(place.map([u, v]));
            row.extend([("x", Some(x)), ("y", Some(y))]);
        }
        row
    }

    /// Writes the table.
    ///
    /// # Errors
    /// As [`output::write`].
    pub fn write_csv(&self, path: &Path, force: bool) -> Result<(), FileError> {
        output::write(path, force, |writer| {
            let mut csv = csv::Writer::from_writer(writer);
            csv.write_record(self.names())?;
            for index in 0..self.leaves.len() {
                let cells = self
                    .row(index)
                    .into_iter()
                    .map(|(_, value)| value.map(|value| value.to_string()).unwrap_or_default());
                csv.write_record(cells)?;
            }
            csv.flush()
        })
    }

    /// Writes the axes as lines, in the raster's CRS, which the file names; in pixels without one.
    ///
    /// # Errors
    /// As [`output::write`].
    pub fn write_geojson(&self, path: &Path, force: bool) -> Result<(), FileError> {
        let crs = self.georeference.and_then(|place| polygons::crs_member(place.crs));
        output::write(path, force, |writer| {
            write!(writer, "{{\"type\":\"FeatureCollection\",")?;
            if let Some(crs) = crs {
                write!(writer, "\"crs\":{crs},")?;
            }
            writeln!(writer, "\"features\":[")?;
            for index in 0..self.leaves.len() {
                let end = if index + 1 < self.leaves.len() { "," } else { "" };
                writeln!(writer, "{}{end}", self.feature(index))?;
            }
            writeln!(writer, "]}}")
        })
    }

    /// Writes the layer `leaves`, and `plants` with their number of leaves where plants are given (in pixels).
    ///
    /// # Errors
    /// As [`gpkg::write`].
    pub fn write_gpkg(
        &self,
        path: &Path,
        force: bool,
        plants: Option<&[[f64; 2]]>,
    ) -> Result<(), FileError> {
        let kind = |name: &str| match whole(name) {
            true => ColumnKind::Integer,
            false => ColumnKind::Real,
        };
        let columns = self.names().into_iter().map(|name| Column::new(name, kind(name)));
        let features = (0..self.leaves.len()).map(|index| Feature {
            geometry: Some(Geometry::LineString(self.axis(index))),
            values: self
                .row(index)
                .into_iter()
                .map(|(name, value)| match value {
                    None => gpkg::Value::Null,
                    Some(value) if whole(name) => gpkg::Value::Integer(value as i64),
                    Some(value) => gpkg::Value::Real(value),
                })
                .collect(),
        });
        let crs = self.georeference.map(|place| place.crs);
        let mut layers = vec![Layer {
            name: "leaves".into(),
            description: "Axes of single leaves".into(),
            kind: GeometryKind::LineString,
            crs,
            columns: columns.collect(),
            features: features.collect(),
        }];
        if let (Some(plants), Some(owners)) = (plants, self.owners) {
            let place = |at: [f64; 2]| self.georeference.map_or(at, |place| place.map(at));
            let counts = counts(plants.len(), owners);
            let features = plants.iter().zip(counts).zip(1..).map(|((&at, count), number)| {
                let values = vec![gpkg::Value::Integer(number), gpkg::Value::Integer(count as i64)];
                Feature { geometry: Some(Geometry::Point(place(at))), values }
            });
            layers.push(Layer {
                name: "plants".into(),
                description: "Plants with their number of leaves".into(),
                kind: GeometryKind::Point,
                crs,
                columns: ["plant", "leaves"].map(|n| Column::new(n, ColumnKind::Integer)).into(),
                features: features.collect(),
            });
        }
        gpkg::write(path, force, &layers)
    }

    /// The axis of a leaf in the mapping frame, or in pixels; two points at least, as a line has.
    fn axis(&self, index: usize) -> Vec<[f64; 2]> {
        let kind = self.georeference.map_or(CrsKind::Unknown, |place| place.crs.kind);
        let place = |point| self.georeference.map_or(point, |place| place.map(point));
        let axis_px = &self.leaves[index].axis_px;
        let mut points: Vec<[f64; 2]> =
            axis_px.iter().map(|&point| kind.rounded(place(point))).collect();
        if points.len() == 1 {
            points.push(points[0]);
        }
        points
    }

    fn feature(&self, index: usize) -> Value {
        let leaf = &self.leaves[index];
        let rounded = |value: f64| (value * 1e4).round() / 1e4;
        let points = self.axis(index);
        let mut properties: Map<String, Value> = self
            .row(index)
            .into_iter()
            .map(|(name, value)| {
                let whole = whole(name);
                let number = value.map_or(Value::Null, |value| {
                    if whole { json!(value as u64) } else { json!(value) }
                });
                (name.to_owned(), number)
            })
            .collect();
        let widths: Vec<f64> = leaf.width_px.iter().map(|&width| rounded(width)).collect();
        properties.insert("width_profile_px".to_owned(), json!(widths));
        json!({
            "type": "Feature",
            "geometry": {"type": "LineString", "coordinates": points},
            "properties": properties,
        })
    }
}

/// Whether a column holds whole numbers.
fn whole(name: &str) -> bool {
    matches!(name, "leaf" | "plant" | "area_px")
}

/// Leaves of each plant.
fn counts(plants: usize, owners: &[Option<usize>]) -> Vec<usize> {
    let mut counts = vec![0usize; plants];
    for &plant in owners.iter().flatten() {
        counts[plant] += 1;
    }
    counts
}

/// Writes the plants (positions in pixels) with their number of leaves.
///
/// # Errors
/// As [`output::write`].
pub fn write_per_plant(
    path: &Path,
    force: bool,
    plants: &[[f64; 2]],
    owners: &[Option<usize>],
) -> Result<(), FileError> {
    let counts = counts(plants.len(), owners);
    output::write(path, force, |writer| {
        writeln!(writer, "plant,u_px,v_px,leaves")?;
        for (index, (plant, count)) in plants.iter().zip(counts).enumerate() {
            writeln!(writer, "{},{:.4},{:.4},{count}", index + 1, plant[0], plant[1])?;
        }
        Ok(())
    })
}
