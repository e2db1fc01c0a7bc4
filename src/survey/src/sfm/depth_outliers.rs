//! Points that stand alone. Where a wrong match lies on the epipolar line its two rays meet as well as right ones do:
//! no residual shows it. But they meet above or below the surface that all others around show, and a lens learns
//! its principal distance from just such differences of depth, so that a few dozen among ten thousands of points
//! bend a whole block.
//!
//! ```text
//! |q - median(q_1 .. q_16)| > 5 s     s = 1.4826 median|q_k - median|,   q = 1/depth, of the nearest in the image
//! ```
//!
//! Inverse depths, as a plane's are linear in the image. What is narrow and tall has several points that bear each
//! other out, and a third ray bears out any.

use super::{block::Block, epipolar_rematching::Buckets, relative::Ray};
use rayon::prelude::*;
use rowgram_optim::robust;

/// The neighbours that a point is compared with.
const NEIGHBOURS: usize = 16;
/// Robust standard deviations of their inverse depths by which it must differ from them.
const FAR: f64 = 5.0;
/// As many of them bear it out whose depths are nearer to its own than to the middle.
const WITNESSES: usize = 2;
/// The least spread of neighbours, as a share of that which is usual in the image: a few may lie in a plane by chance.
const LEAST: f64 = 0.5;

/// A point in an image and those around it.
struct Place {
    track: u32,
    /// Its own inverse depth.
    own: f64,
    /// Those of its neighbours.
    around: [f64; NEIGHBOURS],
    median: f64,
    spread: f64,
}

impl Place {
    fn new(track: u32, own: f64, around: [f64; NEIGHBOURS]) -> Place {
        let median = |values: &mut [f64; NEIGHBOURS]| {
            values.sort_by(f64::total_cmp);
            0.5 * (values[NEIGHBOURS / 2 - 1] + values[NEIGHBOURS / 2])
        };
        let middle = median(&mut around.clone());
        let spread = robust::NORMAL_MAD_RATIO * median(&mut around.map(|q| (q - middle).abs()));
        Place { track, own, around, median: middle, spread }
    }

    fn stands_alone(&self, least: f64) -> bool {
        let off = (self.own - self.median).abs();
        let beside = |q: &&f64| (**q - self.own).abs() < 0.5 * off;
        off > FAR * self.spread.max(least) && self.around.iter().filter(beside).count() < WITNESSES
    }
}

/// Takes the points out of a block that two rays only make and that stand alone in both images; how many.
/// They come back when tracks are gone through again.
pub fn remove_depth_outliers(block: &mut Block<'_>) -> usize {
    let images = 0..block.poses.len();
    let alone: Vec<Vec<u32>> = images.into_par_iter().map(|image| alone_in(block, image)).collect();
    let mut against = vec![0_u8; block.tracks.count()];
    alone.iter().flatten().for_each(|&track| against[track as usize] += 1);
    let mut count = 0;
    for (track, _) in against.iter().enumerate().filter(|(_, against)| **against == 2) {
        block.points[track] = None;
        block.used[block.tracks.places(track)].fill(false);
        count += 1;
    }
    count
}

/// The tracks of two rays that stand alone in an image.
fn alone_in(block: &Block<'_>, image: usize) -> Vec<u32> {
    let Some(pose) = block.poses[image] else { return Vec::new() };
    let mut tracks = Vec::new();
    let mut places: Vec<Option<Ray>> = Vec::new();
    let mut inverse = Vec::new();
    for &(track, place) in block.tracks.in_image(image) {
        let Some(point) = block.points[track as usize] else { continue };
        let depth = -pose.to_camera(point)[2];
        if block.used[place as usize] && depth > 0.0 {
            tracks.push(track);
            places.push(Some(block.position_px(place as usize)));
            inverse.push(1.0 / depth);
        }
    }
    if places.len() <= NEIGHBOURS {
        return Vec::new();
    }
    let reach = reach(&places);
    let buckets = Buckets::new(&places, reach);
    let two_rays = |index: &usize| block.rays(tracks[*index] as usize) == 2;
    let mut near = Vec::new();
    let found: Vec<Place> = (0..tracks.len())
        .filter(two_rays)
        .filter_map(|index| {
            let around = neighbours(&places, &buckets, index, reach, &mut near)?;
            Some(Place::new(tracks[index], inverse[index], around.map(|k| inverse[k as usize])))
        })
        .collect();
    let least = LEAST * robust::median(found.iter().map(|place| place.spread)).unwrap_or(0.0);
    let alone = found.iter().filter(|place| place.stands_alone(least));
    alone.map(|place| place.track).collect()
}

/// How far it is to the sixteenth neighbour, or so.
fn reach(places: &[Option<Ray>]) -> f64 {
    let side = |k: usize| {
        let along = places.iter().flatten().map(|at| at[k]);
        along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
    };
    let area = side(0).max(1.0) * side(1).max(1.0);
    (1.5 * NEIGHBOURS as f64 * area / (std::f64::consts::PI * places.len() as f64)).sqrt()
}

/// The nearest in the image, itself left out.
fn neighbours(
    places: &[Option<Ray>],
    buckets: &Buckets,
    index: usize,
    mut reach: f64,
    near: &mut Vec<(f64, u32)>,
) -> Option<[u32; NEIGHBOURS]> {
    let at = places[index]?;
    // Four times as far there are enough almost anywhere; who has none so near has no neighbourhood.
    for _ in 0..3 {
        near.clear();
        buckets.near([at, at], reach, |other| {
            if let (Some(place), true) = (places[other as usize], other as usize != index) {
                let (x, y) = (place[0] - at[0], place[1] - at[1]);
                let square = x * x + y * y;
                if square <= reach * reach {
                    near.push((square, other));
                }
            }
        });
        if near.len() >= NEIGHBOURS {
            near.select_nth_unstable_by(NEIGHBOURS - 1, |a, b| {
                a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
            });
            return Some(std::array::from_fn(|k| near[k].1));
        }
        reach *= 2.0;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, Interior, Lens, Model},
        scene::Pose,
        sfm::{Features, tracks::Tracks},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rowgram_optim::geometry::rotation;

    /// Points that three photos see from 15 m, each by those that are named.
    fn block<'a>(
        points: &[([f64; 3], &[u32])],
        features: &'a mut Vec<Features>,
        tracks: &'a mut Tracks,
        cameras: &[Camera],
    ) -> Block<'a> {
        let poses: Vec<Pose> = (0..3)
            .map(|k| {
                let rotation = rotation::exp([0.02, 0.0, 0.1]);
                let turned = rotation::rotate(rotation, [4.0 * f64::from(k), 0.0, 15.0]);
                Pose { rotation, translation: turned.map(|v| -v) }
            })
            .collect();
        let lens = &cameras[0].interior;
        *features = vec![Features::default(); 3];
        let mut matches = [([0, 1], vec![]), ([1, 2], vec![])];
        for (point, images) in points {
            let mut places = [None; 3];
            for &image in *images {
                let of = &mut features[image as usize].positions_px;
                places[image as usize] = Some(of.len() as u32);
                of.push(lens.project(poses[image as usize].to_camera(*point)).unwrap());
            }
            for (pair, matches) in &mut matches {
                if let [Some(a), Some(b)] = pair.map(|image| places[image as usize]) {
                    matches.push([a, b]);
                }
            }
        }
        let counts: Vec<usize> = features.iter().map(|of| of.positions_px.len()).collect();
        *tracks = Tracks::join(&counts, matches.iter().map(|(pair, all)| (*pair, all.as_slice())));
        let mut block = Block::new(features, tracks, cameras);
        block.poses = poses.into_iter().map(Some).collect();
        for (point, images) in points {
            let at = lens.project(block.poses[1].unwrap().to_camera(*point)).unwrap();
            assert!(images.contains(&1));
            let track = (0..tracks.count())
                .find(|&track| {
                    tracks.of(track).iter().any(|member| {
                        member.image == 1
                            && block.features[1].positions_px[member.feature as usize] == at
                    })
                })
                .unwrap();
            block.points[track] = Some(*point);
            block.used[tracks.places(track)].fill(true);
        }
        block
    }

    #[test]
    fn what_stands_alone_goes_and_what_is_borne_out_stays() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let values = [800.0, 1.0, 499.5, 374.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let cameras =
            [Camera::new("drone", Interior::new(Model::Brown, [1000, 750], &values).unwrap())];
        // A slope with stones.
        let mut surface = |x: f64, y: f64| [x, y, 0.1 * x + rng.random_range(-0.03..0.03)];
        let mut points: Vec<([f64; 3], &[u32])> = (0..500)
            .map(|k| {
                (surface(0.3 * f64::from(k % 25), 0.35 * f64::from(k / 25) - 3.5), &[0, 1][..])
            })
            .collect();
        // A mast of three points, a bird that three photos see, and three wrong matches.
        for height in [2.0, 2.05, 2.1] {
            points.push(([2.0, 0.3 + 0.1 * height, height], &[0, 1]));
        }
        points.push(([5.0, 2.0, 3.0], &[0, 1, 2]));
        let wrong = [[1.0, -2.0, 1.5], [3.0, 2.0, -1.5], [6.0, -1.0, 2.5]];
        points.extend(wrong.iter().map(|&point| (point, &[0, 1][..])));
        let (mut features, mut tracks) = (Vec::new(), Tracks::default());
        let mut block = block(&points, &mut features, &mut tracks, &cameras);
        assert_eq!(block.points.iter().flatten().count(), 507);
        assert_eq!(remove_depth_outliers(&mut block), 3);
        let left: Vec<[f64; 3]> = block.points.iter().flatten().copied().collect();
        assert!(wrong.iter().all(|point| !left.contains(point)));
        assert_eq!(left.len(), 504);
        for (track, point) in block.points.iter().enumerate() {
            let used = block.tracks.places(track).all(|place| block.used[place]);
            assert_eq!(used, point.is_some());
        }
        assert_eq!(remove_depth_outliers(&mut block), 0, "once is enough");
    }
}
