//! `rowgram targets`: arguments in, marks or a sheet out; see [`rowgram_project::targets`].

use super::{options::Given, project};
use rowgram_base::error::Error;
use rowgram_project::targets::{TargetsOptions, print_targets, targets};
use std::path::PathBuf;

/// Find ground control targets in the photos
///
/// PROJECT is a folder after rowgram align, with surveyed points in gcps.csv. Their targets are looked for where the block has
/// them, measured to about a tenth of a pixel, and checked by all photos together. Writes marks.csv beside the photos (image, label,
/// u_px, v_px, sigma_px, source), which the next rowgram run uses, and, among the results, targets/targets.csv with every target in every
/// photo and targets/targets.png, a contact sheet: a row for each target, green where it was found.
///
/// Targets are chequered plates of four squares, white crosses or discs on darker ground, AprilTag 36h11 or ArUco 4x4_50. Coded
/// ones need no list of which code is where: positions tell. --print makes targets to print instead.
///
/// Marks made by hand stay as they are; those found before (source: found) are found anew. rowgram view shows all of them.
///
/// Exit code 3 where nothing was found that photos agree about.
///
/// Examples:
///   rowgram align field && rowgram targets field && rowgram run field
///   rowgram targets field --kind cross --size-m 0.6
///   rowgram targets --print sheet.pdf --kind apriltag --size-m 0.5 --count 12
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    project: project::ProjectArgs,
    #[command(flatten)]
    options: Given<TargetsOptions>,
    /// Write targets to print into this PDF, in true size, one on a page.
    #[arg(long, value_name = "FILE.pdf", conflicts_with_all = ["project", "output", "json"])]
    print: Option<PathBuf>,
    /// Number of targets to print.
    #[arg(long, value_name = "N", default_value_t = 1, requires = "print")]
    count: usize,
    /// Code of the first target to print.
    #[arg(long, value_name = "CODE", default_value_t = 0, requires = "print")]
    first: usize,
    /// Replace marks made by hand too, or a file that exists.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
///
/// # Errors
/// As [`targets`] and [`print_targets`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if let Some(path) = &args.print {
        let options = args.options.over_defaults()?;
        return print_targets(&options, (args.first, args.count), path, args.force);
    }
    let project = args.project.open()?;
    let options = args.options.over(&project.config().targets)?;
    project::present(
        args.project.json,
        |monitor| targets(&project, &options, args.force, monitor),
        ToString::to_string,
    )
}
