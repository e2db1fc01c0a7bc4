//! Whether results are as they were written, and whether the work gives the same bytes again.

use super::{Config, Project, Stage, record, run};
use record::{Content, MANIFEST, Manifest, Record, Records};
use rowgram_base::{error::Error, monitor::Monitor, options::Choice};
use rowgram_optim::output::FileError;
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

/// A file that is not what its record, or the manifest, says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Difference {
    /// The file, relative to the project.
    pub path: PathBuf,
    /// The stage that read or wrote it; `None` for files of the whole run.
    pub stage: Option<Stage>,
    /// When the difference was found.
    pub occasion: Occasion,
    /// Whether there is no such file; else its content differs.
    pub is_missing: bool,
}

/// When a difference was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Occasion {
    /// What was read has changed since.
    Input,
    /// What was written has changed since.
    Output,
    /// It is among the results, and nothing says that it was written.
    Foreign,
    /// Done again, the stage wrote something else.
    Repetition,
    /// Done again, the stage found something else, which its record says.
    Outcome,
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let state = if self.is_missing { "is missing" } else { "is not the same" };
        let path = self.path.display();
        let stage = self.stage.map_or_else(|| "the run".to_owned(), |stage| stage.word());
        match self.occasion {
            Occasion::Input => write!(f, "{path}, which {stage} read, {state}"),
            Occasion::Output => write!(f, "{path}, which {stage} wrote, {state}"),
            Occasion::Foreign => {
                write!(f, "{path}, which is among the results, was not written by rowgram")
            }
            Occasion::Repetition => write!(f, "{path}, written again by {stage}, {state}"),
            Occasion::Outcome => {
                write!(f, "{path}: what {stage} found is not the same, done again")
            }
        }
    }
}

/// What a verification found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct VerifyOutcome {
    /// Number of stages that were done.
    pub stages: usize,
    /// Number of files that were read and written.
    pub files: usize,
    /// Files that are not the same.
    pub differences: Vec<Difference>,
}

/// Compares inputs and results with their records, and these and all other results with the manifest; then, unless `files_only` or
/// something differs already, does every recorded stage again with its recorded options in a folder of the project that is removed
/// afterwards, and compares.
///
/// # Errors
/// A project without results, files that cannot be read, a stage that fails.
pub fn verify(
    project: &Project,
    files_only: bool,
    monitor: &mut dyn Monitor,
) -> Result<VerifyOutcome, Error> {
    let (root, results) = (project.root(), project.results());
    let records = project.records();
    let done: Vec<Record> =
        Stage::all().into_iter().filter_map(|stage| records.stored(stage)).collect();
    let manifest = Manifest::read(results);
    if done.is_empty() && !results.join(MANIFEST).exists() {
        let message = "there are no results to verify: run `rowgram run` first";
        return Err(FileError::malformed(results, None, message).into());
    }
    let mut found = Comparison { root, files: 0, differences: Vec::new() };
    let mut known: BTreeSet<PathBuf> = BTreeSet::new();
    match &manifest {
        None => found.tell(&results.join(MANIFEST), None, Occasion::Output),
        Some(manifest) => {
            for content in &manifest.files {
                let path = results.join(&content.path);
                // A record that is gone is missed here.
                found.compare(content, &path, None, Occasion::Output)?;
                known.insert(record::absolute(&path));
            }
            let settings = project.settings_file();
            match (&manifest.settings, &settings) {
                (Some(content), _) => {
                    found.compare(content, &root.join(&content.path), None, Occasion::Input)?;
                }
                (None, Some(path)) if manifest.lists_run() => {
                    found.tell(path, None, Occasion::Input);
                }
                _ => {}
            }
        }
    }
    for record in &done {
        let stage = Some(record.stage);
        for (occasion, contents) in
            [(Occasion::Input, &record.inputs), (Occasion::Output, &record.outputs)]
        {
            for content in contents {
                let path = root.join(&content.path);
                found.compare(content, &path, stage, occasion)?;
                if occasion == Occasion::Output {
                    known.insert(record::absolute(&path));
                }
            }
        }
    }
    for path in files_of_results(project)? {
        if !known.contains(&record::absolute(&path)) {
            found.tell(&path, None, Occasion::Foreign);
        }
    }
    if !files_only && found.differences.is_empty() {
        repeat(project, &done, &mut found, monitor)?;
    }
    let Comparison { files, differences, .. } = found;
    Ok(VerifyOutcome { stages: done.len(), files, differences })
}

/// The files of stages, their records, and what else is in a folder that holds nothing but results.
fn files_of_results(project: &Project) -> Result<Vec<PathBuf>, Error> {
    let results = project.results();
    let is_own = !project.root().starts_with(results) && project.root() != results;
    if is_own {
        let mut found = record::files(results)?;
        let is_apart = |path: &PathBuf| {
            *path == results.join(MANIFEST) || path.starts_with(results.join("plan"))
        };
        found.retain(|path| !is_apart(path));
        return Ok(found);
    }
    let mut found = Vec::new();
    let folders = Stage::all().into_iter().map(|stage| stage.word());
    for folder in folders.chain([record::STAGES.to_owned()]) {
        let folder = results.join(folder);
        if folder.is_dir() {
            found.extend(record::files(&folder)?);
        }
    }
    Ok(found)
}

/// Does every recorded stage again.
fn repeat(
    project: &Project,
    done: &[Record],
    found: &mut Comparison<'_>,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let root = project.root();
    // Beside the results, so that a path from them to a photo is the same path.
    let folder = tempfile::Builder::new().prefix(".rowgram-").tempdir_in(root);
    let folder = folder.map_err(|e| FileError::write(root, e))?;
    let again = Project::new(root, settings(project)?)?.with_results(folder.path());
    for record in done {
        run::repeat(&again, record, monitor)?;
        let stage = Some(record.stage);
        let place =
            |path: &Path| Some(project.results().join(path.strip_prefix(folder.path()).ok()?));
        let Some(repeated) = again.records().read(record.stage) else { continue };
        let written: Vec<Content> = repeated
            .outputs
            .into_iter()
            .filter_map(|content| {
                let path = record::relative(root, &place(&root.join(&content.path))?);
                Some(Content { path, ..content })
            })
            .collect();
        let either = record.outputs.iter().chain(&written);
        let paths: BTreeSet<&PathBuf> = either.map(|content| &content.path).collect();
        for path in paths {
            let of = |all: &[Content]| all.iter().find(|content| content.path == *path).cloned();
            let (before, now) = (of(&record.outputs), of(&written));
            if before != now {
                found.push(root.join(path), stage, Occasion::Repetition, now.is_none());
            }
        }
        // An outcome may name files among the results.
        let own = |path: &Path| record::relative(root, path).to_string_lossy().into_owned();
        // As text: a number that is read once more may be another in its last bit.
        let text =
            repeated.outcome.to_string().replace(&own(folder.path()), &own(project.results()));
        let stated = record.outcome.to_string();
        if text != stated {
            let path = project.results().join(Records::name(record.stage));
            found.push(path, stage, Occasion::Outcome, false);
        }
    }
    Ok(())
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

/// What was compared so far.
struct Comparison<'a> {
    root: &'a Path,
    files: usize,
    differences: Vec<Difference>,
}

impl Comparison<'_> {
    fn compare(
        &mut self,
        expected: &Content,
        path: &Path,
        stage: Option<Stage>,
        occasion: Occasion,
    ) -> Result<(), Error> {
        self.files += 1;
        if !path.is_file() || !Content::read(self.root, path)?.is_same(expected) {
            self.tell(path, stage, occasion);
        }
        Ok(())
    }

    fn tell(&mut self, path: &Path, stage: Option<Stage>, occasion: Occasion) {
        self.push(path.to_owned(), stage, occasion, !path.is_file());
    }

    fn push(&mut self, path: PathBuf, stage: Option<Stage>, occasion: Occasion, is_missing: bool) {
        let path = record::relative(self.root, &path);
        self.differences.push(Difference { path, stage, occasion, is_missing });
    }
}
