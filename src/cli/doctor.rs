//! `rowgram doctor`: what a project lacks, before hours are spent on it.

use super::{print, print_json};
use rowgram_base::{error::Error, monitor::Severity};
use rowgram_project as pipeline;
use std::path::PathBuf;

/// Check a project: photos, EXIF, ground points, overlap, settings
///
/// Reads the heads of the photos and all tables, and says what is missing, what contradicts itself and what that
/// will mean. Nothing is written. Exit code 3 where something has to be put right first.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Example:
  rowgram doctor field"
)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Print one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// A project that is no folder, and [`Error::Incomplete`] where something has to be put right first.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let found = pipeline::doctor::doctor(&args.project, pipeline::environment()?.into_iter())?;
    if args.json {
        print_json(&found)?;
    } else {
        let lines = found.iter().map(|found| {
            let state = match found.severity {
                Severity::Info => "good",
                Severity::Warning => "warning",
                Severity::Error => "error",
            };
            format!("{state:<8} {found}\n")
        });
        print(&lines.collect::<String>())?;
    }
    match found.iter().filter(|found| found.severity == Severity::Error).count() {
        0 => Ok(()),
        n => {
            let errors = if n == 1 { "error" } else { "errors" };
            let project = args.project.display();
            Err(Error::Incomplete(format!(
                "{project}: {n} {errors} to be corrected first, listed above"
            )))
        }
    }
}
