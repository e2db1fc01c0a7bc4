//! A folder of results that appears when all of it is there.
//!
//! It is made beside the one that it replaces, and the two are exchanged at the end: what fails, is killed or is refused leaves the
//! last good result as it was. What somebody else put into the old one is carried over.

use super::{Content, contents};
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use std::{
    fs, io,
    path::{Path, PathBuf},
};

/// How folders begin that are being made.
const NEW: &str = ".rowgram-new-";
/// How folders begin that wait for those that replace them.
const OLD: &str = ".rowgram-old-";

/// A folder in the making.
pub(crate) struct NewFolder {
    folder: PathBuf,
    work: tempfile::TempDir,
}

impl NewFolder {
    /// One that will be `folder`; where that is a link, what it leads to.
    ///
    /// # Errors
    /// Something that is no folder, and a place where nothing can be written.
    pub(crate) fn begin(folder: &Path) -> Result<NewFolder, Error> {
        let is_link = fs::symlink_metadata(folder).is_ok_and(|of| of.is_symlink());
        if !folder.is_dir() && (is_link || folder.exists()) {
            let message = "expected a folder, or nothing, in the place of results";
            return Err(FileError::malformed(folder, None, message).into());
        }
        let target = if is_link { folder.canonicalize().ok() } else { None };
        let folder = target.unwrap_or_else(|| folder.to_owned());
        let parent = output::folder_of(&folder);
        output::make_folder(parent)?;
        Ok(NewFolder { work: temporary(parent)?, folder })
    }

    /// Where it is made.
    pub(crate) fn path(&self) -> &Path {
        self.work.path()
    }

    /// Puts it in its place. Of the old one those files go that are as `listed`, by their paths from the folder; the others are carried over.
    ///
    /// # Errors
    /// A file of somebody's in the place of a new one, unless `force`, which keeps it beside; writing.
    pub(crate) fn finish(self, listed: &[Content], force: bool) -> Result<(), Error> {
        let (work, folder) = (self.work.path(), self.folder.as_path());
        if folder.exists() {
            for path in others(folder, listed)? {
                carry(folder, &path, work, force)?;
            }
            let mode = fs::metadata(folder).map_err(|e| FileError::read(folder, e))?.permissions();
            fs::set_permissions(work, mode).map_err(|e| FileError::write(work, e))?;
        }
        exchange(work, folder).map_err(|e| FileError::write(folder, e))?;
        Ok(())
    }
}

/// A folder for work, as readable as the person's other folders are; gone when it is dropped.
pub(crate) fn temporary(parent: &Path) -> Result<tempfile::TempDir, Error> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(NEW);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(fs::Permissions::from_mode(0o777));
    }
    Ok(builder.tempdir_in(parent).map_err(|e| FileError::write(parent, e))?)
}

/// Removes what processes that were killed have left in a folder of results.
pub(super) fn recover(results: &Path) -> Result<(), Error> {
    for entry in fs::read_dir(results).map_err(|e| FileError::read(results, e))? {
        let entry = entry.map_err(|e| FileError::read(results, e))?;
        let (path, name) = (entry.path(), entry.file_name());
        let name = name.to_string_lossy();
        let old = name.strip_prefix(OLD).map(|name| results.join(name));
        let done = match old {
            Some(folder) if !folder.exists() => fs::rename(&path, folder),
            Some(_) => fs::remove_dir_all(&path),
            None if name.starts_with(NEW) => fs::remove_dir_all(&path),
            None => continue,
        };
        done.map_err(|e| FileError::write(&path, e))?;
    }
    Ok(())
}

/// Refuses, unless `force`, a folder with files that were edited since they were listed: before any work is done.
///
/// # Errors
/// The first.
pub(crate) fn check(folder: &Path, listed: &[Content], force: bool) -> Result<(), Error> {
    if force || !folder.is_dir() {
        return Ok(());
    }
    let is_listed = |path: &&PathBuf| listed.iter().any(|content| content.path == **path);
    match others(folder, listed)?.iter().find(is_listed) {
        Some(path) => Err(foreign(&folder.join(path))),
        None => Ok(()),
    }
}

/// All files under a folder that are not as listed, by their paths from it.
fn others(folder: &Path, listed: &[Content]) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    for path in all(folder)? {
        let name = path.strip_prefix(folder).unwrap_or(&path).to_owned();
        let of_name = listed.iter().find(|content| content.path == name);
        let is_file = fs::symlink_metadata(&path).is_ok_and(|of| of.is_file());
        if let Some(expected) = of_name.filter(|_| is_file)
            && Content::read(folder, &path)?.is_same(expected)
        {
            continue;
        }
        found.push(name);
    }
    Ok(found)
}

/// Everything under a folder that is no folder, in a fixed order.
fn all(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    let mut waiting = vec![folder.to_owned()];
    while let Some(folder) = waiting.pop() {
        for entry in fs::read_dir(&folder).map_err(|e| FileError::read(&folder, e))? {
            let entry = entry.map_err(|e| FileError::read(&folder, e))?;
            let kind = entry.file_type().map_err(|e| FileError::read(&entry.path(), e))?;
            if kind.is_dir() { &mut waiting } else { &mut found }.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// A file that is not as it was written, or never was.
pub(super) fn foreign(path: &Path) -> Error {
    let message = "it is not as rowgram wrote it: it was edited since, or is somebody else's; move it away, \
                   or give --force to keep it beside with the ending .edited";
    FileError::malformed(path, None, message).into()
}

/// A name beside a file that nothing has.
fn beside(path: &Path) -> PathBuf {
    let named = |ending: &str| {
        let mut name = path.as_os_str().to_owned();
        name.push(ending);
        PathBuf::from(name)
    };
    let numbered = (2..).map(|number| named(&format!(".edited-{number}")));
    let mut names = std::iter::once(named(".edited")).chain(numbered);
    names.find(|name| fs::symlink_metadata(name).is_err()).unwrap_or_default()
}

/// Moves a file out of the way of results.
///
/// # Errors
/// That it is in the way, unless `force`.
pub(super) fn set_aside(path: &Path, force: bool) -> Result<(), Error> {
    if !force {
        return Err(foreign(path));
    }
    let kept = beside(path);
    fs::rename(path, &kept).map_err(|e| FileError::write(path, e))?;
    tell(path, &kept);
    Ok(())
}

fn tell(path: &Path, kept: &Path) {
    tracing::warn!("{} was not as rowgram wrote it: kept as {}", path.display(), kept.display());
}

/// Takes a file of somebody's over into the new folder. The old one keeps it too, whenever this ends.
fn carry(folder: &Path, name: &Path, work: &Path, force: bool) -> Result<(), Error> {
    let (from, mut to) = (folder.join(name), work.join(name));
    if let Ok(there) = fs::symlink_metadata(&to) {
        let both = [from.clone(), to.clone()];
        let are_files = there.is_file() && fs::symlink_metadata(&from).is_ok_and(|of| of.is_file());
        if are_files && matches!(contents(work, &both)?.as_slice(), [a, b] if a.is_same(b)) {
            return Ok(());
        }
        if !force {
            return Err(foreign(&from));
        }
        to = beside(&to);
        tell(&from, &folder.join(to.strip_prefix(work).unwrap_or(&to)));
    }
    output::make_folder(output::folder_of(&to))?;
    // Some file systems know no second name for a file.
    let linked = fs::hard_link(&from, &to).or_else(|_| fs::copy(&from, &to).map(drop));
    Ok(linked.map_err(|e| FileError::write(&to, e))?)
}

/// Exchanges two folders, or moves the first where there is no second.
fn exchange(work: &Path, folder: &Path) -> io::Result<()> {
    if !folder.exists() {
        return fs::rename(work, folder);
    }
    #[cfg(any(target_os = "linux", target_os = "macos"))]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        if renameat_with(CWD, work, CWD, folder, RenameFlags::EXCHANGE).is_ok() {
            return Ok(());
        }
    }
    exchange_by_turns(work, folder)
}

/// The same where the file system cannot do it at once; what is left half-way is put right by [`recover`].
fn exchange_by_turns(work: &Path, folder: &Path) -> io::Result<()> {
    let mut name = std::ffi::OsString::from(OLD);
    name.push(folder.file_name().unwrap_or_default());
    let old = folder.with_file_name(name);
    fs::rename(folder, &old)?;
    if let Err(error) = fs::rename(work, folder) {
        fs::rename(&old, folder)?;
        return Err(error);
    }
    fs::rename(&old, work)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listed(folder: &Path, names: &[&str]) -> Vec<Content> {
        let files: Vec<PathBuf> = names.iter().map(|name| folder.join(name)).collect();
        contents(folder, &files).unwrap()
    }

    #[test]
    fn the_old_folder_is_exchanged_and_what_is_somebodys_is_carried_over() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("dem");
        let text = |name: &str| fs::read_to_string(folder.join(name)).unwrap();
        let make = |files: &[(&str, &str)]| {
            let new = NewFolder::begin(&folder).unwrap();
            for (name, text) in files {
                output::make_folder(output::folder_of(&new.path().join(name))).unwrap();
                fs::write(new.path().join(name), text).unwrap();
            }
            new
        };
        make(&[("dem.tif", "1"), ("figures/dem.png", "1")]).finish(&[], false).unwrap();
        let first = listed(&folder, &["dem.tif", "figures/dem.png"]);
        fs::write(folder.join("survey.tif"), "mine").unwrap();
        fs::create_dir(folder.join("notes")).unwrap();
        fs::write(folder.join("notes/.hidden"), "mine").unwrap();
        // A failure leaves everything as it was.
        drop(make(&[("dem.tif", "half")]));
        assert_eq!(text("dem.tif"), "1");
        make(&[("dem.tif", "2")]).finish(&first, false).unwrap();
        assert_eq!((text("dem.tif"), text("survey.tif")), ("2".into(), "mine".into()));
        assert_eq!(text("notes/.hidden"), "mine");
        assert!(!folder.join("figures").exists(), "what was written is replaced");
        // Edited since: refused before and after the work; kept beside on request.
        let second = listed(&folder, &["dem.tif"]);
        fs::write(folder.join("dem.tif"), "edited").unwrap();
        assert!(check(&folder, &second, false).unwrap_err().to_string().contains("dem.tif"));
        assert!(check(&folder, &second, true).is_ok());
        assert!(make(&[("dem.tif", "3")]).finish(&second, false).is_err());
        assert_eq!(text("dem.tif"), "edited");
        make(&[("dem.tif", "3"), ("survey.tif", "3")]).finish(&second, true).unwrap();
        assert_eq!((text("dem.tif"), text("dem.tif.edited")), ("3".into(), "edited".into()));
        assert_eq!((text("survey.tif"), text("survey.tif.edited")), ("3".into(), "mine".into()));
        assert_eq!(fs::read_dir(root.path()).unwrap().count(), 1, "no litter");
    }

    #[test]
    fn a_process_that_was_killed_leaves_nothing_behind() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        for name in ["align", ".rowgram-old-dem", ".rowgram-old-align", ".rowgram-new-x"] {
            fs::create_dir(at(name)).unwrap();
            fs::write(at(name).join("a.txt"), name).unwrap();
        }
        recover(root.path()).unwrap();
        let mut names: Vec<_> =
            fs::read_dir(root.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["align", "dem"]);
        assert_eq!(fs::read_to_string(at("dem/a.txt")).unwrap(), ".rowgram-old-dem");
        exchange_by_turns(&at("align"), &at("dem")).unwrap();
        assert_eq!(fs::read_to_string(at("dem/a.txt")).unwrap(), "align");
        assert_eq!(fs::read_to_string(at("align/a.txt")).unwrap(), ".rowgram-old-dem");
    }

    #[test]
    #[cfg(unix)]
    fn a_folder_that_is_a_link_stays_one() {
        let root = tempfile::tempdir().unwrap();
        let (folder, disk) = (root.path().join("ortho"), root.path().join("disk"));
        fs::create_dir(&disk).unwrap();
        std::os::unix::fs::symlink(&disk, &folder).unwrap();
        let new = NewFolder::begin(&folder).unwrap();
        fs::write(new.path().join("ortho.tif"), "1").unwrap();
        new.finish(&[], false).unwrap();
        assert!(fs::symlink_metadata(&folder).unwrap().is_symlink());
        assert_eq!(fs::read_to_string(disk.join("ortho.tif")).unwrap(), "1");
    }
}
