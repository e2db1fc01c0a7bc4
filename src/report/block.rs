//! The section of the block: cameras, overlap, matches.

use super::{
    Facts, drawings,
    page::{Section, drawing, figure},
    pictures,
};
use crate::{
    error::Error,
    monitor::{Diagnostic, Severity},
    pipeline::Stage,
};
use maud::{Markup, html};

/// A file of a stage as a figure, where it is there.
///
/// # Errors
/// Where it cannot be read.
pub(super) fn shown(
    facts: &Facts<'_>,
    stage: Stage,
    name: &str,
    caption: &str,
) -> Result<Markup, Error> {
    Ok(match facts.file(stage, name) {
        Some(path) => figure(&pictures::file(&path)?, caption, "paper"),
        None => html! {},
    })
}

/// Cameras, overlap, matches.
///
/// # Errors
/// Files of the results that cannot be read.
pub(super) fn block(facts: &Facts<'_>) -> Result<Section, Error> {
    let Some(align) = &facts.outcome.results.align else { return Ok(None) };
    let pieces = match align.fragments {
        1 => "one piece".to_owned(),
        fragments => format!("{fragments} pieces"),
    };
    let content = html! {
        p {
            (align.registered) " of " (align.images) " photos in " (pieces) "; "
            (align.tie_points) " tie points with " (align.observations) " measurements; "
            (align.pairs) " oriented pairs; reprojection rms " (format!("{:.3}", align.reprojection_rms_px)) " px; "
            (align.crs) "."
        }
        @if !align.unregistered.is_empty() { p { "Not oriented: " (align.unregistered.join(", ")) } }
        div .pair {
            @if let Some((map, caption)) = drawings::cameras(facts)? { (drawing(&map, &caption)) }
            (shown(facts, Stage::Align, "figures/overlap.svg", "How many photos see each place.")?)
        }
        div .pair {
            (shown(facts, Stage::Align, "figures/match-graph.svg", "Match graph: which photos match, and by which solver they were oriented.")?)
            (shown(facts, Stage::Align, "figures/cloud-above.png", "The sparse cloud from above.")?)
        }
    };
    Ok(Some(("block", "Block", content)))
}

/// What stages found on the way.
pub(super) fn messages(facts: &Facts<'_>) -> Section {
    let found: Vec<(Stage, &Diagnostic)> = facts
        .outcome
        .stages
        .iter()
        .flat_map(|report| report.diagnostics.iter().map(|found| (report.stage, found)))
        .collect();
    if found.is_empty() {
        return None;
    }
    let serious = found.iter().any(|(_, found)| found.severity > Severity::Info);
    let content = html! {
        details open[serious && found.len() < 12] {
            summary { (found.len()) " messages of the stages" }
            ul { @for (stage, found) in found { li {
                b { (stage) } " " (found.severity.word()) ": " b { (found.subject) } ": " (found.message)
                @if let Some(remedy) = &found.remedy { "; " (remedy) }
            } } }
        }
    };
    Some(("messages", "Messages", content))
}
