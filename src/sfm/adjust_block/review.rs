//! What is wrong with image measurements, coordinates and positions before a block is adjusted, and what of its lenses is free.

use super::{BlockOptions, Flight, MARK};
use crate::{
    camera::Lens,
    error::Error,
    monitor::Diagnostic,
    sfm::{
        Block, Features,
        georeference::{Known, MarkReview, axes_exchanged, review_marks},
        intrinsics::estimable,
        triangulate::TriangulationOptions,
    },
};

/// Fewer images than this do not determine a whole lens.
const MIN_IMAGES_FOR_WHOLE_LENS: usize = 6;
/// A difference of heights beyond this is one of vertical datums, metres.
const DATUM_DIFFERENCE_M: f64 = 10.0;

pub(super) fn position_shift([x, y, z]: [f64; 3]) -> Diagnostic {
    let message = format!(
        "they are offset from the control by {x:+.2} {y:+.2} {z:+.2} m (easting, northing, height); the offset was removed"
    );
    if z.abs() > DATUM_DIFFERENCE_M {
        let message =
            format!("{message}; heights that differ by so much have different vertical datums");
        return Diagnostic::warning("vertical-datum", "camera positions", message);
    }
    Diagnostic::info("position-offset", "camera positions", message)
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

/// Image measurements and coordinates that cannot be as they are.
pub(super) fn review(
    block: &Block<'_>,
    known: &mut Known,
    flight: &Flight<'_>,
    options: &BlockOptions,
    found: &mut Vec<Diagnostic>,
) {
    if known.marks.is_empty() {
        return;
    }
    let review = review_marks(block, known, flight.mark_scales, &mark_triangulation(options));
    if review.scale != 1.0 {
        let message = format!(
            "they fit the photos only when multiplied by {}: they were made in resized images, and were converted",
            review.scale
        );
        found.push(Diagnostic::warning("marks-resized", "marks", message));
    }
    name_wrong_marks(&review, known, block.features, found);
    if axes_exchanged(block, known) {
        known.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
        let message = "X and Y are exchanged: as given they would turn the block upside down; they were swapped";
        found.push(Diagnostic::warning("axes-exchanged", "control points", message));
    }
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
