//! The sections of the page.

use super::{
    facts::{Facts, number},
    maps,
    page::{Section, drawing, figure, table},
    pictures,
};
use crate::error::Error;
use maud::{Markup, html};
use serde_json::Value;

/// Rows of a table that are shown; the file has all.
const MOST_ROWS: usize = 200;

pub(super) fn array(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

pub(super) fn word<'v>(value: &'v Value, name: &str) -> &'v str {
    value.get(name).and_then(Value::as_str).unwrap_or_default()
}

pub(super) fn digits(value: Option<f64>, digits: usize) -> String {
    value.filter(|x| x.is_finite()).map_or("-".to_owned(), |x| format!("{x:.digits$}"))
}

/// A file of a stage as a figure, where it is there.
fn shown(facts: &Facts, stage: &str, name: &str, caption: &str) -> Result<Markup, Error> {
    Ok(match facts.file(stage, name) {
        Some(path) => figure(&pictures::file(&path)?, caption, "paper"),
        None => html! {},
    })
}

/// Cameras, overlap, matches.
pub(super) fn block(facts: &Facts) -> Result<Section, Error> {
    if !facts.done("align") {
        return Ok(None);
    }
    let align = facts.says("align");
    let whole = |path: &str| digits(number(align, path), 0);
    let pieces = match number(align, "/fragments") {
        Some(1.0) => "one piece".to_owned(),
        fragments => format!("{} pieces", digits(fragments, 0)),
    };
    let findings = array(&align["findings"]);
    let unregistered = array(&align["unregistered"]);
    let content = html! {
        p {
            (whole("/registered")) " of " (whole("/images")) " photos in " (pieces) "; "
            (whole("/tie_points")) " tie points with " (whole("/observations")) " measurements; "
            (whole("/pairs")) " oriented pairs; reprojection rms " (digits(number(align, "/reprojection_rms_px"), 3)) " px; "
            (word(align, "crs")) "."
        }
        @if !unregistered.is_empty() {
            p { "Not oriented: " (unregistered.iter().filter_map(Value::as_str).collect::<Vec<_>>().join(", ")) }
        }
        div .pair {
            @if let Some((map, caption)) = maps::cameras(facts)? { (drawing(&map, &caption)) }
            (shown(facts, "align", "report/overlap.svg", "How many photos see each place.")?)
        }
        div .pair {
            (shown(facts, "align", "report/match-graph.svg", "Match graph: which photos match, and by which solver they were oriented.")?)
            (shown(facts, "align", "report/cloud-above.png", "The sparse cloud from above.")?)
        }
        @if !findings.is_empty() {
            details open[findings.len() < 6] {
                summary { (findings.len()) " remarks" }
                ul { @for finding in findings { li { b { (word(finding, "subject")) } ": " (word(finding, "what")) } } }
            }
        }
    };
    Ok(Some(("block", "Block", content)))
}

/// What the adjustment says of itself.
pub(super) fn adjustment(facts: &Facts) -> Result<Section, Error> {
    let of = &facts.adjustment;
    if of.is_null() {
        return Ok(None);
    }
    let whole = |path: &str| digits(number(of, path), 0);
    let groups: Vec<Vec<String>> = array(&of["groups"])
        .iter()
        .map(|group| {
            vec![
                word(group, "group").replace('-', " "),
                digits(number(group, "/observations"), 0),
                digits(number(group, "/redundancy"), 1),
                digits(number(group, "/variance_factor").map(f64::sqrt), 3),
            ]
        })
        .collect();
    let content = html! {
        p {
            (whole("/observations")) " observations, " (whole("/parameters")) " parameters, redundancy " (whole("/redundancy"))
            "; sigma0 " (digits(number(of, "/sigma0"), 3))
            @if let (Some(low), Some(high)) = (number(of, "/sigma0_interval/0"), number(of, "/sigma0_interval/1")) {
                " (" (format!("{low:.3}")) " to " (format!("{high:.3}")) " expected)"
            }
            "; " (whole("/iterations")) " iterations; "
            (array(&of["removed"]).len()) " observations taken out, " (array(&of["suspects"]).len()) " suspect."
        }
        (table(&["observations", "number", "redundancy", "own sigma0"], &groups))
        @for interior in array(&of["interiors"]) {
            h3 { "Camera " (digits(number(interior, "/camera").map(|k| k + 1.0), 0)) }
            div .pair {
                div { (parameters(interior)) }
                div { (correlation(interior)) }
            }
        }
        @let same = array(&of["nearly_the_same"]);
        @if !same.is_empty() {
            ul { @for line in same { li { (line.as_str().unwrap_or_default()) } } }
        }
        div .pair {
            (shown(facts, "align", "report/residuals-1.svg", "Mean residuals by place in the image: a pattern here is a lens that is not modelled.")?)
            (shown(facts, "align", "report/control.svg", "Control and check points: adjusted minus given, in plan.")?)
        }
    };
    Ok(Some(("adjustment", "Adjustment", content)))
}

fn parameters(interior: &Value) -> Markup {
    let (values, sigmas) = (array(&interior["values"]), array(&interior["standard_deviations"]));
    let rows: Vec<Vec<String>> = array(&interior["names"])
        .iter()
        .enumerate()
        .map(|(k, name)| {
            let of = |list: &[Value]| list.get(k).and_then(Value::as_f64).unwrap_or(f64::NAN);
            let (value, sigma) = (of(values), of(sigmas));
            vec![
                name.as_str().unwrap_or_default().to_owned(),
                if value.abs() >= 0.01 { format!("{value:.4}") } else { format!("{value:.4e}") },
                format!("{sigma:.1e}"),
            ]
        })
        .collect();
    table(&["parameter", "value", "standard deviation"], &rows)
}

fn correlation(interior: &Value) -> Markup {
    let names: Vec<&str> = array(&interior["names"]).iter().filter_map(Value::as_str).collect();
    let rows = array(&interior["correlation"]);
    let colour = |value: f64| {
        // Mixed with white, so that the dark numbers are read in both themes.
        let rest = 255.0 - 150.0 * value.abs().min(1.0);
        if value > 0.0 {
            format!("background:rgb(255,{rest:.0},{:.0})", rest - 10.0)
        } else {
            format!("background:rgb({:.0},{rest:.0},255)", rest - 10.0)
        }
    };
    html! {
        div .scroll { table .matrix {
            thead { tr { th {} @for name in &names { th { (name) } } } }
            tbody { @for (name, row) in names.iter().zip(rows) {
                tr {
                    th { (name) }
                    @for value in array(row).iter().filter_map(Value::as_f64) {
                        td style=(colour(value)) { (format!("{value:.2}")) }
                    }
                }
            } }
        } }
        p .note { "Correlations of the interior orientation; beyond 0.95 two parameters are nearly the same here." }
    }
}

/// Control and check points one by one.
pub(super) fn ground(facts: &Facts) -> Result<Section, Error> {
    let points = array(&facts.adjustment["ground"]);
    if points.is_empty() {
        return Ok(None);
    }
    // Two-sided 95 % of the normal distribution.
    let half = crate::phenotype::stand::NORMAL_95;
    let row = |point: &Value| {
        let mut row = vec![word(point, "name").to_owned(), word(point, "role").to_owned()];
        for axis in 0..3 {
            let difference = number(point, &format!("/difference_m/{axis}"));
            let sigma = number(point, &format!("/sigma_m/{axis}"));
            let text = match (difference, sigma) {
                (Some(d), Some(s)) => format!("{:+.1} ± {:.1}", 100.0 * d, 100.0 * half * s),
                _ => "-".to_owned(),
            };
            row.push(text);
        }
        row
    };
    let mut sorted: Vec<&Value> = points.iter().collect();
    sorted.sort_by_key(|point| (word(point, "role") != "check", word(point, "name").to_owned()));
    let rows: Vec<Vec<String>> = sorted.into_iter().map(row).collect();
    let rmse: Vec<Vec<String>> = ["X", "Y", "Z"]
        .iter()
        .zip(array(&facts.adjustment["check_rmse"]))
        .filter(|(_, error)| !error.is_null())
        .map(|(axis, error)| {
            let cm = |path: &str| digits(number(error, path).map(|m| 100.0 * m), 2);
            vec![
                (*axis).to_owned(),
                cm("/rmse_m"),
                format!("{} to {}", cm("/interval_m/0"), cm("/interval_m/1")),
                cm("/mean_m"),
                digits(number(error, "/count"), 0),
            ]
        })
        .collect();
    let content = html! {
        @if rmse.is_empty() {
            p { "There are no check points: nothing independent tells how large the errors are." }
        } @else {
            p { "Check points take no part in the adjustment; their errors are those of the map." }
            (table(&["axis", "rmse, cm", "95 %", "mean, cm", "points"], &rmse))
        }
        h3 { "One by one: adjusted minus given, cm, with the half width of its interval" }
        (table(&["point", "role", "X", "Y", "Z"], &rows))
    };
    Ok(Some(("ground", "Ground points", content)))
}

/// Surface and orthomosaic.
pub(super) fn map(facts: &Facts) -> Result<Section, Error> {
    let Some(ortho) = facts.ortho() else { return Ok(None) };
    let overview = pictures::overview(&ortho, 1400)?;
    let (width, height) = overview.size;
    let gsd = facts.gsd_m().map(|gsd| format!(" of {:.2} cm", 100.0 * gsd)).unwrap_or_default();
    let above = number(facts.says("ortho"), "/maps/0/above_m").filter(|above| *above != 0.0);
    let above = above.map_or_else(String::new, |above| {
        format!(
            " It is drawn {above:.2} m above the surface, where photos agree about the leaves: plants are in their places, the ground \
             beside them is up to a few centimetres off."
        )
    });
    let caption = format!("The orthomosaic, {width} x {height} pixels{gsd}.{above}");
    let dem = facts.says("dem");
    let content = html! {
        (figure(&pictures::jpeg(&pictures::on_paper(overview.picture), 1400)?, &caption, ""))
        div .pair {
            (shown(facts, "ortho", "figures/sources.png", "Which photo each place comes from, and the seams between them.")?)
            (shown(facts, "ortho", "figures/coverage.png", "How many photos show each place, from none to many.")?)
        }
        @if facts.done("dem") {
            p {
                "Surface: " (digits(number(dem, "/width_px"), 0)) " x " (digits(number(dem, "/height_px"), 0)) " cells of "
                (digits(number(dem, "/cell_m"), 3)) " m from " (digits(number(dem, "/points"), 0)) " points, "
                (digits(number(dem, "/outlier_count"), 0)) " left out; heights "
                (digits(number(dem, "/least_m"), 2)) " to " (digits(number(dem, "/greatest_m"), 2)) " m; median standard deviation "
                (digits(number(dem, "/median_sigma_m").map(|m| 100.0 * m), 1)) " cm."
            }
            div .pair {
                (shown(facts, "dem", "figures/hillshade.png", "The surface, shaded; where there are no points there is no height.")?)
                (shown(facts, "dem", "figures/sigma.png", "Standard deviation of its heights.")?)
            }
        }
    };
    Ok(Some(("map", "Map", content)))
}

/// Mask, density, leaves.
pub(super) fn leaves(facts: &Facts) -> Result<Section, Error> {
    let Some(mask) = facts.file("segment", "mask.tif") else { return Ok(None) };
    let overview = pictures::overview(&mask, 1100)?;
    let segment = facts.says("segment");
    let of = |name: &str| {
        let value = segment.pointer(&format!("/thresholds/{name}"));
        value.map(Value::to_string).unwrap_or_default()
    };
    let (count, leaves) = (facts.says("count"), facts.says("leaves"));
    let content = html! {
        p {
            "Leaves cover " (digits(number(segment, "/plant_share").map(|s| 100.0 * s), 2)) " % of the map"
            @if let Some(gsd) = facts.gsd_m() {
                ", " (digits(number(segment, "/plant_pixels").map(|n| n * gsd * gsd), 1)) " m²"
            }
            @if !of("tau1").is_empty() {
                "; hue " (of("tau1")) " to " (of("tau2")) ", saturation from " (of("tau3")) " or value from " (of("tau4"))
            }
            "."
        }
        div .pair {
            (figure(&pictures::jpeg(&pictures::green(&overview.picture), 1100)?, "The leaf mask.", ""))
            (shown(facts, "density", "density.png", "Local density: leaf pixels around each pixel, from dark blue (none) to yellow (many).")?)
        }
        @if facts.done("count") {
            h3 { "Leaves by area" }
            p { (digits(number(count, "/rho"), 1)) " leaf pixels per leaf." }
            (table(&["where", "leaf pixels", "leaves", "95 %"], &counts(count)))
        }
        @if facts.done("leaves") {
            h3 { "Leaves one by one" }
            p {
                (digits(number(leaves, "/leaves"), 0)) " leaves were told apart"
                @if let Some(length) = number(leaves, "/median_length_m") { ", of a median length of " (format!("{:.1}", 100.0 * length)) " cm" }
                ". Where leaves cover one another this finds fewer than there are."
            }
        }
    };
    Ok(Some(("leaves", "Leaves", content)))
}

fn counts(count: &Value) -> Vec<Vec<String>> {
    let row = |line: &Value| {
        let interval = match (number(line, "/interval/low"), number(line, "/interval/high")) {
            (Some(low), Some(high)) => format!("{low:.0} to {high:.0}"),
            _ => "-".to_owned(),
        };
        vec![
            word(line, "plot").to_owned(),
            digits(number(line, "/pixels"), 0),
            digits(number(line, "/leaves"), 0),
            interval,
        ]
    };
    array(&count["counts"]).iter().take(MOST_ROWS).map(row).collect()
}

/// Plants, rows, gaps.
pub(super) fn plants(facts: &Facts) -> Result<Section, Error> {
    let locate = facts.says("locate");
    if locate.is_null() {
        return Ok(None);
    }
    let cm = |path: &str| digits(number(locate, path).map(|m| 100.0 * m), 1);
    let pictures = maps::plants(facts)?;
    let rows = facts.table("locate", "rows.csv")?;
    let gaps = facts.table("locate", "gaps.csv")?;
    let shorten = |table: &crate::io::csv_table::CsvTable| {
        let (header, rows) = table.all();
        let header: Vec<String> = header.iter().map(|name| name.replace('_', " ")).collect();
        let names: Vec<&str> = header.iter().map(String::as_str).collect();
        let rows: Vec<Vec<String>> = rows.iter().take(MOST_ROWS).cloned().collect();
        self::table(&names, &rows)
    };
    let content = html! {
        p {
            (digits(number(locate, "/plants"), 0)) " plants in " (digits(number(locate, "/rows"), 0)) " rows"
            @if let (Some(low), Some(high)) = (number(locate, "/plants_interval/0"), number(locate, "/plants_interval/1")) {
                " (by the leaves alone " (format!("{low:.0}")) " to " (format!("{high:.0}")) ")"
            }
            @if number(locate, "/spacing_m").is_some() {
                "; " (cm("/spacing_m")) " cm apart, rows " (cm("/row_spacing_m")) " cm"
            }
            @if let Some(missing) = number(locate, "/share_missing") { "; " (format!("{:.1} %", 100.0 * missing)) " missing" }
            @if let Some(heading) = number(locate, "/heading_deg") { "; rows at " (format!("{heading:.1}")) "° in the picture" }
            "."
        }
        @if let Some((map, detail)) = &pictures {
            (drawing(map, "The plants on the map: red, and orange where they are doubtful (confidence below one half)."))
            @if let Some(detail) = detail {
                (drawing(detail, "A part of it as it is, with ellipses of 95 %."))
            }
        }
        @if let Some(rows) = &rows {
            details open[rows.len() <= 12] { summary { "Rows (" (rows.len()) ")" } (shorten(rows)) }
        }
        @if let Some(gaps) = gaps.as_ref().filter(|gaps| gaps.len() > 0) {
            details { summary { "Gaps (" (gaps.len()) ")" } (shorten(gaps)) }
        }
    };
    Ok(Some(("plants", "Plants", content)))
}

/// Traits of the plots.
pub(super) fn plots(facts: &Facts) -> Result<Section, Error> {
    let says = facts.says("plots");
    let plots = array(&says["plots"]);
    if plots.is_empty() {
        return Ok(None);
    }
    const COLUMNS: [(&str, &str, usize); 9] = [
        ("area_m2", "area, m²", 1),
        ("plants", "plants", 0),
        ("plants_per_ha", "per hectare", 0),
        ("missing_plants", "missing", 0),
        ("canopy_cover", "cover", 3),
        ("leaves_by_area", "leaves by area", 0),
        ("leaves_single", "leaves told apart", 0),
        ("leaf_length_m", "leaf length, m", 3),
        ("leaf_hue_deg", "hue, °", 1),
    ];
    let known: Vec<_> = COLUMNS
        .iter()
        .filter(|(name, ..)| plots.iter().any(|plot| number(plot, &format!("/{name}")).is_some()))
        .collect();
    let mut header = vec!["plot"];
    header.extend(known.iter().map(|(_, title, _)| *title));
    let rows: Vec<Vec<String>> = plots
        .iter()
        .take(MOST_ROWS)
        .map(|plot| {
            let mut row = vec![word(plot, "plot").to_owned()];
            let cell =
                |(name, _, n): &&(&str, &str, usize)| digits(number(plot, &format!("/{name}")), *n);
            row.extend(known.iter().map(cell));
            row
        })
        .collect();
    let bars: Vec<(String, f64)> = plots
        .iter()
        .take(40)
        .filter_map(|plot| {
            Some((word(plot, "plot").to_owned(), 100.0 * number(plot, "/canopy_cover")?))
        })
        .collect();
    let content = html! {
        p { "Plots from " (word(says, "from")) ". The same as CSV (wide and tidy), GeoJSON and BrAPI observations in plots/." }
        (table(&header, &rows))
        @if bars.len() > 1 { h3 { "Canopy cover" } (drawing(&maps::bars(&bars, "%"), "Share of each plot that leaves cover.")) }
    };
    Ok(Some(("plots", "Plots", content)))
}
