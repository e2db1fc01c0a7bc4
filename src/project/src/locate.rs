//! The place of every plant.

mod show;

use super::{
    Project, Stage, Task,
    figures::View,
    forecast,
    leaf_mask::{self, LeafMask},
    stage,
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{plants as table, rasters::Source};
use rowgram_optim::{
    descent::Descent,
    drive::{Drive, Limits},
};
use rowgram_plants::{
    phenotype::{
        locate::Setup,
        locator::{self, Descend, Descended, Found, Work},
        stand::{Doubt, NORMAL_95, Stand},
    },
    problems::plants::Proof,
};
use rowgram_raster::components;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

pub use rowgram_plants::phenotype::locator::{DescentOptions, LocateMethod, LocateOptions};

/// The plants of a field in numbers. Intervals are of 95 %.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LocateOutcome {
    /// How plants were located.
    pub method: LocateMethod,
    /// Plants.
    pub plants: usize,
    /// Leaf pixels.
    pub leaf_pixels: usize,
    /// Rows; 0 where none stand out.
    pub rows: usize,
    /// Ground sampling distance, metres per pixel, where it is known.
    pub gsd_m: Option<f64>,
    /// Direction of the rows, from the raster's `u` axis towards its `v` axis.
    pub heading_deg: Option<f64>,
    /// Distance between rows.
    pub row_spacing_px: Option<f64>,
    /// Distance between rows.
    pub row_spacing_m: Option<f64>,
    /// What only a descent knows.
    #[serde(flatten)]
    pub descent: Option<DescentOutcome>,
    /// What only the row model knows.
    #[serde(flatten)]
    pub stand: Option<StandOutcome>,
}

/// A descent in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DescentOutcome {
    /// Scale of the distances at the end.
    pub sigma_px: f64,
    /// Mean distance from a leaf pixel to its plant.
    pub mean_distance_px: f64,
    /// Plants that no leaf pixel belongs to.
    pub plants_without_pixels: usize,
    /// Objective at the start.
    pub initial_cost: f64,
    /// Objective at the end.
    pub final_cost: f64,
    /// Sweeps over all plants.
    pub sweeps: u64,
    /// Why it ended.
    pub stop: String,
    /// How far plants are from the optima of their convex problems, where that was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub certificate: Option<Proof>,
}

/// The stand in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StandOutcome {
    /// Interval of 95 % of the number of plants; just the number where it was given.
    pub plants_interval: [f64; 2],
    /// Distance of plants within their row.
    pub spacing_px: f64,
    /// Its interval.
    pub spacing_interval_px: [f64; 2],
    /// Distance of plants within their row.
    pub spacing_m: Option<f64>,
    /// Its interval.
    pub spacing_interval_m: Option<[f64; 2]>,
    /// Interval of the distance between rows.
    pub row_spacing_interval_px: Option<[f64; 2]>,
    /// Interval of the distance between rows.
    pub row_spacing_interval_m: Option<[f64; 2]>,
    /// Standard deviation of the spacing over the spacing.
    pub spacing_jitter: f64,
    /// Share of places without a plant.
    pub share_missing: f64,
    /// Share of gaps between two plants in one place.
    pub share_doubles: f64,
    /// Gaps in which plants seem to be missing.
    pub gaps: usize,
    /// Mean probability of a plant.
    pub mean_confidence: f64,
    /// Leaf pixels of one plant, where plants are told by their leaf mass.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plant_leaf_px: Option<f64>,
    /// Share of the leaf pixels in areas too small to be plants, where plants are told by their leaf mass.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unexplained_share: Option<f64>,
    /// Share of the leaf pixels that belong to plants between the rows, where plants are told by their leaf mass.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub between_rows_share: Option<f64>,
    /// Why what was found may be no plants; nothing where it is like the stand of a crop.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub doubts: Vec<Doubt>,
    /// Scale at the lower edge of the photo over that in the middle, less 1, where rows converge; distances are then those in the middle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub convergence: Option<f64>,
    /// Plants over the area of the rows.
    pub plants_per_hectare: Option<f64>,
    /// Its interval.
    pub plants_per_hectare_interval: Option<[f64; 2]>,
}

impl StandOutcome {
    /// Whether leaves have closed along the rows, so that nothing told plants apart.
    pub fn has_closed(&self) -> bool {
        self.doubts.contains(&Doubt::Closed)
    }

    fn new(stand: &Stand, gsd_m: Option<f64>) -> StandOutcome {
        let interval =
            |middle: f64, sigma: f64| [middle - NORMAL_95 * sigma, middle + NORMAL_95 * sigma];
        let spacing_px = stand.spacing.spacing;
        let spacing_interval_px = interval(spacing_px, stand.spacing_sigma_px);
        let row_spacing_interval_px = stand.row_spacing_px().map(|(px, sigma)| interval(px, sigma));
        let hectares = gsd_m.and_then(|gsd| Some(stand.area_px2()? * gsd * gsd / 1e4));
        let count = stand.plants.len() as f64;
        let confidence: f64 = stand.plants.iter().map(|plant| plant.confidence).sum();
        StandOutcome {
            plants_interval: stand.count_interval,
            spacing_px,
            spacing_interval_px,
            spacing_m: gsd_m.map(|gsd| gsd * spacing_px),
            spacing_interval_m: gsd_m.map(|gsd| spacing_interval_px.map(|px| px * gsd)),
            row_spacing_interval_px,
            row_spacing_interval_m: row_spacing_interval_px
                .zip(gsd_m)
                .map(|(interval, gsd)| interval.map(|px| px * gsd)),
            spacing_jitter: stand.spacing.jitter,
            share_missing: stand.spacing.missing,
            share_doubles: stand.spacing.doubles,
            gaps: stand.missing.len(),
            mean_confidence: confidence / count.max(1.0),
            plant_leaf_px: stand.leaf_mass.as_ref().map(|mass| mass.plant_px),
            unexplained_share: stand.leaf_mass.as_ref().map(|mass| mass.unexplained),
            between_rows_share: stand.between_rows.as_ref().map(|between| between.leaf_share),
            doubts: stand.doubts.clone(),
            convergence: stand.perspective.map(|perspective| perspective.convergence),
            plants_per_hectare: hectares.map(|area| count / area),
            plants_per_hectare_interval: hectares
                .map(|area| stand.count_interval.map(|count| count / area)),
        }
    }
}

/// Locates the plants of the leaf mask: `locate/plants.csv`, and with the row model `locate/gaps.csv`,
/// `locate/rows.csv` and, where rows tell weeds, `locate/weeds.csv`.
///
/// # Errors
/// [`Error::NothingToDo`] without a leaf mask; as [`locator::find`] and [`stage::perform`].
pub fn locate(
    project: &Project,
    options: &LocateOptions,
    monitor: &mut dyn Monitor,
) -> Result<LocateOutcome, Error> {
    stage::perform::<Locate>(project, options, monitor)
}

/// The stage.
pub struct Locate;

impl Task for Locate {
    type Options = LocateOptions;
    type Outcome = LocateOutcome;
    const STAGE: Stage = Stage::Locate;

    fn inputs(project: &Project, _: &LocateOptions) -> Result<Vec<PathBuf>, Error> {
        let more = [leaf_mask::POSTERIOR, leaf_mask::VALID]
            .into_iter()
            .filter_map(|name| project.finished(Stage::Segment, name));
        Ok(std::iter::once(project.mask()?).chain(more).collect())
    }

    fn work(
        project: &Project,
        options: &LocateOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<LocateOutcome, Error> {
        let image = project.mask()?;
        let subject = super::record::relative(project.root(), &image).display().to_string();
        let (source, leaf) = leaf_mask::of_project(project, monitor)?;
        let is_row_model = options.method == LocateMethod::RowModel;
        let of_rows = |name: &str| is_row_model.then(|| folder.join(name));
        let [gaps, rows, weeds] = ["gaps.csv", "rows.csv", "weeds.csv"].map(of_rows);
        let files = LocateFiles {
            plants: &folder.join("plants.csv"),
            gaps: gaps.as_deref(),
            rows: rows.as_deref(),
            weeds: weeds.as_deref(),
            trace: None,
            figures: Some(&folder.join("figures")),
            force: true,
        };
        locate_plants(&source, leaf, &subject, files, options, monitor)
    }
}

/// What is written of plants.
#[derive(Debug, Clone, Copy)]
pub struct LocateFiles<'a> {
    /// The plants, a CSV table ([`table`]).
    pub plants: &'a Path,
    /// Where plants are missing, a CSV table; row model only.
    pub gaps: Option<&'a Path>,
    /// The stand count of every row, a CSV table; row model only.
    pub rows: Option<&'a Path>,
    /// Weeds that were left out between rows, a CSV table; row model only, and only where rows tell them.
    pub weeds: Option<&'a Path>,
    /// One line per sweep of a descent, a CSV table; descents from one start only.
    pub trace: Option<&'a Path>,
    /// Folder of pictures: `plants.png`, the plants over the picture.
    pub figures: Option<&'a Path>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

impl LocateFiles<'_> {
    /// Refuses tables that the method does not know, before any work is done.
    fn check(&self, options: &LocateOptions) -> Result<(), Error> {
        options.check()?;
        let refuse = |what: &str, why: &str| Err(Error::Argument(format!("{what}: {why}")));
        let is_row_model = options.method == LocateMethod::RowModel;
        for (what, path) in [("gaps", self.gaps), ("rows", self.rows), ("weeds", self.weeds)] {
            if path.is_some() && !is_row_model {
                return refuse(what, "only the method row-model knows them");
            }
        }
        let descent = &options.paper;
        if self.trace.is_some() && (is_row_model || descent.starts > 1) {
            return refuse("trace", "follows one descent: another method, from one start");
        }
        Ok(())
    }
}

/// Locates the plants of a mask; `source` is the picture that it is of, `subject` its name in diagnostics.
///
/// # Errors
/// Options that do not go together, as [`locator::find`]; files that cannot be written.
pub fn locate_plants(
    source: &Source,
    leaf: LeafMask,
    subject: &str,
    files: LocateFiles<'_>,
    options: &LocateOptions,
    monitor: &mut dyn Monitor,
) -> Result<LocateOutcome, Error> {
    files.check(options)?;
    let mut mask = leaf.mask;
    forecast::require_map(subject.as_ref(), (mask.width, mask.height))?;
    components::remove_small(&mut mask, options.min_pixels);
    let gsd_m = leaf_mask::gsd_m(source, options.gsd_m, subject, monitor);
    let place = table::Placement { georeference: source.georeference(), gsd_m };
    let prepared = locator::prepare(&mask, leaf.posterior, gsd_m, options)?;
    let rows = match &prepared.work {
        Work::Stand(stand) => Some(&stand.rows).filter(|rows| !rows.rows.is_empty()),
        _ => prepared.detection.rows(),
    };
    let row_spacing_px = rows.and_then(|rows| rows.spacing_px);
    let mut outcome = LocateOutcome {
        method: options.method,
        plants: 0,
        leaf_pixels: prepared.leaf_pixels,
        rows: rows.map_or(0, |rows| rows.rows.len()),
        gsd_m,
        heading_deg: rows.map(|rows| rows.axes.heading_rad.to_degrees()),
        row_spacing_px,
        row_spacing_m: row_spacing_px.zip(gsd_m).map(|(px, gsd)| px * gsd),
        descent: None,
        stand: None,
    };
    let found = match prepared.work {
        Work::Stand(stand) => Found::Stand(stand),
        Work::Descent(descend) => Found::Descent(Box::new(match files.trace {
            Some(trace) => traced(*descend, trace, files.force, options.paper.certify)?,
            None => descend.run(&options.paper)?,
        })),
    };
    match &found {
        Found::Stand(stand) => {
            outcome.plants = stand.plants.len();
            outcome.stand = Some(StandOutcome::new(stand, gsd_m));
            show::tell(stand, subject, monitor);
            let has_rows = !stand.rows.rows.is_empty();
            table::write_plants(files.plants, files.force, &stand.plants, has_rows, place)?;
            if let Some(path) = files.gaps {
                table::write_gaps(path, files.force, stand, place)?;
            }
            if let Some(path) = files.rows {
                table::write_rows(path, files.force, stand, gsd_m)?;
            }
            if let (Some(path), Some(between)) = (files.weeds, &stand.between_rows) {
                table::write_weeds(path, files.force, &between.weeds, place)?;
            }
        }
        Found::Descent(found) => {
            outcome.plants = found.located.plants.len();
            outcome.descent = Some(DescentOutcome::new(found));
            table::write_located(files.plants, files.force, &found.located, place)?;
            if found.located.empty_clusters > 0 {
                let message = format!("{} plants have no leaf pixel", found.located.empty_clusters);
                monitor.diagnostic(
                    &Diagnostic::warning("plants-without-pixels", subject, message)
                        .with_remedy("look for fewer plants"),
                );
            }
        }
    }
    if let Some(folder) = files.figures {
        let mut view = View::of(source)?;
        show::draw(&mut view, &found);
        view.write(folder, "plants.png", files.force)?;
    }
    Ok(outcome)
}

impl DescentOutcome {
    fn new(found: &Descended) -> DescentOutcome {
        let Descended { located, outcome, certificate } = found;
        DescentOutcome {
            sigma_px: located.sigma_px,
            mean_distance_px: located.mean_distance_px,
            plants_without_pixels: located.empty_clusters,
            initial_cost: outcome.initial_cost,
            final_cost: outcome.final_cost,
            sweeps: outcome.iterations,
            stop: outcome.stop.word().to_owned(),
            certificate: *certificate,
        }
    }
}

/// Descends and writes a line per sweep.
fn traced(descend: Descend, trace: &Path, force: bool, certify: bool) -> Result<Descended, Error> {
    let Descend { setup: Setup { problem, field, detection }, options } = descend;
    let outcome = Drive::new(&problem, Descent::new(options.descent), field)
        .limits(Limits::iterations(options.max_sweeps))
        .force(force)
        .trace(trace)
        .run()?
        .checked()?;
    let done = outcome.as_run();
    Ok(Descended::finish(Setup { problem, field: outcome.x, detection }, done, certify)?)
}
