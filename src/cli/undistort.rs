//! `rowgram camera undistort`: photos as a camera without distortion would have taken them.

use super::project;
use rowgram_base::error::Error;
use rowgram_project::undistort::{PhotoFormat, UndistortOptions, undistort_photos};
use rowgram_survey::mapping::undistort::{Crop, Interpolation};
use std::path::PathBuf;

/// Remove the distortion from photos
///
/// Every photo becomes what a camera without distortion would have taken: straight lines are
/// straight. Pixels that the photo does not show are black. The folder also gets camera.toml, the
/// camera of the new photos (brown without terms, the same principal distance unless --scale).
///
/// Example: rowgram camera undistort photos/*.jpg --camera camera.toml -o flat --crop inside
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
    /// What the new photos show: as many pixels as before, the largest picture without black, or everything.
    #[arg(long, value_name = "same|inside|all", default_value_t = Crop::Same)]
    crop: Crop,
    /// New principal distance over the old one.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, allow_negative_numbers = true)]
    scale: f64,
    /// How the photos are read between their pixels.
    #[arg(long, value_name = "bilinear|bicubic|lanczos", default_value_t = Interpolation::Bicubic)]
    interpolation: Interpolation,
    /// Format of the new photos; that of the old ones if not given.
    #[arg(long, value_name = "png|jpg|tif")]
    format: Option<PhotoFormat>,
    /// Print what was done as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
///
/// # Errors
/// Where the camera, a photo or an output cannot be used, or writing fails.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = UndistortOptions {
        crop: args.crop,
        scale: args.scale,
        interpolation: args.interpolation,
        format: args.format,
    };
    let (photos, camera, folder) = (&args.images, &args.camera, &args.output);
    project::present(
        args.json,
        |monitor| undistort_photos(photos, camera, &options, folder, args.force, monitor),
        |found| format!("{}: {} photos without distortion", folder.display(), found.photos.len()),
    )
}
