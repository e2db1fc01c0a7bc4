//! Matches once more, by a block that is adjusted: its lenses, poses and surface are known far better than those of
//! any two photos were, so what two photos show together is found where it must lie, in all pairs that overlap.
//!
//! Matches that were found under the first guess of a lens are those that this lens allows, which pulls the
//! adjusted one towards it; these are not.
//!
//! ```text
//! u2(d) = pi(R2 (C1 + d r1) + t2),   d = depths of the surface around the feature in the first photo
//! ```

use super::{
    block::Block,
    epipolar_rematching::{
        BUCKET, Buckets, CONTEXT_PX, Reach, SAME_PX, Seen, compete, distance, in_parts, join,
    },
    relative::Ray,
    verify::PairMatches,
};
use crate::{camera::Lens, features::DescriptorSource};
use rayon::prelude::*;
use rowgram_optim::geometry::rotation;

/// Distance from its piece of line up to which a feature may match, pixels.
const TOLERANCE_PX: f64 = 4.0;
/// A pair overlaps where it shows at least this share of a photo's points together.
const MIN_OVERLAP: f64 = 0.2;
/// Cells along each side of a photo in which its depths are gathered.
const CELLS: usize = 8;
/// Fewer points than this around a cell do not tell its depths.
const FEW: usize = 12;
/// Depths are believed this far beyond those seen, as a share of their range, and of themselves.
const BEYOND: [f64; 2] = [0.25, 0.005];
/// Points of a photo by which overlap is judged.
const SAMPLE: usize = 60;

/// The surface as one photo sees it.
struct Surface {
    /// Inverse depths, from and to, of the cells.
    cells: Vec<[f64; 2]>,
    size_px: [f64; 2],
    /// Some of its points, in the world.
    sample: Vec<[f64; 3]>,
}

/// From the second to the last but second of a hundred values, and a little further on either side.
fn range(inverse: &mut [f64]) -> [f64; 2] {
    inverse.sort_by(f64::total_cmp);
    let cut = inverse.len() / 50;
    let (low, high) = (inverse[cut], inverse[inverse.len() - 1 - cut]);
    let beyond = BEYOND[0] * (high - low) + BEYOND[1] * high;
    [(low - beyond).max(0.5 * low), high + beyond]
}

impl Surface {
    fn of(block: &Block<'_>, image: usize) -> Option<Surface> {
        let pose = block.poses[image]?;
        let size_px = block.lens(image).size_px().map(f64::from);
        let mut of_cells: Vec<Vec<f64>> = vec![Vec::new(); CELLS * CELLS];
        let mut points = Vec::new();
        for &(track, place) in block.tracks.in_image(image) {
            let Some(point) = block.points[track as usize] else { continue };
            let depth = -pose.to_camera(point)[2];
            if block.used[place as usize] && depth > 0.0 {
                of_cells[cell(size_px, block.position_px(place as usize))].push(1.0 / depth);
                points.push(point);
            }
        }
        if points.len() < FEW {
            return None;
        }
        let whole = range(&mut of_cells.concat());
        let cells = (0..CELLS * CELLS)
            .map(|at| {
                let (i, j) = (at % CELLS, at / CELLS);
                let near = |k: usize| k.saturating_sub(1)..=(k + 1).min(CELLS - 1);
                let mut around: Vec<f64> = near(j)
                    .flat_map(|j| near(i).map(move |i| i + CELLS * j))
                    .flat_map(|at| of_cells[at].iter().copied())
                    .collect();
                if around.len() < FEW { whole } else { range(&mut around) }
            })
            .collect();
        let step = points.len().div_ceil(SAMPLE);
        Some(Surface { cells, size_px, sample: points.into_iter().step_by(step).collect() })
    }
}

fn cell(size_px: [f64; 2], at_px: [f64; 2]) -> usize {
    let [i, j] = std::array::from_fn(|k| {
        let share = (at_px[k] + 0.5) / size_px[k];
        ((share * CELLS as f64).max(0.0) as usize).min(CELLS - 1)
    });
    i + CELLS * j
}

/// Where an image has a point, in pixels, by the row that it is in while it is read.
pub(super) fn seen_at(block: &Block<'_>, image: usize, point: [f64; 3]) -> Option<[f64; 2]> {
    let at = block.lens(image).project(block.poses[image]?.to_camera(point))?;
    read_at(block, image, point, at)
}

/// The same, found faster where that is near `near_px`.
pub(super) fn seen_near(
    block: &Block<'_>,
    image: usize,
    point: [f64; 3],
    near_px: [f64; 2],
) -> Option<[f64; 2]> {
    let at = block.lens(image).project_near(block.poses[image]?.to_camera(point), near_px)?;
    read_at(block, image, point, at)
}

/// Where a point is in the row that is read when it is there; `at_px` in the middle one.
fn read_at(
    block: &Block<'_>,
    image: usize,
    point: [f64; 3],
    mut at_px: [f64; 2],
) -> Option<[f64; 2]> {
    if block.shutter.is_some() {
        for _ in 0..2 {
            let seen = block.pose_at(image, at_px[1])?.to_camera(point);
            at_px = block.lens(image).project_near(seen, at_px)?;
        }
    }
    Some(at_px)
}

/// Pairs of images that show the same.
fn overlapping(block: &Block<'_>, surfaces: &[Option<Surface>]) -> Vec<[u32; 2]> {
    let share = |of: &Surface, other: usize| {
        let [width, height] = block.lens(other).size_px().map(f64::from);
        let inside = |point: &&[f64; 3]| {
            seen_at(block, other, **point)
                .is_some_and(|[u, v]| u >= 0.0 && v >= 0.0 && u < width && v < height)
        };
        of.sample.iter().filter(inside).count() as f64 / of.sample.len() as f64
    };
    (0..surfaces.len())
        .into_par_iter()
        .flat_map_iter(|a| {
            let others = a + 1..surfaces.len();
            others
                .filter(move |&b| {
                    let (Some(first), Some(second)) = (&surfaces[a], &surfaces[b]) else {
                        return false;
                    };
                    share(first, b).min(share(second, a)) >= MIN_OVERLAP
                })
                .map(move |b| [a as u32, b as u32])
        })
        .collect()
}

/// The matches of all pairs of a block that overlap: descriptor matches (`matched`, by images) that lie where they must,
/// and what only the block tells; `tell` is called for each pair with how many there are.
pub fn match_guided(
    block: &Block<'_>,
    descriptors: &dyn DescriptorSource,
    matched: &[PairMatches],
    tell: &(dyn Fn(usize) + Sync),
) -> Vec<PairMatches> {
    let images = 0..block.poses.len();
    let surfaces: Vec<Option<Surface>> =
        images.clone().into_par_iter().map(|image| Surface::of(block, image)).collect();
    let places: Vec<Vec<Option<Ray>>> = block
        .features
        .par_iter()
        .map(|of| of.positions_px.iter().copied().map(Some).collect())
        .collect();
    let buckets: Vec<Buckets> =
        places.par_iter().map(|places| Buckets::new(places, BUCKET * CONTEXT_PX)).collect();
    let pairs = overlapping(block, &surfaces);
    let reach = Reach { tolerance: TOLERANCE_PX, context: CONTEXT_PX, same: SAME_PX };
    let total = pairs.len();
    in_parts(&pairs, |&images| {
        let [a, b] = images.map(|k| k as usize);
        let looks = [a, b].map(|k| descriptors.descriptors(k));
        let piece = |index: usize| {
            let surface = surfaces[a].as_ref()?;
            let at = block.features[a].positions_px[index];
            let [low, high] = surface.cells[cell(surface.size_px, at)];
            let pose = block.pose_at(a, at[1])?;
            let d = block.lens(a).unproject(at)?;
            if d[2] > -1e-3 {
                return None;
            }
            let back = rotation::rotate(rotation::inverse(pose.rotation), d);
            let centre = pose.centre_m();
            let [from, to] = [high, low].map(|inverse| {
                let along = 1.0 / (inverse * -d[2]);
                seen_at(block, b, std::array::from_fn(|k| centre[k] + along * back[k]))
            });
            Some([from?, to?])
        };
        let second = Seen { rays: &places[b], descriptors: &looks[1] };
        let mut matches: Vec<[u32; 2]> = matched
            .binary_search_by_key(&images, |matched| matched.images)
            .map_or(&[][..], |at| matched[at].matches.as_slice())
            .iter()
            .filter(|[i, j]| {
                let at = block.features[b].positions_px[*j as usize];
                piece(*i as usize).is_some_and(|piece| distance(piece, at) <= reach.tolerance)
            })
            .copied()
            .collect();
        let more = compete(&looks[0], second, &buckets[b], &piece, &reach);
        join(&mut matches, &more);
        tell(total);
        PairMatches { images, matches }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, Interior, Model},
        features::{DESCRIPTOR_LENGTH, Descriptors},
        scene::{Pose, RollingShutter},
        sfm::{Features, tracks::Tracks},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use std::sync::Arc;

    const POINTS: usize = 1500;
    const IMAGES: usize = 4;

    /// What every image has of the plants, its descriptors, and what was matched at first: a few of each pair.
    struct Flight {
        cameras: Vec<Camera>,
        poses: Vec<Pose>,
        motions: Vec<[f64; 6]>,
        features: Vec<Features>,
        /// Which plant each feature is.
        plants: Vec<Vec<usize>>,
        looks: Vec<Descriptors>,
    }

    /// Four photos along a strip over plants of thirty kinds, read row by row.
    fn flight() -> Flight {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let values = [800.0, 1.0, 499.5, 374.5, -0.08, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let interior = Interior::new(Model::Brown, [1000, 750], &values).unwrap();
        let cameras = vec![Camera::new("drone", interior)];
        let poses: Vec<Pose> = (0..IMAGES)
            .map(|k| {
                let tilt = 0.02 * (k as f64 - 1.5);
                let rotation = rotation::exp([tilt, -0.5 * tilt, 0.1]);
                let centre = [4.0 * k as f64, 0.3 * tilt, 15.0];
                let turned = rotation::rotate(rotation, centre);
                Pose { rotation, translation: turned.map(|v| -v) }
            })
            .collect();
        // To and fro: photos that all fly one way hardly show that they do.
        let motions: Vec<[f64; 6]> = (0..IMAGES)
            .map(|k| [0.0, 0.0, 0.0, if k % 2 == 0 { -0.5 } else { 0.5 }, 0.02, 0.0])
            .collect();
        let ground: Vec<[f64; 3]> = (0..POINTS)
            .map(|_| {
                let (x, y) = (rng.random_range(-9.0..21.0), rng.random_range(-8.0..8.0));
                [x, y, 0.05 * x + rng.random_range(-0.1..0.1)]
            })
            .collect();
        let kinds: Vec<Vec<u8>> = (0..30)
            .map(|_| (0..DESCRIPTOR_LENGTH).map(|_| rng.random_range(0..64)).collect())
            .collect();
        let mut all =
            Flight { cameras, poses, motions, features: vec![], plants: vec![], looks: vec![] };
        let none = Tracks::default();
        let empty = vec![Features::default(); IMAGES];
        let mut block = Block::new(&empty, &none, &all.cameras);
        block.poses = all.poses.iter().copied().map(Some).collect();
        block.motions.clone_from(&all.motions);
        block.shutter = Some(SHUTTER);
        for image in 0..IMAGES {
            let (mut features, mut plants, mut looks) = (Features::default(), vec![], vec![]);
            for (plant, &point) in ground.iter().enumerate() {
                let Some([u, v]) = seen_at(&block, image, point) else { continue };
                if u < 0.0 || v < 0.0 || u > 999.0 || v > 749.0 {
                    continue;
                }
                let mut noise = || rng.random_range(-0.3..0.3);
                features.positions_px.push([u + noise(), v + noise()]);
                plants.push(plant);
                looks.extend(kinds[plant % 30].iter().map(|byte| byte + rng.random_range(0..16u8)));
            }
            all.features.push(features);
            all.plants.push(plants);
            all.looks.push(Descriptors::from_bytes(looks).unwrap());
        }
        all
    }

    const SHUTTER: RollingShutter = RollingShutter { readout_s: 0.03, sigma_velocity_m_s: 1.0 };

    impl Flight {
        /// The matches that are right, every `step`-th of them.
        fn right(&self, step: usize) -> Vec<PairMatches> {
            let of = |a: usize, b: usize| {
                let all = self.plants[a].iter().enumerate().filter_map(|(i, plant)| {
                    let j = self.plants[b].iter().position(|other| other == plant)?;
                    Some([i as u32, j as u32])
                });
                all.step_by(step).collect()
            };
            let pairs = (0..IMAGES).flat_map(|a| (a + 1..IMAGES).map(move |b| (a, b)));
            pairs
                .map(|(a, b)| PairMatches { images: [a as u32, b as u32], matches: of(a, b) })
                .collect()
        }
    }

    #[test]
    fn a_block_of_few_matches_finds_the_others_through_its_lens_and_shutter() {
        let flight = flight();
        let few = flight.right(7);
        let counts: Vec<usize> = flight.features.iter().map(|f| f.positions_px.len()).collect();
        let tracks =
            Tracks::join(&counts, few.iter().map(|pair| (pair.images, pair.matches.as_slice())));
        let mut block = Block::new(&flight.features, &tracks, &flight.cameras);
        block.poses = flight.poses.iter().copied().map(Some).collect();
        block.motions.clone_from(&flight.motions);
        block.shutter = Some(SHUTTER);
        let demands = super::super::triangulate::TriangulationOptions {
            tolerance_px: 2.0,
            min_angle_rad: 0.02,
        };
        let all = block.all_tracks();
        assert!(block.retriangulate(&all, &demands) > 100);
        let looks: Vec<Arc<Descriptors>> = flight.looks.iter().cloned().map(Arc::new).collect();
        // A wrong descriptor match does not come back, and a right one does.
        let far = |k: usize| [few[0].matches[k][0], few[0].matches[k + 20][1]];
        let mut matched = few.clone();
        matched[0].matches = vec![few[0].matches[0], far(1)];
        let found = match_guided(&block, &looks, &matched, &|_| ());
        assert!(found[0].matches.contains(&few[0].matches[0]));
        assert!(!found[0].matches.contains(&far(1)));
        let every = flight.right(1);
        for pair in &found {
            let truth = &every.iter().find(|all| all.images == pair.images).unwrap().matches;
            let right = pair.matches.iter().filter(|m| truth.contains(m)).count();
            assert!(10 * right > 7 * truth.len(), "{:?}: {right} of {}", pair.images, truth.len());
            assert!(50 * right > 49 * pair.matches.len(), "{:?}", pair.images);
            for side in 0..2 {
                let mut own: Vec<u32> = pair.matches.iter().map(|m| m[side]).collect();
                own.sort_unstable();
                own.dedup();
                assert_eq!(own.len(), pair.matches.len(), "no feature is in two matches");
            }
        }
        // The first and the last photo show a fifth of their plants together, or are no pair.
        assert!(found.len() >= 5 && found.is_sorted_by_key(|pair| pair.images));
        // Without the shutter up to 27 pixels are missing.
        block.shutter = None;
        let blind: usize =
            match_guided(&block, &looks, &[], &|_| ()).iter().map(|p| p.matches.len()).sum();
        let seen: usize = found.iter().map(|pair| pair.matches.len()).sum();
        assert!(3 * blind < 2 * seen, "{blind} {seen}");
        // An image that has no pose takes no part.
        block.poses[0] = None;
        let rest = match_guided(&block, &looks, &[], &|_| ());
        assert!(!rest.is_empty() && rest.iter().all(|pair| pair.images[0] > 0));
    }
}
