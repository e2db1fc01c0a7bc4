//! What the steps of a stage found, kept until what it came from changes.
//!
//! A file holds the [`Key`] of everything that decided it, the key of its content, then the content in CBOR. A key that
//! differs, or a file that is damaged, is as good as no file.

use super::Key;
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use serde::{Serialize, de::DeserializeOwned};
use std::path::{Path, PathBuf};

/// Length of a key in a file.
const KEY_BYTES: usize = 32;

/// A folder of results of steps.
pub(crate) struct Cache {
    folder: PathBuf,
}

impl Cache {
    /// Makes the folder.
    pub(crate) fn new(folder: &Path) -> Result<Cache, Error> {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
        Ok(Cache { folder: folder.to_owned() })
    }

    /// What a step found under this key.
    pub(crate) fn load<T: DeserializeOwned>(&self, name: &str, key: Key) -> Option<T> {
        let bytes = std::fs::read(self.folder.join(name)).ok()?;
        let (stored, rest) = bytes.split_at_checked(KEY_BYTES)?;
        let (content, body) = rest.split_at_checked(KEY_BYTES)?;
        if stored != key.bytes() || content != Key::of_bytes(body).bytes() {
            return None;
        }
        ciborium::from_reader(body).ok()
    }

    /// Keeps what a step found.
    pub(crate) fn save(&self, name: &str, key: Key, value: &impl Serialize) -> Result<(), Error> {
        let path = self.folder.join(name);
        let mut body = Vec::new();
        ciborium::into_writer(value, &mut body)
            .map_err(|e| FileError::write(&path, std::io::Error::other(e.to_string())))?;
        output::write(&path, true, |out| {
            out.write_all(key.bytes())?;
            out.write_all(Key::of_bytes(&body).bytes())?;
            out.write_all(&body)
        })?;
        Ok(())
    }

    /// Removes what is kept under a name: a file or a folder.
    pub(crate) fn forget(&self, name: &str) -> Result<(), Error> {
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

    /// Removes all that is kept under other names than these: results of photos that have left the project.
    pub(crate) fn retain(&self, names: &[String]) -> Result<(), Error> {
        let entries =
            std::fs::read_dir(&self.folder).map_err(|e| FileError::read(&self.folder, e))?;
        for entry in entries {
            let entry = entry.map_err(|e| FileError::read(&self.folder, e))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if !names.contains(&name) {
                self.forget(&name)?;
            }
        }
        Ok(())
    }

    /// A folder within.
    pub(crate) fn within(&self, name: &str) -> Result<Cache, Error> {
        Cache::new(&self.folder.join(name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_has_the_key_and_is_whole_is_loaded() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::new(&folder.path().join("cache")).unwrap();
        let (key, other) = (Key::begin().count(1).finish(), Key::begin().count(2).finish());
        cache.save("a.cbor", key, &vec![1.5, 2.5]).unwrap();
        assert_eq!(cache.load::<Vec<f64>>("a.cbor", key), Some(vec![1.5, 2.5]));
        assert_eq!(cache.load::<Vec<f64>>("a.cbor", other), None);
        assert_eq!(cache.load::<Vec<f64>>("b.cbor", key), None);
        let path = folder.path().join("cache/a.cbor");
        let mut bytes = std::fs::read(&path).unwrap();
        let last = bytes.len() - 1;
        bytes[last] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(cache.load::<Vec<f64>>("a.cbor", key), None, "a damaged one");
        std::fs::write(&path, &bytes[..20]).unwrap();
        assert_eq!(cache.load::<Vec<f64>>("a.cbor", key), None, "a short one");
        cache.save("kept.cbor", key, &1).unwrap();
        cache.retain(&["kept.cbor".to_owned()]).unwrap();
        assert!(!path.exists() && cache.load::<i32>("kept.cbor", key) == Some(1));
    }
}
