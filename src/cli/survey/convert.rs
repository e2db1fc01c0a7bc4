//! `rowgram convert`: a reconstruction from one format into another.

use super::{Format, format_of, read_model, write_model};
use crate::{error::Error, io::FileError};
use serde::Serialize;
use std::path::PathBuf;

/// Convert a reconstruction between rowgram, COLMAP (text, binary), Bundler and OpenSfM.
///
/// Nothing is changed but the conventions: pixel centres, camera frames, normalised coordinates. A lens
/// that the other format cannot hold is refused.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram convert sparse/0 --to colmap-text -o text
  rowgram convert bundle.out --image-size 4000x3000 --to opensfm -o reconstruction.json")]
pub(in crate::cli) struct Args {
    /// A COLMAP folder, a bundle.out, OpenSfM's reconstruction.json, or rowgram's (the file or its folder).
    input: PathBuf,
    /// The format to write.
    #[arg(long, value_enum)]
    to: Format,
    /// The folder (COLMAP, rowgram) or file to write; list.txt or tracks.csv goes beside it.
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Image size of a Bundler file, which has none.
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    image_size: Option<String>,
    /// Image names of a Bundler file; list.txt beside it if not given.
    #[arg(long, value_name = "TXT")]
    list: Option<PathBuf>,
    /// Measurements of an OpenSfM reconstruction; tracks.csv beside it if not given.
    #[arg(long, value_name = "CSV")]
    tracks: Option<PathBuf>,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print one line of JSON instead of a summary.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Summary {
    cameras: usize,
    images: usize,
    points: usize,
    observations: usize,
}

/// Runs the command.
///
/// # Errors
/// Bad input, outputs that exist, lenses that the format cannot hold.
pub(in crate::cli) fn run(args: &Args) -> Result<(), Error> {
    if args.output.exists() && !args.force {
        return Err(FileError::Exists { path: args.output.clone() }.into());
    }
    let format = format_of(&args.input).ok_or_else(|| {
        let message =
            "not a COLMAP folder, a bundle.out or a reconstruction.json of rowgram or OpenSfM";
        FileError::malformed(&args.input, None, message)
    })?;
    let size_px = super::description::image_size(args.image_size.as_deref())?;
    let mut model =
        read_model(&args.input, format, args.list.as_deref(), args.tracks.as_deref(), size_px)?;
    write_model(&args.output, args.to, &mut model, args.force)?;
    let survey = &model.survey;
    let summary = Summary {
        cameras: survey.cameras.len(),
        images: survey.images.len(),
        points: survey.points.len(),
        observations: survey.observations.len(),
    };
    if args.json {
        return crate::cli::print_json(&summary);
    }
    crate::cli::print(&format!(
        "{} cameras, {} images, {} points, {} observations",
        summary.cameras, summary.images, summary.points, summary.observations
    ))
}
