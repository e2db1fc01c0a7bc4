//! The content store: bytes on disk under the key of everything that decided them.
//!
//! An entry has a name, which is its place: what is stored under it takes the place of what was there before, so the store does not
//! grow with time. A file holds the [`Key`] of everything that decided it, the key of its content, then the content in CBOR. A key
//! that differs, or a file that is damaged, is as good as no file. The store lies beside the results of stages and is no part of them.

use super::Key;
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::DeserializeOwned, de::Visitor};
use std::path::{Path, PathBuf};

/// Length of a key in a file.
const KEY_BYTES: usize = 32;
/// How the names of entries end. Whatever else lies in the folder is not touched.
const ENDING: &str = ".cbor";

/// A folder of entries.
pub(crate) struct Store {
    folder: PathBuf,
}

impl Store {
    /// That in a folder, which is made when something is stored.
    pub(crate) fn new(folder: impl Into<PathBuf>) -> Store {
        Store { folder: folder.into() }
    }

    /// A store within.
    pub(crate) fn within(&self, name: &str) -> Store {
        Store::new(self.folder.join(name))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.join(format!("{name}{ENDING}"))
    }

    /// What is stored under this key.
    pub(crate) fn load<T: DeserializeOwned>(&self, name: &str, key: Key) -> Option<T> {
        let bytes = std::fs::read(self.path(name)).ok()?;
        let (stored, rest) = bytes.split_at_checked(KEY_BYTES)?;
        let (content, body) = rest.split_at_checked(KEY_BYTES)?;
        if stored != key.bytes() || content != Key::of_bytes(body).bytes() {
            return None;
        }
        ciborium::from_reader(body).ok()
    }

    /// Stores a value.
    pub(crate) fn save(&self, name: &str, key: Key, value: &impl Serialize) -> Result<(), Error> {
        let path = self.path(name);
        let mut body = Vec::new();
        ciborium::into_writer(value, &mut body)
            .map_err(|e| FileError::write(&path, std::io::Error::other(e.to_string())))?;
        output::make_folder(&self.folder)?;
        output::write(&path, true, |out| {
            out.write_all(key.bytes())?;
            out.write_all(Key::of_bytes(&body).bytes())?;
            out.write_all(&body)
        })?;
        Ok(())
    }

    /// Removes an entry, or the store within that has this name.
    pub(crate) fn forget(&self, name: &str) -> Result<(), Error> {
        removed(&self.path(name), std::fs::remove_file(self.path(name)))?;
        let within = self.folder.join(name);
        removed(&within, std::fs::remove_dir_all(&within))
    }

    /// Removes all entries of other names than these: results of photos that have left the project.
    pub(crate) fn retain(&self, names: &[String]) -> Result<(), Error> {
        let Ok(entries) = std::fs::read_dir(&self.folder) else { return Ok(()) };
        for entry in entries {
            let entry = entry.map_err(|e| FileError::read(&self.folder, e))?;
            let name = entry.file_name();
            let other = |name: &&str| !names.iter().any(|retained| retained == name);
            if let Some(name) = name.to_str().and_then(|n| n.strip_suffix(ENDING)).filter(other) {
                removed(&entry.path(), std::fs::remove_file(self.path(name)))?;
            }
        }
        Ok(())
    }
}

/// What was not there is removed.
fn removed(path: &Path, result: std::io::Result<()>) -> Result<(), Error> {
    match result {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(FileError::write(path, e).into()),
        _ => Ok(()),
    }
}

/// Bytes as one CBOR string instead of a list of numbers.
#[derive(Debug, Default)]
pub(crate) struct Bytes(pub(crate) Vec<u8>);

impl Serialize for Bytes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Bytes {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Bytes, D::Error> {
        struct Read;
        impl Visitor<'_> for Read {
            type Value = Bytes;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }
            fn visit_bytes<E>(self, v: &[u8]) -> Result<Bytes, E> {
                Ok(Bytes(v.to_vec()))
            }
            fn visit_byte_buf<E>(self, v: Vec<u8>) -> Result<Bytes, E> {
                Ok(Bytes(v))
            }
        }
        from.deserialize_byte_buf(Read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_has_the_key_and_is_whole_is_loaded() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::new(folder.path().join("store"));
        let (key, other) = (Key::begin().count(1).finish(), Key::begin().count(2).finish());
        store.save("a", key, &vec![1.5, 2.5]).unwrap();
        assert_eq!(store.load::<Vec<f64>>("a", key), Some(vec![1.5, 2.5]));
        assert_eq!(store.load::<Vec<f64>>("a", other), None);
        assert_eq!(store.load::<Vec<f64>>("b", key), None);
        let path = folder.path().join("store/a.cbor");
        let mut bytes = std::fs::read(&path).unwrap();
        let last = bytes.len() - 1;
        bytes[last] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(store.load::<Vec<f64>>("a", key), None, "a damaged one");
        std::fs::write(&path, &bytes[..20]).unwrap();
        assert_eq!(store.load::<Vec<f64>>("a", key), None, "a short one");
        let foreign = folder.path().join("store/notes.txt");
        std::fs::write(&foreign, "somebody's").unwrap();
        store.save("retained", key, &1).unwrap();
        store.within("parts").save("0", key, &2).unwrap();
        store.retain(&["retained".to_owned()]).unwrap();
        assert!(!path.exists() && store.load::<i32>("retained", key) == Some(1));
        assert!(foreign.exists() && store.within("parts").load::<i32>("0", key) == Some(2));
        store.forget("parts").unwrap();
        assert_eq!(store.within("parts").load::<i32>("0", key), None);
    }
}
