//! Styles for QGIS (QML): a layer opens coloured and labelled where a style of its name lies beside it.
//!
//! Only symbols and labels are described; all else is QGIS's own. Written for version 3.16 and later, whose readers also
//! take what earlier ones wrote.
//!
//! Reference: QGIS user guide, "QML - the QGIS style file format"; the elements are those that QGIS 3.22 saves.

use super::{FileError, output};
use std::{fmt::Write as _, path::Path};

/// Colours from low to high values, the perceptually even map viridis at five places.
const RAMP: [[u8; 3]; 5] =
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/// What a layer looks like.
#[derive(Debug, Clone, PartialEq)]
pub enum Style<'a> {
    /// Polygons coloured by a number in five classes, labelled with a text; outlines where the number is the same for all.
    Polygons {
        /// The number that decides the colour.
        by: &'a str,
        /// Its least and its greatest value.
        range: [f64; 2],
        /// The column of the label.
        label: &'a str,
    },
    /// Points in classes of a number from 0 on; each class has its upper end, its colour and its words.
    Points {
        /// The number that decides the class.
        by: &'a str,
        /// Upper ends with red, green, blue and the words of the legend, ascending.
        classes: &'a [(f64, [u8; 3], &'a str)],
        /// Diameter of a point, millimetres on the screen.
        size_mm: f64,
    },
    /// Points of one colour, labelled with a number.
    LabelledPoints {
        /// Red, green and blue.
        colour: [u8; 3],
        /// The column of the label.
        label: &'a str,
    },
    /// A raster of heights or of another quantity, coloured from low to high.
    Raster {
        /// Least and greatest value of the colours.
        range: [f64; 2],
        /// What the quantity is called, with its unit.
        quantity: &'a str,
    },
}

/// Writes a style; its file has the layer's name and the ending `.qml`.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, force: bool, style: &Style<'_>) -> Result<(), FileError> {
    let text = style.text();
    output::write(path, force, |out| out.write_all(text.as_bytes()))
}

/// As XML wants it in an attribute.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn option(name: &str, value: &str) -> String {
    format!("<Option name=\"{name}\" type=\"QString\" value=\"{}\"/>", escaped(value))
}

fn rgba([r, g, b]: [u8; 3]) -> String {
    format!("{r},{g},{b},255")
}

/// A symbol of one layer.
fn symbol(kind: &str, class: &str, name: usize, alpha: f64, options: &[(&str, String)]) -> String {
    let options: String = options.iter().map(|(name, value)| option(name, value)).collect();
    format!(
        "<symbol type=\"{kind}\" name=\"{name}\" alpha=\"{alpha}\" clip_to_extent=\"1\" force_rhr=\"0\">\
         <layer class=\"{class}\" enabled=\"1\" locked=\"0\" pass=\"0\"><Option type=\"Map\">{options}</Option></layer></symbol>\n"
    )
}

fn marker(name: usize, colour: [u8; 3], size_mm: f64) -> String {
    let options = [
        ("name", "circle".to_owned()),
        ("color", rgba(colour)),
        ("outline_color", "255,255,255,255".to_owned()),
        ("outline_style", "solid".to_owned()),
        ("outline_width", "0.15".to_owned()),
        ("outline_width_unit", "MM".to_owned()),
        ("size", size_mm.to_string()),
        ("size_unit", "MM".to_owned()),
    ];
    symbol("marker", "SimpleMarker", name, 1.0, &options)
}

/// Polygons that are all alike: their outlines.
fn outline() -> String {
    let options = [
        ("style", "no".to_owned()),
        ("outline_color", "255,255,255,255".to_owned()),
        ("outline_style", "solid".to_owned()),
        ("outline_width", "0.6".to_owned()),
        ("outline_width_unit", "MM".to_owned()),
    ];
    single(&symbol("fill", "SimpleFill", 0, 1.0, &options))
}

/// One symbol for all.
fn single(symbol: &str) -> String {
    format!(
        "<renderer-v2 type=\"singleSymbol\" symbollevels=\"0\" enableorderby=\"0\" forceraster=\"0\"><symbols>\n{symbol}\
         </symbols></renderer-v2>\n"
    )
}

/// Classes of a number: lower end, upper end, words, symbol.
fn graduated(by: &str, classes: &[(f64, f64, String)], symbols: &str) -> String {
    let mut text = format!(
        "<renderer-v2 type=\"graduatedSymbol\" attr=\"{}\" graduatedMethod=\"GraduatedColor\" symbollevels=\"0\" \
         enableorderby=\"0\" forceraster=\"0\">\n<ranges>\n",
        escaped(by)
    );
    for (number, (lower, upper, words)) in classes.iter().enumerate() {
        let _ = writeln!(
            text,
            "<range lower=\"{lower}\" upper=\"{upper}\" symbol=\"{number}\" label=\"{}\" render=\"true\"/>",
            escaped(words)
        );
    }
    text + "</ranges>\n<symbols>\n" + symbols + "</symbols>\n</renderer-v2>\n"
}

/// Labels with a white halo.
fn labels(column: &str) -> String {
    format!(
        "<labeling type=\"simple\"><settings calloutType=\"simple\">\
         <text-style fieldName=\"{}\" isExpression=\"0\" fontFamily=\"Sans\" fontSize=\"9\" fontSizeUnit=\"Point\" \
         textColor=\"30,30,30,255\" textOpacity=\"1\">\
         <text-buffer bufferDraw=\"1\" bufferSize=\"0.8\" bufferSizeUnits=\"MM\" bufferColor=\"255,255,255,255\" bufferOpacity=\"1\"/>\
         </text-style><placement placement=\"1\" dist=\"0\"/><rendering scaleVisibility=\"0\" drawLabels=\"1\"/></settings></labeling>\n",
        escaped(column)
    )
}

/// A number as a legend shows it: three significant digits.
fn shown(value: f64) -> String {
    let digits = if value == 0.0 { 0 } else { (2 - value.abs().log10().floor() as i32).max(0) };
    format!("{value:.*}", digits as usize)
}

/// `count + 1` even steps of a range; one of no width is widened, so that its value is in a class.
fn steps([low, high]: [f64; 2], count: usize) -> Vec<f64> {
    let wide = high - low > f64::EPSILON * low.abs().max(1.0);
    let (low, high) = if wide { (low, high) } else { (low - 0.5, low + 0.5) };
    (0..=count).map(|k| low + (high - low) * k as f64 / count as f64).collect()
}

impl Style<'_> {
    fn text(&self) -> String {
        let vector = |renderer: String, labels: String| {
            format!(
                "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n\
                 <qgis version=\"3.22.0\" styleCategories=\"Symbology|Labeling\" labelsEnabled=\"{}\">\n{renderer}{labels}</qgis>\n",
                u8::from(!labels.is_empty())
            )
        };
        match self {
            Style::Polygons { by, range, label } => {
                if range[1] - range[0] <= f64::EPSILON * range[0].abs().max(1.0) {
                    return vector(outline(), labels(label));
                }
                let ends = steps(*range, RAMP.len());
                let class = |pair: &[f64]| {
                    (pair[0], pair[1], format!("{} to {}", shown(pair[0]), shown(pair[1])))
                };
                let classes: Vec<_> = ends.windows(2).map(class).collect();
                let fill = |(number, colour): (usize, &[u8; 3])| {
                    let options = [
                        ("color", rgba(*colour)),
                        ("style", "solid".to_owned()),
                        ("outline_color", "255,255,255,255".to_owned()),
                        ("outline_style", "solid".to_owned()),
                        ("outline_width", "0.4".to_owned()),
                        ("outline_width_unit", "MM".to_owned()),
                    ];
                    symbol("fill", "SimpleFill", number, 0.4, &options)
                };
                let symbols: String = RAMP.iter().enumerate().map(fill).collect();
                vector(graduated(by, &classes, &symbols), labels(label))
            }
            Style::Points { by, classes, size_mm } => {
                let mut lower = 0.0;
                let ranges: Vec<_> = classes
                    .iter()
                    .map(|(upper, _, words)| {
                        let class = (lower, *upper, (*words).to_owned());
                        lower = *upper;
                        class
                    })
                    .collect();
                let symbols: String = classes
                    .iter()
                    .enumerate()
                    .map(|(number, (_, colour, _))| marker(number, *colour, *size_mm))
                    .collect();
                vector(graduated(by, &ranges, &symbols), String::new())
            }
            Style::LabelledPoints { colour, label } => {
                vector(single(&marker(0, *colour, 2.4)), labels(label))
            }
            Style::Raster { range, quantity } => raster(*range, quantity),
        }
    }
}

/// A raster of one band with a continuous scale of colours.
fn raster(range: [f64; 2], quantity: &str) -> String {
    let ends = steps(range, RAMP.len() - 1);
    let mut items = String::new();
    for (value, [r, g, b]) in ends.iter().zip(RAMP) {
        let _ = writeln!(
            items,
            "<item value=\"{value}\" label=\"{} {}\" color=\"#{r:02x}{g:02x}{b:02x}\" alpha=\"255\"/>",
            shown(*value),
            escaped(quantity)
        );
    }
    let (low, high) = (ends[0], ends[RAMP.len() - 1]);
    format!(
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n\
         <qgis version=\"3.22.0\" styleCategories=\"Symbology\">\n<pipe>\n\
         <rasterrenderer type=\"singlebandpseudocolor\" band=\"1\" opacity=\"1\" alphaBand=\"-1\" \
         classificationMin=\"{low}\" classificationMax=\"{high}\" nodataColor=\"\">\n\
         <rasterTransparency/>\n<rastershader>\n\
         <colorrampshader colorRampType=\"INTERPOLATED\" classificationMode=\"1\" clip=\"0\" minimumValue=\"{low}\" maximumValue=\"{high}\">\n\
         {items}</colorrampshader>\n</rastershader>\n</rasterrenderer>\n</pipe>\n</qgis>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn styles_are_well_formed_and_cover_their_range() {
        let styles = [
            Style::Polygons { by: "plants<ha", range: [2.0, 12.0], label: "plot" },
            Style::Polygons { by: "cover", range: [0.5, 0.5], label: "plot" },
            Style::Points {
                by: "confidence",
                classes: &[(0.5, [255, 0, 0], "below 50 %"), (1.0, [0, 0, 255], "\"sure\"")],
                size_mm: 1.6,
            },
            Style::LabelledPoints { colour: [1, 2, 3], label: "plants" },
            Style::Raster { range: [-3.0, 7.5], quantity: "m" },
        ];
        for style in styles {
            let text = style.text();
            let mut open: Vec<&str> = Vec::new();
            let body = text.split_once('\n').unwrap().1;
            for tag in body.split('<').skip(1) {
                let tag = tag.split('>').next().unwrap();
                let name = tag.trim_start_matches('/').split([' ', '/']).next().unwrap();
                if tag.starts_with('/') {
                    assert_eq!(open.pop(), Some(name), "{style:?}");
                } else if !tag.ends_with('/') {
                    open.push(name);
                }
                assert_eq!(tag.matches('"').count() % 2, 0, "{tag}");
            }
            assert!(open.is_empty(), "{style:?}: {open:?} stay open");
        }
        assert_eq!(steps([2.0, 12.0], 5), [2.0, 4.0, 6.0, 8.0, 10.0, 12.0]);
        let around = steps([0.5, 0.5], 4);
        assert!(around[0] < 0.5 && 0.5 < around[4]);
        assert_eq!([shown(0.0), shown(123_456.0), shown(0.012_34)], ["0", "123456", "0.0123"]);
    }
}
