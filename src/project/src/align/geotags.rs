//! Where each photo was taken: by a file of positions, else by the photo itself, and what of it cannot be.

use super::{
    inputs::{Photo, Sources, names},
    place,
};
use crate::Project;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    camera_positions::{self, CameraPlaces, PhotoReference},
    photo::Geotag,
};
use rowgram_optim::output::name_of;
use rowgram_optim::robust::median;
use rowgram_raster::crs::Crs;
use std::path::{Path, PathBuf};

/// The usual names of files of camera positions, in the folder of the project and in that of the photos.
const USUAL: [&str; 4] = ["geolocation.csv", "geolocation.txt", "positions.csv", "geo.txt"];
/// Positions that lie within this of each other are one: no flight with more than one photo is so small, metres.
const ONE_PLACE_M: f64 = 0.5;

/// Files of camera positions, the one that is used first: the one that the settings name, else those with usual names, else
/// the image log of a DJI drone, else RTKLIB's solutions at the exposures.
pub(super) fn files(project: &Project, named: Option<&PathBuf>) -> Vec<PathBuf> {
    if let Some(path) = project.given(named, &[]) {
        return vec![path];
    }
    let mut folders = vec![project.root().to_owned(), project.photo_folder()];
    folders.dedup();
    let usual = |folder: &PathBuf| USUAL.map(|name| folder.join(name));
    let mut found: Vec<PathBuf> =
        folders.iter().flat_map(usual).filter(|path| path.is_file()).collect();
    for is in [is_image_log as fn(&str) -> bool, is_events] {
        for folder in &folders {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
            let mut of: Vec<PathBuf> = entries
                .map(|entry| entry.path())
                .filter(|path| path.file_name().is_some_and(|name| is(&name.to_string_lossy())))
                .collect();
            of.sort();
            found.extend(of);
        }
    }
    found
}

fn is_image_log(name: &str) -> bool {
    name.to_ascii_lowercase().ends_with(".mrk") && !name.starts_with('.')
}

fn is_events(name: &str) -> bool {
    name.to_ascii_lowercase().ends_with("events.pos") && !name.starts_with('.')
}

/// About where the photos were taken by what they say themselves: latitude and longitude.
pub(super) fn photos_deg(photos: &[Photo]) -> Option<[f64; 2]> {
    let tags: Vec<Geotag> = photos.iter().filter_map(|photo| photo.metadata.geotag).collect();
    (!tags.is_empty()).then(|| {
        [
            median(tags.iter().map(|tag| tag.latitude_deg)).unwrap_or(0.0),
            median(tags.iter().map(|tag| tag.longitude_deg)).unwrap_or(0.0),
        ]
    })
}

/// The position of each photo, by file or by the photo itself.
///
/// # Errors
/// A file that cannot be read, is of another place, or is in metres of a system that nobody names.
pub(super) fn geotags(
    photos: &[Photo],
    order: &[usize],
    sources: &Sources<'_>,
    monitor: &mut dyn Monitor,
) -> Result<Vec<Option<Geotag>>, Error> {
    let own: Vec<Option<Geotag>> = photos.iter().map(|photo| photo.metadata.geotag).collect();
    let mut tags = own.clone();
    if let Some((path, others)) = sources.positions.split_first() {
        from_file(path, photos, order, sources, &mut tags, monitor)?;
        place::check_tables(&own, &tags)?;
        if !others.is_empty() {
            let names: Vec<String> = others.iter().map(|path| name_of(path)).collect();
            let message =
                format!("positions are those of {}; this file is not used", name_of(path));
            let found = Diagnostic::info("positions-file-unused", names.join(", "), message);
            monitor.diagnostic(&found.with_remedy("name another with [project] positions"));
        }
    }
    place::drop_far(photos, &mut tags, monitor);
    drop_one_place(&mut tags, monitor);
    heights(photos, &mut tags, monitor);
    let missing: Vec<&str> = photos
        .iter()
        .zip(&tags)
        .filter(|(_, tag)| tag.is_none())
        .map(|(photo, _)| photo.name.as_str())
        .collect();
    if !missing.is_empty() && missing.len() < photos.len() {
        let message = "no position in the file";
        monitor.diagnostic(&Diagnostic::warning("no-position", missing.join(", "), message));
    }
    Ok(tags)
}

fn from_file(
    path: &Path,
    photos: &[Photo],
    order: &[usize],
    sources: &Sources<'_>,
    tags: &mut [Option<Geotag>],
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let read = camera_positions::read(path, photos_deg(photos))?;
    if let Some(choice) = &read.choice {
        let found = Diagnostic::info("columns-assumed", name_of(path), choice.as_str());
        let remedy =
            "a first row image, latitude, longitude, height (or easting, northing) says otherwise";
        monitor.diagnostic(&found.with_remedy(remedy));
    }
    let crs = system(path, &read, sources)?;
    let to_wgs84 = |[x, y]: [f64; 2]| match &crs {
        Some(crs) => crs.to_wgs84(x, y).map_err(|e| {
            Error::Argument(format!("{}: {e}: check the system of its positions", path.display()))
        }),
        None => Ok([y, x]),
    };
    let by_place = read.rows.iter().any(|row| matches!(row.photo, PhotoReference::Place(_)));
    if by_place && read.rows.len() != photos.len() {
        let message = format!(
            "{}: {} solutions for {} photos; expected one for each, as RTKLIB writes them for events (a file that ends in _events.pos)",
            path.display(),
            read.rows.len(),
            photos.len()
        );
        return Err(Error::Argument(message));
    }
    let names = names(photos);
    let (mut unmatched, mut matched) = (Vec::new(), 0);
    for row in &read.rows {
        let (photo, called) = match &row.photo {
            PhotoReference::Name(name) => (names.find(name).map(|k| k as usize), name.clone()),
            PhotoReference::Number(number) => {
                (names.numbered(*number).map(|k| k as usize), format!("number {number}"))
            }
            PhotoReference::Place(place) => (order.get(*place).copied(), format!("row {place}")),
        };
        match photo {
            Some(photo) => {
                tags[photo] = Some(row.geotag(to_wgs84)?);
                matched += 1;
            }
            None => unmatched.push(called),
        }
    }
    let Some(first) = unmatched.first() else { return Ok(()) };
    if matched == 0 {
        let ours = photos.first().map_or("none", |photo| photo.name.as_str());
        return Err(Error::Argument(format!(
            "{}: no row names a photo; the file has names like {first:?}, the photos like {ours:?}",
            path.display()
        )));
    }
    let message = format!("{} rows name no photo, the first {first:?}", unmatched.len());
    monitor.diagnostic(&Diagnostic::warning("rows-without-photo", name_of(path), message));
    Ok(())
}

/// The system of positions in metres.
fn system(path: &Path, read: &CameraPlaces, sources: &Sources<'_>) -> Result<Option<Crs>, Error> {
    if !read.needs_system() {
        return Ok(None);
    }
    let Some(words) = read.system.as_deref().or(sources.crs) else {
        return Err(Error::Argument(format!(
            "{}: its positions are in metres of a system that nobody names; name it in its first line (EPSG:<code>) or with [project] crs",
            path.display()
        )));
    };
    let crs = Crs::from_words(words);
    crs.map(Some).map_err(|e| Error::Argument(format!("{}: {e}", path.display())))
}

/// Positions that are all the same tell nothing: the receiver had none but that of the take-off.
fn drop_one_place(tags: &mut [Option<Geotag>], monitor: &mut dyn Monitor) {
    let there: Vec<Geotag> = tags.iter().flatten().copied().collect();
    let Some(first) = there.first().filter(|_| there.len() > 2) else { return };
    let far = |tag: &Geotag| place::apart_m(first, tag) > ONE_PLACE_M;
    if there.iter().any(far) {
        return;
    }
    let message = format!(
        "all {} photos have the same position, latitude {:.6}, longitude {:.6}: no positions of a flight; not used",
        there.len(),
        first.latitude_deg,
        first.longitude_deg
    );
    let remedy = "give the positions of the photos (geolocation.csv, geo.txt), or ground control";
    monitor.diagnostic(
        &Diagnostic::warning("positions-identical", "camera positions", message)
            .with_remedy(remedy),
    );
    tags.fill(None);
}

/// Heights that are all 0 are none; without any, those above the take-off or none at all say how high photos were taken.
fn heights(photos: &[Photo], tags: &mut [Option<Geotag>], monitor: &mut dyn Monitor) {
    let there = tags.iter().flatten().count();
    if there == 0 || tags.iter().flatten().any(|tag| tag.height_m.is_some_and(|h| h != 0.0)) {
        return;
    }
    let above: Option<Vec<f64>> =
        photos.iter().map(|photo| photo.metadata.height_above_take_off_m).collect();
    let message = match &above {
        Some(_) => {
            "they have no heights; those above the point of take-off are used: heights of the result start there"
        }
        None => {
            "they have no heights, or all are 0: heights of the result start at the cameras, and are negative on the ground"
        }
    };
    let found = Diagnostic::warning("heights-missing", "camera positions", message);
    monitor.diagnostic(&found.with_remedy("give heights with the positions, or ground control"));
    for (k, tag) in tags.iter_mut().enumerate() {
        if let Some(tag) = tag {
            tag.height_m = Some(above.as_ref().map_or(0.0, |above| above[k]));
        }
    }
}
