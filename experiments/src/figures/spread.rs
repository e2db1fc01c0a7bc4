//! Boxes: how values spread over seeds.

use super::{
    Drawn, Figure, panels,
    scale::{self, LABEL, TITLE, colour, extent, font, light, placed, tick},
};
use crate::data::{Frame, quantile};
use plotters::prelude::*;

/// Half the width of a box, where labels are 1 apart.
const HALF: f64 = 0.35;

struct Group {
    middle: f64,
    half: f64,
    series: usize,
    values: Vec<f64>,
}

/// Draws boxes.
pub(super) fn draw(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let (labels, names) = (frame.labels(&figure.x)?, frame.labels(&figure.series)?);
    let parts = panels(figure, frame)?;
    let columns =
        ["panel", "series", figure.x.as_str(), "count", "min", "q1", "median", "q3", "max"];
    let mut numbers = vec![columns.map(str::to_owned).to_vec()];
    let mut all: Vec<Vec<Group>> = Vec::new();
    let half = HALF / names.len() as f64;
    for (title, rows) in &parts {
        let mut groups = Vec::new();
        for (k, label) in labels.iter().enumerate() {
            for (series, name) in names.iter().enumerate() {
                let mine = rows.with(&figure.x, label)?.with(&figure.series, name)?;
                let mut values: Vec<f64> = mine
                    .numbers(&figure.y)?
                    .into_iter()
                    .map(|value| placed(value, figure.y_log))
                    .filter(|value| value.is_finite())
                    .collect();
                if values.is_empty() {
                    continue;
                }
                values.sort_by(f64::total_cmp);
                let mut row = vec![title.clone(), name.clone(), label.clone()];
                row.push(values.len().to_string());
                row.extend([0.0, 0.25, 0.5, 0.75, 1.0].map(|q| quantile(&values, q).to_string()));
                numbers.push(row);
                let middle = k as f64 - HALF + (2 * series + 1) as f64 * half;
                groups.push(Group { middle, half: 0.9 * half, series, values });
            }
        }
        all.push(groups);
    }
    let values = all.iter().flatten().flat_map(|group| group.values.iter().copied());
    let (low, high) = extent(values).ok_or("there is nothing to draw")?;
    let legend = figure.legend(&names);
    let rotated = labels.iter().map(String::len).sum::<usize>() > 40;
    let svg = scale::canvas(parts.len(), 440, &legend, |panel, area| {
        let groups = &all[panel];
        let mut builder = ChartBuilder::on(area);
        builder.margin(10).margin_right(24).y_label_area_size(84);
        builder.x_label_area_size(if rotated { 150 } else { 58 });
        if !parts[panel].0.is_empty() {
            builder.caption(&parts[panel].0, font(TITLE));
        }
        let mut chart = builder.build_cartesian_2d(-0.5..labels.len() as f64 - 0.5, low..high)?;
        let name_of = |x: &f64| -> String {
            let near = (x - x.round()).abs() < 0.01 && *x >= -0.01;
            let label = labels.get(x.round().max(0.0) as usize).filter(|_| near);
            label.cloned().unwrap_or_default()
        };
        let y_name = |y: &f64| tick(*y, figure.y_log);
        let mut mesh = chart.configure_mesh();
        mesh.disable_x_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .axis_desc_style(font(LABEL))
            .label_style(font(LABEL - 2))
            .x_desc(figure.x_text())
            .y_desc(figure.y_text())
            .x_labels(2 * labels.len() + 1)
            .x_label_formatter(&name_of)
            .y_label_formatter(&y_name)
            .y_labels(6);
        if rotated {
            mesh.x_label_style(font(LABEL - 4).transform(FontTransform::Rotate90));
        }
        mesh.draw()?;
        for group in groups {
            let (x, half, s) = (group.middle, group.half, group.series);
            let at = |share: f64| quantile(&group.values, share);
            let stroke = colour(s).stroke_width(2);
            let ends = [(at(0.0), at(0.25)), (at(0.75), at(1.0))];
            chart.draw_series(ends.map(|(a, b)| PathElement::new(vec![(x, a), (x, b)], stroke)))?;
            let corners = [(x - half, at(0.25)), (x + half, at(0.75))];
            chart.draw_series([Rectangle::new(corners, light(s).filled())])?;
            chart.draw_series([Rectangle::new(corners, stroke)])?;
            let median = vec![(x - half, at(0.5)), (x + half, at(0.5))];
            chart.draw_series([PathElement::new(median, colour(s).stroke_width(4))])?;
        }
        Ok(())
    })?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}
