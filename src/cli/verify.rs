//! `rowgram verify`: the same again, and are the bytes the same?

use super::{
    print, print_json,
    run::{self, STAGES, record},
};
use crate::{error::Error, io::FileError};
use record::{Content, Records};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Do a run again from its inputs and compare all files byte by byte
///
/// Inputs must be as they were; every stage is done again in a folder of the project that is removed afterwards, with the
/// settings of the run, and its files are compared with the recorded ones. With --files nothing is done again: only the
/// recorded files are compared with what is there. Exit code 3 where something differs.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  rowgram verify field
  rowgram verify field --files"
)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Only look whether inputs and results are what they were.
    #[arg(long)]
    files: bool,
    /// Print one line of JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Outcome {
    stages: usize,
    files: usize,
    differences: Vec<String>,
}

/// Runs the verb.
///
/// # Errors
/// A project without a run, and [`Error::Incomplete`] where something differs.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let root = &args.project;
    let results = root.join("rowgram");
    let records = Records::of(root, &results);
    let done: Vec<_> = STAGES.iter().filter_map(|stage| records.read(stage)).collect();
    if done.is_empty() {
        let message = "there is no run to verify: run rowgram run first";
        return Err(FileError::malformed(&results, None, message).into());
    }
    let mut outcome = Outcome { stages: done.len(), files: 0, differences: Vec::new() };
    for record in &done {
        for (what, contents) in [("read", &record.inputs), ("wrote", &record.outputs)] {
            for content in contents {
                outcome.files += 1;
                let state = state_of(&root.join(&content.path), content)?;
                if let Some(state) = state {
                    let path = content.path.display();
                    outcome
                        .differences
                        .push(format!("{path}, which {} {what}, {state}", record.stage));
                }
            }
        }
    }
    if !args.files && outcome.differences.is_empty() {
        // Beside the results, so that a path from them to a photo is the same path.
        let folder = tempfile::Builder::new().prefix(".rowgram-").tempdir_in(root);
        let folder = folder.map_err(|e| FileError::write(root, e))?;
        run::again(root, &results, folder.path())?;
        for record in done.iter().filter(|record| record.stage != "grow") {
            for content in &record.outputs {
                let inside = root.join(&content.path);
                let Ok(inside) = inside.strip_prefix(&results) else { continue };
                if let Some(state) = state_of(&folder.path().join(inside), content)? {
                    let path = content.path.display();
                    outcome.differences.push(format!("{path}, done again, {state}"));
                }
            }
        }
    }
    if args.json {
        print_json(&outcome)?;
    } else {
        let mut text = format!("{} stages, {} files", outcome.stages, outcome.files);
        for line in &outcome.differences {
            text += &format!("\n  {line}");
        }
        if outcome.differences.is_empty() {
            text += if args.files { ": all as recorded" } else { ": the same bytes again" };
        }
        print(&text)?;
    }
    match outcome.differences.len() {
        0 => Ok(()),
        n => Err(Error::Incomplete(format!("{n} files differ"))),
    }
}

/// What is wrong with a file, if anything is.
fn state_of(path: &Path, expected: &Content) -> Result<Option<&'static str>, Error> {
    if !path.is_file() {
        return Ok(Some("is not there"));
    }
    let found = record::contents(Path::new(""), &[path.to_owned()])?;
    let same = found.iter().all(|content| content.sha256 == expected.sha256);
    Ok((!same).then_some("is not the same"))
}
