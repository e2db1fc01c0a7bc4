//! Polygons of a project: its plots and regions, over its map.

use super::Project;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::polygons::{self, Drawn, Layer, Named};
use rowgram_optim::output::{FileError, name_of};
use rowgram_raster::georeference::Georeference;
use std::path::Path;

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
    say(path, &layer.notes, monitor);
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

/// Says what was chosen and left out in a file of polygons.
pub(super) fn say(path: &Path, notes: &[String], monitor: &mut dyn Monitor) {
    let subject = name_of(path);
    for note in notes {
        let found = match note.ends_with("left out") {
            true => Diagnostic::warning("polygons-left-out", &subject, note),
            false => Diagnostic::info("polygons-named", &subject, note),
        };
        monitor.diagnostic(&found);
    }
}
