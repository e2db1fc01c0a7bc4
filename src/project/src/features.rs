//! Features of photos and matches of two photos, as files.

use super::photo_names;
use image::RgbImage;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_files::{images, memory};
use rowgram_optim::output::{self, FileError};
use rowgram_survey::features::{self, FeatureOptions, Features, matching, sketch};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What the scale space of a photo takes for each of its pixels: one of 16 million pixels in colour took 633 MB with two threads.
const PIXEL_BYTES: f64 = 40.0;

/// Refuses a photo whose scale space takes more memory than there is.
///
/// # Errors
/// Both numbers; a file that is no picture.
pub(super) fn require_memory(photo: &Path) -> Result<(), FileError> {
    memory::require_pixels(photo, "the scale space", PIXEL_BYTES)
}

/// What was found in a photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotoFeatures {
    /// The photo.
    pub image: PathBuf,
    /// The table of its features.
    pub output: PathBuf,
    /// Width of the photo, pixels.
    pub width_px: u32,
    /// Height of the photo, pixels.
    pub height_px: u32,
    /// Number of features.
    pub features: usize,
}

/// What was found in several photos.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FeaturesOutcome {
    /// What was looked for.
    pub options: FeatureOptions,
    /// The photos in their order.
    pub photos: Vec<PhotoFeatures>,
}

/// Finds the features of photos and writes `NAME.features.csv` for each into `folder`, which is made if missing; with `figures`, the photo with its key points as `NAME.features.png` there.
///
/// # Errors
/// Two photos of one name, a file that exists unless `force`, a photo that cannot be read, and writing.
pub fn write_features(
    photos: &[PathBuf],
    options: &FeatureOptions,
    folder: &Path,
    figures: Option<&Path>,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<FeaturesOutcome, Error> {
    let outputs = outputs(photos, folder, figures)?;
    for folder in [Some(folder), figures].into_iter().flatten() {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
    }
    for paths in &outputs {
        for path in [Some(&paths.table), paths.figure.as_ref()] {
            path.map_or(Ok(()), |path| output::check(path, force))?;
        }
    }
    let mut empty = Vec::new();
    let mut found = Vec::with_capacity(photos.len());
    let counter = Counter::new(monitor, "detecting features", photos.len(), "photos");
    for (image, paths) in photos.iter().zip(outputs) {
        require_memory(image)?;
        let mut photo = images::read_photo(image)?;
        let own = features::detect(&features::grey(&photo), options);
        if own.key_points.is_empty() {
            empty.push(image);
        }
        write_table(&paths.table, force, &own)?;
        if let Some(path) = &paths.figure {
            sketch::draw_key_points(&mut photo, &own.key_points);
            images::write_photo(path, force, &photo)?;
        }
        found.push(PhotoFeatures {
            image: image.clone(),
            output: paths.table,
            width_px: own.width_px,
            height_px: own.height_px,
            features: own.key_points.len(),
        });
        counter.tick();
    }
    for image in empty {
        let found = Diagnostic::warning(
            "no-features",
            image.display().to_string(),
            "no feature was found in it",
        );
        monitor.diagnostic(&found.with_remedy("look whether the photo is blurred or flat"));
    }
    Ok(FeaturesOutcome { options: *options, photos: found })
}

/// Where the results of a photo go.
struct Outputs {
    table: PathBuf,
    figure: Option<PathBuf>,
}

fn outputs(
    photos: &[PathBuf],
    folder: &Path,
    figures: Option<&Path>,
) -> Result<Vec<Outputs>, Error> {
    let mut found: Vec<Outputs> = Vec::new();
    for image in photos {
        let Some(name) = image.file_stem() else {
            let image = image.display();
            return Err(Error::Argument(format!("{image}: expected the path of a photo")));
        };
        let path = |folder: &Path, end: &str| {
            let mut name = name.to_owned();
            name.push(end);
            folder.join(name)
        };
        found.push(Outputs {
            table: path(folder, ".features.csv"),
            figure: figures.map(|figures| path(figures, ".features.png")),
        });
    }
    photo_names::refuse_twins(photos, found.iter().map(|of| &of.table))?;
    Ok(found)
}

fn write_table(path: &Path, force: bool, found: &Features) -> Result<(), FileError> {
    output::write(path, force, |file| {
        writeln!(file, "u_px,v_px,sigma_px,angle_rad,response")?;
        for point in &found.key_points {
            let features::KeyPoint { u_px, v_px, sigma_px, angle_rad, response } = point;
            writeln!(file, "{u_px},{v_px},{sigma_px},{angle_rad},{response}")?;
        }
        Ok(())
    })
}

/// What two photos have in common.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MatchOutcome {
    /// The first photo.
    pub first: PathBuf,
    /// The second photo.
    pub second: PathBuf,
    /// The table of matches.
    pub output: PathBuf,
    /// Number of features of each photo.
    pub features: [usize; 2],
    /// Number of matches.
    pub matches: usize,
}

/// The name of the picture that [`write_matches`] draws.
pub const MATCHES_FIGURE: &str = "matches.png";

/// Matches the features of two photos by their descriptors alone and writes the matches as a table; with `figures`, both
/// photos with a line for each match as `matches.png` there.
///
/// `ratio` is the largest distance relative to that of the second nearest, greater than 0 and at most 1.
///
/// # Errors
/// A ratio out of that range, an output that is a photo or exists unless `force`, a photo that cannot be read, writing.
pub fn write_matches(
    [first_path, second_path]: [&Path; 2],
    options: &FeatureOptions,
    ratio: f32,
    path: &Path,
    figures: Option<&Path>,
    force: bool,
) -> Result<MatchOutcome, Error> {
    if !(ratio > 0.0 && ratio <= 1.0) {
        return Err(Error::Argument(format!(
            "ratio {ratio}: expected a number greater than 0 and at most 1"
        )));
    }
    let figure = figures.map(|folder| folder.join(MATCHES_FIGURE));
    let targets: Vec<&Path> = [Some(path), figure.as_deref()].into_iter().flatten().collect();
    output::check_apart(&targets, &[first_path, second_path], force)?;
    output::check(path, force)?;
    let load = |path: &Path| -> Result<(RgbImage, Features), Error> {
        require_memory(path)?;
        let photo = images::read_photo(path)?;
        let found = features::detect(&features::grey(&photo), options);
        Ok((photo, found))
    };
    let (first, second) = (load(first_path)?, load(second_path)?);
    let rule = matching::MatchOptions { ratio, ..Default::default() };
    let matches = matching::match_descriptors(&first.1.descriptors, &second.1.descriptors, &rule);
    output::write(path, force, |file| {
        writeln!(file, "first_u_px,first_v_px,second_u_px,second_v_px,distance")?;
        for m in &matches {
            let a = &first.1.key_points[m.first as usize];
            let b = &second.1.key_points[m.second as usize];
            let distance = f64::from(m.distance_squared).sqrt() / 512.0;
            let (u, v, x, y) = (a.u_px, a.v_px, b.u_px, b.v_px);
            writeln!(file, "{u},{v},{x},{y},{distance:.4}")?;
        }
        Ok(())
    })?;
    if let (Some(folder), Some(figure)) = (figures, &figure) {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
        let picture = sketch::correspondences(
            (&first.0, &first.1.key_points),
            (&second.0, &second.1.key_points),
            &matches,
        );
        images::write_photo(figure, force, &picture)?;
    }
    Ok(MatchOutcome {
        first: first_path.to_owned(),
        second: second_path.to_owned(),
        output: path.to_owned(),
        features: [first.1.key_points.len(), second.1.key_points.len()],
        matches: matches.len(),
    })
}
