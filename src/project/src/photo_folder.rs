//! Photos as they lie in folders: those of a card in its subfolders, colour photos with the bands of a multispectral camera
//! among them.

use super::PHOTO_ENDINGS;
use rowgram_files::image_names::composed;
use std::path::{Path, PathBuf};

/// The name of the folder in which any subfolder may hold photos.
pub(super) const IMAGES: &str = "images";
/// A card has folders in a folder, a project them in one more.
const DEEPEST: usize = 3;
/// Ends of the names of band files, of DJI's and Parrot's multispectral cameras.
const BAND_ENDS: [&str; 9] =
    ["_MS_G", "_MS_R", "_MS_RE", "_MS_NIR", "_MS_B", "_GRE", "_RED", "_REG", "_NIR"];
/// Photos of telephones, and as the sensor saw them.
const UNREAD_ENDINGS: [&str; 10] =
    ["heic", "heif", "avif", "dng", "raw", "arw", "cr2", "cr3", "nef", "rw2"];
/// Fewer colour photos than this are no flight, and bands are all there is.
const LEAST_COLOUR: usize = 3;

/// The photos of a flight.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct FlightPhotos {
    /// Those that are used, sorted.
    pub(super) photos: Vec<PathBuf>,
    /// Bands of a multispectral camera beside colour photos, which are not.
    pub(super) bands: Vec<PathBuf>,
    /// Those whose names are not UTF-8, which are not either.
    pub(super) unusable: Vec<PathBuf>,
}

/// Whether a folder has a name that cameras give: `100MEDIA`, `DCIM`, `DJI_202308141235_001`.
fn is_of_card(name: &str) -> bool {
    let numbered = name.len() == 8
        && name.bytes().take(3).all(|b| b.is_ascii_digit())
        && name.bytes().skip(3).all(|b| b.is_ascii_alphanumeric() || b == b'_');
    numbered || name.eq_ignore_ascii_case("DCIM") || name.starts_with("DJI_")
}

/// What is wrong with a photo whose name is not UTF-8, and what to do.
pub(super) const UNUSABLE_NAME: &str =
    "its name is not UTF-8, expected one that is: rename the file";

/// The photos of a folder by their endings, sorted by name; hidden files are none, nor are those whose names are not UTF-8
/// ([`unusable_names_in`]).
pub fn photos_in(folder: &Path) -> Vec<PathBuf> {
    pictures_in(folder).into_iter().filter(|path| is_text_below(path, folder)).collect()
}

/// Photos of a folder whose names are not UTF-8, with a sign for what cannot be shown. Tables and records cannot name them, so they
/// cannot take part.
pub fn unusable_names_in(folder: &Path) -> Vec<String> {
    let pictures = pictures_in(folder).into_iter();
    let unusable = pictures.filter(|path| !is_text_below(path, folder));
    unusable.map(|path| photo_name(&path, folder)).collect()
}

fn is_text_below(path: &Path, folder: &Path) -> bool {
    path.strip_prefix(folder).is_ok_and(|below| below.to_str().is_some())
}

fn pictures_in(folder: &Path) -> Vec<PathBuf> {
    files_in(folder, &PHOTO_ENDINGS)
}

fn files_in(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut found: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let hidden =
                path.file_name().is_none_or(|name| name.to_string_lossy().starts_with('.'));
            let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
            path.is_file()
                && !hidden
                && ending.is_some_and(|ending| endings.contains(&ending.as_str()))
        })
        .collect();
    found.sort();
    found
}

/// Whether a folder of this name holds copies that a system made: hidden ones, thumbnails and bins of network storage, what is left of archives.
fn is_of_system(name: &str) -> bool {
    name.starts_with(['.', '@', '#'])
        || ["__MACOSX", "thumbnails"].iter().any(|of| name.eq_ignore_ascii_case(of))
}

fn subfolders(folder: &Path, any: bool) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut found: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
            path.is_dir()
                && name.is_some_and(|name| !is_of_system(&name) && (any || is_of_card(&name)))
        })
        .collect();
    found.sort();
    found
}

/// The files with these endings in a folder and, down to a depth, in subfolders with names that cameras give, and in `images` in any.
fn gather(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let any = folder.file_name().is_some_and(|name| name == IMAGES);
    let (mut found, mut level) = (Vec::new(), vec![folder.to_owned()]);
    for _ in 0..=DEEPEST {
        found.extend(level.iter().flat_map(|folder| files_in(folder, endings)));
        level = level.iter().flat_map(|folder| subfolders(folder, any)).collect();
    }
    found.sort();
    found
}

/// Photos of a flight in formats that are not read.
pub(super) fn unread_photos(folder: &Path) -> Vec<PathBuf> {
    gather(folder, &UNREAD_ENDINGS)
}

/// The photos of a flight in a folder: directly in it, in subfolders with names that cameras give, and in `images` in any.
pub(super) fn flight_photos(folder: &Path) -> FlightPhotos {
    let all = gather(folder, &PHOTO_ENDINGS);
    let (all, unusable): (Vec<PathBuf>, Vec<PathBuf>) =
        all.into_iter().partition(|path| is_text_below(path, folder));
    let (tiff, colour): (Vec<PathBuf>, Vec<PathBuf>) =
        all.iter().cloned().partition(|path| rowgram_files::rasters::is_tiff_name(path));
    if tiff.is_empty() || colour.len() < LEAST_COLOUR {
        return FlightPhotos { photos: all, bands: Vec::new(), unusable };
    }
    let (bands, more): (Vec<PathBuf>, Vec<PathBuf>) =
        tiff.into_iter().partition(|path| is_band(path));
    let mut photos = colour;
    photos.extend(more);
    photos.sort();
    FlightPhotos { photos, bands, unusable }
}

/// Whether a TIFF file is of one band: by its name, else because it has one channel.
fn is_band(path: &Path) -> bool {
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().to_uppercase());
    if stem.is_some_and(|stem| BAND_ENDS.iter().any(|end| stem.ends_with(end))) {
        return true;
    }
    let Ok(reader) = image::ImageReader::open(path) else { return false };
    let decoder = reader.with_guessed_format().ok().and_then(|reader| reader.into_decoder().ok());
    decoder.is_some_and(|decoder| {
        use image::ImageDecoder;
        !decoder.color_type().has_color()
    })
}

/// What a photo is called: its path from the folder of the photos on, with slashes and composed letters.
pub(super) fn photo_name(path: &Path, folder: &Path) -> String {
    let below = path.strip_prefix(folder).ok().filter(|below| below.components().count() > 0);
    let below = below.map(Path::to_string_lossy);
    let file = || path.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    composed(&below.unwrap_or_else(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> (Vec<String>, Vec<String>) {
        let found = flight_photos(folder);
        let of = |paths: &[PathBuf]| paths.iter().map(|path| photo_name(path, folder)).collect();
        (of(&found.photos), of(&found.bands))
    }

    #[test]
    fn a_card_is_read_with_its_folders() {
        let root = tempfile::tempdir().unwrap();
        let put = |name: &str| {
            let path = root.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, name).unwrap();
        };
        for name in [
            "DCIM/100MEDIA/DJI_0001.JPG",
            "DCIM/101MEDIA/DJI_0001.JPG",
            "DCIM/101MEDIA/._DJI_0001.JPG",
        ] {
            put(name);
        }
        for other in ["DCIM/Thumbs.db", "rowgram/align/figures/pair.png", "board/IMG_1.JPG"] {
            put(other);
        }
        let card =
            vec!["DCIM/100MEDIA/DJI_0001.JPG".to_owned(), "DCIM/101MEDIA/DJI_0001.JPG".to_owned()];
        assert_eq!(names(root.path()), (card, Vec::new()));
        put("images/b/IMG_1.HEIC");
        assert_eq!(unread_photos(&root.path().join("images")).len(), 1);
        put("images/north/a.jpg");
        put("images/Ko\u{308}ln.jpg");
        let images = root.path().join("images");
        assert_eq!(names(&images).0, ["K\u{f6}ln.jpg", "north/a.jpg"]);
    }

    #[test]
    fn bands_beside_colour_photos_are_set_aside() {
        let root = tempfile::tempdir().unwrap();
        let path = |name: &str| root.path().join(name);
        for k in 0..3 {
            image::RgbImage::new(4, 3).save(path(&format!("DJI_{k}_D.JPG"))).unwrap();
            std::fs::write(path(&format!("DJI_{k}_MS_RE.TIF")), "").unwrap();
        }
        image::GrayImage::new(4, 3).save(path("other.tif")).unwrap();
        image::RgbImage::new(4, 3).save(path("scan.tif")).unwrap();
        let (photos, bands) = names(root.path());
        assert_eq!(photos, ["DJI_0_D.JPG", "DJI_1_D.JPG", "DJI_2_D.JPG", "scan.tif"]);
        assert_eq!(bands, ["DJI_0_MS_RE.TIF", "DJI_1_MS_RE.TIF", "DJI_2_MS_RE.TIF", "other.tif"]);
        // Bands alone are all there is.
        for k in 0..3 {
            std::fs::remove_file(path(&format!("DJI_{k}_D.JPG"))).unwrap();
        }
        assert!(names(root.path()).1.is_empty());
    }
}
