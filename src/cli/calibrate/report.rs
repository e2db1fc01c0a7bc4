//! What a calibration found: for a person, for a machine, and in tables.

use super::{
    Args, Outcome, figures, gather,
    models::{Bend, ModelRow},
    pictures,
    residuals::{curve, residual_rows, rings},
};
use crate::{
    error::Error,
    io::{FileError, corners, output},
    problems::calibration::statistics::{ParameterStatistics, Statistics},
};
use serde::Serialize;
use std::{fmt::Write as _, path::Path};

/// Files of the report folder.
pub(super) const FILES: &[&str] = &[
    "report.json",
    "parameters.csv",
    "correlation.csv",
    "correlation.svg",
    "photos.csv",
    "corners.csv",
    "residuals.csv",
    "residuals.svg",
    "residuals_by_radius.csv",
    "residuals_by_radius.svg",
    "distortion.csv",
    "distortion.svg",
    "models.csv",
    "before.png",
    "after.png",
    "board.csv",
];

/// A photo in the report.
#[derive(Serialize)]
struct PhotoRow<'a> {
    image: &'a str,
    #[serde(flatten)]
    status: &'a gather::Status,
    corners: usize,
    rms_px: Option<f64>,
    largest_px: Option<f64>,
    tilt_deg: Option<f64>,
    distance_m: Option<f64>,
    edge_width_px: Option<f64>,
    blurred: bool,
}

/// The whole report.
#[derive(Serialize)]
pub(super) struct Report<'a> {
    lens: &'static str,
    size_px: [u32; 2],
    board: String,
    square_m: f64,
    photos: Vec<PhotoRow<'a>>,
    photos_used: usize,
    corners: usize,
    iterations: u64,
    converged: bool,
    observations: usize,
    unknowns: usize,
    rms_px: f64,
    sigma0_px: f64,
    parameters: &'a [ParameterStatistics],
    free: &'a [&'static str],
    correlation: &'a [Vec<f64>],
    best_model: &'a str,
    models: &'a [ModelRow],
    #[serde(skip_serializing_if = "Option::is_none")]
    board_bend: Option<Bend>,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    board_heights_m: &'a [[f64; 2]],
}

pub(super) fn json<'a>(args: &Args, outcome: &'a Outcome) -> Report<'a> {
    let found = &outcome.statistics;
    Report {
        lens: outcome.request.model.word(),
        size_px: outcome.request.size_px,
        board: args.board.to_string(),
        square_m: args.square,
        photos: photo_rows(outcome),
        photos_used: outcome.used.len(),
        corners: found.observations / 2,
        iterations: outcome.solution.iterations,
        converged: outcome.solution.stop.converged(),
        observations: found.observations,
        unknowns: found.unknowns,
        rms_px: found.rms_px,
        sigma0_px: found.sigma0_px,
        parameters: &found.parameters,
        free: &found.free,
        correlation: &found.correlation,
        best_model: outcome.models.first().map_or("", |row| row.lens),
        models: &outcome.models,
        board_bend: outcome.bend,
        board_heights_m: &found.heights_m,
    }
}

fn photo_rows(outcome: &Outcome) -> Vec<PhotoRow<'_>> {
    outcome
        .photos
        .iter()
        .enumerate()
        .map(|(k, photo)| {
            let place = outcome.used.iter().position(|&used| used == k);
            let view = place.map(|place| &outcome.statistics.views[place]);
            PhotoRow {
                image: &photo.name,
                status: &photo.status,
                corners: photo.corners.len(),
                rms_px: view.map(|v| v.rms_px),
                largest_px: view.map(|v| v.largest_px),
                tilt_deg: view.map(|v| v.tilt_deg),
                distance_m: view.map(|v| v.distance_m),
                edge_width_px: photo.edge_width_px,
                blurred: photo.blurred,
            }
        })
        .collect()
}

/// The report for a person.
pub(super) fn text(outcome: &Outcome) -> String {
    let found = &outcome.statistics;
    let mut out = String::new();
    let _ = writeln!(
        out,
        "{} of {} photos, {} corners; rms {:.4} px, sigma0 {:.4} px ({} observations, {} unknowns, {} iterations)",
        outcome.used.len(),
        outcome.photos.len(),
        found.observations / 2,
        found.rms_px,
        found.sigma0_px,
        found.observations,
        found.unknowns,
        outcome.solution.iterations
    );
    let _ = writeln!(out, "lens model {}:", outcome.request.model.word());
    for p in &found.parameters {
        let _ = match (p.free, p.probability) {
            (true, Some(probability)) => writeln!(
                out,
                "  {:<7} {:>16} +- {:<12} {:<6} {}",
                p.name,
                number(p.value),
                number(p.standard_deviation),
                p.unit,
                if probability < SIGNIFICANCE { "" } else { "not significant" }
            ),
            _ => writeln!(out, "  {:<7} {:>16} held", p.name, number(p.value)),
        };
    }
    let strong = strongest(found);
    if let Some((a, b, value)) = strong {
        let _ = writeln!(out, "largest correlation: {value:.3} between {a} and {b}");
    }
    if !found.heights_m.is_empty() {
        let most = found.heights_m.iter().map(|h| h[0].abs()).fold(0.0, f64::max);
        let _ = writeln!(out, "the board is up to {:.2} mm off its plane", 1e3 * most);
    }
    let _ = writeln!(out, "lens models on these corners, the best first (Bayes' criterion):");
    for row in &outcome.models {
        let _ = writeln!(
            out,
            "  {:<8} {:>2} parameters  rms {:.4} px  ({})",
            row.lens, row.parameters, row.rms_px, row.terms
        );
    }
    for (k, photo) in outcome.photos.iter().enumerate() {
        if !photo.status.is_used() || photo.blurred {
            let blurred = if photo.blurred { ", blurred" } else { "" };
            let _ = writeln!(out, "{}: {}{blurred}", outcome.photos[k].name, photo.status);
        }
    }
    out
}

/// A probability below this makes a parameter significant.
const SIGNIFICANCE: f64 = 0.05;

/// Six digits, with an exponent where the number is large or small.
fn number(value: f64) -> String {
    if value == 0.0 || (1e-3..1e6).contains(&value.abs()) {
        format!("{value:.6}")
    } else {
        format!("{value:.5e}")
    }
}

fn strongest(found: &Statistics) -> Option<(&'static str, &'static str, f64)> {
    let pairs = (0..found.free.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    pairs
        .map(|(i, j)| (found.free[j], found.free[i], found.correlation[i][j]))
        .max_by(|a, b| a.2.abs().total_cmp(&b.2.abs()))
}

/// Writes the report folder.
///
/// # Errors
/// Where the folder or a file cannot be written.
pub(super) fn write(folder: &Path, args: &Args, outcome: &Outcome) -> Result<(), Error> {
    std::fs::create_dir_all(folder).map_err(|source| FileError::write(folder, source))?;
    let path = |name: &str| folder.join(name);
    let report = serde_json::to_string_pretty(&json(args, outcome))
        .map_err(|e| FileError::write(&path("report.json"), std::io::Error::other(e)))?;
    output::write(&path("report.json"), args.force, |out| {
        out.write_all(report.as_bytes())?;
        out.write_all(b"\n")
    })?;
    let found = &outcome.statistics;
    table(&path("parameters.csv"), args.force, &found.parameters)?;
    output::write(&path("correlation.csv"), args.force, |out| {
        writeln!(out, "parameter,{}", found.free.join(","))?;
        for (name, row) in found.free.iter().zip(&found.correlation) {
            let row: Vec<String> = row.iter().map(f64::to_string).collect();
            writeln!(out, "{name},{}", row.join(","))?;
        }
        Ok(())
    })?;
    photo_table(&path("photos.csv"), args.force, outcome)?;
    corners::write(&path("corners.csv"), args.force, &gather::corner_table(&outcome.photos))?;
    table(&path("models.csv"), args.force, &outcome.models)?;
    let rows = residual_rows(outcome)?;
    let rings = rings(&rows);
    let curve = curve(&outcome.solution.state.interior);
    table(&path("residuals.csv"), args.force, &rows)?;
    table(&path("residuals_by_radius.csv"), args.force, &rings)?;
    table(&path("distortion.csv"), args.force, &curve)?;
    if !found.heights_m.is_empty() {
        output::write(&path("board.csv"), args.force, |out| {
            writeln!(out, "column,row,height_m,standard_deviation_m")?;
            let stride = args.board.columns.max(args.board.rows);
            for (corner, [height, sigma]) in found.heights_m.iter().enumerate() {
                let (column, row) = (corner % stride, corner / stride);
                if column < args.board.columns && row < args.board.rows {
                    writeln!(out, "{column},{row},{height},{sigma}")?;
                }
            }
            Ok(())
        })?;
    }
    figures::correlation(&path("correlation.svg"), args.force, found)?;
    figures::residuals(&path("residuals.svg"), args.force, &rows, outcome.request.size_px)?;
    figures::by_radius(&path("residuals_by_radius.svg"), args.force, &rows, &rings)?;
    figures::distortion(&path("distortion.svg"), args.force, &curve, outcome)?;
    pictures::write(&path("before.png"), &path("after.png"), args.force, outcome)
}

fn table<T: Serialize>(path: &Path, force: bool, rows: &[T]) -> Result<(), FileError> {
    output::write(path, force, |out| {
        let mut writer = csv::Writer::from_writer(out);
        for row in rows {
            writer.serialize(row).map_err(std::io::Error::other)?;
        }
        writer.flush()
    })
}

fn photo_table(path: &Path, force: bool, outcome: &Outcome) -> Result<(), FileError> {
    output::write(path, force, |out| {
        let mut writer = csv::Writer::from_writer(out);
        writer.write_record([
            "image",
            "status",
            "corners",
            "rms_px",
            "largest_px",
            "tilt_deg",
            "distance_m",
            "edge_width_px",
            "blurred",
        ])?;
        let text = |value: Option<f64>| value.map(|v| v.to_string()).unwrap_or_default();
        for row in photo_rows(outcome) {
            writer.write_record([
                row.image.to_owned(),
                row.status.to_string(),
                row.corners.to_string(),
                text(row.rms_px),
                text(row.largest_px),
                text(row.tilt_deg),
                text(row.distance_m),
                text(row.edge_width_px),
                row.blurred.to_string(),
            ])?;
        }
        writer.flush()
    })
}
