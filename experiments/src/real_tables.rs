//! Tables of the locators on real photos and synthetic fields.

use crate::{
    compare::{Comparison, holm, judge},
    data::Summary,
    fail::{Fail, write_csv},
    real_fields::{Described, Row},
    real_locators::BASELINE,
    twin_statistics::NAMES,
};
use std::path::Path;

/// Whether a set of this name is among those that are joined.
type IsMember = fn(&str) -> bool;

/// Real sets that are joined, each of them counting once.
const JOINED: [(&str, IsMember); 2] = [("all real sets", |_| true), (ROWS, is_maize)];
/// The sets of a crop in rows that photos show over several plants.
const ROWS: &str = "maize in rows";

fn is_maize(set: &str) -> bool {
    set.starts_with("maize") || set.starts_with("stand_count")
}

/// One locator on one set.
struct Line {
    set: String,
    real: bool,
    method: &'static str,
    f1: Summary,
    error: Option<Summary>,
    count: Summary,
    count_apart: f64,
    at_limit: usize,
    choice: String,
    against: Option<Comparison>,
}

/// Writes all of it.
pub(crate) fn write(out: &Path, rows: &[Row], described: &[Described]) -> Result<(), Fail> {
    let lines = summary(rows);
    write_csv(&out.join("real.csv"), &long(rows))?;
    write_csv(&out.join("real-summary.csv"), &summary_table(&lines))?;
    write_csv(&out.join("twin-statistics.csv"), &statistics(described))?;
    write_csv(&out.join("real-against-synthetic.csv"), &against_synthetic(&lines))?;
    Ok(())
}

type Cells = Vec<Vec<String>>;

fn header(names: &[&str]) -> Vec<String> {
    names.iter().map(|&name| name.to_owned()).collect()
}

fn number(value: f64) -> String {
    // Adding 0 makes a negative zero positive.
    if value.is_finite() { format!("{:.4}", value + 0.0) } else { String::new() }
}

fn long(rows: &[Row]) -> Cells {
    let mut cells = vec![header(&[
        "set",
        "real",
        "photo",
        "method",
        "truth",
        "found",
        "f1",
        "median_error",
        "count_error",
        "sweeps",
        "stop",
    ])];
    cells.extend(rows.iter().map(|row| {
        let judged = &row.judged;
        let real = u8::from(row.real).to_string();
        let mut cells = vec![row.set.clone(), real, row.photo.clone(), row.method.to_owned()];
        cells.extend([row.truth.to_string(), judged.found.to_string(), number(judged.f1)]);
        cells.push(judged.median_error.map(number).unwrap_or_default());
        cells.extend([number(row.count_error()), judged.sweeps.to_string(), judged.stop.clone()]);
        cells
    }));
    cells
}

/// Different values in the order in which they appear.
fn in_order<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
    let mut found = Vec::new();
    for value in values {
        if !found.contains(&value) {
            found.push(value);
        }
    }
    found
}

/// Every set and locator, tested against the baseline on the same photos; then joined sets, every set counting once.
fn summary(rows: &[Row]) -> Vec<Line> {
    let sets = in_order(rows.iter().map(|row| (row.set.clone(), row.real)));
    let methods = in_order(rows.iter().map(|row| row.method));
    let mut lines = Vec::new();
    for (set, real) in &sets {
        let of = |method: &str| -> Vec<&Row> {
            rows.iter().filter(|row| row.set == *set && row.method == method).collect()
        };
        let base = of(BASELINE);
        for &method in &methods {
            let mine = of(method);
            let values = |f: &dyn Fn(&Row) -> f64| mine.iter().map(|r| f(r)).collect::<Vec<_>>();
            let counts = values(&Row::count_error);
            let (Some(f1), Some(count)) =
                (Summary::of(&values(&|r| r.judged.f1)), Summary::of(&counts))
            else {
                continue;
            };
            let errors: Vec<f64> = mine.iter().filter_map(|r| r.judged.median_error).collect();
            let pairs: Vec<[f64; 2]> =
                base.iter().zip(&mine).map(|(a, b)| [a.judged.f1, b.judged.f1]).collect();
            let limit = crate::real_locators::MOST_SWEEPS;
            lines.push(Line {
                set: set.clone(),
                real: *real,
                method,
                f1,
                error: Summary::of(&errors),
                count,
                count_apart: counts.iter().map(|c| c.abs()).sum::<f64>() / counts.len() as f64,
                at_limit: mine.iter().filter(|r| r.judged.sweeps == limit).count(),
                choice: mine.first().map(|r| r.choice.clone()).unwrap_or_default(),
                against: (method != BASELINE).then(|| judge(set.clone(), "f1".into(), &pairs)),
            });
        }
    }
    let mut joined = Vec::new();
    for ((name, belongs), &method) in
        JOINED.iter().flat_map(|joined| methods.iter().map(move |method| (joined, method)))
    {
        let of = |method: &str, f: &dyn Fn(&Line) -> Option<f64>| -> Vec<f64> {
            let mine = lines.iter().filter(|l| l.real && belongs(&l.set) && l.method == method);
            mine.filter_map(f).collect()
        };
        let f1 = of(method, &|line| Some(line.f1.mean));
        let base = of(BASELINE, &|line| Some(line.f1.mean));
        let counts = of(method, &|line| Some(line.count.mean));
        let apart = of(method, &|line| Some(line.count_apart));
        let (Some(f1_mean), Some(count)) = (Summary::of(&f1), Summary::of(&counts)) else {
            continue;
        };
        let pairs: Vec<[f64; 2]> = base.iter().zip(&f1).map(|(a, b)| [*a, *b]).collect();
        joined.push(Line {
            set: (*name).to_owned(),
            real: true,
            method,
            f1: f1_mean,
            error: Summary::of(&of(method, &|line| line.error.map(|e| e.mean))),
            count,
            count_apart: apart.iter().sum::<f64>() / apart.len() as f64,
            at_limit: 0,
            choice: String::new(),
            against: (method != BASELINE).then(|| judge((*name).to_owned(), "f1".into(), &pairs)),
        });
    }
    lines.extend(joined);
    holm(lines.iter_mut().filter_map(|line| line.against.as_mut()));
    lines
}

fn summary_table(lines: &[Line]) -> Cells {
    let mut cells = vec![header(&[
        "set",
        "method",
        "photos",
        "f1",
        "f1_half_interval",
        "difference",
        "difference_half_interval",
        "probability",
        "median_error",
        "count_error",
        "count_error_apart",
        "at_sweep_limit",
        "choice",
    ])];
    cells.extend(lines.iter().map(|line| {
        let mut row = vec![line.set.clone(), line.method.to_owned(), line.f1.count.to_string()];
        row.extend([number(line.f1.mean), number(line.f1.half)]);
        row.extend(match &line.against {
            Some(c) => {
                let probability = format!("{:.2e}", c.probability);
                [number(c.mean_b - c.mean_a), number(c.half), probability]
            }
            None => [const { String::new() }; 3],
        });
        row.push(line.error.map(|e| number(e.mean)).unwrap_or_default());
        row.extend([number(line.count.mean), number(line.count_apart)]);
        row.extend([line.at_limit.to_string(), line.choice.clone()]);
        row
    }));
    cells
}

fn statistics(described: &[Described]) -> Cells {
    let sets = in_order(described.iter().map(|d| d.set.as_str()));
    let mut cells = vec![header(&["statistic", "about", "set", "photos", "mean", "half_interval"])];
    for (k, (name, about)) in NAMES.into_iter().enumerate() {
        for &set in &sets {
            let mine = described.iter().filter(|d| d.set == set);
            let values: Vec<f64> = mine.filter_map(|d| d.values[k]).collect();
            let Some(found) = Summary::of(&values) else { continue };
            let mut row = header(&[name, about, set]);
            row.extend([found.count.to_string(), number(found.mean), number(found.half)]);
            cells.push(row);
        }
    }
    cells
}

/// Ranks from the largest value, 1 to n; equal values share the mean of theirs.
fn ranks(values: &[f64]) -> Vec<f64> {
    let rank = |value: &f64| {
        let above = values.iter().filter(|other| *other > value).count() as f64;
        let same = values.iter().filter(|other| *other == value).count() as f64;
        above + 0.5 * (same + 1.0)
    };
    values.iter().map(rank).collect()
}

/// F1 of every locator on every kind of synthetic field and on joined real sets, with its rank in either.
fn against_synthetic(lines: &[Line]) -> Cells {
    let methods = in_order(lines.iter().map(|line| line.method));
    let of = |set: &str| -> Vec<f64> {
        let mine = |method: &&str| {
            let line = lines.iter().find(|line| line.set == set && line.method == *method);
            line.map_or(f64::NAN, |line| line.f1.mean)
        };
        methods.iter().map(mine).collect()
    };
    let mut pairs = vec![header(&[
        "field",
        "set",
        "method",
        "synthetic_f1",
        "real_f1",
        "synthetic_rank",
        "real_rank",
    ])];
    for field in in_order(lines.iter().filter(|line| !line.real).map(|line| &line.set)) {
        let synthetic = of(field);
        let a = ranks(&synthetic);
        for (name, _) in JOINED {
            let real = of(name);
            let b = ranks(&real);
            for (k, method) in methods.iter().enumerate() {
                let mut row = header(&[field, name, method]);
                row.extend([synthetic[k], real[k], a[k], b[k]].map(number));
                pairs.push(row);
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::real_locators::Judged;

    #[test]
    fn equal_values_share_a_rank() {
        assert_eq!(ranks(&[0.9, 0.1, 0.5, 0.5]), [1.0, 4.0, 2.5, 2.5]);
    }

    #[test]
    fn photos_are_paired_and_sets_count_once() {
        let row = |set: &str, photo: &str, method, f1| Row {
            set: set.to_owned(),
            real: true,
            photo: photo.to_owned(),
            method,
            choice: String::new(),
            truth: 10,
            judged: Judged { found: 9, f1, median_error: None, sweeps: 1, stop: String::new() },
        };
        let rows = [
            row("a", "1", BASELINE, 0.2),
            row("a", "1", "other", 0.4),
            row("a", "2", BASELINE, 0.3),
            row("a", "2", "other", 0.5),
            row("a", "3", BASELINE, 0.4),
            row("a", "3", "other", 0.6),
            row("b", "1", BASELINE, 0.8),
            row("b", "1", "other", 0.9),
        ];
        let lines = summary(&rows);
        let of = |set: &str| lines.iter().find(|l| l.set == set && l.method == "other").unwrap();
        let a = of("a").against.as_ref().unwrap();
        assert!((a.mean_b - a.mean_a - 0.2).abs() < 1e-12 && a.probability < 0.05, "{a:?}");
        // (0.5 + 0.9) / 2, not the mean of the four photos.
        assert!((of("all real sets").f1.mean - 0.7).abs() < 1e-12);
        assert!((of("a").count.mean + 0.1).abs() < 1e-12);
    }
}
