//! `rowgram segment`: the leaf mask of a project, photo or orthomosaic.

use super::{
    options::Given,
    stage::{Target, check_files, given},
    thresholds,
};
use rowgram_base::error::Error;
use rowgram_optim::output;
use rowgram_project::{
    Stage,
    segment::{self, SegmentFiles, SegmentOptions, SegmentOutcome},
};
use std::path::PathBuf;

/// Find the leaf pixels of an orthomosaic or photo by their colour
///
/// Vegetation and background are estimated from the picture itself: every pixel gets a probability, and
/// neighbouring pixels of different classes are penalised. With --hsv a pixel is leaf where its hue is within two limits, and its saturation or its value is large enough
/// (OpenCV's 8-bit HSV). Of a project, the orthomosaic is segmented into segment/mask.tif. Of a photo, a mask of its size
/// is written, 255 where leaves are and 0 elsewhere (.png, or .tif for a GeoTIFF).
///
/// Example: rowgram segment field
/// Example: rowgram segment plot.jpg --hsv 30,79,30,163 -o mask.png --figures figures
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
    options: Given<SegmentOptions>,
    /// Of a photo: write the probability of vegetation, 0 to 255, here (.png or .tif).
    #[arg(long, value_name = "FILE")]
    posterior: Option<PathBuf>,
    /// Of a photo: write the photo with its mask drawn over it, mask.png, into this folder.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Thresholds(Box<thresholds::Args>),
}

fn text(outcome: &SegmentOutcome) -> String {
    let SegmentOutcome { leaf_pixels, leaf_share, components, .. } = outcome;
    format!(
        "{leaf_pixels} of {} pixels are leaf ({:.2} %), in {components} connected areas",
        outcome.width_px * outcome.height_px,
        100.0 * leaf_share,
    )
}

/// Runs the command.
///
/// # Errors
/// As [`segment::segment`] and [`segment::segment_file`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if let Some(Command::Thresholds(args)) = &args.command {
        return thresholds::run(args);
    }
    let Args { target, options, posterior, figures, .. } = args;
    if target.is_project() {
        target.refuse_of_files(&[
            ("--posterior", posterior.is_some()),
            ("--figures", figures.is_some()),
        ])?;
        return target.perform(
            (Stage::Segment, segment::segment),
            options,
            |config| &config.segment,
            text,
        );
    }
    let mask = target.file()?;
    output::expect_ending(mask, &["png", "tif", "tiff"])?;
    if let Some(posterior) = posterior {
        output::expect_ending(posterior, &["png", "tif", "tiff"])?;
    }
    let options = options.over_defaults()?;
    let picture = figures.as_deref().map(|folder| (folder, "mask.png"));
    check_files(
        &given([Some(mask), posterior.as_deref()]),
        picture,
        &[target.input()],
        target.force,
    )?;
    let files = SegmentFiles {
        valid: None,
        mask,
        posterior: posterior.as_deref(),
        figures: figures.as_deref(),
        force: target.force,
    };
    target.present(|monitor| segment::segment_file(target.input(), files, &options, monitor), text)
}
