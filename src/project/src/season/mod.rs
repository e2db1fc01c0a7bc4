//! A season: the flights over one field on several dates, in one frame, with the growth of its plots and plants.
//!
//! Every flight is a project of its own and is run as one ([`crate::run`]), so only what has changed is done again. Then the
//! maps are brought into one frame, the plots of the season are measured on each of them, plants are
//! followed from date to date ([`rowgram_plants::phenotype::plant_tracks`]) and growth curves fitted to every plot
//! ([`rowgram_plants::problems::growth_curve`]). What came of it is written beside `season.toml`:
//!
//! ```text
//! season/
//!   flights.csv  colours.csv  traits_long.csv  plants_long.csv  growth.csv  season.json
//!   plots/DATE.geojson   the plots on the map of a date
//!   .rowgram-store/      places that two dates share, used again while nothing changes
//! ```

mod colours;
mod file;
mod follow;
mod plots;
mod register;
mod write;

pub use colours::{ColourScale, ColourSource, DateColours};
pub use file::{FlightEntry, Frame, SEASON_FILE, SeasonFile};
pub use follow::{EmergenceDate, Outlier, PlotSeries, SeasonTrait};
pub use register::Placement;

use super::{
    Config, Project, Stage,
    record::{self, Lock, STORE, Store},
    run::{self, RunOptions},
    stage,
};
use colours::PlacedMap;
use follow::Day;
use register::DateMap;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Recorder},
};
use rowgram_files::polygons::{self, Outline};
use rowgram_optim::output::FileError;
use rowgram_plants::{phenotype::traits::PlotTraits, problems::growth_curve::GrowthModel};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

rowgram_base::options! {
    /// How the dates of a season are brought together.
    pub struct SeasonOptions in "season" {
        /// How far the maps of two flights may be apart before they are tied to each other; twice the error of a receiver.
        pub search_m: f64 = 5.0, limits POSITIVE;
        /// Side of the squares of the map in which features are looked for.
        pub tile_m: f64 = 8.0, limits POSITIVE;
        /// The most squares that two maps are compared in, evenly over the field.
        pub tiles: usize = 64, limits at_least(1.0);
        /// The most features of a square.
        pub features_per_tile: usize = 3000, limits at_least(10.0);
        /// How far a place may be from where most others put it, in pixels of the map.
        pub tolerance_px: f64 = 5.0, limits POSITIVE;
        /// Where the scale of the colours of dates comes from: auto from panels of known reflectance where there are any, else ground from
        /// ground without leaf that dates share; off leaves colours as they are.
        pub colours: ColourScale = ColourScale::Auto;
        /// Form of the growth curves; the one that the plots are nearer to where not set.
        pub growth_model: Option<GrowthModel> = None, example "\"logistic\"";
        /// Seed of the random draws.
        pub seed: u64 = 1;
    }
}

/// Results of a season in its folder.
pub const SEASON_RESULTS: &str = "season.json";

/// What the season itself measures on the map of a flight, in its own plots.
pub(super) const BY_PLOTS: [Stage; 3] = [Stage::LeafCount, Stage::Plots, Stage::Evaluate];

/// A flight of a season.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SeasonFlight {
    /// Its date, `YYYY-MM-DD`.
    pub date: String,
    /// Days from sowing, or from the first flight.
    pub day: f64,
    /// The folder of its project, as the season names it.
    pub project: PathBuf,
    /// Ground sampling distance of its map, metres.
    pub gsd_m: Option<f64>,
    /// How it came into the frame of the season; `None` where it did not, and takes no part.
    pub placement: Option<Placement>,
    /// The scale of its colours; `None` where it has none, and they are as its map has them.
    #[serde(default)]
    pub colours: Option<DateColours>,
    /// Plants that were located on its map.
    pub plants: Option<usize>,
    /// Its quality checks that are red.
    pub red_checks: usize,
    /// Why it takes no part, or which of its stages failed.
    pub failure: Option<String>,
}

/// What came of a season.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SeasonOutcome {
    /// Its name.
    pub name: String,
    /// Whether days count from sowing; else from the first flight.
    pub from_sowing: bool,
    /// The flights by date.
    pub flights: Vec<SeasonFlight>,
    /// Names of the plots.
    pub plots: Vec<String>,
    /// Rings of the plots in the frame of the season, metres; empty where the whole field is one.
    pub outlines_m: Vec<Vec<Vec<[f64; 2]>>>,
    /// What the polygons of the plots say beside their names: genotype, treatment, block.
    pub attributes: Vec<Vec<(String, Value)>>,
    /// The traits whose growth was fitted.
    pub traits: Vec<SeasonTrait>,
    /// When each plot emerged.
    pub emergence: Vec<EmergenceDate>,
    /// Plants followed through the dates.
    pub tracks: usize,
    /// For each date after the first: plants seen again, new ones, and those not seen.
    pub steps: Vec<[usize; 3]>,
    /// Values that contradict the growth of their plot.
    pub outliers: Vec<Outlier>,
    /// What was found on the way.
    pub diagnostics: Vec<Diagnostic>,
}

impl SeasonOutcome {
    /// Of the last time that a season was done.
    ///
    /// # Errors
    /// Where it was not, or by another version of the program.
    pub fn read(file: &SeasonFile) -> Result<SeasonOutcome, Error> {
        let path = file.results().join(SEASON_RESULTS);
        let text = std::fs::read(&path).map_err(|e| FileError::read(&path, e))?;
        if !record::holds(&file.results(), SEASON_RESULTS) {
            let message = "it is not as a season wrote it: do `rowgram season` again";
            return Err(FileError::malformed(&path, None, message).into());
        }
        Ok(serde_json::from_slice(&text).map_err(|e| {
            let message =
                format!("it is of another version of the program ({e}): run the season again");
            FileError::malformed(&path, Some(e.line()), message)
        })?)
    }
}

/// A flight while the season is done.
struct Flight {
    entry: FlightEntry,
    config: Config,
    root: PathBuf,
    report: SeasonFlight,
    traits: Vec<PlotTraits>,
    force: bool,
}

impl Flight {
    fn project(&self) -> Result<Project, Error> {
        let project = Project::new(&self.root, self.config.clone())?;
        Ok(project.forced(self.force).on(&self.entry.date))
    }
}

/// Runs the flights of a season as far as something has changed, brings them into one frame, and writes what grows. Settings of the
/// flights are read with `environment` and `settings` (`section.key=value`) over their files. Files in the way that were edited, or are
/// somebody else's, are refused, or kept beside with `force`.
///
/// A flight that fails takes no part, with a diagnostic.
///
/// # Errors
/// Settings that cannot be understood, plots that cannot be read, a season none of whose flights has a map, and writing.
pub fn season(
    file: &SeasonFile,
    environment: &[(String, String)],
    settings: &[String],
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<SeasonOutcome, Error> {
    let root = file.root();
    let results = file.results();
    let _lock = Lock::take(&root, &results)?;
    record::check(&results, &write::FILES, force)?;
    // Before hours are spent on the flights.
    colours::check_panels(file)?;
    let mut flights = Vec::new();
    for entry in &file.flights {
        let folder = root.join(&entry.project);
        let config = Config::read(&folder, environment.iter().cloned(), settings)?;
        let report = SeasonFlight {
            date: entry.date.clone(),
            day: file.day(entry),
            project: entry.project.clone(),
            gsd_m: None,
            placement: None,
            colours: None,
            plants: None,
            red_checks: 0,
            failure: None,
        };
        let (entry, traits) = (entry.clone(), Vec::new());
        flights.push(Flight { entry, config, root: folder, report, traits, force });
    }
    let plot_key = flights.iter().find_map(|flight| flight.config.project.plot_key.clone());
    if let Some(plots) = &file.plots {
        polygons::check(plots, plot_key.as_deref())?;
    }
    let mut recorder = Recorder::new(monitor);
    let mut maps = Vec::new();
    for flight in &mut flights {
        match first_run(flight, &mut recorder) {
            Ok(map) => maps.push(Some(map)),
            Err(error) => {
                fail(flight, &error, &mut recorder);
                maps.push(None);
            }
        }
    }
    let with_map: Vec<usize> = (0..maps.len()).filter(|&k| maps[k].is_some()).collect();
    let maps: Vec<DateMap> = maps.into_iter().flatten().collect();
    if maps.is_empty() {
        let message = "none of its flights has a map; the messages above say why".to_owned();
        return Err(Error::Incomplete(format!("{}: {message}", file.path.display())));
    }
    recorder.stage("season");
    register::check_systems(&maps)?;
    let ties = Store::new(results.join(STORE));
    let placed = register::place(&maps, &file.options, &ties, &mut recorder)?;
    for (&k, placement) in with_map.iter().zip(placed) {
        flights[k].report.placement = placement;
    }
    scale_colours(file, (&with_map, &maps), &mut flights, &ties, &mut recorder)?;
    let outlines_m = plots::read(file, plot_key.as_deref(), &maps[0], &mut recorder)?;
    for (&k, map) in with_map.iter().zip(&maps) {
        let flight = &mut flights[k];
        if flight.report.placement.is_none() {
            flight
                .report
                .failure
                .get_or_insert("it shares too little with the other flights".to_owned());
            continue;
        }
        if let Err(error) = second_run(flight, map, outlines_m.as_deref(), &results, &mut recorder)
        {
            fail(flight, &error, &mut recorder);
            flight.report.placement = None;
        }
    }
    recorder.stage("season");
    let mut days = Vec::new();
    for flight in &flights {
        if let Some(placement) = &flight.report.placement {
            days.push(Day::read(&flight.project()?, &flight.report, placement, &flight.traits)?);
        }
    }
    let names = outlines_m.as_ref().map(|all| all.iter().map(|plot| plot.name.clone()).collect());
    let found = follow::follow(&days, names, &file.traits, file.options.growth_model);
    follow::report_outliers(&found.outliers, &mut recorder);
    for (day, flight) in
        days.iter().zip(flights.iter_mut().filter(|f| f.report.placement.is_some()))
    {
        flight.report.plants = day.plants.as_ref().map(Vec::len);
    }
    let (outlines_m, attributes) =
        outlines_m.into_iter().flatten().map(|plot| (plot.rings, plot.attributes)).unzip();
    let outcome = SeasonOutcome {
        name: file.name.clone(),
        from_sowing: file.sown.is_some(),
        flights: flights.into_iter().map(|flight| flight.report).collect(),
        plots: found.plots.clone(),
        outlines_m,
        attributes,
        traits: found.traits.clone(),
        emergence: found.emergence.clone(),
        tracks: found.tracks.tracks.len(),
        steps: found.tracks.steps.iter().map(|s| [s.matched, s.new, s.unseen]).collect(),
        outliers: found.outliers.clone(),
        diagnostics: recorder.diagnostics,
    };
    let work = record::temporary(&results)?;
    write::write(work.path(), &outcome, &days, &found)?;
    record::publish(work.path(), &results, force)?;
    plots::withdraw(&outcome, &results)?;
    Ok(outcome)
}

/// Gives the flights that have a place the scale of their colours.
fn scale_colours(
    file: &SeasonFile,
    (with_map, maps): (&[usize], &[DateMap]),
    flights: &mut [Flight],
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let mut placed = Vec::new();
    let mut numbers = Vec::new();
    for (&k, map) in with_map.iter().zip(maps) {
        if let Some(placement) = &flights[k].report.placement {
            let panels = flights[k].entry.panels.as_ref().map(|path| file.root().join(path));
            let is_own = placement.fit.is_none();
            placed.push(PlacedMap { map, transform: placement.transform, panels, is_own });
            numbers.push(k);
        }
    }
    let scales = colours::scale(file, &placed, store, monitor)?;
    for (k, scale) in numbers.into_iter().zip(scales) {
        if let Some(scale) = &scale {
            let plots = &mut flights[k].config.plots;
            (plots.light_gain, plots.light_offset) = (scale.gain, scale.offset);
        }
        flights[k].report.colours = scale;
    }
    Ok(())
}

/// Names a flight that takes no part.
fn fail(flight: &mut Flight, error: &Error, monitor: &mut dyn Monitor) {
    report_failure(flight, "it takes no part in the season", error, monitor);
}

/// Names a flight one of whose stages failed, but once.
fn fail_stage(flight: &mut Flight, error: &Error, monitor: &mut dyn Monitor) {
    if flight.report.failure.as_ref().is_none_or(|known| *known != error.to_string()) {
        report_failure(flight, "one of its stages failed", error, monitor);
    }
}

fn report_failure(flight: &mut Flight, what: &str, error: &Error, monitor: &mut dyn Monitor) {
    let message = format!("{what}: {error}");
    monitor.diagnostic(
        &Diagnostic::warning("season-flight-failed", &flight.report.date, message).with_remedy(
            format!("rowgram run {} says more", stage::quoted(&flight.root.display().to_string())),
        ),
    );
    flight.report.failure = Some(error.to_string());
}

/// Runs a flight up to its plants, and looks at its map.
fn first_run(flight: &mut Flight, monitor: &mut dyn Monitor) -> Result<DateMap, Error> {
    let project = flight.project()?;
    let options = RunOptions { skip: BY_PLOTS.to_vec(), ..RunOptions::default() };
    let outcome = run::run(&project, &options, &mut Quiet(monitor))?;
    let has_control =
        outcome.results.align.as_ref().is_some_and(|align| align.control_points.count > 0);
    flight.report.gsd_m = outcome.gsd_m;
    flight.report.red_checks = outcome.red_checks().count();
    let map = DateMap::of(
        &project,
        &flight.entry.date,
        flight.report.day,
        flight.entry.frame.unwrap_or(if has_control { Frame::Own } else { Frame::Tied }),
    );
    match (map, outcome.failure) {
        (Ok(map), failure) => {
            if let Some(error) = failure {
                fail_stage(flight, &error, monitor);
            }
            Ok(map)
        }
        (Err(_), Some(failure)) => Err(failure),
        (Err(error), None) => Err(error),
    }
}

/// Measures the plots of the season on the map of a flight.
fn second_run(
    flight: &mut Flight,
    map: &DateMap,
    outlines_m: Option<&[Outline]>,
    results: &Path,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    if let (Some(plots), Some(placement)) = (outlines_m, &flight.report.placement) {
        let path = plots::write(plots, map, placement, results, flight.force)?;
        flight.config.project.plots = Some(plots::from(&flight.root, &path));
        flight.config.project.plot_key = Some(polygons::NAME.to_owned());
    }
    let outcome = run::run(&flight.project()?, &RunOptions::default(), &mut Quiet(monitor))?;
    if let Some(plots) = outcome.results.plots {
        flight.traits = plots.plots;
    }
    if let Some(error) = outcome.failure {
        fail_stage(flight, &error, monitor);
    }
    Ok(())
}

/// Passes progress on, and of the diagnostics of a flight none: they are in its own report.
struct Quiet<'a>(&'a mut dyn Monitor);

impl Monitor for Quiet<'_> {
    fn stage(&mut self, name: &str) {
        self.0.stage(name);
    }

    fn progress(&mut self, progress: &rowgram_base::monitor::Progress<'_>) {
        self.0.progress(progress);
    }

    fn diagnostic(&mut self, _: &Diagnostic) {}
}
