//! `rowgram density`: how many plant pixels lie around each pixel.

use super::{leaves::check_paths, print_json, tau::TauArgs};
use crate::{
    error::Error,
    io::{
        FileError,
        geotiff::{self, Colour, Layout},
        images,
        rasters::{Source, is_tiff_name},
    },
    raster::{
        Mask, density,
        window::{self, Window},
    },
};
use image::{Rgb, RgbImage};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Map the local density of plants
///
/// For each pixel the number of plant pixels in a square window around it, as a GeoTIFF of whole numbers and a
/// picture. Beyond the border there is no plant. Takes a mask (two values), or a photo or orthomosaic,
/// which is segmented by --tau first.
///
/// Example: rowgram density ortho.tif --window 41 -o density.tif --picture density.png
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Mask, photo or orthomosaic.
    image: PathBuf,
    /// Where to write the density (GeoTIFF).
    #[arg(short, long, value_name = "TIF")]
    output: PathBuf,
    /// Also draw it, dark blue (none) to yellow (the most there is), at most 4096 pixels a side.
    #[arg(long, value_name = "PNG")]
    picture: Option<PathBuf>,
    /// Side of the window, an odd number of pixels.
    #[arg(long, value_name = "PX", default_value_t = 41)]
    window: usize,
    #[command(flatten)]
    tau: TauArgs,
    /// Print a summary as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct Summary<'a> {
    image: &'a Path,
    output: &'a Path,
    width_px: usize,
    height_px: usize,
    window_px: usize,
    plant_pixels: usize,
    largest: u32,
    mean: f64,
}

/// Longest side of the picture, pixels.
const PICTURE_PX: usize = 4096;
/// Largest window: its pixels must be counted in 32 bits.
const LARGEST_PX: usize = 65_535;

/// Runs the verb.
///
/// # Errors
/// Where an argument, an input or an output cannot be used.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let half = density::half_window(args.window)
        .map_err(|error| Error::Argument(format!("--window: {error}")))?;
    if args.window > LARGEST_PX {
        return Err(Error::Argument(format!("--window: expected at most {LARGEST_PX} pixels")));
    }
    if !is_tiff_name(&args.output) {
        return Err(Error::Argument(format!(
            "{}: expected a name that ends in .tif",
            args.output.display()
        )));
    }
    let outputs = [Some(&args.output), args.picture.as_ref()];
    let outputs: Vec<&Path> = outputs.into_iter().flatten().map(PathBuf::as_path).collect();
    check_paths(&outputs, &[&args.image], args.force)?;
    let source = Source::open(&args.image)?;
    let tau = args.tau.of(&source)?;
    let mask = source.mask(|photo| tau.mask(photo))?;
    let layout = Layout {
        width: mask.width,
        height: mask.height,
        colour: Colour::Values,
        georeference: source.georeference(),
        nodata: None,
    };
    let (mut largest, mut sum) = (0, 0.0);
    geotiff::write::<u32, FileError>(&args.output, args.force, &layout, |writer| {
        for band in window::bands(mask.height, geotiff::TILE, half) {
            let counts = density::rows(&mask, half, band.rows.clone());
            largest = counts.iter().copied().max().unwrap_or(0).max(largest);
            sum += counts.iter().map(|&count| f64::from(count)).sum::<f64>();
            writer.put(Window::rows(mask.width, band.rows), &counts)?;
        }
        Ok(())
    })?;
    if let Some(path) = &args.picture {
        images::write_photo(path, args.force, &picture(&mask, half, largest))?;
    }
    let summary = Summary {
        image: &args.image,
        output: &args.output,
        width_px: mask.width,
        height_px: mask.height,
        window_px: args.window,
        plant_pixels: mask.count(),
        largest,
        mean: sum / mask.data.len().max(1) as f64,
    };
    if args.json {
        return print_json(&summary);
    }
    tracing::info!(
        "{}: at most {largest}, on average {:.1} of {} pixels around a pixel are plant",
        args.output.display(),
        summary.mean,
        args.window * args.window
    );
    Ok(())
}

/// The density in colours, every so many pixels.
fn picture(mask: &Mask, half: usize, largest: u32) -> RgbImage {
    let step = mask.width.max(mask.height).div_ceil(PICTURE_PX).max(1);
    let (width, height) = (mask.width.div_ceil(step), mask.height.div_ceil(step));
    let mut picture = RgbImage::new(width as u32, height as u32);
    for band in window::bands(mask.height, geotiff::TILE, half) {
        let counts = density::rows(mask, half, band.rows.clone());
        for v in band.rows.clone().filter(|v| v.is_multiple_of(step)) {
            let row = &counts[(v - band.rows.start) * mask.width..][..mask.width];
            for (u, &count) in row.iter().step_by(step).enumerate() {
                let share = f64::from(count) / f64::from(largest.max(1));
                picture.put_pixel(u as u32, (v / step) as u32, Rgb(density::colour(share)));
            }
        }
    }
    picture
}
