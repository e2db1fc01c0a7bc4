//! Histograms of the colours, and how each threshold trades leaves for soil.
//!
//! `histograms.csv` has the columns `channel` (hue, saturation, value), `value` (in 8-bit HSV), and the numbers of `plant` and
//! `other` pixels; `sweeps.csv` has `threshold`, `value`, `true_positive_rate`, `false_positive_rate` and `iou`.

use crate::figures::{BLUE, Drawn, GREEN, VERMILION, write_drawing};
use plotters::prelude::*;
use rowgram_base::error::Error;
use rowgram_raster::{mask::Thresholds, tuning::Colours};
use std::{fmt::Write as _, path::Path};

const CURVES: [RGBColor; 4] = [BLUE, VERMILION, GREEN, RGBColor(204, 121, 167)];
/// The thresholds in their order.
const THRESHOLDS: [&str; 4] = ["hue_min", "hue_max", "saturation_min", "value_min"];

/// Hue, saturation and value of leaf and other pixels, with the thresholds.
pub(super) fn histograms(
    folder: &Path,
    force: bool,
    colours: &Colours,
    hsv: &Thresholds,
    annotated: bool,
) -> Result<(), Error> {
    let all = colours.histograms();
    let mut csv = "channel,value,plant,other\n".to_owned();
    for (name, histogram) in ["hue", "saturation", "value"].iter().zip(&all) {
        for (value, [other, plant]) in histogram.iter().enumerate() {
            let _ = writeln!(csv, "{name},{value},{plant},{other}");
        }
    }
    let draw = |svg: &mut String| draw_histograms(svg, &all, hsv, annotated);
    Ok(write_drawing(folder, "histograms.svg", force, draw, &csv)?)
}

fn draw_histograms(
    svg: &mut String,
    all: &[[[u64; 2]; 256]; 3],
    hsv: &Thresholds,
    annotated: bool,
) -> Drawn {
    let area = SVGBackend::with_string(svg, (760, 620)).into_drawing_area();
    area.fill(&WHITE)?;
    let marks: [&[u8]; 3] = [&[hsv.hue_min, hsv.hue_max], &[hsv.saturation_min], &[hsv.value_min]];
    let names = ["hue (half degrees)", "saturation", "value"];
    let leaf = if annotated { "leaf" } else { "proposed leaf" };
    for (k, part) in area.split_evenly((3, 1)).iter().enumerate() {
        let end: u16 = if k == 0 { 180 } else { 256 };
        let largest = all[k].iter().flatten().copied().max().unwrap_or(1).max(1) as f64;
        let mut chart = ChartBuilder::on(part)
            .margin(8)
            .x_label_area_size(34)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..f64::from(end), (0.5..largest * 2.0).log_scale())?;
        chart
            .configure_mesh()
            .x_desc(names[k])
            .y_desc("pixels")
            .y_label_formatter(&|y| format!("{y:.0e}"))
            .light_line_style(WHITE)
            .draw()?;
        for (class, colour, name) in [(0, VERMILION, "other"), (1, GREEN, leaf)] {
            let line = (0..end as usize).map(|x| (x as f64, (all[k][x][class] as f64).max(0.5)));
            chart
                .draw_series(LineSeries::new(line, colour.stroke_width(2)))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
        }
        for &mark in marks[k] {
            let x = f64::from(mark);
            chart.draw_series([PathElement::new([(x, 0.5), (x, largest * 2.0)], BLACK)])?;
        }
        if k == 0 {
            chart.configure_series_labels().background_style(WHITE).draw()?;
        }
    }
    area.present()?;
    Ok(())
}

/// TPR against FPR and IoU for every value of each threshold, the others held.
pub(super) fn sweeps(
    folder: &Path,
    force: bool,
    colours: &Colours,
    hsv: &Thresholds,
) -> Result<(), Error> {
    let mut csv = "threshold,value,true_positive_rate,false_positive_rate,iou\n".to_owned();
    let mut curves: Vec<Vec<[f64; 4]>> = Vec::new();
    for (index, name) in THRESHOLDS.iter().enumerate() {
        let mut curve = Vec::new();
        for (value, _, confusion) in colours.sweep(hsv, index) {
            let (tpr, fpr, iou) =
                (confusion.true_positive_rate(), confusion.false_positive_rate(), confusion.iou());
            let _ = writeln!(csv, "{name},{value},{tpr:.6},{fpr:.6},{iou:.6}");
            curve.push([f64::from(value), tpr, fpr, iou]);
        }
        curves.push(curve);
    }
    Ok(write_drawing(folder, "sweeps.svg", force, |svg| draw_sweeps(svg, &curves), &csv)?)
}

fn draw_sweeps(svg: &mut String, curves: &[Vec<[f64; 4]>]) -> Drawn {
    let area = SVGBackend::with_string(svg, (900, 420)).into_drawing_area();
    area.fill(&WHITE)?;
    let panels = area.split_evenly((1, 2));
    let widest = curves.iter().flatten().map(|p| p[2]).fold(0.01, f64::max);
    for (panel, roc) in panels.iter().zip([true, false]) {
        let range = if roc { 0.0..widest } else { 0.0..255.0 };
        let mut chart = ChartBuilder::on(panel)
            .margin(10)
            .x_label_area_size(38)
            .y_label_area_size(48)
            .build_cartesian_2d(range, 0.0..1.0)?;
        let (x, y) =
            if roc { ("false positive rate", "true positive rate") } else { ("threshold", "IoU") };
        chart.configure_mesh().x_desc(x).y_desc(y).light_line_style(WHITE).draw()?;
        for (index, (curve, colour)) in curves.iter().zip(CURVES).enumerate() {
            let line = curve.iter().map(|p| if roc { (p[2], p[1]) } else { (p[0], p[3]) });
            chart
                .draw_series(LineSeries::new(line, colour.stroke_width(2)))?
                .label(THRESHOLDS[index])
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
        }
        let place = SeriesLabelPosition::LowerRight;
        chart.configure_series_labels().position(place).background_style(WHITE).draw()?;
    }
    area.present()?;
    Ok(())
}
