//! `rowgram doctor`: what a project lacks, before hours are spent on it.

use super::{captured, dispatch, parse, print, print_json};
use crate::{
    crs::LocalPlane,
    error::Error,
    io::{FileError, photo},
};
use rayon::prelude::*;
use serde::Serialize;
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// Check a project: photos, EXIF, ground points, overlap, settings
///
/// Reads the heads of the photos and all tables, and says what is missing, what contradicts itself and what that
/// will mean. Nothing is written. Exit code 3 where something is bad.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Example:
  rowgram doctor field"
)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Print one line of JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum State {
    Good,
    Note,
    Bad,
}

#[derive(Debug, Serialize)]
struct Finding {
    state: State,
    subject: &'static str,
    what: String,
}

const ENDINGS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

/// Runs the verb.
///
/// # Errors
/// A project that is no folder, and [`Error::Incomplete`] where something is bad.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let root = &args.project;
    if !root.is_dir() {
        return Err(FileError::malformed(root, None, "expected a folder").into());
    }
    let mut found = Vec::new();
    let mut add = |state, subject, what: String| found.push(Finding { state, subject, what });
    match super::run::settings(root) {
        Ok(()) => {
            add(State::Good, "settings", "rowgram.toml and the environment are understood".into())
        }
        Err(error) => add(State::Bad, "settings", error.to_string()),
    }
    let photos = photos(root)?;
    if photos.is_empty() {
        add(State::Bad, "photos", format!("none in images/ or directly ({})", ENDINGS.join(", ")));
    } else {
        of_photos(&photos, &mut add);
        inspected(root, &mut add);
    }
    if ["gcps.csv", "gcp_list.txt", "ground_control_points.json"]
        .iter()
        .all(|name| !root.join(name).is_file())
    {
        let what = "no ground points: place and height are those of the camera positions, metres off, and nothing tells the error";
        add(State::Note, "control", what.into());
    }
    if crate::io::polygons::find(root, "plots").is_none() {
        let what = "no plots.geojson, .gpkg or .shp: traits are of the whole field unless [plots] says how rows make plots";
        add(State::Note, "plots", what.into());
    }
    if args.json {
        print_json(&found)?;
    } else {
        let lines = found.iter().map(|finding| {
            let state = match finding.state {
                State::Good => "good",
                State::Note => "note",
                State::Bad => "BAD ",
            };
            format!("{state}  {:<10} {}\n", finding.subject, finding.what)
        });
        print(&lines.collect::<String>())?;
    }
    match found.iter().filter(|finding| finding.state == State::Bad).count() {
        0 => Ok(()),
        n => Err(Error::Incomplete(format!("{n} of these have to be put right first"))),
    }
}

fn photos(root: &Path) -> Result<Vec<PathBuf>, Error> {
    let images = root.join("images");
    let folder = if images.is_dir() { images } else { root.to_owned() };
    let mut found: Vec<PathBuf> = std::fs::read_dir(&folder)
        .map_err(|e| FileError::read(&folder, e))?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let ending = path.extension().and_then(|e| e.to_str()).map(str::to_lowercase);
            path.is_file() && ending.is_some_and(|e| ENDINGS.contains(&e.as_str()))
        })
        .collect();
    found.sort();
    Ok(found)
}

/// What their heads say.
fn of_photos(photos: &[PathBuf], add: &mut impl FnMut(State, &'static str, String)) {
    let heads: Vec<_> = photos
        .par_iter()
        .map(|path| (photo::read(path), image::image_dimensions(path).ok()))
        .collect();
    let mut cameras: BTreeMap<String, usize> = BTreeMap::new();
    let (mut unread, mut without_focal, mut without_place) = (Vec::new(), 0, 0);
    let mut places = Vec::new();
    let mut footprint = Vec::new();
    for (path, (head, size)) in photos.iter().zip(&heads) {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let (Ok(head), Some((width, height))) = (head, size) else {
            unread.push(name);
            continue;
        };
        *cameras.entry(format!("{} {} {width} x {height}", head.make, head.model)).or_default() +=
            1;
        let principal = head.principal_distance_px([*width, *height]);
        without_focal += usize::from(principal.is_none());
        match &head.geotag {
            Some(tag) => places.push(*tag),
            None => without_place += 1,
        }
        if let (Some((distance, _)), Some(above)) = (principal, head.height_above_take_off_m) {
            footprint.push(above / distance * f64::from(*width.min(height)));
        }
    }
    let all = photos.len();
    if unread.is_empty() {
        add(State::Good, "photos", format!("{all}, all can be opened"));
    } else {
        add(
            State::Bad,
            "photos",
            format!("{} of {all} cannot be opened: {}", unread.len(), unread.join(", ")),
        );
    }
    if all < 3 {
        add(State::Bad, "photos", format!("{all} are too few for a block, expected 3 or more"));
    }
    let list: Vec<String> =
        cameras.iter().map(|(name, n)| format!("{n} by {}", name.trim())).collect();
    let state = if cameras.len() > 1 { State::Note } else { State::Good };
    add(state, "camera", list.join("; "));
    if without_focal > 0 {
        let what = format!(
            "{without_focal} photos say no focal length; it is found from the photos, or from camera.toml"
        );
        add(State::Note, "camera", what);
    }
    if without_place > 0 {
        let what =
            format!("{without_place} photos have no position: all pairs of them have to be tried");
        add(State::Note, "positions", what);
    } else {
        add(State::Good, "positions", format!("all {all} photos have one"));
    }
    spacing(&places, &footprint, add);
}

/// How far photos are from their nearest neighbours, and what overlap that makes where the height is known.
fn spacing(
    places: &[photo::Geotag],
    footprint_m: &[f64],
    add: &mut impl FnMut(State, &'static str, String),
) {
    let Some(first) = places.first().filter(|_| places.len() > 2) else { return };
    let plane = LocalPlane::at([first.latitude_deg, first.longitude_deg, 0.0]);
    let at: Vec<[f64; 2]> = places
        .iter()
        .map(|tag| {
            let [east, north, _] = plane.from_wgs84([tag.latitude_deg, tag.longitude_deg, 0.0]);
            [east, north]
        })
        .collect();
    let nearest = |k: usize| {
        let others = at.iter().enumerate().filter(|(j, _)| *j != k);
        others.map(|(_, p)| (p[0] - at[k][0]).hypot(p[1] - at[k][1])).fold(f64::INFINITY, f64::min)
    };
    let mut distances: Vec<f64> = (0..at.len()).map(nearest).collect();
    distances.sort_by(f64::total_cmp);
    let (middle, last) = (distances[distances.len() / 2], distances[distances.len() - 1]);
    let mut text = format!("nearest neighbours are {middle:.1} m apart, at most {last:.1} m");
    let mut state = State::Good;
    if let Some(&side) = footprint_m.get(footprint_m.len() / 2).filter(|side| **side > 0.0) {
        let overlap = 100.0 * (1.0 - middle / side);
        text += &format!("; about {overlap:.0} % forward overlap by the heights in the photos");
        state = match overlap {
            overlap if overlap < 30.0 => State::Bad,
            overlap if overlap < 55.0 => State::Note,
            _ => State::Good,
        };
    }
    add(state, "overlap", text);
}

/// What `rowgram align` says when it only looks.
fn inspected(root: &Path, add: &mut impl FnMut(State, &'static str, String)) {
    let result = tempfile::tempdir().map_err(|e| Error::from(FileError::write(root, e))).and_then(
        |folder| {
            let mut words: Vec<std::ffi::OsString> =
                ["rowgram", "align", "--until", "inspect", "-o"].map(Into::into).into();
            words.extend([folder.path().into(), root.into()]);
            let cli = parse(words)?;
            captured(|| dispatch(cli.verb)).1
        },
    );
    match result {
        Ok(()) => add(
            State::Good,
            "tables",
            "photos, control, marks and positions fit together (remarks above)".into(),
        ),
        Err(error) => add(State::Bad, "tables", error.to_string()),
    }
}
