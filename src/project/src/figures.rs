//! Pictures that stages write into their `figures` folders.

use image::RgbImage;
use plotters::prelude::*;
use rowgram_base::error::Error;
use rowgram_files::{
    images,
    rasters::{BAND_ROWS, Source},
};
use rowgram_optim::{
    drive::LogEntry,
    output::{self, FileError},
};
use rowgram_raster::{Mask, window};
use std::path::Path;

/// Longest side of a picture.
const LONGEST_PX: usize = 4096;

/// A raster as a picture of at most 4096 pixels a side: every `step`-th pixel of every `step`-th row.
pub struct View {
    /// The picture.
    pub picture: RgbImage,
    /// Pixels of the raster for one of the picture.
    pub step: usize,
}

impl View {
    /// Of a photo or mask.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn of(source: &Source) -> Result<View, FileError> {
        let (width, height) = source.size();
        let step = step(width, height);
        let mut picture = RgbImage::new(width.div_ceil(step) as u32, height.div_ceil(step) as u32);
        for band in window::bands(height, BAND_ROWS, 0) {
            let first = band.rows.start;
            let rows = source.rgb(band.rows.clone())?;
            for v in band.rows.filter(|v| v.is_multiple_of(step)) {
                for u in (0..width).step_by(step) {
                    let pixel = *rows.get_pixel(u as u32, (v - first) as u32);
                    picture.put_pixel((u / step) as u32, (v / step) as u32, pixel);
                }
            }
        }
        Ok(View { picture, step })
    }

    /// Of a mask of the raster, with as many pixels as the picture.
    pub fn mask(&self, mask: &Mask) -> Mask {
        let (width, height) = (self.picture.width() as usize, self.picture.height() as usize);
        Mask::from_fn(width, height, |u, v| mask.get(u * self.step, v * self.step))
    }

    /// A position of the raster in the picture.
    pub fn position(&self, at_px: [f64; 2]) -> [f64; 2] {
        at_px.map(|x| x / self.step as f64)
    }

    /// Writes it into a folder, which is made if it is not there.
    ///
    /// # Errors
    /// Where it cannot be written.
    pub fn write(&self, folder: &Path, name: &str, force: bool) -> Result<(), FileError> {
        write_picture(folder, name, force, &self.picture)
    }
}

/// Every how many pixels of a raster a picture shows one.
pub fn step(width: usize, height: usize) -> usize {
    width.max(height).div_ceil(LONGEST_PX).max(1)
}

/// Writes a picture into a folder, which is made if it is not there.
///
/// # Errors
/// Where it cannot be written.
pub fn write_picture(
    folder: &Path,
    name: &str,
    force: bool,
    picture: &RgbImage,
) -> Result<(), FileError> {
    output::make_folder(folder)?;
    images::write_photo(&folder.join(name), force, picture)
}

/// Writes a drawing into a folder, which is made if it is not there, and its numbers beside it as CSV.
///
/// # Errors
/// Where they cannot be written.
pub(super) fn write_drawing(
    folder: &Path,
    name: &str,
    force: bool,
    draw: impl FnOnce(&mut String) -> Drawn,
    csv: &str,
) -> Result<(), FileError> {
    output::make_folder(folder)?;
    let path = folder.join(name);
    save_svg(&path, force, draw)?;
    output::write(&path.with_extension("csv"), force, |out| out.write_all(csv.as_bytes()))
}

/// Colours that are told apart by everybody (Okabe and Ito).
pub(super) const BLUE: RGBColor = RGBColor(0, 114, 178);
pub(super) const VERMILION: RGBColor = RGBColor(213, 94, 0);
pub(super) const GREEN: RGBColor = RGBColor(0, 158, 115);

/// Whether an SVG could be drawn.
pub(super) type Drawn = Result<(), Box<dyn std::error::Error>>;

/// Writes an SVG.
///
/// # Errors
/// Where it cannot be drawn or written.
pub(super) fn save_svg(
    path: &Path,
    force: bool,
    draw: impl FnOnce(&mut String) -> Drawn,
) -> Result<(), FileError> {
    let mut svg = String::new();
    draw(&mut svg).map_err(|e| FileError::write(path, std::io::Error::other(e.to_string())))?;
    output::write(path, force, |out| out.write_all(svg.as_bytes()))
}

/// A correlation matrix: blue for negative, vermilion for positive, the number in each cell.
pub(super) fn correlation<N: AsRef<str>>(
    svg: &mut String,
    names: &[N],
    matrix: &[Vec<f64>],
) -> Drawn {
    /// Side of a cell, and room for the names, in pixels of the picture.
    const CELL: i32 = 52;
    const EDGE: i32 = 70;
    let count = names.len() as i32;
    let side = (EDGE + CELL * count + 10) as u32;
    let area = SVGBackend::with_string(svg, (side, side)).into_drawing_area();
    area.fill(&WHITE)?;
    let style = ("sans-serif", 13).into_font().color(&BLACK);
    for (i, name) in (0..count).zip(names) {
        area.draw(&Text::new(name.as_ref(), (4, EDGE + CELL * i + 18), style.clone()))?;
        area.draw(&Text::new(name.as_ref(), (EDGE + CELL * i + 4, EDGE - 22), style.clone()))?;
    }
    for (i, row) in (0..count).zip(matrix) {
        for (j, &value) in (0..count).zip(row) {
            let (x, y) = (EDGE + CELL * j, EDGE + CELL * i);
            let colour = if value < 0.0 { BLUE } else { VERMILION };
            let cell = [(x, y), (x + CELL - 2, y + CELL - 2)];
            area.draw(&Rectangle::new(cell, colour.mix(value.abs()).filled()))?;
            area.draw(&Text::new(format!("{value:.2}"), (x + 9, y + 18), style.clone()))?;
        }
    }
    area.present()?;
    Ok(())
}

/// Surface and ground along a line, as SVG: the way in metres, the height in metres.
///
/// # Errors
/// Where it cannot be drawn.
pub(super) fn profile(svg: &mut String, surface: &[(f64, f64)], ground: &[(f64, f64)]) -> Drawn {
    let all = || surface.iter().chain(ground);
    let least = |axis: fn(&(f64, f64)) -> f64| all().map(axis).fold(f64::INFINITY, f64::min);
    let most = |axis: fn(&(f64, f64)) -> f64| all().map(axis).fold(f64::NEG_INFINITY, f64::max);
    let range = |low: f64, high: f64, spare: f64| match low <= high {
        true => low - spare..high + spare,
        false => 0.0..1.0,
    };
    let (way, height) =
        (range(least(|p| p.0), most(|p| p.0), 0.1), range(least(|p| p.1), most(|p| p.1), 0.1));
    let area = SVGBackend::with_string(svg, (1100, 320)).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(70)
        .build_cartesian_2d(way, height)?;
    chart.configure_mesh().x_desc("way, m").y_desc("height, m").draw()?;
    for (points, colour, name) in [(ground, VERMILION, "ground"), (surface, BLUE, "surface")] {
        chart
            .draw_series(LineSeries::new(points.to_vec(), colour.stroke_width(1)))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
    }
    chart.configure_series_labels().border_style(BLACK).background_style(WHITE).draw()?;
    area.present()?;
    drop(chart);
    Ok(())
}

/// How the cost fell, as SVG: its excess over the lowest, relative to that, by iteration.
///
/// # Errors
/// Where the figure cannot be drawn or written.
pub fn convergence(path: &Path, force: bool, title: &str, log: &[LogEntry]) -> Result<(), Error> {
    Ok(save_svg(path, force, |svg| draw_convergence(svg, title, log))?)
}

fn draw_convergence(svg: &mut String, title: &str, log: &[LogEntry]) -> Drawn {
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
