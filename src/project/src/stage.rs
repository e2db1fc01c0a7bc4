//! The stages from photos to traits, and what they have in common.

use super::{Project, record};
use record::{NewFolder, Record};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Recorder},
    options::{Choice, Options},
};
use rowgram_files::geotiff::Reading;
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

impl Stage {
    /// The command of the program that does this stage alone.
    pub fn command(self) -> String {
        match self {
            Stage::Calibrate => "camera calibrate".to_owned(),
            Stage::Dem => "surface dem".to_owned(),
            Stage::LeafDensity => "leaves density".to_owned(),
            Stage::LeafCount => "leaves count".to_owned(),
            other => other.word(),
        }
    }
}

/// What a stage reads, does and gives.
///
/// The record of a stage names the build of the program, the options and the contents of everything that was read. While
/// none of them changes and its files are as they were written, the stage is not done again. What it finds on its way, and an attempt
/// that was interrupted should find again, goes to the content store of the project.
pub trait Task {
    /// How it is done.
    type Options: Options;
    /// What came of it; kept in the record, so it can be had again without doing the work.
    type Outcome: Serialize + DeserializeOwned;
    /// Which stage it is.
    const STAGE: Stage;
    /// The files that it reads.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where the project has no input for it, and why.
    fn inputs(project: &Project, options: &Self::Options) -> Result<Vec<PathBuf>, Error>;

    /// What of the project, besides options and files, decides the result.
    fn context(_project: &Project) -> String {
        String::new()
    }

    /// Does it, writing into `folder`, which is empty.
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
        let key = key::<T>(project, options, &project.contents(&files)?);
        records.current(T::STAGE, &key, &project.store_of_all())?.is_some()
    };
    Ok(State { is_current, command: command::<T>(options) })
}

/// What came of a stage.
#[derive(Debug, Clone, PartialEq)]
pub struct Performed<T> {
    /// Its outcome.
    pub outcome: T,
    /// Whether it was there and current, so that nothing was done.
    pub was_current: bool,
}

/// Does a stage, unless its result is there and current, and gives what came of it.
///
/// # Errors
/// As the stage itself.
pub fn perform<T: Task>(
    project: &Project,
    options: &T::Options,
    monitor: &mut dyn Monitor,
) -> Result<T::Outcome, Error> {
    let performed = execute::<T>(project, options, monitor)?;
    if performed.was_current {
        monitor.diagnostic(&nothing_changed(T::STAGE));
    }
    Ok(performed.outcome)
}

/// Says that a stage was current.
pub(super) fn nothing_changed(stage: Stage) -> Diagnostic {
    Diagnostic::info("stage-kept", stage.word(), "nothing has changed since it was done: kept")
}

/// Does a stage, unless its result is there and current.
///
/// It is done in a folder of its own, which takes the place of the old result at the end: a stage that fails leaves its last result as it
/// was. So does one that has nothing to do, but later stages do not read that.
///
/// # Errors
/// Options beyond their limits, [`Error::NothingToDo`] where the project has no input for it, a project that another
/// process is working on, an input among the results that it replaces, results that somebody has edited, and what the stage itself says.
pub(super) fn execute<T: Task>(
    project: &Project,
    options: &T::Options,
    monitor: &mut dyn Monitor,
) -> Result<Performed<T::Outcome>, Error> {
    let section = <T::Options as Options>::SECTION;
    options.validate().map_err(|why| Error::Argument(format!("[{section}] {why}")))?;
    let lock = project.lock()?;
    let performed = attempt::<T>(project, options, &lock, monitor);
    match &performed {
        Ok(_) => project.records().supersede(T::STAGE, false)?,
        Err(error) => {
            lock.check()?;
            if matches!(error, Error::NothingToDo(_)) {
                project.records().supersede(T::STAGE, true)?;
            }
        }
    }
    performed
}

fn attempt<T: Task>(
    project: &Project,
    options: &T::Options,
    lock: &record::Lock,
    monitor: &mut dyn Monitor,
) -> Result<Performed<T::Outcome>, Error> {
    let records = project.records();
    let folder = project.folder(T::STAGE);
    let files = T::inputs(project, options)?;
    refuse_own::<T>(&files, &folder)?;
    let inputs = project.contents(&files)?;
    let key = key::<T>(project, options, &inputs);
    monitor.stage(&T::STAGE.word());
    let store = project.store_of_all();
    if !project.is_again(T::STAGE)
        && let Some(record) = records.current(T::STAGE, &key, &store)?
        && let Ok(outcome) = serde_json::from_value(record.outcome)
    {
        record.diagnostics.iter().for_each(|found| monitor.diagnostic(found));
        return Ok(Performed { outcome, was_current: true });
    }
    record::check_folder(&folder, &records.listed(T::STAGE), project.is_forced())?;
    let begin = Instant::now();
    let counts_memory = super::reset_peak_memory();
    let new = NewFolder::begin(&folder)?;
    let mut recorder = Recorder::new(monitor);
    let outcome = T::work(project, options, new.path(), &mut recorder)
        .map_err(|error| in_place(error, new.path(), &folder))?;
    let diagnostics = recorder.diagnostics;
    lock.check()?;
    let written = record::contents(new.path(), &record::files(new.path())?)?;
    let place = |content: record::Content| record::Content {
        path: record::relative(project.root(), &folder.join(&content.path)),
        ..content
    };
    let record = Record {
        stage: T::STAGE,
        key,
        command: command::<T>(options),
        options: as_value(&folder, options)?,
        version: env!("CARGO_PKG_VERSION").to_owned(),
        build: crate::BUILD.to_owned(),
        inputs,
        outputs: written.into_iter().map(place).collect(),
        outcome: as_value(&folder, &outcome)?,
        diagnostics,
        seconds: begin.elapsed().as_secs_f64(),
        peak_memory_mb: super::peak_memory_mb().filter(|_| counts_memory),
        is_superseded: false,
    };
    records.finish(&record, new, project.is_forced())?;
    Ok(Performed { outcome, was_current: false })
}

/// An error that names a file by the place that it would have had.
fn in_place(error: Error, work: &Path, folder: &Path) -> Error {
    match error {
        Error::File(FileError::Write { path, source }) => {
            let path =
                path.strip_prefix(work).map_or_else(|_| path.clone(), |path| folder.join(path));
            FileError::Write { path, source }.into()
        }
        other => other,
    }
}

/// Refuses inputs among the results that the stage replaces: read again, they would be another input.
fn refuse_own<T: Task>(files: &[PathBuf], folder: &Path) -> Result<(), Error> {
    let Ok(own) = folder.canonicalize() else { return Ok(()) };
    let is_own = |file: &&PathBuf| file.canonicalize().is_ok_and(|file| file.starts_with(&own));
    match files.iter().find(is_own) {
        None => Ok(()),
        Some(file) => {
            let message = format!(
                "{} reads it and would replace it, for it is one of its own results: copy it to another folder and name that file",
                T::STAGE
            );
            Err(FileError::malformed(file, None, message).into())
        }
    }
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
    let mut own =
        record::Key::begin().text(&T::STAGE.word()).text(&options).text(&T::context(project));
    // How a picture is read is part of what is read.
    let of_inputs = inputs.iter().map(|input| project.reading(&project.root().join(&input.path)));
    for reading in of_inputs.filter(|reading| *reading != Reading::default()) {
        own = own.text(&format!("{reading:?}"));
    }
    let key = inputs
        .iter()
        .fold(own, |key, input| key.text(&input.sha256).text(&input.path.to_string_lossy()));
    key.finish().to_string()
}

/// The command that does a stage with these options, as a person types it in the folder of the project.
pub fn command<T: Task>(options: &T::Options) -> String {
    let mut words = format!("rowgram {} .", T::STAGE.command());
    for (name, value) in options.changed() {
        words += &format!(" --{}={}", name.replace('_', "-"), quoted(&on_the_command_line(&value)));
    }
    words
}

/// As [`Kind::read`](rowgram_base::options::Kind::read) reads it again: as TOML spells it, where a word or a list of words is something else.
fn on_the_command_line(value: &toml::Value) -> String {
    let is_word = |text: &str| !text.contains(['\'', '"', ',']) && text.trim() == text;
    match value {
        toml::Value::String(text) if !text.contains(['\'', '"']) && text.trim() == text => {
            text.clone()
        }
        toml::Value::Array(values)
            if values.iter().all(|value| {
                value.as_str().is_none_or(|text| is_word(text) && !text.is_empty())
            }) =>
        {
            values.iter().map(on_the_command_line).collect::<Vec<_>>().join(",")
        }
        other => other.to_string(),
    }
}

/// Text as one word of a shell.
pub(super) fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "._-/,:=+".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', "'\\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Config;
    use rowgram_base::monitor::Silent;
    use std::fs;

    rowgram_base::options! {
        /// What the task of these tests does.
        pub struct ProbeOptions in "leaf_density" {
            /// What is read.
            pub input: PathBuf = PathBuf::from("in.txt");
            /// Any number.
            pub number: usize = 1;
        }
    }

    /// Writes what it reads, and does what that says.
    struct Probe;

    impl Task for Probe {
        type Options = ProbeOptions;
        type Outcome = String;
        const STAGE: Stage = Stage::LeafDensity;

        fn inputs(project: &Project, options: &ProbeOptions) -> Result<Vec<PathBuf>, Error> {
            let path = project.root().join(&options.input);
            let nothing = || Error::NothingToDo("there is no input".to_owned());
            Ok(vec![Some(path).filter(|path| path.is_file()).ok_or_else(nothing)?])
        }

        fn work(
            project: &Project,
            options: &ProbeOptions,
            folder: &Path,
            _: &mut dyn Monitor,
        ) -> Result<String, Error> {
            let text = fs::read_to_string(project.root().join(&options.input)).unwrap();
            fs::create_dir(folder.join("figures")).unwrap();
            fs::write(folder.join("figures/a.txt"), &text).unwrap();
            fs::write(folder.join("out.txt"), &text).unwrap();
            match text.as_str() {
                "fail" => Err(Error::Incomplete("it failed".to_owned())),
                "vanish" => {
                    fs::remove_dir_all(project.results()).unwrap();
                    Ok(text)
                }
                "much" => {
                    let much = vec![1_u8; 300 << 20];
                    Ok(format!("{}", much.iter().map(|&x| usize::from(x)).sum::<usize>()))
                }
                _ => Ok(text),
            }
        }
    }

    fn project(root: &Path) -> Project {
        Project::new(root, Config::default()).unwrap()
    }

    fn done(project: &Project) -> Result<Performed<String>, Error> {
        execute::<Probe>(project, &ProbeOptions::default(), &mut Silent)
    }

    #[test]
    fn a_stage_that_fails_is_refused_or_has_nothing_to_do_leaves_its_last_result() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let (project, input) = (project(root), root.join("in.txt"));
        let out = project.file(Stage::LeafDensity, "out.txt");
        let told = |project: &Project| project.finished(Stage::LeafDensity, "out.txt").is_some();
        fs::write(&input, "one").unwrap();
        assert!(!done(&project).unwrap().was_current && done(&project).unwrap().was_current);
        fs::write(&input, "fail").unwrap();
        assert!(done(&project).unwrap_err().to_string().contains("it failed"));
        assert!(fs::read_to_string(&out).unwrap() == "one" && told(&project));
        // Later stages do not read it where there is nothing to do any more, until it is current again.
        fs::remove_file(&input).unwrap();
        assert!(matches!(done(&project), Err(Error::NothingToDo(_))));
        assert!(fs::read_to_string(&out).unwrap() == "one" && !told(&project));
        fs::write(&input, "one").unwrap();
        assert!(done(&project).unwrap().was_current && told(&project));
        // One of its own results cannot be its input.
        let own =
            ProbeOptions { input: "rowgram/leaf-density/out.txt".into(), ..Default::default() };
        let why = execute::<Probe>(&project, &own, &mut Silent).unwrap_err().to_string();
        assert!(why.contains("out.txt") && why.contains("its own results"), "{why}");
        assert_eq!(fs::read_to_string(&out).unwrap(), "one");
        // Nothing is left of all that but results, records and the store.
        let mut names: Vec<String> = fs::read_dir(project.results())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(names, [".lock", "leaf-density", "rowgram-manifest.json", "stages"]);
    }

    #[test]
    fn what_is_edited_or_somebodys_stays() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let (project, input) = (project(root), root.join("in.txt"));
        let at = |name: &str| project.file(Stage::LeafDensity, name);
        let text = |name: &str| fs::read_to_string(at(name)).unwrap();
        fs::create_dir_all(at("figures")).unwrap();
        fs::write(at("notes.txt"), "mine").unwrap();
        fs::write(&input, "one").unwrap();
        done(&project).unwrap();
        fs::write(at("figures/b.txt"), "mine").unwrap();
        fs::write(&input, "two").unwrap();
        done(&project).unwrap();
        assert_eq!(
            [text("out.txt"), text("notes.txt"), text("figures/b.txt")],
            ["two", "mine", "mine"]
        );
        fs::write(at("out.txt"), "edited").unwrap();
        let why = done(&project).unwrap_err().to_string();
        assert!(why.contains("out.txt") && why.contains("--force"), "{why}");
        assert_eq!(text("out.txt"), "edited");
        done(&project.clone().forced(true)).unwrap();
        assert_eq!([text("out.txt"), text("out.txt.edited")], ["two", "edited"]);
        // A foreign file in the way of the first result.
        fs::remove_dir_all(project.results()).unwrap();
        fs::create_dir_all(at("figures")).unwrap();
        fs::write(at("figures/a.txt"), "mine").unwrap();
        assert!(done(&project).unwrap_err().to_string().contains("a.txt"));
        assert!(text("figures/a.txt") == "mine" && !at("out.txt").exists());
    }

    #[test]
    fn a_record_that_was_forged_says_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        fs::write(folder.path().join("in.txt"), "one").unwrap();
        done(&project).unwrap();
        let path = project.results().join("stages/leaf-density.json");
        let record = fs::read_to_string(&path).unwrap();
        fs::write(&path, record.replace("\"outcome\": \"one\"", "\"outcome\": \"999999\""))
            .unwrap();
        let again = done(&project).unwrap();
        assert!(!again.was_current && again.outcome == "one");
        assert!(done(&project).unwrap().was_current);
    }

    #[test]
    fn a_kill_between_exchange_and_record_is_put_right() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        fs::write(folder.path().join("in.txt"), "one").unwrap();
        done(&project).unwrap();
        let path = project.results().join("stages/leaf-density.json");
        let first = fs::read(&path).unwrap();
        let manifest = project.results().join(record::MANIFEST);
        let listed = fs::read(&manifest).unwrap();
        fs::write(folder.path().join("in.txt"), "two").unwrap();
        done(&project).unwrap();
        // The folder is the new one, all else as before the exchange but for the record that waits.
        fs::rename(&path, project.results().join("stages/.leaf-density.next")).unwrap();
        fs::write(&path, first).unwrap();
        fs::write(&manifest, listed).unwrap();
        let found = done(&project).unwrap();
        assert!(found.was_current && found.outcome == "two");
        assert!(!project.results().join("stages/.leaf-density.next").exists());
    }

    #[test]
    fn results_that_vanish_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        fs::write(folder.path().join("in.txt"), "vanish").unwrap();
        let why = done(&project).unwrap_err().to_string();
        assert!(why.contains("has vanished"), "{why}");
        assert!(!project.results().exists(), "nothing is made again in their place");
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_memory_of_a_stage_is_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        let peak_mb = |text: &str| {
            fs::write(folder.path().join("in.txt"), text).unwrap();
            done(&project).unwrap();
            project.records().read(Stage::LeafDensity).unwrap().peak_memory_mb
        };
        if let (Some(much), Some(little)) = (peak_mb("much"), peak_mb("little")) {
            assert!(much > 300.0 && little < much - 200.0, "{much} {little}");
        } else {
            assert!(!crate::reset_peak_memory(), "where it can be counted, it is");
        }
    }
}
