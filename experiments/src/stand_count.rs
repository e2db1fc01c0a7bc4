//! Fits the weights of the stand count (`rowgram::phenotype::stand_count`) to masks of which every plant is known.
//!
//! ```text
//! experiments fit-stand-count --masks DIR --first 1000 --last 1004 --flights DIR \
//!     -o src/plants/src/phenotype/stand_count/weights.csv
//! ```
//!
//! Takes the masks of every scenario with numbers from the first to the last and those of maps of synthetic flights, and writes the weights under which
//! the true plants are likeliest, with the spacing that the locator finds.
//! Penalised maximum likelihood by L-BFGS; the gradient is observed minus expected features.
//!
//! The weights in use are of masks 1000 to 1004 of 16 scenarios of an independent generator, of as many of the presets of the same names
//! (`rowgram synth mask --preset NAME --seed 301` to 305), and of twelve flights
//! (`rowgram synth flight --preset small --stage mid --seed 101`, late 102, mid 103 and so on to late 112, `spacing_m` in field.toml 0.2, 0.16, 0.25, 0.14,
//! 0.22 and 0.3 for two of them each; then `rowgram run --until segment`): leaves on a map of photos are wider than on a mask that is drawn.
//! The locator holds what describes a field within what those masks show.

use argmin::{
    core::{CostFunction, Executor, Gradient},
    solver::{linesearch::MoreThuenteLineSearch, quasinewton::LBFGS},
};
use rayon::prelude::*;
use rowgram::{
    io::{csv_table::CsvTable, images, output, points, rasters::Source},
    phenotype::{
        row_model::RowModelOptions,
        rows,
        rows_to_count::{RowsToCount, rows_to_count},
        stand_count::{
            Lattice, LeafWeights, PAIR, PAIR_FEATURES, PLACE, PLACE_FEATURES, RowFeatures, Weights,
        },
    },
    raster::Mask,
};
use std::{
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

/// A mask with its true plants beside it.
fn read_drawn(path: &Path) -> Result<RowsToCount, Box<dyn std::error::Error + Send + Sync>> {
    read(path, &points::read(&path.with_extension("csv"))?, &images::read_mask(path)?)
}

/// The mask of the map that a flight's photos made, with the true plants.
fn read_flight(folder: &Path) -> Result<RowsToCount, Box<dyn std::error::Error + Send + Sync>> {
    let path = folder.join("rowgram/segment/mask.tif");
    let place = Source::open(&path)?.georeference();
    let place = place.ok_or_else(|| format!("{}: expected a georeference", path.display()))?;
    let truth = folder.join("truth/plants.csv");
    let at_m = CsvTable::read(&truth)?.pairs("easting_m", "northing_m");
    let at_m =
        at_m.ok_or_else(|| format!("{}: expected easting_m, northing_m", truth.display()))?;
    let plants: Vec<[f64; 2]> = at_m.into_iter().filter_map(|at| place.pixel(at)).collect();
    read(&path, &plants, &images::read_mask(&path)?)
}

/// What the locator reads of a mask, with the true plants on it.
fn read(
    path: &Path,
    plants: &[[f64; 2]],
    mask: &Mask,
) -> Result<RowsToCount, Box<dyn std::error::Error + Send + Sync>> {
    let detection = rows::detect(mask);
    let rows = detection.rows().ok_or_else(|| format!("{}: no rows", path.display()))?;
    Ok(rows_to_count(mask, rows, plants, &RowModelOptions::default()))
}

/// The rows of a field that have plants, none of them farther apart than is thought possible.
fn usable(field: &RowsToCount) -> impl Iterator<Item = FieldRow<'_>> {
    let rows = field.profiles.iter().zip(&field.plants).filter(|(_, plants)| plants.len() > 1);
    rows.map(|(row, plants)| FieldRow {
        features: RowFeatures::new(row, &field.overall, &field.spacing),
        plants,
        leaf_width: field.overall.leaf_width,
    })
    .filter(|row| row.plants.windows(2).all(|w| w[1] - w[0] < row.features.gap_limit()))
}

/// Penalty for weights that differ from the start.
const PENALTY: f64 = 1e-4;
/// Steps of L-BFGS, at most; fewer where one changes the cost by less than the tolerance.
const MAX_ROUNDS: u64 = 100;
const TOLERANCE: f64 = 1e-7;
/// Pairs of steps that it remembers.
const REMEMBERED: usize = 12;

/// All weights in one list: of places and pairs, where leaves are narrow, then their changes.
fn flat(weights: &LeafWeights) -> Vec<f64> {
    let both = [&weights.narrow, &weights.change];
    both.into_iter().flat_map(|of| of.places.iter().chain(&of.pairs)).copied().collect()
}

fn folded(flat: &[f64]) -> LeafWeights {
    let [narrow, change] = [0, PLACE + PAIR].map(|from| Weights {
        places: std::array::from_fn(|k| flat[from + k]),
        pairs: std::array::from_fn(|k| flat[from + PLACE + k]),
    });
    LeafWeights { narrow, change }
}

/// A row of a field, its true plants (places in steps), and how wide its leaves are.
struct FieldRow<'f> {
    features: RowFeatures<'f>,
    plants: &'f [usize],
    /// Pixels of the reduced grid.
    leaf_width: f64,
}

/// The penalised likelihood of all plants, per plant, with its sign changed.
struct Cost<'f> {
    rows: Vec<FieldRow<'f>>,
    plants: f64,
    start: &'f [f64],
    /// The last weights with their cost and its gradient, which argmin asks for one after the other.
    last: Mutex<(Vec<f64>, f64, Vec<f64>)>,
}

impl<'f> Cost<'f> {
    fn new(fields: &'f [RowsToCount], start: &'f [f64]) -> Cost<'f> {
        let rows: Vec<FieldRow<'f>> = fields.iter().flat_map(usable).collect();
        let plants = rows.iter().map(|row| row.plants.len() as f64).sum();
        Cost { rows, plants, start, last: Mutex::default() }
    }

    fn at(&self, w: &[f64]) -> (f64, Vec<f64>) {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if last.0 != w {
            let weights = folded(w);
            let of_row = |row: &FieldRow<'_>| {
                let lattice = Lattice::new(&row.features, &weights.at(row.leaf_width));
                lattice.log_likelihood(&row.features, row.plants)
            };
            let parts: Vec<(f64, Weights)> = self.rows.par_iter().map(of_row).collect();
            let off = || w.iter().zip(self.start).map(|(w, s)| w - s);
            let mut gradient: Vec<f64> = off().map(|off| PENALTY * off).collect();
            let mut value: f64 = off().map(|off| 0.5 * PENALTY * off * off).sum();
            for ((v, g), row) in parts.into_iter().zip(&self.rows) {
                value -= v / self.plants;
                let by = LeafWeights::log_width(row.leaf_width);
                for (k, g) in g.places.into_iter().chain(g.pairs).enumerate() {
                    gradient[k] -= g / self.plants;
                    gradient[PLACE + PAIR + k] -= by * g / self.plants;
                }
            }
            *last = (w.to_vec(), value, gradient);
        }
        (last.1, last.2.clone())
    }
}

impl CostFunction for Cost<'_> {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, w: &Vec<f64>) -> Result<f64, argmin::core::Error> {
        Ok(self.at(w).0)
    }
}

impl Gradient for Cost<'_> {
    type Param = Vec<f64>;
    type Gradient = Vec<f64>;

    fn gradient(&self, w: &Vec<f64>) -> Result<Vec<f64>, argmin::core::Error> {
        Ok(self.at(w).1)
    }
}

/// Masks, and where the weights go.
#[derive(Debug, clap::Args)]
pub(crate) struct FitStandCount {
    /// Folder of scenarios, each a folder of masks with their plants (N.png, N.csv).
    #[arg(long, value_name = "DIR")]
    masks: PathBuf,
    /// Number of the first mask of each scenario.
    #[arg(long, default_value_t = 1000)]
    first: u32,
    /// Number of the last mask of each scenario.
    #[arg(long, default_value_t = 1004)]
    last: u32,
    /// Folder of synthetic flights, each a project of which `segment` has run.
    #[arg(long, value_name = "DIR")]
    flights: PathBuf,
    /// Where the weights go (CSV); replaced if it is there.
    #[arg(short, long, value_name = "CSV")]
    output: PathBuf,
}

/// Fits and writes the weights.
///
/// # Errors
/// Masks that cannot be read or show no rows; a file that cannot be written.
pub(crate) fn run(args: &FitStandCount) -> Result<(), rowgram::Error> {
    let failed = |error: Box<dyn std::error::Error + Send + Sync>| {
        rowgram::Error::Argument(format!("{}: {error}", args.masks.display()))
    };
    let weights = weights(args).map_err(failed)?;
    output::write(&args.output, true, |out| {
        writeln!(out, "feature,weight,change")?;
        let (narrow, change) = weights.split_at(PLACE + PAIR);
        let names = PLACE_FEATURES.iter().chain(&PAIR_FEATURES);
        for ((name, weight), change) in names.zip(narrow).zip(change) {
            writeln!(out, "{name},{weight:.4},{change:.4}")?;
        }
        Ok(())
    })?;
    Ok(())
}

/// The folders in a folder.
fn folders(of: &Path) -> std::io::Result<Vec<PathBuf>> {
    let all: Vec<PathBuf> =
        std::fs::read_dir(of)?.map(|of| Ok(of?.path())).collect::<std::io::Result<_>>()?;
    let mut folders: Vec<PathBuf> = all.into_iter().filter(|path| path.is_dir()).collect();
    folders.sort();
    Ok(folders)
}

/// The masks of every scenario with numbers from the first to the last, but those of a whole field, which are large.
fn masks(folder: &Path, first: u32, last: u32) -> std::io::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for scenario in folders(folder)? {
        let masks = (first..=last).map(|number| scenario.join(format!("{number}.png")));
        if !scenario.ends_with("whole_field") {
            paths.extend(masks.filter(|path| path.exists()));
        }
    }
    Ok(paths)
}

fn weights(args: &FitStandCount) -> Result<Vec<f64>, Box<dyn std::error::Error + Send + Sync>> {
    let paths = masks(&args.masks, args.first, args.last)?;
    let mut fields: Vec<RowsToCount> =
        paths.par_iter().map(|path| read_drawn(path)).collect::<Result<_, _>>()?;
    let flights = folders(&args.flights)?;
    let of_flights: Vec<RowsToCount> =
        flights.par_iter().map(|path| read_flight(path)).collect::<Result<_, _>>()?;
    fields.extend(of_flights);
    let start = flat(&LeafWeights { narrow: Weights::by_hand(), change: Weights::default() });
    let solver =
        LBFGS::new(MoreThuenteLineSearch::new(), REMEMBERED).with_tolerance_cost(TOLERANCE)?;
    let found = Executor::new(Cost::new(&fields, &start), solver)
        .configure(|state| state.param(start.clone()).max_iters(MAX_ROUNDS))
        .run()?;
    found.state.best_param.ok_or_else(|| "no weights are likelier than the first".into())
}
