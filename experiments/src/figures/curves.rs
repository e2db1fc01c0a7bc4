//! Means over a number or over labels, convergence curves, performance profiles.

use super::{
    Drawn, Figure, panels, profile,
    scale::{self, Area, Done, LABEL, TITLE, colour, extent, font, light, placed, tick},
};
use crate::data::{Frame, Summary};
use plotters::prelude::*;

/// A point of a series.
#[derive(Debug, Clone, Copy)]
struct Point {
    x: f64,
    y: f64,
    low: f64,
    high: f64,
}

/// How points are joined.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Joined {
    Band,
    Line,
    Step,
    Whisker,
}

/// A series with its name.
type Series = (String, Vec<Vec<Point>>);

/// Labels of the first axis: numbers where all are, places otherwise.
fn places(labels: &[String], bars: bool) -> (Vec<f64>, bool) {
    let numbers: Option<Vec<f64>> = labels.iter().map(|label| label.parse().ok()).collect();
    match numbers {
        Some(numbers) if !bars => (numbers, false),
        _ => ((0..labels.len()).map(|k| k as f64).collect(), true),
    }
}

/// Means with their intervals: curves with bands, or points with whiskers over labels.
pub(super) fn means(figure: &Figure, frame: &Frame, bars: bool) -> Result<Drawn, String> {
    let names = frame.labels(&figure.series)?;
    let mut labels = frame.labels(&figure.x)?;
    let (at, named) = places(&labels, bars);
    let mut order: Vec<usize> = (0..labels.len()).collect();
    order.sort_by(|&a, &b| at[a].total_cmp(&at[b]));
    let mut numbers = vec![header(figure, &["count", "mean", "low", "high"])];
    let parts = panels(figure, frame)?;
    let mut all: Vec<Vec<Series>> = Vec::new();
    for (title, rows) in &parts {
        let mut drawn = Vec::new();
        for (s, name) in names.iter().enumerate() {
            let mine = rows.with(&figure.series, name)?;
            let mut points = Vec::new();
            for &k in &order {
                let values = mine.with(&figure.x, &labels[k])?.numbers(&figure.y)?;
                let Some(found) = Summary::of(&values) else { continue };
                let (mean, half) = (found.mean, found.half);
                let aside =
                    if named { 0.5 * ((s as f64 + 0.5) / names.len() as f64 - 0.5) } else { 0.0 };
                let y = |value: f64| placed(value, figure.y_log);
                let low = if figure.y_log { (mean - half).max(0.05 * mean) } else { mean - half };
                let x = if named { at[k] + aside } else { placed(at[k], figure.x_log) };
                points.push(Point { x, y: y(mean), low: y(low), high: y(mean + half) });
                let mut row = vec![title.clone(), name.clone(), labels[k].clone()];
                row.extend([found.count.to_string(), mean.to_string()]);
                row.extend([(mean - half).to_string(), (mean + half).to_string()]);
                numbers.push(row);
            }
            drawn.push((name.clone(), vec![points]));
        }
        all.push(drawn);
    }
    if !named {
        labels.clear();
    }
    let joined = if named { Joined::Whisker } else { Joined::Band };
    let svg = draw(figure, &parts, &all, &labels, joined, &figure.x_text(), &figure.y_text())?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}

fn header(figure: &Figure, more: &[&str]) -> Vec<String> {
    let mut row = vec!["panel".to_owned(), "series".to_owned(), figure.x.clone()];
    row.extend(more.iter().map(|&name| name.to_owned()));
    row
}

/// One line for each run.
pub(super) fn convergence(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let names = frame.labels(&figure.series)?;
    let parts = panels(figure, frame)?;
    let mut numbers = vec![header(figure, &[&figure.y, "cell", "seed"])];
    let mut all = Vec::new();
    for (title, rows) in &parts {
        let mut drawn: Vec<Series> = Vec::new();
        for name in &names {
            let mine = rows.with(&figure.series, name)?;
            let (cell, seed) = (mine.column("cell")?, mine.column("seed")?);
            let (x, y) = (mine.column(&figure.x)?, mine.column(&figure.y)?);
            let mut lines: Vec<(String, Vec<Point>)> = Vec::new();
            for row in &mine.rows {
                let run = format!("{},{}", row[cell], row[seed]);
                let (Ok(at), Ok(value)) = (row[x].parse::<f64>(), row[y].parse::<f64>()) else {
                    continue;
                };
                let (px, py) = (placed(at, figure.x_log), placed(value, figure.y_log));
                if !(px.is_finite() && py.is_finite()) {
                    continue;
                }
                let point = Point { x: px, y: py, low: py, high: py };
                match lines.last_mut() {
                    Some((last, points)) if *last == run => points.push(point),
                    _ => lines.push((run, vec![point])),
                }
                let mut line = vec![title.clone(), name.clone(), row[x].clone(), row[y].clone()];
                line.extend([row[cell].clone(), row[seed].clone()]);
                numbers.push(line);
            }
            drawn.push((name.clone(), lines.into_iter().map(|(_, points)| points).collect()));
        }
        all.push(drawn);
    }
    let svg = draw(figure, &parts, &all, &[], Joined::Line, &figure.x_text(), &figure.y_text())?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}

/// The share of problems within a factor of the best, over the factor.
pub(super) fn profile(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let solvers = frame.labels(&figure.series)?;
    let parts = panels(figure, frame)?;
    let mut numbers =
        vec![vec!["panel".to_owned(), "series".to_owned(), "tau".to_owned(), "share".to_owned()]];
    let heads = ["panel", "series", "problems", "solved", "best", "within_2", "median_ratio"];
    let mut summary = vec![heads.map(str::to_owned).to_vec()];
    let mut all = Vec::new();
    let mut farthest: f64 = 2.0;
    let mut curves = Vec::new();
    for (title, rows) in &parts {
        let found = profile::profiles(rows, &figure.x, &figure.series, &figure.y, &solvers)?;
        let mut mine = Vec::new();
        for (name, of) in solvers.iter().zip(found) {
            farthest = of.ratios.last().map_or(farthest, |&last| farthest.max(last));
            let count = of.problems.max(1) as f64;
            let shares: Vec<(f64, f64)> = of
                .ratios
                .iter()
                .enumerate()
                .map(|(k, &tau)| (tau, (k + 1) as f64 / count))
                .collect();
            for (tau, share) in &shares {
                numbers.push(vec![title.clone(), name.clone(), tau.to_string(), share.to_string()]);
            }
            if of.problems > 0 {
                let mut row = vec![title.clone(), name.clone(), of.problems.to_string()];
                row.extend([f64::MAX, 1.0, 2.0].map(|tau| format!("{:.2}", of.share(tau))));
                row.push(of.median().map_or(String::new(), |ratio| format!("{ratio:.2}")));
                summary.push(row);
            }
            mine.push((name.clone(), of.problems, shares));
        }
        curves.push(mine);
    }
    let end = (farthest * 1.2).log2();
    for mine in curves {
        let drawn: Vec<Series> = mine
            .into_iter()
            .map(|(name, problems, shares)| {
                if problems == 0 {
                    return (name, Vec::new());
                }
                let mut points = vec![(0.0, 0.0)];
                for (tau, share) in shares {
                    let (_, before) = points[points.len() - 1];
                    points.push((tau.log2(), before));
                    points.push((tau.log2(), share));
                }
                points.push((end, points[points.len() - 1].1));
                let line = points.into_iter().map(|(x, y)| Point { x, y, low: 0.0, high: 1.0 });
                (name, vec![line.collect()])
            })
            .collect();
        all.push(drawn);
    }
    let x_text = format!("log2 of the factor of the best, {}", figure.y_text());
    let svg = draw(figure, &parts, &all, &[], Joined::Step, &x_text, "share of problems")?;
    Ok(Drawn { svg, numbers, summary })
}

fn draw(
    figure: &Figure,
    parts: &[(String, Frame)],
    all: &[Vec<Series>],
    labels: &[String],
    joined: Joined,
    x_text: &str,
    y_text: &str,
) -> Result<String, String> {
    let points = || all.iter().flatten().flat_map(|(_, lines)| lines.iter().flatten());
    let marks = figure.marks.iter().map(|&mark| placed(mark, figure.x_log));
    let (mut x_low, mut x_high) =
        extent(points().map(|p| p.x).chain(marks.clone())).ok_or("there is nothing to draw")?;
    if !labels.is_empty() {
        (x_low, x_high) = (-0.5, labels.len() as f64 - 0.5);
    }
    let (y_low, y_high) = extent(points().flat_map(|p| [p.low, p.high, p.y])).unwrap_or((0.0, 1.0));
    let names: Vec<String> =
        all.first().map_or(Vec::new(), |panel| panel.iter().map(|(n, _)| n.clone()).collect());
    let names = figure.legend(&names);
    let height = 400 + if labels.len() > 4 { 60 } else { 0 };
    let (_, columns) = scale::layout(parts.len());
    scale::canvas(parts.len(), height, &names, |panel, area| {
        let mut builder = ChartBuilder::on(area);
        builder.margin(10).margin_right(24).y_label_area_size(if columns > 2 { 70 } else { 84 });
        let rotated = labels.iter().map(String::len).sum::<usize>() > 46;
        builder.x_label_area_size(if rotated { 150 } else { 58 });
        if !parts[panel].0.is_empty() {
            builder.caption(&parts[panel].0, font(TITLE));
        }
        let mut chart = builder.build_cartesian_2d(x_low..x_high, y_low..y_high)?;
        let name_of = |x: &f64| -> String {
            if labels.is_empty() {
                return tick(*x, figure.x_log);
            }
            let near = (x - x.round()).abs() < 0.01;
            let label = labels.get(x.round().max(0.0) as usize).filter(|_| near && *x >= -0.01);
            label.cloned().unwrap_or_default()
        };
        let y_name = |y: &f64| tick(*y, figure.y_log);
        let mut mesh = chart.configure_mesh();
        mesh.light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .axis_desc_style(font(LABEL))
            .label_style(font(LABEL - 2))
            .x_desc(x_text)
            .y_desc(y_text)
            .x_label_formatter(&name_of)
            .y_label_formatter(&y_name)
            .y_labels(6);
        if labels.is_empty() {
            mesh.x_labels(6);
        } else {
            mesh.x_labels(2 * labels.len() + 1);
            if rotated {
                mesh.x_label_style(font(LABEL - 4).transform(FontTransform::Rotate90));
            }
        }
        mesh.draw()?;
        for mark in marks.clone() {
            let line = [(mark, y_low), (mark, y_high)];
            chart.draw_series(DashedLineSeries::new(line, 6, 5, BLACK.mix(0.6).stroke_width(2)))?;
        }
        for (s, (_, lines)) in all[panel].iter().enumerate() {
            series(&mut chart, s, lines, joined)?;
        }
        Ok(())
    })
}

pub(super) type Chart<'a, 'b> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

fn series<'b>(chart: &mut Chart<'_, 'b>, s: usize, lines: &[Vec<Point>], joined: Joined) -> Done {
    for points in lines {
        let line = || points.iter().map(|p| (p.x, p.y));
        match joined {
            Joined::Band => {
                let upper = points.iter().map(|p| (p.x, p.high));
                let lower = points.iter().rev().map(|p| (p.x, p.low));
                let band: Vec<(f64, f64)> = upper.chain(lower).collect();
                chart.draw_series(std::iter::once(Polygon::new(band, light(s))))?;
                chart.draw_series(LineSeries::new(line(), colour(s).stroke_width(3)))?;
            }
            Joined::Line | Joined::Step if scale::is_dashed(s) => {
                chart.draw_series(DashedLineSeries::new(
                    line(),
                    9,
                    6,
                    colour(s).stroke_width(2),
                ))?;
            }
            Joined::Line => {
                chart.draw_series(LineSeries::new(line(), colour(s).mix(0.7).stroke_width(2)))?;
            }
            Joined::Step => {
                chart.draw_series(LineSeries::new(line(), colour(s).stroke_width(3)))?;
            }
            Joined::Whisker => {
                chart.draw_series(points.iter().map(|p| {
                    PathElement::new(vec![(p.x, p.low), (p.x, p.high)], colour(s).stroke_width(2))
                }))?;
            }
        }
        if matches!(joined, Joined::Band | Joined::Whisker) {
            for at in line() {
                marker(chart, s, at)?;
            }
        }
    }
    Ok(())
}

/// The marker of a series, its form as telling as its colour.
pub(super) fn marker<'b>(chart: &mut Chart<'_, 'b>, s: usize, at: (f64, f64)) -> Done {
    let (area, style) = (chart.plotting_area(), colour(s).filled());
    match s % 4 {
        0 => area.draw(&Circle::new(at, 5, style))?,
        1 => area.draw(&TriangleMarker::new(at, 7, style))?,
        2 => area.draw(&(EmptyElement::at(at) + Rectangle::new([(-4, -4), (4, 4)], style)))?,
        _ => area.draw(&Cross::new(at, 5, colour(s).stroke_width(2)))?,
    }
    Ok(())
}

/// The names of the series with their markers.
pub(super) fn legend_of(area: &Area<'_>, names: &[&str], columns: usize) -> Done {
    let (width, _) = area.dim_in_pixel();
    let wide = (width as usize / columns) as i32;
    for (s, name) in names.iter().enumerate() {
        let at = (14 + (s % columns) as i32 * wide, 16 + (s / columns) as i32 * scale::LINE as i32);
        let ends: &[(i32, i32)] =
            if scale::is_dashed(s) { &[(0, 9), (25, 34)] } else { &[(0, 34)] };
        for (from, to) in ends {
            let line = [(at.0 + from, at.1), (at.0 + to, at.1)];
            area.draw(&PathElement::new(line, colour(s).stroke_width(3)))?;
        }
        let middle = (at.0 + 17, at.1);
        match s % 4 {
            0 => area.draw(&Circle::new(middle, 5, colour(s).filled()))?,
            1 => area.draw(&TriangleMarker::new(middle, 7, colour(s).filled()))?,
            2 => area.draw(&Rectangle::new(
                [(middle.0 - 4, middle.1 - 4), (middle.0 + 4, middle.1 + 4)],
                colour(s).filled(),
            ))?,
            _ => area.draw(&Cross::new(middle, 5, colour(s).stroke_width(2)))?,
        }
        area.draw(&Text::new((*name).to_owned(), (at.0 + 44, at.1 - 10), font(LABEL - 3)))?;
    }
    Ok(())
}
