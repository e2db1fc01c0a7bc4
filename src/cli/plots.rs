//! `rowgram plots`: the traits of the plots of a project; `rowgram plots layout`: the plots themselves.

mod layout;

use super::{
    crops,
    options::Given,
    project::{ProjectArgs, present},
};
use rowgram_base::error::Error;
use rowgram_project::{
    Stage,
    plots::{PlotsOptions, PlotsOutcome, plots},
};

/// Put the traits of every plot together: area, plants, leaves, canopy cover
///
/// Takes the leaf mask, and the plants, gaps, leaves and counts where those stages were done. Plots are the polygons of
/// plots.geojson, .gpkg or .shp, or groups of rows cut at alleys (--rows-per-plot and --alley-m), else the whole field. Writes
/// plots/traits.csv, .geojson, .gpkg, .parquet, traits_long.csv and BrAPI answers (*.brapi.json). The command layout makes the
/// polygons (a project in a folder of that name is ./layout).
///
/// Example: rowgram plots field
/// Example: rowgram plots field --rows-per-plot 4 --alley-m 1
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
    project: ProjectArgs,
    #[command(flatten)]
    options: Given<PlotsOptions>,
    /// Do the stage again although nothing has changed.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Layout(Box<layout::Args>),
    Crops(Box<crops::Args>),
}

fn text(outcome: &PlotsOutcome) -> String {
    let plural = if outcome.plots.len() == 1 { "" } else { "s" };
    let mut text = format!("{} plot{plural}", outcome.plots.len());
    for plot in &outcome.plots {
        text += &format!("\n{}:", plot.plot);
        if let Some(area_m2) = plot.area_m2 {
            text += &format!(" {area_m2:.1} m2");
        }
        if let Some(plants) = plot.plants {
            text += &format!(", {plants:.0} plants");
        }
    }
    text
}

/// Runs the command.
///
/// # Errors
/// As the stage.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    match &args.command {
        Some(Command::Layout(args)) => return layout::run(args),
        Some(Command::Crops(args)) => return crops::run(args),
        None => {}
    }
    let project = args.project.open_for(Stage::Plots, args.force)?;
    let options = args.options.over(&project.config().plots)?;
    present(args.project.json, |monitor| plots(&project, &options, monitor), text)
}
