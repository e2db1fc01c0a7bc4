//! What was read of photos before: of a photo with the same content nothing is read again.

use super::inputs::Photo;
use crate::{
    Project,
    record::{Content, Key, Store},
};
use rayon::prelude::*;
use rowgram_base::error::Error;
use rowgram_files::photo::{self, Metadata};
use rowgram_optim::output::FileError;
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// Name in the store.
const PHOTOS: &str = "photos";

/// What the file of a photo says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Seen {
    metadata: Metadata,
    size_px: [u32; 2],
}

impl Seen {
    fn read(path: &Path) -> Result<Seen, String> {
        let bytes = fs::read(path).map_err(|error| unreadable(&error))?;
        let size_px = size_of(&bytes).ok_or("it is no picture that can be read")?;
        Ok(Seen { metadata: photo::parse(&bytes), size_px })
    }
}

fn unreadable(error: &dyn std::error::Error) -> String {
    format!("it cannot be read: {error}")
}

/// The size of a picture without decoding it.
fn size_of(bytes: &[u8]) -> Option<[u32; 2]> {
    let reader = image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format().ok()?;
    let (width, height) = reader.into_dimensions().ok()?;
    (width > 0 && height > 0).then_some([width, height])
}

/// What is known of photos, by their content.
type Known = BTreeMap<String, Seen>;

/// A photo, or its name and why it cannot be used.
pub(super) type Read = Result<Photo, (String, String)>;

/// Reads photos with their names; what the store knows of them is taken from there, and what is read is stored there.
///
/// # Errors
/// A store that cannot be written.
pub(super) fn read(
    project: &Project,
    photos: &[(PathBuf, String)],
    store: Option<&Store>,
) -> Result<Vec<Read>, Error> {
    let paths: Vec<PathBuf> = photos.iter().map(|(path, _)| path.clone()).collect();
    let contents = match store {
        Some(_) => project.content_of_each(&paths)?,
        None => paths.par_iter().map(|path| Content::read(project.root(), path)).collect(),
    };
    let key = Key::begin().finish();
    let known: Known = store.and_then(|store| store.load(PHOTOS, key)).unwrap_or_default();
    let photo = |((path, name), content): (&(PathBuf, String), Result<Content, FileError>)| {
        let name = name.clone();
        let read = content.map_err(|error| unreadable(&error)).and_then(|content| {
            let before = known.get(&content.sha256).cloned();
            Ok((before.map_or_else(|| Seen::read(path), Ok)?, content.sha256))
        });
        let (seen, sha256) = read.map_err(|why| (name.clone(), why))?;
        let Seen { metadata, size_px } = seen.clone();
        let content = Key::of_bytes(sha256.as_bytes());
        let photo = Photo { path: path.clone(), name, metadata, size_px, content, camera: 0 };
        Ok((photo, (sha256, seen)))
    };
    let read: Vec<Result<_, _>> = photos.par_iter().zip(contents).map(photo).collect();
    let all: Known = read.iter().flatten().map(|(_, seen)| seen.clone()).collect();
    if let Some(store) = store.filter(|_| all != known) {
        store.save(PHOTOS, key, &all)?;
    }
    Ok(read.into_iter().map(|read| read.map(|(photo, _)| photo)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Config, Stage};

    #[test]
    fn a_photo_is_read_again_where_its_content_has_changed() {
        let folder = tempfile::tempdir().unwrap();
        let project = Project::new(folder.path(), Config::default()).unwrap();
        let (store, path) = (project.store(Stage::Align), folder.path().join("a.png"));
        let picture = |width: u32| {
            image::GrayImage::from_pixel(width, 6, image::Luma([10])).save(&path).unwrap();
        };
        let read = || {
            read(&project, &[(path.clone(), "a.png".to_owned())], Some(&store)).unwrap().remove(0)
        };
        picture(8);
        let first = read().unwrap_or_else(|(_, why)| panic!("{why}"));
        assert_eq!((first.size_px, first.name.as_str()), ([8, 6], "a.png"));
        // What is known is taken.
        let key = Key::begin().finish();
        let known = || store.load::<Known>(PHOTOS, key).unwrap();
        let mut other = known();
        other.values_mut().for_each(|seen| seen.size_px = [1, 2]);
        store.save(PHOTOS, key, &other).unwrap();
        assert_eq!(read().map(|photo| photo.size_px).ok(), Some([1, 2]));
        picture(9);
        let changed = read().unwrap_or_else(|(_, why)| panic!("{why}"));
        assert!(changed.size_px == [9, 6] && changed.content != first.content);
        fs::write(&path, "no picture").unwrap();
        assert!(read().is_err_and(|(_, why)| why.contains("no picture")));
        assert!(known().is_empty(), "photos that are gone are forgotten");
    }
}
