//! The work on projects as a graph of commands, for a workflow manager.
//!
//! A task is one command of the program with the files that it needs and a file that says it was done. Tasks of one
//! project follow each other, because a project is worked on by one process at a time and every stage uses all the
//! threads that it is given; tasks of different projects, such as the dates of a season, do not depend on each other.
//! The last task of a project is `rowgram run` itself: it finds all stages done and current, checks what came out and
//! writes the report. So whatever does the tasks, the results are those of `rowgram run`, byte by byte, and a task that
//! was lost is done again by the same command.
//!
//! Projects of many photos have the long steps in parts ([`super::batches`]), which may be done at the same time: features and matches of
//! photos, and tiles of the surface. A season has its flights as projects, up to their plants, and [`super::season`] as its last task.
//!
//! Written for Snakemake: `Snakefile`, which holds no knowledge of stages, `plan.json` with the tasks, and profiles.

use super::{
    Project, SETTINGS, Stage,
    batches::{Batch, BatchStep, Part},
    run,
    season::{self, SeasonFile},
};
use rowgram_base::{error::Error, options::Choice};
use rowgram_optim::output::{self, FileError};
use serde::Serialize;
use std::{
    collections::BTreeSet,
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

/// The workflow that reads [`PLAN_FILE`].
pub const SNAKEFILE: &str = include_str!("plan/Snakefile");
/// The file with the tasks.
pub const PLAN_FILE: &str = "plan.json";
const PROFILES: [(&str, &str); 2] = [
    ("profiles/local/config.yaml", include_str!("plan/local.yaml")),
    ("profiles/slurm/config.yaml", include_str!("plan/slurm.yaml")),
];

/// A command with what it needs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PlannedTask {
    /// Its name, unique in the plan.
    pub name: String,
    /// Files that have to be there before it.
    pub inputs: Vec<PathBuf>,
    /// The file that says it was done.
    pub done: PathBuf,
    /// Arguments of the program.
    pub arguments: Vec<String>,
}

/// All tasks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Workflow {
    /// Version of the program.
    pub version: String,
    /// In an order in which they could be done one by one.
    pub tasks: Vec<PlannedTask>,
}

/// What is planned.
#[derive(Debug)]
pub enum Work {
    /// All stages of a project, and its report.
    Project(Box<Project>),
    /// A season and its flights.
    Season {
        /// Its file.
        file: Box<SeasonFile>,
        /// The projects of its flights.
        flights: Vec<Project>,
    },
}

/// How work is planned.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PlanOptions {
    /// Settings (`section.key=value`) that go with every command.
    pub settings: Vec<String>,
    /// Projects with more photos have their long steps in parts for so many photos each; in one where not set.
    pub photos_per_task: Option<NonZeroUsize>,
}

/// Plans work.
///
/// # Errors
/// No work, a project that is given twice, and what [`run::plan`] says of each.
pub fn plan(work: &[Work], options: &PlanOptions) -> Result<Workflow, Error> {
    if work.is_empty() {
        return Err(Error::Argument("expected one project or more".into()));
    }
    let mut planner =
        Planner { options, tasks: Vec::new(), names: BTreeSet::new(), roots: BTreeSet::new() };
    for work in work {
        match work {
            Work::Project(project) => {
                planner.project(project, &[])?;
            }
            Work::Season { file, flights } => planner.season(file, flights)?,
        }
    }
    Ok(Workflow { version: env!("CARGO_PKG_VERSION").to_owned(), tasks: planner.tasks })
}

/// A plan in the making.
struct Planner<'a> {
    options: &'a PlanOptions,
    tasks: Vec<PlannedTask>,
    names: BTreeSet<String>,
    roots: BTreeSet<PathBuf>,
}

impl Planner<'_> {
    fn with_settings(&self, mut arguments: Vec<String>) -> Vec<String> {
        for setting in &self.options.settings {
            arguments.extend(["--set".to_owned(), setting.clone()]);
        }
        arguments
    }

    /// A season: the stages of its flights before plots, which are those of the season, and then the season itself.
    fn season(&mut self, file: &SeasonFile, flights: &[Project]) -> Result<(), Error> {
        let path = absolute(&file.path)?;
        let name = unique(&mut self.names, &file.name);
        let mut inputs = vec![path.clone()];
        inputs.extend(file.plots.as_deref().map(absolute).transpose()?);
        for flight in flights {
            inputs.extend(self.project(flight, &season::BY_PLOTS)?);
        }
        let results =
            std::path::absolute(file.results()).map_err(|e| FileError::read(&file.results(), e))?;
        let arguments = self.with_settings(vec!["season".to_owned(), text(&path)?]);
        let done = results.join("plan/season.done");
        self.tasks.push(PlannedTask { name, inputs, done, arguments });
        Ok(())
    }

    /// The stages of a project but some, and its report where all are wanted. Gives the file that says that the last was done.
    fn project(&mut self, project: &Project, without: &[Stage]) -> Result<Option<PathBuf>, Error> {
        let root = absolute(project.root())?;
        if !self.roots.insert(root.clone()) {
            return Err(Error::Argument(format!("{} is given twice", project.root().display())));
        }
        let name = unique(&mut self.names, &project.name());
        let results = if project.results() == project.root().join("rowgram") {
            root.join("rowgram")
        } else {
            std::path::absolute(project.results())
                .map_err(|e| FileError::read(project.results(), e))?
        };
        let mut arguments = vec!["run".to_owned(), text(&root)?];
        if results != root.join("rowgram") {
            arguments.extend(["--output".to_owned(), text(&results)?]);
        }
        let arguments = self.with_settings(arguments);
        let photos = project.photos().len();
        let parts =
            self.options.photos_per_task.map_or(1, |per_task| photos.div_ceil(per_task.get()));
        let done = |word: &str| results.join("plan").join(format!("{word}.done"));
        let own = Some(root.join(SETTINGS)).filter(|own| own.is_file());
        let mut before: Vec<PathBuf> = Vec::new();
        for (stage, files) in run::workflow(project)? {
            if without.contains(&stage) {
                continue;
            }
            let mut fixed = own.iter().cloned().collect::<Vec<_>>();
            for file in files {
                fixed.push(absolute(&file)?);
            }
            let mut task = |word: &str, flags: [String; 2], before: &[PathBuf]| {
                let mut inputs = [fixed.as_slice(), before].concat();
                inputs.sort();
                inputs.dedup();
                self.tasks.push(PlannedTask {
                    name: format!("{name}_{}", identifier(word)),
                    inputs,
                    done: done(word),
                    arguments: arguments.iter().cloned().chain(flags).collect(),
                });
                done(word)
            };
            let steps = BatchStep::all().into_iter().filter(|step| step.stage() == stage);
            for step in steps.filter(|_| parts > 1) {
                let of_step = (1..=parts).filter_map(|number| {
                    let batch = Batch { step, part: Part::new(number, parts)? };
                    let word = format!("{step}-{number}-of-{parts}");
                    Some(task(&word, ["--only".to_owned(), batch.to_string()], &before))
                });
                before = of_step.collect();
            }
            let word = stage.word();
            before = vec![task(&word, ["--only".to_owned(), word.clone()], &before)];
        }
        if without.is_empty() {
            self.tasks.push(PlannedTask {
                name: format!("{name}_report"),
                inputs: before.clone(),
                done: done("report"),
                arguments,
            });
        }
        Ok(before.pop())
    }
}

/// Writes a workflow into a folder, made if missing.
///
/// # Errors
/// Files that exist unless `force`, and writing.
pub fn write(workflow: &Workflow, folder: &Path, force: bool) -> Result<(), Error> {
    let files = PROFILES.iter().copied().chain([("Snakefile", SNAKEFILE)]);
    for name in files.clone().map(|(name, _)| name).chain([PLAN_FILE]) {
        let path = folder.join(name);
        if path.exists() {
            output::check(&path, force)?;
        }
    }
    for (name, content) in files {
        let path = folder.join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).map_err(|e| FileError::write(parent, e))?;
        }
        output::write(&path, force, |out| out.write_all(content.as_bytes()))?;
    }
    Ok(output::write_json(&folder.join(PLAN_FILE), force, workflow)?)
}

fn absolute(path: &Path) -> Result<PathBuf, Error> {
    Ok(path.canonicalize().map_err(|e| FileError::read(path, e))?)
}

fn text(path: &Path) -> Result<String, Error> {
    path.to_str().map(str::to_owned).ok_or_else(|| {
        Error::Argument(format!("{}: a workflow needs a path in UTF-8", path.display()))
    })
}

/// Letters, digits and underscores.
fn identifier(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

/// A name for rules that none before it has.
fn unique(taken: &mut BTreeSet<String>, name: &str) -> String {
    let first = format!("p_{}", identifier(name));
    let mut found = first.clone();
    let mut number = 2;
    while !taken.insert(found.clone()) {
        found = format!("{first}_{number}");
        number += 1;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_rules_are_unique_identifiers() {
        let mut taken = BTreeSet::new();
        let names = ["12 May", "12-May", "12_May", "12_May_2"].map(|name| unique(&mut taken, name));
        assert_eq!(names, ["p_12_May", "p_12_May_2", "p_12_May_3", "p_12_May_2_2"]);
    }
}
