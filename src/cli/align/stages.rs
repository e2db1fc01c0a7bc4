//! The stages that compute: orientation of pairs, growth of blocks, the map and the adjustment.

use super::{
    Args, Finding,
    cache::Cache,
    extract::bar,
    project::{Frame, Photo, Project, camera_at},
};
use crate::{
    camera::{Camera, Lens},
    error::Error,
    nlls::Loss,
    problems::adjustment::{
        Alignment, Pose, Removed, Role, Settings, Snooping, Survey, TiePoint, snoop,
    },
    sfm::{
        self, Pair,
        block::Block,
        georeference::{Known, adjust, axes_exchanged, join, review_marks, weigh_positions},
        growth::{Event, Growing, reconstruct},
        relative::{RelativePose, Solver},
        tracks::Tracks,
        triangulate::Demands,
        verify::{Matched, orient_pairs, shares_by_principal_distance},
    },
};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

#[derive(Serialize, Deserialize)]
struct StoredPair {
    images: [u32; 2],
    matches: Vec<[u32; 2]>,
    rotation: [f64; 9],
    translation: [f64; 3],
    solver: Solver,
    angle_rad: f64,
}

impl StoredPair {
    fn of(pair: &Pair) -> StoredPair {
        StoredPair {
            images: pair.images,
            matches: pair.matches.clone(),
            rotation: std::array::from_fn(|k| pair.pose.rotation[(k / 3, k % 3)]),
            translation: pair.pose.translation.into(),
            solver: pair.solver,
            angle_rad: pair.angle_rad,
        }
    }

    fn pair(self) -> Pair {
        Pair {
            images: self.images,
            matches: self.matches,
            pose: RelativePose {
                rotation: Matrix3::from_row_slice(&self.rotation),
                translation: Vector3::from(self.translation),
            },
            solver: self.solver,
            angle_rad: self.angle_rad,
        }
    }
}

/// Looks for the principal distance of cameras whose files do not tell it.
pub(super) fn find_principal_distances(
    project: &mut Project,
    features: &[sfm::Features],
    matched: &[Matched],
    args: &Args,
    findings: &mut Vec<Finding>,
) -> Result<(), Error> {
    for camera in 0..project.cameras.len() {
        if project.cameras[camera].1.is_some() {
            continue;
        }
        let mut own: Vec<&Matched> = matched
            .iter()
            .filter(|m| m.images.iter().all(|&k| features[k as usize].camera == camera))
            .collect();
        own.sort_by(|a, b| b.matches.len().cmp(&a.matches.len()).then(a.images.cmp(&b.images)));
        own.truncate(12);
        let own: Vec<Matched> = own.into_iter().cloned().collect();
        let size_px = project.cameras[camera].0.interior.size_px();
        let larger = f64::from(size_px[0].max(size_px[1]));
        let candidates: Vec<f64> = (0..12).map(|k| larger * 0.5 * 1.18f64.powi(k)).collect();
        let shares =
            shares_by_principal_distance(features, &own, size_px, &candidates, &args.verifying());
        let best = (0..shares.len()).max_by(|&a, &b| shares[a].total_cmp(&shares[b])).unwrap_or(0);
        let mut sorted = shares.clone();
        sorted.sort_by(f64::total_cmp);
        // Photos of a plane from above say little: then the usual is as good.
        let telling = shares[best] - sorted[sorted.len() / 2] > 0.02;
        let (entry, source) = &mut project.cameras[camera];
        let c = if telling { candidates[best] } else { entry.interior.principal_distance_px() };
        let mut found = camera_at(&entry.name, entry.interior.model(), size_px, c)?;
        found.standard_deviations[0] = Some(0.3 * c);
        findings.push(Finding::new(
            &found.name,
            &format!(
                "principal distance {c:.0} px to begin with, {}",
                if telling {
                    "which explains most of the matches"
                } else {
                    "for want of anything better"
                }
            ),
        ));
        *entry = found;
        *source = None;
    }
    Ok(())
}

/// Orients the pairs.
pub(super) fn verify(
    features: &[sfm::Features],
    cameras: &[Camera],
    (matched, matched_mark): (&[Matched], u64),
    args: &Args,
    (cache, fresh): (&Cache, bool),
) -> Result<(Vec<Pair>, u64), Error> {
    let verifying = args.verifying();
    let mut mark = Cache::mark().count(matched_mark).text(&format!("{verifying:?}"));
    for camera in cameras {
        mark = mark.text(camera.interior.model().word()).numbers(camera.interior.values());
    }
    let mark = mark.finish();
    if let Some(found) = cache.load::<Vec<StoredPair>>("pairs.cbor", mark).filter(|_| !fresh) {
        return Ok((found.into_iter().map(StoredPair::pair).collect(), mark));
    }
    let progress = bar(matched.len(), "orienting");
    let pairs = orient_pairs(features, cameras, matched, &verifying, &|| progress.inc(1));
    progress.finish_and_clear();
    cache.save("pairs.cbor", mark, &pairs.iter().map(StoredPair::of).collect::<Vec<_>>())?;
    Ok((pairs, mark))
}

/// Joins what matches, the strongest pairs first.
pub(super) fn tracks(features: &[sfm::Features], pairs: &[Pair]) -> Tracks {
    let mut order: Vec<&Pair> = pairs.iter().collect();
    order.sort_by(|a, b| b.matches.len().cmp(&a.matches.len()).then(a.images.cmp(&b.images)));
    let counts: Vec<usize> = features.iter().map(|f| f.positions_px.len()).collect();
    Tracks::join(&counts, order.into_iter().map(|pair| (pair.images, pair.matches.as_slice())))
}

#[derive(Serialize, Deserialize)]
struct StoredBlock {
    cameras: Vec<Vec<f64>>,
    poses: Vec<Option<[f64; 7]>>,
    points: Vec<Option<[f64; 3]>>,
    used: Vec<bool>,
}

/// Grows blocks.
pub(super) fn orient<'a>(
    features: &'a [sfm::Features],
    tracks: &'a Tracks,
    cameras: &[Camera],
    (pairs, pairs_mark): (&[Pair], u64),
    growing: &Growing,
    (cache, fresh): (&Cache, bool),
) -> Result<Vec<Block<'a>>, Error> {
    let mark = Cache::mark().count(pairs_mark).text(&format!("{growing:?}")).finish();
    if let Some(stored) = cache.load::<Vec<StoredBlock>>("blocks.cbor", mark).filter(|_| !fresh) {
        let restored = stored.into_iter().map(|stored| restore(stored, features, tracks, cameras));
        return restored.collect();
    }
    let progress = bar(features.len(), "orienting");
    let mut total = 0;
    let blocks = reconstruct(features, tracks, pairs, cameras, growing, |event| match event {
        Event::Started(triplet) => {
            let names = triplet.images.map(|k| features[k as usize].name.as_str());
            tracing::debug!("a block starts at {}", names.join(", "));
            total += 3;
            progress.set_position(total);
        }
        Event::Joined(image, seen, inliers) => {
            tracing::debug!("{} joins: {inliers} of {seen} points", features[*image].name);
            total += 1;
            progress.set_position(total);
        }
        Event::Left(image) => tracing::debug!("{} leaves again", features[*image].name),
        Event::Adjusted(images, points, rms_px) => {
            tracing::debug!("{images} images, {points} points, {rms_px:.3} px");
        }
    })?;
    progress.finish_and_clear();
    let stored: Vec<StoredBlock> = blocks
        .iter()
        .map(|block| StoredBlock {
            cameras: block.cameras.iter().map(|c| c.interior.values().to_vec()).collect(),
            poses: block
                .poses
                .iter()
                .map(|pose| {
                    pose.map(|p| {
                        let (q, t) = (p.rotation, p.translation);
                        [q[0], q[1], q[2], q[3], t[0], t[1], t[2]]
                    })
                })
                .collect(),
            points: block.points.clone(),
            used: block.used.clone(),
        })
        .collect();
    cache.save("blocks.cbor", mark, &stored)?;
    // What is stored holds every bit, so that a run that goes on from here is the same.
    Ok(blocks)
}

fn restore<'a>(
    stored: StoredBlock,
    features: &'a [sfm::Features],
    tracks: &'a Tracks,
    cameras: &[Camera],
) -> Result<Block<'a>, Error> {
    let mut block = Block::new(features, tracks, cameras);
    for (camera, values) in block.cameras.iter_mut().zip(&stored.cameras) {
        camera.interior = camera
            .interior
            .with_values(values)
            .map_err(|e| Error::Incomplete(format!("a stored camera is damaged: {e}")))?;
    }
    block.poses = stored
        .poses
        .iter()
        .map(|pose| {
            pose.map(|v| Pose {
                rotation: [v[0], v[1], v[2], v[3]],
                translation: [v[4], v[5], v[6]],
            })
        })
        .collect();
    if stored.points.len() == tracks.count() && stored.used.len() == tracks.member_count() {
        block.points = stored.points;
        block.used = stored.used;
    }
    Ok(block)
}

/// The block as it came out.
pub(super) struct Final {
    /// Everything, adjusted.
    pub(super) survey: Survey,
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

/// Points beyond this distance from the block, in heights of flight, are no control of it.
const GROSS: f64 = 5.0;

/// Brings the blocks into the map, makes them one, adjusts it and judges it.
pub(super) fn finish<'a>(
    mut blocks: Vec<Block<'a>>,
    project: &Project,
    args: &Args,
    findings: &mut Vec<Finding>,
) -> Result<Final, Error> {
    let mut known = project.known.clone();
    let demands = |factor: f64| Demands {
        tolerance_px: factor * args.tolerance,
        least_angle_rad: Growing::default().least_angle_rad,
    };
    let mut fragments: Vec<(Vec<String>, bool)> =
        blocks.iter().map(|block| (names(block, &project.photos), false)).collect();
    if let Some(largest) = blocks.first() {
        review(largest, &mut known, project, args, findings);
    }
    let Some(joined) = join(std::mem::take(&mut blocks), &mut known, &demands(3.0)) else {
        return Err(Error::Incomplete(
            "no three photos could be oriented together: look at the matches (rowgram match), or give the camera (--camera)".into(),
        ));
    };
    let mut block = joined.block;
    for (k, alignment) in joined.alignments.iter().enumerate() {
        fragments[k].1 = alignment.is_some() || !joined.georeferenced && k == 0;
        if let Some(alignment) = alignment {
            demote(alignment, &block, &mut known, findings);
        }
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
    let mut sigma_px = 1.0;
    for round in 0..4 {
        if joined.georeferenced && !known.positions.is_empty() {
            let fit = weigh_positions(&block, &mut known, &project.told);
            for (image, distance) in fit.iter().flat_map(|fit| &fit.outliers) {
                findings.push(Finding::new(
                    &project.photos[*image as usize].name,
                    &format!(
                        "its position is {distance:.1} m from where the block puts it: not used"
                    ),
                ));
            }
        }
        let factor: f64 = if round == 0 { 2.0 } else { 1.0 };
        let tolerance = demands(factor.min((6.0 * sigma_px / args.tolerance).max(0.4)));
        adjust(&mut block, &known, sigma_px, &tolerance, 30)?;
        sigma_px = typical_px(&block).max(0.05);
        tracing::debug!(
            "adjusted: {:.3} px, {} points",
            sigma_px,
            block.points.iter().flatten().count()
        );
    }
    let (mut survey, _, order) = block.survey(None);
    known.attach(&mut survey, &order);
    survey.tie_sigma_px = sigma_px;
    let checks = survey
        .ground
        .iter()
        .filter(|point| point.role == Role::Check)
        .filter(|point| {
            project.known.ground.iter().any(|p| p.name == point.name && p.role == Role::Check)
        })
        .map(|point| point.name.clone())
        .collect();
    let settings = Settings { tie_loss: Loss::SoftL1(2.0), ..Settings::default() };
    let snooping = Snooping { rounds: 8, ..Snooping::default() };
    let snooped = snoop(&mut survey, &settings, &snooping)?;
    for removed in &snooped.removed {
        if removed.group != crate::problems::adjustment::Group::TiePoints {
            findings.push(Finding::new(
                &removed.name,
                &format!(
                    "not consistent with the block ({:.1} times the critical value, {:.3} {:.3} {:.3} off): taken out",
                    removed.excess, removed.residual[0], removed.residual[1], removed.residual[2]
                ),
            ));
        }
    }
    Ok(Final {
        survey,
        adjusted: snooped.adjusted,
        settings: Settings::default(),
        alignment: joined.alignments.into_iter().flatten().next(),
        removed: snooped.removed,
        complete: snooped.complete,
        georeferenced: joined.georeferenced,
        fragments,
        checks,
    })
}

fn names(block: &Block<'_>, photos: &[Photo]) -> Vec<String> {
    let of = block.poses.iter().zip(photos).filter(|(pose, _)| pose.is_some());
    of.map(|(_, photo)| photo.name.clone()).collect()
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
    let mut scales = vec![0.25, 0.5, 2.0, 4.0];
    for photo in &project.photos {
        if let Some([width, _]) = photo.metadata.written_size_px {
            let scale = f64::from(photo.size_px[0]) / f64::from(width);
            if (scale - 1.0).abs() > 0.01 && !scales.iter().any(|s| (s - scale).abs() < 0.01) {
                scales.push(scale);
            }
        }
    }
    // A free block is bent, but not within the few photos of one point.
    let demands = Demands { tolerance_px: 3.0 * args.tolerance, least_angle_rad: 0.01 };
    let review = review_marks(block, known, &scales, &demands);
    if review.scale != 1.0 {
        findings.push(Finding::new(
            "marks",
            &format!(
                "they fit the photos only when multiplied by {}: they were made in resized images, and were converted",
                review.scale
            ),
        ));
    }
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
        findings.push(Finding::new(&format!("mark of {point} in {image}"), &what));
    }
    if axes_exchanged(block, known) {
        known.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
        findings.push(Finding::new(
            "control points",
            "X and Y are exchanged: as given they would turn the block upside down; taken the other way round",
        ));
    }
}

/// Control that is grossly off does not take part in what follows.
fn demote(
    alignment: &Alignment,
    block: &Block<'_>,
    known: &mut Known,
    findings: &mut Vec<Finding>,
) {
    if alignment.by != "control points" {
        return;
    }
    let height = typical_height_m(block);
    for (name, left) in &alignment.misfits {
        if *left < GROSS * alignment.rmse_m.max(0.002 * height) {
            continue;
        }
        if let Some(point) = known.ground.iter_mut().find(|point| point.name == *name) {
            point.role = Role::Check;
            findings.push(Finding::new(
                &format!("control point {name}"),
                &format!("its coordinates are {left:.2} m from where the others put it: not used as control"),
            ));
        }
    }
}

/// The median distance of points from the cameras that see them, metres.
fn typical_height_m(block: &Block<'_>) -> f64 {
    let mut depths = Vec::new();
    for track in (0..block.tracks.count()).step_by(7) {
        let Some(point) = block.points[track] else { continue };
        for member in block.tracks.of(track) {
            if let Some(pose) = &block.poses[member.image as usize] {
                depths.push(-pose.to_camera(point)[2]);
            }
        }
    }
    depths.sort_by(f64::total_cmp);
    depths.get(depths.len() / 2).copied().unwrap_or(1.0)
}

/// The robust standard deviation of an image coordinate, pixels.
fn typical_px(block: &Block<'_>) -> f64 {
    let mut errors = Vec::new();
    for track in 0..block.tracks.count() {
        let Some(point) = block.points[track] else { continue };
        for place in block.tracks.places(track) {
            let image = block.tracks.member(place).image as usize;
            if let (true, Some(pose)) = (block.used[place], &block.poses[image])
                && let Some([u, v]) = block.lens(image).project(pose.to_camera(point))
            {
                let at = block.position_px(place);
                errors.push((u - at[0]).hypot(v - at[1]));
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    errors.get(errors.len() / 2).map_or(1.0, |median| median / 1.1774)
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
                    Some(0.1 * camera.interior.principal_distance_px())
                }
                "cx_px" | "cy_px" | "xp_px" | "yp_px" => Some(0.02 * larger),
                _ => None,
            };
        }
    }
    Ok(())
}

/// What a person calls the frame.
pub(super) fn frame_name(frame: &Frame, georeferenced: bool) -> String {
    if georeferenced { frame.name() } else { Frame::Free.name() }
}

/// The middle of the distances over the principal distance: metres on the ground per pixel.
pub(super) fn gsd_m(survey: &Survey) -> f64 {
    let points: &[TiePoint] = &survey.points;
    let mut all: Vec<f64> = survey
        .observations
        .iter()
        .step_by(5)
        .map(|o| {
            let image = &survey.images[o.image as usize];
            let c = survey.cameras[image.camera].interior.principal_distance_px();
            -image.pose.to_camera(points[o.point as usize].position_m)[2] / c
        })
        .collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(0.0)
}
