//! Pictures: pixels of a table as an image inside the figure's frame.

use super::{
    Drawn, Figure, panels, plain,
    scale::{self, LABEL, TITLE, font, short, tick, viridis},
};
use crate::data::Frame;
use base64::Engine;
use image::{ImageFormat, Rgba, RgbaImage};
use plotters::prelude::*;
use std::{fmt::Write, io::Cursor};

/// Where a panel's picture goes on the canvas, and the picture.
struct Placed {
    x: (i32, i32),
    y: (i32, i32),
    png: Vec<u8>,
}

/// The pixels of one panel.
struct Grid {
    title: String,
    /// Least place and distance of neighbours, by column and by row.
    low: [f64; 2],
    step: [f64; 2],
    picture: RgbaImage,
}

/// Draws one picture for each panel, all in the same scale.
pub(super) fn draw(figure: &Figure, frame: &Frame) -> Result<Drawn, String> {
    let mut columns = vec![figure.x.clone(), figure.y.clone()];
    let numbered = figure.value.is_empty() && figure.channels.is_empty();
    if numbered {
        columns.push(figure.series.clone());
    } else if figure.value.is_empty() {
        columns.extend(figure.channels.iter().cloned());
    } else {
        columns.push(figure.value.clone());
    }
    let mut header = vec!["panel".to_owned()];
    header.extend(columns.iter().cloned());
    let mut numbers = vec![header];
    let parts = panels(figure, frame)?;
    let mut tables = Vec::new();
    for (title, rows) in &parts {
        let places = columns.iter().map(|name| rows.column(name)).collect::<Result<Vec<_>, _>>()?;
        let mut pixels: Vec<Vec<f64>> = Vec::with_capacity(rows.rows.len());
        for row in &rows.rows {
            let values: Option<Vec<f64>> = places.iter().map(|&c| row[c].parse().ok()).collect();
            pixels.extend(values);
            let mut line = vec![title.clone()];
            line.extend(places.iter().map(|&c| row[c].clone()));
            numbers.push(line);
        }
        if pixels.is_empty() {
            return Err("there is nothing to draw".to_owned());
        }
        tables.push((title.clone(), pixels));
    }
    let values = || tables.iter().flat_map(|(_, pixels)| pixels.iter().map(|pixel| pixel[2]));
    let low = values().fold(f64::INFINITY, f64::min);
    let high = values().fold(f64::NEG_INFINITY, f64::max);
    let colour = |pixel: &[f64]| -> [u8; 3] {
        let byte = |value: f64| value.round().clamp(0.0, 255.0) as u8;
        if numbered {
            let found = scale::colour(pixel[2].max(0.0) as usize);
            return [found.0, found.1, found.2];
        }
        match (figure.value.is_empty(), pixel) {
            (true, [_, _, grey]) => [byte(*grey); 3],
            (true, [_, _, red, green, blue]) => [byte(*red), byte(*green), byte(*blue)],
            _ => {
                let share = if high > low { (pixel[2] - low) / (high - low) } else { 0.5 };
                let found = viridis(share.powf(figure.gamma));
                [found.0, found.1, found.2]
            }
        }
    };
    let grids: Vec<Grid> = tables
        .into_iter()
        .map(|(title, pixels)| grid(title, &pixels, &colour))
        .collect::<Result<_, _>>()?;
    let key = (!figure.value.is_empty()).then(|| {
        format!("{}: {} (dark) to {} (bright)", plain(&figure.value), short(low), short(high))
    });
    let svg = frames(figure, &grids, key.as_deref())?;
    Ok(Drawn { svg, numbers, summary: Vec::new() })
}

/// Most pixels along a side.
const LARGEST: u32 = 4000;

/// Puts pixels in their places; what the table does not have stays transparent.
fn grid(
    title: String,
    pixels: &[Vec<f64>],
    colour: &impl Fn(&[f64]) -> [u8; 3],
) -> Result<Grid, String> {
    let axis = |k: usize| {
        let mut places: Vec<f64> = pixels.iter().map(|pixel| pixel[k]).collect();
        places.sort_by(f64::total_cmp);
        places.dedup();
        let step = places.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
        let step = if step.is_finite() { step } else { 1.0 };
        let count = ((places[places.len() - 1] - places[0]) / step).round() as u32 + 1;
        (places[0], step, count)
    };
    let [(left, across, width), (top, down, height)] = [axis(0), axis(1)];
    if width > LARGEST || height > LARGEST {
        return Err(format!("{width} x {height} pixels: a figure has at most {LARGEST} a side"));
    }
    let mut picture = RgbaImage::new(width, height);
    for pixel in pixels {
        let [red, green, blue] = colour(pixel);
        let u = ((pixel[0] - left) / across).round() as u32;
        let v = ((pixel[1] - top) / down).round() as u32;
        picture.put_pixel(u, v, Rgba([red, green, blue, 255]));
    }
    Ok(Grid { title, low: [left, top], step: [across, down], picture })
}

/// The axes by plotters, then the pictures into their places.
fn frames(figure: &Figure, grids: &[Grid], key: Option<&str>) -> Result<String, String> {
    let extent = |grid: &Grid, k: usize| {
        let count = [grid.picture.width(), grid.picture.height()][k];
        let low = grid.low[k] - 0.5 * grid.step[k];
        (low, low + f64::from(count) * grid.step[k])
    };
    let (_, across) = scale::layout(grids.len());
    let wide = if across == 1 { 720.0 } else { 480.0 } - LEFT - RIGHT;
    let aspect = |grid: &Grid| {
        let ((x0, x1), (y0, y1)) = (extent(grid, 0), extent(grid, 1));
        (y1 - y0) / (x1 - x0)
    };
    let tallest = grids.iter().map(aspect).fold(0.0, f64::max);
    let height = (wide * tallest).clamp(120.0, 900.0);
    let titled = f64::from(TITLE) + 14.0;
    let panel_height = height + BOTTOM + TOP + titled;
    let mut placed: Vec<Placed> = Vec::new();
    let foot = if key.is_some() { 34 } else { 0 };
    let svg = scale::canvas(grids.len(), panel_height as u32 + foot, &[], |panel, area| {
        let grid = &grids[panel];
        let (upper, lower) = area.split_vertically(panel_height as u32);
        if let Some(key) = key {
            lower.draw(&Text::new(key.to_owned(), (LEFT as i32, 6), font(LABEL - 4)))?;
        }
        // Each keeps its own form: what is less tall leaves room below, what is less wide on the right.
        let own = (height / aspect(grid)).min(wide);
        let spare = (panel_height - titled - TOP - BOTTOM - own * aspect(grid)).max(0.0);
        let mut builder = ChartBuilder::on(&upper);
        builder
            .margin_top(TOP as i32)
            .margin_right((RIGHT + wide - own) as i32)
            .margin_bottom(spare as i32)
            .x_label_area_size(BOTTOM as i32)
            .y_label_area_size(LEFT as i32);
        if !grid.title.is_empty() {
            builder.caption(&grid.title, font(TITLE));
        }
        let ((x0, x1), (y0, y1)) = (extent(grid, 0), extent(grid, 1));
        let (bottom, top) = if figure.y_down { (y1, y0) } else { (y0, y1) };
        let mut chart = builder.build_cartesian_2d(x0..x1, bottom..top)?;
        chart
            .configure_mesh()
            .disable_mesh()
            .axis_desc_style(font(LABEL))
            .label_style(font(LABEL - 2))
            .x_desc(figure.x_text())
            .y_desc(figure.y_text())
            .x_labels(5)
            .y_labels(5)
            .x_label_formatter(&|x| tick(*x, false))
            .y_label_formatter(&|y| tick(*y, false))
            .draw()?;
        let (x, y) = chart.plotting_area().get_pixel_range();
        let mut png = Cursor::new(Vec::new());
        let upright = if figure.y_down {
            grid.picture.clone()
        } else {
            image::imageops::flip_vertical(&grid.picture)
        };
        upright.write_to(&mut png, ImageFormat::Png)?;
        placed.push(Placed { x: (x.start, x.end), y: (y.start, y.end), png: png.into_inner() });
        Ok(())
    })?;
    let body = svg.trim_end().strip_suffix("</svg>").ok_or("the SVG has no end")?;
    let mut svg = body.to_owned();
    for Placed { x, y, png } in placed {
        let data = base64::engine::general_purpose::STANDARD.encode(png);
        // Writing to a string does not fail.
        let _ = writeln!(
            svg,
            "<image x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" preserveAspectRatio=\"none\" \
             image-rendering=\"optimizeSpeed\" href=\"data:image/png;base64,{data}\"/>",
            x.0 + 1,
            y.0,
            x.1 - x.0,
            y.1 - y.0
        );
    }
    Ok(svg + "</svg>\n")
}

/// Room around a picture, units of the canvas.
const LEFT: f64 = 76.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 8.0;
const BOTTOM: f64 = 56.0;
