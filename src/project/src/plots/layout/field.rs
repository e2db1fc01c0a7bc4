//! The map that a layout is compared with: where it shows anything, and the picture of plots over it.

use super::{Laid, few};
use crate::{Project, figures::View};
use image::Rgb;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::rasters::Source;
use rowgram_optim::output::FileError;
use rowgram_plants::problems::plot_layout::Placement;
use rowgram_raster::{georeference::Georeference, overlay, window};
use std::path::Path;

/// Cells in which it is remembered where the map shows anything, metres.
const CELL_M: f64 = 0.25;
/// Rows of the map that are read at a time.
const BAND_ROWS: usize = 512;
/// Plots before and after their refinement, and rows (Okabe and Ito).
const BEFORE: Rgb<u8> = Rgb([86, 180, 233]);
const AFTER: Rgb<u8> = Rgb([240, 228, 66]);
const ROWS: Rgb<u8> = Rgb([213, 94, 0]);

/// The orthomosaic of a project, else its leaf mask.
pub(super) struct Field {
    source: Source,
    /// Where it lies.
    pub(super) place: Georeference,
    /// Where the raster lies whose pixels the places of plants are: the leaf mask.
    pub(super) place_of_plants: Georeference,
    /// Pixels of a cell.
    step: usize,
    cells: [usize; 2],
    visible: Vec<bool>,
}

impl Field {
    /// That of a project; `None` where there is none yet.
    ///
    /// # Errors
    /// A map that cannot be read or has no place.
    pub(super) fn of(project: &Project) -> Result<Option<Field>, Error> {
        let Ok(path) = project.orthomosaic().or_else(|_| project.mask()) else { return Ok(None) };
        let source = project.open_picture(&path)?;
        let place = source.georeference().ok_or_else(|| {
            FileError::malformed(
                &path,
                None,
                "it is not georeferenced, so plots have no place on it",
            )
        })?;
        let mask = project.mask().ok().map(|path| Source::open(&path)).transpose()?;
        let place_of_plants = mask.and_then(|mask| mask.georeference()).unwrap_or(place);
        let (width, height) = source.size();
        let step = place.gsd_m().map_or(1.0, |gsd_m| CELL_M / gsd_m).round().max(1.0) as usize;
        let cells = [width.div_ceil(step), height.div_ceil(step)];
        let mut visible = vec![true; cells[0] * cells[1]];
        if source.is_photo() {
            for band in window::bands(height, BAND_ROWS, 0) {
                let first = band.rows.start;
                let (_, gaps) = source.rgb_and_gaps(band.rows.clone())?;
                let Some(gaps) = gaps else { break };
                for v in band.rows.filter(|v| v.is_multiple_of(step)) {
                    let row = &gaps[(v - first) * width..][..width];
                    for (cell, gap) in row.iter().step_by(step).enumerate() {
                        visible[v / step * cells[0] + cell] = !gap;
                    }
                }
            }
        }
        Ok(Some(Field { source, place, place_of_plants, step, cells, visible }))
    }

    /// Whether the map shows anything at a position.
    pub(super) fn is_visible(&self, at: [f64; 2]) -> bool {
        let Some(pixel) = self.place.pixel(at) else { return false };
        let (width, height) = self.source.size();
        let [u, v] = pixel.map(f64::round);
        let is_inside = u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64;
        is_inside && self.visible[v as usize / self.step * self.cells[0] + u as usize / self.step]
    }

    /// Says which plots the map does not show.
    pub(super) fn tell_outside(&self, laid: &Laid, metres: f64, monitor: &mut dyn Monitor) {
        let is_shown = |at: &[f64; 2]| self.is_visible(laid.placement.map(*at).map(|x| x / metres));
        let plots = laid.plan.plots.iter();
        let outside: Vec<&str> = plots
            .filter(|plot| !plot.rings.iter().flatten().all(is_shown))
            .map(|plot| plot.name.as_str())
            .collect();
        if outside.is_empty() {
            return;
        }
        let message = format!(
            "{} of {} plots reach beyond what the orthomosaic shows: {}",
            outside.len(),
            laid.plan.plots.len(),
            few(&outside)
        );
        monitor.diagnostic(&Diagnostic::warning("layout-outside", "layout", message));
    }

    /// Draws the plots before and after, and their rows, over the map.
    ///
    /// # Errors
    /// Where it cannot be written.
    pub(super) fn draw(
        &self,
        laid: &Laid,
        before: &Placement,
        metres: f64,
        folder: &Path,
        force: bool,
    ) -> Result<(), Error> {
        let mut view = View::of(&self.source)?;
        let pixel = |at_m: [f64; 2]| self.place.pixel(at_m.map(|x| x / metres));
        let step = view.step as f64;
        let at = |at_m: [f64; 2]| pixel(at_m).map(|at| at.map(|x| x / step));
        let line = |points: Vec<[f64; 2]>| -> Vec<[f64; 2]> {
            points.into_iter().filter_map(at).collect()
        };
        let mut draw = |placement: &Placement, colour, width| {
            for ring in laid.plan.plots.iter().flat_map(|plot| plot.on_map(placement)) {
                let closed = ring.iter().chain(ring.first()).copied().collect();
                overlay::draw_line(&mut view.picture, &line(closed), colour, width);
            }
        };
        if *before != laid.placement {
            draw(before, BEFORE, 1);
        }
        draw(&laid.placement, AFTER, 3);
        for row in laid.plan.plots.iter().flat_map(|plot| &plot.rows) {
            let [from, to] = row.ends;
            let along = (0..=8).map(|k| {
                let s = from[0] + f64::from(k) / 8.0 * (to[0] - from[0]);
                laid.placement.map([s, row.across(s)])
            });
            overlay::draw_line(&mut view.picture, &line(along.collect()), ROWS, 1);
        }
        Ok(view.write(folder, "layout.png", force)?)
    }
}
