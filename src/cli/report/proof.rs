//! The last sections of the page: how good it is, and how to do it again.

use super::{
    facts::{Facts, number},
    page::{Section, table},
    sections::{array, digits, word},
};
use crate::error::Error;
use maud::html;

/// What was found against what is there.
pub(super) fn truth(facts: &Facts) -> Result<Section, Error> {
    let says = facts.says("evaluate");
    if says.is_null() {
        return Ok(None);
    }
    let radii: Vec<Vec<String>> = array(&says["radii_m"])
        .iter()
        .zip(array(&says["score"]["radii"]))
        .map(|(radius, score)| {
            let mut row = vec![format!("{:.0} cm", 100.0 * radius.as_f64().unwrap_or(f64::NAN))];
            row.extend(
                ["precision", "recall", "f1"].map(|k| digits(number(score, &format!("/{k}")), 3)),
            );
            row
        })
        .collect();
    let plots: Vec<Vec<String>> = array(&says["plots"])
        .iter()
        .map(|plot| {
            let of = |name: &str| digits(number(plot, &format!("/{name}")), 0);
            let mut row = vec![word(plot, "plot").to_owned()];
            row.extend(["true_plants", "found_plants", "true_leaves", "leaves_by_area"].map(of));
            row
        })
        .collect();
    let (counted, leaves) = facts.leaves_against_truth();
    let content = html! {
        p {
            (digits(number(says, "/score/truth"), 0)) " true plants are on the map ("
            (digits(number(says, "/true_plants_not_shown"), 0)) " lie outside of it), "
            (digits(number(says, "/score/found"), 0)) " were found; median error of the pairs "
            (digits(number(says, "/median_error_m").map(|m| 100.0 * m), 1)) " cm."
        }
        (table(&["within", "precision", "recall", "F1"], &radii))
        @if !plots.is_empty() {
            h3 { "By plot" }
            (table(&["plot", "plants, true", "found", "leaves, true", "by area"], &plots))
            @if leaves > 0.0 {
                p .note {
                    "Plots whose leaves were not counted by hand: " (format!("{counted:.0}")) " leaves by area, " (format!("{leaves:.0}"))
                    " true (" (format!("{:+.1} %", 100.0 * (counted / leaves - 1.0))) ")."
                }
            }
        }
    };
    Ok(Some(("truth", "Truth", content)))
}

/// What was done, with what, how long it took, and how to do it again.
pub(super) fn provenance(facts: &Facts) -> Result<Section, Error> {
    let rows: Vec<Vec<String>> = facts
        .records
        .iter()
        .map(|record| {
            vec![
                record.stage.clone(),
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
            !facts.records.iter().any(|r| {
                r.stage != "grow" && r.outputs.iter().any(|output| output.path == input.path)
            })
        })
        .collect();
    inputs.sort_by(|a, b| a.path.cmp(&b.path));
    inputs.dedup_by(|a, b| a.path == b.path);
    let content = html! {
        (table(&["stage", "seconds", "peak memory, MB", "files read", "files written", "key"], &rows))
        @if !facts.skipped.is_empty() {
            ul { @for (stage, why) in &facts.skipped { li { b { (stage) } ": " (why) } } }
        }
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
    Ok(Some(("provenance", "How it was made", content)))
}
