//! Tidy CSV and Markdown from runs.

use crate::methods::{METHODS, Run};
use rowgram::io::output;
use std::{fmt::Write as _, path::Path};

/// Writes `NAME.csv`, one line per run, and `NAME.md`, the means per scenario and method.
pub(crate) fn write(
    folder: &Path,
    name: &str,
    title: &str,
    radii: &[&str],
    runs: &[Run],
) -> Result<(), rowgram::Error> {
    let path = folder.join(format!("{name}.csv"));
    output::write(&path, true, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        let mut header = vec!["scenario", "image", "method", "plants", "pixels"];
        let names: Vec<String> = radii.iter().map(|radius| format!("f1_{radius}")).collect();
        header.extend(names.iter().map(String::as_str));
        header.extend(["median_error_px", "sweeps", "stop"]);
        csv.write_record(header)?;
        for run in runs {
            let mut row = vec![run.scenario.clone(), run.image.clone(), run.method.to_owned()];
            row.extend([run.plants.to_string(), run.pixels.to_string()]);
            row.extend(run.f1.iter().map(|f1| format!("{f1:.4}")));
            row.push(run.median_error_px.map(|e| format!("{e:.3}")).unwrap_or_default());
            row.extend([run.sweeps.to_string(), run.stop.clone()]);
            csv.write_record(row)?;
        }
        csv.flush()
    })?;
    let text = markdown(title, radii, runs);
    let path = folder.join(format!("{name}.md"));
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

#[expect(clippy::print_stdout, reason = "the table is the output")]
fn show(text: &str) {
    println!("{text}");
}

/// One line per method, one column per scenario: mean F1 at each radius.
fn markdown(title: &str, radii: &[&str], runs: &[Run]) -> String {
    let mut scenarios: Vec<&str> = Vec::new();
    for run in runs {
        if !scenarios.contains(&run.scenario.as_str()) {
            scenarios.push(&run.scenario);
        }
    }
    // Writing to a string does not fail.
    let mut text = format!("# {title}\n\nMean F1 at {}", radii.join(" / "));
    let _ = writeln!(text, "; last column: mean of the median errors in pixels.\n");
    let _ = writeln!(text, "| method | {} | median error |", scenarios.join(" | "));
    let _ = writeln!(text, "|---|{}---|", "---|".repeat(scenarios.len()));
    for method in METHODS {
        let of = |scenario: &str| -> Vec<&Run> {
            let mine = |run: &&Run| run.method == method.name && run.scenario == scenario;
            runs.iter().filter(mine).collect()
        };
        let _ = write!(text, "| {} |", method.name);
        for scenario in &scenarios {
            let runs = of(scenario);
            let cells: Vec<String> = (0..radii.len())
                .map(|k| short(mean(runs.iter().filter_map(|run| run.f1.get(k).copied()))))
                .collect();
            let _ = write!(text, " {} |", cells.join(" / "));
        }
        let mine = runs.iter().filter(|run| run.method == method.name);
        let _ = writeln!(text, " {:.2} |", mean(mine.filter_map(|run| run.median_error_px)));
    }
    text
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
    sum / count
}

fn short(value: f64) -> String {
    format!("{value:.2}").trim_start_matches('0').to_owned()
}
