//! Fits the weights of the stand count (`rowgram::phenotype::stand_count`) to masks of which every plant is known.
//!
//! ```text
//! experiments fit-stand-count --masks DATA/field_masks --first 1000 --last 1004 --rounds 8 \
//!     -o src/plants/src/phenotype/stand_count/weights.csv
//! ```
//!
//! Takes the masks of every scenario with numbers from the first to the last, and writes both sets of weights: those fitted
//! under the spacing, jitter, share of missing plants and of doubles that the true plants have (`of_spacing`), then those
//! fitted under the ones that the first set finds from the spacing at which the locator starts to count (`of_count`).
//! Penalised maximum likelihood by L-BFGS; the gradient is observed minus expected features.
//!
//! The weights in use are of masks 1000 to 1004 with 8 rounds; the locator makes 4 rounds and holds what describes a field
//! within what those masks show.

mod features;

use features::{ALL, Features, Field, Gaps, PAIR, PLACE, STEP, USED, read};
use rayon::prelude::*;
use rowgram::{
    io::output,
    phenotype::stand_count::{PAIR_FEATURES, PLACE_FEATURES},
};
use std::path::{Path, PathBuf};

fn log_sum_exp(terms: &[f64]) -> f64 {
    let top = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    top + terms.iter().map(|t| (t - top).exp()).sum::<f64>().ln()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Log likelihood of the true plants of a row, its gradient, and the expected gaps.
fn likelihood(f: &Features<'_>, w: &[f64]) -> (f64, [f64; ALL], Vec<f64>) {
    let (count, most, open) = (f.heights.len(), f.of_gap.len(), PLACE + 3);
    let own: Vec<f64> = f.places.iter().map(|p| dot(p, &w[..PLACE])).collect();
    let ends: Vec<[[f64; 2]; 2]> = (0..count).map(|k| [f.end(k, true), f.end(k, false)]).collect();
    let worth = |end: [f64; 2]| end[0] + w[open] * end[1];
    let pairs: Vec<Vec<[f64; PAIR]>> = (0..count)
        .map(|b| {
            let mut valley = f64::INFINITY;
            (0..most.min(b + 1))
                .map(|gap| {
                    let features = if gap < 2 { [0.0; PAIR] } else { f.pair(b - gap, b, valley) };
                    if gap > 0 {
                        valley = valley.min(f.heights[b - gap]);
                    }
                    features
                })
                .collect()
        })
        .collect();
    let score = |b: usize, gap: usize| dot(&pairs[b][gap], &w[PLACE..]);
    let (mut ahead, mut behind, mut terms) = (vec![0.0; count], vec![0.0; count], vec![]);
    for b in 0..count {
        terms.clear();
        terms.push(worth(ends[b][0]));
        terms.extend((2..pairs[b].len()).map(|gap| ahead[b - gap] + score(b, gap)));
        ahead[b] = log_sum_exp(&terms) + own[b];
    }
    for a in (0..count).rev() {
        terms.clear();
        terms.push(worth(ends[a][1]));
        let next = (2..most.min(count - a))
            .map(|gap| behind[a + gap] + own[a + gap] + score(a + gap, gap));
        terms.extend(next);
        behind[a] = log_sum_exp(&terms);
    }
    terms.clear();
    terms.extend((0..count).map(|k| ahead[k] + worth(ends[k][1])));
    let all = log_sum_exp(&terms);
    let (mut value, mut gradient, mut expected) = (-all, [0.0; ALL], vec![0.0; most]);
    let mut add = |from: usize, features: &[f64], by: f64| {
        features.iter().enumerate().for_each(|(k, f)| gradient[from + k] += by * f);
    };
    for b in 0..count {
        add(0, &f.places[b], -(ahead[b] + behind[b] - all).exp());
        let first = (worth(ends[b][0]) + own[b] + behind[b] - all).exp();
        let last = (ahead[b] + worth(ends[b][1]) - all).exp();
        add(open, &[first * ends[b][0][1] + last * ends[b][1][1]], -1.0);
        for gap in 2..pairs[b].len() {
            let probability = (ahead[b - gap] + score(b, gap) + own[b] + behind[b] - all).exp();
            expected[gap] += probability;
            add(PLACE, &pairs[b][gap], -probability);
        }
    }
    let truth = &f.row.truth;
    for &k in truth {
        value += own[k];
        add(0, &f.places[k], 1.0);
    }
    for pair in truth.windows(2) {
        value += score(pair[1], pair[1] - pair[0]);
        add(PLACE, &pairs[pair[1]][pair[1] - pair[0]], 1.0);
    }
    for end in [ends[truth[0]][0], ends[truth[truth.len() - 1]][1]] {
        value += worth(end);
        add(open, &[end[1]], 1.0);
    }
    (value, gradient, expected)
}

/// Penalised maximum likelihood by L-BFGS, per plant.
fn fit(fields: &[Field], gaps: &[Gaps], start: &[f64], penalty: f64, rounds: usize) -> Vec<f64> {
    let rows: Vec<Features<'_>> = fields
        .iter()
        .zip(gaps)
        .flat_map(|(field, gaps)| field.rows.iter().map(move |row| Features::new(field, row, gaps)))
        .filter(|f| f.row.truth.len() > 1)
        .filter(Features::reach_the_truth)
        .collect();
    let plants: f64 = rows.iter().map(|f| f.row.truth.len() as f64).sum();
    let cost = |w: &[f64]| {
        let parts: Vec<_> = rows.par_iter().map(|f| likelihood(f, w)).collect();
        let mut gradient: Vec<f64> = w.iter().zip(start).map(|(w, s)| penalty * (w - s)).collect();
        let mut value: f64 =
            w.iter().zip(start).map(|(w, s)| 0.5 * penalty * (w - s).powi(2)).sum();
        for (v, g, _) in parts {
            value -= v / plants;
            gradient.iter_mut().zip(g).for_each(|(sum, g)| *sum -= g / plants);
        }
        (value, gradient)
    };
    let mut w = start.to_vec();
    let (mut value, mut gradient) = cost(&w);
    let mut memory: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
    for _ in 0..rounds {
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
    /// Rounds in which the spacing is re-estimated.
    #[arg(long, default_value_t = 8)]
    rounds: usize,
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
    let [of_spacing, of_count] = weights(args).map_err(failed)?;
    output::write(&args.output, true, |out| {
        writeln!(out, "feature,of_spacing,of_count")?;
        let names = PLACE_FEATURES.iter().chain(&PAIR_FEATURES);
        for ((name, a), b) in names.zip(&of_spacing).zip(&of_count) {
            writeln!(out, "{name},{a:.4},{b:.4}")?;
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

fn weights(
    args: &FitStandCount,
) -> Result<[Vec<f64>; 2], Box<dyn std::error::Error + Send + Sync>> {
    let paths = masks(&args.masks, args.first, args.last)?;
    let fields: Vec<Field> = paths.par_iter().map(|path| read(path)).collect::<Result<_, _>>()?;
    // The weights of the chain that finds the best places, about.
    let mut start = vec![0.0; ALL];
    (start[0], start[1]) = (1.1, 6.0);
    (start[PLACE], start[PLACE + 1], start[PLACE + 3]) = (1.0, -12.0, -1.0);
    let truth: Vec<Gaps> = fields.iter().map(|field| field.truth).collect();
    let of_spacing = fit(&fields, &truth, &start, 5e-4, 40);
    let found: Vec<Gaps> = fields
        .par_iter()
        .map(|field| {
            let mut gaps = Gaps { s: field.start, j: 0.16, m: 0.05, d: 0.03 };
            for _ in 0..args.rounds {
                let mut expected: Vec<(f64, f64)> = Vec::new();
                for row in field.rows.iter().filter(|row| row.truth.len() > 1) {
                    let features = Features::new(field, row, &gaps);
                    if !features.reach_the_truth() {
                        continue;
                    }
                    let (_, _, numbers) = likelihood(&features, &of_spacing);
                    let lengths = (0..numbers.len()).map(|k| k as f64 * STEP);
                    expected.extend(lengths.zip(numbers));
                }
                gaps = gaps.refit(&expected, &USED);
            }
            gaps
        })
        .collect();
    let of_count = fit(&fields, &found, &of_spacing, 1e-4, 80);
    Ok([of_spacing, of_count])
}

#[cfg(test)]
mod tests {
    use super::{features::Row, *};
    use rowgram::phenotype::{
        double_plants::PlantScores,
        dynamic_programming::Profile,
        stand_count::{self, Overall},
    };

    /// Waves of votes and leaf mass, the same on both sides.
    fn row(count: usize) -> (Row, Profile) {
        let wave = |k: usize, length: f64| (k as f64 * TAU / length).sin();
        let votes: Vec<f64> =
            (0..count).map(|k| 0.7 + 0.5 * wave(k, 26.0) + 0.1 * wave(k, 7.3)).collect();
        let scores: Vec<f64> = (0..count).map(|k| 2.0 * wave(k - k % 2, 41.0) - 0.3).collect();
        let mut mass = vec![[0.0; 2]];
        for k in 0..count {
            let [sum, moment] = mass[k];
            let here = 4.0 + 2.0 * wave(k, 31.0);
            mass.push([sum + here, moment + here * k as f64]);
        }
        let judged = |&score| PlantScores { thin: 0.0, second: 0.0, score };
        let surroundings = scores.iter().step_by(2).map(judged).collect();
        let profile = Profile {
            start: 0.0,
            votes: votes.clone(),
            offsets: vec![0.0; count],
            mass: mass.clone(),
            surroundings,
        };
        (Row { votes, crown: scores, mass, truth: vec![] }, profile)
    }

    #[test]
    fn features_are_those_of_the_library() {
        let (row, profile) = row(240);
        let field =
            Field { rows: vec![], overall: [0.7, 4.0, 0.42, 0.5, 0.25], truth: GAPS, start: 13.0 };
        let overall = Overall { mean: 0.7, mass: 4.0, contrast: 0.42, cover: 0.5, outside: 0.25 };
        let gaps = stand_count::Gaps { spacing: 12.0, jitter: 0.14, missing: 0.06, doubles: 0.03 };
        let here = Features::new(&field, &row, &GAPS);
        let there = stand_count::place_features(&profile, &overall, &gaps);
        let same = |name: &str, a: f64, b: f64| {
            assert!((a - b).abs() < 1e-9 * (1.0 + a.abs()), "{name}: {a} {b}");
        };
        assert_eq!(here.places.len(), there.len());
        for (a, b) in here.places.iter().zip(&there) {
            for ((name, a), b) in PLACE_FEATURES.iter().zip(a).zip(b) {
                same(name, *a, *b);
            }
        }
        let mut compared = 0;
        for to in (2..240).step_by(7) {
            for from in 0..to - 1 {
                let there = stand_count::pair_features(&profile, &overall, &gaps, [from, to]);
                let Some(there) = there.unwrap() else { continue };
                let between = here.heights[from + 1..to].iter().copied();
                let here = here.pair(from, to, between.fold(f64::INFINITY, f64::min));
                for ((name, a), b) in PAIR_FEATURES.iter().zip(here).zip(there) {
                    same(name, a, b);
                }
                compared += 1;
            }
        }
        assert!(compared > 1000, "{compared}");
    }

    const GAPS: Gaps = Gaps { s: 12.0, j: 0.14, m: 0.06, d: 0.03 };
    const TAU: f64 = std::f64::consts::TAU;
}
