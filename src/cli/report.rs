//! `rowgram report`: the page of the last run, written again.

use super::{print, print_json, project, run::judge};
use rowgram_base::error::Error;
use rowgram_project::{report, run::RunOutcome};
use std::path::PathBuf;

/// Write the report of a run again: report.html
///
/// Reads what the stages of rowgram run left in PROJECT/rowgram. The page is one file: it can be sent, printed and
/// read without a network. Exit code 3 where a quality check is red.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Example:
  rowgram report field"
)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Folder of the results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Replace files that were edited since, or that rowgram did not write: they are kept beside, as NAME.edited.
    #[arg(long)]
    force: bool,
    /// Print the outcome of the run as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// A project without results, files that cannot be read or written, and [`Error::Incomplete`] where a check is red.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = project::open(&args.project, args.output.as_deref())?.forced(args.force);
    let outcome = RunOutcome::of_last_run(&project)?;
    let page = report::write(&project, &outcome)?;
    if args.json {
        print_json(&outcome)?;
    } else {
        print(&format!("{}\nreport  {}", report::summary(&outcome), page.display()))?;
    }
    judge(&outcome, None)
}
