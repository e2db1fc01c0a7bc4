//! Contents of files by their hashes. A file that is as it was is not read again.
//!
//! Every stage, and every part of a plan, asks for the contents of all photos; of thousands reading them takes longer than many a part. A
//! file is as it was where its inode, its length, and the times of the last write and of the last change of any kind are; the last of
//! these no program can set. It counts only where that change was some time before the file was read: clocks of file systems are
//! coarse, and those of two machines differ.

use super::{Key, Store, key};
use rayon::prelude::*;
use rowgram_base::error::Error;
use rowgram_optim::output::FileError;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::Read,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
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

impl Content {
    /// Reads a file.
    pub(crate) fn read(root: &Path, path: &Path) -> Result<Content, FileError> {
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
    }

    /// Whether the bytes are the same, wherever they are.
    pub(crate) fn is_same(&self, other: &Content) -> bool {
        (self.bytes, &self.sha256) == (other.bytes, &other.sha256)
    }
}

/// A path as seen from the project; one outside is absolute, for it is found again from another place.
pub(crate) fn relative(root: &Path, path: &Path) -> PathBuf {
    path.strip_prefix(root).map_or_else(|_| absolute(path), Path::to_owned)
}

/// A path that does not depend on where the process works.
pub(crate) fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// Lengths and contents of files, in the order given, read from the first byte to the last.
///
/// # Errors
/// A file that cannot be read.
pub fn contents(root: &Path, files: &[PathBuf]) -> Result<Vec<Content>, Error> {
    files.par_iter().map(|path| Ok(Content::read(root, path)?)).collect()
}

/// The name of the hashes in the store.
const HASHES: &str = "hashes";
/// So much older than its reading a change has to be, seconds.
const SETTLED_S: i64 = 60;

/// A file at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct FileState {
    inode: u64,
    bytes: u64,
    /// Seconds and nanoseconds since 1970.
    written: [i64; 2],
    changed: [i64; 2],
}

impl FileState {
    /// `None` where the system does not tell the time of the last change.
    fn of(path: &Path) -> Option<FileState> {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            let found = fs::metadata(path).ok()?;
            Some(FileState {
                inode: found.ino(),
                bytes: found.len(),
                written: [found.mtime(), found.mtime_nsec()],
                changed: [found.ctime(), found.ctime_nsec()],
            })
        }
        #[cfg(not(unix))]
        {
            let _ = path;
            None
        }
    }
}

/// Hashes by path.
type Known = BTreeMap<PathBuf, (FileState, Content)>;

/// As [`contents`], where a store remembers those of files that have not changed; each file by itself, for one may be unreadable.
///
/// # Errors
/// A store that cannot be written.
pub(crate) fn remembered(
    root: &Path,
    files: &[PathBuf],
    store: &Store,
) -> Result<Vec<Result<Content, FileError>>, Error> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    remembered_at(now.map_or(0, |since| since.as_secs() as i64), root, files, store)
}

fn remembered_at(
    now_s: i64,
    root: &Path,
    files: &[PathBuf],
    store: &Store,
) -> Result<Vec<Result<Content, FileError>>, Error> {
    let key = Key::of_bytes(HASHES.as_bytes());
    let mut known: Known = store.load(HASHES, key).unwrap_or_default();
    let read = |path: &PathBuf| {
        // Before it is read: a change meanwhile is seen the next time.
        let state = FileState::of(path);
        let before = known.get(&relative(root, path));
        if let Some((_, content)) = before.filter(|(known, _)| Some(known) == state.as_ref()) {
            return (Ok(content.clone()), None);
        }
        let settled = state.filter(|state| state.changed[0] + SETTLED_S <= now_s);
        (Content::read(root, path), settled)
    };
    let found: Vec<_> = files.par_iter().map(read).collect();
    let mut is_new = false;
    for (content, state) in &found {
        if let (Ok(content), Some(state)) = (content, state) {
            known.insert(content.path.clone(), (state.clone(), content.clone()));
            is_new = true;
        }
    }
    if is_new {
        // Files that have gone are forgotten.
        known.retain(|path, (state, _)| FileState::of(&root.join(path)).as_ref() == Some(state));
        store.save(HASHES, key, &known)?;
    }
    Ok(found.into_iter().map(|(content, _)| content).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn a_file_is_read_again_where_it_has_changed() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let store = Store::new(root.join("store"));
        let path = root.join("a.txt");
        fs::write(&path, "one").unwrap();
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64;
        let key = Key::of_bytes(HASHES.as_bytes());
        let known = || store.load::<Known>(HASHES, key).unwrap_or_default();
        let content = |now_s: i64| {
            let files = std::slice::from_ref(&path);
            remembered_at(now_s, root, files, &store).unwrap().remove(0).unwrap()
        };
        let first = content(now_s);
        assert!(known().is_empty(), "it was changed just now");
        assert_eq!(content(now_s + 100), first);
        // What is known is taken.
        let mut other = known();
        let forged = Content { sha256: "00".to_owned(), ..first.clone() };
        other.get_mut(Path::new("a.txt")).unwrap().1 = forged.clone();
        store.save(HASHES, key, &other).unwrap();
        assert_eq!(content(now_s), forged);
        // The same length and the same time of the last write, but other bytes.
        let written = fs::metadata(&path).unwrap().modified().unwrap();
        fs::write(&path, "two").unwrap();
        File::options().write(true).open(&path).unwrap().set_modified(written).unwrap();
        let changed = content(now_s + 100);
        assert!(changed != forged && changed.sha256 != first.sha256);
        // One that cannot be read is told by itself, one that has gone is forgotten.
        fs::remove_file(&path).unwrap();
        fs::write(root.join("b.txt"), "three").unwrap();
        let files = [path.clone(), root.join("b.txt")];
        let found = remembered_at(now_s + 100, root, &files, &store).unwrap();
        assert!(found[0].is_err() && found[1].is_ok());
        assert!(known().keys().eq([Path::new("b.txt")]));
    }
}
