//! What was found against the truth, on the map: plants one to one, plants and leaves of every plot.

use super::step::Place;
use crate::{
    error::Error,
    io::{
        FileError, csv_table::CsvTable, geotiff::Reader, output, points, polygons, rasters::Source,
    },
    raster::{georeference::Georeference, window::Window},
    score::Score,
};
use serde_json::{Value, json};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// What is read.
pub(super) struct Inputs {
    truth: PathBuf,
    plants: PathBuf,
    ortho: PathBuf,
    plots: Option<PathBuf>,
    counts: Option<PathBuf>,
    radii_m: Vec<f64>,
}

impl Inputs {
    /// `None` where there is nothing to evaluate.
    pub(super) fn of(place: &Place<'_>) -> Option<Inputs> {
        let plants = place.at("locate", "plants.csv");
        let counts = place.at("count", "counts.csv");
        Some(Inputs {
            truth: place.root.join(place.config.project.truth.as_ref()?),
            plants: Some(plants).filter(|path| path.is_file())?,
            ortho: place.ortho()?,
            plots: place.polygons(place.config.project.plots.as_ref(), "plots"),
            counts: Some(counts).filter(|path| path.is_file()),
            radii_m: place.config.evaluate.radii_m.clone(),
        })
    }

    pub(super) fn files(&self) -> Vec<PathBuf> {
        let mut files = vec![self.truth.clone(), self.plants.clone(), self.ortho.clone()];
        files.extend(self.plots.iter().flat_map(|plots| polygons::files(plots)));
        files.extend(self.counts.clone());
        files
    }

    pub(super) fn key(&self) -> String {
        format!("radii_m {:?}", self.radii_m)
    }
}

/// A true plant on the map.
struct Plant {
    at_m: [f64; 2],
    leaves: Option<f64>,
}

fn truth(path: &Path) -> Result<Vec<Plant>, Error> {
    let malformed =
        |line: Option<usize>, message: String| FileError::malformed(path, line, message);
    let mut reader = csv::Reader::from_path(path).map_err(|e| malformed(None, e.to_string()))?;
    let header = reader.headers().map_err(|e| malformed(None, e.to_string()))?.clone();
    let place = |name: &str| header.iter().position(|field| field.trim() == name);
    let pair = [("easting_m", "northing_m"), ("x", "y")]
        .into_iter()
        .find_map(|(x, y)| place(x).zip(place(y)))
        .ok_or_else(|| malformed(Some(1), "expected easting_m,northing_m or x,y".to_owned()))?;
    let leaves = place("leaves");
    let mut found = Vec::new();
    for (row, record) in reader.records().enumerate() {
        let record = record.map_err(|e| malformed(Some(row + 2), e.to_string()))?;
        let number = |k: usize| {
            let value = record.get(k).and_then(|text| text.trim().parse::<f64>().ok());
            value
                .filter(|value| value.is_finite())
                .ok_or_else(|| malformed(Some(row + 2), format!("column {} is no number", k + 1)))
        };
        let leaves = leaves.map(&number).transpose()?;
        found.push(Plant { at_m: [number(pair.0)?, number(pair.1)?], leaves });
    }
    Ok(found)
}

/// Whether the map shows a place: one that the photos do not show cannot be found.
struct Shown {
    reader: Option<Reader>,
    size: (usize, usize),
}

impl Shown {
    fn at(&self, [u, v]: [f64; 2]) -> Result<bool, Error> {
        let (u, v) = (u.round(), v.round());
        if u < 0.0 || v < 0.0 || u >= self.size.0 as f64 || v >= self.size.1 as f64 {
            return Ok(false);
        }
        let Some(reader) = self.reader.as_ref().filter(|r| r.bands() == 4 && r.holds::<u8>())
        else {
            return Ok(true);
        };
        let window = Window { u: u as usize, v: v as usize, width: 1, height: 1 };
        Ok(reader.read::<u8>(window)?.get(3).is_none_or(|&alpha| alpha > 0))
    }
}

fn place_of(path: &Path) -> Result<(Georeference, (usize, usize)), Error> {
    let source = Source::open(path)?;
    let place = source.georeference().ok_or_else(|| {
        FileError::malformed(path, None, "it has no place on the map, expected a GeoTIFF")
    })?;
    Ok((place, source.size()))
}

/// Scores, and writes `score.json` and `plots.csv`.
///
/// # Errors
/// A file that cannot be read or written.
pub(super) fn work(inputs: &Inputs, folder: &Path) -> Result<Value, Error> {
    let (place, size) = place_of(&inputs.ortho)?;
    let gsd_m = place
        .gsd_m()
        .ok_or_else(|| FileError::malformed(&inputs.ortho, None, "its map is not in metres"))?;
    let shown = Shown { reader: Reader::open(&inputs.ortho).ok(), size };
    let all = truth(&inputs.truth)?;
    let mut plants = Vec::new();
    let mut leaves = Vec::new();
    for plant in &all {
        let at = place.pixel(plant.at_m).unwrap_or([f64::NAN; 2]);
        if shown.at(at)? {
            plants.push(at);
            leaves.push(plant.leaves);
        }
    }
    let found = points::read(&inputs.plants)?;
    let radii_px: Vec<f64> = inputs.radii_m.iter().map(|radius| radius / gsd_m).collect();
    let score = Score::new(&found, &plants, &radii_px)
        .map_err(|e| Error::Argument(format!("[evaluate] radii_m: {e}")))?;
    let counts = inputs.counts.as_deref().map(leaf_counts).transpose()?.unwrap_or_default();
    let mut plots = Vec::new();
    if let Some(path) = &inputs.plots {
        for plot in polygons::read(path, Some(&place))? {
            let inside = |at: &[f64; 2]| plot.polygon.holds(*at);
            let of: Vec<usize> = (0..plants.len()).filter(|&k| inside(&plants[k])).collect();
            let true_leaves: Option<f64> = of.iter().map(|&k| leaves[k]).sum();
            plots.push(json!({
                "plot": plot.name,
                "true_plants": of.len(),
                "found_plants": found.iter().filter(|at| inside(at)).count(),
                "true_leaves": true_leaves,
                "leaves_by_area": counts.get(&plot.name),
            }));
        }
    }
    output::write(&folder.join("plots.csv"), true, |out| {
        writeln!(out, "plot,true_plants,found_plants,true_leaves,leaves_by_area")?;
        for plot in &plots {
            let text = |name: &str| match &plot[name] {
                Value::Null => String::new(),
                Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            let names = ["plot", "true_plants", "found_plants", "true_leaves", "leaves_by_area"];
            writeln!(out, "{}", names.map(text).join(","))?;
        }
        Ok(())
    })?;
    let metres = |px: Option<f64>| px.map(|px| px * gsd_m);
    let says = json!({
        "radii_m": inputs.radii_m,
        "gsd_m": gsd_m,
        "true_plants_not_shown": all.len() - plants.len(),
        "median_error_m": metres(score.median_error_px),
        "rms_error_m": metres(score.rms_error_px),
        "score": score,
        "plots": plots,
    });
    output::write(&folder.join("score.json"), true, |out| {
        serde_json::to_writer_pretty(&mut *out, &says)?;
        writeln!(out)
    })?;
    Ok(says)
}

/// Leaves by plot as `rowgram count` wrote them.
fn leaf_counts(path: &Path) -> Result<BTreeMap<String, f64>, Error> {
    let table = CsvTable::read(path)?;
    let columns = table.texts("plot").zip(table.numbers("leaves"));
    let (plots, leaves) = columns
        .ok_or_else(|| FileError::malformed(path, 1, "expected the columns plot and leaves"))?;
    Ok(plots.into_iter().map(str::to_owned).zip(leaves).collect())
}
