//! Number of leaves from the area that they cover.

use super::{
    Project, Stage, Task, layers,
    leaf_mask::{self, LeafMask},
    stage,
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::Auto,
};
use rowgram_files::{
    leaf_counts,
    polygons::{self, Named},
};
use rowgram_optim::output::{FileError, name_of};
use rowgram_plants::phenotype::leaf_count::{Calibration, LeafCount, Region, squares};
use rowgram_raster::{
    Mask,
    georeference::{CrsKind, Georeference},
    polygon::Polygon,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

rowgram_base::options! {
    /// Number of leaves from the area that they cover.
    pub struct LeafCountOptions in "leaf_count", main [rho_px] {
        /// Leaf pixels per leaf; from the regions counted by hand where not set. Without both, leaves are not counted by area.
        pub rho_px: Option<f64> = None, limits POSITIVE, example "120.0";
        /// Side of the squares whose variation gives the interval where there are fewer than three counted regions.
        pub square_px: usize = 64, limits at_least(1.0);
        /// Seed of the bootstrap of the interval.
        pub seed: u64 = 0;
    }
}

/// Leaves of one area.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlotLeafCount {
    /// Name of the plot; `whole` for all of the raster.
    pub plot: String,
    /// Its leaves.
    #[serde(flatten)]
    pub count: LeafCount,
}

/// Leaves by area in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeafCountOutcome {
    /// Leaf pixels per leaf.
    pub rho_px: f64,
    /// Whether the raster has a place in a mapping frame, so that a leaf has the same area everywhere.
    pub is_orthorectified: bool,
    /// The whole raster, then the plots.
    pub counts: Vec<PlotLeafCount>,
}

/// Counts the leaves of the field and of its plots by area: `leaf-count/counts.csv`.
///
/// # Errors
/// [`Error::NothingToDo`] without a leaf mask, or where nobody says how large a leaf is; as [`stage::perform`].
pub fn leaf_count(
    project: &Project,
    options: &LeafCountOptions,
    monitor: &mut dyn Monitor,
) -> Result<LeafCountOutcome, Error> {
    stage::perform::<LeafCountStage>(project, options, monitor)
}

/// The stage.
pub struct LeafCountStage;

impl Task for LeafCountStage {
    type Options = LeafCountOptions;
    type Outcome = LeafCountOutcome;
    const STAGE: Stage = Stage::LeafCount;

    fn inputs(project: &Project, options: &LeafCountOptions) -> Result<Vec<PathBuf>, Error> {
        let mut files = vec![project.mask()?];
        match (options.rho_px, project.regions()) {
            (Some(_), _) => {}
            (None, Some(regions)) => files.push(regions),
            (None, None) => {
                return Err(Error::NothingToDo(
                    "no leaves were counted by hand: give regions.geojson or [leaf_count] rho_px"
                        .to_owned(),
                ));
            }
        }
        files.extend(project.finished(Stage::Segment, leaf_mask::VALID));
        files.extend(project.plots());
        Ok(files)
    }

    fn context(project: &Project) -> String {
        project.config().project.plot_key.clone().unwrap_or_default()
    }

    fn work(
        project: &Project,
        options: &LeafCountOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<LeafCountOutcome, Error> {
        let image = project.mask()?;
        let (source, mut leaf) = leaf_mask::read_any_leaf_mask(&image, Auto::Auto, monitor)?;
        let is_of_mask =
            |valid: &Mask| (valid.width, valid.height) == (leaf.mask.width, leaf.mask.height);
        if let Some(valid) = leaf_mask::valid_of_project(project)?.filter(is_of_mask) {
            leaf.valid = Some(valid);
        }
        let areas = Areas {
            regions: project.regions().filter(|_| options.rho_px.is_none()),
            plots: project.plots(),
            plot_key: project.config().project.plot_key.clone(),
        };
        let subject = super::record::relative(project.root(), &image).display().to_string();
        let outcome =
            count_leaves(&leaf, source.georeference(), &areas, options, &subject, monitor)?;
        outcome.write(&folder.join("counts.csv"), true)?;
        Ok(outcome)
    }
}

impl LeafCountOutcome {
    /// Writes the counts as a table, [`leaf_counts::write`].
    ///
    /// # Errors
    /// Where it cannot be written.
    pub fn write(&self, path: &Path, force: bool) -> Result<(), FileError> {
        let rows: Vec<(&str, &LeafCount)> =
            self.counts.iter().map(|line| (line.plot.as_str(), &line.count)).collect();
        leaf_counts::write(path, force, &rows)
    }
}

/// Name of the line for all of the raster.
const WHOLE: &str = "whole";

/// Files with the areas that are counted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Areas {
    /// Polygons with a property `leaves`, the leaves that somebody counted there.
    pub regions: Option<PathBuf>,
    /// Polygons of the plots.
    pub plots: Option<PathBuf>,
    /// The property of the plots that has their names; found where it is not given.
    pub plot_key: Option<String>,
}

/// Counts the leaves of a mask and of its plots. `subject` names the mask in diagnostics.
///
/// # Errors
/// Files of polygons that cannot be read; no size of a leaf, given or from regions.
pub fn count_leaves(
    leaf: &LeafMask,
    georeference: Option<Georeference>,
    areas: &Areas,
    options: &LeafCountOptions,
    subject: &str,
    monitor: &mut dyn Monitor,
) -> Result<LeafCountOutcome, Error> {
    let mask = &leaf.mask;
    let is_orthorectified = georeference.is_some_and(|place| place.crs.kind != CrsKind::Unknown);
    if !is_orthorectified {
        let message = "it has no coordinate reference system and may not be orthorectified; where the scale \
                       varies, so does the area of a leaf, and the count is biased";
        monitor.diagnostic(&Diagnostic::warning("not-orthorectified", subject, message));
    }
    let calibration = match (options.rho_px, &areas.regions) {
        (Some(rho), _) => Calibration::given(rho).map_err(Error::Argument)?,
        (None, Some(path)) => {
            let regions = regions(path, leaf, georeference.as_ref(), monitor)?;
            Calibration::from_regions(&regions)
                .map_err(|message| FileError::malformed(path, None, message))?
        }
        (None, None) => {
            let message = "expected regions with counted leaves (--regions), or --rho-px";
            return Err(Error::Argument(message.to_owned()));
        }
    };
    let [width, height] = [mask.width as f64, mask.height as f64];
    let whole = vec![[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]];
    let count = |plot: String, area: &Polygon| PlotLeafCount {
        plot,
        count: calibration.count(&squares(mask, area, options.square_px), options.seed),
    };
    let mut counts = vec![count(WHOLE.to_owned(), &Polygon { rings: vec![whole] })];
    if let Some(path) = &areas.plots {
        let size = Some((mask.width, mask.height));
        let key = areas.plot_key.as_deref();
        let drawn = polygons::Drawn { place: georeference.as_ref(), size, key };
        let plots = polygons::read_layer(path, drawn)?;
        layers::say(path, &plots.notes, monitor);
        layers::say_overlaps(path, &plots.polygons, (mask.width, mask.height), monitor);
        for plot in plots.polygons {
            let name = match plot.name.as_str() {
                WHOLE => {
                    let message = "a plot has the name of the line for all of the raster; its line is called \"plot whole\"";
                    monitor.diagnostic(&Diagnostic::info("plot-renamed", WHOLE, message));
                    "plot whole".to_owned()
                }
                _ => plot.name,
            };
            counts.push(count(name, &plot.polygon));
        }
    }
    Ok(LeafCountOutcome { rho_px: calibration.rho, is_orthorectified, counts })
}

/// What is wrong with a region whose leaves nobody counted.
pub(super) fn without_leaves(name: &str) -> String {
    format!("region {name} lacks the property leaves, its counted leaves")
}

/// A region of which the raster shows less than this is doubtful: leaves were counted in all of it. Pixels at its edge may differ by rounding.
const WHOLE_REGION: f64 = 0.99;

/// Leaf pixels and counted leaves of the regions. Names those that give a wrong size of a leaf.
fn regions(
    path: &Path,
    leaf: &LeafMask,
    georeference: Option<&Georeference>,
    monitor: &mut dyn Monitor,
) -> Result<Vec<Region>, Error> {
    let mask = &leaf.mask;
    let size = (mask.width, mask.height);
    let all = polygons::read(path, georeference)?;
    let mut found = Vec::with_capacity(all.len());
    let (mut unseen, mut bare) = (Vec::new(), Vec::new());
    for Named { name, polygon, leaves, .. } in &all {
        let leaves =
            leaves.ok_or_else(|| FileError::malformed(path, None, without_leaves(name)))?;
        let runs = polygon.runs(mask.width, mask.height);
        if runs.is_empty() {
            let message = format!("region {name} holds no pixel of the raster");
            return Err(FileError::malformed(path, None, message).into());
        }
        let shown: usize = runs
            .iter()
            .map(|(v, run)| match &leaf.valid {
                Some(valid) => {
                    valid.row(*v)[run.clone()].iter().filter(|&&shown| shown != 0).count()
                }
                None => run.len(),
            })
            .sum();
        if (shown as f64) < WHOLE_REGION * polygon.pixels() as f64 {
            unseen.push(name.as_str());
        }
        let pixels: u64 = squares(mask, polygon, mask.width.max(1)).iter().sum();
        if leaves > 0.0 && pixels == 0 {
            bare.push(name.as_str());
        }
        found.push(Region { pixels: pixels as f64, leaves });
    }
    let overlaps = layers::pair_names(&all, &layers::overlapping(&all, size));
    for (what, names) in [
        (
            "the raster shows only a part of these regions, whose leaves were counted in whole",
            unseen.join(", "),
        ),
        ("these regions have counted leaves and no leaf pixel", bare.join(", ")),
        ("these regions lie over each other", overlaps),
    ] {
        if !names.is_empty() {
            let message = format!("{what}, so the size of a leaf is wrong: {names}");
            let found = Diagnostic::warning("regions-doubtful", name_of(path), message);
            let remedy =
                "draw regions whole on the raster and beside each other, or leave them out";
            monitor.diagnostic(&found.with_remedy(remedy));
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::monitor::Collector;

    #[test]
    fn regions_that_give_a_wrong_size_of_a_leaf_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("regions.geojson");
        let region = |name: &str, u: f64, leaves: f64| {
            let (right, ring) = (u + 10.0, |u: f64, v: f64| serde_json::json!([u, v]));
            let ring =
                [ring(u, 0.0), ring(right, 0.0), ring(right, 9.0), ring(u, 9.0), ring(u, 0.0)];
            serde_json::json!({
                "type": "Feature",
                "properties": {"name": name, "leaves": leaves},
                "geometry": {"type": "Polygon", "coordinates": [ring]},
            })
        };
        let told = |regions: &[serde_json::Value]| {
            let all = serde_json::json!({"type": "FeatureCollection", "features": regions});
            std::fs::write(&path, all.to_string()).unwrap();
            let leaf = LeafMask {
                mask: Mask::from_fn(50, 10, |u, _| u < 20),
                posterior: None,
                valid: Some(Mask::from_fn(50, 10, |u, _| u != 25)),
                vegetation: None,
                hsv: None,
            };
            let mut collector = Collector::default();
            super::regions(&path, &leaf, None, &mut collector).unwrap();
            collector.diagnostics.into_iter().map(|of| of.message).collect::<Vec<_>>()
        };
        assert_eq!(
            told(&[region("A", 0.0, 5.0), region("B", 10.0, 5.0), region("C", 30.0, 0.0)]),
            [""; 0]
        );
        let all = told(&[
            region("A", 0.0, 5.0),
            region("B", 5.0, 5.0),
            region("C", 20.0, 0.0),
            region("D", 30.0, 3.0),
            region("E", 45.0, 0.0),
        ]);
        assert!(all[0].contains("only a part") && all[0].ends_with(": C, E"), "{all:?}");
        assert!(all[1].contains("no leaf pixel") && all[1].ends_with(": D"), "{all:?}");
        assert!(all[2].contains("over each other") && all[2].ends_with(": A and B"), "{all:?}");
    }
}
