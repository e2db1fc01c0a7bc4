//! `rowgram plan`: the work on projects as a graph of commands for Snakemake.

use super::{print, print_json, project::open_with};
use rowgram_base::error::Error;
use rowgram_project::{
    plan::{self, PlanOptions, Work},
    season::SeasonFile,
};
use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

/// Write the work on projects and seasons as a workflow for Snakemake
///
/// Every stage becomes a task: a command of rowgram with the files that it needs and a file that says it was done. Tasks of
/// one project follow each other; those of different projects, such as the dates of a season, may be done at the same
/// time, on this machine or on the nodes of a cluster that share the folders. The results are those of rowgram run, byte
/// by byte; what was lost is done again.
///
/// Of projects with more photos than --photos-per-task, the long steps are in parts that may be done at the same time:
/// features and matches of photos, and tiles of the surface. Of a season, all flights may be done at the same time, and rowgram
/// season comes last.
///
/// Writes Snakefile, plan.json (the tasks) and profiles/local and profiles/slurm into --output.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  rowgram plan field -o work && snakemake --snakefile work/Snakefile --profile work/profiles/local
  rowgram plan trial/season.toml -o work && snakemake --snakefile work/Snakefile --profile work/profiles/slurm"
)]
pub(super) struct Args {
    /// Folders of projects, and lists of flights of a season (season.toml).
    #[arg(required = true, value_name = "PROJECT|SEASON")]
    projects: Vec<PathBuf>,
    /// Folder for the workflow, made if missing.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// The most photos of one task of features or matches; projects with more have them in parts.
    #[arg(long, value_name = "N", default_value_t = PHOTOS_PER_TASK)]
    photos_per_task: NonZeroUsize,
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

/// Features of so many photos of 12 megapixels take five minutes of processor time: 14.2 s for 12 photos (`rowgram align` of a synthetic
/// flight at that size).
const PHOTOS_PER_TASK: NonZeroUsize = NonZeroUsize::new(250).unwrap();

/// Runs the command.
///
/// # Errors
/// Folders that are no projects, settings that cannot be used, outputs that exist.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let open = |root: &Path| open_with(root, None, &args.set);
    let work = args.projects.iter().map(|path| {
        if path.is_file() {
            let file = SeasonFile::read(path)?;
            let folders = file.flights.iter().map(|flight| file.root().join(&flight.project));
            let flights = folders.map(|folder| open(&folder)).collect::<Result<Vec<_>, Error>>()?;
            return Ok(Work::Season { file: Box::new(file), flights });
        }
        Ok(Work::Project(Box::new(open(path)?)))
    });
    let work = work.collect::<Result<Vec<_>, Error>>()?;
    let options =
        PlanOptions { settings: args.set.clone(), photos_per_task: Some(args.photos_per_task) };
    let workflow = plan::plan(&work, &options)?;
    plan::write(&workflow, &args.output, args.force)?;
    if args.json {
        return print_json(&workflow);
    }
    print(&format!("{} tasks in {}", workflow.tasks.len(), args.output.display()))
}
