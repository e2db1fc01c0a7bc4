//! Where the bytes of a run lie: the readers take files, so that their errors can name them.

use std::{
    fmt::Display,
    fs,
    path::{Path, PathBuf},
    sync::OnceLock,
};

/// A folder of this process, in memory where there is such a place.
fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let memory = Path::new("/dev/shm");
        let root = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        let folder = root.join(format!("rowgram-fuzz-{}", std::process::id()));
        fs::create_dir_all(&folder).expect("a folder for the files of this run");
        folder
    })
}

/// An error of a reader has to say which file it is about.
fn check(result: Result<(), impl Display>, place: &Path) {
    if let Err(error) = result {
        let message = error.to_string();
        assert!(message.contains(&*place.to_string_lossy()), "names no file: {message}");
    }
}

/// Reads `bytes` as the file `name`.
pub fn read<E: Display>(bytes: &[u8], name: &str, reader: impl FnOnce(&Path) -> Result<(), E>) {
    let path = folder().join(name);
    fs::write(&path, bytes).expect("room for the bytes of this run");
    check(reader(&path), folder());
}

/// Reads a folder of files `names`, whose contents are parted by `\n====\n` in `bytes`.
pub fn read_parts<E: Display>(
    bytes: &[u8],
    names: &[&str],
    reader: impl FnOnce(&Path) -> Result<(), E>,
) {
    let line = b"\n====\n";
    let mut rest = bytes;
    for name in names {
        let at = rest.windows(line.len()).position(|w| w == line);
        let (part, after) = at.map_or((rest, &[][..]), |i| (&rest[..i], &rest[i + line.len()..]));
        fs::write(folder().join(name), part).expect("room for the bytes of this run");
        rest = after;
    }
    check(reader(folder()), folder());
}
