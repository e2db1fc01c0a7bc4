//! `rowgram init`: the settings of a project, for a person to look through.

use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use rowgram_project::{Config, SETTINGS};
use std::path::PathBuf;

/// Write rowgram.toml: the main settings with their defaults, their limits and what they mean
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  rowgram init field")]
pub(super) struct Args {
    /// Folder of the project; it is made where there is none.
    #[arg(default_value = ".")]
    project: PathBuf,
    /// Write the options for experts too.
    #[arg(long)]
    experts: bool,
    /// Replace the file that is there.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
///
/// # Errors
/// A folder that is none, a file that exists.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if args.project.exists() && !args.project.is_dir() {
        return Err(FileError::malformed(&args.project, None, "expected a folder").into());
    }
    std::fs::create_dir_all(&args.project).map_err(|e| FileError::write(&args.project, e))?;
    let path = args.project.join(SETTINGS);
    output::write(&path, args.force, |out| {
        out.write_all(Config::template(args.experts).as_bytes())
    })?;
    let project = args.project.display();
    tracing::info!("{}: look through it, then: rowgram run {project}", path.display());
    Ok(())
}
