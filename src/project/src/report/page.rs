//! The page: its head, its sections in their order, and what they have in common.

use super::{Facts, adjustment, block, provenance, traits};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Severity},
};

pub(super) const STYLE: &str = include_str!("style.css");

/// A section: its mark, its title, what is in it; `None` where there is nothing to tell.
pub(super) type Section = Option<(&'static str, &'static str, Markup)>;

/// A report that needs no other file. Sections have an anchor, a word for the navigation, and a title; `style` is what is added to
/// [`STYLE`], `footer` says what numbers mean and where they are.
pub(super) fn report(
    [name, subtitle, style]: [&str; 3],
    sections: &[(&str, &str, &str, Markup)],
    footer: &str,
) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            (head(name, &html! { style { (PreEscaped(STYLE)) (PreEscaped(style)) } }))
            body {
                header { h1 { (name) } p { (subtitle) } }
                nav { div { @for (mark, word, ..) in sections { a href=(format!("#{mark}")) { (word) } } } }
                main { @for (mark, _, title, content) in sections { section id=(mark) { h2 { (title) } (content) } } }
                footer { "Written by rowgram " (env!("CARGO_PKG_VERSION")) ". " (footer) }
            }
        }
    };
    page.into_string()
}

/// All of it.
///
/// # Errors
/// A file of a stage that cannot be read.
pub(super) fn page(facts: &Facts<'_>) -> Result<String, Error> {
    let overview = html! {
        div .numbers { @for (value, what) in numbers(facts) { (big(&value, &what)) } }
        (lamps(&facts.outcome.checks))
    };
    let sections: Vec<_> = [
        Some(("overview", "Overview", overview)),
        block::block(facts)?,
        adjustment::adjustment(facts)?,
        adjustment::ground(facts),
        traits::map(facts)?,
        traits::leaves(facts)?,
        traits::plants(facts)?,
        traits::plots(facts),
        provenance::truth(facts),
        block::messages(facts),
        provenance::provenance(facts),
    ]
    .into_iter()
    .flatten()
    .map(|(mark, title, content)| (mark, title, title, content))
    .collect();
    let footer = "Intervals are of 95 %, standard deviations are scaled by sigma0, the centre of the top-left pixel is at (0, 0). The numbers \
         of this page are in stats.json, the tables and maps in the folders beside it.";
    Ok(report([&facts.outcome.project, &subtitle(facts), ""], &sections, footer))
}

/// The page of a map that a server sends, with its style in a file, and a way to the page of marks where there is one.
pub(super) fn viewer(name: &str, map: &Markup, has_marks: bool) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            (head(name, &html! { link rel="stylesheet" href="style.css"; }))
            body .viewer {
                header {
                    h1 { (name) }
                    @if has_marks { p { a href="marks" { "Marks of ground points" } } }
                }
                main { (map) }
            }
        }
    };
    page.into_string()
}

pub(super) fn head(name: &str, style: &Markup) -> Markup {
    html! {
        head {
            meta charset="utf-8";
            meta name="viewport" content="width=device-width, initial-scale=1";
            meta name="generator" content=(concat!("rowgram ", env!("CARGO_PKG_VERSION")));
            title { (name) " - rowgram" }
            (style)
        }
    }
}

fn subtitle(facts: &Facts<'_>) -> String {
    let mut parts = Vec::new();
    if let Some(align) = &facts.outcome.results.align {
        parts.push(format!("{} photos", align.images));
        parts.push(align.crs.clone());
    }
    if let Some(gsd_m) = facts.outcome.gsd_m {
        parts.push(format!("{:.2} cm per pixel", 100.0 * gsd_m));
    }
    parts.join(" · ")
}

fn big(value: &str, what: &str) -> Markup {
    html! { div .number { b { (value) } span { (what) } } }
}

fn numbers(facts: &Facts<'_>) -> Vec<(String, String)> {
    let results = &facts.outcome.results;
    let mut found: Vec<(String, String)> = Vec::new();
    let mut add = |value: String, what: &str| found.push((value, what.to_owned()));
    if let Some(align) = &results.align {
        add(format!("{} / {}", align.registered, align.images), "photos oriented");
        let errors = &align.check_points;
        if let (Some(x), Some(y), Some(z)) = (errors.rmse_x_m, errors.rmse_y_m, errors.rmse_z_m) {
            let [x, y, z] = [x, y, z].map(|error| 100.0 * error);
            add(format!("{x:.1} / {y:.1} / {z:.1} cm"), "check points, rmse X / Y / Z");
        }
    }
    if let Some(segment) = &results.segment {
        add(format!("{:.1} %", 100.0 * segment.leaf_share), "covered by leaves");
    }
    if let Some(locate) = &results.locate {
        add(locate.plants.to_string(), "plants");
        if let Some(density) = locate.stand.as_ref().and_then(|stand| stand.plants_per_hectare) {
            add(format!("{density:.0}"), "plants per hectare of row area");
        }
        if let Some(spacing_m) = locate.stand.as_ref().and_then(|stand| stand.spacing_m) {
            add(format!("{:.1} cm", 100.0 * spacing_m), "between plants of a row");
        }
    }
    if let Some(whole) = results.leaf_count.as_ref().and_then(|count| count.counts.first()) {
        add(format!("{:.0}", whole.count.leaves), "leaves, by area");
    }
    if let Some(evaluate) = &results.evaluate
        && let (Some(radius_m), Some(score)) =
            (evaluate.radii_m.first(), evaluate.score.radii.first())
        && let Some(f1) = score.f1
    {
        add(format!("{f1:.2}"), &format!("F1 within {:.0} cm", 100.0 * radius_m));
    }
    found
}

/// Colour of a check, and its meaning for those who do not tell colours apart.
pub(super) fn colour(severity: Severity) -> (&'static str, &'static str) {
    match severity {
        Severity::Info => ("green", "good"),
        Severity::Warning => ("yellow", "needs attention"),
        Severity::Error => ("red", "bad"),
    }
}

/// Which checks are of this severity, in one sentence.
fn verdict(checks: &[Diagnostic]) -> Option<String> {
    let worst = checks.iter().map(|check| check.severity).max()?;
    let of: Vec<&str> = checks
        .iter()
        .filter(|check| check.severity == worst)
        .map(|check| check.subject.as_str())
        .collect();
    let (number, ending) = if of.len() == 1 { ("1 check", "s") } else { ("checks", "") };
    let number = if of.len() == 1 { number.to_owned() } else { format!("{} {number}", of.len()) };
    Some(match worst {
        Severity::Info => "All checks are good.".to_owned(),
        Severity::Warning => format!("{number} need{ending} attention: {}.", of.join(", ")),
        Severity::Error => {
            format!("{number} failed: {}. Do not use the numbers that depend on it.", of.join(", "))
        }
    })
}

fn lamps(checks: &[Diagnostic]) -> Markup {
    html! {
        @if let Some(verdict) = verdict(checks) { p .soft { (verdict) } }
        ul .lights {
            @for check in checks {
                @let (colour, meaning) = colour(check.severity);
                li {
                    span class=(format!("dot {colour}")) title=(meaning) {}
                    div {
                        span .name { (check.subject) } " " span .word { (meaning) }
                        div .soft { (check.message) @if let Some(remedy) = &check.remedy { "; " (remedy) } }
                    }
                }
            }
        }
    }
}

/// A number with so many digits, or a dash.
pub(super) fn digits(value: Option<f64>, digits: usize) -> String {
    value.filter(|x| x.is_finite()).map_or("-".to_owned(), |x| format!("{x:.digits$}"))
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

/// A chart: drawn dark on white, with lettering that has to stay legible on small screens.
pub(super) fn chart(source: &str, caption: &str) -> Markup {
    html! {
        figure {
            div .chart { img .paper .drawn src=(source) alt=(caption); }
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
    // On paper nothing can be moved aside.
    let class = if header.len() > 9 { "wide" } else { "" };
    html! {
        div .scroll { table class=(class) {
            thead { tr { @for name in header { th { (name) } } } }
            tbody { @for row in rows { tr { @for cell in row { td { (cell) } } } } }
        } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_verdict_names_the_worst_checks() {
        let good = Diagnostic::info("a", "reprojection", "rms 0.3 px");
        let doubtful = Diagnostic::warning("b", "self-calibration", "K2 and K3");
        let bad = Diagnostic::error("c", "check points", "rmse 1 m");
        assert_eq!(verdict(&[]), None);
        assert_eq!(verdict(std::slice::from_ref(&good)).unwrap(), "All checks are good.");
        assert_eq!(
            verdict(&[good.clone(), doubtful.clone()]).unwrap(),
            "1 check needs attention: self-calibration."
        );
        let all = [good, doubtful, bad.clone(), bad];
        assert!(verdict(&all).unwrap().starts_with("2 checks failed: check points, check points."));
        let shown = lamps(&all).into_string();
        assert!(shown.contains("dot red") && shown.contains("rmse 1 m"), "{shown}");
    }
}
