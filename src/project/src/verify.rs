//! Whether a run gives the same bytes again.

use super::{Config, Project, Stage, record, run};
use record::{Content, Record};
use rowgram_base::{error::Error, monitor::Monitor, options::Choice};
use rowgram_optim::output::FileError;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A file that is not what its record says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Difference {
    /// The file, relative to the project.
    pub path: PathBuf,
    /// The stage that read or wrote it.
    pub stage: Stage,
    /// When the difference was found.
    pub occasion: Occasion,
    /// Whether there is no such file; else its content differs.
    pub is_missing: bool,
}

/// When a difference was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Occasion {
    /// What the stage read has changed since.
    Input,
    /// What the stage wrote has changed since.
    Output,
    /// Done again, the stage wrote something else.
    Repetition,
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let state = if self.is_missing { "is missing" } else { "is not the same" };
        let (path, stage) = (self.path.display(), self.stage);
        match self.occasion {
            Occasion::Input => write!(f, "{path}, which {stage} read, {state}"),
            Occasion::Output => write!(f, "{path}, which {stage} wrote, {state}"),
            Occasion::Repetition => write!(f, "{path}, written again by {stage}, {state}"),
        }
    }
}

/// What a verification found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct VerifyOutcome {
    /// Number of stages that were done.
    pub stages: usize,
    /// Number of files that they read and wrote.
    pub files: usize,
    /// Files that are not the same.
    pub differences: Vec<Difference>,
}

/// Compares inputs and results with their records; then, unless `files_only` or something differs already, does every
/// recorded stage again with its recorded options in a folder of the project that is removed afterwards, and compares.
///
/// # Errors
/// A project without results, files that cannot be read, a stage that fails.
pub fn verify(
    project: &Project,
    files_only: bool,
    monitor: &mut dyn Monitor,
) -> Result<VerifyOutcome, Error> {
    let root = project.root();
    let records = project.records();
    let done: Vec<Record> =
        Stage::all().into_iter().filter_map(|stage| records.read(stage)).collect();
    if done.is_empty() {
        let message = "there are no results to verify: run `rowgram run` first";
        return Err(FileError::malformed(project.results(), None, message).into());
    }
    let mut outcome = VerifyOutcome { stages: done.len(), files: 0, differences: Vec::new() };
    for record in &done {
        for (occasion, contents) in
            [(Occasion::Input, &record.inputs), (Occasion::Output, &record.outputs)]
        {
            outcome.files += contents.len();
            for content in contents {
                let found = difference(record.stage, content, &root.join(&content.path), occasion)?;
                outcome.differences.extend(found);
            }
        }
    }
    if files_only || !outcome.differences.is_empty() {
        return Ok(outcome);
    }
    // Beside the results, so that a path from them to a photo is the same path.
    let folder = tempfile::Builder::new().prefix(".rowgram-").tempdir_in(root);
    let folder = folder.map_err(|e| FileError::write(root, e))?;
    let again = Project::new(root, settings(project)?)?.with_results(folder.path());
    for record in &done {
        run::repeat(&again, record, monitor)?;
        for content in &record.outputs {
            let path = root.join(&content.path);
            let Ok(inside) = path.strip_prefix(project.results()) else { continue };
            let path = folder.path().join(inside);
            outcome.differences.extend(difference(
                record.stage,
                content,
                &path,
                Occasion::Repetition,
            )?);
        }
    }
    Ok(outcome)
}

/// The settings of the last run where there was one, else those of the project.
fn settings(project: &Project) -> Result<Config, Error> {
    let path = project.results().join(run::RESOLVED_FILE);
    match std::fs::read_to_string(&path) {
        Ok(text) => {
            toml::from_str(&text).map_err(|e| FileError::malformed(&path, None, e.message()).into())
        }
        Err(_) => Ok(project.config().clone()),
    }
}

fn difference(
    stage: Stage,
    expected: &Content,
    path: &Path,
    occasion: Occasion,
) -> Result<Option<Difference>, Error> {
    let is_missing = !path.is_file();
    if !is_missing {
        let found = record::contents(Path::new(""), &[path.to_owned()])?;
        if found.iter().all(|content| content.sha256 == expected.sha256) {
            return Ok(None);
        }
    }
    Ok(Some(Difference { path: expected.path.clone(), stage, occasion, is_missing }))
}
