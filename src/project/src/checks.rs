//! Quality checks of a run: what is well, what needs attention, what should not be used as it is.
//!
//! Every check is a [`Diagnostic`]: information is green, a warning yellow, an error red.

use super::{
    align::AlignOutcome,
    run::{Ending, RunOutcome},
};
use rowgram_base::{
    monitor::{Diagnostic, Severity},
    options::Choice,
};
use rowgram_survey::scene::Reconstruction;

rowgram_base::options! {
    /// Limits of the quality checks: from the first a result needs attention (yellow), from the second it should not be used
    /// as it is (red, exit code 3).
    pub struct ChecksOptions in "checks", together yellow_before_red {
        /// Share of the photos that are oriented; yellow below it.
        pub oriented_yellow: f64 = 1.0, limits SHARE;
        /// Share of the photos that are oriented; red below it.
        pub oriented_red: f64 = 0.9, limits SHARE;
        /// Root mean square reprojection error; yellow above it. Key points are found to about half a pixel.
        pub reprojection_yellow_px: f64 = 1.0, limits POSITIVE;
        /// Root mean square reprojection error; red above it. Two pixels indicate a wrong lens or wrong matches.
        pub reprojection_red_px: f64 = 2.0, limits POSITIVE;
        /// Minimum number of ground control points; yellow below it.
        pub min_control_points: usize = 3;
        /// Largest root mean square error of check points along an axis; yellow above it.
        pub check_points_yellow_gsd: f64 = 2.0, limits POSITIVE;
        /// Largest root mean square error of check points along an axis; red above it.
        pub check_points_red_gsd: f64 = 4.0, limits POSITIVE;
        /// Factor between the assumed accuracies and those found, either way (sigma0 or its inverse); yellow above it.
        pub sigma0_yellow: f64 = 2.0, limits at_least(1.0);
        /// Factor between the assumed accuracies and those found, either way; red above it.
        pub sigma0_red: f64 = 4.0, limits at_least(1.0);
        /// Correlation of two lens parameters; yellow above it, as the block can hardly separate them.
        pub correlation_yellow: f64 = 0.95, limits SHARE;
        /// Mean probability of the plants; yellow below it.
        pub confidence_yellow: f64 = 0.7, limits between(0.0, 1.0);
        /// Mean probability of the plants; red below it.
        pub confidence_red: f64 = 0.5, limits between(0.0, 1.0);
    }
}

fn yellow_before_red(options: &ChecksOptions) -> Result<(), String> {
    let rising = [
        ("reprojection", "_px", options.reprojection_yellow_px, options.reprojection_red_px),
        ("check_points", "_gsd", options.check_points_yellow_gsd, options.check_points_red_gsd),
        ("sigma0", "", options.sigma0_yellow, options.sigma0_red),
    ];
    let falling = [
        ("oriented", "", options.oriented_yellow, options.oriented_red),
        ("confidence", "", options.confidence_yellow, options.confidence_red),
    ];
    let refuse = |(name, unit, yellow, red): (&str, &str, f64, f64), how: &str| {
        Err(format!(
            "{name}_yellow{unit} = {yellow}: expected {how} {name}_red{unit}, which is {red}"
        ))
    };
    if let Some(limits) = rising.into_iter().find(|(_, _, yellow, red)| yellow > red) {
        return refuse(limits, "at most");
    }
    match falling.into_iter().find(|(_, _, yellow, red)| yellow < red) {
        Some(limits) => refuse(limits, "at least"),
        None => Ok(()),
    }
}

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
    limits: &ChecksOptions,
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
    // What a stage says must not be used as it is.
    let severe = outcome.stages.iter().flat_map(|report| &report.diagnostics);
    found.extend(severe.filter(|said| said.severity == Severity::Error).cloned());
    of_block(outcome, limits, &mut found);
    found.extend(reconstruction.and_then(|found| of_accuracy(found, limits)));
    found.extend(reconstruction.and_then(|found| of_lenses(found, limits)));
    if let Some(ortho) = &outcome.results.ortho {
        let share = ortho.mosaic.coloured_pixels as f64
            / (ortho.mosaic.width_px * ortho.mosaic.height_px).max(1) as f64;
        let message = format!("{:.0} % of its frame is covered by photos", 100.0 * share);
        found.push(Diagnostic::info("map-coverage", "orthomosaic", message));
    }
    let locate = outcome.results.locate.as_ref();
    if let Some((locate, stand)) = locate.and_then(|of| Some((of, of.stand.as_ref()?))) {
        let confidence = stand.mean_confidence;
        let severity = rising(-confidence, [-limits.confidence_yellow, -limits.confidence_red]);
        let mut message = format!("mean confidence {confidence:.2}");
        let severity = if stand.doubts.is_empty() {
            severity
        } else if stand.has_closed() {
            message = match locate.rows {
                0 => "leaves cover the picture and show no plants",
                _ => "leaves have closed along the rows and show no plants; plots have row_cover and row_gap_share instead",
            }
            .to_owned();
            Severity::Warning
        } else {
            message.push_str("; this looks like no stand of a crop, as locate says");
            severity.max(Severity::Warning)
        };
        let remedy = match stand.has_closed() {
            true => "count on an earlier photo, or give the number of plants ([locate] plants)",
            false => {
                "look at them over the orthomosaic; check thresholds of leaves and the spacing of plants"
            }
        };
        let found_plants = Diagnostic::new(severity, "plants-confidence", "plants", message);
        found.push(remedied(found_plants, remedy));
    }
    found
}

/// With a remedy where something is not well.
fn remedied(found: Diagnostic, remedy: &str) -> Diagnostic {
    if found.severity == Severity::Info { found } else { found.with_remedy(remedy) }
}

/// How many photos of a flight are oriented.
pub(crate) fn photos_oriented(align: &AlignOutcome, limits: &ChecksOptions) -> Diagnostic {
    let share = align.registered as f64 / align.images.max(1) as f64;
    let severity = rising(-share, [-limits.oriented_yellow, -limits.oriented_red]);
    let message = format!("{} of {}", align.registered, align.images);
    remedied(
        Diagnostic::new(severity, "photos-oriented", "photos oriented", message),
        "look at the photos that are not: blurred, or too little overlap",
    )
}

fn of_block(outcome: &RunOutcome, limits: &ChecksOptions, found: &mut Vec<Diagnostic>) {
    let Some(align) = &outcome.results.align else { return };
    found.push(photos_oriented(align, limits));
    let rms = align.reprojection_rms_px;
    let severity = rising(rms, [limits.reprojection_yellow_px, limits.reprojection_red_px]);
    found.push(remedied(
        Diagnostic::new(severity, "reprojection", "reprojection", format!("rms {rms:.2} px")),
        "try another lens model, or a calibrated camera",
    ));
    found.push(georeference(align, limits));
    let worst = align.check_points.worst_m();
    found.push(match worst.zip(align.gsd_m) {
        Some((worst_m, gsd_m)) => {
            let ratio = worst_m / gsd_m;
            let severity = rising(ratio, [limits.check_points_yellow_gsd, limits.check_points_red_gsd]);
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

/// What places a block in its frame, and whether its control contradicts it.
pub(crate) fn georeference(align: &AlignOutcome, limits: &ChecksOptions) -> Diagnostic {
    let control = align.control_points.count;
    let worst = align.control_points.worst_m().zip(align.gsd_m).zip(align.control_sigma0);
    let misfit = worst.map(|(worst, sigma0)| control_misfit(worst, sigma0, limits));
    let (misfit, misfits) = misfit.unwrap_or((Severity::Info, String::new()));
    if !align.georeferenced {
        Diagnostic::error(
            "georeference",
            "georeference",
            "the block has no scale and no place in a mapping frame",
        )
        .with_remedy("give camera positions or ground control points")
    } else if control < limits.min_control_points {
        Diagnostic::warning(
            "georeference",
            "georeference",
            format!("{control} control points: place and height are those of the camera positions, which may be metres off"),
        )
        .with_remedy("measure three or more ground control points")
    } else {
        let message = format!("{control} control points{misfits}");
        remedied(
            Diagnostic::new(misfit, "georeference", "georeference", message),
            "check that their coordinates have all decimals, their units and their marks in the photos",
        )
    }
}

/// How severe it is that control points are so far from the block, by pixels and by their accuracy, whichever is less severe; what a message says of it.
fn control_misfit(
    (worst_m, gsd_m): (f64, f64),
    sigma0: f64,
    limits: &ChecksOptions,
) -> (Severity, String) {
    let by_errors = [limits.check_points_yellow_gsd, limits.check_points_red_gsd];
    let severity = rising(worst_m / gsd_m, by_errors)
        .min(rising(sigma0, [limits.sigma0_yellow, limits.sigma0_red]));
    let message = format!(
        ", which the block misses by up to {worst_m:.2} m (rmse along an axis), {sigma0:.0} times their accuracy"
    );
    (severity, if severity == Severity::Info { String::new() } else { message })
}

fn of_accuracy(reconstruction: &Reconstruction, limits: &ChecksOptions) -> Option<Diagnostic> {
    let sigma0 = reconstruction.accuracy.as_ref()?.sigma0;
    let severity =
        rising(sigma0.max(1.0 / sigma0.max(1e-9)), [limits.sigma0_yellow, limits.sigma0_red]);
    let message = format!("residuals are {sigma0:.2} times the assumed accuracy (ideal: 1)");
    Some(remedied(
        Diagnostic::new(severity, "assumed-accuracies", "assumed accuracies", message),
        "give standard deviations of control and camera positions that are true",
    ))
}

/// Parameters of lenses that the block hardly tells apart.
fn of_lenses(reconstruction: &Reconstruction, limits: &ChecksOptions) -> Option<Diagnostic> {
    let cameras = &reconstruction.accuracy.as_ref()?.cameras;
    if cameras.iter().all(|camera| camera.names.is_empty()) {
        return None;
    }
    let mut pairs = Vec::new();
    for camera in cameras {
        for (i, row) in camera.correlation.iter().enumerate() {
            for (j, value) in row.iter().enumerate().take(i) {
                if value.abs() > limits.correlation_yellow {
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
    use crate::{Stage, run::StageReport};
    use rowgram_base::options::Options;
    use rowgram_survey::scene::{Accuracy, CameraSigma};

    #[test]
    fn limits_belong_to_the_better_side() {
        assert_eq!(rising(1.0, [1.0, 2.0]), Severity::Info);
        assert_eq!(rising(2.0, [1.0, 2.0]), Severity::Warning);
        assert_eq!(rising(2.1, [1.0, 2.0]), Severity::Error);
        assert_eq!(rising(f64::NAN, [1.0, 2.0]), Severity::Error);
    }

    #[test]
    fn yellow_comes_before_red() {
        let refused = |table: &str| {
            let given = table.parse().unwrap();
            ChecksOptions::default().with(&given).unwrap().validate().unwrap_err()
        };
        let message = refused("sigma0_yellow = 5.0");
        assert_eq!(message, "sigma0_yellow = 5: expected at most sigma0_red, which is 4");
        let message = refused("oriented_yellow = 0.8");
        assert_eq!(message, "oriented_yellow = 0.8: expected at least oriented_red, which is 0.9");
        ChecksOptions::default().validate().unwrap();
    }

    #[test]
    fn control_contradicts_a_block_beyond_its_accuracy_and_some_pixels() {
        let limits = ChecksOptions::default();
        for (worst_m, sigma0, expected) in [
            (2.7, 99.5, Severity::Error),
            // As accurate as was said, or within a few pixels.
            (2.7, 1.1, Severity::Info),
            (0.02, 9.0, Severity::Info),
            (0.04, 9.0, Severity::Warning),
        ] {
            let (severity, words) = control_misfit((worst_m, 0.015), sigma0, &limits);
            assert_eq!(severity, expected, "{worst_m} {sigma0}");
            assert_eq!(words.contains("times their accuracy"), severity > Severity::Info);
        }
    }

    #[test]
    fn a_failed_stage_is_red() {
        let report = StageReport {
            stage: Stage::Ortho,
            ending: Ending::Failed,
            reason: Some("no photo".to_owned()),
            seconds: None,
            peak_memory_mb: None,
            diagnostics: Vec::new(),
        };
        let outcome = RunOutcome { stages: vec![report], ..RunOutcome::default() };
        let found = checks(&outcome, None, &ChecksOptions::default());
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
        let limits = ChecksOptions::default();
        let found = of_lenses(&with(vec![camera(-0.98)]), &limits).unwrap();
        assert_eq!(found.severity, Severity::Warning);
        assert!(found.message.contains("K2 and K3 (-0.98)"), "{found}");
        assert_eq!(of_lenses(&with(vec![camera(0.5)]), &limits).unwrap().severity, Severity::Info);
        assert_eq!(of_lenses(&with(vec![CameraSigma::default()]), &limits), None);
        assert_eq!(of_accuracy(&with(Vec::new()), &limits).unwrap().severity, Severity::Warning);
        let lenient = ChecksOptions { sigma0_yellow: 3.5, correlation_yellow: 0.99, ..limits };
        assert_eq!(of_accuracy(&with(Vec::new()), &lenient).unwrap().severity, Severity::Info);
        assert_eq!(
            of_lenses(&with(vec![camera(-0.98)]), &lenient).unwrap().severity,
            Severity::Info
        );
    }
}
