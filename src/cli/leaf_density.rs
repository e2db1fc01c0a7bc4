//! `rowgram leaves density`: how many leaf pixels lie around each pixel.

use super::{
    options::{Given, HsvOptions},
    stage::{Target, check_files},
};
use rowgram_base::error::Error;
use rowgram_optim::output;
use rowgram_project::{
    Stage,
    leaf_density::{
        LeafDensityFiles, LeafDensityOptions, LeafDensityOutcome, leaf_density, map_leaf_density,
    },
    leaf_mask::read_leaf_mask,
};
use std::path::PathBuf;

/// Map the local density of leaf pixels
///
/// For each pixel the number of leaf pixels in a square window around it, as a GeoTIFF of whole numbers and a picture.
/// Beyond the border there are no leaves. Of a project, the leaf mask is taken; a single file is a mask (two values), or
/// a photo or orthomosaic, of which --hsv makes one.
///
/// Example: rowgram leaves density field
/// Example: rowgram leaves density ortho.tif --window-px 41 -o density.tif --figures figures
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    target: Target,
    #[command(flatten)]
    options: Given<LeafDensityOptions>,
    #[command(flatten)]
    hsv: Given<HsvOptions>,
    /// Of a single file: draw the density, density.png, into this folder: dark blue (none) to yellow (the most there is).
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
}

fn text(outcome: &LeafDensityOutcome) -> String {
    format!(
        "at most {}, on average {:.1} of {} pixels around a pixel are leaf",
        outcome.largest,
        outcome.mean,
        outcome.window_px * outcome.window_px
    )
}

/// Runs the command.
///
/// # Errors
/// As [`map_leaf_density`] and the stage.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let Args { target, options, hsv, figures } = args;
    if target.is_project() {
        target.refuse_of_files(&[("--figures", figures.is_some()), ("--hsv", hsv.has("hsv"))])?;
        return target.perform(
            (Stage::LeafDensity, leaf_density),
            options,
            |config| &config.leaf_density,
            text,
        );
    }
    let density = target.file()?;
    output::expect_ending(density, &["tif", "tiff"])?;
    let picture = figures.as_deref().map(|folder| (folder, "density.png"));
    check_files(&[density], picture, &[target.input()], target.force)?;
    let (options, hsv) = (options.over_defaults()?, hsv.over_defaults()?.hsv);
    let files = LeafDensityFiles { density, figures: figures.as_deref(), force: target.force };
    target.present(
        |monitor| {
            let (source, leaf) = read_leaf_mask(target.input(), hsv, monitor)?;
            map_leaf_density(&leaf.mask, source.georeference(), files, &options)
        },
        text,
    )
}
