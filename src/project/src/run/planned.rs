//! What a run would do.

use super::{RunOptions, check_input, inputs, needs, state};
use crate::{Project, Stage};
use rowgram_base::error::Error;
use rowgram_files::side_files::with_side_files;
use serde::Serialize;
use std::path::PathBuf;

/// What a run would do about a stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlannedStage {
    /// The stage.
    pub stage: Stage,
    /// What would be done about it.
    pub plan: Plan,
    /// The command that does it alone, where it would be done, else why it would not.
    pub text: String,
}

/// What would be done about a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Plan {
    /// It would be done.
    ToDo,
    /// Its result is there and current.
    Keep,
    /// It depends on what stages before it give, which have to be done first.
    Depends,
    /// It would be left out.
    LeaveOut,
}

/// Says what a run would do, and does nothing.
///
/// # Errors
/// As [`super::run`], and what a stage cannot read.
pub fn plan(project: &Project, options: &RunOptions) -> Result<Vec<PlannedStage>, Error> {
    let mut planned: Vec<PlannedStage> = Vec::new();
    check_input(project)?;
    project.config().validate()?;
    for (stage, is_wanted) in options.stages(project)? {
        let waits = needs(stage).iter().any(|needed| {
            let before = planned.iter().find(|other| other.stage == *needed);
            before.is_some_and(|before| matches!(before.plan, Plan::ToDo | Plan::Depends))
        });
        let again = options.from.is_some_and(|from| stage >= from);
        let (plan, text) = match state(stage, project) {
            _ if !is_wanted => (Plan::LeaveOut, "left out as asked".to_owned()),
            Err(Error::NothingToDo(why)) if waits => (Plan::Depends, format!("so far {why}")),
            Err(Error::NothingToDo(why)) => (Plan::LeaveOut, why),
            Err(error) => return Err(error),
            Ok(state) if waits => (Plan::Depends, state.command),
            Ok(state) if state.is_current && !again => (Plan::Keep, state.command),
            Ok(state) => (Plan::ToDo, state.command),
        };
        planned.push(PlannedStage { stage, plan, text });
    }
    Ok(planned)
}

/// The stages that a run would look at, each with the files that it is known to read from outside the results.
///
/// # Errors
/// As [`run`].
pub(crate) fn workflow(project: &Project) -> Result<Vec<(Stage, Vec<PathBuf>)>, Error> {
    let planned = plan(project, &RunOptions::default())?;
    let taken = planned.into_iter().filter(|stage| stage.plan != Plan::LeaveOut);
    taken
        .map(|planned| match inputs(planned.stage, project) {
            Ok(files) => {
                let outside = files.iter().filter(|path| !path.starts_with(project.results()));
                Ok((planned.stage, outside.flat_map(|path| with_side_files(path)).collect()))
            }
            Err(Error::NothingToDo(_)) => Ok((planned.stage, Vec::new())),
            Err(error) => Err(error),
        })
        .collect()
}
