//! The report of a run: one HTML file that needs no other, from typed results; computes nothing.

mod adjustment;
mod block;
mod drawings;
mod map;
mod page;
mod pictures;
mod provenance;
mod season;
mod summary;
mod traits;
pub mod view;

pub use crate::run::REPORT_FILE;
use crate::{
    Project, Stage,
    record::{self, Record},
    run::RunOutcome,
};
use adjustment::Adjustment;
use rowgram_base::{error::Error, options::Choice};
use rowgram_files::{csv_table::CsvTable, reconstruction};
use rowgram_optim::output::{self, FileError};
use rowgram_survey::scene::Reconstruction;
pub use season::write_season;
use std::path::{Path, PathBuf};
pub use summary::summary;

/// Writes `report.html` into the results of a project, and gives its path.
///
/// # Errors
/// A file of that name that is not as it was written; files of the results that cannot be read, and writing.
pub fn write(project: &Project, outcome: &RunOutcome) -> Result<PathBuf, Error> {
    let _lock = project.lock()?;
    let page = page::page(&Facts::gather(project, outcome)?)?;
    put(&page, project.results(), project.is_forced())
}

/// Puts a page into a folder of results.
fn put(page: &str, results: &Path, force: bool) -> Result<PathBuf, Error> {
    let work = record::temporary(results)?;
    output::write(&work.path().join(REPORT_FILE), true, |out| out.write_all(page.as_bytes()))?;
    record::publish(work.path(), results, force)?;
    Ok(results.join(REPORT_FILE))
}

/// All that the report tells.
struct Facts<'a> {
    project: &'a Project,
    outcome: &'a RunOutcome,
    /// Records of the stages that have a result, in their order.
    records: Vec<Record>,
    /// The reconstruction and the statistics of its adjustment.
    block: Option<(Reconstruction, Adjustment)>,
}

impl<'a> Facts<'a> {
    fn gather(project: &'a Project, outcome: &'a RunOutcome) -> Result<Facts<'a>, Error> {
        let records = project.records();
        let with_result = Stage::all().into_iter().filter(|stage| outcome.has(*stage));
        let records = with_result.filter_map(|stage| records.read(stage)).collect();
        let mut facts = Facts { project, outcome, records, block: None };
        if let (Some(scene), Some(statistics)) = (
            facts.file(Stage::Align, reconstruction::NAME),
            facts.file(Stage::Align, adjustment::FILE),
        ) {
            facts.block = Some((reconstruction::read(&scene)?, Adjustment::read(&statistics)?));
        }
        Ok(facts)
    }

    /// A file of a stage that has a result.
    fn file(&self, stage: Stage, name: &str) -> Option<PathBuf> {
        self.project.finished(stage, name).filter(|_| self.outcome.has(stage))
    }

    /// A table of a stage that has a result.
    fn table(&self, stage: Stage, name: &str) -> Result<Option<CsvTable>, FileError> {
        self.file(stage, name).map(|path| CsvTable::read(&path)).transpose()
    }

    /// The orthomosaic that traits come from.
    fn orthomosaic(&self) -> Option<PathBuf> {
        self.project.orthomosaic().ok().filter(|_| self.outcome.has(Stage::Segment))
    }
}
