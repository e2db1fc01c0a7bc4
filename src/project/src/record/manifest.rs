//! What was written into a folder of results, and what was in it.
//!
//! Only what a manifest lists, and as it lists it, is replaced: a file that somebody else put there, or has edited since, is refused by
//! name, or kept beside under another name where that was asked for. A manifest has a digest of its own.

use super::{Content, contents, folder, key};
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    fs::File,
    path::{Path, PathBuf},
};

/// Its file in the folder.
pub(crate) const MANIFEST: &str = "rowgram-manifest.json";

/// The files that were written into a folder, but for those of stages: their records, which it lists, list these.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Manifest {
    /// By their paths from the folder. While one is replaced, it is listed as it was and as it will be.
    pub(crate) files: Vec<Content>,
    /// The settings that a person wrote for the last run, where there were any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) settings: Option<Content>,
    /// Of all of the above.
    sha256: String,
}

impl Manifest {
    /// That of a folder; `None` where there is none, or what it says does not fit its digest.
    pub(crate) fn read(folder: &Path) -> Option<Manifest> {
        let bytes = std::fs::read(folder.join(MANIFEST)).ok()?;
        let found: Manifest = serde_json::from_slice(&bytes).ok()?;
        (found.digest() == found.sha256).then_some(found)
    }

    fn digest(&self) -> String {
        let bytes = serde_json::to_vec(&(&self.files, &self.settings)).unwrap_or_default();
        key::digits(&Sha256::digest(bytes))
    }

    fn write(&mut self, folder: &Path) -> Result<(), Error> {
        self.files.sort_by(|a, b| (&a.path, &a.sha256).cmp(&(&b.path, &b.sha256)));
        self.files.dedup();
        self.sha256 = self.digest();
        Ok(output::write_json(&folder.join(MANIFEST), true, self)?)
    }

    /// Whether a run of several stages was done, which had the settings of a person or none.
    pub(crate) fn lists_run(&self) -> bool {
        self.files.iter().any(|content| content.path == Path::new(crate::run::RESOLVED_FILE))
    }

    /// Whether it lists these bytes at this place.
    pub(crate) fn lists(&self, content: &Content) -> bool {
        self.files.contains(content)
    }
}

/// Whether a file of a folder of results has the bytes that were written.
pub(crate) fn holds(folder: &Path, name: &str) -> bool {
    let content = Content::read(folder, &folder.join(name));
    Manifest::read(folder).zip(content.ok()).is_some_and(|(listed, content)| listed.lists(&content))
}

/// Refuses, unless `force`, files of a folder of results that are not as they were written: before any work is done.
///
/// # Errors
/// The first.
pub(crate) fn check(folder: &Path, names: &[&str], force: bool) -> Result<(), Error> {
    let is_foreign = |name: &&str| folder.join(name).exists() && !holds(folder, name);
    match names.iter().copied().find(is_foreign) {
        Some(name) if !force => Err(folder::foreign(&folder.join(name))),
        _ => Ok(()),
    }
}

/// Puts the files that are in `work` into a folder of results, each in place of the one that was written there before.
///
/// # Errors
/// A file in the way that is not as it was written, unless `force`, which keeps it beside; writing.
pub(crate) fn publish(work: &Path, folder: &Path, force: bool) -> Result<(), Error> {
    let files = super::files(work)?;
    let fresh = contents(work, &files)?;
    let mut manifest = Manifest::read(folder).unwrap_or_default();
    for file in &fresh {
        let path = folder.join(&file.path);
        let found = Content::read(folder, &path).ok();
        if found.is_some_and(|found| found != *file && !manifest.lists(&found)) {
            folder::set_aside(&path, force)?;
        }
    }
    // Whatever ends this half-way, both the old and the new file are listed.
    output::make_folder(folder)?;
    manifest.files.extend(fresh.iter().cloned());
    manifest.write(folder)?;
    for (file, from) in fresh.iter().zip(&files) {
        let path = folder.join(&file.path);
        output::make_folder(output::folder_of(&path))?;
        let mut source = File::open(from).map_err(|e| FileError::read(from, e))?;
        output::write(&path, true, |out| std::io::copy(&mut source, out).map(drop))?;
    }
    let is_old = |old: &Content| fresh.iter().any(|new| new.path == old.path && new != old);
    manifest.files.retain(|old| !is_old(old));
    manifest.write(folder)
}

/// Puts a folder within a folder of results in its place, and lists its files.
///
/// # Errors
/// A file of somebody's in the way, unless `force`, which keeps it beside; writing.
pub(crate) fn publish_folder(
    new: folder::NewFolder,
    folder: &Path,
    name: &str,
    force: bool,
) -> Result<(), Error> {
    let within = |content: &Content| content.path.strip_prefix(name).ok().map(Path::to_owned);
    let mut fresh = contents(new.path(), &super::files(new.path())?)?;
    fresh.iter_mut().for_each(|content| content.path = Path::new(name).join(&content.path));
    let mut manifest = Manifest::read(folder).unwrap_or_default();
    let old: Vec<Content> = manifest
        .files
        .iter()
        .filter_map(|content| Some(Content { path: within(content)?, ..content.clone() }))
        .collect();
    manifest.files.extend(fresh.iter().cloned());
    manifest.write(folder)?;
    new.finish(&old, force)?;
    manifest.files.retain(|content| within(content).is_none() || fresh.contains(content));
    manifest.write(folder)
}

/// Removes a file, where it is as it was written, and no longer lists it.
///
/// # Errors
/// Where it cannot be removed.
pub(crate) fn withdraw(folder: &Path, name: &str) -> Result<(), Error> {
    let Some(mut manifest) = Manifest::read(folder).filter(|_| holds(folder, name)) else {
        return Ok(());
    };
    let path = folder.join(name);
    std::fs::remove_file(&path).map_err(|e| FileError::write(&path, e))?;
    manifest.files.retain(|listed| listed.path != Path::new(name));
    manifest.write(folder)
}

/// Lists the settings that a run was done with.
///
/// # Errors
/// Settings that cannot be read; writing.
pub(crate) fn list_settings(folder: &Path, settings: Option<PathBuf>) -> Result<(), Error> {
    let root = settings.as_deref().map(output::folder_of);
    let read = settings.as_deref().zip(root).map(|(path, root)| Content::read(root, path));
    let mut manifest = Manifest::read(folder).unwrap_or_default();
    manifest.settings = read.transpose()?;
    manifest.write(folder)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn put(folder: &Path, files: &[(&str, &str)], force: bool) -> Result<(), Error> {
        let work = tempfile::tempdir().unwrap();
        for (name, text) in files {
            fs::write(work.path().join(name), text).unwrap();
        }
        publish(work.path(), folder, force)
    }

    #[test]
    fn a_file_is_no_folder_of_results() {
        let root = tempfile::tempdir().unwrap();
        let results = root.path().join("afile");
        fs::write(&results, "").unwrap();
        let error = super::super::Lock::take(root.path(), &results).map(drop).unwrap_err();
        assert_eq!(error.kind(), rowgram_base::error::Kind::BadInput, "{error}");
    }

    #[test]
    fn only_what_was_written_is_replaced() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("results");
        let text = |name: &str| fs::read_to_string(folder.join(name)).unwrap();
        put(&folder, &[("a.csv", "1"), ("b.csv", "2")], false).unwrap();
        put(&folder, &[("a.csv", "3")], false).unwrap();
        assert_eq!((text("a.csv").as_str(), text("b.csv").as_str()), ("3", "2"));
        assert!(holds(&folder, "a.csv") && holds(&folder, "b.csv"));
        // Edited since, and never written: refused by name, before anything is touched.
        fs::write(folder.join("b.csv"), "mine").unwrap();
        fs::write(folder.join("c.csv"), "mine too").unwrap();
        for name in ["b.csv", "c.csv"] {
            let why = put(&folder, &[("a.csv", "4"), (name, "5")], false).unwrap_err();
            assert!(why.to_string().contains(name) && text("a.csv") == "3", "{why}");
            assert!(check(&folder, &["a.csv", name], false).is_err());
        }
        put(&folder, &[("a.csv", "4"), ("b.csv", "5"), ("c.csv", "6")], true).unwrap();
        assert_eq!((text("b.csv").as_str(), text("b.csv.edited").as_str()), ("5", "mine"));
        assert_eq!(text("c.csv.edited"), "mine too");
        // What is there already in these bytes is in nobody's way.
        fs::write(folder.join("d.csv"), "7").unwrap();
        put(&folder, &[("d.csv", "7")], false).unwrap();
        // Only what is as it was written is withdrawn.
        withdraw(&folder, "d.csv").unwrap();
        withdraw(&folder, "b.csv.edited").unwrap();
        assert!(!folder.join("d.csv").exists() && folder.join("b.csv.edited").exists());
    }

    #[test]
    fn a_forged_manifest_is_none() {
        let root = tempfile::tempdir().unwrap();
        put(root.path(), &[("a.csv", "1")], false).unwrap();
        let path = root.path().join(MANIFEST);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replace("\"bytes\": 1", "\"bytes\": 2")).unwrap();
        assert!(Manifest::read(root.path()).is_none() && !holds(root.path(), "a.csv"));
        assert!(put(root.path(), &[("a.csv", "2")], false).is_err());
    }
}
