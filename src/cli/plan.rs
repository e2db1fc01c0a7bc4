//! `rowgram plan`: the work on projects as a graph of commands for Snakemake.

use super::{print, print_json, project::open_with};
use crate::{error::Error, pipeline::plan};
use std::path::PathBuf;

/// Write the work on one project or several as a workflow for Snakemake
///
/// Every stage becomes a task: a command of rowgram with the files that it needs and a file that says it was done. Tasks of
/// one project follow each other; those of different projects, such as the dates of a season, may be done at the same
/// time, on this machine or on the nodes of a cluster that share the folders. The results are those of rowgram run, byte
/// by byte; what was lost is done again.
///
/// Writes Snakefile, plan.json (the tasks) and profiles/local and profiles/slurm into --output.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  rowgram plan field -o work && snakemake --snakefile work/Snakefile --profile work/profiles/local
  rowgram plan season/* -o work && snakemake --snakefile work/Snakefile --profile work/profiles/slurm"
)]
pub(super) struct Args {
    /// Folders of projects.
    #[arg(required = true)]
    projects: Vec<PathBuf>,
    /// Folder for the workflow, made if missing.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Set a key of rowgram.toml in every project; may be given several times.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
    /// Print the tasks as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// Folders that are no projects, settings that cannot be used, outputs that exist.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let projects = args
        .projects
        .iter()
        .map(|root| open_with(root, None, &args.set))
        .collect::<Result<Vec<_>, Error>>()?;
    let workflow = plan::plan(&projects, &args.set)?;
    plan::write(&workflow, &args.output, args.force)?;
    if args.json {
        return print_json(&workflow);
    }
    print(&format!("{} tasks in {}", workflow.tasks.len(), args.output.display()))
}
