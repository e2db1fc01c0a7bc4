//! How much memory there is, and whether what a file holds fits into it: asked before the file is decoded.
//!
//! A compressed picture of some kilobytes may decode to gigabytes. Readers of this crate ask [`require`] for what a header says that
//! they will decode; callers whose work takes more than the pixels themselves ask [`require_pixels`] with their own need.

use super::{FileError, images};
use std::{
    io::Read,
    path::Path,
    sync::atomic::{AtomicU64, Ordering},
};

/// The limit that was set, bytes; 0 where none was.
static LIMIT: AtomicU64 = AtomicU64::new(0);

/// Sets the most memory that the content of one file may take; with `None` it is what the machine has free. For all threads of the
/// process.
pub fn set_limit_bytes(bytes: Option<u64>) {
    LIMIT.store(bytes.map_or(0, |bytes| bytes.max(1)), Ordering::Relaxed);
}

/// Returns freed memory to the operating system. The allocator of glibc keeps freed blocks that lie between blocks in use, so call this where much was
/// freed and the work goes on. Does nothing with other allocators.
pub fn return_freed() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: looks through the allocator's own lists, under its locks; any thread may call it at any time.
    #[expect(unsafe_code, reason = "no crate has a safe call of this function")]
    unsafe {
        libc::malloc_trim(0);
    }
}

/// Memory that the content of a file may take, bytes: the limit that was set, else what the machine has free and the process is allowed.
/// `None` where the system does not say (Linux does).
pub fn available_bytes() -> Option<u64> {
    match LIMIT.load(Ordering::Relaxed) {
        0 => [free_bytes(), group_bytes(), process_bytes()].into_iter().flatten().min(),
        limit => Some(limit),
    }
}

/// Refuses a file whose content takes more memory than there is.
///
/// # Errors
/// [`FileError::Malformed`] with both numbers.
pub fn require(path: &Path, what: &str, bytes: u64) -> Result<(), FileError> {
    check(what, bytes).map_err(|message| FileError::malformed(path, None, message))
}

/// As [`require`], where the caller names the file.
pub(super) fn check(what: &str, bytes: u64) -> Result<(), String> {
    // What every machine has is not worth the question.
    if bytes < 1 << 24 {
        return Ok(());
    }
    match available_bytes().filter(|&available| available < bytes) {
        None => Ok(()),
        Some(available) => Err(format!(
            "{what} takes {} of memory, {} may be used: cut it into parts or make it coarser, or raise the limit (--max-memory-mb, limit_memory in Python)",
            size(bytes),
            size(available)
        )),
    }
}

/// As [`require`], for work that takes so many bytes for each pixel of a picture, of which only the header is read.
///
/// # Errors
/// As [`require`]; a file that cannot be read.
pub fn require_pixels(path: &Path, what: &str, bytes_per_pixel: f64) -> Result<(), FileError> {
    let [width, height] = images::size_px(path)?;
    let what = format!("{what} of {width} x {height} pixels");
    require(path, &what, (bytes_per_pixel * f64::from(width) * f64::from(height)) as u64)
}

/// The content of a file, which may be a pipe, but nothing that has no end.
///
/// # Errors
/// A file that cannot be read; as [`require`].
pub fn read_file(path: &Path) -> Result<Vec<u8>, FileError> {
    let failed = |error| FileError::read(path, error);
    let mut file = std::fs::File::open(path).map_err(failed)?;
    let about = file.metadata().map_err(failed)?;
    if about.is_file() {
        require(path, "reading it", about.len())?;
        let mut bytes = Vec::with_capacity(about.len() as usize);
        file.read_to_end(&mut bytes).map_err(failed)?;
        return Ok(bytes);
    }
    read_to_end(path, file)
}

/// Everything that comes from a pipe or a decompressor, whose length nobody says, of the file at `path`.
///
/// # Errors
/// As [`read_file`].
pub fn read_to_end(path: &Path, reader: impl Read) -> Result<Vec<u8>, FileError> {
    let mut bytes = Vec::new();
    // A buffer doubles while it grows.
    let most = available_bytes().map_or(u64::MAX, |bytes| bytes / 3);
    reader.take(most).read_to_end(&mut bytes).map_err(|error| FileError::read(path, error))?;
    if bytes.len() as u64 == most {
        let message =
            format!("it has no end within {}, a third of the memory that may be used", size(most));
        return Err(FileError::malformed(path, None, message));
    }
    Ok(bytes)
}

/// As [`read_file`], of text.
///
/// # Errors
/// As [`read_file`]; a file that is not UTF-8.
pub fn read_text(path: &Path) -> Result<String, FileError> {
    let invalid = |error: std::string::FromUtf8Error| {
        FileError::read(path, std::io::Error::new(std::io::ErrorKind::InvalidData, error))
    };
    let text = String::from_utf8(read_file(path)?).map_err(invalid)?;
    // A byte order mark, as Windows programs write it.
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

/// In words.
fn size(bytes: u64) -> String {
    match bytes as f64 {
        bytes if bytes < 1e9 => format!("{:.0} MB", bytes / 1e6),
        bytes => format!("{:.1} GB", bytes / 1e9),
    }
}

/// What programs can still have.
fn free_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kibibytes)
}

/// What the control group of the process, such as a container or a job of a cluster, may have.
fn group_bytes() -> Option<u64> {
    let groups = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let group = groups.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let folder = Path::new("/sys/fs/cgroup").join(group);
    let limits = folder.ancestors().filter_map(|folder| {
        std::fs::read_to_string(folder.join("memory.max")).ok()?.trim().parse::<u64>().ok()
    });
    limits.min()
}

/// What is left of the address space of the process (`ulimit -v`).
fn process_bytes() -> Option<u64> {
    let limits = std::fs::read_to_string("/proc/self/limits").ok()?;
    let line = limits.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    let limit: u64 = line.split_whitespace().next()?.parse().ok()?;
    let pages = std::fs::read_to_string("/proc/self/statm").ok()?;
    let used: u64 = pages.split_whitespace().next()?.parse().ok()?;
    Some(limit.saturating_sub(used * PAGE_BYTES))
}

/// Of a page, as `/proc/self/statm` counts on all machines that are built for but some with 64-bit ARM, where more is left than said.
const PAGE_BYTES: u64 = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_takes_more_than_there_is_is_refused_with_both_numbers() {
        let path = Path::new("large.png");
        require(path, "decoding it", 1 << 25).unwrap();
        let error = require(path, "decoding it", 1 << 60).unwrap_err().to_string();
        assert!(error.starts_with("large.png: decoding it takes 1152921504.6 GB of memory, "));
        assert!(error.contains("may be used"), "{error}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn linux_says_what_is_free() {
        assert!(available_bytes().unwrap() > 1 << 24);
    }
}
