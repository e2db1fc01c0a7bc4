//! The work on projects as a graph of commands, for a workflow manager.
//!
//! A task is one command of the program with the files that it needs and a file that says it was done. Tasks of one
//! project follow each other, because a project is worked on by one process at a time and every stage uses all the
//! threads that it is given; tasks of different projects, such as the dates of a season, do not depend on each other.
//! The last task of a project is `rowgram run` itself: it finds all stages done and current, checks what came out and
//! writes the report. So whatever does the tasks, the results are those of `rowgram run`, byte by byte, and a task that
//! was lost is done again by the same command.
//!
//! Written for Snakemake: `Snakefile`, which holds no knowledge of stages, `plan.json` with the tasks, and profiles.

use super::{Project, SETTINGS, run};
use crate::{
    error::Error,
    io::{FileError, output},
    options::Choice,
};
use serde::Serialize;
use std::{
    collections::BTreeSet,
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
    /// Whether no task needs it.
    pub last: bool,
}

/// All tasks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Workflow {
    /// Version of the program.
    pub version: String,
    /// In an order in which they could be done one by one.
    pub tasks: Vec<PlannedTask>,
}

/// Plans the work on projects; `settings` (`section.key=value`) go with every command.
///
/// # Errors
/// No project, one given twice, and what [`run::plan`] says of each.
pub fn plan(projects: &[Project], settings: &[String]) -> Result<Workflow, Error> {
    if projects.is_empty() {
        return Err(Error::Argument("expected one project or more".into()));
    }
    let (mut tasks, mut names, mut roots) = (Vec::new(), BTreeSet::new(), BTreeSet::new());
    for project in projects {
        let root = absolute(project.root())?;
        if !roots.insert(root.clone()) {
            return Err(Error::Argument(format!("{} is given twice", project.root().display())));
        }
        let name = unique(&mut names, &project.name());
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
        for setting in settings {
            arguments.extend(["--set".to_owned(), setting.clone()]);
        }
        let done = |word: &str| results.join("plan").join(format!("{word}.done"));
        let mut before: Option<PathBuf> = None;
        for (stage, files) in run::workflow(project)? {
            let mut inputs = Vec::new();
            for file in files {
                inputs.push(absolute(&file)?);
            }
            let own = root.join(SETTINGS);
            if own.is_file() {
                inputs.push(own);
            }
            inputs.extend(before.take());
            inputs.sort();
            inputs.dedup();
            let word = stage.word();
            let only = ["--only".to_owned(), word.clone()];
            tasks.push(PlannedTask {
                name: format!("{name}_{}", identifier(&word)),
                inputs,
                done: done(&word),
                arguments: arguments.iter().cloned().chain(only).collect(),
                last: false,
            });
            before = Some(done(&word));
        }
        tasks.push(PlannedTask {
            name: format!("{name}_report"),
            inputs: before.into_iter().collect(),
            done: done("report"),
            arguments,
            last: true,
        });
    }
    Ok(Workflow { version: env!("CARGO_PKG_VERSION").to_owned(), tasks })
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
    output::write(&folder.join(PLAN_FILE), force, |out| {
        serde_json::to_writer_pretty(&mut *out, workflow)?;
        writeln!(out)
    })
    .map_err(Error::from)
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
