//! Shares of a variance by factor: first-order and total indices with their intervals.

use super::{
    Drawn, Figure,
    scale::{self, LABEL, colour, font, light, tick},
};
use crate::{
    data::Frame,
    sensitivity::{self, Index, Interval},
};
use plotters::prelude::*;

/// Half the height of a bar, where factors are 1 apart.
const HALF: f64 = 0.18;
/// Height of a figure: what does not depend on the number of factors, and for each of them.
const FOOT: u32 = 90;
const BAR: u32 = 46;

/// Draws two bars for each factor, the largest total on top.
pub(super) fn draw(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let factors = sensitivity::factors(frame)?;
    let found = sensitivity::of(frame, &figure.y)?.ok_or("there is nothing to draw")?;
    let names = figure.legend(&factors);
    let mut bars: Vec<(&str, Index)> = names.into_iter().zip(found.factors).collect();
    bars.sort_by(|a, b| a.1.total.value.total_cmp(&b.1.total.value));
    let columns =
        ["factor", "first", "first_low", "first_high", "total", "total_low", "total_high"];
    let mut numbers = vec![columns.map(str::to_owned).to_vec()];
    numbers.extend(bars.iter().rev().map(|(name, Index { first, total })| {
        let parts = [first, total].into_iter().flat_map(|i| [i.value, i.low, i.high]);
        std::iter::once((*name).to_owned()).chain(parts.map(|x| x.to_string())).collect()
    }));
    // Intervals of a few samples reach far beyond any share there is.
    let reach = bars.iter().map(|(_, i)| i.total.high.max(i.first.high)).fold(1.0, f64::max);
    let reach = reach.min(1.5);
    let least = bars.iter().map(|(_, i)| i.first.low).fold(0.0, f64::min).max(-0.25);
    let count = bars.len();
    let longest = bars.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let svg = scale::canvas(1, FOOT + BAR * count as u32, &["first-order", "total"], |_, area| {
        let mut builder = ChartBuilder::on(area);
        builder.margin(10).margin_right(24).x_label_area_size(58);
        builder.y_label_area_size(30 + 11 * longest as u32);
        let mut chart =
            builder.build_cartesian_2d(least..1.02 * reach, -0.5..count as f64 - 0.5)?;
        let name_of = |y: &f64| -> String {
            let near = (y - y.round()).abs() < 0.01 && *y >= -0.01;
            let bar = bars.get(y.round().max(0.0) as usize).filter(|_| near);
            bar.map(|(name, _)| (*name).to_owned()).unwrap_or_default()
        };
        chart
            .configure_mesh()
            .disable_y_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .axis_desc_style(font(LABEL))
            .label_style(font(LABEL - 2))
            .x_desc(if figure.x_label.is_empty() {
                "share of the variance"
            } else {
                &figure.x_label
            })
            .x_labels(6)
            .x_label_formatter(&|x| tick(*x, false))
            .y_labels(2 * count + 1)
            .y_label_formatter(&name_of)
            .draw()?;
        for (place, (_, index)) in bars.iter().enumerate() {
            for (series, part) in [index.first, index.total].into_iter().enumerate() {
                let Interval { value, low, high } = part;
                let y = place as f64 + HALF - 2.0 * HALF * series as f64;
                let stroke = colour(series).stroke_width(2);
                let corners = [(0.0, y - HALF), (value.clamp(least, reach), y + HALF)];
                chart.draw_series([Rectangle::new(corners, light(series).filled())])?;
                chart.draw_series([Rectangle::new(corners, stroke)])?;
                let ends = vec![(low.clamp(least, reach), y), (high.clamp(least, reach), y)];
                chart.draw_series([PathElement::new(ends, BLACK.stroke_width(2))])?;
            }
        }
        Ok(())
    })?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}
