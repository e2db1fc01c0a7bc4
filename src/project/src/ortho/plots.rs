//! Plots that are to come from one photo each: which photos are assigned to cells of the mosaic.

use super::write::{OrthoFiles, Work};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{csv_table::CsvWriter, polygons};
use rowgram_optim::output::{self, name_of};
use rowgram_raster::{georeference::Georeference, polygon::Polygon};
use rowgram_survey::mapping::{View, assignment::Assignment, select::PhotoSelector};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Names of plots in a message.
const NAMED: usize = 5;

/// Which photos plots come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WholePlots {
    /// Plots that come from one photo.
    pub of_one_photo: usize,
    /// Plots that no photo shows as a whole.
    pub of_several: Vec<String>,
    /// A table: plot, photo, angle of view.
    pub table: PathBuf,
}

/// The table of plots beside an orthomosaic.
pub(super) fn table_path(orthophoto: &Path) -> PathBuf {
    let stem = orthophoto.file_stem().unwrap_or_default().to_string_lossy();
    orthophoto.with_file_name(format!("{stem}_plots.csv"))
}

impl Work<'_> {
    /// The photos that are assigned to cells of the mosaic, where the options ask for any.
    pub(super) fn assignment(
        &self,
        selector: &PhotoSelector<'_>,
        (grid, size): (Georeference, [usize; 2]),
        monitor: &mut dyn Monitor,
    ) -> Result<(Assignment, Option<WholePlots>), Error> {
        let Some(path) = &self.options.whole_plots else { return Ok(Default::default()) };
        let (assignment, found) = whole_plots(selector, path, (grid, size), self.files, monitor)?;
        Ok((assignment, Some(found)))
    }
}

fn whole_plots(
    selector: &PhotoSelector<'_>,
    path: &Path,
    (grid, size): (Georeference, [usize; 2]),
    files: &OrthoFiles<'_>,
    monitor: &mut dyn Monitor,
) -> Result<(Assignment, WholePlots), Error> {
    let plots = polygons::read(path, Some(&grid))?;
    let outlines: Vec<&Polygon> = plots.iter().map(|plot| &plot.polygon).collect();
    let (assignment, photos) = selector.whole_plots(size, &outlines);
    let table = table_path(files.mosaic);
    let view = |k: usize| -> &View { &selector.views()[k] };
    output::write(&table, files.force, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record(["plot", "photo", "view_angle_deg"])?;
        for (plot, photo) in plots.iter().zip(&photos) {
            let named = photo.map_or("", |of| &view(of.view).name);
            let angle = photo.map(|of| format!("{:.2}", of.angle_rad.to_degrees()));
            csv.write_record([plot.name.as_str(), named, &angle.unwrap_or_default()])?;
        }
        csv.flush()
    })?;
    let several = plots.iter().zip(&photos).filter(|(_, photo)| photo.is_none());
    let several: Vec<String> = several.map(|(plot, _)| plot.name.clone()).collect();
    let found = WholePlots {
        of_one_photo: plots.len() - several.len(),
        of_several: several,
        table: name_of(&table).into(),
    };
    if !found.of_several.is_empty() {
        let few = found.of_several.iter().take(NAMED).map(String::as_str).collect::<Vec<_>>();
        let more = if found.of_several.len() > NAMED { " ..." } else { "" };
        let message = format!(
            "no photo shows the whole of {} of {} plots ({}{more}); they are drawn from several, as everything else",
            found.of_several.len(),
            plots.len(),
            few.join(", ")
        );
        monitor.diagnostic(&Diagnostic::warning("plots-of-several-photos", name_of(path), message));
    }
    Ok((assignment, found))
}
