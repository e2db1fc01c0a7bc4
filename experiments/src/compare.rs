//! Which cells of two results differ beyond their intervals.
//!
//! Runs are paired by cell and seed. For the differences `d_k = b_k - a_k` of a metric,
//!
//! ```text
//! t = mean(d) / (s_d / sqrt(n)),   effect size d_z = mean(d) / s_d,
//! ```
//!
//! with a two-sided Student test; the probabilities of all cells and metrics are corrected by Holm's
//! step-down. A cell differs where the corrected probability is below the level. Reference: S. Holm, "A
//! simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979.

use crate::{data::Frame, fail::Fail};
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::{
    collections::BTreeMap,
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// A metric of a cell in two results.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Comparison {
    pub(crate) cell: String,
    pub(crate) metric: String,
    pub(crate) pairs: usize,
    pub(crate) mean_a: f64,
    pub(crate) mean_b: f64,
    /// Half the 95 % interval of the mean difference.
    pub(crate) half: f64,
    /// Mean difference over the standard deviation of the differences.
    pub(crate) effect: f64,
    /// Probability of such a difference without a cause, corrected for the number of tests.
    pub(crate) probability: f64,
    /// Largest relative difference of a pair, rounding aside.
    pub(crate) largest: f64,
}

/// The table of a result: the file itself, or `runs.csv` of a folder.
pub(crate) fn runs_of(path: &Path) -> PathBuf {
    if path.is_dir() { path.join("runs.csv") } else { path.to_path_buf() }
}

type Values = BTreeMap<(String, String), BTreeMap<String, f64>>;

/// Metrics by (cell, seed), and the runs that failed.
fn values(frame: &Frame, path: &Path) -> Result<Values, Fail> {
    let place = |name: &str| {
        frame.column(name).map_err(|e| Fail::Input(format!("{}: {e}", path.display())))
    };
    let (seed, reason) = (place("seed")?, place("reason")?);
    let mut found = Values::new();
    for row in &frame.rows {
        let cell: Vec<String> =
            (1..seed).map(|c| format!("{} = {}", frame.header[c], row[c])).collect();
        let cell = if cell.is_empty() { "base".to_owned() } else { cell.join(", ") };
        let metrics = (reason + 1..row.len())
            .filter_map(|c| Some((frame.header[c].clone(), row[c].parse().ok()?)))
            .collect();
        found.insert((cell, row[seed].clone()), metrics);
    }
    Ok(found)
}

/// Compares two results; also says which runs are in one of them only.
pub(crate) fn compare(a: &Path, b: &Path) -> Result<(Vec<Comparison>, Vec<String>), Fail> {
    let (a, b) = (runs_of(a), runs_of(b));
    let first = values(&Frame::read(&a)?, &a)?;
    let second = values(&Frame::read(&b)?, &b)?;
    let mut lonely = Vec::new();
    for (one, other, path) in [(&first, &second, &a), (&second, &first, &b)] {
        for (cell, seed) in one.keys().filter(|key| !other.contains_key(*key)) {
            lonely.push(format!("only in {}: {cell}, seed {seed}", path.display()));
        }
    }
    let mut pairs: BTreeMap<(String, String), Vec<[f64; 2]>> = BTreeMap::new();
    for ((cell, seed), metrics) in &first {
        let Some(others) = second.get(&(cell.clone(), seed.clone())) else { continue };
        for name in metrics.keys().chain(others.keys().filter(|k| !metrics.contains_key(*k))) {
            match (metrics.get(name), others.get(name)) {
                (Some(&a), Some(&b)) => {
                    pairs.entry((cell.clone(), name.clone())).or_default().push([a, b]);
                }
                _ => lonely.push(format!("{name} in one only: {cell}, seed {seed}")),
            }
        }
    }
    let mut found: Vec<Comparison> =
        pairs.into_iter().map(|((cell, metric), pairs)| judge(cell, metric, &pairs)).collect();
    holm(&mut found);
    Ok((found, lonely))
}

/// Nothing is measured to this, in whatever unit: smaller differences are the arithmetic's.
const ROUNDING: f64 = 1e-11;

/// Tests the mean difference of pairs.
pub(crate) fn judge(cell: String, metric: String, pairs: &[[f64; 2]]) -> Comparison {
    let count = pairs.len() as f64;
    let mean = |k: usize| pairs.iter().map(|pair| pair[k]).sum::<f64>() / count;
    let differences: Vec<f64> = pairs.iter().map(|[a, b]| b - a).collect();
    let shift = differences.iter().sum::<f64>() / count;
    let squares: f64 = differences.iter().map(|d| (d - shift).powi(2)).sum();
    let spread = (squares / (count - 1.0)).sqrt();
    let relative = |[a, b]: &[f64; 2]| {
        let apart = (b - a).abs();
        if apart <= ROUNDING { 0.0 } else { apart / a.abs().max(b.abs()) }
    };
    let largest = pairs.iter().map(relative).fold(0.0, f64::max);
    let student = StudentsT::new(0.0, 1.0, (count - 1.0).max(1.0)).ok();
    let (half, effect, probability) = match student {
        // The same difference in every pair: certain if it is one.
        Some(_) if pairs.len() > 1 && spread == 0.0 => {
            let sure = shift != 0.0;
            (0.0, if sure { shift.signum() * f64::INFINITY } else { 0.0 }, f64::from(!sure))
        }
        Some(student) if pairs.len() > 1 => {
            let t = shift / (spread / count.sqrt());
            let half = student.inverse_cdf(0.975) * spread / count.sqrt();
            (half, shift / spread, 2.0 * student.cdf(-t.abs()))
        }
        // A single pair has no spread, and so no test.
        _ => (f64::NAN, f64::NAN, 1.0),
    };
    let (mean_a, mean_b, pairs) = (mean(0), mean(1), pairs.len());
    Comparison { cell, metric, pairs, mean_a, mean_b, half, effect, probability, largest }
}

/// Corrects the probabilities.
pub(crate) fn holm<'a>(found: impl IntoIterator<Item = &'a mut Comparison>) {
    let mut found: Vec<&mut Comparison> = found.into_iter().collect();
    let mut order: Vec<usize> = (0..found.len()).collect();
    order.sort_by(|&a, &b| found[a].probability.total_cmp(&found[b].probability));
    let mut least: f64 = 0.0;
    for (rank, &place) in order.iter().enumerate() {
        let corrected = found[place].probability * (found.len() - rank) as f64;
        least = least.max(corrected.min(1.0));
        found[place].probability = least;
    }
}

/// What differs, for people.
pub(crate) fn report(found: &[Comparison], lonely: &[String], level: f64) -> String {
    let differ: Vec<&Comparison> = found.iter().filter(|c| c.probability < level).collect();
    // Writing to a string does not fail.
    let mut text = format!(
        "{} comparisons, {} differ at the level {level} (paired t tests, Holm)\n",
        found.len(),
        differ.len()
    );
    if !differ.is_empty() {
        text += "\n| cell | metric | pairs | A | B | B - A | effect size | probability |\n";
        text += "|---|---|---|---|---|---|---|---|\n";
    }
    for c in differ {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {:.5} | {:.5} | {:+.5} +- {:.5} | {:+.2} | {:.2e} |",
            c.cell,
            c.metric,
            c.pairs,
            c.mean_a,
            c.mean_b,
            c.mean_b - c.mean_a,
            c.half,
            c.effect,
            c.probability
        );
    }
    for line in lonely {
        let _ = writeln!(text, "{line}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_paired_test_sees_what_intervals_hide() {
        // Far apart between seeds, about 1 apart within a pair: t = 16.266 with 3 degrees of freedom,
        // p = 1 - 2/pi (atan s + s/(1 + s^2)) with s = t/sqrt 3, 0.000507.
        let pairs = [[1.0, 2.0], [10.0, 11.1], [100.0, 100.9], [50.0, 51.2]];
        let found = judge("c".into(), "m".into(), &pairs);
        assert!((found.effect - 8.133).abs() < 2e-3, "{}", found.effect);
        assert!((found.probability - 5.07e-4).abs() < 2e-6, "{}", found.probability);
        let same = judge("c".into(), "m".into(), &[[1.0, 1.0], [2.0, 2.0]]);
        assert_eq!((same.probability, same.largest), (1.0, 0.0));
        let single = judge("c".into(), "m".into(), &[[1.0, 2.0]]);
        assert_eq!((single.probability, single.largest), (1.0, 0.5));
    }

    #[test]
    fn many_tests_are_corrected() {
        let with = |probability| Comparison {
            probability,
            ..judge(String::new(), String::new(), &[[0.0, 0.0], [0.0, 0.0]])
        };
        let mut found = [with(0.04), with(0.01), with(0.03)];
        holm(&mut found);
        let corrected: Vec<f64> = found.iter().map(|c| (c.probability * 1e4).round()).collect();
        assert_eq!(corrected, [600.0, 300.0, 600.0]);
    }
}
