//! What the commands of stages have in common: they work on a project, or on a single file.

use super::{
    options::Given,
    project::{open_for, present},
};
use rowgram_base::{error::Error, monitor::Monitor, options::Options};
use rowgram_optim::output::{self, FileError, same_file};
use rowgram_project::{Config, Project, Stage};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// The project or file, and where results go.
#[derive(Debug, clap::Args)]
pub(super) struct Target {
    /// A project (a folder), or a single file.
    #[arg(value_name = "PROJECT|FILE", required = true)]
    input: Option<PathBuf>,
    /// Of a project: the folder of results [default: PROJECT/rowgram]. Of a file: the file to write.
    #[arg(short, long, value_name = "PATH")]
    output: Option<PathBuf>,
    /// Repeat the stage although nothing has changed (results that were edited since are kept beside, as NAME.edited); replace
    /// files that exist.
    #[arg(long)]
    pub(super) force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    pub(super) json: bool,
}

/// A stage of the library.
pub(super) type StageFunction<O, R> = fn(&Project, &O, &mut dyn Monitor) -> Result<R, Error>;

impl Target {
    /// The project or file; the folder here where a subcommand stands in its place.
    pub(super) fn input(&self) -> &Path {
        self.input.as_deref().unwrap_or(Path::new("."))
    }

    /// Whether it is a project.
    pub(super) fn is_project(&self) -> bool {
        self.input().is_dir()
    }

    /// Where results go, if that is given.
    pub(super) fn output(&self) -> Option<&Path> {
        self.output.as_deref()
    }

    /// The file to write for a single file.
    ///
    /// # Errors
    /// Where it is not given.
    pub(super) fn file(&self) -> Result<&Path, Error> {
        self.output.as_deref().ok_or_else(|| {
            let input = self.input().display();
            Error::Argument(format!("{input} is a single file: give the file to write (--output)"))
        })
    }

    /// Refuses options of single files for a project.
    ///
    /// # Errors
    /// The first one that was given.
    pub(super) fn refuse_of_files(&self, options: &[(&str, bool)]) -> Result<(), Error> {
        match options.iter().find(|(_, given)| *given) {
            Some((name, _)) => Err(Error::Argument(format!(
                "{name} is for single files; a project has its files at their places"
            ))),
            None => Ok(()),
        }
    }

    /// Does a stage of the project, with the options of its settings and of the command line, and presents the outcome.
    ///
    /// # Errors
    /// Settings that cannot be understood, and as the stage.
    pub(super) fn perform<O: Options, R: Serialize>(
        &self,
        (stage, work): (Stage, StageFunction<O, R>),
        given: &Given<O>,
        of: fn(&Config) -> &O,
        text: impl FnOnce(&R) -> String,
    ) -> Result<(), Error> {
        let project = open_for(stage, self.input(), self.output.as_deref(), self.force)?;
        let options = given.over(of(project.config()))?;
        self.present(|monitor| work(&project, &options, monitor), text)
    }

    /// Does some work with the terminal as listener and presents what came of it.
    ///
    /// # Errors
    /// As the work; [`Error::Incomplete`] where a diagnostic says that the result should not be used.
    pub(super) fn present<O: Serialize>(
        &self,
        work: impl FnOnce(&mut dyn Monitor) -> Result<O, Error>,
        text: impl FnOnce(&O) -> String,
    ) -> Result<(), Error> {
        present(self.json, work, text)
    }
}

/// Refuses outputs that are inputs, are given twice, or cannot be written, before any work is done.
///
/// # Errors
/// Which, and why.
pub(super) fn check_paths(outputs: &[&Path], inputs: &[&Path], force: bool) -> Result<(), Error> {
    for (index, path) in outputs.iter().enumerate() {
        let shown = path.display();
        if inputs.iter().any(|input| same_file(path, input)) {
            return Err(Error::Argument(format!("{shown} is an input, expected another output")));
        }
        if outputs[..index].iter().any(|other| same_file(path, other)) {
            return Err(Error::Argument(format!("{shown} is given for two outputs")));
        }
        output::check(path, force)?;
    }
    for input in inputs {
        if input.is_dir() {
            let source = std::io::Error::new(std::io::ErrorKind::IsADirectory, "it is a folder");
            return Err(FileError::read(input, source).into());
        }
    }
    Ok(())
}

/// As [`check_paths`], and refuses a picture that exists in the folder of pictures.
///
/// # Errors
/// As [`check_paths`].
pub(super) fn check_files(
    outputs: &[&Path],
    picture: Option<(&Path, &str)>,
    inputs: &[&Path],
    force: bool,
) -> Result<(), Error> {
    check_paths(outputs, inputs, force)?;
    let picture = picture.map(|(folder, name)| folder.join(name)).filter(|path| path.exists());
    match picture {
        Some(path) => check_paths(&[outputs, &[path.as_path()]].concat(), inputs, force),
        None => Ok(()),
    }
}

/// Refuses tables that are written as CSV under the name of another format.
///
/// # Errors
/// Which, and what was expected.
pub(super) fn check_tables(paths: &[&Path]) -> Result<(), Error> {
    const OTHERS: [&str; 8] = ["gpkg", "geojson", "shp", "parquet", "json", "xlsx", "png", "tif"];
    let is_other = |path: &&&Path| {
        let ending = path.extension();
        ending.is_some_and(|ending| OTHERS.iter().any(|of| ending.eq_ignore_ascii_case(of)))
    };
    match paths.iter().find(is_other) {
        None => Ok(()),
        Some(path) => Err(Error::Argument(format!(
            "{}: it would be a table of text, expected a name that ends in .csv",
            path.display()
        ))),
    }
}

/// The paths that are given, of some that need not be.
pub(super) fn given<'a>(paths: impl IntoIterator<Item = Option<&'a Path>>) -> Vec<&'a Path> {
    paths.into_iter().flatten().collect()
}
