//! `rowgram completions` and `rowgram man`: what shells and readers of manuals know of the program.

use super::{Cli, print};
use crate::{error::Error, io::FileError};
use clap::CommandFactory;
use clap_complete::Shell;
use std::path::{Path, PathBuf};

/// Print the completions of a shell
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram completions bash > ~/.local/share/bash-completion/completions/rowgram
  rowgram completions fish > ~/.config/fish/completions/rowgram.fish")]
pub(super) struct Completions {
    /// The shell.
    #[arg(value_enum)]
    shell: Shell,
}

impl Completions {
    /// Runs the verb.
    ///
    /// # Errors
    /// Where stdout is closed.
    pub(super) fn run(&self) -> Result<(), Error> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Cli::command(), "rowgram", &mut script);
        print(&String::from_utf8_lossy(&script))
    }
}

/// Print the manual page, or write those of all verbs into a folder
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram man | man -l -
  rowgram man -o ~/.local/share/man/man1")]
pub(super) struct Man {
    /// Folder for the pages of all verbs: rowgram.1, rowgram-align.1 and so on.
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

impl Man {
    /// Runs the verb.
    ///
    /// # Errors
    /// Where a page cannot be written.
    pub(super) fn run(&self) -> Result<(), Error> {
        if let Some(folder) = &self.output {
            std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
            return clap_mangen::generate_to(Cli::command(), folder)
                .map_err(|e| FileError::write(folder, e).into());
        }
        let mut page = Vec::new();
        clap_mangen::Man::new(Cli::command())
            .render(&mut page)
            .map_err(|e| FileError::write(Path::new("stdout"), e))?;
        print(&String::from_utf8_lossy(&page))
    }
}
