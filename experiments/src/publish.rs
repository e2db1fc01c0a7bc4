//! From result folders to what is committed, and from that to figures.
//!
//! A kept result has `runs.csv` with six digits, the series and timings that its figures are drawn from, `tests.csv` where
//! the spec names a baseline, and the manifest: small enough for a repository, and all that figures,
//! tables and findings need.

use crate::{
    contrasts::{Baseline, Contrast},
    data::Frame,
    fail::Fail,
    figures::Figure,
    plan::Planned,
    spec::Spec,
};
use rowgram::io::output;
use std::path::{Path, PathBuf};

/// Significant digits of kept numbers: more than any interval of a mean resolves.
const DIGITS: usize = 6;

/// Larger series are not kept; their figures need the run.
const MAX_BYTES: u64 = 400_000;

/// Copies a merged result into the folder of kept ones; says how many bytes it has.
pub(crate) fn keep(result: &Path, results: &Path) -> Result<(String, u64), Fail> {
    let spec = Planned::load(result)?.plan.spec;
    let folder = results.join(&spec.name);
    let series = folder.join("traces");
    std::fs::create_dir_all(&series).map_err(|e| Fail::io(&series, &e))?;
    let mut bytes = 0;
    for name in tables_of(&spec) {
        let (from, to) = (result.join(&name), folder.join(&name));
        let size = copy_rounded(&from, &to)?;
        if name != "runs.csv" && size > MAX_BYTES {
            std::fs::remove_file(&to).map_err(|e| Fail::io(&to, &e))?;
        } else {
            bytes += size;
        }
    }
    for name in ["manifest.json", "sensitivity.csv"] {
        let from = result.join(name);
        if from.exists() {
            let text = std::fs::read(&from).map_err(|e| Fail::io(&from, &e))?;
            output::write(&folder.join(name), true, |out| out.write_all(&text))?;
            bytes += text.len() as u64;
        }
    }
    // Stays only where there is something in it.
    let _ = std::fs::remove_dir(&series);
    write_tests(&spec, &Frame::read(&folder.join("runs.csv"))?, &folder)?;
    Ok((spec.name, bytes))
}

/// The tables that a spec's figures, tables and findings are made from.
fn tables_of(spec: &Spec) -> Vec<String> {
    let mut names = vec!["runs.csv".to_owned()];
    for figure in &spec.figures {
        for name in [&figure.from, &figure.over].into_iter().filter_map(|name| table_of(name)) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
    }
    names
}

/// The file of a figure's table; `None` for none, and for the runs, which are always there.
fn table_of(name: &str) -> Option<String> {
    match name {
        "" | "runs" => None,
        "timing" => Some("timing.csv".to_owned()),
        series => Some(format!("traces/{series}.csv")),
    }
}

fn copy_rounded(from: &Path, to: &Path) -> Result<u64, Fail> {
    let frame = Frame::read(from)?;
    output::write(to, true, |out| {
        let mut writer = csv::Writer::from_writer(out);
        writer.write_record(&frame.header)?;
        for row in &frame.rows {
            writer.write_record(row.iter().map(|cell| rounded(cell)))?;
        }
        writer.flush()
    })?;
    Ok(std::fs::metadata(to).map_err(|e| Fail::io(to, &e))?.len())
}

/// A cell with fewer digits, where it is a number that has more.
fn rounded(cell: &str) -> String {
    match cell.parse::<f64>() {
        Ok(value) if value.is_finite() && cell.len() > DIGITS && cell.contains(['.', 'e']) => {
            let short = format!("{value:.*e}", DIGITS - 1);
            short.parse::<f64>().map_or_else(|_| cell.to_owned(), |value| format!("{value}"))
        }
        _ => cell.to_owned(),
    }
}

/// Writes `tests.csv` where the spec names a baseline.
pub(crate) fn write_tests(spec: &Spec, runs: &Frame, folder: &Path) -> Result<(), Fail> {
    let Some(baseline) = &spec.baseline else { return Ok(()) };
    let (found, columns) = contrasts(spec, baseline, runs)?;
    let axes: Vec<&str> = columns.iter().map(String::as_str).collect();
    baseline.write(&found, &axes, &folder.join("tests.csv"))
}

/// What the tests against the spec's baseline show, in a sentence; nothing without a baseline.
pub(crate) fn tests_sentence(spec: &Spec, runs: &Frame) -> Result<String, Fail> {
    let Some(baseline) = &spec.baseline else { return Ok(String::new()) };
    Ok(baseline.sentence(&contrasts(spec, baseline, runs)?.0))
}

fn contrasts(
    spec: &Spec,
    baseline: &Baseline,
    runs: &Frame,
) -> Result<(Vec<Contrast>, Vec<String>), Fail> {
    let fail = |e: String| Fail::Failed(format!("{}: baseline: {e}", spec.name));
    let columns = spec.columns().map_err(fail)?;
    let axes: Vec<&str> = columns.iter().map(String::as_str).collect();
    Ok((baseline.contrasts(runs, &axes).map_err(fail)?, columns))
}

/// Figures and tables of a spec from the tables in `result`, into `folder`.
pub(crate) fn draw(spec: &Spec, result: &Path, folder: &Path) -> Result<(), Fail> {
    std::fs::create_dir_all(folder).map_err(|e| Fail::io(folder, &e))?;
    let runs = Frame::read(&result.join("runs.csv"))?;
    drawn(spec, result).try_for_each(|figure| figure.draw(result, folder))?;
    spec.tables.iter().try_for_each(|table| table.write(&runs, folder))
}

/// The figures whose tables are in a result; series that are too large to be kept are missing in kept ones.
pub(crate) fn drawn<'a>(spec: &'a Spec, result: &'a Path) -> impl Iterator<Item = &'a Figure> {
    // A result that was not kept has every table, or the figure says which is missing.
    let complete = Planned::exists(result);
    spec.figures.iter().filter(move |figure| {
        let mut tables = [&figure.from, &figure.over].into_iter();
        complete || tables.all(|name| table_of(name).is_none_or(|name| result.join(name).exists()))
    })
}

/// The specs that have a kept result, each with its folder.
pub(crate) fn kept(specs: &[PathBuf], results: &Path) -> Result<Vec<(Spec, PathBuf)>, Fail> {
    let mut found = Vec::new();
    for path in specs {
        let (spec, _) = Spec::read(path, false)?;
        let result = results.join(&spec.name);
        if result.join("runs.csv").exists() {
            found.push((spec, result));
        }
    }
    if found.is_empty() {
        let message = format!("{}: no spec has a result here", results.display());
        return Err(Fail::Input(message));
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_without_their_series_are_left_out_of_kept_results() {
        let (spec, _) = Spec::parse(
            r#"
            name = "toy"
            title = "Toy"
            stage = "arena"
            seeds = { count = 1 }
            figure = [
                { name = "a", look = "bars", x = "seed", y = "solved" },
                { name = "b", look = "convergence", from = "descent", x = "evaluations", y = "excess" },
            ]
            "#,
            false,
        )
        .unwrap();
        assert_eq!(tables_of(&spec), ["runs.csv", "traces/descent.csv"]);
        let folder = tempfile::tempdir().unwrap();
        let names = |result: &Path| -> Vec<String> {
            drawn(&spec, result).map(|figure| figure.name.clone()).collect()
        };
        assert_eq!(names(folder.path()), ["a"]);
        // A run has to have it, and says so where it does not.
        std::fs::write(folder.path().join("plan.json"), "{}").unwrap();
        assert_eq!(names(folder.path()), ["a", "b"]);
    }

    #[test]
    fn numbers_keep_six_digits() {
        for (long, short) in [
            ("0.7391304347826086", "0.73913"),
            ("-123456.789", "-123457"),
            ("1.23456789e-12", "0.00000000000123457"),
            ("200000", "200000"),
            ("1234567", "1234567"),
            ("fixed, 4 px", "fixed, 4 px"),
            ("", ""),
        ] {
            assert_eq!(rounded(long), short);
        }
    }
}
