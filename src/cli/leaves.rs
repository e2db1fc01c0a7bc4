//! `rowgram leaves`: each single leaf of a project, mask, photo or orthomosaic.

use super::{
    leaf_count, leaf_density,
    options::{Given, HsvOptions},
    stage::{Target, check_files, given},
};
use rowgram_base::error::Error;
use rowgram_files::points;
use rowgram_optim::output;
use rowgram_project::{
    Stage,
    leaf_mask::read_leaf_mask,
    leaves::{self, LeafPicture, LeavesFiles, LeavesOptions, LeavesOutcome, measure_leaves},
};
use std::path::PathBuf;

/// Find each single leaf and measure it
///
/// Slices across the leaves (stroke width transform) are merged into segments, and segments that face each other across a
/// gap into leaves. Broad leaves, as those of rosettes, are distinguished from blades by the mask, and found as parts
/// of the plant between constrictions. One leaf is one label.
///
/// Of a project, the leaf mask, the orthomosaic and the plants are taken, and leaves/leaves.csv and per_plant.csv are
/// written. A single file is a mask (two values), or a photo or orthomosaic, of which --hsv makes one. The ending of
/// --output says what is written: .csv, a table; .gpkg (GeoPackage, for QGIS) or .geojson, axes with the same columns; a
/// GeoPackage also has the layer "plants" where --plants are given. Coordinates are in the raster's own CRS, else pixels.
///
/// Example: rowgram leaves field
/// Example: rowgram leaves ortho.tif -o leaves.gpkg --labels labels.tif --figures figures
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
    target: Target,
    #[command(flatten)]
    options: Given<LeavesOptions>,
    #[command(flatten)]
    hsv: Given<HsvOptions>,
    /// Of a single file: write one label per leaf, 0 elsewhere, as a GeoTIFF.
    #[arg(long, value_name = "TIF")]
    labels: Option<PathBuf>,
    /// Of a single file: plant positions (CSV, u_px,v_px), to which leaves are assigned.
    #[arg(long, value_name = "CSV")]
    plants: Option<PathBuf>,
    /// With --plants: write the plants with their number of leaves.
    #[arg(long, value_name = "CSV", requires = "plants")]
    per_plant: Option<PathBuf>,
    /// Of a single file: draw the leaves with their axes, leaves.png, into this folder.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Count(Box<leaf_count::Args>),
    Density(Box<leaf_density::Args>),
}

fn text(outcome: &LeavesOutcome) -> String {
    let length = match (outcome.median_length_m, outcome.median_length_px) {
        (Some(m), _) => format!(", median length {m:.3} m"),
        (None, Some(px)) => format!(", median length {px:.1} pixels"),
        (None, None) => String::new(),
    };
    let shape = if outcome.is_broad { "broad leaves" } else { "leaves" };
    format!("{} {shape}{length}", outcome.leaves)
}

/// Runs the command.
///
/// # Errors
/// As [`measure_leaves`] and the stage.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    match &args.command {
        Some(Command::Count(args)) => return leaf_count::run(args),
        Some(Command::Density(args)) => return leaf_density::run(args),
        None => {}
    }
    let Args { target, options, hsv, labels, plants, per_plant, figures, .. } = args;
    if target.is_project() {
        target.refuse_of_files(&[
            ("--labels", labels.is_some()),
            ("--plants", plants.is_some()),
            ("--figures", figures.is_some()),
            ("--hsv", hsv.has("hsv")),
        ])?;
        return target.perform(
            (Stage::Leaves, leaves::leaves),
            options,
            |config| &config.leaves,
            text,
        );
    }
    let table = target.file()?;
    output::expect_ending(table, &["gpkg", "geojson", "csv"])?;
    if let Some(labels) = labels {
        output::expect_ending(labels, &["tif", "tiff"])?;
    }
    let outputs = given([Some(table), labels.as_deref(), per_plant.as_deref()]);
    let inputs = given([Some(target.input()), plants.as_deref()]);
    let (options, hsv) = (options.over_defaults()?, hsv.over_defaults()?.hsv);
    let picture = figures.as_deref().map(|folder| (folder, "leaves.png"));
    check_files(&outputs, picture, &inputs, target.force)?;
    let files = LeavesFiles {
        leaves: table,
        per_plant: per_plant.as_deref(),
        labels: labels.as_deref(),
        figures: figures.as_deref(),
        force: target.force,
    };
    let subject = target.input().display().to_string();
    target.present(
        |monitor| {
            let (source, leaf) = read_leaf_mask(target.input(), hsv, monitor)?;
            let plants = plants.as_deref().map(points::read).transpose()?;
            let picture = LeafPicture { source: &source, mask: &leaf.mask, subject: &subject };
            measure_leaves(picture, plants.as_deref(), files, &options, monitor)
        },
        text,
    )
}
