//! Figures of what a verb did, as SVG.

use crate::{
    drive::LogEntry,
    error::Error,
    io::{FileError, output},
};
use plotters::prelude::*;
use std::path::Path;

/// Colours that are told apart by everybody (Okabe and Ito).
const BLUE: RGBColor = RGBColor(0, 114, 178);
const VERMILION: RGBColor = RGBColor(213, 94, 0);

/// How the cost fell: its excess over the lowest, relative to that, by iteration.
///
/// # Errors
/// Where the figure cannot be drawn or written.
pub(super) fn convergence(
    path: &Path,
    force: bool,
    title: &str,
    log: &[LogEntry],
) -> Result<(), Error> {
    let mut svg = String::new();
    draw(&mut svg, title, log)
        .map_err(|e| FileError::write(path, std::io::Error::other(e.to_string())))?;
    output::write(path, force, |out| out.write_all(svg.as_bytes()))?;
    Ok(())
}

fn draw(svg: &mut String, title: &str, log: &[LogEntry]) -> Result<(), Box<dyn std::error::Error>> {
    let best = log.iter().map(|entry| entry.best_cost).fold(f64::INFINITY, f64::min);
    let scale = if best > 0.0 { best } else { 1.0 };
    // What is left above the best cost; the best itself has no place on a logarithmic axis.
    let curve: Vec<(f64, f64)> = log
        .iter()
        .map(|entry| (entry.iteration as f64, (entry.best_cost - best) / scale))
        .filter(|(_, excess)| *excess > 0.0)
        .collect();
    let low = curve.iter().map(|(_, e)| *e).fold(1e-2, f64::min).max(1e-16);
    let high = curve.iter().map(|(_, e)| *e).fold(1.0, f64::max);
    let last = log.iter().map(|entry| entry.iteration).max().unwrap_or(1).max(1);
    let area = SVGBackend::with_string(svg, (640, 400)).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .caption(title, ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(70)
        .build_cartesian_2d(0.0..last as f64, (low / 2.0..high * 2.0).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("iteration")
        .y_desc("cost above the lowest, relative")
        .x_label_formatter(&|x| format!("{x:.0}"))
        .y_label_formatter(&|y| format!("{y:.0e}"))
        .light_line_style(WHITE)
        .draw()?;
    chart.draw_series(LineSeries::new(curve.iter().copied(), BLUE.stroke_width(2)))?;
    chart.draw_series(curve.iter().map(|&point| Circle::new(point, 3, VERMILION.filled())))?;
    area.present()?;
    drop(chart);
    Ok(())
}
