//! `rowgram ortho`: the orthomosaic of a project, or of photos with poses from elsewhere.

use super::{import::ModelArgs, options::Given, project, query};
use rowgram_base::error::Error;
use rowgram_project::{
    Stage,
    import::photo_files,
    ortho::{
        OrthoFiles, OrthoInput, OrthoOptions, OrthoOutcome, Orthophoto, ortho, write_orthophotos,
    },
};
use std::path::{Path, PathBuf};

/// Make an orthomosaic, and orthophotos of single photos
///
/// Every cell is projected from the surface into the photos that may show it (collinearity, with the exact lens of
/// each camera), and takes its colour from the photo whose camera is closest.
///
/// Writes a tiled, compressed GeoTIFF with overviews and an alpha channel (ortho.tif), and beside it, as
/// ortho_provenance.tif, where each pixel comes from: number of the photo, and 1 where a better one was passed over, because it has no
/// data or does not see the place; ortho.json has the photos. rowgram ortho query computes the rest: column, row, view angle, distance to the seam.
///
/// PROJECT is a folder after rowgram align and rowgram surface dem. Without a project, another program's model is read, or
/// poses with a camera.
///
/// Examples:
///   rowgram ortho field --gsd-m 0.015
///   rowgram ortho field --frames --canopy-height-m 0
///   rowgram ortho --poses opk.csv --camera camera.toml --photos photos --dem dem.tif -o ortho.tif
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true
)]
pub(super) struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    /// Folder of the project.
    #[arg(required_unless_present_any = ["model", "poses"], conflicts_with_all = ["model", "poses", "photos", "crs", "vertical_crs", "offset", "figures"])]
    project: Option<PathBuf>,
    /// Folder of results [default: PROJECT/rowgram]; without a project the file of the orthomosaic.
    #[arg(short, long, value_name = "PATH")]
    output: Option<PathBuf>,
    #[command(flatten)]
    options: Given<OrthoOptions>,
    #[command(flatten)]
    import: ModelArgs,
    /// Folder of the photos.
    #[arg(long, value_name = "DIR")]
    photos: Option<PathBuf>,
    /// Folder for pictures; those of a project go to figures/ beside the orthomosaic.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Make it again where nothing has changed; without a project, replace files that exist.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Query(Box<query::Args>),
}

/// Runs the command.
///
/// # Errors
/// As the stage says.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if let Some(Command::Query(args)) = &args.command {
        return query::run(args);
    }
    let Some(root) = &args.project else { return of_model(args) };
    let project = project::open_for(Stage::Ortho, root, args.output.as_deref(), args.force)?;
    let options = args.options.over(&project.config().ortho)?;
    let folder = project.folder(Stage::Ortho);
    project::present(
        args.json,
        |monitor| ortho(&project, &options, monitor),
        |outcome| text(&folder, outcome),
    )
}

fn of_model(args: &Args) -> Result<(), Error> {
    let options = args.options.over_defaults()?;
    let needed = |path: &Option<PathBuf>, what: &str| {
        path.clone().ok_or_else(|| Error::Argument(format!("without a project {what}")))
    };
    let output = needed(&args.output, "--output names the file of the orthomosaic")?;
    let surface = needed(&options.dem, "--dem names the surface; rowgram surface dem makes one")?;
    let folder = needed(&args.photos, "--photos names the folder of the photos")?;
    let reconstruction = args.import.import()?.read()?;
    let photos = photo_files(&reconstruction, &folder)?;
    let input = OrthoInput {
        reconstruction: &reconstruction,
        photos: &photos,
        surface: &surface,
        filled: None,
    };
    let figures = args.figures.as_deref();
    let files = OrthoFiles { mosaic: &output, figures, force: args.force };
    project::present(
        args.json,
        |monitor| write_orthophotos(&input, &options, &files, monitor),
        |outcome| text(output.parent().unwrap_or(Path::new("")), outcome),
    )
}

fn text(folder: &Path, outcome: &OrthoOutcome) -> String {
    let line = |map: &Orthophoto| {
        format!(
            "{}: {} x {} pixels of {} m, {:.1} % coloured, {} photos",
            folder.join(&map.file).display(),
            map.width_px,
            map.height_px,
            map.gsd_m,
            100.0 * map.coloured_pixels as f64 / (map.width_px * map.height_px) as f64,
            map.photos
        )
    };
    let maps = std::iter::once(&outcome.mosaic).chain(&outcome.frames);
    maps.map(line).collect::<Vec<_>>().join("\n")
}
