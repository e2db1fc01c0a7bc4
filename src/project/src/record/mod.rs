//! What a stage did: its command, what it read and wrote, what it found.
//!
//! A stage's record is written when all of its files are; until then it has not been done. Its key stands for
//! everything that decides its files, so a stage whose key is the recorded one, and whose files still have the
//! recorded contents, need not be done again. Paths are relative to the project, which may move. A record that the manifest of the
//! results does not list as it is was forged or damaged, and says nothing.
//!
//! Beside the records are the content store (`store`) for the steps of stages, under the same kind of `Key`; the contents of files
//! (`content`); the exchange of folders of results (`folder`); and what was written into a folder (`manifest`).

mod content;
mod folder;
mod key;
mod manifest;
mod store;

pub use content::{Content, contents};
pub(crate) use content::{absolute, relative, remembered};
pub(crate) use folder::{NewFolder, check as check_folder, temporary};
pub(crate) use key::Key;
pub(crate) use manifest::{
    MANIFEST, Manifest, check, holds, list_settings, publish, publish_folder, withdraw,
};
pub(crate) use store::{Bytes, Store};

use super::Stage;
use rowgram_base::{error::Error, monitor::Diagnostic, options::Choice};
use rowgram_optim::output::{self, FileError};
use serde::{Deserialize, Serialize};
use std::{
    fs::File,
    path::{Path, PathBuf},
};

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
    /// The most memory that it used, megabytes, where the system can count that anew.
    pub peak_memory_mb: Option<f64>,
    /// Whether the stage had nothing to do, or failed, when it was last looked at: the files are there, and nothing reads them.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_superseded: bool,
}

/// All files under a folder but hidden ones, in a fixed order.
///
/// # Errors
/// A folder that cannot be read.
pub(crate) fn files(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    let mut waiting = vec![folder.to_owned()];
    while let Some(folder) = waiting.pop() {
        for entry in std::fs::read_dir(&folder).map_err(|e| FileError::read(&folder, e))? {
            let entry = entry.map_err(|e| FileError::read(&folder, e))?;
            let path = entry.path();
            if entry.file_name().to_string_lossy().starts_with('.') {
                continue;
            }
            if path.is_dir() { &mut waiting } else { &mut found }.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The folder of the content store, in a folder of results.
pub(crate) const STORE: &str = ".rowgram-store";
/// Where the records are, in a folder of results.
pub(crate) const STAGES: &str = "stages";

/// The records of a project's results.
pub struct Records {
    root: PathBuf,
    results: PathBuf,
}

impl Records {
    /// Those of the project at `root` with results in `results`.
    pub fn of(root: &Path, results: &Path) -> Records {
        Records { root: root.to_owned(), results: results.to_owned() }
    }

    /// A record's place in the results.
    pub(crate) fn name(stage: Stage) -> String {
        format!("{STAGES}/{}.json", stage.word())
    }

    /// What a stage did, if it was done.
    pub fn read(&self, stage: Stage) -> Option<Record> {
        // A record that cannot be read or believed is none: the stage is done again.
        self.stored(stage).filter(|_| holds(&self.results, &Records::name(stage)))
    }

    /// What the file of a record says, believed or not.
    pub(crate) fn stored(&self, stage: Stage) -> Option<Record> {
        let path = self.results.join(Records::name(stage));
        serde_json::from_slice(&std::fs::read(path).ok()?).ok()
    }

    /// The files that a stage has written, by their paths from its folder.
    pub(crate) fn listed(&self, stage: Stage) -> Vec<Content> {
        let folder = absolute(&self.results.join(stage.word()));
        let written = self.stored(stage).map(|record| record.outputs).unwrap_or_default();
        let from_folder = |content: Content| {
            let path = absolute(&self.root.join(&content.path));
            Content { path: relative(&folder, &path), ..content }
        };
        written.into_iter().map(from_folder).collect()
    }

    /// Files that a stage has written and that are no longer there.
    pub(crate) fn missing(&self, stage: Stage) -> Option<PathBuf> {
        let written = self.read(stage).map(|record| record.outputs).unwrap_or_default();
        written.iter().map(|content| self.root.join(&content.path)).find(|path| !path.is_file())
    }

    /// What a stage did with this key, if all that it wrote is still there as it was.
    ///
    /// # Errors
    /// A file that is there and cannot be read.
    pub(crate) fn current(
        &self,
        stage: Stage,
        key: &str,
        store: &Store,
    ) -> Result<Option<Record>, Error> {
        let Some(record) = self.read(stage).filter(|record| record.key == key) else {
            return Ok(None);
        };
        let paths: Vec<PathBuf> =
            record.outputs.iter().map(|output| self.root.join(&output.path)).collect();
        if !paths.iter().all(|path| path.is_file()) {
            return Ok(None);
        }
        let found: Result<Vec<Content>, FileError> =
            remembered(&self.root, &paths, store)?.into_iter().collect();
        Ok((found? == record.outputs).then_some(record))
    }

    /// Whether later stages may read what a stage wrote when it was last done.
    ///
    /// # Errors
    /// Where the record cannot be written.
    pub(crate) fn supersede(&self, stage: Stage, is_superseded: bool) -> Result<(), Error> {
        match self.read(stage).filter(|record| record.is_superseded != is_superseded) {
            Some(record) => self.write(&Record { is_superseded, ..record }),
            None => Ok(()),
        }
    }

    /// The stage has been done: its new folder takes the place of the old one, and the record says so.
    ///
    /// # Errors
    /// A file of somebody's in the way, unless `force`; writing.
    pub(crate) fn finish(&self, record: &Record, new: NewFolder, force: bool) -> Result<(), Error> {
        // Where the exchange is the last thing that happens, `recover` finds the record here.
        let waiting = self.waiting(record.stage);
        output::make_folder(&self.results.join(STAGES))?;
        put(&waiting, record)?;
        if let Err(error) = new.finish(&self.listed(record.stage), force) {
            removed(&waiting)?;
            return Err(error);
        }
        self.write(record)?;
        removed(&waiting)
    }

    fn waiting(&self, stage: Stage) -> PathBuf {
        self.results.join(STAGES).join(format!(".{}.next", stage.word()))
    }

    fn write(&self, record: &Record) -> Result<(), Error> {
        let work = temporary(&self.results)?;
        let path = work.path().join(Records::name(record.stage));
        output::make_folder(output::folder_of(&path))?;
        put(&path, record)?;
        publish(work.path(), &self.results, true)
    }

    /// Puts right what a process left that was killed; only for who has the results alone.
    fn recover(&self) -> Result<(), Error> {
        folder::recover(&self.results)?;
        for stage in Stage::all() {
            let waiting = self.waiting(stage);
            let Ok(bytes) = std::fs::read(&waiting) else { continue };
            if let Ok(record) = serde_json::from_slice::<Record>(&bytes) {
                let written = record.outputs.iter().map(|output| self.root.join(&output.path));
                let written: Vec<PathBuf> = written.collect();
                if contents(&self.root, &written).is_ok_and(|found| found == record.outputs) {
                    self.write(&record)?;
                }
            }
            removed(&waiting)?;
        }
        Ok(())
    }
}

fn put(path: &Path, record: &Record) -> Result<(), Error> {
    Ok(output::write_json(path, true, record)?)
}

fn removed(path: &Path) -> Result<(), Error> {
    Ok(std::fs::remove_file(path).map_err(|e| FileError::write(path, e))?)
}

/// The file that a lock is on.
const LOCK: &str = ".lock";

/// Results that are no longer there in the middle of the work.
pub(crate) fn vanished(path: &Path) -> Error {
    let path = path.display();
    Error::Incomplete(format!("{path} has vanished while the work went on: do it again"))
}

/// Held while a process works on a project; the system gives it back when the process ends, however it ends.
#[derive(Debug)]
pub struct Lock {
    file: File,
    results: PathBuf,
}

impl Lock {
    /// Takes it for one process alone, which puts right what one before left that was killed.
    ///
    /// # Errors
    /// Where another run has it, or the folder cannot be written.
    pub fn take(root: &Path, results: &Path) -> Result<Lock, Error> {
        let lock = Lock::with(results, File::try_lock)?;
        Records::of(root, results).recover()?;
        Ok(lock)
    }

    /// Whether the folder of results is still there, and still the same.
    ///
    /// # Errors
    /// [`Error::Incomplete`] where it is not.
    pub fn check(&self) -> Result<(), Error> {
        let there = std::fs::metadata(self.results.join(LOCK));
        #[cfg(unix)]
        let is_same = {
            use std::os::unix::fs::MetadataExt;
            let own = self.file.metadata();
            own.is_ok_and(|own| {
                there.is_ok_and(|there| (own.dev(), own.ino()) == (there.dev(), there.ino()))
            })
        };
        #[cfg(not(unix))]
        let is_same = there.is_ok();
        if is_same { Ok(()) } else { Err(vanished(&self.results)) }
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
        if results.is_file() {
            let message = "it is a file, expected the folder of the results";
            return Err(FileError::Unusable { path: results.to_owned(), message }.into());
        }
        std::fs::create_dir_all(results).map_err(|e| FileError::write(results, e))?;
        let path = results.join(LOCK);
        let failed = |e| FileError::write(&path, e);
        let file =
            File::options().create(true).truncate(false).write(true).open(&path).map_err(failed)?;
        match lock(&file) {
            Ok(()) => Ok(Lock { file, results: results.to_owned() }),
            Err(std::fs::TryLockError::WouldBlock) => Err(Error::Argument(format!(
                "{}: another rowgram process is working here; wait until it has finished, or choose another folder with --output",
                results.display()
            ))),
            Err(std::fs::TryLockError::Error(e)) => Err(failed(e).into()),
        }
    }
}
