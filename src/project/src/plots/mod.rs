//! Traits of every plot: from polygons, from a grid that the rows give, or of the whole field.
//!
//! Written as a wide table (`traits.csv`), a tidy one (`traits_long.csv`: plot, trait, value, unit), polygons with
//! the traits (`traits.geojson`, `traits.gpkg`, `traits.parquet`), BrAPI answers (`*.brapi.json`), sections of MIAPPE (`miappe_*.csv`), and what each
//! trait is (`trait_dictionary.csv`). Plants and gaps come with the plot that they stand in (`plants.csv`, `gaps.csv`, and
//! both as `.gpkg` and `.parquet`). Layers have styles for QGIS beside them.

mod areas;
mod brapi;
mod colours;
mod crop_ontology;
mod heights;
mod indices;
pub mod layout;
mod miappe;
mod plants;
mod tables;
mod variable_ids;
mod write;

use super::{Project, Stage, Task, align::AlignOutcome, leaf_mask, locate::LocateOutcome, stage};
use indices::{Means, Measuring, Sums};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::Auto,
};
use rowgram_files::{polygons::Named, rasters};
use rowgram_optim::output::{FileError, name_of};
use rowgram_plants::phenotype::{
    plots::{Area, PlotIndex, SeenField},
    row_cover::RowCover,
    traits::{PlotTraits, Trait, traits_with},
};
use rowgram_raster::{mask::Thresholds, polygon::Polygon, spectral::Index, srgb::LightScale};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};
use tables::Tables;
use variable_ids::VariableIds;

rowgram_base::options! {
    /// Traits of plots. Without polygons and without both options below the whole field is one plot.
    pub struct PlotsOptions in "plots", together check, main [rows_per_plot, alley_m] {
        /// Number of rows of plants in a plot, where there are no polygons.
        pub rows_per_plot: Option<usize> = None, limits at_least(1.0), example "4";
        /// Minimum length of an alley between plots, where there are no polygons.
        pub alley_m: Option<f64> = None, limits POSITIVE, example "1.0";
        /// Spectral indices: names (ndvi, ndre, gndvi, savi, osavi, evi2, ci_green, ci_red_edge), formulas of bands, or both as
        /// name = formula. auto takes ndvi where the orthomosaic has a near-infrared band, and ndre where it has a red-edge band too.
        pub indices: Auto<Vec<String>> = Auto::Auto;
        /// Distance by which plots are measured further in than their outline, along the rows.
        pub inset_along_m: f64 = 0.0, limits NON_NEGATIVE;
        /// The same across the rows.
        pub inset_across_m: f64 = 0.0, limits NON_NEGATIVE;
        /// Rows of plants that are left out on either side of each plot.
        pub border_rows: usize = 0;
        /// Length from which a stretch of a row without leaf is a gap (row_gap_share).
        pub min_gap_m: f64 = 0.5, limits POSITIVE;
        /// What the linear light of a map of three bands is multiplied by before colours are measured: red, green, blue. A season
        /// sets it for each of its dates.
        pub light_gain: [f64; 3] = [1.0; 3], limits POSITIVE;
        /// What is added then, 1 at saturation.
        pub light_offset: [f64; 3] = [0.0; 3], limits between(-1.0, 1.0);
        /// Share of a plot that the map has to show for numbers of the whole plot (plants, leaves, volume); means and densities
        /// are those of what it shows.
        pub min_valid_share: f64 = 0.5, limits between(0.0, 1.0);
        /// Table with more of the plots (genotype, treatment): its column that has the names of the plots is found, all others
        /// become columns of the results.
        pub field_book: Option<PathBuf> = None, example "\"field_book.csv\"";
        /// Common name of the crop for BrAPI and MIAPPE. Traits of maize and sorghum have the identifiers of the Crop Ontology
        /// where it has them.
        pub crop: Option<String> = None, example "\"sorghum\"";
        /// Table with identifiers of traits for BrAPI, such as those of the Crop Ontology: columns trait and id.
        pub variable_ids: Option<PathBuf> = None, example "\"variables.csv\"";
    }
}

fn check(options: &PlotsOptions) -> Result<(), String> {
    options.named_indices()?;
    options.crop.as_deref().map_or(Ok(()), crop_ontology::check)?;
    match (options.rows_per_plot, options.alley_m) {
        (Some(_), None) => Err("alley_m is not set: expected it beside rows_per_plot".to_owned()),
        (None, Some(_)) => Err("rows_per_plot is not set: expected it beside alley_m".to_owned()),
        _ => Ok(()),
    }
}

/// Where plots come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlotSource {
    /// Polygons that somebody drew.
    Polygons,
    /// Groups of rows, cut at alleys.
    Rows,
    /// There is one plot: the whole field.
    WholeField,
}

rowgram_base::choices!(PlotSource: Polygons, Rows, WholeField);

/// Traits of the plots of a project.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlotsOutcome {
    /// Where the plots come from.
    pub source: PlotSource,
    /// The plots in the order of their source.
    pub plots: Vec<PlotTraits>,
    /// Plots that lie outside of the orthomosaic.
    pub outside: Vec<String>,
    /// Plots of which the orthomosaic shows a part only.
    #[serde(default)]
    pub partly_outside: Vec<String>,
    /// Plots of which it shows so little that numbers of the whole plot are left empty.
    #[serde(default)]
    pub mostly_unseen: Vec<String>,
    /// The spectral indices that were measured.
    #[serde(default)]
    pub indices: Vec<Index>,
}

impl PlotsOutcome {
    /// All traits of these plots, in the order of their columns.
    pub fn traits(&self) -> Vec<Trait> {
        traits_with(&self.indices)
    }
}

/// A plot, its polygon in pixels, its traits, and what its polygon says of it.
struct Plot {
    polygon: Polygon,
    traits: PlotTraits,
    attributes: Vec<(String, Value)>,
}

/// A plot of which the orthomosaic shows less than this is told.
const WHOLE: f64 = 0.99;

/// Measures the traits of the plots from what earlier stages found, and writes them.
///
/// # Errors
/// As [`stage::perform`]; plots none of which lies on the orthomosaic; an alley in metres where the orthomosaic has no
/// scale.
pub fn plots(
    project: &Project,
    options: &PlotsOptions,
    monitor: &mut dyn Monitor,
) -> Result<PlotsOutcome, Error> {
    stage::perform::<Plots>(project, options, monitor)
}

/// Polygons of the plots with their traits.
pub const POLYGONS: &str = "traits.geojson";

/// The stage.
pub struct Plots;

impl Task for Plots {
    type Options = PlotsOptions;
    type Outcome = PlotsOutcome;
    const STAGE: Stage = Stage::Plots;

    fn inputs(project: &Project, options: &PlotsOptions) -> Result<Vec<PathBuf>, Error> {
        let mut files = vec![project.mask()?];
        files.extend(project.orthomosaic().ok());
        files.extend(project.plots());
        files.extend(variable_ids_path(project, options));
        files.extend(options.field_book.as_ref().map(|path| project.root().join(path)));
        files.extend(project.finished(Stage::Segment, leaf_mask::VALID));
        let tables = Tables::of(project);
        let of_plants = [tables.plants, tables.gaps, tables.rows, tables.weeds];
        let others = [tables.leaves, tables.counts, tables.canopy];
        files.extend(of_plants.into_iter().chain(others).flatten());
        Ok(files)
    }

    fn context(project: &Project) -> String {
        let study = study(project);
        let key = project.config().project.plot_key.as_deref().unwrap_or_default();
        format!("{} {} {key}", study.name, study.time.unwrap_or_default())
    }

    fn work(
        project: &Project,
        options: &PlotsOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<PlotsOutcome, Error> {
        let (mask, place) = rasters::read_mask(&project.mask()?, &Thresholds::default())?;
        let picture = project.orthomosaic().ok().map(|path| project.open_picture(&path));
        let picture = picture.transpose()?;
        let formulas = match &picture {
            Some(picture) if picture.is_photo() => options.indices_of(&picture.roles()?)?,
            _ => Vec::new(),
        };
        let indices: Vec<Index> = formulas.iter().map(|(index, _)| index.clone()).collect();
        let all_traits = traits_with(&indices);
        let ids = variable_ids_path(project, options);
        let ids = ids.map(|path| VariableIds::read(&path, &all_traits));
        let ids = ids.transpose()?.unwrap_or_default();
        let tables = Tables::of(project);
        let valid = leaf_mask::valid_of_project(project)?;
        let valid = valid.filter(|valid| (valid.width, valid.height) == (mask.width, mask.height));
        let seen = SeenField {
            mask: &mask,
            valid: valid.as_ref(),
            min_valid_share: options.min_valid_share,
        };
        let gsd_m = place.and_then(|place| place.gsd_m());
        let mut field = tables.measurements(gsd_m)?;
        let rows_px = tables.rows_px()?;
        let min_gap_px = gsd_m.map(|gsd| options.min_gap_m / gsd);
        field.rows = RowCover::new(&mask, valid.as_ref(), &rows_px, min_gap_px);
        if has_closed(project) {
            // Where they are is a guess.
            (field.plants, field.gaps, field.weeds) = (None, None, None);
        }
        if options.leaves_borders_out() {
            // These are counts of the outlines as they were drawn.
            field.by_area = None;
        }
        let size = (mask.width, mask.height);
        let (source, areas) = areas::areas(project, options, &tables, (place, size), monitor)?;
        let areas = areas.unwrap_or_else(|| {
            let [u, v] = [mask.width as f64 - 0.5, mask.height as f64 - 0.5];
            let ring = vec![[-0.5, -0.5], [u, -0.5], [u, v], [-0.5, v]];
            vec![areas::named("field".to_owned(), Polygon { rings: vec![ring] })]
        });
        let polygons: Vec<&Polygon> = areas.iter().map(|area| &area.polygon).collect();
        let light = LightScale { gain: options.light_gain, offset: options.light_offset };
        let of_leaves = |picture| colours::of_leaves(picture, (&mask, light), &polygons);
        let colours = picture.as_ref().map(of_leaves);
        let colours = colours.transpose()?.flatten();
        let plants_px = field.plants.as_deref().unwrap_or_default();
        let means = match &picture {
            Some(source) => {
                let valid = valid.as_ref();
                Measuring { source, mask: &mask, valid, indices: &formulas, light }
                    .means(&polygons, plants_px)?
            }
            None => Means::default(),
        };
        let heights = match (&tables.canopy, place) {
            (Some(path), Some(place)) => {
                Some(heights::of_areas(path, place, areas.iter().map(|area| &area.polygon))?)
            }
            _ => None,
        };
        let mut outside = Vec::new();
        let (mut partly_outside, mut mostly_unseen, mut slivers, mut without_height) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let index = field.index();
        let plots: Vec<Plot> = areas
            .into_iter()
            .enumerate()
            .map(|(number, Named { name, polygon, attributes, .. })| {
                let colour = colours.as_ref().map(|sums| &sums[number]);
                let canopy = heights.as_ref().and_then(|heights| heights[number]);
                let is_field = source == PlotSource::WholeField;
                let area = Area { name: &name, polygon: &polygon, is_field };
                let of_plot = means.plots.get(number).into_iter().flatten();
                let spectral: Vec<PlotIndex<'_>> = (indices.iter().zip(of_plot))
                    .map(|(index, Sums { ground, leaf })| PlotIndex {
                        name: &index.name,
                        ground,
                        leaf,
                    })
                    .collect();
                let (traits, shown) = index.traits(area, seen, colour, canopy, &spectral);
                let area_m2 = canopy.and_then(|canopy| canopy.area_m2).unwrap_or(0.0);
                let least_m2 = options.min_valid_share * traits.area_m2.unwrap_or(0.0);
                if heights.is_some() && shown > 0 && (canopy.is_none() || area_m2 < least_m2) {
                    without_height.push(name.clone());
                }
                let share = traits.valid_share;
                if shown == 0 && share.is_none() && is_on(&polygon, size) {
                    slivers.push(name);
                } else if shown == 0 {
                    outside.push(name);
                } else if share.is_some_and(|share| share < options.min_valid_share) {
                    mostly_unseen.push(format!("{name} ({:.0} %)", 100.0 * share.unwrap_or(0.0)));
                } else if source == PlotSource::Polygons && share.is_some_and(|share| share < WHOLE)
                {
                    partly_outside.push(name);
                }
                Plot { polygon, traits, attributes }
            })
            .collect();
        let path = project.plots();
        if let Some(path) = &path
            && !outside.is_empty()
            && outside.len() == plots.len()
        {
            let message =
                "the orthomosaic shows nothing of any of its plots: is it of another field?";
            return Err(FileError::malformed(path, None, message).into());
        }
        let subject = path.as_deref().map_or("plots".to_owned(), name_of);
        for (code, names, what, remedy) in [
            (
                "plots-narrow",
                &slivers,
                "hold no middle of a pixel, being narrower than one, and have no traits",
                Some("draw them as areas; the leftovers of an overlay can go"),
            ),
            (
                "plots-without-heights",
                &without_height,
                "have no heights, or only in a small part of them: the surface or the ground below it does not reach so far",
                None,
            ),
            ("plots-outside", &outside, "lie outside of the orthomosaic and have no traits", None),
            (
                "plots-partly-outside",
                &partly_outside,
                "are shown only in part by the orthomosaic, and their traits are of that part",
                None,
            ),
        ] {
            if !names.is_empty() {
                let (some, all, names) = (names.len(), plots.len(), names.join(", "));
                let message = format!("{some} of {all} plots {what}: {names}");
                let found = Diagnostic::warning(code, &subject, message);
                let remedy = remedy.map(str::to_owned);
                monitor.diagnostic(&Diagnostic { remedy, ..found });
            }
        }
        if !mostly_unseen.is_empty() {
            let message = format!(
                "the orthomosaic shows less than {:.0} % ([plots] min_valid_share) of {} of {} plots; numbers of the whole plot \
                 are left empty: {}",
                100.0 * options.min_valid_share,
                mostly_unseen.len(),
                plots.len(),
                mostly_unseen.join(", ")
            );
            monitor.diagnostic(&Diagnostic::warning("plots-mostly-unseen", "plots", message));
        }
        write::traits(&plots, &all_traits, place, folder, monitor)?;
        let study = brapi::Study { ids, crop: options.crop.clone(), ..study(project) };
        brapi::write(&plots, &all_traits, &study, folder)?;
        miappe::write(&plots, &all_traits, &study, folder)?;
        plants::write(&tables, &plots, (&indices, &means.plants), place, folder)?;
        let plots = plots.into_iter().map(|plot| plot.traits).collect();
        Ok(PlotsOutcome { source, plots, outside, partly_outside, mostly_unseen, indices })
    }
}

/// Whether the box around a polygon meets the raster.
pub(super) fn is_on(polygon: &Polygon, (width, height): (usize, usize)) -> bool {
    let size = [width as f64, height as f64];
    polygon.bounds().is_some_and(|[low, high]| {
        (0..2).all(|axis| high[axis] > -0.5 && low[axis] < size[axis] - 0.5)
    })
}

/// The study. Its name is not the folder's: a project that moves keeps its bytes.
fn study(project: &Project) -> brapi::Study {
    let name = project.config().project.name.clone().unwrap_or_else(|| "field".to_owned());
    let align = project.records().read(Stage::Align);
    let outcome =
        align.and_then(|record| serde_json::from_value::<AlignOutcome>(record.outcome).ok());
    let time = outcome.and_then(|outcome| outcome.flight.first_photo_time);
    let time = time.or_else(|| project.date().map(str::to_owned));
    brapi::Study { name, time, ..brapi::Study::default() }
}

fn variable_ids_path(project: &Project, options: &PlotsOptions) -> Option<PathBuf> {
    options.variable_ids.as_ref().map(|path| project.root().join(path))
}

/// Whether the canopy has closed, so that nothing told its plants apart, and nobody told how many there are.
fn has_closed(project: &Project) -> bool {
    if project.config().locate.plants != Auto::Auto {
        return false;
    }
    let record = project.records().read(Stage::Locate);
    let outcome =
        record.and_then(|record| serde_json::from_value::<LocateOutcome>(record.outcome).ok());
    outcome.and_then(|outcome| outcome.stand).is_some_and(|stand| stand.has_closed())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::options::Options;

    #[test]
    fn the_day_is_that_of_the_season_where_photos_do_not_say_it() {
        let folder = tempfile::tempdir().unwrap();
        let project = Project::open(folder.path()).unwrap();
        assert_eq!(study(&project).time, None);
        assert_eq!(study(&project.on("2024-06-01")).time.as_deref(), Some("2024-06-01"));
    }

    #[test]
    fn rows_and_alley_belong_together() {
        let with = |text: &str| PlotsOptions::default().with(&text.parse().unwrap()).unwrap();
        assert!(with("rows_per_plot = 4\nalley_m = 1.0").validate().is_ok());
        assert!(with("").validate().is_ok());
        let error = with("rows_per_plot = 4").validate().unwrap_err();
        assert!(error.contains("alley_m is not set"), "{error}");
        let error = with("alley_m = 1").validate().unwrap_err();
        assert!(error.contains("rows_per_plot is not set"), "{error}");
    }
}
