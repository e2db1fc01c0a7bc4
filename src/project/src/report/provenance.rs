//! The last sections of the page: how good it is, and how to do it again.

use super::{
    Facts,
    page::{Section, digits, table},
};
use crate::run::Ending;
use maud::html;

/// What was found, compared with ground truth.
pub(super) fn truth(facts: &Facts<'_>) -> Section {
    let evaluate = facts.outcome.results.evaluate.as_ref()?;
    let score = &evaluate.score;
    let radii: Vec<Vec<String>> = evaluate
        .radii_m
        .iter()
        .zip(&score.radii)
        .map(|(radius_m, of)| {
            let mut row = vec![format!("{:.0} cm", 100.0 * radius_m)];
            row.extend([of.precision, of.recall, of.f1].map(|share| digits(share, 3)));
            row
        })
        .collect();
    let plots: Vec<Vec<String>> = evaluate
        .plots
        .iter()
        .map(|plot| {
            let by_hand = if plot.is_counted_by_hand { "yes" } else { "" };
            vec![
                plot.plot.clone(),
                plot.true_plants.to_string(),
                plot.found_plants.to_string(),
                digits(plot.true_leaves, 0),
                digits(plot.leaves_by_area, 0),
                by_hand.to_owned(),
            ]
        })
        .collect();
    let content = html! {
        p {
            (score.truth) " true plants are on the map (" (evaluate.true_plants_not_shown) " lie outside of it), "
            (score.found) " were found; median error of the pairs "
            (digits(evaluate.median_error_m.map(|m| 100.0 * m), 1)) " cm."
        }
        (table(&["within", "precision", "recall", "F1"], &radii))
        @if !plots.is_empty() {
            h3 { "By plot" }
            (table(&["plot", "plants, true", "found", "leaves, true", "by area", "counted by hand"], &plots))
            @if let Some(leaves) = &evaluate.leaf_validation {
                p .note {
                    "The " (leaves.plots) " plots whose leaves were not counted by hand: "
                    (format!("{:.0}", leaves.leaves_by_area)) " leaves by area, " (format!("{:.0}", leaves.true_leaves))
                    " true (" (format!("{:+.1} %", 100.0 * leaves.relative_error)) ")."
                }
            }
        }
    };
    Some(("truth", "Truth", content))
}

/// What was done, with what, how long it took, and how to do it again.
pub(super) fn provenance(facts: &Facts<'_>) -> Section {
    let rows: Vec<Vec<String>> = facts
        .records
        .iter()
        .map(|record| {
            vec![
                record.stage.to_string(),
                format!("{:.1}", record.seconds),
                digits(record.peak_memory_mb, 0),
                record.inputs.len().to_string(),
                record.outputs.len().to_string(),
                record.key.chars().take(12).collect(),
            ]
        })
        .collect();
    let mut inputs: Vec<_> = facts
        .records
        .iter()
        .flat_map(|record| &record.inputs)
        .filter(|input| {
            !facts.records.iter().any(|r| r.outputs.iter().any(|output| output.path == input.path))
        })
        .collect();
    inputs.sort_by(|a, b| a.path.cmp(&b.path));
    inputs.dedup_by(|a, b| a.path == b.path);
    let content = html! {
        (table(&["stage", "seconds", "peak memory, MB", "files read", "files written", "key"], &rows))
        ul { @for report in &facts.outcome.stages {
            @if let Some(why) = &report.reason {
                li { b { (report.stage) } @if report.ending == Ending::Failed { " failed" } ": " (why) }
            }
        } }
        h3 { "The same again" }
        p .note { "In the project's folder; results do not depend on the number of threads." }
        pre { code { @for record in &facts.records { (record.command) "\n" } } }
        details {
            summary { "Inputs (" (inputs.len()) " files)" }
            div .scroll { table {
                thead { tr { th { "file" } th { "bytes" } th .left { "SHA-256" } } }
                tbody { @for input in inputs.iter().take(2000) { tr {
                    td { (input.path.display().to_string()) } td { (input.bytes) } td .left { code { (input.sha256) } }
                } } }
            } }
        }
    };
    Some(("provenance", "How it was made", content))
}
