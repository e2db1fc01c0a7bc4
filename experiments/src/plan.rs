//! The immutable list of tasks of an experiment: one task for each cell and seed.
//!
//! A plan is a file, `plan.json`, that is written once. Its hash covers the spec and every parameter
//! of every task, and every record of a finished task carries it, so that results of different plans
//! never mix.

use crate::{
    fail::Fail,
    spec::{Cell, Spec},
    stage::{self, Entry},
};
use rowgram::io::output;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// The file of a plan.
const FILE: &str = "plan.json";

/// What is to be done.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Plan {
    /// The experiment.
    pub(crate) spec: Spec,
    /// Whether it is the small setting.
    pub(crate) small: bool,
    /// Every setting.
    pub(crate) cells: Vec<Cell>,
    /// Version of the program that planned it.
    pub(crate) version: String,
}

/// A plan where it lies.
pub(crate) struct Planned {
    pub(crate) plan: Plan,
    pub(crate) hash: String,
    pub(crate) folder: PathBuf,
}

/// One cell under one seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Task {
    pub(crate) number: usize,
    pub(crate) cell: usize,
    pub(crate) seed: u64,
}

/// SHA-256 in hexadecimal.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |mut text, byte| {
        // Writing to a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

impl Plan {
    /// Reads and checks a spec.
    pub(crate) fn of(path: &Path, small: bool) -> Result<Plan, Fail> {
        let (spec, cells) = Spec::read(path, small)?;
        Ok(Plan { spec, small, cells, version: env!("CARGO_PKG_VERSION").to_owned() })
    }

    fn text(&self) -> Result<String, Fail> {
        serde_json::to_string(self).map_err(|e| Fail::Failed(format!("the plan: {e}")))
    }

    /// Writes the plan into `folder`; one that is there already has to be the same.
    ///
    /// # Errors
    /// Where another plan lies there and `force` is not set, and where it cannot be written.
    pub(crate) fn save(self, folder: &Path, force: bool) -> Result<Planned, Fail> {
        let text = self.text()?;
        let path = folder.join(FILE);
        let planned =
            Planned { hash: sha256(text.as_bytes()), plan: self, folder: folder.to_path_buf() };
        let there = std::fs::read(&path).ok();
        if there.as_deref() == Some(text.as_bytes()) {
            return Ok(planned);
        }
        if there.is_some() && !force {
            return Err(Fail::Input(format!(
                "{}: another plan is there already; choose another folder or pass --force",
                path.display()
            )));
        }
        std::fs::create_dir_all(planned.tasks_folder())
            .map_err(|e| Fail::io(&planned.tasks_folder(), &e))?;
        output::write(&path, force, |out| out.write_all(text.as_bytes()))?;
        Ok(planned)
    }
}

impl Planned {
    /// The plan of a folder.
    pub(crate) fn load(folder: &Path) -> Result<Planned, Fail> {
        let path = folder.join(FILE);
        let text = std::fs::read(&path).map_err(|e| {
            Fail::Input(format!("{}: {e}; `experiments plan` makes one", path.display()))
        })?;
        let plan: Plan = serde_json::from_slice(&text)
            .map_err(|e| Fail::Input(format!("{}: not a plan: {e}", path.display())))?;
        let hash = sha256(&text);
        Ok(Planned { plan, hash, folder: folder.to_path_buf() })
    }

    /// Whether a folder holds a plan.
    pub(crate) fn exists(folder: &Path) -> bool {
        folder.join(FILE).exists()
    }

    /// The stage under test.
    pub(crate) fn stage(&self) -> Result<&'static Entry, Fail> {
        stage::find(&self.plan.spec.stage).map_err(Fail::Input)
    }

    /// Where the records of finished tasks are.
    pub(crate) fn tasks_folder(&self) -> PathBuf {
        self.folder.join("tasks")
    }

    /// How many tasks there are.
    pub(crate) fn count(&self) -> usize {
        self.plan.cells.len() * self.plan.spec.seeds.count as usize
    }

    /// A task by its number: all seeds of a cell, then the next cell.
    pub(crate) fn task(&self, number: usize) -> Task {
        let seeds = self.plan.spec.seeds;
        let count = seeds.count as usize;
        Task { number, cell: number / count, seed: seeds.first + (number % count) as u64 }
    }
}
