//! The report of a season: one HTML file that needs no other, from the typed outcome; computes nothing.

use super::page;
use crate::season::{PlotSeries, SeasonFile, SeasonFlight, SeasonOutcome, SeasonTrait};
use maud::{Markup, PreEscaped, html};
use rowgram_base::error::Error;
use rowgram_plants::problems::growth_curve::Estimate;
use serde_json::json;
use std::path::PathBuf;

const SCRIPT: &str = include_str!("season.js");
/// What this page adds to the style of the report of a run.
const OWN_STYLE: &str = ".multiples { display: grid; grid-template-columns: repeat(auto-fill, minmax(170px, 1fr)); gap: .7rem; }\n\
    .multiples figure { margin: 0; } .multiples figcaption { font-size: .8rem; }\n\
    .controls { display: flex; flex-wrap: wrap; gap: 1rem; align-items: center; margin: .4rem 0 .8rem; }\n\
    .controls input { flex: 1 1 220px; }\n";
/// Drawings of one trait; the others are in the tables.
const MOST_DRAWINGS: usize = 240;

/// Writes `report.html` into the results of a season, and gives its path.
///
/// # Errors
/// Where it cannot be written.
pub fn write_season(
    file: &SeasonFile,
    outcome: &SeasonOutcome,
    force: bool,
) -> Result<PathBuf, Error> {
    super::put(&whole(outcome), &file.results(), force)
}

fn whole(outcome: &SeasonOutcome) -> String {
    let (first, last) = (outcome.flights.first(), outcome.flights.last());
    let dates = first.zip(last).map(|(first, last)| format!("{} to {}", first.date, last.date));
    let mut sections = vec![
        ("overview", "Overview", "Overview", overview(outcome)),
        ("flights", "Flights", "Flights in one frame", flights(outcome)),
    ];
    if !outcome.outlines_m.is_empty() {
        sections.push(("map", "Map", "Plots by date", map(outcome)));
    }
    if has_colours(outcome) {
        sections.push(("colours", "Colours", "One scale of colours", colours(outcome)));
    }
    sections.push(("growth", "Growth", "Growth", growth(outcome)));
    sections.push(("plants", "Plants", "Plants", plants(outcome)));
    let from = if outcome.from_sowing { "sowing" } else { "the first flight" };
    let footer = format!(
        "Intervals are of 95 %. Days count from {from}. The numbers of this page are in season.json and the tables beside it."
    );
    page::report([&outcome.name, &dates.unwrap_or_default(), OWN_STYLE], &sections, &footer)
}

fn overview(outcome: &SeasonOutcome) -> Markup {
    let taking_part = outcome.flights.iter().filter(|flight| flight.placement.is_some()).count();
    html! {
        div .numbers {
            div .number { b { (taking_part) " / " (outcome.flights.len()) } span { "flights in one frame" } }
            div .number { b { (outcome.plots.len()) } span { "plots" } }
            div .number { b { (outcome.tracks) } span { "plants followed" } }
            div .number { b { (outcome.outliers.len()) } span { "outliers" } }
        }
        @if !outcome.diagnostics.is_empty() {
            ul .lights {
                @for found in &outcome.diagnostics {
                    li {
                        span class=(format!("dot {}", page::colour(found.severity).0)) {}
                        div { div .name { (found.subject) } div { (found.message) }
                            @if let Some(remedy) = &found.remedy { div .soft { (remedy) } } }
                    }
                }
            }
        }
    }
}

fn centimetres(value_m: f64) -> String {
    format!("{:.1}", 100.0 * value_m)
}

/// Which stage of a flight failed that takes part.
fn failure(flight: &SeasonFlight) -> Markup {
    html! { @if let Some(why) = &flight.failure { "; a stage failed: " (why) } }
}

fn flights(outcome: &SeasonOutcome) -> Markup {
    html! {
        div .scroll { table {
            tr { th { "date" } th { "day" } th { "frame" } th { "places" } th { "moved, cm" } th { "scatter, cm" }
                th { "deformation, cm" } th { "middle +-, cm" } th { "edge +-, cm" } th { "cm per pixel" } th { "plants" } th { "red checks" } }
            @for flight in &outcome.flights {
                @let fit = flight.placement.as_ref().and_then(|placement| placement.fit.as_ref());
                tr {
                    td { (flight.date) }
                    td { (flight.day) }
                    @match (&flight.placement, fit) {
                        (None, _) => td .wrap { "none: " (flight.failure.as_deref().unwrap_or("no map")) },
                        (Some(_), None) => td .wrap { "its own" (failure(flight)) },
                        (Some(placement), Some(_)) => td .wrap { "tied to " (placement.tied_to.join(", ")) (failure(flight)) },
                    }
                    @match fit {
                        Some(fit) => {
                            td { (fit.ties) }
                            td { (centimetres(fit.transform.shift_m[0].hypot(fit.transform.shift_m[1]))) }
                            td { (centimetres(fit.scatter_m)) }
                            td { (centimetres(fit.deformation_m)) }
                            td { (centimetres(fit.middle_sigma_m)) }
                            td { (centimetres(fit.edge_sigma_m)) }
                        }
                        None => { td {} td {} td {} td {} td {} td {} }
                    }
                    td { (flight.gsd_m.map(|gsd| format!("{:.2}", 100.0 * gsd)).unwrap_or_default()) }
                    td { (flight.plants.map(|plants| plants.to_string()).unwrap_or_default()) }
                    td { (flight.red_checks) }
                }
            }
        } }
        p .note {
            "Places are what two maps share and does not grow. Scatter is the standard deviation of one of them; deformation is the "
            "root mean square of their means over cells of the field, which no transform of the map takes out."
        }
    }
}

fn has_colours(outcome: &SeasonOutcome) -> bool {
    outcome.flights.iter().any(|flight| flight.colours.is_some())
}

fn colours(outcome: &SeasonOutcome) -> Markup {
    let percent =
        |of: [f64; 3], gain: [f64; 3]| [0, 1, 2].map(|c| format!("{:.2}", 100.0 * of[c] / gain[c]));
    html! {
        div .scroll { table {
            tr { th { "date" } th { "scale from" } th { "places" } th { "gain: red" } th { "green" } th { "blue" }
                th { "+-, %: red" } th { "green" } th { "blue" } th { "offset: red" } th { "green" } th { "blue" }
                th { "one place, %: red" } th { "green" } th { "blue" } }
            @for flight in &outcome.flights {
                tr {
                    td { (flight.date) }
                    @match &flight.colours {
                        Some(of) => {
                            td { (of.source) @if !of.compared_with.is_empty() { " of " (of.compared_with.join(", ")) } }
                            td { (of.places) }
                            @for gain in of.gain { td { (format!("{gain:.3}")) } }
                            @for sigma in percent(of.gain_sigma, of.gain) { td { (sigma) } }
                            @for offset in of.offset { td { @if offset != 0.0 { (format!("{offset:.4}")) } } }
                            @for scatter in of.scatter { td { @if let Some(scatter) = scatter { (format!("{:.1}", 100.0 * scatter)) } } }
                        }
                        None => { td .wrap { "none: colours are as its map has them" } @for _ in 0..13 { td {} } }
                    }
                }
            }
        } }
        p .note {
            "The linear light of a date is multiplied by its gain before colours of leaves and indices are measured. +- is the standard deviation "
            "of a gain, common to all plots of the date; one place is that of a single panel, or of a single square of ground."
        }
    }
}

/// A rounded number for people.
fn short(value: f64) -> String {
    let digits = match value.abs() {
        x if x >= 100.0 => 0,
        x if x >= 10.0 => 1,
        x if x >= 1.0 => 2,
        _ => 3,
    };
    format!("{value:.digits$}")
}

fn map(outcome: &SeasonOutcome) -> Markup {
    const WIDE: f64 = 720.0;
    let corners = || outcome.outlines_m.iter().flatten().flatten();
    let bound = |axis: usize| {
        corners()
            .map(|p| p[axis])
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)))
    };
    let ((x0, x1), (y0, y1)) = (bound(0), bound(1));
    let pad = 0.03 * (x1 - x0).max(y1 - y0).max(1e-6);
    let scale = WIDE / (x1 - x0 + 2.0 * pad);
    let at =
        |p: &[f64; 2]| format!("{:.1},{:.1}", (p[0] - x0 + pad) * scale, (y1 + pad - p[1]) * scale);
    let outline = |rings: &Vec<Vec<[f64; 2]>>| -> String {
        let ring = |ring: &Vec<[f64; 2]>| ring.iter().map(at).collect::<Vec<_>>().join(" L");
        rings.iter().map(|of| format!("M{}Z", ring(of))).collect()
    };
    let tall = (y1 - y0 + 2.0 * pad) * scale;
    let with_map: Vec<_> = outcome.flights.iter().filter(|f| f.placement.is_some()).collect();
    let values = |of: &SeasonTrait| -> Vec<Vec<Option<f64>>> {
        of.plots
            .iter()
            .map(|series| {
                with_map
                    .iter()
                    .map(|flight| {
                        let sample = series.samples.iter().find(|sample| sample.day == flight.day);
                        sample.map(|sample| sample.value)
                    })
                    .collect()
            })
            .collect()
    };
    let traits: Vec<_> = outcome
        .traits
        .iter()
        .map(|of| {
            let values = values(of);
            let known = || values.iter().flatten().flatten().copied();
            let (low, high) =
                known().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
            let (low, high) = if low.is_finite() { (low, high) } else { (0.0, 1.0) };
            json!({"name": of.name, "low": low, "high": high, "values": values})
        })
        .collect();
    let dates: Vec<&str> = with_map.iter().map(|flight| flight.date.as_str()).collect();
    let data = json!({"dates": dates, "plots": outcome.plots, "traits": traits});
    // Nothing in it may end the element.
    let data = data.to_string().replace('<', "\\u003c");
    html! {
        @if traits.is_empty() || dates.is_empty() {
            p { "No trait was followed." }
        } @else {
            div .controls {
                label { "Trait " select id="season-trait" {
                    @for (k, of) in outcome.traits.iter().enumerate() { option value=(k) { (of.name) } }
                } }
                input id="season-date" type="range" min="0" max=(dates.len() - 1) value=(dates.len() - 1) step="1"
                    aria-label="Date";
            }
            p id="season-label" .note { "The colours need JavaScript; the values are in traits_long.csv." }
            figure { svg id="season-map" viewBox=(format!("0 0 {WIDE} {tall:.0}")) role="img" aria-label="Plots coloured by a trait" {
                @for rings in &outcome.outlines_m {
                    path d=(outline(rings)) fill="none" fill-rule="evenodd" stroke="var(--soft)" { title {} }
                }
            } }
            script id="season-data" type="application/json" { (PreEscaped(data)) }
            script { (PreEscaped(SCRIPT)) }
        }
    }
}

fn growth(outcome: &SeasonOutcome) -> Markup {
    html! {
        @for of in &outcome.traits {
            @let fitted = of.plots.iter().filter(|plot| plot.curve.is_some()).count();
            h3 { (of.name) }
            p .note {
                (of.model) " curves of " (fitted) " of " (of.plots.len()) " plots"
                @if let Some(scatter) = of.scatter { "; a value is within " (short(scatter)) " (standard deviation) of its curve" }
                ". The dashed line is the day on which half of the final value is reached."
            }
            div .multiples {
                @for series in of.plots.iter().take(MOST_DRAWINGS) { (multiple(outcome, of, series)) }
            }
            @if of.plots.len() > MOST_DRAWINGS {
                p .note { (of.plots.len() - MOST_DRAWINGS) " more plots are in growth.csv." }
            }
        }
        @if !outcome.emergence.is_empty() {
            h3 { "Emergence" }
            p .note { "The day on which half of the plants that a plot has in the end could be seen." }
            div .scroll { table {
                tr { th { "plot" } th { "day" } th { "+-" } th { "95 % interval" } }
                @for of in &outcome.emergence {
                    tr {
                        td { (of.plot) }
                        @match (of.day, of.untold) {
                            (Some(day), _) => {
                                td { (format!("{:.1}", day.value)) } td { (format!("{:.1}", day.sigma)) } td { (interval(&day)) }
                            }
                            (None, untold) => td .wrap colspan="3" { (untold.map(|why| why.reason()).unwrap_or_default()) },
                        }
                    }
                }
            } }
        }
        @if !outcome.outliers.is_empty() {
            h3 { "Outliers" }
            div .scroll { table {
                tr { th { "plot" } th { "trait" } th { "date" } th { "value" } th { "expected" } }
                @for outlier in &outcome.outliers {
                    tr { td { (outlier.plot) } td { (outlier.name) } td { (outlier.date) } td { (short(outlier.value)) }
                        td { (short(outlier.expected)) } }
                }
            } }
        }
    }
}

fn interval(of: &Estimate) -> String {
    format!("{:.1} to {:.1}", of.low, of.high)
}

/// The values of a plot with their curve.
fn multiple(outcome: &SeasonOutcome, of: &SeasonTrait, series: &PlotSeries) -> Markup {
    const WIDE: f64 = 170.0;
    const TALL: f64 = 100.0;
    const EDGE: f64 = 6.0;
    let days = || outcome.flights.iter().map(|flight| flight.day);
    let (first, last) =
        (days().fold(f64::INFINITY, f64::min), days().fold(f64::NEG_INFINITY, f64::max));
    let span = (last - first).max(1e-9);
    // One scale for all plots of a trait, so that they can be compared.
    let all = of.plots.iter().flat_map(|plot| &plot.samples).map(|sample| sample.value);
    let highest = all.fold(0.0, f64::max).max(1e-12);
    let x = |day: f64| EDGE + (day - first) / span * (WIDE - 2.0 * EDGE);
    let y = |value: f64| TALL - EDGE - (value / highest).clamp(-0.05, 1.05) * (TALL - 2.0 * EDGE);
    let path = |shift: f64| -> Option<String> {
        let curve = series.curve.as_ref()?;
        let point = |k: i32| {
            let day = first + span * f64::from(k) / 40.0;
            let [value, sigma] = curve.at(day);
            format!("{:.1},{:.1}", x(day), y(value + shift * curve.t95 * sigma))
        };
        Some((0..=40).map(point).collect::<Vec<_>>().join(" "))
    };
    let band = path(1.0).zip(path(-1.0)).map(|(upper, lower)| {
        let back: Vec<&str> = lower.split(' ').rev().collect();
        format!("{upper} {}", back.join(" "))
    });
    let is_outlier =
        |k: usize| series.curve.as_ref().is_some_and(|curve| curve.outliers.contains(&k));
    let caption = match (&series.curve, series.untold) {
        (Some(curve), _) => {
            format!("half on day {:.1} +- {:.1}", curve.half_day.value, curve.half_day.sigma)
        }
        (None, untold) => untold.map(|why| why.reason().to_owned()).unwrap_or_default(),
    };
    html! {
        figure {
            svg viewBox=(format!("0 0 {WIDE} {TALL}")) role="img" aria-label=(format!("{} of {}", of.name, series.plot)) {
                rect .plot x=(EDGE) y=(EDGE) width=(WIDE - 2.0 * EDGE) height=(TALL - 2.0 * EDGE) {}
                @if let Some(band) = band { polygon points=(band) fill="var(--accent)" fill-opacity="0.18" {} }
                @if let Some(path) = path(0.0) { polyline points=(path) fill="none" stroke="var(--accent)" stroke-width="1.5" {} }
                @if let Some(curve) = &series.curve {
                    @let at = x(curve.half_day.value).clamp(0.0, WIDE);
                    line x1=(format!("{at:.1}")) x2=(format!("{at:.1}")) y1=(EDGE) y2=(TALL - EDGE) stroke="var(--soft)" stroke-dasharray="3 3" {}
                }
                @for (k, sample) in series.samples.iter().enumerate() {
                    circle cx=(format!("{:.1}", x(sample.day))) cy=(format!("{:.1}", y(sample.value))) r="2.6"
                        fill=(if is_outlier(k) { "var(--red)" } else { "var(--ink)" }) {
                        title { "day " (sample.day) ": " (short(sample.value)) }
                    }
                }
            }
            figcaption { b { (series.plot) } " " (caption) }
        }
    }
}

fn plants(outcome: &SeasonOutcome) -> Markup {
    let dates: Vec<&str> = outcome
        .flights
        .iter()
        .filter(|flight| flight.placement.is_some())
        .map(|flight| flight.date.as_str())
        .collect();
    html! {
        p { (outcome.tracks) " plants were seen on at least one date. Which plant of one date is which of the next, and how sure, is in plants_long.csv." }
        @if !outcome.steps.is_empty() {
            div .scroll { table {
                tr { th { "from" } th { "to" } th { "seen again" } th { "new" } th { "not seen" } }
                @for (k, step) in outcome.steps.iter().enumerate() {
                    tr { td { (dates[k]) } td { (dates[k + 1]) } @for number in step { td { (number) } } }
                }
            } }
        }
    }
}
