//! Drawings in the page: vector graphics that follow its colours.

use super::{Facts, pictures};
use crate::Stage;
use maud::{Markup, html};
use rowgram_base::error::Error;
use rowgram_optim::robust::median;
use rowgram_survey::scene::Role;

/// Width of a drawing in its own units.
const WIDE: f64 = 720.0;

fn f(value: f64) -> String {
    format!("{value:.2}")
}

/// From the map to a drawing with the same scale on both axes and north up.
struct Frame {
    low: [f64; 2],
    high: [f64; 2],
    scale: f64,
}

impl Frame {
    fn new(points: &[[f64; 2]], margin: f64) -> Option<Frame> {
        let bound = |k: usize| {
            let known = points.iter().map(|p| p[k]).filter(|x| x.is_finite());
            let low = known.clone().fold(f64::INFINITY, f64::min);
            let high = known.fold(f64::NEG_INFINITY, f64::max);
            (low, high)
        };
        let ((x0, x1), (y0, y1)) = (bound(0), bound(1));
        if !(x0.is_finite() && y0.is_finite()) {
            return None;
        }
        let pad = margin * (x1 - x0).max(y1 - y0).max(1.0);
        let (low, high) = ([x0 - pad, y0 - pad], [x1 + pad, y1 + pad]);
        Some(Frame { low, high, scale: WIDE / (high[0] - low[0]) })
    }

    fn height(&self) -> f64 {
        (self.high[1] - self.low[1]) * self.scale
    }

    fn at(&self, p: [f64; 2]) -> [f64; 2] {
        [(p[0] - self.low[0]) * self.scale, (self.high[1] - p[1]) * self.scale]
    }

    /// A bar of a round length at the lower left.
    fn bar(&self) -> Markup {
        let span = 0.2 * (self.high[0] - self.low[0]);
        let unit = 10f64.powf(span.log10().floor());
        let length = [5.0, 2.0, 1.0].map(|k| k * unit).into_iter().find(|l| *l <= span);
        let length = length.unwrap_or(unit);
        let y = self.height() - 14.0;
        let label = if length >= 1.0 { format!("{length:.0} m") } else { format!("{length} m") };
        html! {
            line x1="12" x2=(f(12.0 + length * self.scale)) y1=(f(y)) y2=(f(y)) stroke="var(--ink)" stroke-width="3" {}
            text x="12" y=(f(y - 6.0)) { (label) }
        }
    }
}

/// Cameras with the ellipses of their positions, the pairs that match, and the ground points.
///
/// # Errors
/// A table that cannot be read.
pub(super) fn cameras(facts: &Facts<'_>) -> Result<Option<(Markup, String)>, Error> {
    let Some((scene, adjustment)) = &facts.block else { return Ok(None) };
    let names: Vec<&str> = scene.images.iter().map(|image| image.name.as_str()).collect();
    let from_above = |[x, y, _]: [f64; 3]| [x, y];
    let at: Vec<[f64; 2]> =
        scene.images.iter().map(|image| from_above(image.pose.centre_m())).collect();
    let sigmas: Vec<[f64; 2]> = scene
        .accuracy
        .iter()
        .flat_map(|accuracy| accuracy.images.iter().map(|sigma| from_above(sigma.centre_m)))
        .collect();
    let ground: Vec<(&str, bool, [f64; 2])> = adjustment
        .ground
        .iter()
        .map(|point| (point.name.as_str(), point.role == Role::Check, from_above(point.adjusted_m)))
        .collect();
    let all: Vec<[f64; 2]> = at.iter().copied().chain(ground.iter().map(|g| g.2)).collect();
    let Some(frame) = Frame::new(&all, 0.08) else { return Ok(None) };
    let largest = sigmas.iter().flatten().copied().filter(|s| s.is_finite()).fold(0.0, f64::max);
    // Ellipses are drawn so large that the largest is seen.
    let times = (0.04 * (frame.high[0] - frame.low[0]) / largest.max(1e-9)).max(1.0);
    let round = 10f64.powf(times.log10().floor());
    let times = (times / round).floor() * round;
    let place = |name: &str| names.iter().position(|other| *other == name);
    let mut lines = Vec::new();
    if let Some(pairs) = facts.table(Stage::Align, "report/pairs.csv")?
        && let (Some(a), Some(b), Some(n)) =
            (pairs.texts("first"), pairs.texts("second"), pairs.numbers("matches"))
    {
        let most = n.iter().copied().fold(1.0, f64::max);
        for k in 0..pairs.len() {
            if let (Some(i), Some(j)) = (place(a[k]), place(b[k])) {
                lines.push((frame.at(at[i]), frame.at(at[j]), n[k] / most));
            }
        }
    }
    let few = names.len() <= 60;
    let drawing = html! {
        svg viewBox=(format!("0 0 {WIDE} {:.0}", frame.height())) role="img" aria-label="Cameras from above" {
            @for (from, to, share) in &lines {
                line x1=(f(from[0])) y1=(f(from[1])) x2=(f(to[0])) y2=(f(to[1])) stroke="var(--accent)"
                    stroke-width=(f(0.4 + 2.6 * share)) stroke-opacity="0.45" {}
            }
            @for (k, &place) in at.iter().enumerate() {
                @let [x, y] = frame.at(place);
                @if let Some([sx, sy]) = sigmas.get(k) {
                    ellipse cx=(f(x)) cy=(f(y)) rx=(f(sx * times * frame.scale)) ry=(f(sy * times * frame.scale))
                        fill="var(--blue)" fill-opacity="0.18" stroke="var(--blue)" {}
                }
                circle cx=(f(x)) cy=(f(y)) r="2.5" fill="var(--blue)" {
                    title { (names[k]) }
                }
                @if few {
                    text x=(f(x + 5.0)) y=(f(y - 5.0)) { (names[k].rsplit_once('.').map_or(names[k], |(stem, _)| stem)) }
                }
            }
            @for (name, check, place) in &ground {
                @let [x, y] = frame.at(*place);
                path d=(format!("M{:.1} {:.1}l6 10h-12z", x, y - 6.0)) fill=(if *check { "var(--orange)" } else { "var(--green)" }) {
                    title { (name) }
                }
                text x=(f(x + 7.0)) y=(f(y + 8.0)) { (name) }
            }
            (frame.bar())
        }
    };
    let caption = format!(
        "Cameras from above, north up. Ellipses: standard deviations of their positions, {times:.0} times as large as they are. \
         Lines: pairs that match, thicker with more matches. Triangles: control (green) and check points (orange)."
    );
    Ok(Some((drawing, caption)))
}

/// Half axes of an ellipse that holds a place in the plane with 95 %, in standard deviations along its axes: the square root of the
/// 0.95 quantile of chi-square with two degrees of freedom, `-2 ln 0.05`.
const ELLIPSE_95: f64 = 2.447_746_830_680_816;

/// Some plants over the orthomosaic as it is, with their ellipses.
///
/// # Errors
/// A file that cannot be read.
pub(super) fn plants(facts: &Facts<'_>) -> Result<Option<Markup>, Error> {
    let (Some(ortho), Some(table)) =
        (facts.orthomosaic(), facts.table(Stage::Locate, "plants.csv")?)
    else {
        return Ok(None);
    };
    let (Some(at), Some(along), Some(across)) = (
        table.pairs("u_px", "v_px"),
        table.numbers("sigma_along_px"),
        table.numbers("sigma_across_px"),
    ) else {
        return Ok(None);
    };
    let confidence = table.numbers("confidence").unwrap_or_else(|| vec![1.0; at.len()]);
    let colour = |k: usize| if confidence[k] >= 0.5 { "#ff3b30" } else { "#ff9f0a" };
    let mut sorted: Vec<[f64; 2]> = at.clone();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let Some(middle) = sorted.get(sorted.len() / 2) else { return Ok(None) };
    let median_v = median(at.iter().map(|p| p[1])).unwrap_or_default();
    let ([u0, v0], part) =
        pictures::detail(&facts.project.open_picture(&ortho)?, [middle[0], median_v], [360, 240])?;
    let (columns, rows) = part.dimensions();
    let enlarged = image::imageops::resize(
        &part,
        3 * columns,
        3 * rows,
        image::imageops::FilterType::CatmullRom,
    );
    let href = pictures::jpeg(&enlarged, 1200)?;
    let locate = facts.outcome.results.locate.as_ref();
    let heading = locate.and_then(|locate| locate.heading_deg).unwrap_or(0.0);
    let inside = |p: &[f64; 2]| {
        p[0] >= u0 as f64
            && p[1] >= v0 as f64
            && p[0] < (u0 + columns as usize) as f64
            && p[1] < (v0 + rows as usize) as f64
    };
    let near: Vec<usize> = (0..at.len()).filter(|&k| inside(&at[k])).collect();
    let view = format!("{} {} {columns} {rows}", u0 as f64 - 0.5, v0 as f64 - 0.5);
    let detail = html! {
        svg viewBox=(view) role="img" aria-label="Some plants with their ellipses" {
            image href=(href) x=(f(u0 as f64 - 0.5)) y=(f(v0 as f64 - 0.5)) width=(columns) height=(rows) {}
            @for &k in &near {
                @let turn = format!("rotate({:.1} {:.2} {:.2})", heading, at[k][0], at[k][1]);
                ellipse cx=(f(at[k][0])) cy=(f(at[k][1])) rx=(f(ELLIPSE_95 * along[k])) ry=(f(ELLIPSE_95 * across[k])) transform=(turn)
                    fill=(colour(k)) fill-opacity="0.12" stroke=(colour(k)) stroke-width="0.7" {}
                circle cx=(f(at[k][0])) cy=(f(at[k][1])) r="1" fill=(colour(k)) {
                    title { (format!("confidence {:.2}", confidence[k])) }
                }
            }
        }
    };
    Ok(Some(detail))
}

/// Bars of a few numbers, each with its label.
pub(super) fn bars(rows: &[(String, f64)], unit: &str) -> Markup {
    let most = rows.iter().map(|(_, value)| *value).fold(1e-9, f64::max);
    let height = 20.0 * rows.len() as f64 + 4.0;
    html! {
        svg viewBox=(format!("0 0 {WIDE} {height:.0}")) role="img" aria-label="Bars" {
            @for (k, (name, value)) in rows.iter().enumerate() {
                @let y = 20.0 * k as f64 + 4.0;
                text x="0" y=(f(y + 11.0)) { (name) }
                rect x="110" y=(f(y)) width=(f(500.0 * value / most)) height="14" rx="3" fill="var(--accent)" {}
                text x=(f(118.0 + 500.0 * value / most)) y=(f(y + 11.0)) { (format!("{value:.1} {unit}")) }
            }
        }
    }
}
