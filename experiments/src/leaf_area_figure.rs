//! Leaf count against leaf area, drawn: a panel for each growth stage, a colour for each kind of picture.

use crate::leaf_area::{KINDS, STAGES, Square};
use plotters::prelude::*;

/// Colours that are told apart by everybody (Okabe and Ito).
const COLOURS: [RGBColor; 3] = [RGBColor(213, 94, 0), RGBColor(0, 114, 178), RGBColor(0, 158, 115)];

/// The figure as SVG.
pub(crate) fn draw(squares: &[Square]) -> Result<String, Box<dyn std::error::Error>> {
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, (1200, 420)).into_drawing_area();
    area.fill(&WHITE)?;
    for (stage, panel) in area.split_evenly((1, 3)).iter().enumerate() {
        let mine: Vec<&Square> = squares.iter().filter(|s| s.stage == stage).collect();
        let most = |f: fn(&Square) -> f64| mine.iter().map(|s| f(s)).fold(1.0, f64::max) * 1.05;
        let (right, top) = (most(|s| s.pixels), most(|s| s.leaves));
        let mut chart = ChartBuilder::on(panel)
            .caption(STAGES[stage].to_string(), ("sans-serif", 18))
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(50)
            .build_cartesian_2d(0.0..right, 0.0..top)?;
        chart
            .configure_mesh()
            .x_desc("leaf pixels of a square")
            .y_desc("leaves")
            .x_labels(5)
            .x_label_formatter(&|value| format!("{value:.0}"))
            .y_label_formatter(&|value| format!("{value:.0}"))
            .light_line_style(WHITE)
            .draw()?;
        for (kind, colour) in COLOURS.into_iter().enumerate() {
            let of_kind = || mine.iter().filter(move |s| s.kind == kind);
            let (pixels, leaves) =
                of_kind().fold((0.0, 0.0), |(p, l), s| (p + s.pixels, l + s.leaves));
            // Through the origin, as the method counts.
            let end = right.min(top * pixels / f64::max(leaves, 1.0));
            let line = [(0.0, 0.0), (end, end * leaves / f64::max(pixels, 1.0))];
            chart
                .draw_series(
                    of_kind()
                        .map(|s| Circle::new((s.pixels, s.leaves), 2, colour.mix(0.5).filled())),
                )?
                .label(KINDS[kind])
                .legend(move |at| Circle::new(at, 4, colour.filled()));
            chart.draw_series(LineSeries::new(line, colour.stroke_width(2)))?;
        }
        if stage == 0 {
            let place = SeriesLabelPosition::LowerRight;
            chart.configure_series_labels().position(place).background_style(WHITE).draw()?;
        }
    }
    area.present()?;
    drop(area);
    Ok(svg)
}
