//! `rowgram init`: the settings of `rowgram run`, for a person to look through.

use super::config;
use crate::{
    error::Error,
    io::{FileError, output},
};
use std::path::PathBuf;

/// Write rowgram.toml: every setting of rowgram run with its default and what it means
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  rowgram init field")]
pub(in crate::cli) struct Init {
    /// Folder of the project.
    #[arg(default_value = ".")]
    project: PathBuf,
    /// Replace the file that is there.
    #[arg(long)]
    force: bool,
}

impl Init {
    /// Runs the verb.
    ///
    /// # Errors
    /// A folder that is none, a file that exists.
    pub(in crate::cli) fn run(&self) -> Result<(), Error> {
        if !self.project.is_dir() {
            return Err(FileError::malformed(&self.project, None, "expected a folder").into());
        }
        let path = self.project.join(config::NAME);
        output::write(&path, self.force, |out| out.write_all(config::TEMPLATE.as_bytes()))?;
        tracing::info!("{}: look through it, then: rowgram run {}", path.display(), {
            self.project.display()
        });
        Ok(())
    }
}
