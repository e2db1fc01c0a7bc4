//! `rowgram locate`: the place of every plant in a project, photo or leaf mask.

use super::{
    options::{Given, HsvOptions},
    stage::{Target, check_files, check_tables, given},
};
use rowgram_base::error::Error;
use rowgram_project::{
    Stage,
    leaf_mask::read_leaf_mask,
    locate::{LocateFiles, LocateOptions, LocateOutcome, StandOutcome, locate, locate_plants},
};
use std::{fmt::Write as _, path::PathBuf};

/// Locate plants and count them
///
/// The default method, row-model, finds stalks where the axes of leaves meet, follows the rows where they bend and chooses
/// the best plants along each row under a model of their spacing. Every plant has a confidence, their number an
/// interval, and gaps the probability that plants are missing. The other methods are the paper's descent and its variants (--method paper).
///
/// Of a project, the leaf mask is taken, and locate/plants.csv, gaps.csv, rows.csv and weeds.csv are written. A single file is a
/// mask (two values), or a photo, of which --hsv makes one.
///
/// Example: rowgram locate field
/// Example: rowgram locate mask.png --gsd-m 0.015 -o plants.csv --gaps gaps.csv
/// Example: rowgram locate mask.png --plants 304 --method paper -o plants.csv
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    target: Target,
    #[command(flatten)]
    options: Given<LocateOptions>,
    #[command(flatten)]
    hsv: Given<HsvOptions>,
    /// Of a single file: write where plants are missing (CSV; method row-model).
    #[arg(long, value_name = "CSV")]
    gaps: Option<PathBuf>,
    /// Of a single file: write the stand count of every row, with its interval (CSV; method row-model).
    #[arg(long, value_name = "CSV")]
    rows: Option<PathBuf>,
    /// Of a single file: write the weeds that were left out between rows (CSV; method row-model).
    #[arg(long, value_name = "CSV")]
    weeds: Option<PathBuf>,
    /// Of a single file: write one line per sweep (CSV; other methods).
    #[arg(long, value_name = "CSV")]
    trace: Option<PathBuf>,
    /// Of a single file: draw the plants over the picture, plants.png, into this folder.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
}

fn text(outcome: &LocateOutcome) -> String {
    let LocateOutcome { plants, rows, leaf_pixels, .. } = outcome;
    let rows = match rows {
        0 => "; no rows".to_owned(),
        1 => " in 1 row".to_owned(),
        rows => format!(" in {rows} rows"),
    };
    let mut text = format!("{plants} plants{rows} from {leaf_pixels} leaf pixels");
    // Writing to a string cannot fail.
    if let Some(descent) = &outcome.descent {
        let (sweeps, distance) = (descent.sweeps, descent.mean_distance_px);
        let _ = write!(text, "; {sweeps} sweeps, {}; mean distance {distance:.2} px", descent.stop);
        if let Some(proof) = &descent.certificate {
            let _ = write!(text, "; {proof}");
        }
    }
    if outcome.stand.as_ref().is_some_and(StandOutcome::has_closed) {
        return match outcome.rows {
            0 => {
                format!("leaves cover the picture and show no plants; {plants} places are guesses")
            }
            _ => {
                format!("leaves have closed{rows} and show no plants; {plants} places are guesses")
            }
        };
    }
    if let Some(stand) = &outcome.stand {
        let [low, high] = stand.plants_interval;
        if low < high {
            let _ = write!(text, "; {low:.0} to {high:.0} with a probability of 95 %");
        }
        match (stand.spacing_m, stand.spacing_interval_m) {
            (Some(m), Some(interval)) => {
                let [low, high] = interval.map(|end| 100.0 * end);
                let _ = write!(text, "; spacing {:.1} cm ({low:.1} to {high:.1})", 100.0 * m);
            }
            _ => {
                let _ = write!(text, "; spacing {:.1} px", stand.spacing_px);
            }
        }
        let _ = write!(text, "; {} gaps", stand.gaps);
        if let Some(density) = stand.plants_per_hectare {
            let _ = write!(text, "; {density:.0} plants per hectare of row area");
        }
    }
    text
}

/// Runs the command.
///
/// # Errors
/// As [`locate_plants`] and the stage.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let Args { target, options, hsv, gaps, rows, weeds, trace, figures } = args;
    if target.is_project() {
        target.refuse_of_files(&[
            ("--gaps", gaps.is_some()),
            ("--rows", rows.is_some()),
            ("--weeds", weeds.is_some()),
            ("--trace", trace.is_some()),
            ("--figures", figures.is_some()),
            ("--hsv", hsv.has("hsv")),
        ])?;
        return target.perform((Stage::Locate, locate), options, |config| &config.locate, text);
    }
    let plants = target.file()?;
    let tables = [gaps, rows, weeds, trace].map(Option::as_deref);
    let outputs = given([Some(plants)].into_iter().chain(tables));
    let (options, hsv) = (options.over_defaults()?, hsv.over_defaults()?.hsv);
    let picture = figures.as_deref().map(|folder| (folder, "plants.png"));
    check_files(&outputs, picture, &[target.input()], target.force)?;
    check_tables(&outputs)?;
    let files = LocateFiles {
        plants,
        gaps: gaps.as_deref(),
        rows: rows.as_deref(),
        weeds: weeds.as_deref(),
        trace: trace.as_deref(),
        figures: figures.as_deref(),
        force: target.force,
    };
    let subject = target.input().display().to_string();
    target.present(
        |monitor| {
            let (source, leaf) = read_leaf_mask(target.input(), hsv, monitor)?;
            locate_plants(&source, leaf, &subject, files, &options, monitor)
        },
        text,
    )
}
