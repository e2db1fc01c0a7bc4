//! The last stage that computes: blocks into the map, made one, adjusted and judged.

use super::{
    Args, Finding,
    again::Photos,
    judge::{Way, demands, judge},
    project::{Photo, Project},
};
use crate::{
    camera::Lens,
    error::Error,
    problems::adjustment::{Alignment, Group, Removed, Settings},
    scene::{Reconstruction, Role},
    sfm::{
        block::Block,
        georeference::{Known, MarkReview, axes_exchanged, join, review_marks},
        triangulate::Demands,
    },
};

/// The block as it came out.
pub(super) struct Final {
    /// Everything, adjusted.
    pub(super) survey: Reconstruction,
    pub(super) adjusted: crate::problems::adjustment::Adjusted,
    pub(super) settings: Settings,
    pub(super) alignment: Option<Alignment>,
    pub(super) removed: Vec<Removed>,
    pub(super) complete: bool,
    pub(super) georeferenced: bool,
    /// The pieces that the growth left: names of their images, and whether they are in the block.
    pub(super) fragments: Vec<(Vec<String>, bool)>,
    /// Check points as the project has them, not those that were made ones.
    pub(super) checks: Vec<String>,
}

/// What control is off by at most after a similarity, but for the worst of it, metres.
fn loosest_control_m(alignment: &Alignment) -> f64 {
    let mut left: Vec<f64> = alignment.misfits.iter().map(|(_, left)| *left).collect();
    left.extend(std::iter::repeat_n(alignment.rmse_m, alignment.used.len()));
    left.sort_by(f64::total_cmp);
    left.get(left.len() * 3 / 4).copied().unwrap_or(0.0)
}

/// Brings the blocks into the map, makes them one, adjusts it and judges it.
pub(super) fn finish<'a>(
    mut blocks: Vec<Block<'a>>,
    project: &Project,
    photos: &Photos<'_>,
    args: &Args,
    findings: &mut Vec<Finding>,
) -> Result<Final, Error> {
    let mut known = project.known.clone();
    let mut fragments: Vec<(Vec<String>, bool)> =
        blocks.iter().map(|block| (names(block, &project.photos), false)).collect();
    if let Some(largest) = blocks.first() {
        review(largest, &mut known, project, args, findings);
    }
    name_scarcely_marked(&blocks, &known, findings);
    let Some(joined) =
        join(std::mem::take(&mut blocks), &mut known, &demands(3.0 * args.tolerance))
    else {
        return Err(Error::Incomplete(
            "no three photos could be oriented together: look at the matches (rowgram match), or give the camera (--camera)".into(),
        ));
    };
    let mut block = joined.block;
    for (k, alignment) in joined.alignments.iter().enumerate() {
        fragments[k].1 = alignment.is_some() || !joined.georeferenced && k == 0;
    }
    if let Some([x, y, z]) = joined.position_shift_m.filter(|_| !known.positions.is_empty()) {
        tracing::info!(
            "camera positions are {x:+.2} {y:+.2} {z:+.2} m from where the control puts them on the whole; that was taken off"
        );
        if z.abs() > 10.0 {
            findings.push(Finding::new(
                "camera positions",
                &format!("their heights are {z:+.1} m from those of the control: another vertical datum; the difference was taken off"),
            ));
        }
    }
    prepare_cameras(&mut block, joined.georeferenced, args)?;
    let mut told = vec![None; project.told.len()];
    for position in &project.known.positions {
        let image = position.image as usize;
        told[image] = project.told[image].then_some(position.sigma_m);
    }
    let loosest_m = joined
        .alignments
        .iter()
        .flatten()
        .filter(|alignment| alignment.by == "control points")
        .map(loosest_control_m)
        .fold(0.0, f64::max);
    let way = Way { georeferenced: joined.georeferenced, told, loosest_m };
    let said = findings.clone();
    let mut judged = judge(block.clone(), known.clone(), &way, (project, photos), args, findings)?;
    let wrong: Vec<Removed> =
        judged.removed.iter().filter(|r| r.group == Group::Control).cloned().collect();
    if !wrong.is_empty() {
        // All that was found with it in leaned on it, a shutter that seems to roll above all.
        let named = |subject: &str| wrong.iter().any(|removed| removed.name == subject);
        let found = std::mem::replace(findings, said);
        findings.extend(found.into_iter().filter(|finding| named(&finding.subject)));
        for point in &mut known.ground {
            if named(&format!("control point {}", point.name)) {
                point.role = Role::Check;
            }
        }
        judged = judge(block, known, &way, (project, photos), args, findings)?;
        judged.removed.splice(0..0, wrong);
    }
    Ok(Final {
        survey: judged.survey,
        adjusted: judged.adjusted,
        settings: Settings { minimal_datum: !joined.georeferenced, ..Settings::default() },
        alignment: joined.alignments.into_iter().flatten().next(),
        removed: judged.removed,
        complete: judged.complete,
        georeferenced: joined.georeferenced,
        fragments,
        checks: judged.checks,
    })
}

fn names(block: &Block<'_>, photos: &[Photo]) -> Vec<String> {
    let of = block.poses.iter().zip(photos).filter(|(pose, _)| pose.is_some());
    of.map(|(_, photo)| photo.name.clone()).collect()
}

/// Control that does little or nothing for want of marks.
fn name_scarcely_marked(blocks: &[Block<'_>], known: &Known, findings: &mut Vec<Finding>) {
    for (ground, point) in known.ground.iter().enumerate() {
        let oriented = |image: u32| {
            blocks.iter().any(|block| block.poses.get(image as usize).is_some_and(Option::is_some))
        };
        let marks = known.marks.iter().filter(|mark| mark.ground as usize == ground);
        let what = match marks.filter(|mark| oriented(mark.image)).count() {
            0 => "no oriented photo has a mark of it: it takes no part",
            1 => "one oriented photo only has a mark of it: two at least fix its place",
            _ => continue,
        };
        findings.push(Finding::new(&format!("ground point {}", point.name), what));
    }
}

/// Marks and coordinates that cannot be as they are.
fn review(
    block: &Block<'_>,
    known: &mut Known,
    project: &Project,
    args: &Args,
    findings: &mut Vec<Finding>,
) {
    if known.marks.is_empty() {
        return;
    }
    let review = review_marks(block, known, &mark_scales(project), &mark_demands(args));
    if review.scale != 1.0 {
        findings.push(Finding::new(
            "marks",
            &format!(
                "they fit the photos only when multiplied by {}: they were made in resized images, and were converted",
                review.scale
            ),
        ));
    }
    name_wrong_marks(&review, known, project, findings);
    if axes_exchanged(block, known) {
        known.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
        findings.push(Finding::new(
            "control points",
            "X and Y are exchanged: as given they would turn the block upside down; taken the other way round",
        ));
    }
}

/// Sizes that marks may have been made in, relative to the photos.
pub(super) fn mark_scales(project: &Project) -> Vec<f64> {
    let mut scales = vec![0.25, 0.5, 2.0, 4.0];
    for photo in &project.photos {
        if let Some([width, _]) = photo.metadata.written_size_px {
            let scale = f64::from(photo.size_px[0]) / f64::from(width);
            if (scale - 1.0).abs() > 0.01 && !scales.iter().any(|s| (s - scale).abs() < 0.01) {
                scales.push(scale);
            }
        }
    }
    scales
}

/// What marks of one point must be like: a free block is bent, but not within the few photos of one.
pub(super) fn mark_demands(args: &Args) -> Demands {
    Demands { tolerance_px: 3.0 * args.tolerance, least_angle_rad: 0.01 }
}

/// How findings about marks begin.
pub(super) const MARK: &str = "mark of ";

pub(super) fn name_wrong_marks(
    review: &MarkReview,
    known: &Known,
    project: &Project,
    findings: &mut Vec<Finding>,
) {
    for wrong in &review.wrong {
        let (point, image) =
            (&known.ground[wrong.ground as usize].name, &project.photos[wrong.image as usize].name);
        let what = if wrong.error_px.is_finite() {
            format!(
                "the mark is {:.0} px from where the others of the point put it: taken out",
                wrong.error_px
            )
        } else {
            "no two marks of the point agree".to_owned()
        };
        findings.push(Finding::new(&format!("{MARK}{point} in {image}"), &what));
    }
}

/// The robust standard deviation of an image coordinate, pixels. Most points are seen twice or three
/// times, and residuals are shorter than errors by the root of the redundancy's share.
pub(super) fn typical_px(block: &Block<'_>) -> f64 {
    let mut errors = Vec::new();
    let unknowns = 3 * block.points.iter().flatten().count() + 6 * block.registered();
    for track in 0..block.tracks.count() {
        let Some(point) = block.points[track] else { continue };
        for place in block.tracks.places(track) {
            let image = block.tracks.member(place).image as usize;
            let pose = block.pose_at(image, block.position_px(place)[1]);
            if let (true, Some(pose)) = (block.used[place], pose)
                && let Some([u, v]) = block.lens(image).project(pose.to_camera(point))
            {
                let at = block.position_px(place);
                errors.push((u - at[0]).hypot(v - at[1]));
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    let share = 1.0 - unknowns as f64 / (2 * errors.len().max(1)) as f64;
    let median = errors.get(errors.len() / 2).copied().unwrap_or(1.1774);
    median / 1.1774 / share.max(0.1).sqrt()
}

/// Fewer images than this do not tell a whole lens.
const WHOLE_LENS_FROM: usize = 6;

/// What of the lenses the last adjustment frees, and what is known of them beforehand.
fn prepare_cameras(block: &mut Block<'_>, georeferenced: bool, args: &Args) -> Result<(), Error> {
    let images = block.registered();
    for camera in &mut block.cameras {
        let names = args.last_free(camera, images >= WHOLE_LENS_FROM);
        camera.set_free(&names).map_err(|e| Error::Argument(format!("--free: {e}")))?;
        if args.camera.is_some() {
            continue;
        }
        let larger = f64::from(camera.interior.size_px()[0].max(camera.interior.size_px()[1]));
        let parameters = camera.interior.parameters();
        for (k, parameter) in parameters.iter().enumerate() {
            camera.standard_deviations[k] = match parameter.name {
                "f_px" | "c_px" if !georeferenced => {
                    // A block without a map has found it better than the files told it, where they did.
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
