//! What was read of photos before: a photo whose file is as it was is not read again.
//!
//! Every part of a plan ([`super::parts`]) needs a mark of the content of every photo; of thousands of photos reading that takes longer than
//! many a part. A file is as it was where its inode, its length, and the times of the last write and of the last change of any kind are;
//! the last of these no program can set. It counts only where that change was some time before the photo was read: clocks of
//! file systems are coarse, and those of two machines differ.

use super::inputs::Photo;
use crate::record::{Cache, Key};
use rayon::prelude::*;
use rowgram_base::error::Error;
use rowgram_files::photo::{self, Metadata};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

/// Name in the cache.
const KEPT: &str = "photos.cbor";
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

/// What the file of a photo says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Seen {
    metadata: Metadata,
    size_px: [u32; 2],
    content: Key,
}

impl Seen {
    fn read(path: &Path) -> Result<Seen, String> {
        let bytes = fs::read(path).map_err(|error| format!("it cannot be read: {error}"))?;
        let size_px = size_of(&bytes).ok_or("it is no picture that can be read")?;
        Ok(Seen { metadata: photo::parse(&bytes), size_px, content: Key::of_bytes(&bytes) })
    }
}

/// The size of a picture without decoding it.
fn size_of(bytes: &[u8]) -> Option<[u32; 2]> {
    let reader = image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format().ok()?;
    let (width, height) = reader.into_dimensions().ok()?;
    (width > 0 && height > 0).then_some([width, height])
}

/// What is kept of photos, by name.
type Known = BTreeMap<String, (FileState, Seen)>;

/// A photo, or its name and why it cannot be used.
pub(super) type Read = Result<Photo, (String, String)>;

/// Reads photos with their names; what the cache knows of them is taken from there, and what is read is kept there.
///
/// # Errors
/// A cache that cannot be written.
pub(super) fn read(
    photos: &[(PathBuf, String)],
    cache: Option<&Cache>,
) -> Result<Vec<Read>, Error> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    read_at(now.map_or(0, |since| since.as_secs() as i64), photos, cache)
}

fn read_at(
    now_s: i64,
    photos: &[(PathBuf, String)],
    cache: Option<&Cache>,
) -> Result<Vec<Read>, Error> {
    let key = Key::begin().finish();
    let known: Known = cache.and_then(|cache| cache.load(KEPT, key)).unwrap_or_default();
    let read: Vec<(Read, Option<(FileState, Seen)>)> =
        photos.par_iter().map(|photo| one(now_s, photo, &known)).collect();
    let (mut photos, mut keep) = (Vec::with_capacity(read.len()), Known::new());
    for (photo, kept) in read {
        if let (Ok(photo), Some(kept)) = (&photo, kept) {
            keep.insert(photo.name.clone(), kept);
        }
        photos.push(photo);
    }
    if let Some(cache) = cache.filter(|_| keep != known) {
        cache.save(KEPT, key, &keep)?;
    }
    Ok(photos)
}

/// A photo, and what to keep of it.
fn one(
    now_s: i64,
    (path, name): &(PathBuf, String),
    known: &Known,
) -> (Read, Option<(FileState, Seen)>) {
    let name = name.clone();
    // Before it is read: a change meanwhile is seen the next time.
    let file = FileState::of(path);
    let kept = known.get(&name).filter(|(state, _)| Some(state) == file.as_ref());
    let seen = match kept {
        Some((_, seen)) => Ok(seen.clone()),
        None => Seen::read(path),
    };
    let seen = match seen {
        Ok(seen) => seen,
        Err(why) => return (Err((name, why)), None),
    };
    let is_settled = |file: &FileState| kept.is_some() || file.changed[0] + SETTLED_S <= now_s;
    let keep = file.filter(is_settled).map(|file| (file, seen.clone()));
    let Seen { metadata, size_px, content } = seen;
    (Ok(Photo { path: path.to_owned(), name, metadata, size_px, content, camera: 0 }), keep)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn a_photo_is_read_again_where_its_file_has_changed() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::new(&folder.path().join("cache")).unwrap();
        let path = folder.path().join("a.png");
        let picture = |level: u8| {
            image::GrayImage::from_pixel(8, 6, image::Luma([level])).save(&path).unwrap();
        };
        picture(10);
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64;
        let content = |now_s: i64| {
            let read = read_at(now_s, &[(path.clone(), "a.png".to_owned())], Some(&cache)).unwrap();
            let [Ok(photo)] = read.as_slice() else { panic!("a picture that can be read") };
            assert_eq!((photo.size_px, photo.name.as_str()), ([8, 6], "a.png"));
            photo.content
        };
        let kept = || -> Known { cache.load(KEPT, Key::begin().finish()).unwrap_or_default() };
        let first = content(now_s);
        assert!(kept().is_empty(), "it was changed just now");
        assert_eq!(content(now_s + 100), first);
        assert_eq!(kept().len(), 1);
        // What is kept is taken.
        let mut other = kept();
        let mark = Key::begin().count(7).finish();
        other.get_mut("a.png").unwrap().1.content = mark;
        cache.save(KEPT, Key::begin().finish(), &other).unwrap();
        assert_eq!(content(now_s), mark);
        // The same length and the same time of the last write, but other pixels.
        let written = fs::metadata(&path).unwrap().modified().unwrap();
        picture(11);
        fs::File::options().write(true).open(&path).unwrap().set_modified(written).unwrap();
        let changed = content(now_s + 100);
        assert!(changed != mark && changed != first);
        fs::remove_file(&path).unwrap();
        fs::write(&path, "no picture").unwrap();
        let read =
            read_at(now_s + 100, &[(path.clone(), "a.png".to_owned())], Some(&cache)).unwrap();
        assert!(read[0].as_ref().is_err_and(|(_, why)| why.contains("no picture")));
        assert!(kept().is_empty());
    }
}
