//! `rowgram undistort`: photos as a camera without distortion would have taken them.

use crate::{
    camera::Camera,
    error::Error,
    io::{FileError, camera, images},
    raster::undistort::{Crop, Interpolation, ideal_camera, undistort},
};
use clap::ValueEnum;
use rayon::prelude::*;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Remove the distortion from photos
///
/// Every photo becomes what a camera without distortion would have taken: straight lines are
/// straight. Pixels that the photo does not show are black. The folder also gets camera.toml, the
/// camera of the new photos (brown without terms, the same principal distance unless --scale).
///
/// Example: rowgram undistort photos/*.jpg --camera camera.toml -o flat --crop inside
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// The photos (PNG, JPEG or TIFF).
    #[arg(required = true, value_name = "IMAGES")]
    images: Vec<PathBuf>,
    /// Their camera.
    #[arg(long, value_name = "CAMERA.toml")]
    camera: PathBuf,
    /// Folder for the new photos, which keep their names; made if it is not there.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// What the new photos show.
    #[arg(long, value_enum, default_value_t = CropName::Same)]
    crop: CropName,
    /// New principal distance over the old one.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, allow_negative_numbers = true)]
    scale: f64,
    /// How the photos are read between their pixels.
    #[arg(long, value_enum, default_value_t = InterpolationName::Bicubic)]
    interpolation: InterpolationName,
    /// Format of the new photos; that of the old ones if not given.
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Print what was done as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum CropName {
    /// As many pixels as before.
    Same,
    /// The largest picture without black.
    Inside,
    /// Everything the photo shows.
    All,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum InterpolationName {
    Bilinear,
    Bicubic,
    Lanczos,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Format {
    Png,
    Jpg,
    Tif,
}

#[derive(Serialize)]
struct Row {
    image: String,
    output: String,
    width_px: u32,
    height_px: u32,
    black_pixels: usize,
}

/// Runs the verb.
///
/// # Errors
/// Where the camera, a photo or an output cannot be used, or writing fails.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let camera = camera::read(&args.camera)?;
    let crop = match args.crop {
        CropName::Same => Crop::Same,
        CropName::Inside => Crop::Inside,
        CropName::All => Crop::All,
    };
    let interpolation = match args.interpolation {
        InterpolationName::Bilinear => Interpolation::Bilinear,
        InterpolationName::Bicubic => Interpolation::Bicubic,
        InterpolationName::Lanczos => Interpolation::Lanczos,
    };
    let ideal = ideal_camera(&camera.interior, crop, args.scale)
        .map_err(|error| Error::Argument(format!("{}: {error}", args.camera.display())))?;
    let outputs = outputs(args)?;
    std::fs::create_dir_all(&args.output)
        .map_err(|source| FileError::write(&args.output, source))?;
    let rows = args
        .images
        .par_iter()
        .zip(&outputs)
        .map(|(image, to)| {
            let photo = images::read_colour(image)?;
            let (flat, black_pixels) =
                undistort(&photo, &camera.interior, &ideal, interpolation)
                    .map_err(|error| Error::Argument(format!("{}: {error}", image.display())))?;
            images::write_as_named(to, args.force, &flat)?;
            tracing::info!("{}", to.display());
            Ok(Row {
                image: image.display().to_string(),
                output: to.display().to_string(),
                width_px: flat.width(),
                height_px: flat.height(),
                black_pixels,
            })
        })
        .collect::<Vec<Result<Row, Error>>>()
        .into_iter()
        .collect::<Result<Vec<Row>, Error>>()?;
    camera::write(&args.output.join(CAMERA), args.force, &Camera::new(&camera.name, ideal))?;
    if args.json {
        return super::print_json(&rows);
    }
    Ok(())
}

/// Name of the camera of the new photos.
const CAMERA: &str = "camera.toml";

/// Where the photos go; refuses what would fail, or destroy an input, after the work is done.
fn outputs(args: &Args) -> Result<Vec<PathBuf>, Error> {
    if args.output.exists() && !args.output.is_dir() {
        return Err(
            FileError::Unusable { path: args.output.clone(), message: "it is no folder" }.into()
        );
    }
    let mut outputs: Vec<PathBuf> = Vec::with_capacity(args.images.len());
    for image in &args.images {
        let name = image
            .file_name()
            .ok_or_else(|| Error::Argument(format!("{}: expected a photo", image.display())))?;
        let mut to = args.output.join(name);
        if let Some(format) = args.format {
            to.set_extension(match format {
                Format::Png => "png",
                Format::Jpg => "jpg",
                Format::Tif => "tif",
            });
        }
        if let Some(twin) = outputs.iter().position(|other| *other == to) {
            return Err(Error::Argument(format!(
                "{} and {} would both become {}",
                args.images[twin].display(),
                image.display(),
                to.display()
            )));
        }
        free(&to, args)?;
        outputs.push(to);
    }
    let camera = args.output.join(CAMERA);
    free(&camera, args)?;
    Ok(outputs)
}

/// Refuses an output that exists or is an input.
fn free(path: &Path, args: &Args) -> Result<(), Error> {
    let inputs = args.images.iter().chain([&args.camera]);
    if inputs.into_iter().any(|input| super::segment::same_file(input, path)) {
        return Err(Error::Argument(format!(
            "{} is an input, expected another folder",
            path.display()
        )));
    }
    if path.exists() && !args.force {
        return Err(FileError::Exists { path: path.to_owned() }.into());
    }
    Ok(())
}
