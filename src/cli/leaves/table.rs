//! Leaves as a table (CSV) and on the map (GeoJSON).
//!
//! Columns: `leaf` (its label, from 1), `u_px, v_px` (middle of the axis), `length_px, mean_width_px,
//! max_width_px, area_px`, `angle_deg` (of the axis, 0 to 180, from the picture's `u` axis towards `v`), `hue_deg`
//! (0 to 360; empty without colours), `plant` (from 1; empty without plants); with a ground sampling distance
//! `length_m, mean_width_m, max_width_m, area_m2`; with a place on the map `x, y`.

use crate::{
    error::Error,
    io::{
        FileError, output,
        rasters::{BAND_ROWS, Source},
    },
    phenotype::leaves::Leaf,
    raster::{georeference::Georeference, hsv, window},
};
use serde_json::{Map, Value, json};
use std::{f64::consts::TAU, path::Path};

/// What is written of each leaf.
pub(super) struct Rows<'a> {
    pub(super) leaves: &'a [Leaf],
    pub(super) hues: Option<&'a [Option<f64>]>,
    pub(super) owners: Option<&'a [Option<usize>]>,
    pub(super) gsd_m: Option<f64>,
    pub(super) georeference: Option<Georeference>,
}

impl Rows<'_> {
    /// Names and values of one leaf, in the order of the columns.
    fn row(&self, index: usize) -> Vec<(&'static str, Option<f64>)> {
        let leaf = &self.leaves[index];
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
            ("hue_deg", self.hues.and_then(|hues| hues[index]).and_then(|hue| rounded(hue, 1))),
            ("plant", self.owners.and_then(|owners| owners[index]).map(|plant| plant as f64 + 1.0)),
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
            let [x, y] = place.map([u, v]);
            row.extend([("x", rounded(x, 4)), ("y", rounded(y, 4))]);
        }
        row
    }

    pub(super) fn write_csv(&self, path: &Path, force: bool) -> Result<(), FileError> {
        output::write(path, force, |writer| {
            let mut csv = csv::Writer::from_writer(writer);
            let names: Vec<&str> = if self.leaves.is_empty() {
                vec![
                    "leaf",
                    "u_px",
                    "v_px",
                    "length_px",
                    "mean_width_px",
                    "max_width_px",
                    "area_px",
                    "angle_deg",
                    "hue_deg",
                    "plant",
                ]
            } else {
                self.row(0).iter().map(|(name, _)| *name).collect()
            };
            csv.write_record(names)?;
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

    pub(super) fn write_geojson(&self, path: &Path, force: bool) -> Result<(), FileError> {
        let crs = self.georeference.and_then(|place| place.crs.epsg).map(|epsg| {
            json!({"type": "name", "properties": {"name": format!("urn:ogc:def:crs:EPSG::{epsg}")}})
        });
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

    fn feature(&self, index: usize) -> Value {
        let leaf = &self.leaves[index];
        let rounded = |value: f64| (value * 1e4).round() / 1e4;
        let mut points: Vec<[f64; 2]> = leaf
            .axis_px
            .iter()
            .map(|&point| self.georeference.map_or(point, |place| place.map(point)).map(rounded))
            .collect();
        // A line has two points at least.
        if points.len() == 1 {
            points.push(points[0]);
        }
        let mut properties: Map<String, Value> = self
            .row(index)
            .into_iter()
            .map(|(name, value)| {
                let whole = matches!(name, "leaf" | "plant" | "area_px");
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

/// The mean hue of each leaf, degrees; the mean of directions on the circle, so that red is no green.
pub(super) fn hues(source: &Source, leaves: &[Leaf]) -> Result<Vec<Option<f64>>, Error> {
    let (_, height) = source.size();
    let bands: Vec<window::Band> = window::bands(height, BAND_ROWS, 0).collect();
    let mut of_band: Vec<Vec<(usize, usize)>> = vec![Vec::new(); bands.len()];
    for (leaf, runs) in leaves.iter().map(|leaf| &leaf.runs).enumerate() {
        for (run, place) in runs.iter().enumerate() {
            of_band[place.v / BAND_ROWS].push((leaf, run));
        }
    }
    // Sine and cosine of the 180 hues.
    let directions: Vec<(f64, f64)> =
        (0..256).map(|hue| (f64::from(hue) * TAU / 180.0).sin_cos()).collect();
    let mut sums = vec![[0.0; 2]; leaves.len()];
    for (band, runs) in bands.iter().zip(of_band) {
        if runs.is_empty() {
            continue;
        }
        let photo = source.rgb(band.rows.clone())?;
        for (leaf, run) in runs {
            let run = leaves[leaf].runs[run];
            for u in run.start..run.end {
                let rgb = photo.get_pixel(u as u32, (run.v - band.rows.start) as u32).0;
                let (sin, cos) = directions[usize::from(hsv::from_rgb(rgb)[0])];
                sums[leaf][0] += sin;
                sums[leaf][1] += cos;
            }
        }
    }
    let hue = |sum: &[f64; 2]| {
        (sum[0].hypot(sum[1]) > 1e-9).then(|| sum[0].atan2(sum[1]).rem_euclid(TAU).to_degrees())
    };
    Ok(sums.iter().map(hue).collect())
}

/// The plants with their number of leaves.
pub(super) fn write_plants(
    path: &Path,
    force: bool,
    plants: &[[f64; 2]],
    owners: &[Option<usize>],
) -> Result<(), FileError> {
    let mut counts = vec![0usize; plants.len()];
    for &plant in owners.iter().flatten() {
        counts[plant] += 1;
    }
    output::write(path, force, |writer| {
        writeln!(writer, "plant,u_px,v_px,leaves")?;
        for (index, (plant, count)) in plants.iter().zip(counts).enumerate() {
            writeln!(writer, "{},{:.4},{:.4},{count}", index + 1, plant[0], plant[1])?;
        }
        Ok(())
    })
}
