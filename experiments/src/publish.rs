//! From result folders to what is committed, and from that to figures.
//!
//! A kept result has `runs.csv` with six digits, the series and timings that its figures are drawn from, `tests.csv` where
//! the spec names a baseline, and the manifest: small enough for a repository, and all that figures,
//! tables and findings need.

use crate::{
    contrasts::{Baseline, Contrast},
    data::Frame,
    fail::Fail,
    plan::Planned,
    spec::Spec,
};
use rowgram::io::output;
use std::path::{Path, PathBuf};

/// Significant digits of kept numbers: more than any interval of a mean resolves.
const DIGITS: usize = 6;

/// Copies a merged result into the folder of kept ones; says how many bytes it has.
pub(crate) fn keep(result: &Path, results: &Path) -> Result<(String, u64), Fail> {
    let spec = Planned::load(result)?.plan.spec;
    let folder = results.join(&spec.name);
    let series = folder.join("traces");
    std::fs::create_dir_all(&series).map_err(|e| Fail::io(&series, &e))?;
    let mut bytes = 0;
    for name in tables_of(&spec) {
        bytes += copy_rounded(&result.join(&name), &folder.join(&name))?;
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
        for table in [&figure.from, &figure.over] {
            let name = match table.as_str() {
                "" | "runs" => continue,
                "timing" => "timing.csv".to_owned(),
                trace => format!("traces/{trace}.csv"),
            };
            if !names.contains(&name) {
                names.push(name);
            }
        }
    }
    names
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
    spec.figures.iter().try_for_each(|figure| figure.draw(result, folder))?;
    spec.tables.iter().try_for_each(|table| table.write(&runs, folder))
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
