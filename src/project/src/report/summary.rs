//! The most important numbers of a run, for a terminal.

use crate::{
    locate::{LocateOutcome, StandOutcome},
    run::{Ending, RunOutcome},
};
use std::fmt::Write;

/// The most important numbers of a run, a few lines.
pub fn summary(outcome: &RunOutcome) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = block(&mut text, outcome);
    let _ = traits(&mut text, outcome);
    let _ = truth(&mut text, outcome);
    for report in outcome.stages.iter().filter(|report| report.ending == Ending::Failed) {
        let why = report.reason.as_deref().unwrap_or_default();
        let _ = writeln!(text, "{:<8}failed: {why}", report.stage.to_string());
    }
    text.trim_end().to_owned()
}

fn block(text: &mut String, outcome: &RunOutcome) -> std::fmt::Result {
    if let Some(align) = &outcome.results.align {
        write!(text, "block   {} of {} photos oriented", align.registered, align.images)?;
        writeln!(text, ", reprojection rms {:.2} px", align.reprojection_rms_px)?;
        let errors = &align.check_points;
        if let (Some(x), Some(y), Some(z)) = (errors.rmse_x_m, errors.rmse_y_m, errors.rmse_z_m) {
            let [x, y, z] = [x, y, z].map(|error| 100.0 * error);
            writeln!(text, "        check points: rmse {x:.1} {y:.1} {z:.1} cm in X, Y, Z")?;
        }
    }
    if let Some(gsd_m) = outcome.gsd_m {
        writeln!(text, "map     {:.2} cm per pixel", 100.0 * gsd_m)?;
    }
    Ok(())
}

fn traits(text: &mut String, outcome: &RunOutcome) -> std::fmt::Result {
    let results = &outcome.results;
    if let Some(segment) = &results.segment {
        writeln!(text, "leaves  cover {:.1} % of the map", 100.0 * segment.leaf_share)?;
    }
    if let Some(whole) = results.leaf_count.as_ref().and_then(|count| count.counts.first()) {
        writeln!(text, "        {:.0} leaves by area", whole.count.leaves)?;
    }
    if let Some(locate) = &results.locate {
        plants(text, locate)?;
    }
    if let Some(plots) = results.plots.as_ref().filter(|plots| plots.plots.len() > 1) {
        writeln!(text, "plots   {}", plots.plots.len())?;
    }
    Ok(())
}

fn plants(text: &mut String, locate: &LocateOutcome) -> std::fmt::Result {
    let stand = locate.stand.as_ref();
    if stand.is_some_and(StandOutcome::has_closed) {
        return match locate.rows {
            0 => writeln!(text, "plants  not told apart: leaves cover the picture"),
            rows => writeln!(text, "plants  not told apart: leaves have closed along {rows} rows"),
        };
    }
    match locate.rows {
        0 => write!(text, "plants  {}, no rows stand out", locate.plants)?,
        rows => write!(text, "plants  {} in {rows} rows", locate.plants)?,
    }
    let spacing_m = stand.filter(|_| locate.rows > 0).and_then(|stand| stand.spacing_m);
    if let Some(spacing_m) = spacing_m {
        write!(text, ", {:.1} cm apart", 100.0 * spacing_m)?;
    }
    writeln!(text)?;
    if stand.is_some_and(|stand| !stand.doubts.is_empty()) {
        writeln!(text, "        looks like no stand of a crop: see the warnings of locate")?;
    }
    Ok(())
}

fn truth(text: &mut String, outcome: &RunOutcome) -> std::fmt::Result {
    let Some(evaluate) = &outcome.results.evaluate else { return Ok(()) };
    write!(text, "truth   {} plants on the map", evaluate.score.truth)?;
    for (radius_m, score) in evaluate.radii_m.iter().zip(&evaluate.score.radii) {
        if let Some(f1) = score.f1 {
            write!(text, "; F1 {f1:.2} within {:.0} cm", 100.0 * radius_m)?;
        }
    }
    writeln!(text)?;
    if let Some(leaves) = &evaluate.leaf_validation {
        writeln!(
            text,
            "        leaves of the {} plots not counted by hand: {:.0} by area, {:.0} true ({:+.1} %)",
            leaves.plots,
            leaves.leaves_by_area,
            leaves.true_leaves,
            100.0 * leaves.relative_error
        )?;
    }
    Ok(())
}
