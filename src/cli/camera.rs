//! `rowgram camera`: calibration, conversion to other programs, photos without distortion.

use super::{calibrate, undistort};
use clap::{Args as ClapArgs, Subcommand};
use rowgram_base::error::Error;
use rowgram_files::camera;
use rowgram_optim::output;
use rowgram_project::camera::{CameraFormat, ConvertedCamera, ConvertedLens, convert_camera};
use rowgram_survey::problems::lens_fit::Fit;
use serde::Serialize;
use std::path::PathBuf;

/// Calibrate a camera, convert it to other programs, undistort photos.
#[derive(Debug, ClapArgs)]
pub(super) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Calibrate(Box<calibrate::Args>),
    Convert(ConvertArgs),
    Undistort(undistort::Args),
}

impl Args {
    /// Runs the command.
    ///
    /// # Errors
    /// As the command says.
    pub(super) fn run(&self) -> Result<(), Error> {
        match &self.command {
            Command::Calibrate(args) => calibrate::run(args),
            Command::Convert(args) => convert(args),
            Command::Undistort(args) => undistort::run(args),
        }
    }
}

/// Convert a camera to another program or another lens model
///
/// Models differ in shape and direction (smac corrects what was measured, the others distort what
/// is ideal), so the new parameters are a least-squares fit over the whole sensor, and what the
/// fit leaves is said: root mean square and largest distance, in pixels. Pixel positions follow
/// each program's own convention.
///
/// Example: rowgram camera convert camera.toml --to colmap -o cameras.txt
#[derive(Debug, ClapArgs)]
#[command(verbatim_doc_comment)]
struct ConvertArgs {
    /// The camera.
    camera: PathBuf,
    /// The program whose file is written (opencv, colmap, metashape, opensfm), or the lens model of another camera.toml
    /// (smac, brown, fisheye).
    #[arg(long, value_name = "FORMAT")]
    to: CameraFormat,
    /// The lens model of the program's file; brown with five terms if not given, and the fisheye
    /// where the camera is one.
    #[arg(long, value_name = "brown|rational|fisheye")]
    model: Option<ConvertedLens>,
    /// Where to write; stdout if not given.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// End with code 3 where a pixel is further off than this after the fit.
    #[arg(long, value_name = "PX", alias = "max-residual", allow_negative_numbers = true)]
    max_residual_px: Option<f64>,
    /// Print the residual as one line of JSON; needs --output.
    #[arg(long, requires = "output")]
    json: bool,
    /// Replace an output that exists.
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct Report<'a> {
    camera: String,
    from: &'a str,
    to: &'a str,
    exact: bool,
    #[serde(flatten)]
    fit: &'a Fit,
}

fn convert(args: &ConvertArgs) -> Result<(), Error> {
    if let Some(most) = args.max_residual_px.filter(|most| !(*most >= 0.0 && most.is_finite())) {
        return Err(Error::Argument(format!(
            "--max-residual-px {most}: expected pixels, 0 or more"
        )));
    }
    if let Some(path) = &args.output {
        output::check_apart(&[path], &[&args.camera], args.force)?;
        output::check(path, args.force)?;
    }
    let source = camera::read(&args.camera)?;
    let converted = convert_camera(&source, args.to, args.model).map_err(|error| match error {
        Error::Argument(message) if !message.starts_with("--") => {
            Error::Argument(format!("{}: {message}", args.camera.display()))
        }
        other => other,
    })?;
    match &args.output {
        Some(path) => {
            output::write(path, args.force, |out| out.write_all(converted.text.as_bytes()))?;
        }
        None => super::print(&converted.text)?,
    }
    show(args, source.interior.model().word(), &converted)?;
    let largest_px = converted.fit.largest_px;
    match args.max_residual_px {
        Some(most) if largest_px > most => Err(Error::Incomplete(format!(
            "the fit leaves {largest_px:.3} px, --max-residual-px allows {most} px"
        ))),
        _ => Ok(()),
    }
}

fn show(args: &ConvertArgs, from: &str, converted: &ConvertedCamera) -> Result<(), Error> {
    let ConvertedCamera { fit, is_exact, .. } = converted;
    if args.json {
        return super::print_json(&Report {
            camera: args.camera.display().to_string(),
            from,
            to: fit.interior.model().word(),
            exact: *is_exact,
            fit,
        });
    }
    if *is_exact {
        tracing::info!("{}: the same lens model: nothing was fitted", args.camera.display());
        return Ok(());
    }
    tracing::info!(
        "{}: fitted over the sensor: rms {:.4} px, at most {:.4} px at ({:.0}, {:.0})",
        args.camera.display(),
        fit.rms_px,
        fit.largest_px,
        fit.largest_at_px[0],
        fit.largest_at_px[1]
    );
    if fit.left_out > 0 {
        tracing::warn!(
            "{}: {} of {} places of the sensor took no part: one of the lens models has no ray there",
            args.camera.display(),
            fit.left_out,
            fit.left_out + fit.points
        );
    }
    Ok(())
}
