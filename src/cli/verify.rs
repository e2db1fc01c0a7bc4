//! `rowgram verify`: whether a run gives the same bytes again.

use super::{print, print_json, project, terminal::Terminal};
use rowgram_base::error::Error;
use rowgram_project::verify;
use std::path::PathBuf;

/// Do a run again from its inputs and compare all files byte by byte
///
/// Inputs, settings and results must be as they were, with no other file among the results; every stage is done again in a
/// folder of the project that is removed afterwards, with the options of its record, and its files and what it found are
/// compared with the recorded ones. With --files nothing is done again: only files are compared with what records and the
/// manifest say of them. Exit code 3 where something differs.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  rowgram verify field
  rowgram verify field --files"
)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Folder of the results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Only look whether inputs and results are what they were.
    #[arg(long)]
    files: bool,
    /// Print one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// A project without a run, and [`Error::Incomplete`] where something differs.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = project::open(&args.project, args.output.as_deref())?;
    let mut terminal = Terminal::new();
    let outcome = verify::verify(&project, args.files, &mut terminal)?;
    drop(terminal);
    if args.json {
        print_json(&outcome)?;
    } else {
        let mut text = format!("{} stages, {} files", outcome.stages, outcome.files);
        for difference in &outcome.differences {
            text += &format!("\n  {difference}");
        }
        if outcome.differences.is_empty() {
            text += if args.files { ": all as recorded" } else { ": the same bytes again" };
        }
        print(&text)?;
    }
    match outcome.differences.len() {
        0 => Ok(()),
        1 => Err(Error::Incomplete("1 file differs".to_owned())),
        n => Err(Error::Incomplete(format!("{n} files differ"))),
    }
}
