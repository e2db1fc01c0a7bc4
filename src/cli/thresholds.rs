//! `rowgram segment thresholds`: thresholds of leaf pixels for photos.

use super::{options::Given, project::present};
use rowgram_base::error::Error;
use rowgram_project::thresholds::{Photos, ThresholdsOptions, ThresholdsOutcome, thresholds};
use std::path::PathBuf;

/// Propose, tune or judge the thresholds of leaf pixels
///
/// Without masks: a proposal from the photos' colours alone (Otsu's threshold on the excess green or on the hue), for a
/// person to look at and to give to the other commands as --hsv. With one mask per photo: the thresholds of the largest
/// intersection over union; with --judge those of --hsv are judged only. With --leave-one-out each photo is judged with
/// thresholds tuned on all the others.
///
/// A mask has two values, of which the brighter is leaf. A grey picture with softened edges is split at half of its white; in
/// a picture of several classes everything but black is leaf. Masks are laid over photos pixel by pixel as stored;
/// --as-shown first turns the photos as their metadata says, for masks drawn over what a viewer shows.
///
/// Example: rowgram segment thresholds a.jpg b.jpg --masks a.png,b.png --figures figures
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Photos.
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    /// Their annotated masks, in the same order.
    #[arg(long, value_name = "FILE[,FILE...]", value_delimiter = ',')]
    masks: Vec<PathBuf>,
    #[command(flatten)]
    options: Given<ThresholdsOptions>,
    /// Draw histograms of hue, saturation and value, and with masks ROC and IoU curves (SVG, with a CSV of the same name), into
    /// this folder.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace figures that exist.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
///
/// # Errors
/// As [`thresholds`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = args.options.over_defaults()?;
    let input = Photos { photos: &args.photos, masks: &args.masks };
    let figures = args.figures.as_deref().map(|folder| (folder, args.force));
    present(args.json, |monitor| thresholds(input, &options, figures, monitor), text)
}

fn text(outcome: &ThresholdsOutcome) -> String {
    let mut text = format!("--hsv {}  ({})\n", outcome.hsv, outcome.origin);
    for judged in &outcome.judged {
        text += &format!(
            "{}: IoU {:.4}, TPR {:.4}, FPR {:.4} with {}\n",
            judged.photo.display(),
            judged.iou,
            judged.true_positive_rate,
            judged.false_positive_rate,
            judged.hsv
        );
    }
    text
}
