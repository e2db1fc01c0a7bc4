//! `rowgram crops`: plots cut out of the photos themselves.

use super::{options::Given, project};
use crate::{
    error::Error,
    pipeline::crops::{CropsOptions, CropsOutcome, crops},
};
use std::path::PathBuf;

/// Cut every plot out of its best photos, with traits photo by photo
///
/// For every plot the photos that show it whole, the steepest view first; those that were found blurred or wrongly exposed come
/// last. Each is drawn on the surface along the sides of the plot: PNG with a world file (.pgw) in crops/PLOT/. crops.csv has a
/// line for every picture, crops.json also the outline of the plot in picture and photo, traits.csv the mean of cover and
/// colour indices over the photos of a plot and their standard deviation between photos.
///
/// PROJECT is a folder after rowgram run (or align, dem, ortho, segment, plots).
///
/// Examples:
///   rowgram crops field
///   rowgram crops field --photos-per-plot 5 --margin-m 0.3 --as-taken
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Folder of results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    options: Given<CropsOptions>,
    /// Replace crops that are there.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// As [`crops`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = project::open(&args.project, args.output.as_deref())?;
    let options = args.options.over(&project.config().crops)?;
    project::present(args.json, |monitor| crops(&project, &options, args.force, monitor), text)
}

fn text(of: &CropsOutcome) -> String {
    let plots = of.crops.chunk_by(|a, b| a.plot == b.plot).count();
    format!(
        "{}: {} pictures of {plots} plots, pixels of {:.4} m",
        of.folder.display(),
        of.crops.len(),
        of.gsd_m
    )
}
