//! `rowgram surface`: the dense surface of a project.

use super::{dem, options::Given, project};
use rowgram_base::error::Error;
use rowgram_project::{
    Stage,
    surface::{SurfaceOptions, SurfaceOutcome, surface},
};

/// Make the dense surface: canopy, ground, plant height
///
/// For every cell the height at which photos agree, within what the surface of the tie points allows (rowgram surface dem), by
/// semi-global matching. Writes GeoTIFFs of heights in metres: dsm.tif (the first surface), dtm.tif (the ground below it, from what is
/// bare), with dsm_sigma.tif and dtm_sigma.tif, their standard deviations (from matching and from the orientation of the photos), and
/// chm.tif (the height of the one over the other; errors of orientation cancel in it); for every cell the confidence of its height
/// (confidence.tif, 0 to 255) and how many photos were compared (photos.tif); pictures and a profile in figures/.
///
/// For crops that stand on soil. Hills, walls and houses come out too; crowns of trees are noise where photos overlap by two thirds only.
///
/// PROJECT is a folder after rowgram align and rowgram surface dem; or one with the heights of another program (--dsm, --dtm, or dsm.tif
/// and dtm.tif beside its orthomosaic): then nothing is matched.
///
/// Examples:
///   rowgram surface field
///   rowgram surface field --cell-m 0.02 --ground any
///   rowgram surface field --dsm cloud.laz --dtm terrain.tif
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true
)]
pub(super) struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    project: project::ProjectArgs,
    #[command(flatten)]
    options: Given<SurfaceOptions>,
    /// Make it again where nothing has changed.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Dem(Box<dem::Args>),
}

/// Runs the command.
///
/// # Errors
/// As the stage says.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if let Some(Command::Dem(args)) = &args.command {
        return dem::run(args);
    }
    let project = args.project.open_for(Stage::Surface, args.force)?;
    let options = args.options.over(&project.config().surface)?;
    let folder = project.folder(Stage::Surface);
    project::present(
        args.project.json,
        |monitor| surface(&project, &options, monitor),
        |outcome| text(&folder.join(&outcome.surface).display().to_string(), outcome),
    )
}

fn text(path: &str, of: &SurfaceOutcome) -> String {
    let share = 100.0 * of.cells_with_height as f64 / of.cells_seen.max(1) as f64;
    let from = match &of.given {
        Some(file) => format!("heights are those of {file}"),
        None => format!("{share:.1} % of those that two photos show have a height"),
    };
    let mut text =
        format!("{path}: {} x {} cells of {} m, {from}", of.width_px, of.height_px, of.cell_m);
    if let Some(cloud) = &of.cloud {
        text += &format!("\nas points with colours: {} beside it", cloud.display());
    }
    if let Some([half, most, top]) = of.canopy_percentiles_m {
        text += &format!(
            "\nheight over the ground: 50 % of the cells at most {half:.3} m, 95 % {most:.3} m, 99 % {top:.3} m"
        );
    }
    text
}
