//! The photos of a calibration and their corners: found or read, and what is wrong with each.

use super::Args;
use crate::{
    error::Error,
    io::{FileError, corners, images},
    problems::calibration::{Mark, View, start},
    target::{Board, BoardCorner, NotFound, Options, detect},
};
use rayon::prelude::*;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What became of a photo.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "status", rename_all = "kebab-case")]
pub(super) enum Status {
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
        /// That of the usual photo, pixels.
        usual_px: f64,
    },
}

impl Status {
    pub(super) fn is_used(&self) -> bool {
        matches!(self, Status::Used | Status::UsedPart)
    }
}

impl std::fmt::Display for Status {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Status::Used => write!(f, "used"),
            Status::UsedPart => write!(f, "used in part"),
            Status::Part { seen } => {
                write!(f, "left out: only a part of the board can be seen ({seen} inner corners)")
            }
            Status::NoBoard { reason } => write!(f, "left out: {reason}"),
            Status::OtherBoard { found } => {
                write!(f, "left out: a board of {found} inner corners")
            }
            Status::NoPlane => write!(f, "left out: the corners are in no order of a board"),
            Status::Duplicate { of } => write!(f, "left out: the same as {of}"),
            Status::Misfit { rms_px, usual_px } => {
                write!(f, "left out: {rms_px:.2} px rms against {usual_px:.2} px")
            }
        }
    }
}

/// One photo.
#[derive(Debug, Clone)]
pub(super) struct Photo {
    /// Its name in messages and tables.
    pub(super) name: String,
    /// Its file, where there is one.
    pub(super) path: Option<PathBuf>,
    /// Its corners; empty where none were found.
    pub(super) corners: Vec<BoardCorner>,
    pub(super) status: Status,
    /// Width of the board's edges, pixels, where the photo was looked at.
    pub(super) edge_width_px: Option<f64>,
    /// Whether its edges are much wider than those of the others.
    pub(super) blurred: bool,
}

/// All photos, and their common size.
pub(super) struct Gathered {
    pub(super) photos: Vec<Photo>,
    pub(super) size_px: [u32; 2],
}

pub(super) fn gather(args: &Args) -> Result<Gathered, Error> {
    let (mut photos, size_px) = match &args.corners {
        Some(path) => read(path, args)?,
        None => look(args)?,
    };
    mark_duplicates(&mut photos);
    for photo in &mut photos {
        if photo.status.is_used() && !start::resembles_plane(&view(photo, args)) {
            photo.status = Status::NoPlane;
        }
    }
    for photo in photos.iter().filter(|photo| !photo.status.is_used()) {
        tracing::warn!("{}: {}", photo.name, photo.status);
    }
    Ok(Gathered { photos, size_px })
}

/// Looks for the board in every photo.
fn look(args: &Args) -> Result<(Vec<Photo>, [u32; 2]), Error> {
    let options = Options { refinement: args.refine.method(), ..Options::default() };
    let progress = indicatif::ProgressBar::new(args.images.len() as u64).with_style(
        indicatif::ProgressStyle::with_template("corners {bar:30} {pos}/{len} photos")
            .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar()),
    );
    if !tracing::enabled!(tracing::Level::INFO) {
        progress.set_draw_target(indicatif::ProgressDrawTarget::hidden());
    }
    let folder = folder_of_all(&args.images);
    let found: Vec<Result<(Photo, [u32; 2]), FileError>> = args
        .images
        .par_iter()
        .map(|path| {
            let image = images::read_grey(path)?;
            let size_px = [image.width(), image.height()];
            let photo = one(path, &folder, detect(&image, args.board, &options), args);
            progress.inc(1);
            Ok((photo, size_px))
        })
        .collect();
    progress.finish_and_clear();
    let found = found.into_iter().collect::<Result<Vec<_>, FileError>>()?;
    let size_px = found.first().map_or([0, 0], |(_, size)| *size);
    let first = found.first().map_or("", |(photo, _)| photo.name.as_str());
    if let Some((photo, size)) = found.iter().find(|(_, size)| *size != size_px) {
        return Err(Error::Argument(format!(
            "{} has {} x {} pixels, {first} {} x {}; one calibration needs photos of one size (no turned or scaled ones)",
            photo.name, size[0], size[1], size_px[0], size_px[1]
        )));
    }
    Ok((found.into_iter().map(|(photo, _)| photo).collect(), size_px))
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
    found: Result<crate::target::Detection, NotFound>,
    args: &Args,
) -> Photo {
    // Where the photos are is not a matter of the calibration: moved, they give the same tables.
    let name = path.strip_prefix(folder).unwrap_or(path).display().to_string();
    let mut photo = Photo {
        name,
        path: Some(path.to_owned()),
        corners: Vec::new(),
        status: Status::Used,
        edge_width_px: None,
        blurred: false,
    };
    match found {
        Ok(detection) => {
            if detection.others > 0 {
                tracing::warn!(
                    "{}: {} more board(s) of this size; the largest is used",
                    photo.name,
                    detection.others
                );
            }
            photo.corners = detection.corners;
            photo.edge_width_px = Some(detection.edge_width_px);
            photo.status = match (detection.complete, args.partial) {
                (true, _) => Status::Used,
                (false, true) => Status::UsedPart,
                (false, false) => Status::Part { seen: extent(&photo.corners).to_string() },
            };
        }
        Err(NotFound::OtherSize { found, .. }) => {
            photo.status = Status::OtherBoard { found: found.to_string() };
        }
        Err(reason) => photo.status = Status::NoBoard { reason: reason.to_string() },
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
fn read(path: &Path, args: &Args) -> Result<(Vec<Photo>, [u32; 2]), Error> {
    let listed = corners::read(path, args.board)?;
    let file_name = |path: &Path| path.file_name().map(|n| n.to_string_lossy().into_owned());
    let mut size_px = match &args.size {
        Some(text) => Some(parse_size(text)?),
        None => None,
    };
    let mut origin = "--size".to_owned();
    for image in &args.images {
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
            "--corners: the size of the photos is not known; give the photos too, or --size WIDTHxHEIGHT".into(),
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
        let own = args.images.iter().find(|given| {
            given.to_string_lossy() == image.image
                || file_name(given) == file_name(Path::new(&image.image))
        });
        let count = image.corners.len();
        let complete = count == args.board.columns * args.board.rows;
        let status = match count {
            // Too few for a pose and a share in the lens.
            0..6 => {
                Status::NoBoard { reason: format!("only {count} corners, at least 6 are needed") }
            }
            _ if complete => Status::Used,
            _ => Status::UsedPart,
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

fn parse_size(text: &str) -> Result<[u32; 2], Error> {
    let sides = text
        .split_once(['x', 'X'])
        .and_then(|(a, b)| Some([a.trim().parse().ok()?, b.trim().parse().ok()?]));
    sides.filter(|sides: &[u32; 2]| !sides.contains(&0)).ok_or_else(|| {
        Error::Argument(format!("--size {text}: expected WIDTHxHEIGHT in pixels, such as 1280x960"))
    })
}

/// Photos with the very same corners are one photo given twice.
fn mark_duplicates(photos: &mut [Photo]) {
    for k in 1..photos.len() {
        if photos[k].corners.is_empty() {
            continue;
        }
        let twin = (0..k).find(|&other| photos[other].corners == photos[k].corners);
        if let Some(other) = twin {
            photos[k].status = Status::Duplicate { of: photos[other].name.clone() };
        }
    }
}

/// A photo as the adjustment takes it.
pub(super) fn view(photo: &Photo, args: &Args) -> View {
    let marks = photo.corners.iter().map(|corner| Mark {
        corner: corner.row * args.board.columns.max(args.board.rows) + corner.column,
        board_m: [args.square * corner.column as f64, args.square * corner.row as f64],
        image_px: corner.image_px,
    });
    View { marks: marks.collect() }
}

/// Refuses too few photos, in the words that say why.
pub(super) fn enough(photos: &[Photo], used: &[usize], args: &Args) -> Result<(), Error> {
    const LEAST: usize = 3;
    const FEW: usize = 8;
    if used.len() >= LEAST {
        if used.len() < FEW {
            tracing::warn!(
                "only {} photos show the board; {FEW} or more, tilted and all over the picture, make a good calibration",
                used.len()
            );
        }
        return Ok(());
    }
    let mut other: Vec<&str> = photos
        .iter()
        .filter_map(|photo| match &photo.status {
            Status::OtherBoard { found } => Some(found.as_str()),
            Status::Part { seen } => Some(seen.as_str()),
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
            "{count} of {} photos show a board of {size} inner corners, --board says {}",
            photos.len(),
            args.board
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
        "{} of {} photos can be used, a calibration needs at least {LEAST} with the board at different tilts{}{more}",
        used.len(),
        photos.len(),
        reasons.concat()
    )))
}

/// Names photos whose edges are much wider than those of the others.
pub(super) fn name_blurred(photos: &mut [Photo], used: &[usize]) {
    const RATIO: f64 = 2.0;
    const LEAST_PX: f64 = 2.5;
    let mut widths: Vec<f64> = used.iter().filter_map(|&k| photos[k].edge_width_px).collect();
    if widths.is_empty() {
        return;
    }
    widths.sort_by(f64::total_cmp);
    let usual = widths[widths.len() / 2];
    for &k in used {
        let Some(width) = photos[k].edge_width_px else { continue };
        if width > RATIO * usual && width > LEAST_PX {
            photos[k].blurred = true;
            tracing::warn!(
                "{} is blurred: edges are {width:.1} px wide, usually {usual:.1} px",
                photos[k].name
            );
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
