//! What a stage did: its command, what it read and wrote, what it found.
//!
//! A stage's record is written when all of its files are; until then it has not been done. Its key stands for
//! everything that decides its files, so a stage whose key is the recorded one, and whose files still have the
//! recorded contents, need not be done again. Paths are relative to the project, which may move.
//!
//! Steps within a stage are kept in the same manner (`cache`): one kind of `Key` for both.

mod cache;
mod key;

pub(crate) use cache::Cache;
pub(crate) use key::Key;

use super::Stage;
use rayon::prelude::*;
use rowgram_base::{error::Error, monitor::Diagnostic, options::Choice};
use rowgram_optim::output::{self, FileError};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    fs::File,
    io::Read,
    path::{Path, PathBuf},
};

/// A file and what is in it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Content {
    /// Its place, relative to the project.
    pub path: PathBuf,
    /// Its length.
    pub bytes: u64,
    /// SHA-256 of its bytes, in hexadecimal digits.
    pub sha256: String,
}

/// What a stage did.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Record {
    /// Its name.
    pub stage: Stage,
    /// What decides its files.
    pub key: String,
    /// The command that repeats it, as a person would type it in the project.
    pub command: String,
    /// Its options, all of them.
    #[serde(default)]
    pub options: serde_json::Value,
    /// The program's version.
    pub version: String,
    /// Digest of the sources that the program was built from.
    pub build: String,
    /// What was read.
    pub inputs: Vec<Content>,
    /// What was written.
    pub outputs: Vec<Content>,
    /// What came of it.
    pub outcome: serde_json::Value,
    /// What was found on the way.
    pub diagnostics: Vec<Diagnostic>,
    /// How long it took.
    pub seconds: f64,
    /// The most memory that the run had used by its end, megabytes.
    pub peak_memory_mb: Option<f64>,
}

/// Lengths and contents of files, in the order given.
///
/// # Errors
/// A file that cannot be read.
pub fn contents(root: &Path, files: &[PathBuf]) -> Result<Vec<Content>, Error> {
    files
        .par_iter()
        .map(|path| {
            let read = |e| FileError::read(path, e);
            let mut file = File::open(path).map_err(read)?;
            let (mut hash, mut bytes) = (Sha256::new(), 0);
            let mut buffer = vec![0; 1 << 16];
            loop {
                let count = file.read(&mut buffer).map_err(read)?;
                if count == 0 {
                    break;
                }
                hash.update(&buffer[..count]);
                bytes += count as u64;
            }
            Ok(Content { path: relative(root, path), bytes, sha256: key::digits(&hash.finalize()) })
        })
        .collect()
}

/// A path as seen from the project; one outside stays as it is.
pub(crate) fn relative(root: &Path, path: &Path) -> PathBuf {
    path.strip_prefix(root).unwrap_or(path).to_owned()
}

/// All files under a folder, in a fixed order; `skip` names folders that are left out.
///
/// # Errors
/// A folder that cannot be read.
pub(crate) fn files(folder: &Path, skip: &[&str]) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    let mut waiting = vec![folder.to_owned()];
    while let Some(folder) = waiting.pop() {
        for entry in std::fs::read_dir(&folder).map_err(|e| FileError::read(&folder, e))? {
            let entry = entry.map_err(|e| FileError::read(&folder, e))?;
            let path = entry.path();
            let name = entry.file_name();
            if path.is_dir() {
                if !skip.iter().any(|skipped| name == **skipped) {
                    waiting.push(path);
                }
            } else if !name.to_string_lossy().starts_with('.') {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}

/// The records of a project's results.
pub struct Records {
    root: PathBuf,
    folder: PathBuf,
}

impl Records {
    /// Those of the project at `root` with results in `results`.
    pub fn of(root: &Path, results: &Path) -> Records {
        Records { root: root.to_owned(), folder: results.join("stages") }
    }

    fn path(&self, stage: Stage) -> PathBuf {
        self.folder.join(format!("{}.json", stage.word()))
    }

    /// What a stage did, if it was done.
    pub fn read(&self, stage: Stage) -> Option<Record> {
        // A record that cannot be read is none: the stage is done again.
        serde_json::from_slice(&std::fs::read(self.path(stage)).ok()?).ok()
    }

    /// What a stage did with this key, if all that it wrote is still there as it was.
    ///
    /// # Errors
    /// A file that is there and cannot be read.
    pub fn kept(&self, stage: Stage, key: &str) -> Result<Option<Record>, Error> {
        let Some(record) = self.read(stage).filter(|record| record.key == key) else {
            return Ok(None);
        };
        let paths: Vec<PathBuf> =
            record.outputs.iter().map(|output| self.root.join(&output.path)).collect();
        if !paths.iter().all(|path| path.is_file()) {
            return Ok(None);
        }
        Ok((contents(&self.root, &paths)? == record.outputs).then_some(record))
    }

    /// From now on the stage has not been done.
    ///
    /// # Errors
    /// Where the record cannot be removed.
    pub fn forget(&self, stage: Stage) -> Result<(), Error> {
        let path = self.path(stage);
        match std::fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                Err(FileError::write(&path, e).into())
            }
            _ => Ok(()),
        }
    }

    /// The stage has been done.
    ///
    /// # Errors
    /// Where the record cannot be written.
    pub fn write(&self, record: &Record) -> Result<(), Error> {
        std::fs::create_dir_all(&self.folder).map_err(|e| FileError::write(&self.folder, e))?;
        output::write(&self.path(record.stage), true, |out| {
            serde_json::to_writer_pretty(&mut *out, record)?;
            writeln!(out)
        })?;
        Ok(())
    }
}

/// Held while a process works on a project; the system gives it back when the process ends, however it ends.
#[derive(Debug)]
pub struct Lock {
    _file: File,
}

impl Lock {
    /// Takes it for one process alone.
    ///
    /// # Errors
    /// Where another run has it, or the folder cannot be written.
    pub fn take(results: &Path) -> Result<Lock, Error> {
        Lock::with(results, File::try_lock)
    }

    /// Takes it for a process that only adds to what is kept, together with others of the kind.
    ///
    /// # Errors
    /// Where a process has it alone, or the folder cannot be written.
    pub fn share(results: &Path) -> Result<Lock, Error> {
        Lock::with(results, File::try_lock_shared)
    }

    fn with(
        results: &Path,
        lock: impl Fn(&File) -> Result<(), std::fs::TryLockError>,
    ) -> Result<Lock, Error> {
        std::fs::create_dir_all(results).map_err(|e| FileError::write(results, e))?;
        let path = results.join(".lock");
        let failed = |e| FileError::write(&path, e);
        let file =
            File::options().create(true).truncate(false).write(true).open(&path).map_err(failed)?;
        match lock(&file) {
            Ok(()) => Ok(Lock { _file: file }),
            Err(std::fs::TryLockError::WouldBlock) => Err(Error::Argument(format!(
                "{}: another rowgram process is working here; wait until it has finished, or choose another folder with --output",
                results.display()
            ))),
            Err(std::fs::TryLockError::Error(e)) => Err(failed(e).into()),
        }
    }
}
