//! Reconstructions in the formats of several programs: recognised, read, written, converted.

use rowgram_base::error::Error;
use rowgram_files::{bundler, colmap, model::Model, opensfm, reconstruction};
use rowgram_optim::output::FileError;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Formats of reconstructions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// cameras.txt, images.txt, points3D.txt.
    ColmapText,
    /// cameras.bin, images.bin, points3D.bin.
    ColmapBinary,
    /// bundle.out and list.txt.
    Bundler,
    /// reconstruction.json and tracks.csv.
    Opensfm,
    /// Our own reconstruction.json with tie_points.csv and tie_observations.csv: everything, exactly.
    Rowgram,
}

rowgram_base::choices!(Format: ColmapText, ColmapBinary, Bundler, Opensfm, Rowgram);

rowgram_base::options! {
    /// What the files of a reconstruction do not say.
    pub struct ModelFileOptions in "convert" {
        /// Width and height of the images of a Bundler file, which has none.
        pub image_size_px: Option<[u32; 2]> = None, limits at_least(1.0), example "[4000, 3000]";
        /// Image names of a Bundler file; list.txt beside it where not set.
        pub list: Option<PathBuf> = None, example "\"list.txt\"";
        /// Measurements of an OpenSfM reconstruction; tracks.csv beside it where not set.
        pub tracks: Option<PathBuf> = None, example "\"tracks.csv\"";
    }
}

/// A converted reconstruction in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConvertOutcome {
    /// Cameras.
    pub cameras: usize,
    /// Images.
    pub images: usize,
    /// Tie points.
    pub points: usize,
    /// Measurements of tie points.
    pub observations: usize,
}

/// Converts a reconstruction. Nothing is changed but the conventions.
///
/// # Errors
/// A file that is none, an output that exists, a lens that the format cannot hold.
pub fn convert(
    input: &Path,
    (output, to): (&Path, Format),
    options: &ModelFileOptions,
    force: bool,
) -> Result<ConvertOutcome, Error> {
    if is_in_the_way(output) && !force {
        return Err(FileError::Exists { path: output.to_owned() }.into());
    }
    let mut model = read(input, Format::required(input)?, options)?;
    write(output, to, &mut model, force)?;
    let survey = &model.survey;
    Ok(ConvertOutcome {
        cameras: survey.cameras.len(),
        images: survey.images.len(),
        points: survey.points.len(),
        observations: survey.observations.len(),
    })
}

/// Whether something would be replaced: an empty folder is nothing.
pub(super) fn is_in_the_way(path: &Path) -> bool {
    path.exists() && !path.read_dir().is_ok_and(|mut entries| entries.next().is_none())
}

impl Format {
    /// The format of a reconstruction, if the path is one.
    pub fn of(path: &Path) -> Option<Format> {
        if reconstruction::is_one(path) {
            return Some(Format::Rowgram);
        }
        if path.is_dir() {
            return Some(match colmap::find(path) {
                Some(colmap::Form::Text) => Format::ColmapText,
                _ => Format::ColmapBinary,
            });
        }
        if path.extension().is_some_and(|extension| extension == "json") {
            return Some(Format::Opensfm);
        }
        let mut start = [0; 13];
        let read = std::fs::File::open(path)
            .and_then(|mut file| std::io::Read::read_exact(&mut file, &mut start));
        (read.is_ok() && bundler::is_one(&start)).then_some(Format::Bundler)
    }

    /// As [`Format::of`], where there has to be one.
    ///
    /// # Errors
    /// A path that is no reconstruction, and what was expected.
    pub(super) fn required(path: &Path) -> Result<Format, Error> {
        std::fs::metadata(path).map_err(|e| FileError::read(path, e))?;
        Format::of(path).ok_or_else(|| {
            let message = "expected a COLMAP folder, a bundle.out or a reconstruction.json of rowgram or OpenSfM";
            FileError::malformed(path, None, message).into()
        })
    }
}

/// Reads a reconstruction.
///
/// # Errors
/// A file that cannot be read or is damaged; images of a Bundler file without a size.
pub(super) fn read(
    path: &Path,
    format: Format,
    options: &ModelFileOptions,
) -> Result<Model, Error> {
    Ok(match format {
        Format::ColmapText | Format::ColmapBinary => colmap::read(path)?,
        Format::Bundler => {
            let beside = path.with_file_name("list.txt");
            let list = options.list.as_deref().or_else(|| beside.is_file().then_some(&*beside));
            let size_px = options.image_size_px.ok_or_else(|| {
                Error::Argument(format!(
                    "{}: Bundler's files have no image sizes; give --image-size-px WIDTH,HEIGHT",
                    path.display()
                ))
            })?;
            bundler::read(path, list, size_px)?
        }
        Format::Opensfm => {
            let beside = path.with_file_name("tracks.csv");
            opensfm::read(path, options.tracks.as_deref().unwrap_or(&beside))?
        }
        Format::Rowgram => Model { survey: reconstruction::read(path)?, ..Model::default() },
    })
}

/// Writes a reconstruction.
///
/// # Errors
/// A lens that the format cannot hold; files that exist or cannot be written.
pub(super) fn write(
    path: &Path,
    format: Format,
    model: &mut Model,
    force: bool,
) -> Result<(), Error> {
    match format {
        Format::ColmapText | Format::ColmapBinary => {
            std::fs::create_dir_all(path).map_err(|e| FileError::write(path, e))?;
            let form = if format == Format::ColmapText {
                colmap::Form::Text
            } else {
                colmap::Form::Binary
            };
            colmap::write(path, model, form, force)?;
        }
        Format::Bundler => {
            let list = path.with_file_name("list.txt");
            bundler::write(path, Some(&list), model, force)?;
        }
        Format::Opensfm => {
            opensfm::write(path, &path.with_file_name("tracks.csv"), model, force)?;
        }
        Format::Rowgram => {
            // A path that is no JSON file is a folder for the three of them.
            if path.extension().is_none_or(|extension| extension != "json") {
                std::fs::create_dir_all(path).map_err(|e| FileError::write(path, e))?;
            }
            reconstruction::write(path, &model.survey, force)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_folder_is_not_in_the_way() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!is_in_the_way(folder.path()) && !is_in_the_way(&folder.path().join("none")));
        std::fs::write(folder.path().join("a"), "").unwrap();
        assert!(is_in_the_way(folder.path()) && is_in_the_way(&folder.path().join("a")));
    }
}
