//! What commands on a project share: opening it, doing a stage, showing what came of it.

use super::terminal::Terminal;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Recorder, Severity},
};
use rowgram_project::{Config, Project, Stage, environment};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// A project, and where its results go.
#[derive(Debug, clap::Args)]
pub(super) struct ProjectArgs {
    /// Folder of the project.
    #[arg(required = true)]
    project: Option<PathBuf>,
    /// Folder of results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    pub(super) json: bool,
}

impl ProjectArgs {
    /// Its folder; the one here where a subcommand or another argument stands in its place.
    pub(super) fn root(&self) -> &Path {
        self.project.as_deref().unwrap_or(Path::new("."))
    }

    /// As [`open`].
    pub(super) fn open(&self) -> Result<Project, Error> {
        open(self.root(), self.output.as_deref())
    }

    /// As [`open_for`].
    pub(super) fn open_for(&self, stage: Stage, force: bool) -> Result<Project, Error> {
        open_for(stage, self.root(), self.output.as_deref(), force)
    }

    /// As [`with_config`].
    pub(super) fn with_config(&self, config: Config) -> Result<Project, Error> {
        with_config(self.root(), self.output.as_deref(), config)
    }
}

/// The project in a folder, with the settings of its file and of the environment.
///
/// # Errors
/// A folder that is none, settings that cannot be understood.
pub(super) fn open(root: &Path, results: Option<&Path>) -> Result<Project, Error> {
    open_with(root, results, &[])
}

/// As [`open`], with `settings` (`section.key=value`) over the file and the environment.
///
/// # Errors
/// As [`open`].
pub(super) fn open_with(
    root: &Path,
    results: Option<&Path>,
    settings: &[String],
) -> Result<Project, Error> {
    let config = Config::read(root, environment()?.into_iter(), settings)?;
    with_config(root, results, config)
}

/// The project in a folder, with these settings.
///
/// # Errors
/// A folder that is none.
pub(super) fn with_config(
    root: &Path,
    results: Option<&Path>,
    config: Config,
) -> Result<Project, Error> {
    let project = Project::new(root, config)?;
    Ok(match results {
        Some(folder) => project.with_results(folder),
        None => project,
    })
}

/// As [`open`]; with `force`, `stage` is done again even where nothing has changed, and files in its way are kept beside.
///
/// # Errors
/// As [`open`].
pub(super) fn open_for(
    stage: Stage,
    root: &Path,
    results: Option<&Path>,
    force: bool,
) -> Result<Project, Error> {
    let project = open(root, results)?;
    Ok(project.again(force.then_some(stage)).forced(force))
}

#[derive(Serialize)]
struct WithDiagnostics<'a, T> {
    #[serde(flatten)]
    outcome: &'a T,
    diagnostics: &'a [Diagnostic],
}

/// Does some work with the terminal as its listener, then prints what came of it: as JSON with the diagnostics, or as text.
///
/// # Errors
/// As the work says; [`Error::Incomplete`] where a diagnostic forbids the use of the result.
pub(super) fn present<T: Serialize>(
    json: bool,
    work: impl FnOnce(&mut dyn Monitor) -> Result<T, Error>,
    text: impl FnOnce(&T) -> String,
) -> Result<(), Error> {
    let mut terminal = Terminal::new();
    let mut recorder = Recorder::new(&mut terminal);
    let outcome = work(&mut recorder)?;
    let diagnostics = recorder.diagnostics;
    drop(terminal);
    if json {
        super::print_json(&WithDiagnostics { outcome: &outcome, diagnostics: &diagnostics })?;
    } else {
        super::print(&text(&outcome))?;
    }
    let severe: Vec<String> = diagnostics
        .iter()
        .filter(|found| found.severity == Severity::Error)
        .map(ToString::to_string)
        .collect();
    if severe.is_empty() { Ok(()) } else { Err(Error::Incomplete(severe.join("\n"))) }
}
