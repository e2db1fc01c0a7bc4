//! In the plane: surfaces as colours, points, fields of arrows.

use super::{
    Drawn, Figure,
    curves::marker,
    panels, plain,
    scale::{self, LABEL, TITLE, colour, extent, font, short, tick, viridis},
};
use crate::data::Frame;
use plotters::prelude::*;

/// The different numbers, ascending, and the borders half-way between neighbours; those at the ends are as
/// far out as their neighbours are in.
fn cells(values: impl Iterator<Item = f64>) -> (Vec<f64>, Vec<f64>) {
    let mut places: Vec<f64> = values.collect();
    places.sort_by(f64::total_cmp);
    places.dedup();
    let last = places.len() - 1;
    let half = |k: usize| if last == 0 { 0.5 } else { 0.5 * (places[k + 1] - places[k]) };
    let mut borders = vec![places[0] - half(0)];
    borders.extend((0..last).map(|k| places[k] + half(k)));
    borders.push(places[last] + half(last.saturating_sub(1)));
    (places, borders)
}

fn columns(frame: &Frame, names: &[&str]) -> Result<Vec<Vec<f64>>, String> {
    let places = names.iter().map(|name| frame.column(name)).collect::<Result<Vec<_>, _>>()?;
    let numbers = |row: &Vec<String>| -> Option<Vec<f64>> {
        places.iter().map(|&c| row[c].parse().ok()).collect()
    };
    Ok(frame.rows.iter().filter_map(numbers).collect())
}

/// Bounds of a map whose two axes have the same scale, and the height of its panel.
fn bounds(points: &[Vec<f64>], panels: usize) -> Result<([f64; 4], u32), String> {
    let (x0, x1) = extent(points.iter().map(|p| p[0])).ok_or("there is nothing to draw")?;
    let (y0, y1) = extent(points.iter().map(|p| p[1])).ok_or("there is nothing to draw")?;
    let (_, across) = scale::layout(panels);
    let wide = if across == 1 { 720.0 } else { 480.0 } - 120.0;
    let height = (wide * (y1 - y0) / (x1 - x0)).clamp(90.0, 900.0);
    // What is very high or very flat gets room beside it instead of another scale.
    let wider = 0.5 * ((y1 - y0) * wide / height - (x1 - x0)).max(0.0);
    let higher = 0.5 * ((x1 - x0) * height / wide - (y1 - y0)).max(0.0);
    Ok(([x0 - wider, x1 + wider, y0 - higher, y1 + higher], height as u32 + 110))
}

/// A chart of equal scales with its mesh, in which `inside` draws.
macro_rules! map {
    ($figure:expr, $area:expr, $title:expr, $bounds:expr, $chart:ident, $inside:block) => {{
        let [x0, x1, y0, y1] = $bounds;
        let (bottom, top) = if $figure.y_down { (y1, y0) } else { (y0, y1) };
        let mut builder = ChartBuilder::on($area);
        builder.margin(10).margin_right(24).x_label_area_size(58).y_label_area_size(84);
        if !$title.is_empty() {
            builder.caption($title, font(TITLE));
        }
        let mut $chart = builder.build_cartesian_2d(x0..x1, bottom..top)?;
        $chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(TRANSPARENT)
            .axis_desc_style(font(LABEL))
            .label_style(font(LABEL - 2))
            .x_desc($figure.x_text())
            .y_desc($figure.y_text())
            .x_labels(6)
            .y_labels(6)
            .x_label_formatter(&|x| tick(*x, false))
            .y_label_formatter(&|y| tick(*y, false))
            .draw()?;
        $inside
        Ok(())
    }};
}

/// A value over two coordinates; means where several runs have the same place.
pub(super) fn surface(
    figure: &Figure,
    frame: &Frame,
    over: Option<&Frame>,
) -> Result<Drawn, String> {
    let parts = panels(figure, frame)?;
    let mut numbers =
        vec![vec!["panel".to_owned(), figure.x.clone(), figure.y.clone(), figure.value.clone()]];
    let mut all = Vec::new();
    for (title, rows) in &parts {
        let mut places = columns(rows, &[&figure.x, &figure.y, &figure.value])?;
        places.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
        let mut joined: Vec<(Vec<f64>, f64)> = Vec::new();
        for place in places {
            match joined.last_mut() {
                Some((last, count)) if last[..2] == place[..2] => {
                    last[2] += (place[2] - last[2]) / (*count + 1.0);
                    *count += 1.0;
                }
                _ => joined.push((place, 1.0)),
            }
        }
        let joined: Vec<Vec<f64>> = joined.into_iter().map(|(place, _)| place).collect();
        for place in &joined {
            let mut row = vec![title.clone()];
            row.extend(place.iter().map(f64::to_string));
            numbers.push(row);
        }
        all.push(joined);
    }
    let flat: Vec<Vec<f64>> = all.iter().flatten().cloned().collect();
    if flat.is_empty() {
        return Err("there is nothing to draw".to_owned());
    }
    let axes = [0, 1].map(|k| cells(flat.iter().map(|p| p[k])));
    let border = |k: usize, value: f64| {
        let (places, borders) = &axes[k];
        let at = places.partition_point(|&place| place < value).min(places.len() - 1);
        (borders[at], borders[at + 1])
    };
    let low = flat.iter().map(|p| p[2]).fold(f64::INFINITY, f64::min);
    let high = flat.iter().map(|p| p[2]).fold(f64::NEG_INFINITY, f64::max);
    let share = |value: f64| {
        let linear = if high > low { (value - low) / (high - low) } else { 0.5 };
        linear.powf(figure.gamma)
    };
    let ends: Vec<Vec<f64>> =
        [0, 1].map(|end| [0, 1].map(|k| axes[k].1[end * (axes[k].1.len() - 1)]).to_vec()).to_vec();
    // Parameters have scales of their own, places in the plane have one.
    let (bounds, height) = if figure.from == "runs" {
        ([ends[0][0], ends[1][0], ends[0][1], ends[1][1]], 470)
    } else {
        bounds(&ends, parts.len())?
    };
    let dots = match over {
        Some(frame) => {
            let meets = |row: &&Vec<String>| {
                figure.conditions.iter().all(|(name, label)| {
                    frame.column(name).is_ok_and(|column| row[column] == *label)
                })
            };
            let rows = frame.rows.iter().filter(meets).cloned().collect();
            let frame = Frame { header: frame.header.clone(), rows };
            columns(&frame, &[&figure.x, &figure.y])?
        }
        None => Vec::new(),
    };
    let marks = || figure.marks.iter().copied().zip(figure.y_marks.iter().copied());
    let key = format!(
        "{}: {} (dark) to {} (bright){}",
        plain(&figure.value),
        short(low),
        short(high),
        if figure.gamma == 1.0 { String::new() } else { format!(", exponent {}", figure.gamma) }
    );
    let svg = scale::canvas(parts.len(), height + 34, &[], |panel, area| {
        let (upper, lower) = area.split_vertically(height);
        lower.draw(&Text::new(key.clone(), (90, 6), font(LABEL - 4)))?;
        map!(figure, &upper, &parts[panel].0, bounds, chart, {
            chart.draw_series(all[panel].iter().map(|p| {
                let ((left, right), (low, high)) = (border(0, p[0]), border(1, p[1]));
                // A little over the border: no seams between neighbours.
                let over = |from: f64, to: f64, k: usize| (to + 0.1 * (to - from)).min(ends[1][k]);
                let corners = [(left, low), (over(left, right, 0), over(low, high, 1))];
                Rectangle::new(corners, viridis(share(p[2])).filled())
            }))?;
            chart.draw_series(marks().map(|at| Cross::new(at, 9, WHITE.stroke_width(6))))?;
            chart.draw_series(marks().map(|at| Cross::new(at, 8, colour(1).stroke_width(3))))?;
            chart.draw_series(
                dots.iter().map(|p| Circle::new((p[0], p[1]), 6, WHITE.stroke_width(3))),
            )?;
            chart.draw_series(
                dots.iter().map(|p| Circle::new((p[0], p[1]), 4, colour(1).filled())),
            )?;
        })
    })?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}

/// Fewer points than this have the marker of their series.
const FEW: usize = 300;

/// Points, coloured by series.
pub(super) fn points(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let parts = panels(figure, frame)?;
    let names = frame.labels(&figure.series)?;
    let mut numbers =
        vec![vec!["panel".to_owned(), "series".to_owned(), figure.x.clone(), figure.y.clone()]];
    let mut all: Vec<Vec<Vec<Vec<f64>>>> = Vec::new();
    for (title, rows) in &parts {
        let mut mine = Vec::new();
        for name in &names {
            let places = columns(&rows.with(&figure.series, name)?, &[&figure.x, &figure.y])?;
            for place in &places {
                let mut row = vec![title.clone(), name.clone()];
                row.extend(place.iter().map(f64::to_string));
                numbers.push(row);
            }
            mine.push(places);
        }
        all.push(mine);
    }
    let flat: Vec<Vec<f64>> = all.iter().flatten().flatten().cloned().collect();
    let (bounds, height) = bounds(&flat, parts.len())?;
    let size = match flat.len() {
        3001.. => 1,
        FEW.. => 2,
        _ => 4,
    };
    let legend = figure.legend(&names);
    let svg = scale::canvas(parts.len(), height, &legend, |panel, area| {
        map!(figure, area, &parts[panel].0, bounds, chart, {
            // A few dots lie on the markers of the others, a crowd of them below.
            let crowded = all[panel].first().is_some_and(|places| places.len() >= FEW);
            let mut order: Vec<usize> = (0..names.len()).collect();
            if !crowded {
                order.rotate_left(1);
            }
            for s in order {
                let places = &all[panel][s];
                if (s > 0 || names.len() > 2) && places.len() < FEW {
                    places.iter().try_for_each(|p| marker(&mut chart, s, (p[0], p[1])))?;
                } else {
                    let dot = |p: &Vec<f64>| Circle::new((p[0], p[1]), size, colour(s).filled());
                    chart.draw_series(places.iter().map(dot))?;
                }
            }
        })
    })?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}

/// Arrows from where something was measured, as many times longer than life as `magnify` says.
pub(super) fn field(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let parts = panels(figure, frame)?;
    let names = [&figure.x, &figure.y, &figure.arrow[0], &figure.arrow[1]];
    let mut header = vec!["panel".to_owned()];
    header.extend(names.iter().map(|name| (*name).clone()));
    let mut numbers = vec![header];
    let mut all = Vec::new();
    for (title, rows) in &parts {
        let places = columns(rows, &names.map(String::as_str))?;
        for place in &places {
            let mut row = vec![title.clone()];
            row.extend(place.iter().map(f64::to_string));
            numbers.push(row);
        }
        all.push(places);
    }
    let tip = |p: &[f64]| vec![p[0] + figure.magnify * p[2], p[1] + figure.magnify * p[3]];
    let flat: Vec<Vec<f64>> =
        all.iter().flatten().flat_map(|p: &Vec<f64>| [p[..2].to_vec(), tip(p)]).collect();
    let (bounds, height) = bounds(&flat, parts.len())?;
    let magnified = figure.magnify != 1.0;
    let key = format!("arrows {} times their length", figure.magnify);
    let foot = if magnified { 34 } else { 0 };
    let svg = scale::canvas(parts.len(), height + foot, &[], |panel, area| {
        let (upper, lower) = area.split_vertically(height);
        if magnified {
            lower.draw(&Text::new(key.clone(), (90, 6), font(LABEL - 4)))?;
        }
        map!(figure, &upper, &parts[panel].0, bounds, chart, {
            chart.draw_series(all[panel].iter().map(|p| {
                let tip = tip(p);
                let line = vec![(p[0], p[1]), (tip[0], tip[1])];
                PathElement::new(line, colour(0).stroke_width(2))
            }))?;
            let foot = |p: &Vec<f64>| Circle::new((p[0], p[1]), 2, colour(1).filled());
            chart.draw_series(all[panel].iter().map(foot))?;
        })
    })?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}
