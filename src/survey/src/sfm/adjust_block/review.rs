//! What is wrong with image measurements, coordinates and positions before a block is adjusted, and what of its lenses is free.

use super::{BlockOptions, Flight, MARK, SHUTTER, ShutterModel};
use crate::{
    camera::Lens,
    scene::{Axes, Reconstruction, Role},
    sfm::{
        Block, Features,
        georeference::{
            Known, MarkReading, MarkReview, axes_exchanged, control_left_m, review_marks,
        },
        intrinsics::estimable,
        level::{HeightError, HeightReview, tilt_rad},
        orientation_review::{OrientationReview, OrientationSummary},
        positions::PositionFit,
        rolling_shutter::RollingShutterEstimate,
        triangulate::TriangulationOptions,
        weak_control::is_weak,
    },
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Severity},
};
use rowgram_optim::robust::median;

/// Fewer images than this do not determine a whole lens.
const MIN_IMAGES_FOR_WHOLE_LENS: usize = 6;
/// A difference of heights beyond this is one of vertical datums, metres.
const DATUM_DIFFERENCE_M: f64 = 10.0;

/// No geoid is farther from the ellipsoid, metres (EGM2008: -107 to 86).
const GEOID_M: f64 = 110.0;
/// No receiver is off by more in the plan, metres.
const RECEIVER_ERROR_M: f64 = 100.0;

/// What is said of a rolling shutter that is part of the adjustment.
pub(super) fn shutter(estimate: &RollingShutterEstimate, model: ShutterModel) -> Diagnostic {
    let message = format!(
        "while a photo is read its camera moves {:.2} m, {:.1} px on the ground (single photos +- {:.3} m); the motion is part of the adjustment",
        estimate.readout_displacement_m, estimate.readout_displacement_px, estimate.image_sigma_m
    );
    let diagnostic = Diagnostic::info(SHUTTER, "rolling shutter", message);
    match model {
        ShutterModel::Rolling(_) => diagnostic,
        _ => diagnostic.with_remedy("[align] rolling_shutter = \"off\" leaves it out"),
    }
}

pub(super) fn position_shift([x, y, z]: [f64; 3]) -> Diagnostic {
    let message = format!(
        "they are offset from the control by {x:+.2} {y:+.2} {z:+.2} m (easting, northing, height); the offset was removed"
    );
    if z.abs() > GEOID_M {
        let message = format!("{message}; no two vertical datums differ by so much");
        let remedy = "check the heights of both tables: one may be in feet, or above the field";
        return Diagnostic::warning("vertical-datum", "camera positions", message)
            .with_remedy(remedy);
    }
    if z.abs() > DATUM_DIFFERENCE_M {
        let message =
            format!("{message}; heights that differ by so much have different vertical datums");
        return Diagnostic::warning("vertical-datum", "camera positions", message);
    }
    if x.hypot(y) > RECEIVER_ERROR_M {
        let remedy =
            "check [project] crs, its datum, and both tables: one of them may be of another place";
        return Diagnostic::warning("position-offset", "camera positions", message)
            .with_remedy(remedy);
    }
    Diagnostic::info("position-offset", "camera positions", message)
}

/// Heights of camera positions that err by less than this along a flight are what receivers give, metres.
const HEIGHT_ERROR_M: f64 = 3.0;
/// Orientations that are farther from the level of the block than this contradict it, standard deviations.
const CONTRADICTION_SIGMAS: f64 = 4.0;
/// A tilt of heights by more standard deviations than this is reported.
const TILT_SIGMAS: f64 = 3.0;
/// A tilt beyond this is none of a mount.
const TILT_DEG: f64 = 8.0;

/// What was found in the heights of the camera positions.
pub(super) fn heights(review: &HeightReview) -> Vec<Diagnostic> {
    let mut found = Vec::new();
    let error = match review.error {
        HeightError::Drift(_) => Some("drift"),
        HeightError::Jump(..) => Some("jump"),
        HeightError::Constant => None,
    };
    if let Some(what) = error {
        let message = format!(
            "their heights {what} by {:.2} m along the flight ({:.0} standard deviations of {:.2} m), which the photos contradict; this error was removed from them",
            review.range_m,
            review.range_m / review.sigma_m.max(1e-9),
            review.sigma_m
        );
        let is_usual = review.range_m <= HEIGHT_ERROR_M;
        let severity = if is_usual { Severity::Info } else { Severity::Warning };
        let diagnostic =
            Diagnostic::new(severity, "heights-corrected", "camera positions", message);
        found.push(
            diagnostic
                .with_remedy("heights of the result may be off by as much: give control points"),
        );
    }
    let degrees = review.tilt_rad.to_degrees();
    if degrees > TILT_DEG || review.tilt_sigmas > TILT_SIGMAS {
        let message = format!(
            "their heights alone would tilt the block by {degrees:.1} degrees ({:.0} standard deviations) against the direction in which the cameras look; they were weighed with the cameras",
            review.tilt_sigmas
        );
        let severity = if degrees > TILT_DEG { Severity::Warning } else { Severity::Info };
        found.push(Diagnostic::new(severity, "heights-tilted", "camera positions", message));
    }
    found
}

/// Camera positions that are far from where the block puts them.
pub(super) fn rejected_positions(fit: &PositionFit, images: &[Features]) -> Vec<Diagnostic> {
    let said = |(image, distance): &(u32, f64)| {
        let message = format!(
            "its camera position is {distance:.1} m from where the block puts it; the position is not used"
        );
        Diagnostic::warning("position-rejected", images[*image as usize].name.as_str(), message)
    };
    fit.outliers.iter().map(said).collect()
}

/// Whether camera positions are off by more than their stated accuracies.
pub(super) fn exceeded_accuracy(
    fit: &PositionFit,
    told: &[Option<[f64; 3]>],
) -> Option<Diagnostic> {
    let factor = fit.told_factors.into_iter().fold(1.0, f64::max);
    let usual = |axis: usize| median(told.iter().flatten().map(|sigma| sigma[axis]));
    let [east, north, up] = [usual(0)?, usual(1)?, usual(2)?];
    let message = format!(
        "they are {:.3} m (plan) and {:.3} m (height) from where the photos put them, {:.0} and {:.0} of their stated standard deviations, which were multiplied by {factor:.1}",
        fit.sigma_m[0],
        fit.sigma_m[1],
        fit.sigma_m[0] / east.max(north),
        fit.sigma_m[1] / up
    );
    let found = Diagnostic::warning("position-accuracy", "camera positions", message);
    let remedy = "check which accuracies the receiver states, its base station, and its lever arm";
    (factor > 1.0).then(|| found.with_remedy(remedy))
}

/// What is said of orientations before the adjustment.
pub(super) fn orientations(found: &OrientationReview, images: &[Features]) -> Vec<Diagnostic> {
    let remedy = "[align] gimbal_sigma_deg = 0 leaves the gimbal's angles out";
    let [level, heading] = found.scatter_rad.map(f64::to_degrees);
    if found.is_contradiction {
        let message = format!(
            "the gimbal's angles contradict the relative orientations of the photos: {} of {} are outliers, the others differ by {level:.1} degrees in roll and pitch and {heading:.1} in heading; not used",
            found.outliers.len(),
            found.compared
        );
        let said = Diagnostic::warning("gimbal-rejected", "camera orientations", message);
        return vec![said.with_remedy(remedy)];
    }
    let Some((_, most)) = found.outliers.iter().max_by(|a, b| a.1.total_cmp(&b.1)) else {
        return Vec::new();
    };
    let names: Vec<&str> =
        found.outliers.iter().map(|(image, _)| images[*image as usize].name.as_str()).collect();
    let message = format!(
        "the gimbal's angles are up to {:.0} degrees from the orientations that the photos give; not used for these photos",
        most.to_degrees()
    );
    vec![Diagnostic::warning("gimbal-rejected", names.join(", "), message)]
}

/// What is said of orientations that took part.
pub(super) fn orientations_used(found: &OrientationSummary) -> Diagnostic {
    let [east, north, heading] = found.mean_correction_deg;
    let mount = found.mount_deg.iter().copied().fold(0.0, f64::max);
    let message = format!(
        "the gimbal's angles of {} photos are used: corrected by {:.2} degrees in roll and pitch and {heading:+.1} in heading on average, the camera hangs {mount:.1} degrees from where they point; residuals {:.2} and {:.1} degrees (assumed {:.2}, {:.1})",
        found.photos,
        east.hypot(north),
        found.level_rms_deg,
        found.heading_rms_deg,
        found.level_sigma_deg,
        found.heading_sigma_deg
    );
    if found.contradiction_sigmas < CONTRADICTION_SIGMAS {
        return Diagnostic::info("gimbal-used", "camera orientations", message);
    }
    let message = format!(
        "{message}: {:.0} standard deviations from the level that positions and control give",
        found.contradiction_sigmas
    );
    Diagnostic::warning("gimbal-contradicts", "camera orientations", message).with_remedy(
        "check the mount of the camera and the heights of control points and camera positions",
    )
}

/// Whether a block in the map is level as its cameras have it.
pub(super) fn tilt(scene: &Reconstruction, georeferenced: bool) -> Option<Diagnostic> {
    let degrees = tilt_rad(scene).filter(|_| georeferenced)?.to_degrees();
    let message = format!(
        "the cameras of the block look {degrees:.0} degrees away from straight down on average: it may be tilted"
    );
    let remedy = "check the heights of control points and camera positions; nothing has to be done where the camera was mounted obliquely";
    let diagnostic = Diagnostic::warning("block-tilted", "block", message);
    (degrees > TILT_DEG).then(|| diagnostic.with_remedy(remedy))
}

/// What image measurements of one ground point must be like: a free block is bent, but not within the few photos of one.
pub(super) fn mark_triangulation(options: &BlockOptions) -> TriangulationOptions {
    TriangulationOptions { tolerance_px: 3.0 * options.tolerance_px, min_angle_rad: 0.01 }
}

/// Ground points that do little or nothing for want of image measurements.
pub(super) fn name_scarcely_marked(
    blocks: &[Block<'_>],
    known: &Known,
    found: &mut Vec<Diagnostic>,
) {
    for (ground, point) in known.ground.iter().enumerate() {
        let oriented = |image: u32| {
            blocks.iter().any(|block| block.poses.get(image as usize).is_some_and(Option::is_some))
        };
        let marks = known.marks.iter().filter(|mark| mark.ground as usize == ground);
        let message = match marks.filter(|mark| oriented(mark.image)).count() {
            0 => "it is measured in no oriented photo: it takes no part",
            1 => "it is measured in one oriented photo only: two at least fix its place",
            _ => continue,
        };
        let subject = format!("ground point {}", point.name);
        found.push(Diagnostic::warning("scarcely-measured", subject, message));
    }
}

/// Says what control and positions leave open of how a block lies.
pub(super) fn datum(block: &Block<'_>, known: &Known, georeferenced: bool) -> Option<Diagnostic> {
    let control = known.ground.iter().filter(|point| point.role == Role::Control).count();
    if !georeferenced {
        if control == 0 && known.positions.is_empty() {
            return None;
        }
        let message = format!(
            "{control} control points in photos and {} camera positions do not fix where the block is: it is in a frame of its own, without scale, and they are not used",
            known.positions.len()
        );
        let remedy = "three points or positions at least, not in one line";
        return Some(Diagnostic::error("datum-undetermined", "block", message).with_remedy(remedy));
    }
    let (mut survey, _, order) = block.reconstruction(None);
    known.attach(&mut survey, &order);
    let heights = known.ground.iter().any(|p| p.role == Role::Control && p.axes != Axes::Xy);
    if is_weak(&survey) != Some(true) || !heights {
        return None;
    }
    let message = "its control points are fewer than three or lie nearly in one line: its tilt about them is that of the camera positions, and heights away from them may be far off";
    let remedy = "measure control points on all sides of the field";
    Some(Diagnostic::error("datum-weak", "block", message).with_remedy(remedy))
}

/// Image measurements and coordinates that cannot be as they are. What they are once they are read right, nothing
/// rejected.
pub(super) fn review(
    block: &Block<'_>,
    known: &mut Known,
    flight: &Flight<'_>,
    options: &BlockOptions,
    found: &mut Vec<Diagnostic>,
) -> Known {
    let mut given = known.clone();
    if known.marks.is_empty() {
        return given;
    }
    let review = review_marks(block, known, flight.mark_scales, true, &mark_triangulation(options));
    let refused = match review.reading {
        MarkReading::Resized(scale) => {
            let message = format!(
                "they fit the photos only when multiplied by {scale}: they were made in resized images, and were converted"
            );
            found.push(Diagnostic::warning("marks-resized", "marks", message));
            None
        }
        MarkReading::Pixels => review.is_contradiction.then(|| {
            let all = review.fitting + review.wrong.len();
            let message = format!(
                "{} of {all} contradict the other marks of their points, however they are read: control is not used",
                review.wrong.len()
            );
            Diagnostic::error("marks-contradict", "marks", message)
                .with_remedy("check that they are of these photos and points")
        }),
        other => {
            let message = format!(
                "{} of them fit the photos when taken as {}, and hardly any as column and row in pixels: control is not used",
                review.fitting,
                other.words()
            );
            Some(Diagnostic::error("marks-misread", "marks", message).with_remedy(
                "write u_px to the right and v_px downwards, from the centre of the top-left pixel",
            ))
        }
    };
    if let Some(why) = refused {
        found.push(why);
        known.without_control();
        return known.clone();
    }
    name_wrong_marks(&review, known, block.features, found);
    for mark in &mut given.marks {
        let size_px = block.lens(mark.image as usize).size_px();
        mark.image_px = review.reading.px(mark.image_px, size_px);
    }
    if axes_exchanged(block, known) {
        for point in known.ground.iter_mut().chain(&mut given.ground) {
            point.position_m.swap(0, 1);
        }
        let message = "X and Y are exchanged: as given they would turn the block upside down; they were swapped";
        found.push(Diagnostic::warning("axes-exchanged", "control points", message));
    }
    given
}

pub(super) fn name_wrong_marks(
    review: &MarkReview,
    known: &Known,
    images: &[Features],
    found: &mut Vec<Diagnostic>,
) {
    for wrong in &review.wrong {
        let point = &known.ground[wrong.ground as usize].name;
        let subject = format!("mark of {point} in {}", images[wrong.image as usize].name);
        let message = if wrong.error_px.is_finite() {
            format!(
                "it is {:.0} px from where the other marks of the point put it; removed",
                wrong.error_px
            )
        } else {
            "no two marks of the point agree".to_owned()
        };
        found.push(Diagnostic::warning(MARK, subject, message));
    }
}

/// What of the lenses the last adjustment frees, and what is known of them beforehand.
pub(super) fn prepare_cameras(
    block: &mut Block<'_>,
    georeferenced: bool,
    options: &BlockOptions,
) -> Result<(), Error> {
    let images = block.registered();
    for camera in &mut block.cameras {
        let model = camera.interior.model();
        let names: Vec<String> = match &options.free {
            Some(names) => names.clone(),
            None if options.calibrated => {
                let free = camera.free.iter().zip(model.parameters()).filter(|(free, _)| **free);
                free.map(|(_, parameter)| parameter.name.to_owned()).collect()
            }
            None => estimable(model, images >= MIN_IMAGES_FOR_WHOLE_LENS),
        };
        camera.set_free(&names).map_err(|e| Error::Argument(format!("free: {e}")))?;
        if options.calibrated {
            continue;
        }
        let larger = f64::from(camera.interior.size_px()[0].max(camera.interior.size_px()[1]));
        let parameters = camera.interior.parameters();
        for (k, parameter) in parameters.iter().enumerate() {
            camera.standard_deviations[k] = match parameter.name {
                "f_px" | "c_px" if !georeferenced => {
                    // A block of its own has found it better than the files told it, where they did.
                    let c = camera.interior.principal_distance_px();
                    if let Some(expected) = &mut camera.expected {
                        expected[k] = c;
                    }
                    Some(0.1 * c)
                }
                "cx_px" | "cy_px" | "xp_px" | "yp_px" => Some(0.02 * larger),
                _ => None,
            };
        }
    }
    Ok(())
}

/// Control that is this many times as far off as half of it is wrong.
const GROSS_ERROR_RATIO: f64 = 8.0;

/// The control point that the block contradicts most, and by how many metres.
pub(super) fn worst_control(
    block: &Block<'_>,
    known: &Known,
    sigma_m: f64,
) -> Option<(usize, f64)> {
    let mut left = control_left_m(block, known);
    left.retain(|(ground, _)| !known.keep.contains(&known.ground[*ground].name));
    if left.len() < 4 {
        return None;
    }
    let half = median(left.iter().map(|(_, left)| *left))?;
    let (index, most) = left.into_iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let given = known.ground[index].sigma_m.iter().copied().fold(0.0, f64::max);
    let is_gross = most > GROSS_ERROR_RATIO * half && most > GROSS_ERROR_RATIO * given;
    (is_gross && most > sigma_m).then_some((index, most))
}
