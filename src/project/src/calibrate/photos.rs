//! The photos of a calibration and their corners: found or read, and what is wrong with each.

use super::CalibrateOptions;
use rayon::prelude::*;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_files::{corners, images};
use rowgram_optim::output::FileError;
use rowgram_optim::robust::median;
use rowgram_survey::{
    problems::calibration::{Mark, View, consistent::MIN_VIEWS, start},
    target::{self, Board, BoardCorner, NotFound, detect},
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What became of a photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "status", rename_all = "kebab-case")]
pub enum PhotoStatus {
    /// The whole board took part.
    Used,
    /// What can be seen of it took part.
    UsedPart,
    /// A part of the board was found, and left out.
    Part {
        /// Columns and rows of inner corners that can be seen.
        seen: String,
    },
    /// No board was found.
    NoBoard {
        /// Why.
        reason: String,
    },
    /// A board of another size was found.
    OtherBoard {
        /// Its inner corners.
        found: String,
    },
    /// The corners are in no order of a board.
    NoPlane,
    /// The same as another photo.
    Duplicate {
        /// That photo.
        of: String,
    },
    /// It contradicts the others.
    Misfit {
        /// Its root mean square, pixels.
        rms_px: f64,
        /// The median one of all photos, pixels.
        median_px: f64,
    },
}

impl PhotoStatus {
    /// Whether it took part.
    pub fn is_used(&self) -> bool {
        matches!(self, PhotoStatus::Used | PhotoStatus::UsedPart)
    }
}

impl std::fmt::Display for PhotoStatus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            PhotoStatus::Used => write!(f, "used"),
            PhotoStatus::UsedPart => write!(f, "used in part"),
            PhotoStatus::Part { seen } => {
                write!(f, "left out: only a part of the board can be seen ({seen} inner corners)")
            }
            PhotoStatus::NoBoard { reason } => write!(f, "left out: {reason}"),
            PhotoStatus::OtherBoard { found } => {
                write!(f, "left out: a board of {found} inner corners")
            }
            PhotoStatus::NoPlane => write!(f, "left out: the corners are in no order of a board"),
            PhotoStatus::Duplicate { of } => write!(f, "left out: the same as {of}"),
            PhotoStatus::Misfit { rms_px, median_px } => {
                write!(
                    f,
                    "left out: it contradicts the others, {rms_px:.2} px rms, median {median_px:.2} px"
                )
            }
        }
    }
}

/// One photo.
#[derive(Debug, Clone)]
pub struct Photo {
    /// Its name in messages and tables.
    pub name: String,
    /// Its file, where there is one.
    pub path: Option<PathBuf>,
    /// Its corners; empty where none were found.
    pub corners: Vec<BoardCorner>,
    /// What became of it.
    pub status: PhotoStatus,
    /// Width of the board's edges, pixels, where the photo was looked at.
    pub edge_width_px: Option<f64>,
    /// Whether its edges are much wider than those of the others.
    pub blurred: bool,
}

/// All photos, and their common size.
pub(super) struct Gathered {
    pub(super) photos: Vec<Photo>,
    pub(super) size_px: [u32; 2],
}

/// Finds or reads the corners of all photos; those that cannot be used are reported.
///
/// # Errors
/// Photos that cannot be read or differ in size; a table that does not belong to the board.
pub(super) fn gather(
    images: &[PathBuf],
    board: Board,
    square_m: f64,
    options: &CalibrateOptions,
    monitor: &mut dyn Monitor,
) -> Result<Gathered, Error> {
    let (mut photos, size_px) = match &options.corners {
        Some(path) => read(path, images, board, options)?,
        None => look(images, board, options, monitor)?,
    };
    mark_duplicates(&mut photos);
    for photo in &mut photos {
        if photo.status.is_used() && !start::resembles_plane(&view(photo, board, square_m)) {
            photo.status = PhotoStatus::NoPlane;
        }
    }
    for photo in photos.iter().filter(|photo| !photo.status.is_used()) {
        let found = Diagnostic::warning("photo-left-out", &photo.name, photo.status.to_string());
        monitor.diagnostic(&found);
    }
    Ok(Gathered { photos, size_px })
}

/// A photo with what was found in it, its size, and how many other boards it shows.
type Searched = Result<(Photo, [u32; 2], usize), FileError>;

/// Looks for the board in every photo.
fn look(
    images: &[PathBuf],
    board: Board,
    options: &CalibrateOptions,
    monitor: &mut dyn Monitor,
) -> Result<(Vec<Photo>, [u32; 2]), Error> {
    let search = target::DetectionOptions { ..target::DetectionOptions::default() };
    let folder = folder_of_all(images);
    let counter = Counter::new(monitor, "finding corners", images.len(), "photos");
    let found: Vec<Searched> = images
        .par_iter()
        .map(|path| {
            let image = images::read_grey(path)?;
            let size_px = [image.width(), image.height()];
            let found = detect(&image, board, &search);
            let others = found.as_ref().map_or(0, |detection| detection.others);
            let photo = one(path, &folder, found, options.partial_boards);
            counter.tick();
            Ok((photo, size_px, others))
        })
        .collect();
    // The error of the first photo, whichever thread came first.
    let found = found.into_iter().collect::<Result<Vec<_>, FileError>>()?;
    for (photo, _, others) in found.iter().filter(|(_, _, others)| *others > 0) {
        let message = format!("it shows {others} more board(s) of this size; the largest is used");
        monitor.diagnostic(&Diagnostic::warning("several-boards", &photo.name, message));
    }
    let size_px = found.first().map_or([0, 0], |(_, size, _)| *size);
    let first = found.first().map_or("", |(photo, ..)| photo.name.as_str());
    if let Some((photo, size, _)) = found.iter().find(|(_, size, _)| *size != size_px) {
        return Err(Error::Argument(format!(
            "{} has {} x {} pixels, {first} {} x {}; one calibration needs photos of one size (no turned or scaled ones)",
            photo.name, size[0], size[1], size_px[0], size_px[1]
        )));
    }
    Ok((found.into_iter().map(|(photo, ..)| photo).collect(), size_px))
}

/// The folder that all photos are in, at some depth.
fn folder_of_all(paths: &[PathBuf]) -> PathBuf {
    let Some((first, others)) = paths.split_first() else { return PathBuf::new() };
    let above = |folder: &&Path| others.iter().all(|path| path.starts_with(folder));
    first.ancestors().skip(1).find(above).map_or_else(PathBuf::new, Path::to_owned)
}

fn one(
    path: &Path,
    folder: &Path,
    found: Result<target::Detection, NotFound>,
    use_part: bool,
) -> Photo {
    // Where the photos are is not a matter of the calibration: moved, they give the same tables.
    let name = path.strip_prefix(folder).unwrap_or(path).display().to_string();
    let mut photo = Photo {
        name,
        path: Some(path.to_owned()),
        corners: Vec::new(),
        status: PhotoStatus::Used,
        edge_width_px: None,
        blurred: false,
    };
    match found {
        Ok(detection) => {
            photo.corners = detection.corners;
            photo.edge_width_px = Some(detection.edge_width_px);
            photo.status = match (detection.complete, use_part) {
                (true, _) => PhotoStatus::Used,
                (false, true) => PhotoStatus::UsedPart,
                (false, false) => PhotoStatus::Part { seen: extent(&photo.corners).to_string() },
            };
        }
        Err(NotFound::OtherSize { found, .. }) => {
            photo.status = PhotoStatus::OtherBoard { found: found.to_string() };
        }
        Err(reason) => photo.status = PhotoStatus::NoBoard { reason: reason.to_string() },
    }
    photo
}

/// Columns and rows that corners take up, the longer side first.
fn extent(corners: &[BoardCorner]) -> Board {
    let columns = corners.iter().map(|c| c.column + 1).max().unwrap_or(0);
    let rows = corners.iter().map(|c| c.row + 1).max().unwrap_or(0);
    Board { columns: columns.max(rows), rows: columns.min(rows) }
}

/// Reads corners; photos that are given too are taken by their names.
fn read(
    path: &Path,
    images: &[PathBuf],
    board: Board,
    options: &CalibrateOptions,
) -> Result<(Vec<Photo>, [u32; 2]), Error> {
    let listed = corners::read(path, board)?;
    let file_name = |path: &Path| path.file_name().map(|n| n.to_string_lossy().into_owned());
    let mut size_px = options.size_px;
    let mut origin = "size_px".to_owned();
    for image in images {
        let picture = images::read_grey(image)?;
        let size = [picture.width(), picture.height()];
        if let Some(other) = size_px.filter(|other| *other != size) {
            return Err(Error::Argument(format!(
                "{} has {} x {} pixels, {origin} says {} x {}",
                image.display(),
                size[0],
                size[1],
                other[0],
                other[1]
            )));
        }
        size_px = Some(size);
        origin = image.display().to_string();
    }
    let Some(size_px) = size_px else {
        return Err(Error::Argument(
            "corners: the size of the photos is not known; give the photos too, or size_px (width, height)".into(),
        ));
    };
    let mut photos = Vec::with_capacity(listed.len());
    for image in listed {
        let outside = image.corners.iter().find(|c| {
            (0..2).any(|k| !(-0.5..=f64::from(size_px[k]) - 0.5).contains(&c.image_px[k]))
        });
        if let Some(corner) = outside {
            return Err(FileError::malformed(
                path,
                None,
                format!(
                    "column {} of row {} of {} is at ({}, {}), outside the photo of {} x {} pixels",
                    corner.column,
                    corner.row,
                    image.image,
                    corner.image_px[0],
                    corner.image_px[1],
                    size_px[0],
                    size_px[1]
                ),
            )
            .into());
        }
        let own = images.iter().find(|given| {
            given.to_string_lossy() == image.image
                || file_name(given) == file_name(Path::new(&image.image))
        });
        let count = image.corners.len();
        let complete = count == board.columns * board.rows;
        let status = match count {
            // Too few for a pose and a share in the lens.
            0..6 => PhotoStatus::NoBoard {
                reason: format!("only {count} corners, at least 6 are needed"),
            },
            _ if complete => PhotoStatus::Used,
            _ => PhotoStatus::UsedPart,
        };
        photos.push(Photo {
            name: image.image,
            path: own.cloned(),
            corners: image.corners,
            status,
            edge_width_px: None,
            blurred: false,
        });
    }
    Ok((photos, size_px))
}

/// Photos with the very same corners are one photo given twice.
fn mark_duplicates(photos: &mut [Photo]) {
    for k in 1..photos.len() {
        if photos[k].corners.is_empty() {
            continue;
        }
        let twin = (0..k).find(|&other| photos[other].corners == photos[k].corners);
        if let Some(other) = twin {
            photos[k].status = PhotoStatus::Duplicate { of: photos[other].name.clone() };
        }
    }
}

/// A photo as the adjustment takes it.
pub(super) fn view(photo: &Photo, board: Board, square_m: f64) -> View {
    let marks = photo.corners.iter().map(|corner| Mark {
        corner: corner.row * board.columns.max(board.rows) + corner.column,
        board_m: [square_m * corner.column as f64, square_m * corner.row as f64],
        image_px: corner.image_px,
    });
    View { marks: marks.collect() }
}

/// Reports a number of photos that is enough, but not for a good calibration.
pub(super) fn report_few(used: usize, monitor: &mut dyn Monitor) {
    const FEW: usize = 8;
    if used < FEW {
        let message = format!("only {used} photos show the board");
        monitor.diagnostic(&Diagnostic::warning("few-photos", "calibration", message).with_remedy(
            format!("take {FEW} or more, with the board tilted and all over the picture"),
        ));
    }
}

/// Refuses too few photos, in the words that say why.
///
/// # Errors
/// As said.
pub(super) fn refuse_too_few(photos: &[Photo], used: &[usize], board: Board) -> Result<(), Error> {
    if used.len() >= MIN_VIEWS {
        return Ok(());
    }
    let mut other: Vec<&str> = photos
        .iter()
        .filter_map(|photo| match &photo.status {
            PhotoStatus::OtherBoard { found } => Some(found.as_str()),
            PhotoStatus::Part { seen } => Some(seen.as_str()),
            _ => None,
        })
        .collect();
    other.sort_unstable();
    // Parts of a board differ in size from photo to photo; another board does not.
    let usual = other.chunk_by(|a, b| a == b).max_by_key(|same| same.len());
    if let Some(&[size, ..]) = usual
        && let Some(count) = usual.map(<[&str]>::len)
        && 2 * count > photos.len()
    {
        return Err(Error::Argument(format!(
            "{count} of {} photos show a board of {size} inner corners, expected {}",
            photos.len(),
            board
        )));
    }
    let reasons: Vec<String> = photos
        .iter()
        .filter(|photo| !photo.status.is_used())
        .take(5)
        .map(|photo| format!("\n  {}: {}", photo.name, photo.status))
        .collect();
    let more = photos.len() - used.len() - reasons.len();
    let more = if more > 0 { format!("\n  and {more} more") } else { String::new() };
    Err(Error::Argument(format!(
        "{} of {} photos can be used, a calibration needs at least {MIN_VIEWS} with the board at different tilts{}{more}",
        used.len(),
        photos.len(),
        reasons.concat()
    )))
}

/// Reports photos whose edges are much wider than those of the others.
pub(super) fn report_blurred(photos: &mut [Photo], used: &[usize], monitor: &mut dyn Monitor) {
    const RATIO: f64 = 2.0;
    const MIN_WIDTH_PX: f64 = 2.5;
    let widths = used.iter().filter_map(|&k| photos[k].edge_width_px);
    let Some(median) = median(widths) else { return };
    for &k in used {
        let Some(width) = photos[k].edge_width_px else { continue };
        if width > RATIO * median && width > MIN_WIDTH_PX {
            photos[k].blurred = true;
            let message = format!("blurred: edges are {width:.1} px wide, median {median:.1} px");
            monitor.diagnostic(&Diagnostic::warning("photo-blurred", &photos[k].name, message));
        }
    }
}

/// The corners of all photos as a file has them.
pub(super) fn corner_table(photos: &[Photo]) -> Vec<corners::ImageCorners> {
    let with = photos.iter().filter(|photo| !photo.corners.is_empty());
    with.map(|photo| corners::ImageCorners {
        image: photo.name.clone(),
        corners: photo.corners.clone(),
    })
    .collect()
}
