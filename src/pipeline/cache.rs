//! What the steps of a stage found, kept until what it came from changes.
//!
//! A file holds the mark of everything that decided it (contents of photos, options, results of the
//! step before), then CBOR. A mark that differs, or a file that is damaged, is as good as no file.

use crate::{
    error::Error,
    io::{FileError, checkpoint::Fingerprint, output},
};
use serde::{Serialize, de::DeserializeOwned};
use std::path::{Path, PathBuf};

/// A folder of results of steps.
pub(super) struct Cache {
    folder: PathBuf,
}

impl Cache {
    /// Makes the folder.
    pub(super) fn new(folder: &Path) -> Result<Cache, Error> {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
        Ok(Cache { folder: folder.to_owned() })
    }

    /// A mark to begin a step's own with: the build of the program.
    pub(super) fn mark() -> Fingerprint {
        Fingerprint::new().text(crate::BUILD)
    }

    /// What a step found under this mark.
    pub(super) fn load<T: DeserializeOwned>(&self, name: &str, mark: u64) -> Option<T> {
        let bytes = std::fs::read(self.folder.join(name)).ok()?;
        let (stored, rest) = bytes.split_at_checked(16)?;
        let (stored, checksum) = stored.split_at(8);
        if stored != mark.to_le_bytes()
            || checksum != Fingerprint::new().bytes(rest).finish().to_le_bytes()
        {
            return None;
        }
        ciborium::from_reader(rest).ok()
    }

    /// Keeps what a step found.
    pub(super) fn save(&self, name: &str, mark: u64, value: &impl Serialize) -> Result<(), Error> {
        let path = self.folder.join(name);
        let mut body = Vec::new();
        ciborium::into_writer(value, &mut body)
            .map_err(|e| FileError::write(&path, std::io::Error::other(e.to_string())))?;
        let checksum = Fingerprint::new().bytes(&body).finish();
        output::write(&path, true, |out| {
            out.write_all(&mark.to_le_bytes())?;
            out.write_all(&checksum.to_le_bytes())?;
            out.write_all(&body)
        })?;
        Ok(())
    }

    /// Removes what is kept under a name: a file or a folder.
    pub(super) fn forget(&self, name: &str) -> Result<(), Error> {
        let path = self.folder.join(name);
        let removed = if path.is_dir() {
            std::fs::remove_dir_all(&path)
        } else {
            std::fs::remove_file(&path)
        };
        match removed {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                Err(FileError::write(&path, e).into())
            }
            _ => Ok(()),
        }
    }

    /// A folder within.
    pub(super) fn within(&self, name: &str) -> Result<Cache, Error> {
        Cache::new(&self.folder.join(name))
    }
}
