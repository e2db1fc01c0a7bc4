//! The sections of maps and traits: surface and orthomosaic, leaves, plants, plots.

use super::{
    Facts,
    block::{scaled, shown},
    drawings, map,
    page::{Section, digits, drawing, figure, table},
    pictures,
};
use crate::{Stage, leaf_count::LeafCountOutcome, plots::PlotSource};
use maud::{Markup, html};
use rowgram_base::error::Error;
use rowgram_files::{csv_table::CsvTable, rasters::Source};
use rowgram_plants::phenotype::traits::leaf_name;
use rowgram_survey::mapping::colour_balance::ColourBalance;

/// Rows of a table that are shown; the file has all.
const MOST_ROWS: usize = 200;

/// How the colours of photos were brought together.
fn balanced(colour: &ColourBalance) -> Markup {
    let number = |value: f64, sigma: f64| format!("{value:.3} ± {sigma:.3}");
    html! {
        h3 { "Colours" }
        p {
            "Two photos of one place differ by " (format!("{:.1}", colour.difference.after)) " grey values, "
            (format!("{:.1}", colour.difference.before)) " before the adjustment of exposure, white balance, vignetting and light (median over "
            (colour.observations) " windows at " (colour.points) " places; " (format!("{:.1}", 100.0 * colour.downweighted))
            " % of them with reduced weight). The brightness of a window has a standard deviation of "
            (format!("{:.1}", 100.0 * colour.sigma)) " %. Photos are from " (format!("{:.2}", colour.gain_range[0])) " to "
            (format!("{:.2}", colour.gain_range[1])) " times as bright as the mean; the logarithm of a gain is known to "
            (format!("{:.4}", colour.gain_sigma)) " (median standard deviation). Exposures in the files of the photos "
            @if colour.with_exposures { "took part." } @else { "are not known." }
        }
        table {
            thead { tr {
                th { "camera" } th { "light in the corners" } th { "r²" } th { "r⁴" } th { "r⁶" } th { "to the east" } th { "to the north" }
            } }
            tbody {
                @for (k, of) in colour.cameras.iter().enumerate() {
                    tr {
                        td { (k + 1) } td { (format!("{:.2}", of.corner_light)) }
                        @for (value, sigma) in of.vignetting.iter().zip(&of.vignetting_sigma) { td { (number(*value, *sigma)) } }
                        @for (value, sigma) in of.direction[..2].iter().zip(&of.direction_sigma) { td { (number(*value, *sigma)) } }
                    }
                }
            }
        }
        p .note {
            "Coefficients of the logarithm of the light: vignetting by the distance from the principal point over half the diagonal, and "
            "by the tangent of the direction of view. ortho.json has what each photo was multiplied by."
        }
    }
}

/// Surface and orthomosaic.
///
/// # Errors
/// Files of the results that cannot be read.
pub(super) fn map(facts: &Facts<'_>) -> Result<Section, Error> {
    let Some(ortho) = facts.orthomosaic() else { return Ok(None) };
    let (width, height) = Source::open(&ortho)?.size();
    let gsd_m = facts.outcome.gsd_m;
    let gsd = gsd_m.map(|gsd_m| format!(" of {:.2} cm", 100.0 * gsd_m)).unwrap_or_default();
    let results = &facts.outcome.results;
    let canopy_height_m = results.ortho.as_ref().map_or(0.0, |ortho| ortho.canopy_height_m);
    let drawn = if canopy_height_m == 0.0 {
        String::new()
    } else {
        format!(
            " It is drawn {canopy_height_m:.2} m above the surface, where photos agree about the leaves: plants are in their \
             places, the ground beside them is up to a few centimetres off."
        )
    };
    let most = at_share(facts, Stage::Ortho, "figures/coverage.csv", "photos_that_show_it", 1.0)?;
    let most = digits(most, 0);
    let sigma_m = at_share(facts, Stage::Dem, "figures/heights.csv", "sigma_m", 0.95)?;
    let sigma_cm = digits(sigma_m.map(|m| 100.0 * m), 1);
    let caption = format!("The orthomosaic, {width} x {height} pixels{gsd}.{drawn}");
    let content = html! {
        @if let Some(map) = map::map(facts)? { (map) }
        p .note { (caption) }
        div .pair {
            (shown(facts, Stage::Ortho, "figures/sources.png", "Which photo each place comes from, and the seams between them.")?)
            (scaled(facts, Stage::Ortho, "figures/coverage.png", "How many photos show each place; white where none does.", ["1", &format!("{most} photos")])?)
        }
        @if let Some(colour) = results.ortho.as_ref().and_then(|ortho| ortho.colour.as_ref()) { (balanced(colour)) }
        @if let Some(dem) = &results.dem {
            p {
                "Surface: " (dem.width_px) " x " (dem.height_px) " cells of " (format!("{:.3}", dem.cell_m)) " m from "
                (dem.statistics.points) " points, " (dem.outlier_count) " left out; heights "
                (format!("{:.2}", dem.min_height_m)) " to " (format!("{:.2}", dem.max_height_m)) " m; median standard deviation "
                (digits(dem.median_sigma_m.map(|m| 100.0 * m), 1)) " cm."
            }
            div .pair {
                (shown(facts, Stage::Dem, "figures/hillshade.png", "The surface, shaded; where there are no points there is no height.")?)
                (scaled(facts, Stage::Dem, "figures/sigma.png", "Standard deviation of its heights; one cell in twenty exceeds the end of the scale.", ["0", &format!("{sigma_cm} cm")])?)
            }
        }
        @if let Some(surface) = &results.surface {
            h3 { "Canopy" }
            p {
                "Dense surface: " (surface.width_px) " x " (surface.height_px) " cells of " (format!("{:.3}", surface.cell_m)) " m, "
                @if let Some(file) = &surface.given {
                    "heights are those of " (file)
                } @else {
                    (format!("{:.1}", 100.0 * surface.cells_with_height as f64 / surface.cells_seen.max(1) as f64))
                    " % of those that two photos show have a height"
                }
                @if let Some([half, most, top]) = surface.canopy_percentiles_m {
                    "; over the ground 50 % of them at most " (format!("{half:.2}")) " m, 95 % " (format!("{most:.2}")) " m, 99 % "
                    (format!("{top:.2}")) " m"
                }
                "."
            }
            div .pair {
                (shown(facts, Stage::Surface, "figures/surface.png", "The dense surface, shaded.")?)
                (scaled(facts, Stage::Surface, "figures/canopy.png", "Height over the ground; one cell in 200 exceeds the end of the scale.", ["0", &format!("{} m", digits(surface.canopy_picture_to_m, 2))])?)
            }
            (shown(facts, Stage::Surface, "figures/profile.svg", "A line across the middle of the map: the surface and the ground below it.")?)
        }
    };
    Ok(Some(("map", "Map", content)))
}

/// The value of a column at a share of the rows of a table that is sorted by it.
fn at_share(
    facts: &Facts<'_>,
    stage: Stage,
    name: &str,
    column: &str,
    share: f64,
) -> Result<Option<f64>, Error> {
    let values = facts.table(stage, name)?.and_then(|table| table.numbers(column));
    Ok(values.and_then(|of| {
        of.get((of.len().saturating_sub(1) as f64 * share).round() as usize).copied()
    }))
}

/// Mask, density, leaves.
///
/// # Errors
/// Files of the results that cannot be read.
pub(super) fn leaves(facts: &Facts<'_>) -> Result<Section, Error> {
    let results = &facts.outcome.results;
    let (Some(segment), Some(mask)) = (&results.segment, facts.file(Stage::Segment, "mask.tif"))
    else {
        return Ok(None);
    };
    let overview = pictures::overview(&Source::open(&mask)?, 1100)?;
    let densest = results.leaf_density.as_ref().map_or(0, |density| density.largest);
    let content = html! {
        p {
            "Leaves cover " (format!("{:.2}", 100.0 * segment.leaf_share)) " % of the map"
            @if let Some(gsd_m) = facts.outcome.gsd_m {
                ", " (format!("{:.1}", segment.leaf_pixels as f64 * gsd_m * gsd_m)) " m²"
            }
            @if let Some(hsv) = segment.hsv {
                // Hues of the 8-bit HSV are half degrees; the page has degrees everywhere.
                ": pixels with a hue from " (2 * u16::from(hsv.hue_min)) "° to " (2 * u16::from(hsv.hue_max))
                "°, and a saturation from " (hsv.saturation_min) " or a value from " (hsv.value_min) " (of 255)."
            } @else {
                ", estimated from the colours of the map itself."
            }
        }
        div .pair {
            (figure(&pictures::jpeg(&pictures::green(&overview.picture), 1100)?, "The leaf mask.", ""))
            (scaled(facts, Stage::LeafDensity, "figures/density.png", "Local density: leaf pixels around each pixel.", ["0", &format!("{densest} pixels")])?)
        }
        @if let Some(count) = &results.leaf_count {
            h3 { "Leaves by area" }
            p { (format!("{:.1}", count.rho_px)) " leaf pixels per leaf." }
            (table(&["where", "leaf pixels", "leaves", "95 %"], &counts(count)))
        }
        @if let Some(leaves) = &results.leaves {
            h3 { "Leaves one by one" }
            p {
                (leaves.leaves) " leaves were told apart"
                @if let Some(length) = leaves.median_length_m { ", of a median length of " (format!("{:.1}", 100.0 * length)) " cm" }
                ". Where leaves cover one another this finds fewer than there are."
            }
        }
    };
    Ok(Some(("leaves", "Leaves", content)))
}

fn counts(count: &LeafCountOutcome) -> Vec<Vec<String>> {
    let rows = count.counts.iter().take(MOST_ROWS).map(|line| {
        let interval = line.count.interval.as_ref();
        vec![
            line.plot.clone(),
            line.count.pixels.to_string(),
            format!("{:.0}", line.count.leaves),
            interval.map_or("-".to_owned(), |of| format!("{:.0} to {:.0}", of.low, of.high)),
        ]
    });
    rows.collect()
}

/// Plants, rows, gaps.
///
/// # Errors
/// Files of the results that cannot be read.
pub(super) fn plants(facts: &Facts<'_>) -> Result<Section, Error> {
    let Some(locate) = &facts.outcome.results.locate else { return Ok(None) };
    let detail = drawings::plants(facts)?;
    let rows = facts.table(Stage::Locate, "rows.csv")?;
    let gaps = facts.table(Stage::Locate, "gaps.csv")?;
    let cm = |metres: Option<f64>| digits(metres.map(|m| 100.0 * m), 1);
    let content = html! {
        p {
            (locate.plants) " plants in " (locate.rows) " rows"
            @if let Some(stand) = &locate.stand {
                @let [low, high] = stand.plants_interval;
                @if low < high {
                    " (" (format!("{low:.0}")) " to " (format!("{high:.0}")) " with a probability of 95 %)"
                }
                @if stand.spacing_m.is_some() {
                    "; " (cm(stand.spacing_m)) " cm apart, rows " (cm(locate.row_spacing_m)) " cm"
                }
                "; " (format!("{:.1} %", 100.0 * stand.share_missing)) " missing"
            }
            @if let Some(heading) = locate.heading_deg { "; rows at " (format!("{heading:.1}")) "° in the picture" }
            "."
        }
        @if let Some(detail) = &detail {
            (drawing(detail, "Part of the map as it is: plants with ellipses of 95 % (2.448 standard deviations along and across the row), orange where they are doubtful (confidence below one half)."))
        }
        @if let Some(rows) = &rows {
            details open[rows.len() <= 12] { summary { "Rows (" (rows.len()) ")" } (beginning(rows)) }
        }
        @if let Some(gaps) = gaps.as_ref().filter(|gaps| !gaps.is_empty()) {
            details { summary { "Gaps (" (gaps.len()) ")" } (beginning(gaps)) }
        }
    };
    Ok(Some(("plants", "Plants", content)))
}

/// The first rows of a table.
fn beginning(of: &CsvTable) -> Markup {
    let header: Vec<String> = of.header().iter().map(|name| name.replace('_', " ")).collect();
    let names: Vec<&str> = header.iter().map(String::as_str).collect();
    let row = |row: usize| of.row(row).map(str::to_owned).collect();
    let rows: Vec<Vec<String>> = (0..of.len().min(MOST_ROWS)).map(row).collect();
    table(&names, &rows)
}

/// Traits that are shown, their titles and digits.
const COLUMNS: [(&str, &str, usize); 15] = [
    ("area_m2", "area, m²", 1),
    ("plants", "plants", 0),
    ("plants_per_ha", "per hectare", 0),
    ("missing_plants", "missing", 0),
    ("canopy_cover", "cover", 3),
    ("weeds", "weeds", 0),
    ("leaves_by_area", "leaves by area", 0),
    ("leaves_single", "leaves told apart", 0),
    ("leaf_length_m", "leaf length, m", 3),
    ("leaf_hue_deg", "hue, °", 1),
    ("plant_spacing_m", "spacing, m", 3),
    ("plant_spacing_cv", "spacing CV", 2),
    ("canopy_height_m", "height, m", 2),
    ("exg", "ExG", 3),
    ("ngrdi", "NGRDI", 3),
];

/// A trait that is shown: its name, its title, its digits.
type Column = (String, String, usize);

/// Traits of the plots.
pub(super) fn plots(facts: &Facts<'_>) -> Section {
    let outcome = facts.outcome.results.plots.as_ref().filter(|of| !of.plots.is_empty())?;
    let plots = &outcome.plots;
    let is_index = |name: &str| outcome.indices.iter().any(|index| index.name == name);
    let usual = COLUMNS.iter().filter(|(name, ..)| !is_index(name));
    let usual = usual.map(|(name, title, n)| ((*name).to_owned(), (*title).to_owned(), *n));
    let spectral = outcome.indices.iter().flat_map(|index| {
        let of_leaf = (leaf_name(&index.name), format!("{} of leaves", index.name), 3);
        [(index.name.clone(), index.name.clone(), 3), of_leaf]
    });
    let is_known = |(name, ..): &Column| plots.iter().any(|plot| plot.value(name).is_some());
    let known: Vec<Column> = usual.chain(spectral).filter(is_known).collect();
    let mut header = vec!["plot"];
    header.extend(known.iter().map(|(_, title, _)| title.as_str()));
    let rows: Vec<Vec<String>> = plots
        .iter()
        .take(MOST_ROWS)
        .map(|plot| {
            let mut row = vec![plot.plot.clone()];
            row.extend(known.iter().map(|(name, _, n)| digits(plot.value(name), *n)));
            row
        })
        .collect();
    let bars: Vec<(String, f64)> = plots
        .iter()
        .take(40)
        .filter_map(|plot| Some((plot.plot.clone(), 100.0 * plot.canopy_cover?)))
        .collect();
    let source = match outcome.source {
        PlotSource::Polygons => "Plots are the polygons of the project.",
        PlotSource::Rows => "Plots are groups of rows, cut at alleys.",
        PlotSource::WholeField => "The whole field is one plot.",
    };
    let content = html! {
        p { (source) " The same as CSV (wide and tidy), GeoJSON, GeoPackage and BrAPI observations in plots/." }
        (table(&header, &rows))
        @if bars.len() > 1 { h3 { "Canopy cover" } (drawing(&drawings::bars(&bars, "%"), "Share of each plot that leaves cover.")) }
    };
    Some(("plots", "Plots", content))
}
