//! Quality checks of a run: what is well, what needs attention, what should not be used as it is.
//!
//! Every check is a [`Diagnostic`]: information is green, a warning yellow, an error red.

use super::{
    ReportOptions,
    run::{Ending, RunOutcome},
};
use crate::{
    monitor::{Diagnostic, Severity},
    options::Choice,
    scene::Reconstruction,
};

/// Root mean square reprojection errors beyond which a block needs attention, and is bad, pixels. Features are found to
/// about half a pixel; two pixels are a wrong lens or wrong matches.
const REPROJECTION_PX: [f64; 2] = [1.0, 2.0];
/// Shares of oriented photos below which a block needs attention, and is bad.
const ORIENTED: [f64; 2] = [1.0, 0.9];
/// Factors between assumed and found standard deviations.
const SIGMA0: [f64; 2] = [2.0, 4.0];
/// Mean probabilities of plants below which they need attention, and are bad.
const CONFIDENCE: [f64; 2] = [0.7, 0.5];
/// Correlations of two parameters of a lens from which the block hardly tells them apart.
const HIGH_CORRELATION: f64 = 0.95;
/// Fewer control points than this do not place a block.
const LEAST_CONTROL: usize = 3;

/// Green up to the first limit, yellow up to the second; what is no number is red.
fn rising(value: f64, [yellow, red]: [f64; 2]) -> Severity {
    if value <= yellow {
        Severity::Info
    } else if value <= red {
        Severity::Warning
    } else {
        Severity::Error
    }
}

/// The checks of a run; `reconstruction` is what its alignment made.
pub(super) fn checks(
    outcome: &RunOutcome,
    reconstruction: Option<&Reconstruction>,
    limits: &ReportOptions,
) -> Vec<Diagnostic> {
    let mut found: Vec<Diagnostic> = outcome
        .stages
        .iter()
        .filter(|report| report.ending == Ending::Failed)
        .map(|report| {
            let why = report.reason.clone().unwrap_or_default();
            Diagnostic::error("stage-failed", report.stage.word(), format!("failed: {why}"))
        })
        .collect();
    of_block(outcome, limits, &mut found);
    found.extend(reconstruction.and_then(of_accuracy));
    found.extend(reconstruction.and_then(of_lenses));
    if let Some(ortho) = &outcome.results.ortho {
        let share = ortho.mosaic.coloured_pixels as f64
            / (ortho.mosaic.width_px * ortho.mosaic.height_px).max(1) as f64;
        let message = format!("{:.0} % of its frame is covered by photos", 100.0 * share);
        found.push(Diagnostic::info("map-coverage", "orthomosaic", message));
    }
    if let Some(stand) = outcome.results.locate.as_ref().and_then(|locate| locate.stand.as_ref()) {
        let confidence = stand.mean_confidence;
        let severity = rising(-confidence, CONFIDENCE.map(|limit| -limit));
        let message = format!("mean confidence {confidence:.2}");
        found.push(remedied(
            Diagnostic::new(severity, "plants-confidence", "plants", message),
            "look at them over the orthomosaic; check thresholds of leaves and the spacing of plants",
        ));
    }
    found
}

/// With a remedy where something is not well.
fn remedied(found: Diagnostic, remedy: &str) -> Diagnostic {
    if found.severity == Severity::Info { found } else { found.with_remedy(remedy) }
}

fn of_block(outcome: &RunOutcome, limits: &ReportOptions, found: &mut Vec<Diagnostic>) {
    let Some(align) = &outcome.results.align else { return };
    let share = align.registered as f64 / align.images.max(1) as f64;
    let severity = rising(-share, ORIENTED.map(|limit| -limit));
    let message = format!("{} of {}", align.registered, align.images);
    found.push(remedied(
        Diagnostic::new(severity, "photos-oriented", "photos oriented", message),
        "look at the photos that are not: blurred, or too little overlap",
    ));
    let rms = align.reprojection_rms_px;
    let severity = rising(rms, REPROJECTION_PX);
    found.push(remedied(
        Diagnostic::new(severity, "reprojection", "reprojection", format!("rms {rms:.2} px")),
        "try another lens model, or a calibrated camera",
    ));
    let control = align.control_points.count;
    found.push(if !align.georeferenced {
        Diagnostic::error("georeference", "georeference", "the block has no scale and no place in a mapping frame")
            .with_remedy("give camera positions or ground control points")
    } else if control < LEAST_CONTROL {
        Diagnostic::warning(
            "georeference",
            "georeference",
            format!("{control} control points: place and height are those of the camera positions, which may be metres off"),
        )
        .with_remedy("measure three or more ground control points")
    } else {
        Diagnostic::info("georeference", "georeference", format!("{control} control points"))
    });
    let errors = &align.check_points;
    let worst = [errors.rmse_x_m, errors.rmse_y_m, errors.rmse_z_m];
    let worst = worst.into_iter().flatten().reduce(f64::max);
    found.push(match worst.zip(align.gsd_m) {
        Some((worst_m, gsd_m)) => {
            let ratio = worst_m / gsd_m;
            let severity = rising(ratio, [limits.check_yellow_gsd, limits.check_red_gsd]);
            let message = format!(
                "largest rmse {:.1} cm, {ratio:.1} ground sampling distances",
                100.0 * worst_m
            );
            remedied(
                Diagnostic::new(severity, "check-points", "check points", message),
                "check the coordinates of the points, their marks in the photos and the reference system",
            )
        }
        None => Diagnostic::warning(
            "check-points-missing",
            "check points",
            "there are none: nothing independent tells how large errors are",
        )
        .with_remedy("name some ground points in [align] check"),
    });
}

fn of_accuracy(reconstruction: &Reconstruction) -> Option<Diagnostic> {
    let sigma0 = reconstruction.accuracy.as_ref()?.sigma0;
    let severity = rising(sigma0.max(1.0 / sigma0.max(1e-9)), SIGMA0);
    let message = format!("residuals are {sigma0:.2} times the assumed accuracy (ideal: 1)");
    Some(remedied(
        Diagnostic::new(severity, "assumed-accuracies", "assumed accuracies", message),
        "give standard deviations of control and camera positions that are true",
    ))
}

/// Parameters of lenses that the block hardly tells apart.
fn of_lenses(reconstruction: &Reconstruction) -> Option<Diagnostic> {
    let cameras = &reconstruction.accuracy.as_ref()?.cameras;
    if cameras.iter().all(|camera| camera.names.is_empty()) {
        return None;
    }
    let mut pairs = Vec::new();
    for camera in cameras {
        for (i, row) in camera.correlation.iter().enumerate() {
            for (j, value) in row.iter().enumerate().take(i) {
                if value.abs() > HIGH_CORRELATION {
                    let [a, b] = [&camera.names[j], &camera.names[i]];
                    pairs.push(format!("{a} and {b} ({value:.2})"));
                }
            }
        }
    }
    Some(if pairs.is_empty() {
        let message = "every parameter is told apart from the others";
        Diagnostic::info("self-calibration", "self-calibration", message)
    } else {
        let message = format!("highly correlated, normal for small blocks: {}", pairs.join(", "));
        Diagnostic::warning("self-calibration", "self-calibration", message)
            .with_remedy("calibrate the camera beforehand where the lens itself matters")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        pipeline::{Stage, run::StageReport},
        scene::{Accuracy, CameraSigma},
    };

    #[test]
    fn limits_belong_to_the_better_side() {
        assert_eq!(rising(1.0, [1.0, 2.0]), Severity::Info);
        assert_eq!(rising(2.0, [1.0, 2.0]), Severity::Warning);
        assert_eq!(rising(2.1, [1.0, 2.0]), Severity::Error);
        assert_eq!(rising(f64::NAN, [1.0, 2.0]), Severity::Error);
    }

    #[test]
    fn a_failed_stage_is_red() {
        let report = StageReport {
            stage: Stage::Ortho,
            ending: Ending::Failed,
            reason: Some("no photo".to_owned()),
            diagnostics: Vec::new(),
        };
        let outcome = RunOutcome { stages: vec![report], ..RunOutcome::default() };
        let found = checks(&outcome, None, &ReportOptions::default());
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].severity, Severity::Error);
        assert_eq!(found[0].to_string(), "ortho: failed: no photo");
    }

    #[test]
    fn correlated_parameters_are_named() {
        let camera = |correlation: f64| CameraSigma {
            names: vec!["K2".to_owned(), "K3".to_owned()],
            sigmas: vec![1.0, 1.0],
            correlation: vec![vec![1.0, correlation], vec![correlation, 1.0]],
        };
        let with = |cameras| Reconstruction {
            accuracy: Some(Accuracy { sigma0: 3.0, cameras, ..Accuracy::default() }),
            ..Reconstruction::default()
        };
        let found = of_lenses(&with(vec![camera(-0.98)])).unwrap();
        assert_eq!(found.severity, Severity::Warning);
        assert!(found.message.contains("K2 and K3 (-0.98)"), "{found}");
        assert_eq!(of_lenses(&with(vec![camera(0.5)])).unwrap().severity, Severity::Info);
        assert_eq!(of_lenses(&with(vec![CameraSigma::default()])), None);
        assert_eq!(of_accuracy(&with(Vec::new())).unwrap().severity, Severity::Warning);
    }
}
