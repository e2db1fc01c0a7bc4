//! Polygons of a project: its plots and regions, over its map.

use super::Project;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::polygons::{self, Drawn, Layer, Named};
use rowgram_optim::output::{self, FileError, name_of};
use rowgram_raster::{georeference::Georeference, polygon::Polygon};
use std::{collections::BTreeMap, path::Path};

/// The plots of a file over a raster, and what there is to say of them.
///
/// # Errors
/// As [`polygons::read_layer`]; plots that all lie elsewhere.
pub(super) fn plots(
    project: &Project,
    path: &Path,
    place: Option<&Georeference>,
    size: (usize, usize),
    monitor: &mut dyn Monitor,
) -> Result<Vec<Named>, Error> {
    let layer = layer(project, path, place, Some(size))?;
    say_unused(project, path, monitor);
    say(path, &layer.notes, monitor);
    say_overlaps(path, &layer.polygons, size, monitor);
    Ok(layer.polygons)
}

/// The polygons of a file over a raster, named as the settings say.
///
/// # Errors
/// As [`polygons::read_layer`].
pub(super) fn layer(
    project: &Project,
    path: &Path,
    place: Option<&Georeference>,
    size: Option<(usize, usize)>,
) -> Result<Layer, FileError> {
    // The setting is for plots; regions have names of their own.
    let is_of_plots = project.plots().is_some_and(|plots| plots == path);
    let key = project.config().project.plot_key.as_deref().filter(|_| is_of_plots);
    polygons::read_layer(path, Drawn { place, size, key })
}

/// Says which files of the same polygons are not used where nobody named one.
pub(super) fn say_unused(project: &Project, path: &Path, monitor: &mut dyn Monitor) {
    let settings = &project.config().project;
    let mut named = [&settings.plots, &settings.regions].into_iter().flatten();
    let stem = path.file_stem().map(|stem| stem.to_string_lossy()).unwrap_or_default();
    let mut others = polygons::find(output::folder_of(path), &stem, &polygons::ENDINGS);
    others.retain(|other| other != path);
    if others.is_empty() || named.any(|of| project.root().join(of) == path) {
        return;
    }
    let others: Vec<String> = others.iter().map(|path| name_of(path)).collect();
    let message = format!("polygons are those of {}; this file is not used", name_of(path));
    let found = Diagnostic::info("polygons-file-unused", others.join(", "), message);
    monitor.diagnostic(&found.with_remedy("remove one, or name it: [project] plots or regions"));
}

/// Files of plots in formats that are not read, where there are no others.
pub(super) fn unread_plots(project: &Project) -> Option<Diagnostic> {
    let unread = polygons::find(project.root(), "plots", &polygons::UNREAD_ENDINGS);
    let first = unread.first().filter(|_| project.plots().is_none())?;
    let message = "not read: traits are of the whole field";
    let found = Diagnostic::warning("plots-missing", name_of(first), message);
    Some(found.with_remedy("save it as plots.geojson, .gpkg or .shp"))
}

/// Says what was chosen and left out in a file of polygons.
pub(super) fn say(path: &Path, notes: &[String], monitor: &mut dyn Monitor) {
    let subject = name_of(path);
    for note in notes {
        let found = if note.ends_with("left out") {
            Diagnostic::warning("polygons-left-out", &subject, note)
        } else if note.starts_with("polygons have no") {
            Diagnostic::warning("polygons-unnamed", &subject, note)
        } else {
            Diagnostic::info("polygons-named", &subject, note)
        };
        monitor.diagnostic(&found);
    }
}

/// Pairs that a message names, so that it stays readable.
const NAMED_PAIRS: usize = 10;

/// Names plots that lie over each other.
pub(super) fn say_overlaps(
    path: &Path,
    plots: &[Named],
    size: (usize, usize),
    monitor: &mut dyn Monitor,
) {
    let pairs = overlapping(plots, size);
    if pairs.is_empty() {
        return;
    }
    let message = format!(
        "plots lie over each other, so that what is in both counts in both: {}",
        pair_names(plots, &pairs)
    );
    let found = Diagnostic::warning("plots-overlapping", name_of(path), message);
    monitor.diagnostic(&found.with_remedy("draw them beside each other, or remove the copies"));
}

/// Names of pairs of polygons, of many the first ones.
pub(super) fn pair_names(of: &[Named], pairs: &[[usize; 2]]) -> String {
    let name = |[a, b]: &[usize; 2]| format!("{} and {}", of[*a].name, of[*b].name);
    let named: Vec<String> = pairs.iter().take(NAMED_PAIRS).map(name).collect();
    let rest = pairs.len() - named.len();
    let more = if rest > 0 { format!(", and {rest} more pairs") } else { String::new() };
    named.join(", ") + &more
}

/// The pairs of polygons that lie over each other.
pub(super) fn overlapping(of: &[Named], size: (usize, usize)) -> Vec<[usize; 2]> {
    let boxes: Vec<_> = of.iter().map(|of| of.polygon.bounds()).collect();
    let meet = |a: usize, b: usize| {
        boxes[a].zip(boxes[b]).is_some_and(|([a_low, a_high], [b_low, b_high])| {
            (0..2).all(|k| a_low[k] < b_high[k] && b_low[k] < a_high[k])
        })
    };
    let pairs = (0..of.len()).flat_map(|a| (a + 1..of.len()).map(move |b| [a, b]));
    pairs.filter(|&[a, b]| meet(a, b) && overlap(&of[a].polygon, &of[b].polygon, size)).collect()
}

/// Whether two polygons are of the same plants on a raster: they share more pixels than neighbours along a common side do.
pub(super) fn overlap(a: &Polygon, b: &Polygon, (width, height): (usize, usize)) -> bool {
    // Sides that are drawn half a pixel over each other share less of a plot of 20 pixels. Assumed, not compared with others.
    const SHARE: f64 = 0.05;
    let (a, b) = (a.runs(width, height), b.runs(width, height));
    let pixels = |runs: &[(usize, std::ops::Range<usize>)]| -> usize {
        runs.iter().map(|(_, run)| run.len()).sum()
    };
    let smaller = pixels(&a).min(pixels(&b));
    let mut by_row: BTreeMap<usize, Vec<&std::ops::Range<usize>>> = BTreeMap::new();
    b.iter().for_each(|(v, run)| by_row.entry(*v).or_default().push(run));
    let shared: usize = a
        .iter()
        .flat_map(|(v, run)| by_row.get(v).into_iter().flatten().map(move |other| (run, other)))
        .map(|(run, other)| run.end.min(other.end).saturating_sub(run.start.max(other.start)))
        .sum();
    shared as f64 > SHARE * smaller as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(left: f64, side: f64) -> Polygon {
        let right = left + side;
        Polygon { rings: vec![vec![[left, 0.0], [right, 0.0], [right, side], [left, side]]] }
    }

    #[test]
    fn a_common_side_is_no_overlap() {
        let size = (100, 100);
        assert!(overlap(&square(0.0, 20.0), &square(0.0, 20.0), size));
        assert!(overlap(&square(5.0, 4.0), &square(0.0, 20.0), size), "a part of the plot");
        assert!(!overlap(&square(0.0, 20.0), &square(20.0, 20.0), size));
        assert!(!overlap(&square(0.0, 20.0), &square(19.5, 20.0), size), "drawn a little off");
    }

    #[test]
    fn plots_that_lie_over_each_other_are_named() {
        let plot = |name: &str, left: f64| Named {
            name: name.to_owned(),
            polygon: square(left, 20.0),
            leaves: None,
            attributes: Vec::new(),
        };
        let plots = [plot("A", 0.0), plot("B", 20.0), plot("C", 30.0), plot("D", 0.0)];
        let pairs = overlapping(&plots, (100, 100));
        assert_eq!(pair_names(&plots, &pairs), "A and D, B and C");
    }
}
