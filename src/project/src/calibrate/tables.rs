//! What a calibration found, for programs and in tables.

use super::{Calibration, PhotoStatus, photos};
use rowgram_base::error::Error;
use rowgram_files::{
    corners,
    csv_table::{CsvWriter, as_cell},
};
use rowgram_optim::output::{self, FileError};
use rowgram_survey::{
    camera::Model,
    problems::calibration::{
        comparison::{BoardBend, ModelFit},
        residuals::{CornerResidual, distortion_curve, principal_point_px, rings},
        statistics::{ParameterStatistics, residuals},
    },
    target::Board,
};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What became of a photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotoOutcome {
    /// Its name.
    pub image: String,
    /// Whether it took part.
    #[serde(flatten)]
    pub status: PhotoStatus,
    /// Corners found in it.
    pub corners: usize,
    /// Root mean square of the distances between corners and projections, pixels.
    pub rms_px: Option<f64>,
    /// The largest such distance, pixels.
    pub largest_px: Option<f64>,
    /// The angle between the board and the image plane, degrees.
    pub tilt_deg: Option<f64>,
    /// Distance of the board's first corner from the camera, metres.
    pub distance_m: Option<f64>,
    /// Width of the board's edges, pixels, where the photo was looked at.
    pub edge_width_px: Option<f64>,
    /// Whether its edges are much wider than those of the others.
    pub blurred: bool,
}

/// What came of a calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrateOutcome {
    /// The lens model.
    pub lens: Model,
    /// Width and height of the photos, pixels.
    pub size_px: [u32; 2],
    /// The board.
    pub board: Board,
    /// Side of a square, metres.
    pub square_m: f64,
    /// All photos.
    pub photos: Vec<PhotoOutcome>,
    /// Number of photos that took part.
    pub photos_used: usize,
    /// Number of corners that took part.
    pub corners: usize,
    /// Iterations of the final adjustment.
    pub iterations: u64,
    /// Whether it converged.
    pub converged: bool,
    /// Observations: two for each corner of each photo.
    pub observations: usize,
    /// Unknowns.
    pub unknowns: usize,
    /// Root mean square of the distances between corners and projections, pixels.
    pub rms_px: f64,
    /// Standard deviation of one coordinate of a corner, pixels.
    pub sigma0_px: f64,
    /// The parameters of the lens model.
    pub parameters: Vec<ParameterStatistics>,
    /// Names of the free ones, in the order of `correlation`.
    pub free: Vec<String>,
    /// Their correlation matrix, row by row.
    pub correlation: Vec<Vec<f64>>,
    /// The lens model that describes the corners best by Bayes' criterion.
    pub best_model: Option<Model>,
    /// Lens models on the same corners, the best first.
    pub models: Vec<ModelFit>,
    /// Whether the board is flat, where that can be tested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub board_bend: Option<BoardBend>,
    /// Height of each corner of the board and its standard deviation, metres, where they were estimated.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub board_heights_m: Vec<[f64; 2]>,
}

impl CalibrateOutcome {
    /// Of a calibration.
    pub fn of(calibration: &Calibration) -> CalibrateOutcome {
        let found = &calibration.statistics;
        CalibrateOutcome {
            lens: calibration.request.model,
            size_px: calibration.request.size_px,
            board: calibration.board,
            square_m: calibration.square_m,
            photos: photo_rows(calibration),
            photos_used: calibration.used.len(),
            corners: found.observations / 2,
            iterations: calibration.solution.iterations,
            converged: calibration.solution.stop.converged(),
            observations: found.observations,
            unknowns: found.unknowns,
            rms_px: found.rms_px,
            sigma0_px: found.sigma0_px,
            parameters: found.parameters.clone(),
            free: found.free.iter().map(|name| name.clone().into_owned()).collect(),
            correlation: found.correlation.clone(),
            best_model: calibration.models.first().map(|row| row.lens),
            models: calibration.models.clone(),
            board_bend: calibration.bend,
            board_heights_m: found.heights_m.clone(),
        }
    }
}

fn photo_rows(outcome: &Calibration) -> Vec<PhotoOutcome> {
    outcome
        .photos
        .iter()
        .enumerate()
        .map(|(k, photo)| {
            let place = outcome.used.iter().position(|&used| used == k);
            let view = place.map(|place| &outcome.statistics.views[place]);
            PhotoOutcome {
                image: photo.name.clone(),
                status: photo.status.clone(),
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

/// Writes `calibration.json` and all tables.
///
/// # Errors
/// Where the folder or a file cannot be written.
pub(super) fn write(folder: &Path, force: bool, outcome: &Calibration) -> Result<(), Error> {
    let path = |name: &str| folder.join(name);
    let report = serde_json::to_string_pretty(&CalibrateOutcome::of(outcome))
        .map_err(|e| FileError::write(&path("calibration.json"), std::io::Error::other(e)))?;
    output::write(&path("calibration.json"), force, |out| writeln!(out, "{report}"))?;
    let found = &outcome.statistics;
    table(&path("parameters.csv"), force, &found.parameters)?;
    output::write(&path("correlation.csv"), force, |out| {
        writeln!(out, "parameter,{}", found.free.join(","))?;
        for (name, row) in found.free.iter().zip(&found.correlation) {
            let row: Vec<String> = row.iter().map(f64::to_string).collect();
            writeln!(out, "{name},{}", row.join(","))?;
        }
        Ok(())
    })?;
    photo_table(&path("photos.csv"), force, outcome)?;
    corners::write(&path("corners.csv"), force, &photos::corner_table(&outcome.photos))?;
    table(&path("models.csv"), force, &outcome.models)?;
    let rows = residual_rows(outcome)?;
    residual_table(&path("residuals.csv"), force, &rows)?;
    let all: Vec<CornerResidual> = rows.iter().map(|row| row.residual).collect();
    table(&path("residuals_by_radius.csv"), force, &rings(&all))?;
    let curve = distortion_curve(&outcome.solution.state.interior);
    table(&path("distortion.csv"), force, &curve)?;
    if !found.heights_m.is_empty() {
        output::write(&path("board.csv"), force, |out| {
            writeln!(out, "column,row,height_m,standard_deviation_m")?;
            let board = outcome.board;
            let stride = board.columns.max(board.rows);
            for (corner, [height, sigma]) in found.heights_m.iter().enumerate() {
                let (column, row) = (corner % stride, corner / stride);
                if column < board.columns && row < board.rows {
                    writeln!(out, "{column},{row},{height},{sigma}")?;
                }
            }
            Ok(())
        })?;
    }
    Ok(())
}

/// The residual of a corner of a photo.
pub(super) struct ResidualRow<'a> {
    image: &'a str,
    column: usize,
    row: usize,
    pub(super) residual: CornerResidual,
}

/// The residuals of all corners that took part.
///
/// # Errors
/// Where a corner has no projection.
pub(super) fn residual_rows(outcome: &Calibration) -> Result<Vec<ResidualRow<'_>>, Error> {
    let all = residuals(&outcome.views, &outcome.solution.state)?;
    let centre_px = principal_point_px(&outcome.solution.state.interior);
    let mut rows = Vec::new();
    for (&photo, residuals) in outcome.used.iter().zip(&all) {
        let photo = &outcome.photos[photo];
        for (corner, &residual_px) in photo.corners.iter().zip(residuals) {
            rows.push(ResidualRow {
                image: &photo.name,
                column: corner.column,
                row: corner.row,
                residual: CornerResidual::new(corner.image_px, residual_px, centre_px),
            });
        }
    }
    Ok(rows)
}

fn residual_table(path: &Path, force: bool, rows: &[ResidualRow<'_>]) -> Result<(), FileError> {
    output::write(path, force, |out| {
        writeln!(out, "image,column,row,u_px,v_px,du_px,dv_px,radius_px,radial_px,tangential_px")?;
        let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(out);
        for row in rows {
            let fields = (as_cell(row.image), row.column, row.row, row.residual);
            writer.serialize(fields).map_err(std::io::Error::other)?;
        }
        writer.flush()
    })
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

fn photo_table(path: &Path, force: bool, outcome: &Calibration) -> Result<(), FileError> {
    output::write(path, force, |out| {
        let mut writer = CsvWriter::new(out);
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
                row.image.clone(),
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
