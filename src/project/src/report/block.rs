//! The section of the block: flight, cameras, overlap, matches.

use super::{
    Facts, drawings,
    page::{Section, chart, digits, drawing, figure, table},
    pictures,
};
use crate::{Stage, align::AlignOutcome};
use maud::{Markup, html};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Severity},
};
use rowgram_survey::{camera::Lens, scene::Reconstruction};

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
        Some(path) if name.ends_with(".svg") => chart(&pictures::file(&path)?, caption),
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
        (flight(align))
        @if let Some((scene, _)) = &facts.block { (cameras(scene)) }
        div .pair {
            @if let Some((map, caption)) = drawings::cameras(facts)? { (drawing(&map, &caption)) }
            (shown(facts, Stage::Align, "figures/overlap.svg", "How many photos see each place.")?)
        }
        (shown(facts, Stage::Align, "figures/cloud-above.png", "The sparse cloud from above.")?)
    };
    Ok(Some(("block", "Block", content)))
}

/// As [`shown`], for a map in colours from dark blue (`low`) to yellow (`high`), with its bar.
///
/// # Errors
/// As [`shown`].
pub(super) fn scaled(
    facts: &Facts<'_>,
    stage: Stage,
    name: &str,
    caption: &str,
    [low, high]: [&str; 2],
) -> Result<Markup, Error> {
    let Some(path) = facts.file(stage, name) else { return Ok(html! {}) };
    Ok(html! {
        figure {
            img .paper src=(pictures::file(&path)?) alt=(caption);
            div .colour-bar { span { (low) } i {} span { (high) } }
            figcaption { (caption) }
        }
    })
}

/// When, how high, how much photos share.
fn flight(align: &AlignOutcome) -> Markup {
    let flight = &align.flight;
    let percent = |share: Option<f64>| digits(share.map(|share| 100.0 * share), 0);
    // Without a scale there are no metres.
    let height_m = flight.height_above_ground_m.filter(|_| align.gsd_m.is_some());
    let row = vec![
        flight.first_photo_time.clone().unwrap_or_else(|| "-".to_owned()),
        flight.last_photo_time.clone().unwrap_or_else(|| "-".to_owned()),
        digits(height_m, 1),
        digits(align.gsd_m.map(|gsd_m| 100.0 * gsd_m), 2),
        percent(flight.overlap),
        digits(flight.photos_per_place, 1),
    ];
    let header = [
        "first photo",
        "last photo",
        "height above ground, m",
        "ground sampling distance, cm",
        "overlap with the next photo, %",
        "photos per place",
    ];
    html! { h3 { "Flight" } (table(&header, &[row])) }
}

/// The cameras as adjusted.
fn cameras(scene: &Reconstruction) -> Markup {
    let rows: Vec<Vec<String>> = (scene.cameras.iter().enumerate())
        .map(|(k, camera)| {
            let interior = &camera.interior;
            let [width, height] = interior.size_px();
            let c_px = interior.principal_distance_px();
            let view_deg = |length: u32| 2.0 * (0.5 * f64::from(length) / c_px).atan().to_degrees();
            let free = camera.free.iter().filter(|free| **free).count();
            vec![
                camera.name.clone(),
                scene.images.iter().filter(|image| image.camera == k).count().to_string(),
                format!("{width} x {height}"),
                interior.model().word().to_owned(),
                format!("{c_px:.1}"),
                format!("{:.0} x {:.0}", view_deg(width), view_deg(height)),
                format!("{free} of {}", interior.parameters().len()),
                if scene.rolling_shutter.is_some() { "rolling" } else { "global" }.to_owned(),
            ]
        })
        .collect();
    let header = [
        "camera",
        "photos",
        "size, px",
        "lens model",
        "principal distance, px",
        "field of view, °",
        "parameters adjusted",
        "shutter",
    ];
    html! { h3 { "Cameras" } (table(&header, &rows)) }
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
