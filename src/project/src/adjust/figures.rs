//! The figures of a report, as SVG; their numbers are in the tables.

use super::Adjustment;
use crate::figures::{BLUE, Drawn, VERMILION, correlation, save_svg};
use plotters::{
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};
use rowgram_base::error::Error;
use rowgram_survey::{problems::adjustment::ObservationRef, scene::Role};
use std::path::Path;

/// Cells of the mean residual vectors along the width of an image.
const CELLS: usize = 24;

pub(super) fn write(folder: &Path, adjustment: &Adjustment, force: bool) -> Result<(), Error> {
    for camera in 0..adjustment.adjusted.reconstruction.cameras.len().min(8) {
        let name = format!("residuals-{}.svg", camera + 1);
        save_svg(&folder.join(&name), force, |svg| residuals(svg, adjustment, camera))?;
    }
    for interior in &adjustment.adjusted.statistics.interiors {
        let name = format!("correlation-{}.svg", interior.camera + 1);
        save_svg(&folder.join(&name), force, |svg| {
            correlation(svg, &interior.names, &interior.correlation)
        })?;
    }
    if !adjustment.adjusted.reconstruction.ground.is_empty() {
        save_svg(&folder.join("control.svg"), force, |svg| control(svg, adjustment))?;
    }
    Ok(())
}

/// Residuals of one camera's images, the mean of each cell of the image as an arrow.
fn residuals(svg: &mut String, adjustment: &Adjustment, camera: usize) -> Drawn {
    let survey = &adjustment.adjusted.reconstruction;
    let size = survey.cameras[camera].interior.size_px().map(f64::from);
    let cell = size[0] / CELLS as f64;
    let rows = (size[1] / cell).ceil().max(1.0) as usize;
    let mut sums = vec![[0.0f64; 3]; CELLS * rows];
    for tested in &adjustment.adjusted.statistics.tested {
        let ObservationRef::TieObservation(k) = tested.subject else { continue };
        let o = &survey.observations[k];
        if survey.images[o.image as usize].camera != camera {
            continue;
        }
        let [column, row] = o.image_px.map(|v| (v / cell).max(0.0) as usize);
        let sum = &mut sums[row.min(rows - 1) * CELLS + column.min(CELLS - 1)];
        for k in 0..2 {
            sum[k] += survey.tie_sigma_px * tested.residual[k];
        }
        sum[2] += 1.0;
    }
    let means: Vec<Option<[f64; 2]>> =
        sums.iter().map(|s| (s[2] > 0.0).then(|| [s[0] / s[2], s[1] / s[2]])).collect();
    let longest = means.iter().flatten().map(|m| m[0].hypot(m[1])).fold(1e-9, f64::max);
    let scale = 1.4 * cell / longest;
    let height = (760.0 * size[1] / size[0]) as u32 + 80;
    let area = SVGBackend::with_string(svg, (820, height)).into_drawing_area();
    area.fill(&WHITE)?;
    let title = format!("mean residuals by place in the image; the longest is {longest:.3} px");
    let mut chart = ChartBuilder::on(&area)
        .caption(title, ("sans-serif", 16))
        .margin(10)
        .x_label_area_size(30)
        .y_label_area_size(50)
        .build_cartesian_2d(0.0..size[0], size[1]..0.0)?;
    chart.configure_mesh().x_desc("u, px").y_desc("v, px").light_line_style(WHITE).draw()?;
    for (k, mean) in means.iter().enumerate() {
        let Some(mean) = mean else { continue };
        let from = [((k % CELLS) as f64 + 0.5) * cell, ((k / CELLS) as f64 + 0.5) * cell];
        let to = (from[0] + scale * mean[0], from[1] + scale * mean[1]);
        chart.draw_series(std::iter::once(PathElement::new(
            vec![(from[0], from[1]), to],
            BLUE.stroke_width(2),
        )))?;
        chart.draw_series(std::iter::once(Circle::new(to, 2, BLUE.filled())))?;
    }
    area.present()?;
    drop(chart);
    Ok(())
}

/// Control (blue) and check points (red) in plan with their differences as arrows.
fn control(svg: &mut String, adjustment: &Adjustment) -> Drawn {
    let adjusted = &adjustment.adjusted;
    let mut rows = Vec::new();
    for (k, point) in adjusted.reconstruction.ground.iter().enumerate() {
        let check = adjusted.check_points.iter().find(|check| check.ground == k);
        let at = check.map(|check| check.position_m).or(adjusted.ground_m[k]);
        let Some(at) = at else { continue };
        let difference: [f64; 3] = std::array::from_fn(|a| at[a] - point.position_m[a]);
        rows.push((point, difference));
    }
    let bound = |axis: usize| -> [f64; 2] {
        let values = rows.iter().map(|(point, _)| point.position_m[axis]);
        [values.clone().fold(f64::MAX, f64::min), values.fold(f64::MIN, f64::max)]
    };
    let (x, y) = (bound(0), bound(1));
    let extent = (x[1] - x[0]).max(y[1] - y[0]).max(1.0);
    let longest = rows.iter().map(|(_, d)| d[0].hypot(d[1])).fold(1e-9, f64::max);
    let scale = 0.15 * extent / longest;
    let (mid, half) = ([0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1])], 0.65 * extent);
    let area = SVGBackend::with_string(svg, (760, 760)).into_drawing_area();
    area.fill(&WHITE)?;
    let title = format!(
        "adjusted minus given in plan; the longest is {longest:.3} m (blue control, red check; dZ in m)"
    );
    let mut chart = ChartBuilder::on(&area)
        .caption(title, ("sans-serif", 15))
        .margin(10)
        .x_label_area_size(30)
        .y_label_area_size(70)
        .build_cartesian_2d(mid[0] - half..mid[0] + half, mid[1] - half..mid[1] + half)?;
    chart.configure_mesh().x_desc("X, m").y_desc("Y, m").light_line_style(WHITE).draw()?;
    for (point, difference) in rows {
        let colour = if point.role == Role::Check { VERMILION } else { BLUE };
        let from = (point.position_m[0], point.position_m[1]);
        let to = (from.0 + scale * difference[0], from.1 + scale * difference[1]);
        chart.draw_series(std::iter::once(Circle::new(from, 4, colour.filled())))?;
        chart.draw_series(std::iter::once(PathElement::new(
            vec![from, to],
            colour.stroke_width(2),
        )))?;
        let label = format!("{} {:+.3}", point.name, difference[2]);
        // Names at the right border grow to the left.
        let (side, aside) = if from.0 > mid[0] + 0.3 * extent {
            (HPos::Right, -0.012)
        } else {
            (HPos::Left, 0.012)
        };
        let style = TextStyle::from(("sans-serif", 12).into_font()).pos(Pos::new(side, VPos::Top));
        let at = (from.0 + aside * extent, from.1 - 0.012 * extent);
        chart.draw_series(std::iter::once(Text::new(label, at, style)))?;
    }
    area.present()?;
    drop(chart);
    Ok(())
}
