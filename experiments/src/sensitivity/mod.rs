//! Variance-based sensitivity: a Saltelli design over factors, and indices from its runs.
//!
//! `[sensitivity]` draws two samples `A` and `B` of `samples` rows each, as a shifted Sobol' sequence in twice as many
//! coordinates as there are draws; the cells are all rows of `A`, of `B`, and for each factor the rows of `A` with
//! the numbers of that factor from `B`. Draws that name the same `factor` are one factor: the size of an error and
//! its realisation, say, so that a trait's error is shared out among the errors that went in. What the indices
//! are computed from are the columns `matrix` and `sample` of runs.csv; seeds of a cell are averaged.

mod indices;
mod sobol;

pub(crate) use indices::{Index, Indices, Interval};

use crate::{
    data::Frame,
    fail::Fail,
    keys,
    spec::{Draw, Labels, Level, text},
    streams::{Stream, stream},
};
use indices::Row;
use rand::RngExt;
use rowgram::io::output;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, path::Path};
use toml::Table;

/// The columns that tell the cells apart.
pub(crate) const COLUMNS: [&str; 2] = ["matrix", "sample"];
const SAMPLES: [&str; 2] = ["A", "B"];

/// Which inputs are varied, and how often.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Sensitivity {
    /// Rows of each sample; a power of 2 fills the cube evenly.
    pub(crate) samples: usize,
    pub(crate) seed: u64,
    #[serde(rename = "draw")]
    pub(crate) draws: Vec<Draw>,
}

/// A row of both samples in the unit cube.
struct UnitPoint {
    a: Vec<f64>,
    b: Vec<f64>,
}

impl UnitPoint {
    /// The row of `A` with the coordinates of a factor from `B`.
    fn mixed(&self, factor_of: &[usize], factor: usize) -> Vec<f64> {
        let both = self.a.iter().zip(&self.b).zip(factor_of);
        both.map(|((&a, &b), &of)| if of == factor { b } else { a }).collect()
    }
}

/// The rows of both samples.
fn unit_points(factor_of: &[usize], samples: usize, seed: u64) -> Vec<UnitPoint> {
    let mut rng = stream(seed, Stream::Sweep);
    let columns: Vec<_> =
        (0..2 * factor_of.len()).map(|j| (sobol::directions(j), rng.random::<u32>())).collect();
    (0..samples as u32)
        .map(|row| {
            let mut a: Vec<f64> =
                columns.iter().map(|(v, shift)| sobol::coordinate(v, row, *shift)).collect();
            let b = a.split_off(factor_of.len());
            UnitPoint { a, b }
        })
        .collect()
}

impl Sensitivity {
    /// The factors, in the order in which they appear.
    pub(crate) fn factors(&self) -> Vec<String> {
        let mut factors: Vec<String> = Vec::new();
        for draw in &self.draws {
            if !factors.iter().any(|factor| factor == draw.factor()) {
                factors.push(draw.factor().to_owned());
            }
        }
        factors
    }

    /// The columns of its cells.
    pub(crate) fn columns(&self) -> impl Iterator<Item = String> {
        let keys = self.draws.iter().map(|draw| draw.key.clone());
        COLUMNS.into_iter().map(str::to_owned).chain(keys)
    }

    /// All cells: row by row A, B, then the factors.
    pub(crate) fn levels(&self) -> Result<(Vec<Labels>, Vec<Level>), String> {
        let factors = self.factors();
        if self.samples < 2 || self.samples > u32::MAX as usize {
            return Err("sensitivity: expected at least 2 samples".to_owned());
        }
        if self.draws.is_empty() || 2 * self.draws.len() > sobol::MAX_COORDINATES {
            return Err(format!("sensitivity: expected 1 to {} draws", sobol::MAX_COORDINATES / 2));
        }
        if let Some(factor) = factors.iter().find(|factor| SAMPLES.contains(&factor.as_str())) {
            return Err(format!("sensitivity: {factor} is the name of a sample, not of a factor"));
        }
        let factor_of: Vec<usize> = self
            .draws
            .iter()
            .map(|draw| factors.iter().position(|f| f == draw.factor()).unwrap_or(0))
            .collect();
        let (mut labels, mut levels) = (Vec::new(), Vec::new());
        let points = unit_points(&factor_of, self.samples, self.seed);
        for (sample, point) in points.into_iter().enumerate() {
            let mixed = |(i, name): (usize, &String)| (name.clone(), point.mixed(&factor_of, i));
            let mixed: Vec<(String, Vec<f64>)> = factors.iter().enumerate().map(mixed).collect();
            let [a, b] = SAMPLES.map(str::to_owned);
            for (matrix, units) in [(a, point.a), (b, point.b)].into_iter().chain(mixed) {
                let (label, set) = self.setting(&matrix, sample, &units)?;
                labels.push(label);
                levels.push(Level { label: String::new(), set });
            }
        }
        Ok((labels, levels))
    }

    fn setting(
        &self,
        matrix: &str,
        sample: usize,
        units: &[f64],
    ) -> Result<(Labels, Table), String> {
        let [first, second] = COLUMNS.map(str::to_owned);
        let mut label = vec![(first, matrix.to_owned()), (second, sample.to_string())];
        let mut set = Table::new();
        for (draw, &unit) in self.draws.iter().zip(units) {
            let value = draw.at(unit).map_err(|e| format!("sensitivity {}: {e}", draw.key))?;
            label.push((draw.key.clone(), text(&value)));
            set.insert(draw.key.clone(), value);
        }
        Ok((label, set))
    }
}

/// The factors of a result.
pub(crate) fn factors(runs: &Frame) -> Result<Vec<String>, String> {
    let labels = runs.labels(COLUMNS[0])?;
    Ok(labels.into_iter().filter(|label| !SAMPLES.contains(&label.as_str())).collect())
}

/// The indices of a metric from its runs; rows of the samples that lack a run are left out.
pub(crate) fn of(runs: &Frame, metric: &str) -> Result<Option<Indices>, String> {
    let factors = factors(runs)?;
    let [matrix, sample] = COLUMNS;
    let (matrix, sample) = (runs.column(matrix)?, runs.column(sample)?);
    let value = runs.column(metric)?;
    // By sample and matrix the sum over the seeds and their number.
    let mut sums: BTreeMap<(usize, &str), (f64, f64)> = BTreeMap::new();
    for row in &runs.rows {
        let (Ok(at), Ok(value)) = (row[sample].parse(), row[value].parse::<f64>()) else {
            continue;
        };
        let sum = sums.entry((at, row[matrix].as_str())).or_default();
        *sum = (sum.0 + value, sum.1 + 1.0);
    }
    let count = sums.keys().map(|(at, _)| at + 1).max().unwrap_or(0);
    let row = |at: usize| {
        let mean = |name: &str| sums.get(&(at, name)).map(|(sum, count)| sum / count);
        let mixed = factors.iter().map(|factor| mean(factor)).collect::<Option<Vec<f64>>>()?;
        Some(Row { a: mean(SAMPLES[0])?, b: mean(SAMPLES[1])?, mixed })
    };
    let rows: Vec<Row> = (0..count).filter_map(row).collect();
    Ok(indices::indices(&rows, factors.len()))
}

/// The first-order or total index of a factor.
pub(crate) fn one(runs: &Frame, metric: &str, factor: &str, total: bool) -> Result<f64, String> {
    let names = factors(runs)?;
    let place = names
        .iter()
        .position(|name| name == factor)
        .ok_or_else(|| keys::unknown("factor", factor, names.iter().map(String::as_str)))?;
    let found = of(runs, metric)?.ok_or_else(|| format!("{metric} does not vary"))?;
    let index = found.factors[place];
    Ok(if total { index.total.value } else { index.first.value })
}

/// The factor with the greatest total index, leaving out some.
pub(crate) fn foremost(runs: &Frame, metric: &str, without: &str) -> Result<String, String> {
    let names = factors(runs)?;
    let found = of(runs, metric)?.ok_or_else(|| format!("{metric} does not vary"))?;
    let total = |k: &usize| found.factors[*k].total.value;
    (0..names.len())
        .filter(|&k| names[k] != without)
        .max_by(|a, b| total(a).total_cmp(&total(b)))
        .map(|k| names[k].clone())
        .ok_or_else(|| "there is no factor".to_owned())
}

/// Writes `sensitivity.csv`: one row for each metric and factor.
pub(crate) fn write(runs: &Frame, metrics: &[&str], path: &Path) -> Result<(), Fail> {
    let fail = |e: String| Fail::Failed(format!("sensitivity: {e}"));
    let names = factors(runs).map_err(fail)?;
    let mut rows = vec![
        [
            "metric",
            "factor",
            "samples",
            "mean",
            "standard_deviation",
            "first",
            "first_low",
            "first_high",
            "total",
            "total_low",
            "total_high",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];
    for &metric in metrics {
        let Some(found) = of(runs, metric).map_err(fail)? else { continue };
        for (name, Index { first, total }) in names.iter().zip(&found.factors) {
            let mut row = vec![metric.to_owned(), name.clone(), found.rows.to_string()];
            let numbers = [
                found.mean,
                found.deviation,
                first.value,
                first.low,
                first.high,
                total.value,
                total.low,
                total.high,
            ];
            row.extend(numbers.map(|value| format!("{value:.5}")));
            rows.push(row);
        }
    }
    output::write(path, true, |out| {
        let mut writer = csv::Writer::from_writer(out);
        rows.iter().try_for_each(|row| writer.write_record(row))?;
        writer.flush()
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::Spec;

    const SPEC: &str = "
        name = 'a'\n title = 'A'\n stage = 'locate'\n metrics = ['f1_5cm']\n seeds = { count = 1 }
        [sensitivity]\n samples = 4\n seed = 1
        [[sensitivity.draw]]\n factor = 'sowing'\n key = 'scenario.field.jitter_along'\n uniform = [0.0, 0.3]
        [[sensitivity.draw]]\n factor = 'sowing'\n key = 'scenario.field.missing_fraction'\n uniform = [0.0, 0.3]
        [[sensitivity.draw]]\n key = 'scenario.field.spacing_m'\n uniform = [0.1, 0.3]
        [small]\n samples = 2
    ";

    #[test]
    fn a_design_takes_one_factor_at_a_time_from_the_other_sample() {
        let (_, cells) = Spec::parse(SPEC, false).unwrap();
        assert_eq!(cells.len(), 4 * (2 + 2));
        let [a, b, sowing, spacing] = [0, 1, 2, 3].map(|k| &cells[k].at);
        assert_eq!(a[0], ("matrix".to_owned(), "A".to_owned()));
        assert_eq!(sowing[0].1, "sowing");
        assert_eq!(spacing[0].1, "scenario.field.spacing_m");
        assert_eq!((&sowing[2..4], &sowing[4]), (&b[2..4], &a[4]));
        assert_eq!((&spacing[2..4], &spacing[4]), (&a[2..4], &b[4]));
        assert!((2..5).all(|k| a[k] != b[k]));
        assert_eq!(Spec::parse(SPEC, true).unwrap().1.len(), 2 * 4);
        // More samples leave the first ones as they are.
        let (_, more) = Spec::parse(&SPEC.replace("samples = 4", "samples = 8"), false).unwrap();
        assert_eq!(more[..16], cells[..]);
    }

    #[test]
    fn mistakes_are_found_before_any_work() {
        for (good, bad, part) in [
            ("samples = 4", "samples = 1", "at least 2"),
            ("factor = 'sowing'", "factor = 'A'", "name of a sample"),
            ("uniform = [0.1, 0.3]", "uniform = [-0.1, 0.3]", "spacing_m"),
            (
                "[small]",
                "[[axis]]\n key = 'tempering'\n values = [0.0, 6.0]\n [small]",
                "without axes",
            ),
            ("[small]", "[random]\n count = 1\n seed = 1\n draw = []\n [small]", "without axes"),
        ] {
            let error = Spec::parse(&SPEC.replace(good, bad), false).unwrap_err();
            assert!(error.contains(part), "{bad}: {error}");
        }
    }

    /// The runs of a design whose metric is a function of the drawn values.
    fn runs(f: impl Fn(f64, f64, f64) -> f64) -> Frame {
        let spec = SPEC.replace("samples = 4", "samples = 256");
        let (_, cells) = Spec::parse(&spec, false).unwrap();
        let mut header: Vec<String> = cells[0].at.iter().map(|(name, _)| name.clone()).collect();
        header.push("y".to_owned());
        let rows = cells
            .iter()
            .map(|cell| {
                let mut row: Vec<String> = cell.at.iter().map(|(_, label)| label.clone()).collect();
                let [x, y, z] = [2, 3, 4].map(|k| row[k].parse::<f64>().unwrap());
                row.push(f(x, y, z).to_string());
                row
            })
            .collect();
        Frame { header, rows }
    }

    #[test]
    fn indices_come_from_the_runs_and_rows_with_a_gap_are_left_out() {
        let mut runs = runs(|x, y, z| x + y + z);
        // Variances as 0.3^2 + 0.3^2 to 0.2^2.
        let sowing = 18.0 / 22.0;
        assert!((one(&runs, "y", "sowing", false).unwrap() - sowing).abs() < 0.02);
        assert!((one(&runs, "y", "sowing", true).unwrap() - sowing).abs() < 0.02);
        assert_eq!(foremost(&runs, "y", "").unwrap(), "sowing");
        assert_eq!(foremost(&runs, "y", "sowing").unwrap(), "scenario.field.spacing_m");
        assert!(one(&runs, "y", "sown", true).unwrap_err().contains("did you mean `sowing`"));
        runs.rows[5][5].clear();
        assert_eq!(of(&runs, "y").unwrap().unwrap().rows, 255);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sensitivity.csv");
        write(&runs, &["y"], &path).unwrap();
        let text = std::fs::read_to_string(path).unwrap();
        assert!(text.contains("\ny,sowing,255,0.49936,"), "{text}");
    }
}
