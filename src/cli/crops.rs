//! `rowgram plots crops`: plots cut out of the photos themselves.

use super::{options::Given, project};
use rowgram_base::error::Error;
use rowgram_project::crops::{CropsOptions, CropsOutcome, crops};

/// Cut every plot out of its best photos, with traits photo by photo
///
/// For every plot the photos that show it whole, the steepest view first; those that were found blurred or wrongly exposed come
/// last. Each is drawn on the surface along the sides of the plot: PNG with a world file (.pgw) in crops/PLOT/. crops.csv has a
/// line for every picture, crops.json also the outline of the plot in picture and photo, traits.csv the mean of cover and
/// colour indices over the photos of a plot and their standard deviation between photos, comparison.csv these beside the traits
/// of the orthomosaic.
///
/// PROJECT is a folder after rowgram run (or align, dem, ortho, segment, plots).
///
/// Examples:
///   rowgram plots crops field
///   rowgram plots crops field --photos-per-plot 5 --margin-m 0.3 --as-taken
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    project: project::ProjectArgs,
    #[command(flatten)]
    options: Given<CropsOptions>,
    /// Replace crops that are there; files that were edited since are kept beside, as NAME.edited.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
///
/// # Errors
/// As [`crops`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = args.project.open()?;
    let options = args.options.over(&project.config().crops)?;
    project::present(
        args.project.json,
        |monitor| crops(&project, &options, args.force, monitor),
        text,
    )
}

fn text(of: &CropsOutcome) -> String {
    let plots = of.crops.chunk_by(|a, b| a.plot == b.plot).count();
    let count =
        |number: usize, of: &str| format!("{number} {of}{}", if number == 1 { "" } else { "s" });
    let mut text = format!(
        "{}: {} of {}, pixels of {:.4} m",
        of.folder.display(),
        count(of.crops.len(), "picture"),
        count(plots, "plot"),
        of.gsd_m
    );
    if !of.comparison.is_empty() {
        text +=
            "\n\ntrait          plots  orthomosaic   photos  difference  its SD  SD between photos";
    }
    let shown = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    for of in &of.comparison {
        text += &format!(
            "\n{:<14} {:>5} {:>12.4} {:>8.4} {:>+11.4} {:>7} {:>18}",
            of.name,
            of.plots,
            of.orthomosaic,
            of.photos,
            of.photos - of.orthomosaic,
            shown(of.difference_sd),
            shown(of.between_photos_sd)
        );
    }
    text
}
