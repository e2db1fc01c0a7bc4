//! What a stage did: its command, what it read and wrote, and what it said.
//!
//! A stage's record is written when all of its files are; until then it has not been done. Its key stands for
//! everything that decides its files, so a stage whose key is the recorded one, and whose files still have the
//! recorded contents, need not be done again. Paths are relative to the project, which may move.

use crate::{
    error::Error,
    io::{FileError, output},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    fs::File,
    io::Read,
    path::{Path, PathBuf},
    sync::LazyLock,
};

/// A file and what is in it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::cli) struct Content {
    /// Its place, relative to the project.
    pub(in crate::cli) path: PathBuf,
    /// Its length.
    pub(in crate::cli) bytes: u64,
    /// SHA-256 of its bytes, in hexadecimal digits.
    pub(in crate::cli) sha256: String,
}

/// What a stage did.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(in crate::cli) struct Record {
    /// Its name.
    pub(in crate::cli) stage: String,
    /// What decides its files.
    pub(in crate::cli) key: String,
    /// The command that repeats it, as a person would type it in the project.
    pub(in crate::cli) command: String,
    /// The program's version.
    pub(in crate::cli) version: String,
    /// SHA-256 of the program itself; empty where it could not be read.
    #[serde(default)]
    pub(in crate::cli) program: String,
    /// What was read.
    pub(in crate::cli) inputs: Vec<Content>,
    /// What was written.
    pub(in crate::cli) outputs: Vec<Content>,
    /// What the stage says of its result.
    pub(in crate::cli) says: serde_json::Value,
    /// How long it took.
    pub(in crate::cli) seconds: f64,
    /// The most memory that the run had used by its end, megabytes.
    pub(in crate::cli) peak_memory_mb: Option<f64>,
}

/// Hexadecimal digits of a digest.
fn digits(digest: &[u8]) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The SHA-256 of a text.
pub(super) fn of_text(text: &str) -> String {
    digits(&Sha256::digest(text.as_bytes()))
}

/// Lengths and contents of files, in the order given.
///
/// # Errors
/// A file that cannot be read.
pub(in crate::cli) fn contents(root: &Path, files: &[PathBuf]) -> Result<Vec<Content>, Error> {
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
            Ok(Content { path: relative(root, path), bytes, sha256: digits(&hash.finalize()) })
        })
        .collect()
}

/// The SHA-256 of the program that runs; empty where the system does not let it be read.
///
/// It decides nothing, since builds of one version by several people are meant to agree; it tells apart what an
/// earlier build of a program under development wrote.
pub(super) fn program() -> &'static str {
    static PROGRAM: LazyLock<String> = LazyLock::new(|| {
        let contents =
            std::env::current_exe().ok().and_then(|path| contents(Path::new(""), &[path]).ok());
        contents.and_then(|mut found| found.pop()).map_or_else(String::new, |found| found.sha256)
    });
    &PROGRAM
}

/// A path as seen from the project; one outside stays as it is.
pub(super) fn relative(root: &Path, path: &Path) -> PathBuf {
    path.strip_prefix(root).unwrap_or(path).to_owned()
}

/// All files under a folder, in a fixed order; `skip` names folders that are left out.
///
/// # Errors
/// A folder that cannot be read.
pub(super) fn files(folder: &Path, skip: &[&str]) -> Result<Vec<PathBuf>, Error> {
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
pub(in crate::cli) struct Records {
    root: PathBuf,
    folder: PathBuf,
}

impl Records {
    /// Those of the project at `root` with results in `results`.
    pub(in crate::cli) fn of(root: &Path, results: &Path) -> Records {
        Records { root: root.to_owned(), folder: results.join("stages") }
    }

    fn path(&self, stage: &str) -> PathBuf {
        self.folder.join(format!("{stage}.json"))
    }

    /// What a stage did, if it was done.
    pub(in crate::cli) fn read(&self, stage: &str) -> Option<Record> {
        // A record that cannot be read is none: the stage is done again.
        serde_json::from_slice(&std::fs::read(self.path(stage)).ok()?).ok()
    }

    /// What a stage did with this key, if all that it wrote is still there as it was.
    ///
    /// # Errors
    /// A file that is there and cannot be read.
    pub(super) fn kept(&self, stage: &str, key: &str) -> Result<Option<Record>, Error> {
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
    pub(super) fn forget(&self, stage: &str) -> Result<(), Error> {
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
    pub(super) fn write(&self, record: &Record) -> Result<(), Error> {
        std::fs::create_dir_all(&self.folder).map_err(|e| FileError::write(&self.folder, e))?;
        output::write(&self.path(&record.stage), true, |out| {
            serde_json::to_writer_pretty(&mut *out, record)?;
            writeln!(out)
        })?;
        Ok(())
    }
}

/// Held while a run is at work on a project; given back when the program ends, however it ends.
pub(super) struct Lock {
    _file: File,
}

impl Lock {
    /// Takes it.
    ///
    /// # Errors
    /// Where another run has it, or the folder cannot be written.
    pub(super) fn take(results: &Path) -> Result<Lock, Error> {
        std::fs::create_dir_all(results).map_err(|e| FileError::write(results, e))?;
        let path = results.join(".lock");
        let failed = |e| FileError::write(&path, e);
        let file =
            File::options().create(true).truncate(false).write(true).open(&path).map_err(failed)?;
        match file.try_lock() {
            Ok(()) => Ok(Lock { _file: file }),
            Err(std::fs::TryLockError::WouldBlock) => Err(Error::Argument(format!(
                "{}: another rowgram run is at work here; wait for its end, or give another --output",
                results.display()
            ))),
            Err(std::fs::TryLockError::Error(e)) => Err(failed(e).into()),
        }
    }
}
