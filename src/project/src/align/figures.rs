//! Pictures of a block: where the cameras are and what they see, the cloud from above and aside; the table of pairs.

use crate::figures::save_svg;
use image::{Rgb, RgbImage};
use plotters::prelude::*;
use rowgram_base::error::Error;
use rowgram_files::{csv_table::CsvWriter, images};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::overlay::draw_line;
use rowgram_survey::{
    camera::Lens,
    scene::Reconstruction,
    sfm::{Pair, resection::quaternion},
};
use std::path::Path;

/// Cells of the overlap map along its longer side.
const CELLS: usize = 90;
/// Pixels of the pictures of the cloud along their longer side.
const SIDE_PX: f64 = 1200.0;

/// Draws all of them into `folder`, with their numbers in `tables`.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn write(
    folder: &Path,
    tables: &Path,
    survey: &Reconstruction,
    pairs: &[Pair],
    names: &[&str],
) -> Result<(), Error> {
    if survey.points.len() < 3 {
        return Ok(());
    }
    for folder in [folder, tables] {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
    }
    overlap(folder, tables, survey, &View::of(survey))?;
    pairs_table(tables, pairs, names)?;
    images::write_photo(&folder.join("cloud-above.png"), true, &cloud(survey, [0, 1]))?;
    images::write_photo(&folder.join("cloud-aside.png"), true, &cloud(survey, [0, 2]))?;
    Ok(())
}

/// What a map shows.
struct View {
    x: [f64; 2],
    y: [f64; 2],
    height: f64,
}

/// The values at two shares of some numbers.
fn shares(mut values: Vec<f64>, low: f64, high: f64) -> [f64; 2] {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    [at(low), at(high)]
}

impl View {
    fn of(survey: &Reconstruction) -> View {
        let of = |axis: usize| {
            let points = survey.points.iter().map(|p| p.position_m[axis]).collect();
            let [mut low, mut high] = shares(points, 0.005, 0.995);
            for image in &survey.images {
                let c = image.pose.centre_m()[axis];
                (low, high) = (low.min(c), high.max(c));
            }
            let margin = 0.05 * (high - low).max(1e-6);
            [low - margin, high + margin]
        };
        let heights = survey.points.iter().map(|p| p.position_m[2]).collect();
        View { x: of(0), y: of(1), height: shares(heights, 0.5, 0.5)[0] }
    }

    fn size(&self) -> (u32, u32) {
        let (dx, dy) = (self.x[1] - self.x[0], self.y[1] - self.y[0]);
        let scale = 760.0 / dx.max(dy);
        ((dx * scale) as u32 + 110, ((dy * scale) as u32).max(160) + 110)
    }
}

/// How many photos see each place of a level ground, and where the cameras are.
fn overlap(
    folder: &Path,
    tables: &Path,
    survey: &Reconstruction,
    view: &View,
) -> Result<(), FileError> {
    let step = (view.x[1] - view.x[0]).max(view.y[1] - view.y[0]) / CELLS as f64;
    let count = |range: [f64; 2]| ((range[1] - range[0]) / step).ceil() as usize;
    let (columns, rows) = (count(view.x), count(view.y));
    let mut cells = Vec::with_capacity(columns * rows);
    for row in 0..rows {
        for column in 0..columns {
            let at = [
                view.x[0] + (column as f64 + 0.5) * step,
                view.y[0] + (row as f64 + 0.5) * step,
                view.height,
            ];
            let sees = |image: &&rowgram_survey::scene::Image| {
                let interior = &survey.cameras[image.camera].interior;
                let size = interior.size_px().map(f64::from);
                interior
                    .project(image.pose.to_camera(at))
                    .is_some_and(|p| p[0] >= 0.0 && p[1] >= 0.0 && p[0] < size[0] && p[1] < size[1])
            };
            cells.push((at, survey.images.iter().filter(sees).count()));
        }
    }
    output::write(&tables.join("overlap.csv"), true, |out| {
        writeln!(out, "x_m,y_m,images")?;
        cells.iter().try_for_each(|(at, n)| writeln!(out, "{:.3},{:.3},{n}", at[0], at[1]))
    })?;
    save_svg(&folder.join("overlap.svg"), true, |svg| {
        let area = SVGBackend::with_string(svg, view.size()).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .caption("photos that see each place", ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(35)
            .y_label_area_size(60)
            .build_cartesian_2d(view.x[0]..view.x[1], view.y[0]..view.y[1])?;
        chart.configure_mesh().disable_mesh().x_desc("X").y_desc("Y").draw()?;
        let shown = cells.iter().filter(|(_, n)| *n > 0).map(|(at, n)| {
            let share = (*n as f64 / 9.0).min(1.0);
            let colour = HSLColor(0.02 + 0.33 * share, 0.65, 0.72 - 0.2 * share);
            let (x, y) = (at[0] - 0.5 * step, at[1] - 0.5 * step);
            Rectangle::new([(x, y), (x + step, y + step)], colour.filled())
        });
        chart.draw_series(shown)?;
        chart.draw_series(survey.images.iter().map(|image| {
            let c = image.pose.centre_m();
            Circle::new((c[0], c[1]), 3, BLACK.filled())
        }))?;
        area.present()?;
        drop(chart);
        Ok(())
    })
}

/// The pairs with their orientations: the rotation as a quaternion `w, x, y, z` and the baseline of
/// length 1 that take the camera frame of the first to that of the second (`y` up, looking along `-z`).
fn pairs_table(folder: &Path, pairs: &[Pair], names: &[&str]) -> Result<(), FileError> {
    output::write(&folder.join("pairs.csv"), true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "first",
            "second",
            "matches",
            "solver",
            "angle_deg",
            "tilt_deg",
            "qw",
            "qx",
            "qy",
            "qz",
            "tx",
            "ty",
            "tz",
        ])?;
        for pair in pairs {
            let [a, b] = pair.images.map(|k| names[k as usize]);
            let (angle, tilt) = (pair.angle_rad.to_degrees(), pair.pose.tilt_rad().to_degrees());
            let [w, x, y, z] = quaternion(&pair.pose.rotation);
            let t = pair.pose.translation;
            let numbers = [w, x, y, z, t.x, t.y, t.z];
            let fixed = [
                a.to_owned(),
                b.to_owned(),
                pair.matches.len().to_string(),
                pair.solver.to_string(),
                format!("{angle:.3}"),
                format!("{tilt:.3}"),
            ];
            csv.write_record(fixed.into_iter().chain(numbers.map(|x| format!("{x:.9}"))))?;
        }
        csv.flush()
    })?;
    Ok(())
}

/// The points in their colours along two axes, cameras in red.
fn cloud(survey: &Reconstruction, axes: [usize; 2]) -> RgbImage {
    let range = |axis: usize| {
        let mut values: Vec<f64> = survey.points.iter().map(|p| p.position_m[axis]).collect();
        let [low, high] = shares(std::mem::take(&mut values), 0.005, 0.995);
        let centres = survey.images.iter().map(|image| image.pose.centre_m()[axis]);
        let (low, high) = centres.fold((low, high), |(l, h), c| (l.min(c), h.max(c)));
        let margin = 0.03 * (high - low).max(1e-6);
        (low - margin, high + margin)
    };
    let (across, up) = (range(axes[0]), range(axes[1]));
    let scale = SIDE_PX / (across.1 - across.0).max(up.1 - up.0);
    let width = ((across.1 - across.0) * scale).ceil().max(16.0) as u32;
    let height = ((up.1 - up.0) * scale).ceil().max(16.0) as u32;
    let mut picture = RgbImage::from_pixel(width, height, Rgb([255, 255, 255]));
    let mut dot = |at: [f64; 3], colour: [u8; 3], side_px: u32| {
        let x = (at[axes[0]] - across.0) * scale;
        let y = f64::from(height - 1) - (at[axes[1]] - up.0) * scale;
        draw_line(&mut picture, &[[x, y]; 2], Rgb(colour), side_px);
    };
    for point in &survey.points {
        dot(point.position_m, point.colour, 3);
    }
    for image in &survey.images {
        dot(image.pose.centre_m(), [213, 30, 30], 7);
    }
    picture
}
