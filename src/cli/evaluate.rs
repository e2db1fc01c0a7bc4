//! `rowgram evaluate`: found plants against the truth.

use super::{print, print_json};
use crate::{error::Error, io::points, score::Score};
use std::path::PathBuf;

/// Score plant positions against the true ones
///
/// Pairs found and true plants one to one: as many pairs as possible within the radius, and among
/// those the shortest in sum. Prints precision, recall and F1 at each radius, and the median and RMS
/// distance of the pairs at the largest.
///
/// Both CSVs are read by header (u_px,v_px or x,y; other columns are allowed) or, without one, as two
/// columns; positions in pixels, the centre of the top-left pixel at (0, 0).
///
/// Example: rowgram evaluate plants.csv truth.csv --radius 5,10
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// The plants that were found (CSV).
    plants: PathBuf,
    /// The plants that are there (CSV).
    truth: PathBuf,
    /// How far from a true plant a found one may be, in pixels; one number or several.
    #[arg(
        long,
        value_name = "PX[,PX...]",
        required = true,
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    radius: Vec<f64>,
    /// Print one line of JSON in place of the table.
    #[arg(long)]
    json: bool,
}

/// Runs the verb.
///
/// # Errors
/// Where a radius or a file cannot be used.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let score = score(args)?;
    if args.json { print_json(&score) } else { print(&score.to_string()) }
}

/// Reads and scores; prints nothing.
///
/// # Errors
/// As [`run`].
pub(super) fn score(args: &Args) -> Result<Score, Error> {
    // An unusable radius is told before the files are read.
    Score::new(&[], &[], &args.radius)
        .map_err(|error| Error::Argument(format!("--radius: {error}")))?;
    let found = points::read(&args.plants)?;
    let truth = points::read(&args.truth)?;
    Score::new(&found, &truth, &args.radius)
}
