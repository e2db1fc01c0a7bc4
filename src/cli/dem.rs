//! `rowgram dem`: a surface from the points of a block.

use super::ortho::{
    figures,
    project::{Block, Input},
};
use crate::{
    error::Error,
    io::{
        FileError,
        geotiff::{self, Colour, Layout, TILE},
        images, output,
    },
    mapping::{
        Surface,
        dem::{Account, Cloud, Options},
        ground,
        surface::Heights,
    },
    raster::{
        georeference::{Crs, Georeference},
        window,
    },
};
use serde::Serialize;
use std::{
    path::{Path, PathBuf},
    time::Instant,
};

/// Make a digital elevation model from a sparse cloud
///
/// Points that do not fit their neighbours are left out; the rest is triangulated (Delaunay) and interpolated by
/// natural neighbours. Where there are no points there is no height. Writes a tiled GeoTIFF of heights in metres
/// (OUTPUT, nodata -9999) and OUTPUT_sigma.tif, what the points' standard deviations leave of uncertainty.
///
/// With --ground also OUTPUT_ground.tif: the ground under plants, the lower envelope of the points with as few
/// breaks as they allow.
///
/// Examples:
///   rowgram dem field
///   rowgram dem field --cell 0.1 --ground --figures pictures
///   rowgram dem --points points.csv --epsg 32616 -o dem.tif
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    input: Input,
    /// The surface [default: PROJECT/rowgram/dem.tif].
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Side of a cell, metres [default: half the median distance of neighbouring points].
    #[arg(long, value_name = "M")]
    cell: Option<f64>,
    /// Points further off their neighbours' plane than so many times the usual distance are left out.
    #[arg(long, value_name = "TIMES", default_value_t = 5.0)]
    outlier: f64,
    /// The longest side of a triangle that is filled, metres [default: 30 median distances].
    #[arg(long, value_name = "M")]
    gap: Option<f64>,
    /// Also the ground under plants.
    #[arg(long)]
    ground: bool,
    /// Side of the ground's cells, metres: larger than a plant.
    #[arg(long, value_name = "M", default_value_t = 1.0)]
    ground_cell: f64,
    /// Share of the points that noise puts below the ground.
    #[arg(long, value_name = "SHARE", default_value_t = 0.1)]
    ground_quantile: f64,
    /// What a break of the ground costs, in points.
    #[arg(long, value_name = "POINTS", default_value_t = 2.0)]
    ground_smoothness: f64,
    /// Folder for pictures: hillshade, sigma; with CSV.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Print what was done as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

/// What stands for no height: finite, so that every program takes it.
const NODATA: f32 = -9999.0;

#[derive(Serialize)]
struct Report<'a> {
    output: String,
    width_px: usize,
    height_px: usize,
    cell_m: f64,
    epsg: Option<u32>,
    vertical_epsg: Option<u32>,
    #[serde(flatten)]
    account: &'a Account,
    outlier_count: usize,
    cells_with_height: usize,
    least_m: f64,
    greatest_m: f64,
    median_sigma_m: Option<f64>,
    seconds: f64,
}

/// Runs the verb.
///
/// # Errors
/// No points, numbers that make no sense, outputs that cannot be written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let started = Instant::now();
    for (name, value) in [
        ("cell", args.cell),
        ("gap", args.gap),
        ("outlier", Some(args.outlier)),
        ("ground-cell", Some(args.ground_cell)),
        ("ground-smoothness", Some(args.ground_smoothness)),
    ] {
        if let Some(value) = value.filter(|value| !(value.is_finite() && *value > 0.0)) {
            return Err(Error::Argument(format!("--{name} {value}: expected a positive number")));
        }
    }
    if !(args.ground_quantile > 0.0 && args.ground_quantile < 1.0) {
        return Err(Error::Argument(format!(
            "--ground-quantile {}: expected a share between 0 and 1",
            args.ground_quantile
        )));
    }
    let Block { points, crs, .. } = args.input.block()?;
    if points.is_empty() {
        return Err(Error::Argument(
            "there are no points: run rowgram align first, or give --model or --points".into(),
        ));
    }
    let output = args.input.output(args.output.as_deref(), "dem.tif")?;
    let (sigma_path, ground_path) = (beside(&output, "sigma"), beside(&output, "ground"));
    output::check(&output, args.force)?;
    output::check(&sigma_path, args.force)?;
    if args.ground {
        output::check(&ground_path, args.force)?;
    }
    let options = Options { outlier: args.outlier, largest_gap_m: args.gap };
    let cloud = Cloud::new(&points, &options)?;
    let cell_m = args.cell.unwrap_or_else(|| two_digits(0.5 * cloud.account.spacing_m));
    let (place, size) = grid(&cloud, cell_m, crs.unwrap_or(Crs::LOCAL))?;
    let (surface, sigmas) = cloud.surface(place, size)?;
    write(&output, &surface.georeference, size, &surface.heights_m, args.force)?;
    let known_sigmas = sigmas.iter().any(|sigma| sigma.is_finite());
    if known_sigmas {
        write(&sigma_path, &place, size, &sigmas, args.force)?;
    } else {
        tracing::warn!("the points have no standard deviations: no {}", sigma_path.display());
    }
    if args.ground {
        let how = ground::Options {
            cell_m: args.ground_cell,
            quantile: args.ground_quantile,
            smoothness: args.ground_smoothness,
        };
        let coarse = ground::ground(&cloud, &how, &place)?;
        // Only where there is a surface is there a ground.
        let heights: Vec<f32> = (0..size[0] * size[1])
            .map(|k| {
                let at = place.map([(k % size[0]) as f64, (k / size[0]) as f64]);
                let known = surface.heights_m[k].is_finite();
                coarse.at(at).filter(|_| known).map_or(f32::NAN, |z| z as f32)
            })
            .collect();
        write(&ground_path, &place, size, &heights, args.force)?;
        if let Some(folder) = &args.figures {
            std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
            let ground = Surface::new(place, size, heights, Heights::Bilinear)?;
            let path = folder.join("ground.png");
            images::write_photo(&path, args.force, &figures::hillshade(&ground))?;
        }
    }
    let mut known: Vec<f32> = sigmas.iter().copied().filter(|s| s.is_finite()).collect();
    known.sort_by(f32::total_cmp);
    if let Some(folder) = &args.figures {
        draw(folder, &surface, &sigmas, &known, args.force)?;
    }
    let account = &cloud.account;
    let report = Report {
        output: output.display().to_string(),
        width_px: size[0],
        height_px: size[1],
        cell_m,
        epsg: place.crs.epsg,
        vertical_epsg: place.crs.vertical_epsg,
        account,
        outlier_count: account.outliers.len(),
        cells_with_height: surface.heights_m.iter().filter(|z| z.is_finite()).count(),
        least_m: surface.range_m()[0],
        greatest_m: surface.range_m()[1],
        median_sigma_m: known.get(known.len() / 2).map(|&sigma| f64::from(sigma)),
        seconds: started.elapsed().as_secs_f64(),
    };
    if args.json {
        return super::print_json(&report);
    }
    super::print(&format!(
        "{}: {} x {} cells of {} m from {} points ({} outliers), heights {:.3} to {:.3} m",
        report.output,
        report.width_px,
        report.height_px,
        report.cell_m,
        account.points,
        report.outlier_count,
        report.least_m,
        report.greatest_m
    ))
}

fn two_digits(value: f64) -> f64 {
    format!("{value:.1e}").parse().unwrap_or(value)
}

fn beside(path: &Path, what: &str) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}_{what}.tif"))
}

fn grid(cloud: &Cloud, cell_m: f64, crs: Crs) -> Result<(Georeference, [usize; 2]), Error> {
    let [x, y] = cloud.bounds_m();
    let span = |[low, high]: [f64; 2]| {
        let first = (low / cell_m).floor();
        (first, (high / cell_m).ceil() - first)
    };
    let ((left, columns), (bottom, rows)) = (span(x), span(y));
    if columns * rows > 4e8 {
        return Err(Error::Argument(format!(
            "the surface would have {columns:.0} x {rows:.0} cells of {cell_m} m; give a larger --cell"
        )));
    }
    let origin = [(left + 0.5) * cell_m, (bottom + rows - 0.5) * cell_m];
    let size = [columns.max(1.0) as usize, rows.max(1.0) as usize];
    Ok((Georeference::north_up(origin, cell_m, crs), size))
}

/// Writes heights in metres.
fn write(
    path: &Path,
    place: &Georeference,
    [width, height]: [usize; 2],
    values: &[f32],
    force: bool,
) -> Result<(), Error> {
    let layout = Layout {
        width,
        height,
        colour: Colour::Values,
        georeference: Some(*place),
        nodata: Some(f64::from(NODATA)),
    };
    geotiff::write::<f32, Error>(path, force, &layout, |writer| {
        for band in window::bands(height, TILE, 0) {
            let rows = &values[band.rows.start * width..band.rows.end * width];
            let known: Vec<f32> =
                rows.iter().map(|&z| if z.is_finite() { z } else { NODATA }).collect();
            writer.put(window::Window::rows(width, band.rows), &known)?;
        }
        Ok(())
    })
}

fn draw(
    folder: &Path,
    surface: &Surface,
    sigmas: &[f32],
    known: &[f32],
    force: bool,
) -> Result<(), Error> {
    std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
    images::write_photo(&folder.join("hillshade.png"), force, &figures::hillshade(surface))?;
    let size = [surface.width, surface.height];
    if !known.is_empty() {
        let at = |share: f64| f64::from(known[((known.len() - 1) as f64 * share) as usize]);
        let picture = figures::values(size, sigmas, [0.0, at(0.95)]);
        images::write_photo(&folder.join("sigma.png"), force, &picture)?;
    }
    output::write(&folder.join("heights.csv"), force, |out| {
        writeln!(out, "share_of_cells,height_m,sigma_m")?;
        let mut heights: Vec<f32> =
            surface.heights_m.iter().copied().filter(|z| z.is_finite()).collect();
        heights.sort_by(f32::total_cmp);
        for percent in (0..=100).step_by(5) {
            let of = |values: &[f32]| {
                let at = (values.len().saturating_sub(1)) * percent / 100;
                values.get(at).map_or(String::new(), |value| format!("{value:.4}"))
            };
            writeln!(out, "{:.2},{},{}", percent as f64 / 100.0, of(&heights), of(known))?;
        }
        Ok(())
    })?;
    Ok(())
}
