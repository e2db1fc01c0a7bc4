//! Outputs that appear whole or not at all.
//!
//! A file is written beside its final place under a temporary name and renamed when complete, so a
//! reader never sees half of one and a failure leaves what was there before.

use std::{
    fs::{self, File},
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

/// What is wrong with a file: which one, where in it, what was expected.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FileError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file cannot be created or written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The output is already there and `--force` was not given.
    #[error("{} exists already; give --force to replace it, or another path", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The output path cannot be used as given.
    #[error("cannot write {}: {message}", path.display())]
    Unusable {
        /// The path.
        path: PathBuf,
        /// Why.
        message: &'static str,
    },
    /// The content is not what the format asks for.
    #[error("{}{}: {message}", path.display(), line.map(|n| format!(", line {n}")).unwrap_or_default())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// One-based line, for text formats.
        line: Option<usize>,
        /// What is wrong and what was expected.
        message: String,
    },
}

impl FileError {
    /// Shorthand for [`FileError::Read`].
    pub fn read(path: &Path, source: std::io::Error) -> FileError {
        FileError::Read { path: path.to_owned(), source }
    }

    /// Shorthand for [`FileError::Write`].
    pub fn write(path: &Path, source: std::io::Error) -> FileError {
        FileError::Write { path: path.to_owned(), source }
    }

    /// Shorthand for [`FileError::Malformed`]; `line` is one-based. Messages quote files, which may hold a word of megabytes: of one
    /// that is too long to read the middle is left out.
    pub fn malformed(
        path: &Path,
        line: impl Into<Option<usize>>,
        message: impl Into<String>,
    ) -> FileError {
        let message = readable(message.into());
        FileError::Malformed { path: path.to_owned(), line: line.into(), message }
    }
}

/// A message longer than the first number, bytes, is cut to about the second at its start and the third at its end.
const READABLE: [usize; 3] = [3000, 2000, 500];

fn readable(message: String) -> String {
    let [longest, start, end] = READABLE;
    if message.len() <= longest {
        return message;
    }
    let cut = |at: usize| (at..message.len()).find(|&at| message.is_char_boundary(at)).unwrap_or(0);
    let (start, end) = (cut(start), cut(message.len() - end));
    format!("{} ... {}", &message[..start], &message[end..])
}

/// Refuses an output path that is taken, unless `force` says that it may be replaced.
///
/// Called before any work is done, so that a refusal costs the user nothing.
///
/// # Errors
/// [`FileError::Exists`] where the file exists; [`FileError::Unusable`] where its folder does not,
/// or where the path is a folder, a device or a pipe.
pub fn check(path: &Path, force: bool) -> Result<(), FileError> {
    let target = target_of(path, force)?;
    if folder_of(&target).is_dir() {
        return Ok(());
    }
    Err(FileError::Unusable { path: path.to_owned(), message: "its folder does not exist" })
}

/// The file that an output becomes: where `path` is a link, what it leads to, so that the link stays.
fn target_of(path: &Path, force: bool) -> Result<PathBuf, FileError> {
    let unusable = |message| FileError::Unusable { path: path.to_owned(), message };
    let mut target = path.to_owned();
    match fs::metadata(path) {
        Ok(found) if found.is_dir() => {
            return Err(unusable("it is a folder, a file name was expected"));
        }
        Ok(found) if !found.is_file() => {
            return Err(unusable("it is a device, a pipe or a socket, a file was expected"));
        }
        Ok(_) if !force => return Err(FileError::Exists { path: path.to_owned() }),
        Ok(_) => target = path.canonicalize().map_err(|e| FileError::write(path, e))?,
        // A link to nothing yet.
        Err(_) => {
            let mut links = 0;
            while let Ok(next) = fs::read_link(&target) {
                links += 1;
                if links > MAX_LINKS {
                    return Err(unusable("it is a link that leads in a circle"));
                }
                target = folder_of(&target).join(next);
            }
        }
    }
    Ok(target)
}

/// Links that lead to one another, at most; the limit of Linux.
const MAX_LINKS: usize = 40;

/// Refuses a name without one of these endings, upper or lower case.
///
/// # Errors
/// [`FileError::Malformed`]: the endings.
pub fn expect_ending(path: &Path, endings: &[&str]) -> Result<(), FileError> {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    if ending.is_some_and(|ending| endings.contains(&ending.as_str())) {
        return Ok(());
    }
    let dotted: Vec<String> = endings.iter().map(|ending| format!(".{ending}")).collect();
    let message = format!("expected a name that ends in {}", dotted.join(" or "));
    Err(FileError::malformed(path, None, message))
}

/// Whether two paths lead to the same file, through whatever links; the files need not exist yet.
pub fn same_file(one: &Path, other: &Path) -> bool {
    let resolved = |path: &Path| {
        path.canonicalize().or_else(|error| {
            let folder = folder_of(path).canonicalize()?;
            path.file_name().map(|name| folder.join(name)).ok_or(error)
        })
    };
    match (resolved(one), resolved(other)) {
        (Ok(one), Ok(other)) => one == other,
        _ => one == other,
    }
}

/// Refuses outputs that are there already, unless `force`, and those that are one of `inputs`: before any work is done.
///
/// # Errors
/// [`FileError::Exists`], and [`FileError::Unusable`] for an output that is an input.
pub fn check_apart(outputs: &[&Path], inputs: &[&Path], force: bool) -> Result<(), FileError> {
    for output in outputs {
        if inputs.iter().any(|input| same_file(input, output)) {
            let message = "it is an input, expected another output";
            return Err(FileError::Unusable { path: (*output).to_owned(), message });
        }
        target_of(output, force)?;
    }
    Ok(())
}

/// Writes a file atomically: `fill` writes the content, then the file takes its name.
///
/// # Errors
/// [`FileError::Exists`] where the file exists, [`FileError::Write`] where writing or renaming fails.
pub fn write(
    path: &Path,
    force: bool,
    fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), FileError> {
    write_seekable(path, force, |file| {
        let mut writer = BufWriter::new(file);
        fill(&mut writer)
            .and_then(|()| writer.flush())
            .map_err(|source| FileError::write(path, source))
    })
}

/// Writes a value as JSON, one entry a line, atomically.
///
/// # Errors
/// As [`write()`], and a value that JSON cannot hold.
pub fn write_json(
    path: &Path,
    force: bool,
    value: &impl serde::Serialize,
) -> Result<(), FileError> {
    write(path, force, |out| {
        serde_json::to_writer_pretty(&mut *out, value)?;
        writeln!(out)
    })
}

/// As [`write()`], for content that is not written from its beginning to its end.
///
/// # Errors
/// As [`write()`], and whatever `fill` fails with.
pub fn write_seekable<E: From<FileError>>(
    path: &Path,
    force: bool,
    fill: impl FnOnce(&mut File) -> Result<(), E>,
) -> Result<(), E> {
    let mut waiting = Waiting::new(path, force)?;
    fill(waiting.temporary.as_file_mut())?;
    Ok(waiting.take_place()?)
}

/// A file that is being written, beside its place.
struct Waiting<'a> {
    path: &'a Path,
    target: PathBuf,
    temporary: tempfile::NamedTempFile,
    force: bool,
}

impl<'a> Waiting<'a> {
    /// A new file is as readable as the person's other files are, which the umask says; one that is replaced stays as readable as it is.
    fn new(path: &'a Path, force: bool) -> Result<Waiting<'a>, FileError> {
        let target = target_of(path, force)?;
        let mut builder = tempfile::Builder::new();
        builder.prefix(".rowgram-");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let replaced = fs::metadata(&target).map(|found| found.permissions().mode() & 0o777);
            let mode = replaced.map_or(0o666, |mode| mode | 0o600);
            builder.permissions(fs::Permissions::from_mode(mode));
        }
        let made = builder.tempfile_in(folder_of(&target));
        let temporary = made.map_err(|source| FileError::write(path, source))?;
        Ok(Waiting { path, target, temporary, force })
    }

    /// Gives the complete file its name.
    fn take_place(self) -> Result<(), FileError> {
        let Waiting { path, target, temporary, force } = self;
        let failed = |source| FileError::write(path, source);
        temporary.as_file().sync_all().map_err(failed)?;
        if let (true, Ok(replaced)) = (force, fs::metadata(&target)) {
            temporary.as_file().set_permissions(replaced.permissions()).map_err(failed)?;
        }
        if force {
            temporary.persist(&target).map_err(|e| failed(e.error))?;
        } else {
            temporary.persist_noclobber(&target).map_err(|e| match e.error.kind() {
                std::io::ErrorKind::AlreadyExists => FileError::Exists { path: path.to_owned() },
                _ => failed(e.error),
            })?;
        }
        Ok(())
    }
}

/// As [`write()`], for content that a library writes to a path of its own opening: `fill` gets the path of an empty file,
/// and may leave no other beside it.
///
/// # Errors
/// As [`write()`], and whatever `fill` fails with.
pub fn write_by_path(
    path: &Path,
    force: bool,
    fill: impl FnOnce(&Path) -> Result<(), FileError>,
) -> Result<(), FileError> {
    let waiting = Waiting::new(path, force)?;
    fill(waiting.temporary.path())?;
    waiting.take_place()
}

/// Makes a folder, and those it lies in, unless it is there.
///
/// # Errors
/// Where it cannot be made.
pub fn make_folder(path: &Path) -> Result<(), FileError> {
    std::fs::create_dir_all(path).map_err(|source| FileError::write(path, source))
}

/// A file without a name beside `path`, gone when it is closed or the program ends.
///
/// # Errors
/// Where none can be made in that folder.
pub fn scratch(path: &Path) -> Result<File, FileError> {
    tempfile::tempfile_in(folder_of(path)).map_err(|source| FileError::write(path, source))
}

/// The folder that a path lies in.
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// The name of a file without its folder.
pub fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_that_quote_megabytes_stay_readable() {
        let path = Path::new("word.txt");
        let error = FileError::malformed(
            path,
            1,
            format!("found {}, expected 3", "\u{e4}".repeat(1 << 20)),
        );
        let text = error.to_string();
        assert!(text.len() < 3000 && text.contains("found \u{e4}"), "{} bytes", text.len());
        assert!(text.ends_with(", expected 3"));
        let plain = FileError::malformed(path, None, "expected 3").to_string();
        assert_eq!(plain, "word.txt: expected 3");
    }

    #[test]
    fn a_failed_write_leaves_what_was_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.txt");
        write(&path, false, |w| w.write_all(b"first")).unwrap();
        assert!(matches!(write(&path, false, |_| Ok(())), Err(FileError::Exists { .. })));
        let broken = write(&path, true, |w| {
            w.write_all(b"half")?;
            Err(std::io::Error::other("disk full"))
        });
        assert!(matches!(broken, Err(FileError::Write { .. })));
        assert_eq!(std::fs::read(&path).unwrap(), b"first");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no litter");
        write(&path, true, |w| w.write_all(b"second")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"second");
    }

    #[test]
    #[cfg(unix)]
    fn links_devices_and_modes_stay_as_they_are() {
        use std::os::unix::{
            fs::{PermissionsExt, symlink},
            net::UnixListener,
        };
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let mode = |name: &str| fs::metadata(at(name)).unwrap().permissions().mode() & 0o777;
        let put = |name: &str, force| write(&at(name), force, |w| w.write_all(b"new"));
        fs::write(at("target"), "precious").unwrap();
        fs::set_permissions(at("target"), fs::Permissions::from_mode(0o640)).unwrap();
        symlink("target", at("link")).unwrap();
        assert!(matches!(put("link", false), Err(FileError::Exists { .. })));
        put("link", true).unwrap();
        assert_eq!(fs::read_link(at("link")).unwrap(), Path::new("target"), "still a link");
        assert_eq!((fs::read(at("target")).unwrap(), mode("target")), (b"new".to_vec(), 0o640));
        // A link to nothing yet makes what it leads to; links in a circle lead nowhere.
        symlink("later", at("to-later")).unwrap();
        put("to-later", false).unwrap();
        assert_eq!(fs::read(at("later")).unwrap(), b"new");
        assert!(fs::symlink_metadata(at("to-later")).unwrap().is_symlink());
        symlink("b", at("a")).unwrap();
        symlink("a", at("b")).unwrap();
        assert!(put("a", true).unwrap_err().to_string().contains("circle"));
        // What is no file is refused, and stays.
        let _socket = UnixListener::bind(at("socket")).unwrap();
        symlink("/dev/null", at("null")).unwrap();
        for name in ["socket", "null"] {
            for force in [false, true] {
                let why = put(name, force).unwrap_err().to_string();
                assert!(why.contains("a device, a pipe or a socket"), "{why}");
                assert!(check(&at(name), force).is_err());
            }
        }
        // The umask decides for a new file, as for a file of any other program.
        fs::write(at("usual"), "").unwrap();
        put("fresh", false).unwrap();
        assert_eq!(mode("fresh"), mode("usual"));
        fs::set_permissions(at("fresh"), fs::Permissions::from_mode(0o400)).unwrap();
        write_by_path(&at("fresh"), true, |path| {
            fs::write(path, "by path").map_err(|e| FileError::write(path, e))
        })
        .unwrap();
        assert_eq!((fs::read(at("fresh")).unwrap(), mode("fresh")), (b"by path".to_vec(), 0o400));
    }

    #[test]
    fn a_missing_folder_is_named() {
        let missing = Path::new("/nonexistent-folder/out.txt");
        let message = write(missing, false, |_| Ok(())).unwrap_err().to_string();
        assert!(message.contains("/nonexistent-folder/out.txt"), "{message}");
    }
}
