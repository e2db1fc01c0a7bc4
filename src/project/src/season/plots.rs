//! The plots of a season: in its frame, and on the map of each date.

use super::{Placement, SeasonFile, SeasonOutcome, register::DateMap};
use crate::{layers, record};
use rowgram_base::{error::Error, monitor::Monitor};
use rowgram_files::polygons::{self, Drawn, Named, Outline};
use rowgram_optim::output;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Folder of the plots within the results.
const FOLDER: &str = "plots";

/// The plots in the frame of the season; `None` where the season has none.
///
/// # Errors
/// A file that cannot be read.
pub(super) fn read(
    file: &SeasonFile,
    key: Option<&str>,
    map: &DateMap,
    monitor: &mut dyn Monitor,
) -> Result<Option<Vec<Outline>>, Error> {
    let Some(path) = &file.plots else { return Ok(None) };
    // Any map will do: it says in which system, and pixels go back to where they came from.
    let place = map.place;
    let drawn = Drawn { place: Some(&place), key, ..Drawn::default() };
    let outline = |plot: Named| {
        let ring = |ring: Vec<[f64; 2]>| ring.into_iter().map(|at| place.map(at)).collect();
        let rename = |(name, value): (String, Value)| match name == polygons::NAME {
            true => (format!("{name}_of_plot"), value),
            false => (name, value),
        };
        Outline {
            name: plot.name,
            rings: plot.polygon.rings.into_iter().map(ring).collect(),
            attributes: plot.attributes.into_iter().map(rename).collect(),
        }
    };
    let layer = polygons::read_layer(path, drawn)?;
    layers::say(path, &layer.notes, monitor);
    layers::say_overlaps(path, &layer.polygons, map.size, monitor);
    Ok(Some(layer.polygons.into_iter().map(outline).collect()))
}

/// Writes the plots on the map of a date, and gives the path of the file.
///
/// # Errors
/// Where it cannot be written.
pub(super) fn write(
    plots: &[Outline],
    map: &DateMap,
    placement: &Placement,
    results: &Path,
    force: bool,
) -> Result<PathBuf, Error> {
    let name = Path::new(FOLDER).join(format!("{}.geojson", map.date));
    let work = record::temporary(results)?;
    output::make_folder(&work.path().join(FOLDER))?;
    let invert =
        |ring: &Vec<[f64; 2]>| ring.iter().map(|&at| placement.transform.invert(at)).collect();
    let on_map = plots
        .iter()
        .map(|plot| Outline { rings: plot.rings.iter().map(invert).collect(), ..plot.clone() });
    let on_map: Vec<Outline> = on_map.collect();
    polygons::write(&work.path().join(&name), true, &on_map, Some(map.place.crs))?;
    record::publish(work.path(), results, force)?;
    Ok(results.join(name))
}

/// Removes the plots of dates that the season has no more.
///
/// # Errors
/// Where one cannot be removed.
pub(super) fn withdraw(outcome: &SeasonOutcome, results: &Path) -> Result<(), Error> {
    let dates: Vec<&str> = match outcome.outlines_m.is_empty() {
        true => Vec::new(),
        false => outcome.flights.iter().map(|flight| flight.date.as_str()).collect(),
    };
    withdraw_others(&dates, results)
}

fn withdraw_others(dates: &[&str], results: &Path) -> Result<(), Error> {
    let entries = std::fs::read_dir(results.join(FOLDER)).into_iter().flatten().flatten();
    for name in entries.filter_map(|entry| entry.file_name().into_string().ok()) {
        let date = name.strip_suffix(".geojson");
        if date.is_some_and(|date| !dates.contains(&date)) {
            record::withdraw(results, &format!("{FOLDER}/{name}"))?;
        }
    }
    Ok(())
}

/// A path as seen from a folder, where both lie in one place; absolute otherwise.
pub(super) fn from(folder: &Path, path: &Path) -> PathBuf {
    let (Ok(folder), Ok(path)) = (folder.canonicalize(), path.canonicalize()) else {
        return path.to_owned();
    };
    let shared = folder.components().zip(path.components()).take_while(|(a, b)| a == b).count();
    if shared <= 1 {
        return path;
    }
    let up = folder.components().skip(shared).map(|_| std::path::Component::ParentDir);
    up.chain(path.components().skip(shared)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plots_of_dates_that_are_gone_go() {
        let results = tempfile::tempdir().unwrap();
        let work = tempfile::tempdir().unwrap();
        std::fs::create_dir(work.path().join(FOLDER)).unwrap();
        for name in ["2024-05-01", "2024-06-01"] {
            let path = work.path().join(FOLDER).join(name).with_extension("geojson");
            std::fs::write(path, name).unwrap();
        }
        record::publish(work.path(), results.path(), false).unwrap();
        let folder = results.path().join(FOLDER);
        std::fs::write(folder.join("mine.geojson"), "").unwrap();
        withdraw_others(&["2024-06-01"], results.path()).unwrap();
        let is_there = |name: &&str| folder.join(name).exists();
        let names = ["2024-05-01.geojson", "2024-06-01.geojson", "mine.geojson"];
        assert_eq!(names.iter().map(is_there).collect::<Vec<_>>(), [false, true, true]);
    }

    #[test]
    fn paths_are_seen_from_the_folder_of_the_flight() {
        let folder = tempfile::tempdir().unwrap();
        let (flight, plots) = (folder.path().join("a"), folder.path().join("season/plots"));
        std::fs::create_dir(&flight).unwrap();
        std::fs::create_dir_all(&plots).unwrap();
        std::fs::write(plots.join("x.geojson"), "").unwrap();
        let seen = from(&flight, &plots.join("x.geojson"));
        assert_eq!(seen, PathBuf::from("../season/plots/x.geojson"));
    }
}
