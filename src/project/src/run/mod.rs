//! From photos to traits, one stage after the other.
//!
//! A stage for which the project has no input is left out with the reason. A stage that fails takes those with it that
//! need its result; the others go on. What a stage did before is kept while nothing that it came from has changed.

mod planned;

use super::{Project, Stage, State, checks, orthomosaic, record, stac, stage};
pub(crate) use planned::workflow;
pub use planned::{Plan, PlannedStage, plan};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Recorder, Severity},
    options::Choice,
};
use rowgram_files::reconstruction;
use rowgram_optim::output::{self, FileError};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeSet, path::PathBuf};

/// The file in the folder of results that holds the [`RunOutcome`].
pub const RUN_FILE: &str = "stats.json";
/// The file in the folder of results that holds the settings of the run.
pub const RESOLVED_FILE: &str = "resolved.toml";
/// The file in the folder of results that holds the report, one page.
pub const REPORT_FILE: &str = "report.html";

/// Fewer photos than this make no block.
pub(super) const LEAST_PHOTOS: usize = 3;

/// Which stages are done.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunOptions {
    /// Stages that are left out, besides those that the settings leave out; what they did before is used.
    pub skip: Vec<Stage>,
    /// This stage and those after it are done again, whatever is kept.
    pub from: Option<Stage>,
    /// The last stage that is done.
    pub until: Option<Stage>,
}

impl RunOptions {
    /// The stages that are looked at, and whether each is asked for.
    fn stages(&self, project: &Project) -> Result<Vec<(Stage, bool)>, Error> {
        if let (Some(from), Some(until)) = (self.from, self.until)
            && from > until
        {
            return Err(Error::Argument(format!(
                "--from {from} --until {until}: expected a stage to end with that does not come before the first"
            )));
        }
        let until = self.until.unwrap_or(Stage::Evaluate);
        let by_settings = &project.config().stages.skip;
        let wanted = |stage: &Stage| !(self.skip.contains(stage) || by_settings.contains(stage));
        let all = Stage::all().into_iter().filter(|stage| *stage <= until);
        Ok(all.map(|stage| (stage, wanted(&stage))).collect())
    }

    /// The stages that the results of a run are of, whatever the settings leave out.
    fn asked(&self) -> Vec<Stage> {
        let until = self.until.unwrap_or(Stage::Evaluate);
        let is_asked = |stage: &Stage| *stage <= until && !self.skip.contains(stage);
        Stage::all().into_iter().filter(is_asked).collect()
    }
}

/// How a stage ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// It was done.
    Done,
    /// Its result was there and current.
    Kept,
    /// It was not done: there was nothing to do, a stage before it failed, or it was not asked for.
    LeftOut,
    /// It could not be done.
    Failed,
}

/// What became of a stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageReport {
    /// The stage.
    pub stage: Stage,
    /// How it ended.
    pub ending: Ending,
    /// Why it was left out or failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// How long it took when it was done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// The most memory that the process had then, megabytes; of this stage alone, where the system can count it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory_mb: Option<f64>,
    /// What was found on the way.
    pub diagnostics: Vec<Diagnostic>,
}

impl StageReport {
    fn new(
        records: &record::Records,
        stage: Stage,
        (ending, reason): (Ending, Option<String>),
        diagnostics: Vec<Diagnostic>,
    ) -> StageReport {
        let record =
            matches!(ending, Ending::Done | Ending::Kept).then(|| records.read(stage)).flatten();
        let seconds = record.as_ref().map(|of| of.seconds);
        let peak_memory_mb = record.and_then(|of| of.peak_memory_mb);
        StageReport { stage, ending, reason, seconds, peak_memory_mb, diagnostics }
    }
}

/// The stages that have to have succeeded before this one; old results do not stand in for one that failed.
fn needs(stage: Stage) -> &'static [Stage] {
    match stage {
        Stage::Calibrate => &[],
        Stage::Align => &[Stage::Calibrate],
        Stage::Dem => &[Stage::Align],
        Stage::Surface | Stage::Ortho => &[Stage::Align, Stage::Dem],
        Stage::Segment => &[Stage::Ortho],
        Stage::LeafDensity | Stage::LeafCount | Stage::Locate => &[Stage::Segment],
        Stage::Leaves | Stage::Plots => &[Stage::Segment, Stage::Locate],
        Stage::Evaluate => &[Stage::Locate],
    }
}

macro_rules! stages {
    ($($module:ident: $stage:ident, $outcome:ident, $task:ident;)*) => {
        /// What came of the stages; `None` for one that was not done.
        #[derive(Debug, Default, Serialize, Deserialize)]
        pub struct StageResults {
            $(
                #[doc = concat!("What came of `", stringify!($module), "`.")]
                #[serde(default, skip_serializing_if = "Option::is_none")]
                pub $module: Option<super::$module::$outcome>,
            )*
        }

        impl StageResults {
            /// Does a stage with the settings of the project, or with `options` where they are given.
            fn perform(
                &mut self,
                stage: Stage,
                project: &Project,
                options: Option<&serde_json::Value>,
                monitor: &mut dyn Monitor,
            ) -> Result<Ending, Error> {
                let was_current = match stage {
                    $(Stage::$stage => {
                        let options = match options {
                            Some(options) => recorded(stage, options)?,
                            None => project.config().$module.clone(),
                        };
                        let performed =
                            stage::execute::<super::$module::$task>(project, &options, monitor)?;
                        self.$module = Some(performed.outcome);
                        performed.was_current
                    })*
                };
                Ok(if was_current { Ending::Kept } else { Ending::Done })
            }
        }

        /// The files that a stage reads.
        fn inputs(stage: Stage, project: &Project) -> Result<Vec<PathBuf>, Error> {
            match stage {
                $(Stage::$stage => {
                    <super::$module::$task as stage::Task>::inputs(project, &project.config().$module)
                })*
            }
        }

        /// What would become of a stage.
        fn state(stage: Stage, project: &Project) -> Result<State, Error> {
            match stage {
                $(Stage::$stage => {
                    stage::state::<super::$module::$task>(project, &project.config().$module)
                })*
            }
        }
    };
}

stages! {
    calibrate: Calibrate, CalibrateOutcome, Calibrate;
    align: Align, AlignOutcome, AlignTask;
    dem: Dem, DemOutcome, DemTask;
    surface: Surface, SurfaceOutcome, SurfaceTask;
    ortho: Ortho, OrthoOutcome, OrthoTask;
    segment: Segment, SegmentOutcome, Segment;
    leaf_density: LeafDensity, LeafDensityOutcome, LeafDensity;
    leaf_count: LeafCount, LeafCountOutcome, LeafCountStage;
    locate: Locate, LocateOutcome, Locate;
    leaves: Leaves, LeavesOutcome, LeavesStage;
    plots: Plots, PlotsOutcome, Plots;
    evaluate: Evaluate, EvaluateOutcome, Evaluate;
}

fn recorded<T: serde::de::DeserializeOwned>(
    stage: Stage,
    options: &serde_json::Value,
) -> Result<T, Error> {
    serde_json::from_value(options.clone()).map_err(|e| {
        Error::Argument(format!("the recorded options of {stage} are of another version: {e}"))
    })
}

/// What came of a run.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct RunOutcome {
    /// Name of the project.
    pub project: String,
    /// Version of the program.
    pub version: String,
    /// Digest of the sources that the program was built from.
    pub build: String,
    /// Ground sampling distance of the orthomosaic that traits come from, metres.
    pub gsd_m: Option<f64>,
    /// Quality checks: information is green, a warning is yellow, an error is red.
    pub checks: Vec<Diagnostic>,
    /// What became of the stages, in their order.
    pub stages: Vec<StageReport>,
    /// What came of them.
    pub results: StageResults,
    /// The stages that were asked for.
    #[serde(default)]
    pub asked: Vec<Stage>,
    /// Why the first stage failed that did.
    #[serde(skip)]
    pub failure: Option<Error>,
    /// Whether [`RUN_FILE`] and the report are to be of this run: those of a run of more stages stay.
    #[serde(skip)]
    pub is_whole: bool,
}

impl RunOutcome {
    /// Of the last run of a project.
    ///
    /// # Errors
    /// Where there was none, or by another version of the program.
    pub fn of_last_run(project: &Project) -> Result<RunOutcome, Error> {
        let path = project.results().join(RUN_FILE);
        let text = std::fs::read(&path).map_err(|_| {
            let message = "there are no results here: run `rowgram run` first";
            FileError::malformed(project.results(), None, message)
        })?;
        if !record::holds(project.results(), RUN_FILE) {
            let message = "it is not as a run wrote it: do `rowgram run` again";
            return Err(FileError::malformed(&path, None, message).into());
        }
        let outcome = serde_json::from_slice(&text).map_err(|e| {
            let message = format!("it is of another version of the program, run again ({e})");
            FileError::malformed(&path, e.line(), message)
        })?;
        Ok(outcome)
    }

    /// The quality checks that forbid the use of results before somebody has looked at them.
    pub fn red_checks(&self) -> impl Iterator<Item = &Diagnostic> {
        self.checks.iter().filter(|check| check.severity == Severity::Error)
    }

    /// Whether a stage has a result.
    pub fn has(&self, stage: Stage) -> bool {
        let ended = |report: &&StageReport| report.stage == stage;
        let report = self.stages.iter().find(ended);
        report.is_some_and(|report| matches!(report.ending, Ending::Done | Ending::Kept))
    }
}

/// Does the stages of a project, checks the quality of what came out, and writes `stats.json`, `resolved.toml` and, where the
/// products have a place and a time, `stac.json`.
///
/// A stage that fails does not end the run; its error is in the outcome.
///
/// # Errors
/// A folder without photos and orthomosaic, a project that another process is working on, results that cannot be
/// written.
pub fn run(
    project: &Project,
    options: &RunOptions,
    monitor: &mut dyn Monitor,
) -> Result<RunOutcome, Error> {
    let wanted = options.stages(project)?;
    check_input(project)?;
    project.config().validate()?;
    if wanted.contains(&(Stage::Plots, true)) {
        orthomosaic::check_bands(project)?;
        orthomosaic::check(project)?;
    }
    let again = |stage: &Stage| options.from.is_some_and(|from| *stage >= from);
    let again = Stage::all().into_iter().filter(again);
    let project = &project.clone().again(again).reserved()?;
    let results = project.results();
    let written = [RUN_FILE, RESOLVED_FILE, stac::STAC_FILE, REPORT_FILE];
    record::check(results, &written, project.is_forced())?;
    let records = project.records();
    let mut outcome = RunOutcome {
        project: project.name(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        build: crate::BUILD.to_owned(),
        asked: options.asked(),
        ..RunOutcome::default()
    };
    let mut missing = BTreeSet::new();
    for (stage, is_wanted) in wanted {
        let broken = needs(stage).iter().find(|needed| missing.contains(*needed));
        let mut recorder = Recorder::new(monitor);
        let ended = if !is_wanted {
            Err("left out as asked".to_owned())
        } else if let Some(broken) = broken {
            missing.insert(stage);
            records.supersede(stage, true)?;
            Err(format!("{broken} has no result"))
        } else {
            match outcome.results.perform(stage, project, None, &mut recorder) {
                Ok(ending) => Ok((ending, None)),
                Err(Error::NothingToDo(why)) => {
                    check_results(project, &outcome.stages)?;
                    Err(why)
                }
                Err(error) => {
                    check_results(project, &outcome.stages)?;
                    records.supersede(stage, true)?;
                    missing.insert(stage);
                    let why = error.to_string();
                    outcome.failure.get_or_insert(error);
                    Ok((Ending::Failed, Some(why)))
                }
            }
        };
        let diagnostics = recorder.diagnostics;
        let (ending, reason) = ended.unwrap_or_else(|why| (Ending::LeftOut, Some(why)));
        match (ending, &reason) {
            (Ending::Kept, _) => monitor.diagnostic(&stage::nothing_changed(stage)),
            (Ending::LeftOut, Some(why)) if is_wanted && broken.is_none() => {
                let message = format!("left out: {why}");
                monitor.diagnostic(&Diagnostic::info("stage-left-out", stage.word(), message));
            }
            _ => {}
        }
        outcome.stages.push(StageReport::new(&records, stage, (ending, reason), diagnostics));
    }
    check_results(project, &outcome.stages)?;
    let ortho = project.orthomosaic().ok().and_then(|path| project.open_picture(&path).ok());
    outcome.gsd_m = ortho.and_then(|source| source.georeference()?.gsd_m());
    let aligned = project.finished(Stage::Align, reconstruction::NAME);
    let reconstruction = aligned
        .filter(|_| outcome.results.align.is_some())
        .map(|path| reconstruction::read(&path))
        .transpose()?;
    outcome.checks = checks::checks(&outcome, reconstruction.as_ref(), &project.config().checks);
    monitor.stage("checks");
    outcome.checks.iter().for_each(|found| monitor.diagnostic(found));
    let before = RunOutcome::of_last_run(project).map(|before| before.asked).unwrap_or_default();
    outcome.is_whole = before.iter().all(|stage| outcome.asked.contains(stage));
    write(project, &outcome)?;
    Ok(outcome)
}

/// Whether everything is there that this run has made.
fn check_results(project: &Project, stages: &[StageReport]) -> Result<(), Error> {
    project.lock()?.check()?;
    let records = project.records();
    let mut done =
        stages.iter().filter(|stage| matches!(stage.ending, Ending::Done | Ending::Kept));
    match done.find_map(|stage| records.missing(stage.stage)) {
        Some(path) => Err(record::vanished(&path)),
        None => Ok(()),
    }
}

pub(super) fn check_input(project: &Project) -> Result<(), Error> {
    if project.given_orthomosaic().is_some() {
        return Ok(());
    }
    let photos = project.photos();
    if let Some(message) = orthomosaic::undecided(&photos) {
        return Err(FileError::malformed(project.root(), None, message).into());
    }
    let photos = photos.len();
    if photos >= LEAST_PHOTOS {
        return Ok(());
    }
    let number = if photos == 0 { "no".to_owned() } else { format!("only {photos}") };
    let message = format!(
        "{number} photos {} and no orthomosaic; expected {LEAST_PHOTOS} photos or more ({})",
        project.photo_place(),
        super::PHOTO_ENDINGS.join(", ")
    );
    Err(FileError::malformed(project.root(), None, message).into())
}

/// Writes the settings of a run, and what came of it unless that of more stages is there.
fn write(project: &Project, outcome: &RunOutcome) -> Result<(), Error> {
    let results = project.results();
    let work = record::temporary(results)?;
    let settings = project.config().to_toml();
    let resolved = work.path().join(RESOLVED_FILE);
    output::write(&resolved, true, |out| out.write_all(settings.as_bytes()))?;
    if outcome.is_whole {
        output::write_json(&work.path().join(RUN_FILE), true, outcome)?;
        if !stac::write(project, outcome, work.path())? {
            record::withdraw(results, stac::STAC_FILE)?;
        }
    }
    record::publish(work.path(), results, project.is_forced())?;
    record::list_settings(results, project.settings_file())
}

/// Does one stage, whose predecessors have been done, and nothing else: no checks, no report.
///
/// # Errors
/// As [`run`], and what the stage itself says; having nothing to do is none.
pub fn only(
    project: &Project,
    stage: Stage,
    monitor: &mut dyn Monitor,
) -> Result<StageReport, Error> {
    check_input(project)?;
    project.config().validate()?;
    let project = &project.clone().reserved()?;
    let mut recorder = Recorder::new(monitor);
    let done = StageResults::default().perform(stage, project, None, &mut recorder);
    let diagnostics = recorder.diagnostics;
    let (ending, reason) = match done {
        Ok(ending) => (ending, None),
        Err(Error::NothingToDo(why)) => (Ending::LeftOut, Some(why)),
        Err(error) => return Err(error),
    };
    Ok(StageReport::new(&project.records(), stage, (ending, reason), diagnostics))
}

/// Does a stage again as its record says, with results in the folder of `project`.
///
/// # Errors
/// What the stage says.
pub(super) fn repeat(
    project: &Project,
    record: &record::Record,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    StageResults::default().perform(record.stage, project, Some(&record.options), monitor).map(drop)
}
