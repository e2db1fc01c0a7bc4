//! The project that a run makes for itself: a small field, flown over and photographed.

use super::config;
use crate::{
    cli::{dispatch, parse},
    error::Error,
    io::{FileError, output},
};
use data_synth::board::BOARD;
use serde_json::{Value, json};
use std::{collections::BTreeMap, path::Path};

/// Says that a folder is such a project, and from which seed.
const MARKER: &str = "synthetic-field.txt";

/// Photos of a chessboard from which the camera is calibrated.
const BOARDS: usize = 16;

/// Refuses a folder that holds something else, and one of another seed.
///
/// # Errors
/// As said.
pub(super) fn check(root: &Path, seed: u64, force: bool) -> Result<(), Error> {
    let marker = root.join(MARKER);
    match std::fs::read_to_string(&marker) {
        Ok(text) if text == marker_text(seed) || force => return Ok(()),
        Ok(text) => {
            let message = format!(
                "it holds the field of another seed ({}); give another --output, or --force",
                text.trim()
            );
            return Err(FileError::malformed(root, None, message).into());
        }
        Err(_) => {}
    }
    let taken = std::fs::read_dir(root).is_ok_and(|mut entries| entries.next().is_some());
    if root.exists() && (taken || !root.is_dir()) && !force {
        return Err(FileError::Exists { path: root.to_owned() }.into());
    }
    std::fs::create_dir_all(root).map_err(|e| FileError::write(root, e))?;
    output::write(&marker, true, |out| out.write_all(marker_text(seed).as_bytes()))?;
    Ok(())
}

fn marker_text(seed: u64) -> String {
    format!("seed {seed}\n")
}

/// The command that makes the project.
pub(super) fn command(seed: u64) -> String {
    format!("rowgram synth flight --preset small --boards {BOARDS} --seed {seed} -o .")
}

/// A plot of the truth.
struct Plot {
    name: String,
    leaves: f64,
    corners_m: [[f64; 2]; 4],
}

/// Makes it: what a crew brings home, the truth, the plots, regions whose leaves were counted, `rowgram.toml`.
///
/// # Errors
/// Where a file cannot be written.
pub(super) fn grow(root: &Path, seed: u64) -> Result<Value, Error> {
    let mut words: Vec<std::ffi::OsString> =
        ["rowgram", "synth", "flight", "--preset", "small", "--force", "--boards"]
            .map(Into::into)
            .into();
    words.extend([BOARDS.to_string().into(), "--seed".into(), seed.to_string().into()]);
    words.extend(["-o".into(), root.into()]);
    dispatch(parse(words)?.verb)?;
    let path = root.join("truth").join("plots.csv");
    let plots = plots(&path)?;
    let epsg = epsg(&root.join("field.toml"))?;
    // Every third plot has been counted by hand.
    let counted: Vec<&Plot> = plots.iter().step_by(3).collect();
    polygons(&root.join("plots.geojson"), epsg, plots.iter().map(|plot| (plot, false)))?;
    polygons(&root.join("regions.geojson"), epsg, counted.iter().map(|plot| (*plot, true)))?;
    let settings = config::TEMPLATE
        .replace("# name = \"My field\"", &format!("name = \"Synthetic field {seed}\""))
        .replace("# crs = \"EPSG:32616\"", &format!("crs = \"EPSG:{epsg}\""))
        .replace("# board = \"8x6\"", &format!("board = \"{}x{}\"", BOARD.columns, BOARD.rows))
        .replace("# square_m = 0.025", &format!("square_m = {}", BOARD.side_m))
        .replace("# truth = \"truth/plants.csv\"", "truth = \"truth/plants.csv\"");
    let path = root.join(config::NAME);
    if !path.exists() {
        output::write(&path, false, |out| out.write_all(settings.as_bytes()))?;
    }
    Ok(json!({"seed": seed, "plots": plots.len(), "counted_by_hand": counted.len()}))
}

fn epsg(path: &Path) -> Result<u32, Error> {
    let text = std::fs::read_to_string(path).map_err(|e| FileError::read(path, e))?;
    let table: toml::Table =
        text.parse().map_err(|e: toml::de::Error| FileError::malformed(path, None, e.message()))?;
    let code =
        table.get("site").and_then(|site| site.get("epsg")).and_then(toml::Value::as_integer);
    code.and_then(|code| u32::try_from(code).ok())
        .ok_or_else(|| FileError::malformed(path, None, "expected site.epsg").into())
}

fn plots(path: &Path) -> Result<Vec<Plot>, Error> {
    let malformed = |message: String| FileError::malformed(path, None, message);
    let mut reader = csv::Reader::from_path(path).map_err(|e| malformed(e.to_string()))?;
    let mut found = Vec::new();
    for row in reader.deserialize::<BTreeMap<String, String>>() {
        let row = row.map_err(|e| malformed(e.to_string()))?;
        let number = |name: &str| {
            let value = row.get(name).and_then(|text| text.parse::<f64>().ok());
            value.ok_or_else(|| malformed(format!("expected a number in the column {name}")))
        };
        let mut corners_m = [[0.0; 2]; 4];
        for (k, corner) in corners_m.iter_mut().enumerate() {
            *corner = [number(&format!("easting_{k}_m"))?, number(&format!("northing_{k}_m"))?];
        }
        found.push(Plot {
            name: format!("P{:02.0}", number("plot")? + 1.0),
            leaves: number("leaves")?,
            corners_m,
        });
    }
    Ok(found)
}

fn polygons<'a>(
    path: &Path,
    epsg: u32,
    plots: impl Iterator<Item = (&'a Plot, bool)>,
) -> Result<(), Error> {
    let features: Vec<Value> = plots
        .map(|(plot, leaves)| {
            let mut ring = plot.corners_m.to_vec();
            ring.push(plot.corners_m[0]);
            let mut properties = json!({"name": plot.name});
            if leaves {
                properties["leaves"] = json!(plot.leaves);
            }
            json!({
                "type": "Feature",
                "properties": properties,
                "geometry": {"type": "Polygon", "coordinates": [ring]},
            })
        })
        .collect();
    let name = format!("urn:ogc:def:crs:EPSG::{epsg}");
    let collection = json!({
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": name}},
        "features": features,
    });
    output::write(path, true, |out| writeln!(out, "{collection}"))?;
    Ok(())
}
