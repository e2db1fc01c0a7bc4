//! The stages that compute: orientation of pairs, tracks, growth of blocks.

use super::{Args, cache::Cache, extract::bar, project::Frame};
use crate::{
    camera::{Camera, Lens},
    error::Error,
    features::Descriptors,
    scene::{Pose, Reconstruction, TiePoint},
    sfm::{
        self, Pair,
        block::Block,
        growth::{Event, Growing, reconstruct},
        guided::{Guiding, strengthen},
        relative::{RelativePose, Solver},
        tracks::Tracks,
        verify::{Matched, orient_pairs},
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

/// Orients the pairs.
pub(super) fn verify(
    features: &[sfm::Features],
    cameras: &[Camera],
    descriptors: &[&Descriptors],
    (matched, matched_mark): (&[Matched], u64),
    args: &Args,
    (cache, fresh): (&Cache, bool),
) -> Result<(Vec<Pair>, u64), Error> {
    let (verifying, guiding) = (args.verifying(), Guiding::default());
    let mut mark = Cache::mark().count(matched_mark).text(&format!("{verifying:?} {guiding:?}"));
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
    let before: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    let progress = bar(pairs.len(), "looking again");
    let ways = (&verifying, &guiding);
    let pairs = strengthen(features, descriptors, cameras, &pairs, ways, &|| progress.inc(1));
    progress.finish_and_clear();
    let after: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    tracing::info!("{before} matches, {after} after weak pairs were looked at again");
    cache.save("pairs.cbor", mark, &pairs.iter().map(StoredPair::of).collect::<Vec<_>>())?;
    Ok((pairs, mark))
}

/// Joins what matches, the strongest pairs first.
pub(super) fn tracks<'a>(
    features: &[sfm::Features],
    pairs: impl Iterator<Item = ([u32; 2], &'a [[u32; 2]])>,
) -> Tracks {
    let mut order: Vec<([u32; 2], &[[u32; 2]])> = pairs.collect();
    order.sort_by(|(a, of_a), (b, of_b)| of_b.len().cmp(&of_a.len()).then(a.cmp(b)));
    let counts: Vec<usize> = features.iter().map(|f| f.positions_px.len()).collect();
    Tracks::join(&counts, order.into_iter())
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

/// What a person calls the frame.
pub(super) fn frame_name(frame: &Frame, georeferenced: bool) -> String {
    if georeferenced { frame.name() } else { Frame::Free.name() }
}

/// The middle of the distances over the principal distance: metres on the ground per pixel.
pub(super) fn gsd_m(survey: &Reconstruction) -> f64 {
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
