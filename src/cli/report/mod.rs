//! The report of a run: one HTML file that needs no other, and `stats.json` with its numbers.

mod facts;
mod lights;
mod maps;
mod page;
mod pictures;
mod proof;
mod sections;

use crate::{
    error::Error,
    io::{FileError, output},
};
pub(super) use facts::Facts;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Write the report of a run again: report.html and stats.json
///
/// Reads what the stages of rowgram run left in PROJECT/rowgram. The page is one file: it can be sent, printed and
/// read without a network.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  rowgram report field")]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Folder of the results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print the numbers as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// When lights turn.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct Limits {
    /// Check points further off than so many ground sampling distances are not well.
    pub(super) check_yellow_gsd: f64,
    /// And so many are bad.
    pub(super) check_red_gsd: f64,
}

/// What the report is of.
pub(super) struct Sources<'a> {
    pub(super) root: &'a Path,
    pub(super) results: &'a Path,
    pub(super) name: Option<String>,
    /// Stages that were not done, and why.
    pub(super) skipped: &'a [(String, String)],
    pub(super) limits: Limits,
}

/// What was written.
pub(super) struct Written {
    /// All numbers.
    pub(super) stats: Value,
    /// The most important ones, for a terminal.
    pub(super) headline: String,
    /// The page.
    pub(super) path: PathBuf,
}

/// What the last run knew beside the records of its stages.
#[derive(Serialize, Deserialize)]
struct Last {
    name: Option<String>,
    skipped: Vec<(String, String)>,
    limits: Limits,
}

const LAST: &str = "run.json";

/// Runs the verb.
///
/// # Errors
/// A project without results, files that cannot be read or written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let results = args.output.clone().unwrap_or_else(|| args.project.join("rowgram"));
    let path = results.join(LAST);
    let text = std::fs::read(&path).map_err(|_| {
        FileError::malformed(&results, None, "there are no results here: run rowgram run first")
    })?;
    let last: Last = serde_json::from_slice(&text)
        .map_err(|e| FileError::malformed(&path, e.line(), e.to_string()))?;
    let written = write(&Sources {
        root: &args.project,
        results: &results,
        name: last.name,
        skipped: &last.skipped,
        limits: last.limits,
    })?;
    if args.json {
        return super::print_json(&written.stats);
    }
    super::print(&format!("{}\nreport  {}", written.headline, written.path.display()))
}

/// Writes `report.html` and `stats.json` into the results.
///
/// # Errors
/// Files that cannot be read or written.
pub(super) fn write(sources: &Sources<'_>) -> Result<Written, Error> {
    let facts = Facts::gather(sources)?;
    let lights = lights::lights(&facts, &sources.limits);
    let stats = facts.stats(&lights);
    let json = |name: &str, value: &Value| {
        output::write(&sources.results.join(name), true, |out| {
            serde_json::to_writer_pretty(&mut *out, value)?;
            writeln!(out)
        })
    };
    let last = Last {
        name: sources.name.clone(),
        skipped: sources.skipped.to_vec(),
        limits: sources.limits,
    };
    json(LAST, &serde_json::to_value(&last).unwrap_or_default())?;
    json("stats.json", &stats)?;
    let page = page::page(&facts, &lights)?;
    let path = sources.results.join("report.html");
    output::write(&path, true, |out| out.write_all(page.as_bytes()))?;
    Ok(Written { stats, headline: facts.headline(), path })
}
