//! Pictures of a calibration, as SVG.

use super::{Calibration, tables::residual_rows};
use crate::figures::{BLUE, GREEN, VERMILION, correlation, save_svg};
use plotters::prelude::*;
use rowgram_base::error::Error;
use rowgram_optim::output::FileError;
use rowgram_optim::robust::median;
use rowgram_survey::problems::calibration::{
    residuals::{CornerResidual, DistortionAt, Ring, distortion_curve, principal_point_px, rings},
    statistics::Statistics,
};
use std::path::Path;

const GREY: RGBColor = RGBColor(120, 120, 120);

/// Draws all of them into `folder`.
///
/// # Errors
/// A file that exists unless `force`, and writing.
pub(super) fn write(folder: &Path, force: bool, found: &Calibration) -> Result<(), Error> {
    let rows: Vec<CornerResidual> =
        residual_rows(found)?.into_iter().map(|row| row.residual).collect();
    let curve = distortion_curve(&found.solution.state.interior);
    let path = |name: &str| folder.join(name);
    let Statistics { free, correlation: matrix, .. } = &found.statistics;
    save_svg(&path("correlation.svg"), force, |svg| correlation(svg, free, matrix))?;
    residuals(&path("residuals.svg"), force, &rows, found.request.size_px)?;
    by_radius(&path("residuals_by_radius.svg"), force, &rows, &rings(&rows))?;
    Ok(distortion(&path("distortion.svg"), force, &curve, found)?)
}

/// The residual of every corner as an arrow at its place, made longer by a round factor.
fn residuals(
    path: &Path,
    force: bool,
    rows: &[CornerResidual],
    size_px: [u32; 2],
) -> Result<(), FileError> {
    let [width, height] = size_px.map(f64::from);
    let lengths = rows.iter().map(|row| row.du_px.hypot(row.dv_px));
    let usual = median(lengths).unwrap_or(1.0).max(1e-9);
    // The usual arrow is about a hundredth of the picture's width long.
    let wanted = width / 100.0 / usual;
    let decade = 10f64.powf(wanted.log10().floor());
    let factor =
        [5.0, 2.0, 1.0].map(|k| k * decade).into_iter().find(|k| *k <= wanted).unwrap_or(decade);
    save_svg(path, force, |svg| {
        let drawn = (900, (900.0 * height / width) as u32 + 90);
        let area = SVGBackend::with_string(svg, drawn).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .caption(
                format!("residuals (measured - projected), {factor} times their length"),
                ("sans-serif", 18),
            )
            .margin(12)
            .x_label_area_size(36)
            .y_label_area_size(56)
            .build_cartesian_2d(0.0..width, height..0.0)?;
        chart
            .configure_mesh()
            .disable_mesh()
            .x_desc("u, px")
            .y_desc("v, px")
            .x_label_formatter(&|x| format!("{x:.0}"))
            .y_label_formatter(&|y| format!("{y:.0}"))
            .draw()?;
        for row in rows {
            let from = (row.u_px, row.v_px);
            let to = (row.u_px + factor * row.du_px, row.v_px + factor * row.dv_px);
            chart.draw_series([PathElement::new(vec![from, to], BLUE.stroke_width(1))])?;
            chart.draw_series([Circle::new(from, 1, VERMILION.filled())])?;
        }
        area.present()?;
        drop(chart);
        Ok(())
    })
}

/// Radial residuals by their distance from the principal point, with the mean of each ring.
fn by_radius(
    path: &Path,
    force: bool,
    rows: &[CornerResidual],
    rings: &[Ring],
) -> Result<(), FileError> {
    let far = rows.iter().map(|row| row.radius_px).fold(1.0, f64::max);
    let mut sizes: Vec<f64> = rows.iter().map(|row| row.radial_px.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    // A few outliers should not press everything else to a line.
    let high = sizes.get(sizes.len() * 99 / 100).copied().unwrap_or(1.0).max(1e-3) * 1.3;
    save_svg(path, force, |svg| {
        let area = SVGBackend::with_string(svg, (720, 420)).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .caption("residuals by radius", ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(40)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..far, -high..high)?;
        chart
            .configure_mesh()
            .x_desc("distance from the principal point, px")
            .y_desc("radial residual, px")
            .light_line_style(WHITE)
            .draw()?;
        let inside = rows.iter().filter(|row| row.radial_px.abs() <= high);
        chart.draw_series(
            inside.map(|row| Circle::new((row.radius_px, row.radial_px), 1, GREY.filled())),
        )?;
        let means = |part: fn(&Ring) -> f64| {
            rings.iter().map(move |ring| (ring.radius_px, part(ring).clamp(-high, high)))
        };
        chart
            .draw_series(LineSeries::new(means(|r| r.radial_mean_px), VERMILION.stroke_width(2)))?
            .label("mean radial")
            .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], VERMILION.stroke_width(2)));
        chart
            .draw_series(LineSeries::new(means(|r| r.tangential_mean_px), GREEN.stroke_width(2)))?
            .label("mean tangential")
            .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], GREEN.stroke_width(2)));
        chart
            .draw_series(LineSeries::new(means(|r| r.radial_rms_px), BLUE.stroke_width(2)))?
            .label("rms radial")
            .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], BLUE.stroke_width(2)));
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerLeft)
            .border_style(GREY)
            .background_style(WHITE)
            .draw()?;
        area.present()?;
        drop(chart);
        Ok(())
    })
}

/// The distortion curve, and as far as which radius corners tell of it.
fn distortion(
    path: &Path,
    force: bool,
    curve: &[DistortionAt],
    outcome: &Calibration,
) -> Result<(), FileError> {
    let points: Vec<(f64, f64)> = curve
        .iter()
        .filter_map(|row| row.distortion_px.map(|distortion| (row.radius_px, distortion)))
        .collect();
    let centre = principal_point_px(&outcome.solution.state.interior);
    let seen = outcome
        .views
        .iter()
        .flat_map(|view| &view.marks)
        .map(|m| (m.image_px[0] - centre[0]).hypot(m.image_px[1] - centre[1]))
        .fold(0.0, f64::max);
    let far = points.iter().map(|p| p.0).fold(1.0, f64::max);
    let low = points.iter().map(|p| p.1).fold(0.0, f64::min);
    let high = points.iter().map(|p| p.1).fold(0.0, f64::max);
    let margin = (0.05 * (high - low)).max(1e-3);
    save_svg(path, force, |svg| {
        let area = SVGBackend::with_string(svg, (720, 420)).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .caption(
                format!("distortion of the {} lens", outcome.request.model.word()),
                ("sans-serif", 18),
            )
            .margin(12)
            .x_label_area_size(40)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..far, low - margin..high + margin)?;
        chart
            .configure_mesh()
            .x_desc("distance from the principal point, px")
            .y_desc("measured - ideal radius, px")
            .light_line_style(WHITE)
            .draw()?;
        chart.draw_series(LineSeries::new(points.iter().copied(), BLUE.stroke_width(2)))?;
        chart
            .draw_series([PathElement::new(
                vec![(seen, low - margin), (seen, high + margin)],
                GREY.stroke_width(1),
            )])?
            .label("furthest corner")
            .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], GREY.stroke_width(1)));
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerLeft)
            .border_style(GREY)
            .background_style(WHITE)
            .draw()?;
        area.present()?;
        drop(chart);
        Ok(())
    })
}
