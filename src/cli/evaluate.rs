//! `rowgram evaluate`: found plants against the truth, of a project or of two files.

use super::{
    options::Given,
    print, print_json,
    stage::{Target, check_paths},
};
use rowgram_base::error::Error;
use rowgram_optim::output;
use rowgram_project::{
    Stage,
    evaluate::{EvaluateOptions, EvaluateOutcome, evaluate, evaluate_positions},
};
use std::path::PathBuf;

/// Compare located plants with the true ones
///
/// Pairs found and true plants one to one: as many pairs as possible within the radius, and among those the shortest in sum.
/// Prints precision, recall and F1 at each radius, and the median and RMS distance of the pairs at the largest.
///
/// Of a project, its plants are compared with [project] truth, in the mapping frame. Two files are CSV, read by header
/// (u_px,v_px or x,y; other columns are allowed) or, without one, as two columns; positions in pixels, the centre of the
/// top-left pixel at (0, 0). With --output their comparison is also written, as JSON.
///
/// Example: rowgram evaluate field
/// Example: rowgram evaluate plants.csv truth.csv --radius-px 5,10
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    target: Target,
    /// Of a file of located plants: the plants that are there (CSV).
    truth: Option<PathBuf>,
    /// Of two files: how far from a true plant a found one may be; one number or several.
    #[arg(
        long,
        alias = "radius",
        value_name = "PX[,PX...]",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    radius_px: Vec<f64>,
    #[command(flatten)]
    options: Given<EvaluateOptions>,
}

fn text(outcome: &EvaluateOutcome) -> String {
    let score = &outcome.score;
    let mut text = format!("{} true plants, {} found", score.truth, score.found);
    for (radius_m, radius) in outcome.radii_m.iter().zip(&score.radii) {
        if let Some(f1) = radius.f1 {
            text += &format!("; F1 {f1:.3} within {radius_m} m");
        }
    }
    text
}

/// Runs the command.
///
/// # Errors
/// Where a radius or a file cannot be used; as the stage.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let Args { target, truth, radius_px, options } = args;
    let Some(truth) = truth else {
        if !target.is_project() {
            let found = target.input().display();
            return Err(Error::Argument(format!("{found}: expected also a file of true plants")));
        }
        target.refuse_of_files(&[("--radius-px", !radius_px.is_empty())])?;
        let stage = (Stage::Evaluate, evaluate as _);
        return target.perform(stage, options, |config| &config.evaluate, text);
    };
    let output = target.output();
    if let Some(path) = output {
        output::expect_ending(path, &["json"])?;
        check_paths(&[path], &[target.input(), truth], target.force)?;
    }
    let score =
        evaluate_positions(target.input(), truth, radius_px).map_err(|error| match error {
            Error::Argument(why) => Error::Argument(format!("--radius-px: {why}")),
            other => other,
        })?;
    if let Some(path) = output {
        output::write_json(path, target.force, &score)?;
    }
    if target.json { print_json(&score) } else { print(&score.to_string()) }
}
