//! The stages from photos to traits, and what they have in common.

use super::{Project, record};
use record::Record;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Recorder},
    options::{Choice, Options},
};
use rowgram_optim::output::FileError;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::{
    path::{Path, PathBuf},
    time::Instant,
};

/// A stage, in the order in which they are done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stage {
    /// A camera from photos of a chessboard.
    Calibrate,
    /// Photos to a reconstruction in the mapping frame.
    Align,
    /// The surface from the tie points.
    Dem,
    /// The dense surface: canopy and ground.
    Surface,
    /// The orthomosaic.
    Ortho,
    /// The leaf mask.
    Segment,
    /// Local density of leaf pixels.
    LeafDensity,
    /// Number of leaves from the area that they cover.
    LeafCount,
    /// The place of every plant.
    Locate,
    /// Single leaves.
    Leaves,
    /// Traits of plots.
    Plots,
    /// Comparison with ground truth.
    Evaluate,
}

rowgram_base::choices!(Stage: Calibrate, Align, Dem, Surface, Ortho, Segment, LeafDensity, LeafCount, Locate, Leaves, Plots, Evaluate);

/// What a stage reads, does and gives.
///
/// The record of a stage names the build of the program, the options and the contents of everything that was read. While
/// none of them changes and its files are as they were written, the stage is not done again.
pub trait Task {
    /// How it is done.
    type Options: Options;
    /// What came of it; kept in the record, so it can be had again without doing the work.
    type Outcome: Serialize + DeserializeOwned;
    /// Which stage it is.
    const STAGE: Stage;
    /// Whether its folder keeps what an earlier attempt that was interrupted has found.
    const RESUMES: bool = false;

    /// The files that it reads.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where the project has no input for it, and why.
    fn inputs(project: &Project, options: &Self::Options) -> Result<Vec<PathBuf>, Error>;

    /// What of the project, besides options and files, decides the result.
    fn context(_project: &Project) -> String {
        String::new()
    }

    /// Does it, writing into `folder`.
    ///
    /// # Errors
    /// As the stage says.
    fn work(
        project: &Project,
        options: &Self::Options,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<Self::Outcome, Error>;
}

/// What has become of a stage.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Whether its result is there and current.
    pub is_current: bool,
    /// The command that does it alone, as a person types it in the folder of the project.
    pub command: String,
}

/// Whether a stage has to be done, and by which command it would be.
///
/// # Errors
/// As [`Task::inputs`]; inputs that cannot be read.
pub fn state<T: Task>(project: &Project, options: &T::Options) -> Result<State, Error> {
    let files = T::inputs(project, options)?;
    let records = project.records();
    // Contents are read where there is something to compare them with: of thousands of photos that takes minutes.
    let is_current = records.read(T::STAGE).is_some() && {
        let inputs = record::contents(project.root(), &files)?;
        records.kept(T::STAGE, &key::<T>(project, options, &inputs))?.is_some()
    };
    Ok(State { is_current, command: command::<T>(options) })
}

/// Does a stage, unless its result is there and current, and gives what came of it.
///
/// # Errors
/// Options beyond their limits, [`Error::NothingToDo`] where the project has no input for it, a project that another
/// process is working on, and what the stage itself says.
pub fn perform<T: Task>(
    project: &Project,
    options: &T::Options,
    monitor: &mut dyn Monitor,
) -> Result<T::Outcome, Error> {
    let section = <T::Options as Options>::SECTION;
    options.validate().map_err(|why| Error::Argument(format!("[{section}] {why}")))?;
    let _lock = project.lock()?;
    let stage = T::STAGE.word();
    let inputs = record::contents(project.root(), &T::inputs(project, options)?)?;
    let key = key::<T>(project, options, &inputs);
    let records = project.records();
    monitor.stage(&stage);
    if let Some(kept) = records.kept(T::STAGE, &key)?
        && let Ok(outcome) = serde_json::from_value(kept.outcome)
    {
        kept.diagnostics.iter().for_each(|found| monitor.diagnostic(found));
        let message = "nothing has changed since it was done: kept";
        monitor.diagnostic(&Diagnostic::info("stage-kept", stage, message));
        return Ok(outcome);
    }
    let begin = Instant::now();
    records.forget(T::STAGE)?;
    let folder = project.folder(T::STAGE);
    if !T::RESUMES && folder.is_dir() {
        std::fs::remove_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
    }
    std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
    let mut recorder = Recorder::new(monitor);
    let outcome = T::work(project, options, &folder, &mut recorder)?;
    let diagnostics = recorder.diagnostics;
    let written = record::files(&folder, &[super::CACHE])?;
    records.write(&Record {
        stage: T::STAGE,
        key,
        command: command::<T>(options),
        options: as_value(&folder, options)?,
        version: env!("CARGO_PKG_VERSION").to_owned(),
        build: crate::BUILD.to_owned(),
        inputs,
        outputs: record::contents(project.root(), &written)?,
        outcome: as_value(&folder, &outcome)?,
        diagnostics,
        seconds: begin.elapsed().as_secs_f64(),
        peak_memory_mb: super::peak_memory_mb(),
    })?;
    Ok(outcome)
}

/// Removes the results of an earlier attempt, but not what it keeps for the next.
pub(super) fn clear(folder: &Path) -> Result<(), Error> {
    for entry in std::fs::read_dir(folder).map_err(|e| FileError::read(folder, e))? {
        let entry = entry.map_err(|e| FileError::read(folder, e))?;
        let path = entry.path();
        if entry.file_name() == super::CACHE {
            continue;
        }
        let removed = if path.is_dir() {
            std::fs::remove_dir_all(&path)
        } else {
            std::fs::remove_file(&path)
        };
        removed.map_err(|e| FileError::write(&path, e))?;
    }
    Ok(())
}

fn as_value(folder: &Path, what: &impl Serialize) -> Result<serde_json::Value, Error> {
    let failed = |e| FileError::write(folder, std::io::Error::other(e));
    Ok(serde_json::to_value(what).map_err(failed)?)
}

/// Everything that decides the files of a stage, in one digest.
pub(super) fn key<T: Task>(
    project: &Project,
    options: &T::Options,
    inputs: &[record::Content],
) -> String {
    let options = serde_json::to_string(options).unwrap_or_default();
    let own = record::Key::begin().text(&T::STAGE.word()).text(&options).text(&T::context(project));
    let key = inputs
        .iter()
        .fold(own, |key, input| key.text(&input.sha256).text(&input.path.to_string_lossy()));
    key.finish().to_string()
}

/// The command that does a stage with these options.
fn command<T: Task>(options: &T::Options) -> String {
    let mut words = format!("rowgram {} .", T::STAGE.word());
    for (name, value) in options.changed() {
        words += &format!(" --{} {}", name.replace('_', "-"), on_the_command_line(&value));
    }
    words
}

fn on_the_command_line(value: &toml::Value) -> String {
    let text = match value {
        toml::Value::String(text) => text.clone(),
        toml::Value::Array(values) => {
            values.iter().map(on_the_command_line).collect::<Vec<_>>().join(",")
        }
        other => other.to_string(),
    };
    let plain = |c: char| c.is_alphanumeric() || "._-/,:=+".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text
    } else {
        format!("'{}'", text.replace('\'', "'\\''"))
    }
}
