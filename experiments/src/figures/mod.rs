//! Figures, drawn from tables only: SVG, PDF and PNG, with the numbers that are in them as CSV and a
//! caption stub in LaTeX.
//!
//! Colours are those of Okabe and Ito, which everybody tells apart, and every series has a marker of its
//! own; letters are large enough for one column of two-column print.

mod curves;
mod export;
mod maps;
mod picture;
mod profile;
mod scale;
mod shares;
mod spread;

use crate::{
    data::{Conditions, Frame},
    fail::Fail,
    keys,
    tables::escaped,
};
use rowgram::io::output;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, path::Path};

/// What a figure looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Look {
    /// Means over a number, with 95 % confidence bands.
    Curve,
    /// Means over labels, with 95 % intervals.
    Bars,
    /// Quartiles, whiskers to the extremes.
    Box,
    /// A number over two coordinates, as colours.
    Surface,
    /// Series over iterations, one thin line for each run.
    Convergence,
    /// Share of problems solved within a factor of the best (Dolan and More 2002).
    Profile,
    /// Points in the plane, coloured by series.
    Points,
    /// Arrows in the plane.
    Field,
    /// First-order and total shares of the variance of `y` by factor, from a sensitivity design.
    Sensitivity,
    /// A picture: a value, one or three channels, or the number of a colour for each pixel.
    Image,
}

/// A figure as a spec asks for it.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Figure {
    /// Names the files.
    pub(crate) name: String,
    /// What it looks like.
    pub(crate) look: Look,
    /// The table: `runs`, `timing`, or the name of a trace.
    #[serde(default = "runs")]
    pub(crate) from: String,
    /// The column along the first axis; for a profile, the axis that names the problems.
    #[serde(default)]
    pub(crate) x: String,
    /// The column along the second axis.
    pub(crate) y: String,
    /// The column that tells the series apart.
    #[serde(default)]
    pub(crate) series: String,
    /// What the key calls the labels of the series (or a figure of sensitivity its factors), where that is not the
    /// label itself.
    #[serde(default)]
    pub(crate) names: BTreeMap<String, String>,
    /// The column of the small multiples.
    #[serde(default)]
    pub(crate) panel: String,
    /// For surfaces, the column shown as colour.
    #[serde(default)]
    pub(crate) value: String,
    /// For fields, the columns of the arrows.
    #[serde(default)]
    pub(crate) arrow: Vec<String>,
    /// For images without a value, the columns of the channels, 0 to 255: one for grey, three for colours.
    #[serde(default)]
    pub(crate) channels: Vec<String>,
    /// How much longer than life arrows are.
    #[serde(default = "unity")]
    pub(crate) magnify: f64,
    /// Points drawn over a surface: a trace with the same coordinate columns.
    #[serde(default)]
    pub(crate) over: String,
    /// Exponent of the colour scale of a surface; 1 is linear.
    #[serde(default = "unity")]
    pub(crate) gamma: f64,
    #[serde(default)]
    pub(crate) x_log: bool,
    #[serde(default)]
    pub(crate) y_log: bool,
    /// The second axis points down, as in images.
    #[serde(default)]
    pub(crate) y_down: bool,
    /// Places along the first axis that are marked, such as published values.
    #[serde(default)]
    pub(crate) marks: Vec<f64>,
    /// On surfaces, the same along the second axis: a mark is a place.
    #[serde(default)]
    pub(crate) y_marks: Vec<f64>,
    #[serde(default)]
    pub(crate) x_label: String,
    #[serde(default)]
    pub(crate) y_label: String,
    /// For a profile, the metric that is 0 where a solver does not apply to a problem.
    #[serde(default)]
    pub(crate) applies: String,
    /// Which rows.
    #[serde(default, rename = "where")]
    pub(crate) conditions: Conditions,
    /// What it shows.
    #[serde(default)]
    pub(crate) caption: String,
}

fn runs() -> String {
    "runs".to_owned()
}

pub(crate) fn unity() -> f64 {
    1.0
}

impl Figure {
    /// Refuses axes and metrics that there are not. The columns of traces are known once they are
    /// there; everything else is checked before any work.
    pub(crate) fn check(&self, axes: &[&str], metrics: &[&str]) -> Result<(), String> {
        let place = |e: String| format!("figure {}: {e}", self.name);
        let given = |name: &&str| !name.is_empty();
        let table = ["runs", "timing"].contains(&self.from.as_str());
        // The series of a trace may be a column of its own.
        let series = if table { self.series.as_str() } else { "" };
        let groups = [series, self.panel.as_str()];
        let conditions = self.conditions.keys().map(String::as_str);
        for axis in groups.into_iter().filter(given).chain(conditions) {
            if !axes.contains(&axis) {
                return Err(place(keys::unknown("axis", axis, axes.iter().copied())));
            }
        }
        if self.from == "runs" {
            let both = || axes.iter().chain(metrics).copied();
            let columns = [self.x.as_str(), self.y.as_str(), self.value.as_str()];
            for column in columns.into_iter().filter(given) {
                if !both().any(|known| known == column) {
                    return Err(place(keys::unknown("column", column, both())));
                }
            }
        }
        if !self.applies.is_empty() && !metrics.contains(&self.applies.as_str()) {
            return Err(place(keys::unknown("metric", &self.applies, metrics.iter().copied())));
        }
        if self.look == Look::Field && self.arrow.len() != 2 {
            return Err(place("a field needs the two columns of its arrows".to_owned()));
        }
        if self.look == Look::Surface && self.marks.len() != self.y_marks.len() {
            return Err(place("a mark on a surface needs both coordinates".to_owned()));
        }
        if self.look == Look::Surface && self.value.is_empty() {
            return Err(place("a surface needs a column of values".to_owned()));
        }
        let channels = [1, 3].contains(&self.channels.len());
        let coloured = channels || !self.value.is_empty() || !self.series.is_empty();
        if self.look == Look::Image && !coloured {
            return Err(place(
                "an image needs a column of values, one or three channels, or a series".to_owned(),
            ));
        }
        if !(self.gamma > 0.0 && self.magnify > 0.0) {
            return Err(place("gamma and magnify have to be positive".to_owned()));
        }
        Ok(())
    }

    /// Draws the figure from the tables of a result folder into another folder.
    pub(crate) fn draw(&self, result: &Path, out: &Path) -> Result<(), Fail> {
        let fail = |e: String| Fail::Failed(format!("figure {}: {e}", self.name));
        let table = |name: &str| match name {
            "runs" | "timing" => Frame::read(&result.join(format!("{name}.csv"))),
            trace => {
                let path = result.join(format!("traces/{trace}.csv"));
                if !path.exists() {
                    let message = format!(
                        "figure {}: no run left the series `{trace}`; runs.csv has the reasons of those that \
                         failed, otherwise the base lacks `trace = true`",
                        self.name
                    );
                    return Err(Fail::Failed(message));
                }
                Frame::read(&path)
            }
        };
        let frame = table(&self.from)?.at(&self.conditions).map_err(fail)?;
        let frame = if self.applies.is_empty() {
            frame
        } else {
            profile::applicable(&frame, &table("runs")?, &self.applies).map_err(fail)?
        };
        let over = if self.over.is_empty() { None } else { Some(table(&self.over)?) };
        let drawn = match self.look {
            Look::Curve => curves::means(self, &frame, false),
            Look::Convergence => curves::convergence(self, &frame),
            Look::Profile => curves::profile(self, &frame),
            Look::Bars => curves::means(self, &frame, true),
            Look::Box => spread::draw(self, &frame),
            Look::Surface => maps::surface(self, &frame, over.as_ref()),
            Look::Points => maps::points(self, &frame),
            Look::Field => maps::field(self, &frame),
            Look::Sensitivity => shares::draw(self, &frame),
            Look::Image => picture::draw(self, &frame),
        };
        let Drawn { svg, numbers, summary } = drawn.map_err(fail)?;
        export::write(out, &self.name, &svg)?;
        for (end, rows) in [("", numbers), ("-summary", summary)] {
            if rows.is_empty() {
                continue;
            }
            output::write(&out.join(format!("{}{end}.csv", self.name)), true, |file| {
                let mut writer = csv::Writer::from_writer(file);
                rows.iter().try_for_each(|row| writer.write_record(row))?;
                writer.flush()
            })?;
        }
        // What is drawn for one column keeps its letters there; small multiples go across both.
        let (place, width) = if scale::is_one_column(&svg) {
            ("figure", "\\columnwidth")
        } else {
            ("figure*", "\\textwidth")
        };
        let caption = format!(
            "\\begin{{{place}}}\n\\centering\n\\includegraphics[width={width}]{{{name}.pdf}}\n\
             \\caption{{{}}}\n\\label{{fig:{name}}}\n\\end{{{place}}}\n",
            escaped(&self.caption),
            name = self.name
        );
        output::write(&out.join(format!("{}.tex", self.name)), true, |file| {
            file.write_all(caption.as_bytes())
        })?;
        Ok(())
    }

    /// The names of series as the key has them.
    fn legend<'a>(&'a self, labels: &'a [String]) -> Vec<&'a str> {
        labels.iter().map(|label| self.names.get(label).unwrap_or(label).as_str()).collect()
    }

    fn x_text(&self) -> String {
        if self.x_label.is_empty() { plain(&self.x) } else { self.x_label.clone() }
    }

    fn y_text(&self) -> String {
        if self.y_label.is_empty() { plain(&self.y) } else { self.y_label.clone() }
    }
}

/// A column as a person reads it: without the path before it.
fn plain(column: &str) -> String {
    column.rsplit('.').next().unwrap_or(column).replace('_', " ")
}

/// A picture and the numbers in it.
struct Drawn {
    svg: String,
    numbers: Vec<Vec<String>>,
    /// Of a profile, what it comes to for each series.
    summary: Vec<Vec<String>>,
}

/// The labels of the panels with their rows.
fn panels(figure: &Figure, frame: &Frame) -> Result<Vec<(String, Frame)>, String> {
    frame
        .labels(&figure.panel)?
        .into_iter()
        .map(|label| {
            let rows = frame.with(&figure.panel, &label)?;
            let title = if label.is_empty() {
                String::new()
            } else {
                format!("{} {label}", plain(&figure.panel))
            };
            Ok((title, rows))
        })
        .collect()
}
