//! `rowgram leaves`: each single leaf of a mask, photo or orthomosaic.

mod paint;
mod table;

use super::{print_json, segment::same_file, tau::TauArgs};
use crate::{
    error::Error,
    io::{
        FileError, images, labels, output, points,
        rasters::{self, Source},
    },
    phenotype::leaves::{self, Bridging, Leaf, Leaves, Options},
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Find each single leaf and measure it
///
/// Slices across the leaves (stroke width transform) are merged into segments, and segments that face
/// each other across a gap into leaves. One leaf is one label. Takes a mask (two values), or a photo or
/// orthomosaic, which is segmented by --tau first. TIFF and GeoTIFF, PNG, JPEG.
///
/// The output's ending says what it is: .csv, a table; .gpkg (GeoPackage, for QGIS) or .geojson, axes with the same
/// columns; a GeoPackage also has the layer "plants" where --plants are given. Traits are in
/// metres too where the raster has a ground sampling distance (or --gsd gives it), else in pixels only.
/// GeoJSON coordinates are in the raster's own CRS, which the file names; without one they are pixels.
///
/// Angles are written as pi/5, 36deg or in radians.
///
/// Example: rowgram leaves ortho.tif -o leaves.gpkg --labels labels.tif --overlay seen.png
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Mask, photo or orthomosaic.
    image: PathBuf,
    /// Where to write the leaves (.gpkg, .geojson or .csv).
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Write one label per leaf, 0 elsewhere, as a GeoTIFF.
    #[arg(long, value_name = "TIF")]
    labels: Option<PathBuf>,
    /// Draw the leaves with their axes, as a PNG.
    #[arg(long, value_name = "PNG")]
    overlay: Option<PathBuf>,
    /// Plant positions (CSV, u_px,v_px): leaves are assigned to plants.
    #[arg(long, value_name = "CSV")]
    plants: Option<PathBuf>,
    /// With --plants: write the plants with their number of leaves.
    #[arg(long, value_name = "CSV", requires = "plants")]
    per_plant: Option<PathBuf>,
    /// Ground sampling distance, metres per pixel, where the raster does not tell.
    #[arg(long, value_name = "M")]
    gsd: Option<f64>,
    #[command(flatten)]
    tau: TauArgs,
    #[command(flatten)]
    how: How,
    /// Print a summary as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method")]
struct How {
    /// How far the gradients at the two ends of a slice may be from opposite.
    #[arg(long, value_name = "ANGLE", default_value = "pi/5", value_parser = angle)]
    ta: f64,
    /// How far the directions of adjacent slices may differ.
    #[arg(long, value_name = "ANGLE", default_value = "pi/8", value_parser = angle)]
    tb: f64,
    /// How far the directions on both sides of a gap may differ.
    #[arg(long, value_name = "ANGLE", default_value = "pi/6", value_parser = angle)]
    tc: f64,
    /// How gaps are bridged: all at once (global), the shortest first (greedy), or not at all (none).
    #[arg(long, value_name = "HOW", default_value = "global", value_parser = bridging)]
    bridging: Bridging,
    /// Do not count how much a bridge bends.
    #[arg(long)]
    no_curvature: bool,
    /// Do not split segments by their width.
    #[arg(long)]
    no_split: bool,
    /// The paper's method alone: greedy, without curvature and splitting.
    #[arg(long, conflicts_with_all = ["bridging", "no_curvature", "no_split"])]
    paper: bool,
    /// Usual width of a leaf, pixels; found from the mask where it is not given.
    #[arg(long, value_name = "PX")]
    leaf_width: Option<f64>,
    /// Leave out leaves of fewer pixels.
    #[arg(long, value_name = "N", default_value_t = 1)]
    min_pixels: usize,
}

/// An angle as a person writes it, radians.
fn angle(text: &str) -> Result<f64, String> {
    let number = |text: &str| text.trim().parse::<f64>().ok();
    let text = text.trim();
    let value = if let Some(degrees) = text.strip_suffix("deg") {
        number(degrees).map(f64::to_radians)
    } else if let Some((before, after)) = text.split_once("pi") {
        let factor = match before.trim().trim_end_matches('*') {
            "" => Some(1.0),
            factor => number(factor),
        };
        let divisor = match after.trim().strip_prefix('/') {
            None if after.trim().is_empty() => Some(1.0),
            None => None,
            Some(divisor) => number(divisor),
        };
        factor.zip(divisor).map(|(factor, divisor)| factor * std::f64::consts::PI / divisor)
    } else {
        number(text)
    };
    value.filter(|v| (0.0..=std::f64::consts::PI).contains(v)).ok_or_else(|| {
        "expected an angle from 0 to a half turn, such as pi/5, 36deg or 0.63".to_owned()
    })
}

fn bridging(text: &str) -> Result<Bridging, String> {
    match text {
        "none" => Ok(Bridging::None),
        "greedy" => Ok(Bridging::Greedy),
        "global" => Ok(Bridging::Global),
        _ => Err("expected one of: global, greedy, none".to_owned()),
    }
}

impl How {
    fn options(&self) -> Result<Options, Error> {
        if let Some(width) = self.leaf_width.filter(|width| !(0.5..=1e4).contains(width)) {
            return Err(Error::Argument(format!(
                "--leaf-width is {width}, expected pixels from 0.5 to 10000"
            )));
        }
        let base = if self.paper { Options::paper() } else { Options::default() };
        let chosen = if self.paper {
            base
        } else {
            Options {
                bridging: self.bridging,
                curvature: !self.no_curvature,
                split: !self.no_split,
                ..base
            }
        };
        Ok(Options {
            t_a: self.ta,
            t_b: self.tb,
            t_c: self.tc,
            leaf_width_px: self.leaf_width,
            min_pixels: self.min_pixels,
            ..chosen
        })
    }
}

/// What `--json` prints.
#[derive(Serialize)]
struct Summary<'a> {
    image: &'a Path,
    output: &'a Path,
    width_px: usize,
    height_px: usize,
    gsd_m: Option<f64>,
    leaves: usize,
    plant_pixels: usize,
    usual_width_px: f64,
    median_length_px: Option<f64>,
    median_length_m: Option<f64>,
    plants: Option<usize>,
    leaves_without_plant: Option<usize>,
}

/// Runs the verb.
///
/// # Errors
/// Where an argument, an input or an output path cannot be used, or writing fails.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = args.how.options()?;
    check(args)?;
    let source = Source::open(&args.image)?;
    let tau = args.tau.of(&source)?;
    let mask = source.mask(|photo| tau.mask(photo))?;
    let georeference = source.georeference();
    let gsd_m = args.gsd.or_else(|| georeference.and_then(|place| place.gsd_m()));
    if gsd_m.is_none() {
        tracing::warn!(
            "{}: no ground sampling distance in metres; traits are in pixels (give --gsd)",
            args.image.display()
        );
    }
    let found = leaves::find(&mask, &options);
    if found.leaves.is_empty() {
        tracing::warn!("{}: no pixel is plant; there is no leaf", args.image.display());
    }
    let hues = if source.is_photo() { Some(table::hues(&source, &found.leaves)?) } else { None };
    let plants = args.plants.as_deref().map(points::read).transpose()?;
    let owners = plants.as_ref().map(|plants| leaves::assign(&found, plants));
    let rows = table::Rows {
        leaves: &found.leaves,
        hues: hues.as_deref(),
        owners: owners.as_deref(),
        gsd_m,
        georeference,
    };
    if ends(&args.output, "gpkg") {
        rows.write_gpkg(&args.output, args.force, plants.as_deref())?;
    } else if ends(&args.output, "geojson") {
        rows.write_geojson(&args.output, args.force)?;
    } else {
        rows.write_csv(&args.output, args.force)?;
    }
    if let Some(path) = &args.labels {
        let sets: Vec<_> = found.leaves.iter().map(|leaf| leaf.runs.as_slice()).collect();
        labels::write(path, args.force, source.size(), georeference, &sets)?;
    }
    if let Some(path) = &args.overlay {
        let mut picture = source.rgb(0..mask.height)?;
        paint::leaves(&mut picture, &found.leaves);
        images::write_photo(path, args.force, &picture)?;
    }
    if let (Some(path), Some(plants), Some(owners)) = (&args.per_plant, &plants, &owners) {
        table::write_plants(path, args.force, plants, owners)?;
    }
    let length_px = median(&found);
    let summary = Summary {
        image: &args.image,
        output: &args.output,
        width_px: mask.width,
        height_px: mask.height,
        gsd_m,
        leaves: found.leaves.len(),
        plant_pixels: mask.count(),
        usual_width_px: found.usual_width_px,
        median_length_px: length_px,
        median_length_m: length_px.zip(gsd_m).map(|(length, gsd)| length * gsd),
        plants: plants.as_ref().map(Vec::len),
        leaves_without_plant: owners
            .as_ref()
            .map(|owners| owners.iter().filter(|owner| owner.is_none()).count()),
    };
    if args.json {
        return print_json(&summary);
    }
    let length = match (length_px, gsd_m) {
        (Some(px), Some(gsd)) => format!(", median length {:.3} m", px * gsd),
        (Some(px), None) => format!(", median length {px:.1} pixels"),
        (None, _) => String::new(),
    };
    tracing::info!("{}: {} leaves{length}", args.output.display(), summary.leaves);
    Ok(())
}

fn median(found: &Leaves) -> Option<f64> {
    let mut lengths: Vec<f64> = found.leaves.iter().map(|leaf: &Leaf| leaf.length_px).collect();
    lengths.sort_by(f64::total_cmp);
    lengths.get(lengths.len() / 2).copied()
}

fn ends(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case(ending))
}

/// Refuses what would fail, or destroy an input, after the work is done.
fn check(args: &Args) -> Result<(), Error> {
    if let Some(gsd) = args.gsd.filter(|gsd| !(1e-5..=100.0).contains(gsd)) {
        return Err(Error::Argument(format!(
            "--gsd is {gsd}, expected metres per pixel from 0.00001 to 100"
        )));
    }
    if !["gpkg", "geojson", "csv"].iter().any(|ending| ends(&args.output, ending)) {
        return Err(Error::Argument(format!(
            "{}: expected a name that ends in .gpkg, .geojson or .csv",
            args.output.display()
        )));
    }
    if let Some(path) = args.labels.as_ref().filter(|path| !rasters::is_tiff_name(path)) {
        return Err(Error::Argument(format!(
            "{}: expected a name that ends in .tif",
            path.display()
        )));
    }
    if let Some(path) = args.overlay.as_ref().filter(|path| !ends(path, "png")) {
        return Err(Error::Argument(format!(
            "{}: expected a name that ends in .png",
            path.display()
        )));
    }
    let outputs =
        [Some(&args.output), args.labels.as_ref(), args.overlay.as_ref(), args.per_plant.as_ref()];
    let inputs = [Some(&args.image), args.plants.as_ref()];
    check_paths(
        &outputs.into_iter().flatten().map(PathBuf::as_path).collect::<Vec<_>>(),
        &inputs.into_iter().flatten().map(PathBuf::as_path).collect::<Vec<_>>(),
        args.force,
    )
}

/// Refuses outputs that are inputs, are given twice, or cannot be written.
pub(super) fn check_paths(outputs: &[&Path], inputs: &[&Path], force: bool) -> Result<(), Error> {
    for (index, path) in outputs.iter().enumerate() {
        let shown = path.display();
        if inputs.iter().any(|input| same_file(path, input)) {
            return Err(Error::Argument(format!("{shown} is an input, expected another output")));
        }
        if outputs[..index].iter().any(|other| same_file(path, other)) {
            return Err(Error::Argument(format!("{shown} is given for two outputs")));
        }
        output::check(path, force)?;
    }
    for input in inputs {
        if input.is_dir() {
            let source = std::io::Error::new(std::io::ErrorKind::IsADirectory, "it is a folder");
            return Err(FileError::read(input, source).into());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_read_as_people_write_them() {
        let pi = std::f64::consts::PI;
        for (text, value) in [
            ("pi/5", pi / 5.0),
            ("pi", pi),
            ("2*pi/7", 2.0 * pi / 7.0),
            ("0.5pi", pi / 2.0),
            ("36deg", pi / 5.0),
            (" 0.25 ", 0.25),
            ("0", 0.0),
        ] {
            assert!((angle(text).unwrap() - value).abs() < 1e-12, "{text}");
        }
        for text in ["", "pi/", "pi/0", "4", "-0.1", "pi5", "deg", "nan", "x*pi"] {
            assert!(angle(text).is_err(), "{text}");
        }
    }
}
