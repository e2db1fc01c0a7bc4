//! `rowgram segment`: the leaf mask of a photo or orthomosaic.

use super::{print_json, tau::TauArgs};
use crate::{
    error::Error,
    io::{
        FileError, images, output,
        rasters::{self, Source},
    },
    raster::{
        components,
        mask::Thresholds,
        overlay,
        white_balance::{Channels, Gains, WhiteBalance},
        window,
    },
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Find the plant pixels of a photo by their colour
///
/// Writes a PNG or GeoTIFF of the photo's size, 255 where plants are and 0 elsewhere. A pixel is plant where
/// its hue is from TAU1 to TAU2 and its saturation is at least TAU3 or its value at least TAU4, in
/// OpenCV's 8-bit HSV (hue 0 to 180, the others 0 to 255).
///
/// A (Geo)TIFF in colours is read by bands of rows: only the mask is held in memory, a byte per pixel.
///
/// Example: rowgram segment plot.jpg --tau 30,79,30,163 -o mask.png --overlay seen.png
/// Example: rowgram segment ortho.tif -o mask.tif
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// The photo (PNG, JPEG or TIFF).
    image: PathBuf,
    #[command(flatten)]
    tau: TauArgs,
    /// Where to write the mask (.png, or .tif for a GeoTIFF).
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Also write the photo with the mask drawn over it.
    #[arg(long, value_name = "PNG")]
    overlay: Option<PathBuf>,
    /// Scale the channels first so that the photo's mean is grey ("grey-world"), or its brightest
    /// colours white ("white-patch").
    #[arg(long, value_name = "HOW")]
    white_balance: Option<WhiteBalance>,
    /// Remove connected plant pixels that are fewer than this.
    #[arg(long, value_name = "N", default_value_t = 0)]
    min_pixels: usize,
    /// Fill holes of at most this many pixels inside plants, after the removal.
    #[arg(long, value_name = "N", default_value_t = 0)]
    fill_holes: usize,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print what was found as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Summary<'a> {
    image: &'a Path,
    output: &'a Path,
    width_px: usize,
    height_px: usize,
    thresholds: Thresholds,
    plant_pixels: usize,
    plant_share: f64,
    components: usize,
    removed_components: usize,
    removed_pixels: usize,
    filled_holes: usize,
    filled_pixels: usize,
}

/// Runs the verb.
///
/// # Errors
/// Where an argument, the photo or an output path cannot be used, or writing fails.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    check_outputs(args)?;
    let source = open(&args.image)?;
    let gains = args.white_balance.map(|how| gains(&source, how)).transpose()?;
    let thresholds = args.tau.with(&source, |photo| {
        if let Some(gains) = gains {
            *photo = gains.applied(photo);
        }
    })?;
    let mut mask = source.mask(|photo| match gains {
        None => thresholds.mask(photo),
        Some(gains) => thresholds.mask(&gains.applied(photo)),
    })?;
    let removed = components::remove_small(&mut mask, args.min_pixels);
    let filled = components::fill_holes(&mut mask, args.fill_holes);
    let plant_pixels = mask.count();
    if plant_pixels == 0 {
        tracing::warn!("{}: no pixel is plant; the mask is empty", args.image.display());
    }
    rasters::write_mask(&args.output, args.force, &mask, source.georeference())?;
    if let Some(path) = &args.overlay {
        let mut photo = source.rgb(0..mask.height)?;
        overlay::draw_mask(&mut photo, &mask, overlay::MASK_COLOUR)?;
        images::write_photo(path, args.force, &photo)?;
    }
    let summary = Summary {
        image: &args.image,
        output: &args.output,
        width_px: mask.width,
        height_px: mask.height,
        thresholds,
        plant_pixels,
        plant_share: plant_pixels as f64 / mask.data.len() as f64,
        components: components::count(&mask),
        removed_components: removed.components,
        removed_pixels: removed.pixels,
        filled_holes: filled.components,
        filled_pixels: filled.pixels,
    };
    if args.json {
        return print_json(&summary);
    }
    tracing::info!(
        "{}: {plant_pixels} of {} pixels are plant ({:.2} %), in {} components",
        args.output.display(),
        mask.data.len(),
        100.0 * summary.plant_share,
        summary.components
    );
    Ok(())
}

/// Opens what is to be segmented: anything but a mask.
fn open(path: &Path) -> Result<Source, FileError> {
    let source = Source::open(path)?;
    // A grey TIFF may be a photo or a mask; which of them takes a look at all of it.
    let mask = match &source {
        Source::Picture(_) => !source.is_photo(),
        Source::File(_) if source.is_photo() => false,
        Source::File(_) => {
            return images::read_photo(path)
                .map(|photo| Source::Picture(images::Picture::Photo(photo)));
        }
    };
    if mask {
        let message = "it holds a mask (two values), expected a photo";
        return Err(FileError::malformed(path, None, message));
    }
    Ok(source)
}

/// The gains of the channels, from all of the photo.
fn gains(source: &Source, how: WhiteBalance) -> Result<Gains, FileError> {
    let (_, height) = source.size();
    let mut histogram = Channels::default();
    for band in window::bands(height, rasters::BAND_ROWS, 0) {
        histogram.add(&source.rgb(band.rows)?);
    }
    Ok(histogram.gains(how))
}

/// Refuses what would fail, or destroy an input, after the work is done.
fn check_outputs(args: &Args) -> Result<(), Error> {
    let outputs: Vec<&Path> =
        [Some(&args.output), args.overlay.as_ref()].into_iter().flatten().map(|p| &**p).collect();
    for (index, path) in outputs.iter().enumerate() {
        let is_png = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("png"));
        let is_tiff = index == 0 && rasters::is_tiff_name(path);
        if !is_png && !is_tiff {
            let path = path.display();
            let expected = if index == 0 { ".png or .tif" } else { ".png" };
            return Err(Error::Argument(format!(
                "{path}: expected a name that ends in {expected}"
            )));
        }
        if same_file(path, &args.image) {
            let path = path.display();
            return Err(Error::Argument(format!("{path} is the photo, expected another output")));
        }
        if outputs[..index].iter().any(|other| same_file(path, other)) {
            let path = path.display();
            return Err(Error::Argument(format!("{path} is given for two outputs")));
        }
        output::check(path, args.force)?;
    }
    if args.image.is_dir() {
        let source = std::io::Error::new(std::io::ErrorKind::IsADirectory, "it is a folder");
        return Err(FileError::read(&args.image, source).into());
    }
    Ok(())
}

/// Whether two paths lead to the same file, through whatever links; the files need not exist yet.
pub(super) fn same_file(one: &Path, other: &Path) -> bool {
    let resolved = |path: &Path| {
        path.canonicalize().or_else(|error| {
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
            let folder = folder.unwrap_or(Path::new(".")).canonicalize()?;
            path.file_name().map(|name| folder.join(name)).ok_or(error)
        })
    };
    match (resolved(one), resolved(other)) {
        (Ok(one), Ok(other)) => one == other,
        _ => one == other,
    }
}
