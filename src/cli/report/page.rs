//! The page: its head, its sections in their order, and what they have in common.

use super::{
    facts::{Facts, number},
    lights::{Colour, Light},
    proof, sections,
};
use crate::error::Error;
use maud::{DOCTYPE, Markup, PreEscaped, html};

const STYLE: &str = include_str!("style.css");

/// A section: its mark, its title, what is in it; `None` where there is nothing to tell.
pub(super) type Section = Option<(&'static str, &'static str, Markup)>;

/// All of it.
///
/// # Errors
/// A file of a stage that cannot be read.
pub(super) fn page(facts: &Facts, lights: &[Light]) -> Result<String, Error> {
    let parts: Vec<_> = [
        sections::block(facts)?,
        sections::adjustment(facts)?,
        sections::ground(facts)?,
        sections::map(facts)?,
        sections::leaves(facts)?,
        sections::plants(facts)?,
        sections::plots(facts)?,
        proof::truth(facts)?,
        proof::provenance(facts)?,
    ]
    .into_iter()
    .flatten()
    .collect();
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="generator" content=(concat!("rowgram ", env!("CARGO_PKG_VERSION")));
                title { (facts.name) " - rowgram" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header {
                    h1 { (facts.name) }
                    p { (subtitle(facts)) }
                }
                nav { div {
                    a href="#overview" { "Overview" }
                    @for (mark, title, _) in &parts { a href=(format!("#{mark}")) { (title) } }
                } }
                main {
                    section id="overview" {
                        h2 { "Overview" }
                        div .numbers { @for (value, what) in numbers(facts) { (big(&value, what)) } }
                        (lamps(lights))
                    }
                    @for (mark, title, content) in &parts {
                        section id=(mark) { h2 { (title) } (content) }
                    }
                }
                footer {
                    "Written by rowgram " (env!("CARGO_PKG_VERSION")) ". Intervals are of 95 %, standard deviations "
                    "are scaled by sigma0, the centre of the top-left pixel is at (0, 0). The numbers of this page "
                    "are in stats.json, the tables and maps in the folders beside it."
                }
            }
        }
    };
    Ok(page.into_string())
}

fn subtitle(facts: &Facts) -> String {
    let mut parts = Vec::new();
    let align = facts.says("align");
    if let Some(images) = number(align, "/images") {
        parts.push(format!("{images} photos"));
    }
    if let Some(crs) = align.get("crs").and_then(|crs| crs.as_str()) {
        parts.push(crs.to_owned());
    }
    if let Some(gsd) = facts.gsd_m() {
        parts.push(format!("{:.2} cm per pixel", 100.0 * gsd));
    }
    parts.join(" · ")
}

fn big(value: &str, what: &str) -> Markup {
    html! { div .number { b { (value) } span { (what) } } }
}

fn numbers(facts: &Facts) -> Vec<(String, &'static str)> {
    let mut found = Vec::new();
    let align = facts.says("align");
    if let (Some(a), Some(b)) = (number(align, "/registered"), number(align, "/images")) {
        found.push((format!("{a} / {b}"), "photos oriented"));
    }
    let checks: Vec<f64> = ["x", "y", "z"]
        .iter()
        .filter_map(|axis| number(align, &format!("/check_points/rmse_{axis}_m")))
        .collect();
    if let [x, y, z] = checks[..] {
        let text = format!("{:.1} / {:.1} / {:.1} cm", 100.0 * x, 100.0 * y, 100.0 * z);
        found.push((text, "check points, rmse X / Y / Z"));
    }
    if let Some(share) = number(facts.says("segment"), "/plant_share") {
        found.push((format!("{:.1} %", 100.0 * share), "covered by leaves"));
    }
    let locate = facts.says("locate");
    if let Some(plants) = number(locate, "/plants") {
        found.push((format!("{plants}"), "plants"));
    }
    if let Some(density) = number(locate, "/plants_per_hectare") {
        found.push((format!("{density:.0}"), "plants per hectare"));
    }
    if let Some(spacing) = number(locate, "/spacing_m") {
        found.push((format!("{:.1} cm", 100.0 * spacing), "between plants of a row"));
    }
    if let Some(leaves) = number(facts.says("count"), "/counts/0/leaves") {
        found.push((format!("{leaves:.0}"), "leaves, by area"));
    }
    if let Some(f1) = number(facts.says("evaluate"), "/score/radii/0/f1") {
        let radius = number(facts.says("evaluate"), "/radii_m/0").unwrap_or(f64::NAN);
        let what = if (radius - 0.05).abs() < 1e-9 { "F1 within 5 cm" } else { "F1, first radius" };
        found.push((format!("{f1:.2}"), what));
    }
    found
}

fn lamps(lights: &[Light]) -> Markup {
    let worst = lights.iter().map(|light| light.colour).filter(|c| *c != Colour::Grey).max();
    html! {
        @if let Some(worst) = worst {
            p .soft {
                @match worst {
                    Colour::Green => "Nothing stands out.",
                    Colour::Yellow => "Some of it should be looked at before it is used.",
                    _ => "Something is wrong: do not use the numbers that depend on it.",
                }
            }
        }
        ul .lights {
            @for light in lights {
                li {
                    span class=(format!("dot {}", light.colour.word())) title=(light.colour.meaning()) {}
                    div {
                        span .name { (light.name) } " " span .word { (light.colour.meaning()) }
                        div .soft { (light.why) }
                    }
                }
            }
        }
    }
}

/// A picture of the page.
pub(super) fn figure(source: &str, caption: &str, class: &str) -> Markup {
    html! {
        figure {
            img class=(class) src=(source) alt=(caption);
            figcaption { (caption) }
        }
    }
}

/// A drawing of the page.
pub(super) fn drawing(content: &Markup, caption: &str) -> Markup {
    html! { figure { (content) figcaption { (caption) } } }
}

/// A table.
pub(super) fn table(header: &[&str], rows: &[Vec<String>]) -> Markup {
    html! {
        div .scroll { table {
            thead { tr { @for name in header { th { (name) } } } }
            tbody { @for row in rows { tr { @for cell in row { td { (cell) } } } } }
        } }
    }
}
