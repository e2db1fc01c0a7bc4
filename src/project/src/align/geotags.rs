//! Where each photo was taken: by a file of positions, else by the photo itself, and what of it cannot be.

use super::{
    inputs::{Photo, Sources},
    place,
};
use crate::Project;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    camera_positions::{self, CameraPlaces, PhotoReference},
    image_names::Names,
    photo::Geotag,
};
use rowgram_optim::output::name_of;
use rowgram_optim::robust::median;
use rowgram_raster::crs::Crs;
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

/// The usual names of files of camera positions, in the folder of the project and in that of the photos.
const USUAL: [&str; 4] = ["geolocation.csv", "geolocation.txt", "positions.csv", "geo.txt"];
/// Positions that lie within this of each other are one: no flight with more than one photo is so small, metres.
const ONE_PLACE_M: f64 = 0.5;

/// Files of camera positions.
pub(super) struct PositionFiles {
    /// Of all photos, the one that is used first: the one that the settings name, else those with usual names, else the image log
    /// of a DJI drone, else RTKLIB's solutions at the exposures.
    pub(super) of_all: Vec<PathBuf>,
    /// Where there is none of all: for each subfolder with photos the one of these.
    pub(super) of_folders: Vec<PathBuf>,
}

impl PositionFiles {
    /// Those that are read.
    pub(super) fn used(&self) -> impl Iterator<Item = &PathBuf> {
        self.of_all.first().into_iter().chain(&self.of_folders)
    }
}

/// The files of camera positions of a project.
pub(super) fn files(project: &Project, named: Option<&PathBuf>) -> PositionFiles {
    if let Some(path) = project.given(named, &[]) {
        return PositionFiles { of_all: vec![path], of_folders: Vec::new() };
    }
    let mut folders = vec![project.root().to_owned(), project.photo_folder()];
    folders.dedup();
    let of_all = files_in(&folders);
    let mut of_folders = Vec::new();
    if of_all.is_empty() {
        let photos = project.photos();
        let below: BTreeSet<&Path> = photos.iter().filter_map(|path| path.parent()).collect();
        let below = below.into_iter().filter(|folder| !folders.iter().any(|all| all == folder));
        of_folders =
            below.filter_map(|folder| files_in(&[folder.to_owned()]).into_iter().next()).collect();
    }
    PositionFiles { of_all, of_folders }
}

fn files_in(folders: &[PathBuf]) -> Vec<PathBuf> {
    let usual = |folder: &PathBuf| USUAL.map(|name| folder.join(name));
    let mut found: Vec<PathBuf> =
        folders.iter().flat_map(usual).filter(|path| path.is_file()).collect();
    for is in [is_image_log as fn(&str) -> bool, is_events] {
        for folder in folders {
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
    let used: Vec<&PathBuf> = sources.positions.used().collect();
    for path in &used {
        let is_of_folder = sources.positions.of_folders.contains(path);
        let is_member = |k: &&usize| !is_of_folder || photos[**k].path.parent() == path.parent();
        let members: Vec<usize> = order.iter().filter(is_member).copied().collect();
        match from_file(path, photos, &members, sources, &mut tags, monitor) {
            // Nobody named it: photos may do without.
            Err(error) if is_of_folder => {
                let message = format!("not used: {error}");
                let found = Diagnostic::warning("positions-file-unused", name_of(path), message);
                monitor.diagnostic(&found.with_remedy("name another with [project] positions"));
            }
            read => read?,
        }
    }
    if !used.is_empty() {
        place::check_tables(&own, &tags)?;
    }
    if let Some((path, others)) = sources.positions.of_all.split_first()
        && !others.is_empty()
    {
        let names: Vec<String> = others.iter().map(|path| name_of(path)).collect();
        let message = format!("positions are those of {}; this file is not used", name_of(path));
        let found = Diagnostic::info("positions-file-unused", names.join(", "), message);
        monitor.diagnostic(&found.with_remedy("name another with [project] positions"));
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

/// Reads the positions of photos: of `members`, in the order in which they were taken.
fn from_file(
    path: &Path,
    photos: &[Photo],
    members: &[usize],
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
    if by_place && read.rows.len() != members.len() {
        let message = format!(
            "{}: {} solutions for {} photos; expected one for each, as RTKLIB writes them for events (a file that ends in _events.pos)",
            path.display(),
            read.rows.len(),
            members.len()
        );
        return Err(Error::Argument(message));
    }
    if read.rows.is_empty() {
        monitor.diagnostic(&empty_table(path, "positions"));
    }
    let names = Names::new(members.iter().map(|&k| photos[k].name.as_str()));
    let member = |k: u32| members.get(k as usize).copied();
    let mut unmatched = Vec::new();
    let mut matched = vec![false; photos.len()];
    for row in &read.rows {
        let (photo, called) = match &row.photo {
            PhotoReference::Name(name) => (names.find(name).and_then(member), name.clone()),
            PhotoReference::Number(number) => {
                (names.numbered(*number).and_then(member), format!("number {number}"))
            }
            PhotoReference::Place(place) => (members.get(*place).copied(), format!("row {place}")),
        };
        match photo {
            Some(photo) => {
                tags[photo] = Some(row.geotag(to_wgs84)?);
                matched[photo] = true;
            }
            None => unmatched.push(called),
        }
    }
    uncovered(path, photos, members, &matched, monitor);
    let Some(first) = unmatched.first() else { return Ok(()) };
    if !matched.contains(&true) {
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

/// Says that a table has a header and no row.
pub(super) fn empty_table(path: &Path, what: &str) -> Diagnostic {
    let message = format!("it holds no {what}: not a single row");
    Diagnostic::warning("table-empty", name_of(path), message)
        .with_remedy("fill it in, or take it out of the folder")
}

/// Says for which photos a file of positions has none where they have one themselves: the two may differ by metres.
fn uncovered(
    path: &Path,
    photos: &[Photo],
    members: &[usize],
    matched: &[bool],
    monitor: &mut dyn Monitor,
) {
    let has_own = |k: &&usize| !matched[**k] && photos[**k].metadata.geotag.is_some();
    let left: Vec<&str> =
        members.iter().filter(has_own).map(|&k| photos[k].name.as_str()).collect();
    let Some(first) = left.first().filter(|_| matched.contains(&true)) else { return };
    let message = format!(
        "{} of {} photos are not in it, the first {first}; the positions in these photos are used",
        left.len(),
        members.len()
    );
    let found = Diagnostic::warning("positions-partial", name_of(path), message);
    let remedy =
        "give the positions of all photos: those in photos may be metres off from the others";
    monitor.diagnostic(&found.with_remedy(remedy));
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
    if there == 0 {
        return;
    }
    if tags.iter().flatten().any(|tag| tag.height_m.is_some_and(|h| h != 0.0)) {
        let is_flat = |tag: &Option<Geotag>| tag.is_some_and(|tag| tag.height_m.is_none());
        let flat = tags.iter().filter(|tag| is_flat(tag)).count();
        if let Some(first) = tags.iter().position(is_flat) {
            let message = format!(
                "{flat} of {there} have no height, the first {}: they only tell which photos are neighbours",
                photos[first].name
            );
            let found = Diagnostic::warning("heights-missing", "camera positions", message);
            monitor.diagnostic(&found.with_remedy("give their heights"));
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{align::AlignOptions, record::Key};
    use rowgram_base::monitor::Collector;
    use rowgram_files::photo::Metadata;
    use std::fs;

    /// Positions and codes of what was told of photos with these names; they have positions of their own.
    fn read(project: &Project, names: &[&str]) -> (Vec<Option<Geotag>>, Vec<String>) {
        let photo = |(k, name): (usize, &&str)| {
            let latitude_deg = 40.47 + 1e-4 * k as f64;
            let tag =
                Geotag { latitude_deg, longitude_deg: -87.0, height_m: Some(190.0), sigma_m: None };
            Photo {
                path: project.photo_folder().join(name),
                name: (*name).to_owned(),
                metadata: Metadata { geotag: Some(tag), ..Metadata::default() },
                size_px: [4, 3],
                content: Key::begin().finish(),
                camera: 0,
            }
        };
        let photos: Vec<Photo> = names.iter().enumerate().map(photo).collect();
        let order: Vec<usize> = (0..photos.len()).collect();
        let options = AlignOptions::default();
        let sources = Sources::of(project, &options);
        let mut collector = Collector::default();
        let tags = geotags(&photos, &order, &sources, &mut collector).unwrap();
        (tags, collector.diagnostics.iter().map(|found| found.code.to_string()).collect())
    }

    #[test]
    fn a_log_beside_photos_is_of_these_photos() {
        let folder = tempfile::tempdir().unwrap();
        let names = ["100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG"];
        for (name, latitude) in names.iter().zip([40.471, 40.472]) {
            let path = folder.path().join("images").join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, "").unwrap();
            let log = format!("1\t385478.1\t[2275]\t{latitude},Lat\t-87.0,Lon\t193.3,Ellh\n");
            fs::write(path.with_file_name("flight_Timestamp.MRK"), log).unwrap();
        }
        let project = Project::open(folder.path()).unwrap();
        let (tags, codes) = read(&project, &names);
        let latitudes: Vec<f64> = tags.iter().flatten().map(|tag| tag.latitude_deg).collect();
        assert_eq!((latitudes, codes), (vec![40.471, 40.472], Vec::new()));
        // One that cannot be read leaves the photos their own positions.
        let broken = folder.path().join("images/100MEDIA/flight_Timestamp.MRK");
        fs::write(broken, "no log").unwrap();
        let (tags, codes) = read(&project, &names);
        assert_eq!(tags[0].unwrap().latitude_deg, 40.47);
        assert_eq!(codes, ["positions-file-unused"]);
    }

    #[test]
    fn what_a_file_of_positions_lacks_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let header = "image,latitude,longitude,height_m\n";
        for (rows, expected) in [
            ("", vec!["table-empty"]),
            ("a.jpg,40.470,-87,190\n", vec!["positions-partial"]),
            ("a.jpg,40.470,-87,190\nb.jpg,40.471,-87,\n", vec!["heights-missing"]),
            ("a.jpg,40.470,-87,190\nb.jpg,40.471,-87,190\n", vec![]),
        ] {
            fs::write(folder.path().join("geolocation.csv"), format!("{header}{rows}")).unwrap();
            let project = Project::open(folder.path()).unwrap();
            assert_eq!(read(&project, &["a.jpg", "b.jpg"]).1, expected, "{rows}");
        }
    }
}
