//! `rowgram count`: leaves from the area that they cover.

use super::{leaves::check_paths, print, print_json, tau::TauArgs};
use crate::{
    error::Error,
    io::{FileError, output, polygons, rasters::Source},
    phenotype::leaf_count::{Calibration, Count, Region},
    raster::{Mask, georeference::CrsKind, polygon::Polygon},
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Count leaves from the area that they cover
///
/// lambda = alpha / rho: alpha plant pixels, rho of them to a leaf. rho is given, or comes from regions in which
/// leaves were counted by hand (GeoJSON polygons with the property "leaves"). With three regions or more the
/// interval of 95 % tells how well they agree; else how unevenly the plot is covered.
///
/// Takes a mask (two values), or a photo or orthomosaic, which is segmented by --tau first. Polygons are in the
/// raster's CRS, or in pixels where it has none. In a photo in perspective leaves far from the camera
/// are smaller and the count is biased: use an orthomosaic.
///
/// Example: rowgram count ortho.tif --calibrate regions.geojson --plots plots.geojson -o leaves.csv
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Mask, photo or orthomosaic.
    image: PathBuf,
    /// Regions with counted leaves (GeoJSON polygons with the property "leaves").
    #[arg(long, value_name = "GEOJSON", required_unless_present = "rho", conflicts_with = "rho")]
    calibrate: Option<PathBuf>,
    /// Plant pixels per leaf.
    #[arg(long, value_name = "PIXELS", allow_negative_numbers = true)]
    rho: Option<f64>,
    /// Also count in each of these plots (GeoJSON polygons).
    #[arg(long, value_name = "GEOJSON")]
    plots: Option<PathBuf>,
    /// Write the counts to a CSV: plot, pixels, leaves, low, high, interval.
    #[arg(short, long, value_name = "CSV")]
    output: Option<PathBuf>,
    /// Side of the squares whose unevenness the interval shows, pixels.
    #[arg(long, value_name = "PX", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    square: u32,
    /// Decides the draws of the interval.
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    tau: TauArgs,
    /// Print the counts as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace an output that exists.
    #[arg(long)]
    force: bool,
}

/// One line of the result.
#[derive(Serialize)]
struct Line {
    plot: String,
    #[serde(flatten)]
    count: Count,
}

#[derive(Serialize)]
struct Summary<'a> {
    image: &'a Path,
    rho: f64,
    orthorectified: bool,
    counts: &'a [Line],
}

/// Runs the verb.
///
/// # Errors
/// Where an argument, an input or the output cannot be used.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let outputs: Vec<&Path> = args.output.iter().map(PathBuf::as_path).collect();
    let inputs = [Some(&args.image), args.calibrate.as_ref(), args.plots.as_ref()];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().map(PathBuf::as_path).collect();
    check_paths(&outputs, &inputs, args.force)?;
    let given = args.rho.map(Calibration::given).transpose();
    let given = given.map_err(|message| Error::Argument(format!("--rho: {message}")))?;
    let source = Source::open(&args.image)?;
    let tau = args.tau.of(&source)?;
    let mask = source.mask(|photo| tau.mask(photo))?;
    let place = source.georeference();
    let orthorectified = place.is_some_and(|place| place.crs.kind != CrsKind::Unknown);
    if !orthorectified {
        tracing::warn!(
            "{}: it has no place on the map, so it may not be orthorectified; where the scale varies, the \
             area of a leaf does, and the count is biased",
            args.image.display()
        );
    }
    let calibration = match (given, &args.calibrate) {
        (Some(calibration), _) => calibration,
        (None, Some(path)) => {
            let regions = regions(path, &mask, place.as_ref())?;
            Calibration::from_regions(&regions)
                .map_err(|message| FileError::malformed(path, None, message))?
        }
        (None, None) => return Err(Error::Argument("expected --calibrate or --rho".to_owned())),
    };
    let side = args.square as usize;
    let whole = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
        .map(|[u, v]| [u * mask.width as f64, v * mask.height as f64]);
    let whole = Polygon { rings: vec![whole.to_vec()] };
    let mut lines = vec![Line {
        plot: "whole".to_owned(),
        count: calibration.count(&squares(&mask, &whole, side), args.seed),
    }];
    if let Some(path) = &args.plots {
        for plot in polygons::read(path, place.as_ref())? {
            let count = calibration.count(&squares(&mask, &plot.polygon, side), args.seed);
            lines.push(Line { plot: plot.name, count });
        }
    }
    if let Some(path) = &args.output {
        write(path, args.force, &lines)?;
    }
    let rho = calibration.rho;
    if args.json {
        return print_json(&Summary { image: &args.image, rho, orthorectified, counts: &lines });
    }
    let mut text = format!(
        "{rho:.2} plant pixels per leaf\n\n{:<20} {:>12} {:>10}  95 %\n",
        "plot", "pixels", "leaves"
    );
    for Line { plot, count } in &lines {
        let interval = count.interval.map_or(String::new(), |interval| {
            format!("{:.1} to {:.1}", interval.low, interval.high)
        });
        text += &format!("{plot:<20} {:>12} {:>10.1}  {interval}\n", count.pixels, count.leaves);
    }
    print(&text)
}

/// Plant pixels and counted leaves of the calibration regions.
fn regions(
    path: &Path,
    mask: &Mask,
    place: Option<&crate::raster::georeference::Georeference>,
) -> Result<Vec<Region>, Error> {
    polygons::read(path, place)?
        .into_iter()
        .map(|region| {
            let leaves = region.leaves.ok_or_else(|| {
                let name = &region.name;
                let message =
                    format!("region {name} lacks the property leaves, its counted leaves");
                FileError::malformed(path, None, message)
            })?;
            let runs = region.polygon.runs(mask.width, mask.height);
            if runs.is_empty() {
                let message = format!("region {} holds no pixel of the raster", region.name);
                return Err(FileError::malformed(path, None, message).into());
            }
            let pixels: u64 = runs.iter().map(|(v, run)| plants(mask, *v, run.clone())).sum();
            Ok(Region { pixels: pixels as f64, leaves })
        })
        .collect()
}

fn plants(mask: &Mask, v: usize, columns: std::ops::Range<usize>) -> u64 {
    mask.row(v)[columns].iter().map(|&pixel| u64::from(pixel != 0)).sum()
}

/// The plant pixels of a polygon in squares of the raster that it touches.
fn squares(mask: &Mask, polygon: &Polygon, side: usize) -> Vec<u64> {
    let across = mask.width.div_ceil(side);
    let mut sums = vec![None; across * mask.height.div_ceil(side)];
    for (v, run) in polygon.runs(mask.width, mask.height) {
        for square in run.start / side..=(run.end - 1) / side {
            let columns = run.start.max(square * side)..run.end.min((square + 1) * side);
            *sums[v / side * across + square].get_or_insert(0) += plants(mask, v, columns);
        }
    }
    sums.into_iter().flatten().collect()
}

fn write(path: &Path, force: bool, lines: &[Line]) -> Result<(), FileError> {
    output::write(path, force, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        csv.write_record(["plot", "pixels", "leaves", "low", "high", "interval"])?;
        for Line { plot, count } in lines {
            let end = |value: fn(&crate::phenotype::leaf_count::Interval) -> f64| {
                count.interval.as_ref().map(|i| format!("{:.3}", value(i))).unwrap_or_default()
            };
            let of = count.interval.map_or("", |interval| interval.of.word());
            csv.write_record([
                plot.clone(),
                count.pixels.to_string(),
                format!("{:.3}", count.leaves),
                end(|i| i.low),
                end(|i| i.high),
                of.to_owned(),
            ])?;
        }
        csv.flush()
    })
}
