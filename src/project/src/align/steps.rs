//! The steps that compute, with what they keep: lenses to start with, orientation of pairs, blocks.

use super::{AlignOptions, Step, features::FEATURES, inputs::Inputs, matches};
use crate::record::{Key, Store};
use nalgebra::{Matrix3, Vector3};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_survey::{
    camera::{Camera, Lens},
    features::DescriptorSource,
    scene::Pose,
    sfm::{
        self, Block, Pair,
        epipolar_rematching::rematch_weak_pairs,
        incremental::{Event, IncrementalOptions, reconstruct},
        intrinsics::{InitialIntrinsics, initialize_intrinsics},
        relative::{RelativePose, Solver},
        tracks::Tracks,
        verify::{GeometricVerificationOptions, PairMatches, orient_pairs},
    },
};
use serde::{Deserialize, Serialize};

const LENSES: &str = "lenses";
const PAIRS: &str = "pairs";
const BLOCKS: &str = "blocks";

/// What is kept of every step.
pub(super) const KEPT: [(Step, &str); 6] = [
    (Step::Features, FEATURES),
    (Step::Match, matches::MATCHES),
    (Step::Match, matches::PARTS),
    (Step::Verify, LENSES),
    (Step::Verify, PAIRS),
    (Step::Orient, BLOCKS),
];

/// Gives every camera that was not calibrated a lens to start with.
///
/// # Errors
/// Where what was found cannot be kept.
pub(super) fn intrinsics(
    inputs: &mut Inputs,
    features: &[sfm::Features],
    (matched, matched_key): (&[PairMatches], Key),
    options: &AlignOptions,
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    if inputs.calibrated {
        return Ok(());
    }
    let verification = options.verification();
    let mut key =
        Key::begin().key(matched_key).text(&format!("{verification:?} {:?}", options.lens));
    for (camera, _) in &inputs.cameras {
        key = key.text(camera.interior.model().word()).numbers(camera.interior.values());
    }
    let key = key.finish();
    let wrong = |camera: &Camera, why: rowgram_survey::camera::CameraError| {
        Error::Incomplete(format!("camera {}: {why}", camera.name))
    };
    let kept = store.load::<Vec<InitialIntrinsics>>(LENSES, key);
    let found = match kept.filter(|kept| kept.len() == inputs.cameras.len()) {
        Some(found) => found,
        None => {
            let all = inputs.cameras.iter().enumerate();
            let found: Vec<InitialIntrinsics> = all
                .map(|(k, (camera, source))| {
                    let how = (&verification, options.lens);
                    initialize_intrinsics((camera, k), source.is_some(), features, matched, how)
                        .map_err(|why| wrong(camera, why))
                })
                .collect::<Result<_, Error>>()?;
            store.save(LENSES, key, &found)?;
            found
        }
    };
    for ((camera, _), found) in inputs.cameras.iter_mut().zip(found) {
        found.apply(camera).map_err(|why| wrong(camera, why))?;
        for note in found.notes {
            monitor.diagnostic(&Diagnostic::info("initial-lens", camera.name.as_str(), note));
        }
    }
    Ok(())
}

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
    (features, cameras, descriptors): (&[sfm::Features], &[Camera], &dyn DescriptorSource),
    (matched, matched_key): (&[PairMatches], Key),
    verification: &GeometricVerificationOptions,
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<(Vec<Pair>, Key), Error> {
    let mut key = Key::begin().key(matched_key).text(&format!("{verification:?}"));
    for camera in cameras {
        key = key.text(camera.interior.model().word()).numbers(camera.interior.values());
    }
    let key = key.finish();
    if let Some(found) = store.load::<Vec<StoredPair>>(PAIRS, key) {
        return Ok((found.into_iter().map(StoredPair::pair).collect(), key));
    }
    let counter = Counter::new(monitor, "orienting pairs", matched.len(), "pairs");
    let pairs = orient_pairs(features, cameras, matched, verification, &|| counter.tick());
    let counter = Counter::new(monitor, "rematching weak pairs", pairs.len(), "pairs");
    let pairs = rematch_weak_pairs(features, descriptors, cameras, &pairs, verification, &|| {
        counter.tick()
    });
    store.save(PAIRS, key, &pairs.iter().map(StoredPair::of).collect::<Vec<_>>())?;
    Ok((pairs, key))
}

#[derive(Serialize, Deserialize)]
struct StoredBlock {
    cameras: Vec<Vec<f64>>,
    poses: Vec<Option<[f64; 7]>>,
    points: Vec<Option<[f64; 3]>>,
    used: Vec<bool>,
}

/// Orients the images.
pub(super) fn orient<'a>(
    (features, tracks, cameras): (&'a [sfm::Features], &'a Tracks, &[Camera]),
    (pairs, tracks_key): (&[Pair], Key),
    incremental: &IncrementalOptions,
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<Vec<Block<'a>>, Error> {
    let key = Key::begin().key(tracks_key).text(&format!("{incremental:?}")).finish();
    if let Some(stored) = store.load::<Vec<StoredBlock>>(BLOCKS, key) {
        let restored = stored.into_iter().map(|stored| restore(stored, features, tracks, cameras));
        return restored.collect();
    }
    let counter = Counter::new(monitor, "orienting photos", features.len(), "photos");
    let blocks = reconstruct(features, tracks, pairs, cameras, incremental, |event| match event {
        Event::Started(triplet) => {
            let names = triplet.images.map(|k| features[k as usize].name.as_str());
            tracing::debug!("a block starts at {}", names.join(", "));
            (0..3).for_each(|_| counter.tick());
        }
        Event::Joined(image, seen, inliers) => {
            tracing::debug!("{} joins: {inliers} of {seen} points", features[*image].name);
            counter.tick();
        }
        Event::Left(image) => tracing::debug!("{} leaves again", features[*image].name),
        Event::Adjusted(images, points, rms_px) => {
            tracing::debug!("{images} images, {points} points, {rms_px:.3} px");
        }
    })?;
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
    store.save(BLOCKS, key, &stored)?;
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
