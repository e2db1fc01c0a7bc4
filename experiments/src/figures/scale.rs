//! Colours, markers, extents and the canvas that all looks share.

use plotters::{
    coord::Shift,
    prelude::*,
    style::{FontFamily, RGBAColor},
};
use rowgram::raster::density;

/// The drawing area of a figure.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// What plotters answers.
pub(super) type Done = Result<(), Box<dyn std::error::Error>>;

/// Okabe and Ito, "Color Universal Design", 2008; yellow is left out, for it is lost on white.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(0, 0, 0),
];

/// Sizes of letters, for a picture 720 wide in a column 240 points wide.
pub(super) const LABEL: u32 = 21;
pub(super) const TITLE: u32 = 22;

/// Whether the lines of a series are dashed: the colours are used up before it.
pub(super) fn is_dashed(series: usize) -> bool {
    series >= COLOURS.len()
}

/// The colour of a series.
pub(super) fn colour(series: usize) -> RGBColor {
    COLOURS[series % COLOURS.len()]
}

/// The font of a label.
pub(super) fn font(size: u32) -> TextStyle<'static> {
    (FontFamily::SansSerif, size).into_font().color(&BLACK)
}

/// A light version of a colour.
pub(super) fn light(series: usize) -> RGBAColor {
    colour(series).mix(0.2)
}

/// The colour of a share from 0 to 1.
pub(super) fn viridis(share: f64) -> RGBColor {
    let [red, green, blue] = density::colour(share);
    RGBColor(red, green, blue)
}

/// The extent of numbers, a little wider; never empty. On a logarithmic axis, of the logarithms.
pub(super) fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for value in values.filter(|value| value.is_finite()) {
        (low, high) = (low.min(value), high.max(value));
    }
    if low > high {
        return None;
    }
    let margin = if high > low { 0.05 * (high - low) } else { 0.5 * low.abs().max(0.02) };
    Some((low - margin, high + margin))
}

/// Axes are linear in what is drawn; a logarithmic one is drawn in powers of ten.
pub(super) fn placed(value: f64, logarithmic: bool) -> f64 {
    if logarithmic { value.log10() } else { value }
}

/// How a number stands at its tick.
pub(super) fn tick(place: f64, logarithmic: bool) -> String {
    let value = if logarithmic { 10f64.powf(place) } else { place };
    let size = value.abs();
    if value == 0.0 {
        "0".to_owned()
    } else if !(1e-3..1e5).contains(&size) {
        format!("{value:.0e}")
    } else {
        let digits = if size < 0.1 {
            3
        } else if size < 10.0 {
            2
        } else {
            0
        };
        let text = format!("{value:.digits$}");
        if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.').to_owned()
        } else {
            text
        }
    }
}

/// A number in the key of a figure.
pub(super) fn short(value: f64) -> String {
    if value != 0.0 && !(1e-3..1e5).contains(&value.abs()) {
        format!("{value:.2e}")
    } else {
        format!("{value:.3}")
    }
}

/// Rows and columns of small multiples.
pub(super) fn layout(panels: usize) -> (usize, usize) {
    let columns = match panels {
        0 | 1 => 1,
        2 | 4 => 2,
        _ => 3,
    };
    (panels.div_ceil(columns).max(1), columns)
}

/// Width of a picture for one column.
const COLUMN: u32 = 720;

/// Room for the name of a series: its line, and each letter. The height of a line of names.
const NAME: usize = 66;
const LETTER: usize = 8;
pub(super) const LINE: u32 = 26;

/// Whether a picture was drawn for one column.
pub(super) fn is_one_column(svg: &str) -> bool {
    svg.starts_with(&format!("<svg width=\"{COLUMN}\""))
}

/// Draws panels on one canvas, `height` high each, and below them the names of the series where there are several.
pub(super) fn canvas(
    panels: usize,
    height: u32,
    names: &[&str],
    mut draw: impl FnMut(usize, &Area<'_>) -> Done,
) -> Result<String, String> {
    let (rows, columns) = layout(panels);
    let width = if columns == 1 { COLUMN } else { 480 * columns as u32 };
    let longest = names.iter().map(|name| name.chars().count()).max().unwrap_or(0);
    let beside = (width as usize / (NAME + LETTER * longest)).max(1);
    let foot = if names.len() > 1 { LINE * names.len().div_ceil(beside) as u32 + 6 } else { 0 };
    let (body, mut svg) = (height * rows as u32, String::new());
    let mut run = |svg: &mut String| -> Done {
        let area = SVGBackend::with_string(svg, (width, body + foot)).into_drawing_area();
        area.fill(&WHITE)?;
        let (upper, lower) = area.split_vertically(body);
        for (panel, part) in upper.split_evenly((rows, columns)).iter().enumerate().take(panels) {
            draw(panel, part)?;
        }
        if foot > 0 {
            super::curves::legend_of(&lower, names, beside)?;
        }
        area.present()?;
        Ok(())
    };
    run(&mut svg).map_err(|e| e.to_string())?;
    Ok(svg)
}
