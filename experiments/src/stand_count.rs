//! Fits the weights of the stand count (`rowgram::phenotype::stand_count`) to masks of which every plant is known.
//!
//! ```text
//! experiments fit-stand-count --masks DIR --first 1000 --last 1004 \
//!     -o src/plants/src/phenotype/stand_count/weights.csv
//! ```
//!
//! Takes the masks of every scenario with numbers from the first to the last, and writes the weights under which the true plants
//! are likeliest, with the spacing that the locator finds.
//! Penalised maximum likelihood by L-BFGS; the gradient is observed minus expected features.
//!
//! The weights in use are of masks 1000 to 1004 of 16 scenarios of an independent generator, and of as many of the presets of the same names:
//! `rowgram synth mask --preset NAME --seed 301` to 305. The locator holds what describes a field within what those masks show.
//! Masks are read as the locator reads them, which compares the leaves around a place with those around plants that the weights in use find: fitted
//! again, weights move by 0.17 at most.

use rayon::prelude::*;
use rowgram::{
    io::{images, output, points},
    phenotype::{
        row_model::RowModelOptions,
        rows,
        rows_to_count::{RowsToCount, rows_to_count},
        stand_count::{Lattice, PAIR_FEATURES, PLACE, PLACE_FEATURES, RowFeatures, Weights},
    },
};
use std::path::{Path, PathBuf};

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// What the locator reads of a mask, with the true plants on it.
fn read(path: &Path) -> Result<RowsToCount, Box<dyn std::error::Error + Send + Sync>> {
    let mask = images::read_mask(path)?;
    let plants = points::read(&path.with_extension("csv"))?;
    let detection = rows::detect(&mask);
    let rows = detection.rows().ok_or_else(|| format!("{}: no rows", path.display()))?;
    Ok(rows_to_count(&mask, rows, &plants, &RowModelOptions::default())?)
}

/// The rows of a field that have plants, none of them farther apart than is thought possible.
fn usable(field: &RowsToCount) -> impl Iterator<Item = (RowFeatures<'_>, &[usize])> {
    let rows = field.profiles.iter().zip(&field.plants).filter(|(_, plants)| plants.len() > 1);
    rows.map(|(row, plants)| (RowFeatures::new(row, &field.overall, &field.spacing), &plants[..]))
        .filter(|(row, plants)| plants.windows(2).all(|w| w[1] - w[0] < row.gap_limit()))
}

/// Penalty for weights that differ from the start.
const PENALTY: f64 = 1e-4;
/// Steps of L-BFGS, at most.
const ROUNDS: usize = 100;

/// All weights in one list, those of places first.
fn flat(weights: &Weights) -> Vec<f64> {
    weights.places.iter().chain(&weights.pairs).copied().collect()
}

fn folded(flat: &[f64]) -> Weights {
    let (places, pairs) = flat.split_at(PLACE);
    Weights { places: std::array::from_fn(|k| places[k]), pairs: std::array::from_fn(|k| pairs[k]) }
}

/// Penalised maximum likelihood by L-BFGS, per plant.
fn fit(fields: &[RowsToCount], start: &[f64]) -> Vec<f64> {
    let rows: Vec<(RowFeatures<'_>, &[usize])> = fields.iter().flat_map(usable).collect();
    let plants: f64 = rows.iter().map(|(_, plants)| plants.len() as f64).sum();
    let cost = |w: &[f64]| {
        let weights = folded(w);
        let of_row = |(row, plants): &(RowFeatures<'_>, &[usize])| {
            Lattice::new(row, &weights).log_likelihood(row, plants)
        };
        let parts: Vec<(f64, Weights)> = rows.par_iter().map(of_row).collect();
        let mut gradient: Vec<f64> = w.iter().zip(start).map(|(w, s)| PENALTY * (w - s)).collect();
        let mut value: f64 =
            w.iter().zip(start).map(|(w, s)| 0.5 * PENALTY * (w - s).powi(2)).sum();
        for (v, g) in parts {
            value -= v / plants;
            gradient.iter_mut().zip(flat(&g)).for_each(|(sum, g)| *sum -= g / plants);
        }
        (value, gradient)
    };
    let mut w = start.to_vec();
    let (mut value, mut gradient) = cost(&w);
    let mut memory: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
    for _ in 0..ROUNDS {
        let mut step: Vec<f64> = gradient.iter().map(|g| -g).collect();
        let mut shares = Vec::new();
        for (s, y) in memory.iter().rev() {
            let share = dot(s, &step) / dot(s, y);
            step.iter_mut().zip(y).for_each(|(d, y)| *d -= share * y);
            shares.push(share);
        }
        let scale = memory.last().map_or_else(
            || 0.3 / dot(&gradient, &gradient).sqrt().max(0.3),
            |(s, y)| dot(s, y) / dot(y, y),
        );
        step.iter_mut().for_each(|d| *d *= scale);
        for ((s, y), share) in memory.iter().zip(shares.into_iter().rev()) {
            let other = dot(y, &step) / dot(s, y);
            step.iter_mut().zip(s).for_each(|(d, s)| *d += (share - other) * s);
        }
        let slope = dot(&gradient, &step);
        let Some((next, (lower, new))) = (0..8).find_map(|k| {
            let length = 0.4_f64.powi(k);
            let next: Vec<f64> = w.iter().zip(&step).map(|(w, d)| w + length * d).collect();
            let there = cost(&next);
            (there.0 <= value + 1e-4 * length * slope).then_some((next, there))
        }) else {
            break;
        };
        let s: Vec<f64> = next.iter().zip(&w).map(|(a, b)| a - b).collect();
        let y: Vec<f64> = new.iter().zip(&gradient).map(|(a, b)| a - b).collect();
        if dot(&s, &y) > 1e-12 {
            memory.push((s, y));
            memory.drain(..memory.len().saturating_sub(12));
        }
        let gain = value - lower;
        (w, value, gradient) = (next, lower, new);
        if gain < 1e-7 {
            break;
        }
    }
    w
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
        writeln!(out, "feature,weight")?;
        let names = PLACE_FEATURES.iter().chain(&PAIR_FEATURES);
        for (name, weight) in names.zip(&weights) {
            writeln!(out, "{name},{weight:.4}")?;
        }
        Ok(())
    })?;
    Ok(())
}

/// The masks of every scenario with numbers from the first to the last, but those of a whole field, which are large.
fn masks(folder: &Path, first: u32, last: u32) -> std::io::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for scenario in std::fs::read_dir(folder)? {
        let scenario = scenario?.path();
        let masks = (first..=last).map(|number| scenario.join(format!("{number}.png")));
        if !scenario.ends_with("whole_field") {
            paths.extend(masks.filter(|path| path.exists()));
        }
    }
    paths.sort();
    Ok(paths)
}

fn weights(args: &FitStandCount) -> Result<Vec<f64>, Box<dyn std::error::Error + Send + Sync>> {
    let paths = masks(&args.masks, args.first, args.last)?;
    let fields: Vec<RowsToCount> =
        paths.par_iter().map(|path| read(path)).collect::<Result<_, _>>()?;
    // The weights of the score by which the spacing is found, about.
    let mut start = Weights::default();
    start.places[..2].copy_from_slice(&[1.1, 6.0]);
    start.pairs[..4].copy_from_slice(&[1.0, -12.0, 0.0, -1.0]);
    Ok(fit(&fields, &flat(&start)))
}
