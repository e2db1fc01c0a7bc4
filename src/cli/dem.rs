//! `rowgram surface dem`: a surface from the tie points of a project, or from other points.

use super::{import::ModelArgs, options::Given, project};
use rowgram_base::error::Error;
use rowgram_files::cloud_points;
use rowgram_project::{
    Stage,
    dem::{Cloud, DemOptions, DemOutcome, dem, write_elevation},
};
use rowgram_raster::georeference::Crs;
use std::path::PathBuf;

/// Make a digital elevation model
///
/// Points that do not fit their neighbours are left out; the rest is triangulated (Delaunay) and interpolated by
/// natural neighbours. Where there are no points there is no height, but for --extend-m. Writes a tiled GeoTIFF of heights in metres
/// (dem.tif, nodata -9999) and their standard deviations (dem_sigma.tif).
///
/// PROJECT is a folder after rowgram align. Without a project, points or another program's model are read.
///
/// Examples:
///   rowgram surface dem field
///   rowgram surface dem field --cell-m 0.1
///   rowgram surface dem --points points.csv --crs EPSG:32616 -o dem.tif
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder of the project.
    #[arg(required_unless_present_any = ["model", "points"], conflicts_with_all = ["model", "poses", "points", "crs", "vertical_crs", "offset", "figures"])]
    project: Option<PathBuf>,
    /// Folder of results [default: PROJECT/rowgram]; without a project the file of the surface.
    #[arg(short, long, value_name = "PATH")]
    output: Option<PathBuf>,
    #[command(flatten)]
    options: Given<DemOptions>,
    #[command(flatten)]
    import: ModelArgs,
    /// Points: CSV with x_m, y_m, z_m and perhaps sigma_z_m.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["model", "poses"])]
    points: Option<PathBuf>,
    /// Folder for pictures; those of a project go to figures/ beside the surface.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Make it again where nothing has changed; without a project, replace files that exist.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// As the stage says.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let Some(root) = &args.project else { return of_points(args) };
    let project = project::open_for(Stage::Dem, root, args.output.as_deref(), args.force)?;
    let options = args.options.over(&project.config().dem)?;
    let folder = project.folder(Stage::Dem);
    project::present(
        args.json,
        |monitor| dem(&project, &options, monitor),
        |outcome| text(&folder.join(&outcome.surface).display().to_string(), outcome),
    )
}

fn of_points(args: &Args) -> Result<(), Error> {
    let options = args.options.over_defaults()?;
    let output = args.output.as_deref().ok_or_else(|| {
        Error::Argument("without a project --output names the file of the surface".into())
    })?;
    let import = args.import.import()?;
    let cloud = match &args.points {
        Some(path) => Cloud {
            points: cloud_points::read(path)?,
            crs: Crs::from(&import.reference()?),
            shown_m: None,
        },
        None => Cloud::of(&import.read()?),
    };
    let files = (output, args.figures.as_deref(), args.force);
    project::present(
        args.json,
        |monitor| write_elevation(&cloud, &options, files, monitor),
        |outcome| text(&output.display().to_string(), outcome),
    )
}

fn text(path: &str, outcome: &DemOutcome) -> String {
    format!(
        "{path}: {} x {} cells of {} m from {} points ({} outliers), heights {:.3} to {:.3} m",
        outcome.width_px,
        outcome.height_px,
        outcome.cell_m,
        outcome.statistics.points,
        outcome.outlier_count,
        outcome.min_height_m,
        outcome.max_height_m
    )
}
