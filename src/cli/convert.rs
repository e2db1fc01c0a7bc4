//! `rowgram convert`: a reconstruction from one format into another.

use super::{options::Given, project::present};
use rowgram_base::error::Error;
use rowgram_project::convert::{self, Format, ModelFileOptions};
use std::path::PathBuf;

/// Convert a reconstruction between rowgram, COLMAP (text, binary), Bundler and OpenSfM.
///
/// Nothing is changed but the conventions: pixel centres, camera frames, normalised coordinates. A lens
/// that the other format cannot hold is refused.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram convert sparse/0 --to colmap-text -o text
  rowgram convert bundle.out --image-size-px 4000,3000 --to opensfm -o reconstruction.json")]
pub(super) struct Args {
    /// A COLMAP folder, a bundle.out, OpenSfM's reconstruction.json, or rowgram's (the file or its folder).
    input: PathBuf,
    /// The format to write: colmap-text, colmap-binary, bundler, opensfm, rowgram.
    #[arg(long, value_name = "FORMAT")]
    to: Format,
    /// The folder (COLMAP, rowgram) or file to write; list.txt or tracks.csv goes beside it.
    #[arg(short, long, value_name = "PATH")]
    output: PathBuf,
    #[command(flatten)]
    options: Given<ModelFileOptions>,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print one line of JSON instead of a summary.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// As [`convert::convert`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = args.options.over_defaults()?;
    present(
        args.json,
        |_| convert::convert(&args.input, (&args.output, args.to), &options, args.force),
        |found| {
            format!(
                "{} cameras, {} images, {} points, {} observations",
                found.cameras, found.images, found.points, found.observations
            )
        },
    )
}
