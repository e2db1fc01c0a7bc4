//! Tie points measured again: a key point is where its own photo has a blob, which is not quite the same place in
//! another. With a block that is adjusted it is known how the surroundings of a point look in every photo; there
//! they are found by least-squares matching, several times as exactly.
//!
//! ```text
//! u_2(p) = pi_2(R_2 X(p) + t_2),   X(p): where the ray of pixel p of the first photo meets the plane through the point
//! ```
//!
//! The first photo of a point is the one that has it nearest to its middle. It has it at a whole pixel: which place
//! on the ground a point stands for is free to choose, and there nothing is interpolated.

use super::{
    Features, block::Block, epipolar_rematching::Ground, guided_matching::seen_near,
    verify::PairMatches,
};
use crate::{
    camera::Lens,
    features::least_squares::{BSplineImage, Match, Template, Warp, Window},
};
use image::GrayImage;
use rayon::prelude::*;
use rowgram_optim::geometry::rotation;
use std::collections::BTreeMap;

/// Least correlation of grey values of a match that is accepted.
const MIN_CORRELATION: f64 = 0.7;
/// Largest distance of such a match from its key point, pixels.
const MAX_SHIFT_PX: f64 = 1.5;

fn is_accepted(found: &Match, start: &Warp) -> bool {
    let off = [0, 1].map(|k| found.warp.at_px[k] - start.at_px[k]);
    let far = (off[0] * off[0] + off[1] * off[1]).sqrt();
    found.correlation >= MIN_CORRELATION && far <= MAX_SHIFT_PX
}

/// Where the photos have their points.
#[derive(Debug, Clone, PartialEq)]
pub struct RefinedTiePoints {
    /// As those of the block, at other places.
    pub features: Vec<Features>,
    /// What was found again, by images; of a photo in which hardly anything was, its key points, which are as inexact as before.
    pub matches: Vec<PairMatches>,
    /// How many image positions were looked for, besides those of the first photos.
    pub asked: usize,
    /// How many of them were measured; others are lost, but for those of photos that kept theirs.
    pub found: usize,
    /// How many of those found were predicted: places of points in further photos.
    pub further: usize,
    /// Photos that kept their key points because fewer than [`MIN_REFINED`] were found, and how many they have.
    pub kept: Vec<(u32, usize)>,
}

/// Half of the way over which the shape of a window is taken, pixels.
const REACH_PX: f64 = 6.0;
/// A photo in which fewer are found again, one that is blurred maybe, keeps its key points: better than to lose it.
pub const MIN_REFINED: usize = 20;
/// How far points may be off the plane of a photo, as [`Ground`] has it; nothing depends on it here.
const SLACK: [f64; 2] = [0.0, 1.0];

/// A point as its first photo has it.
struct First {
    /// Place among the members of the tracks.
    place: usize,
    image: usize,
    key_point: [f64; 2],
    /// The whole pixel nearest to that.
    at_px: [f64; 2],
    window: Window,
}

/// Where a point is in another photo.
struct Found {
    track: usize,
    place: usize,
    at_px: [f64; 2],
}

/// What came of a photo: positions that were found, and key points that it keeps.
#[derive(Default)]
struct InPhoto {
    found: Vec<Found>,
    kept: Vec<Found>,
}

/// Measures the points of a block again in the photos that `read` yields, each of which is asked for twice; `tell` is
/// called for each. `measured` says how many features of each image were measured before; where others are is only predicted
/// ([`super::longer_tracks`]), and what is not found of them is forgotten.
///
/// # Errors
/// What `read` says.
pub fn refine_tie_points<E: Send>(
    block: &Block<'_>,
    measured: &[usize],
    read: &(dyn Fn(usize) -> Result<GrayImage, E> + Sync),
    tell: &(dyn Fn() + Sync),
) -> Result<RefinedTiePoints, E> {
    let is_measured = |image: usize, place: usize| {
        measured
            .get(image)
            .is_none_or(|&count| (block.tracks.member(place).feature as usize) < count)
    };
    let firsts = &firsts(block, &is_measured, read, tell)?;
    let planes: Vec<[f64; 3]> =
        (0..block.poses.len()).into_par_iter().map(|image| plane(block, image)).collect();
    let template = Template::default();
    let other = |image: usize| {
        let members = block.tracks.in_image(image).iter();
        members.filter_map(move |&(track, place)| {
            let first = firsts[track as usize].as_ref().filter(|first| first.image != image)?;
            block.used[place as usize].then_some((first, track as usize, place as usize))
        })
    };
    let find = |image: usize| -> Result<InPhoto, E> {
        tell();
        if other(image).next().is_none() {
            return Ok(InPhoto::default());
        }
        let picture = BSplineImage::new(&read(image)?);
        let (mut found, mut missed) = (Vec::new(), Vec::new());
        for (first, track, place) in other(image) {
            let key_point = block.position_px(place);
            let Some(start) = block.points[track].and_then(|point| {
                start(block, first, planes[first.image], point, image, key_point)
            }) else {
                continue;
            };
            let matched = template.find(&first.window, &picture, start);
            match matched.filter(|matched| is_accepted(matched, &start)) {
                Some(matched) => found.push(Found { track, place, at_px: matched.warp.at_px }),
                None => missed.push(Found { track, place, at_px: start.at_px }),
            }
        }
        missed.retain(|missed| is_measured(image, missed.place));
        let few = found.len() < MIN_REFINED && !missed.is_empty();
        Ok(InPhoto { found, kept: if few { missed } else { Vec::new() } })
    };
    let images = 0..block.poses.len();
    let found: Vec<InPhoto> = images.clone().into_par_iter().map(find).collect::<Result<_, E>>()?;
    let asked = images.map(|image| other(image).count()).sum();
    let is_further = |(image, of): (usize, &InPhoto)| {
        of.found.iter().filter(|found| !is_measured(image, found.place)).count()
    };
    let further = found.iter().enumerate().map(is_further).sum();
    Ok(RefinedTiePoints { asked, further, ..gather(block, firsts, &found) })
}

/// The first photo of each point, and its window there.
fn firsts<E: Send>(
    block: &Block<'_>,
    is_measured: &(dyn Fn(usize, usize) -> bool + Sync),
    read: &(dyn Fn(usize) -> Result<GrayImage, E> + Sync),
    tell: &(dyn Fn() + Sync),
) -> Result<Vec<Option<First>>, E> {
    let off_middle = |place: usize| {
        let [u, v] = block.position_px(place);
        let size = block.lens(block.tracks.member(place).image as usize).size_px().map(f64::from);
        let (x, y) = (u - 0.5 * (size[0] - 1.0), v - 0.5 * (size[1] - 1.0));
        x * x + y * y
    };
    let mut of_images: Vec<Vec<(usize, usize)>> = vec![Vec::new(); block.poses.len()];
    for track in (0..block.tracks.count()).filter(|&track| block.points[track].is_some()) {
        let used = block.tracks.places(track).filter(|&place| {
            block.used[place] && is_measured(block.tracks.member(place).image as usize, place)
        });
        let nearest = used.min_by(|&a, &b| off_middle(a).total_cmp(&off_middle(b)));
        if let Some(place) = nearest {
            of_images[block.tracks.member(place).image as usize].push((track, place));
        }
    }
    let windows: Vec<Vec<(usize, First)>> = of_images
        .par_iter()
        .enumerate()
        .map(|(image, asked)| {
            let mut windows = Vec::new();
            if !asked.is_empty() {
                let picture = read(image)?;
                windows.extend(asked.iter().filter_map(|&(track, place)| {
                    let key_point = block.position_px(place);
                    let at_px = key_point.map(f64::round);
                    let window = Window::of(&picture, at_px.map(|v| v.max(0.0) as u32))?;
                    Some((track, First { place, image, key_point, at_px, window }))
                }));
            }
            tell();
            Ok(windows)
        })
        .collect::<Result<_, E>>()?;
    let mut firsts: Vec<Option<First>> = (0..block.tracks.count()).map(|_| None).collect();
    for (track, first) in windows.into_iter().flatten() {
        firsts[track] = Some(first);
    }
    Ok(firsts)
}

/// `1/depth = a + b x + c y` of the plane through the points of an image, up to a factor.
fn plane(block: &Block<'_>, image: usize) -> [f64; 3] {
    let seen = block.tracks.in_image(image).iter().filter_map(|&(track, place)| {
        let pose = block.poses[image]?;
        let point = block.points[track as usize].filter(|_| block.used[place as usize])?;
        inverse_depth(pose.to_camera(point))
    });
    let points: Vec<[f64; 3]> = seen.collect();
    Ground::through(&points, SLACK).map_or([1.0, 0.0, 0.0], |ground| ground.plane)
}

/// The ray to a point of the camera frame and its inverse depth.
fn inverse_depth(p: [f64; 3]) -> Option<[f64; 3]> {
    (p[2] < 0.0).then(|| [p[0] / -p[2], p[1] / -p[2], 1.0 / -p[2]])
}

/// Where a window should be in an image that has the point at `key_point`, and how it should look, by the block.
fn start(
    block: &Block<'_>,
    first: &First,
    [a, b, c]: [f64; 3],
    point: [f64; 3],
    image: usize,
    key_point: [f64; 2],
) -> Option<Warp> {
    let share = |[x, y]: [f64; 2]| a + b * x + c * y;
    let pose = block.pose_at(first.image, first.at_px[1])?;
    let [x, y, inverse] = inverse_depth(pose.to_camera(point))?;
    let factor = inverse / share([x, y]);
    let lens = block.lens(first.image);
    let seen = |x: f64, y: f64| {
        let at = [first.at_px[0] + x, first.at_px[1] + y];
        let d = lens.unproject(at)?;
        let [x, y, _] = inverse_depth(d)?;
        let inverse = factor * share([x, y]);
        // The plane ends at its horizon.
        if inverse.is_nan() || inverse <= 0.0 {
            return None;
        }
        let pose = block.pose_at(first.image, at[1])?;
        let from_centre = [x / inverse, y / inverse, -1.0 / inverse];
        let off: [f64; 3] = std::array::from_fn(|k| from_centre[k] - pose.translation[k]);
        let point = rotation::rotate(rotation::inverse(pose.rotation), off);
        seen_near(block, image, point, key_point)
    };
    const E: f64 = REACH_PX;
    let middle = seen(0.0, 0.0)?;
    let [left, right, up, down] = [seen(-E, 0.0)?, seen(E, 0.0)?, seen(0.0, -E)?, seen(0.0, E)?];
    let [along, across] = [[seen(-E, -E)?, seen(E, E)?], [seen(-E, E)?, seen(E, -E)?]];
    let of = |value: &dyn Fn(usize) -> f64| [value(0), value(1)];
    let shape = [of(&|k| (right[k] - left[k]) / (2.0 * E)), of(&|k| (down[k] - up[k]) / (2.0 * E))];
    let curvature = [
        of(&|k| (left[k] + right[k] - 2.0 * middle[k]) / (2.0 * E * E)),
        of(&|k| (along[0][k] + along[1][k] - across[0][k] - across[1][k]) / (4.0 * E * E)),
        of(&|k| (up[k] + down[k] - 2.0 * middle[k]) / (2.0 * E * E)),
    ];
    let by = carried(first, &shape);
    let at_px = [key_point[0] + by[0], key_point[1] + by[1]];
    Some(Warp { at_px, shape, curvature })
}

/// How far the window's middle is from the key point of the first photo, as another photo has it.
fn carried(first: &First, shape: &[[f64; 2]; 2]) -> [f64; 2] {
    let [x, y] = [0, 1].map(|k| first.at_px[k] - first.key_point[k]);
    [0, 1].map(|k| shape[0][k] * x + shape[1][k] * y)
}

/// What was found, as features and matches between the first photo of a point and the others.
fn gather(block: &Block<'_>, firsts: &[Option<First>], of_photos: &[InPhoto]) -> RefinedTiePoints {
    let mut features = block.features.to_vec();
    let mut of_pairs: BTreeMap<[u32; 2], Vec<[u32; 2]>> = BTreeMap::new();
    let positions = of_photos.iter().flat_map(|photo| photo.found.iter().chain(&photo.kept));
    for &Found { track, place, at_px } in positions {
        let Some(first) = &firsts[track] else { continue };
        let (one, other) = (block.tracks.member(first.place), block.tracks.member(place));
        features[one.image as usize].positions_px[one.feature as usize] = first.at_px;
        features[other.image as usize].positions_px[other.feature as usize] = at_px;
        let forward = one.image < other.image;
        let images = if forward { [one.image, other.image] } else { [other.image, one.image] };
        let pair =
            if forward { [one.feature, other.feature] } else { [other.feature, one.feature] };
        of_pairs.entry(images).or_default().push(pair);
    }
    let matches = of_pairs.into_iter().map(|(images, matches)| PairMatches { images, matches });
    let kept = of_photos
        .iter()
        .enumerate()
        .filter(|(_, photo)| !photo.kept.is_empty())
        .map(|(image, photo)| (image as u32, photo.kept.len()));
    RefinedTiePoints {
        features,
        matches: matches.collect(),
        asked: 0,
        further: 0,
        found: of_photos.iter().map(|photo| photo.found.len()).sum(),
        kept: kept.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, Interior, Model},
        scene::{Pose, RollingShutter},
        sfm::{guided_matching::seen_at, tracks::Tracks},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const IMAGES: usize = 3;
    const SHUTTER: RollingShutter = RollingShutter { readout_s: 0.03, sigma_velocity_m_s: 1.0 };

    /// How bright the ground is: waves of 15 cm and more, where a pixel is 3 cm.
    fn ground(x: f64, y: f64) -> f64 {
        let wave = |k: f64| {
            let (length, turn) = (0.15 + 0.04 * k, 2.4 * k);
            let along = x * turn.cos() + y * turn.sin();
            (std::f64::consts::TAU * along / length + 1.3 * k * k).sin()
        };
        118.0 + 16.0 * (0..7).map(|k| wave(f64::from(k))).sum::<f64>()
    }

    /// The height of the ground, which slopes.
    fn height(x: f64) -> f64 {
        0.08 * x
    }

    /// Where a pixel meets the ground.
    fn place(block: &Block<'_>, image: usize, at_px: [f64; 2]) -> [f64; 3] {
        let pose = block.pose_at(image, at_px[1]).unwrap();
        let d = block.lens(image).unproject(at_px).unwrap();
        let d = rotation::rotate(rotation::inverse(pose.rotation), d);
        let c = pose.centre_m();
        // c_z + s d_z = 0.08 (c_x + s d_x)
        let s = (height(c[0]) - c[2]) / (d[2] - 0.08 * d[0]);
        [0, 1, 2].map(|k| c[k] + s * d[k])
    }

    /// Photos of a slope while the camera moves, without points.
    fn photos<'a>(features: &'a [Features], tracks: &'a Tracks, cameras: &[Camera]) -> Block<'a> {
        let mut block = Block::new(features, tracks, cameras);
        for image in 0..IMAGES {
            let rotation = rotation::exp([0.03, -0.02 * image as f64, 0.2 * image as f64]);
            let turned = rotation::rotate(rotation, [2.5 * image as f64, 0.4, 15.0]);
            block.poses[image] = Some(Pose { rotation, translation: turned.map(|v| -v) });
            block.motions[image] = [0.0, 0.0, 0.0, 0.2, 0.03, 0.0];
        }
        block.shutter = Some(SHUTTER);
        block
    }

    #[test]
    fn points_are_where_the_ground_has_them_and_wrong_ones_go() {
        let values = [500.0, 1.0, 199.5, 149.5, -0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let cameras =
            [Camera::new("drone", Interior::new(Model::Brown, [400, 300], &values).unwrap())];
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let (mut features, empty) = (vec![Features::default(); IMAGES], Tracks::default());
        let nothing = features.clone();
        let bare = photos(&nothing, &empty, &cameras);
        let mut points = Vec::new();
        let mut matches = vec![([0, 1], Vec::new()), ([1, 2], Vec::new())];
        for k in 0..200 {
            let (x, y) = (rng.random_range(-3.0..8.0), rng.random_range(-4.0..4.0));
            let point = [x, y, height(x)];
            let mut members = [None; IMAGES];
            for image in 0..IMAGES {
                let [u, v] = seen_at(&bare, image, point).unwrap();
                if u < 12.0 || v < 12.0 || u > 387.0 || v > 287.0 {
                    continue;
                }
                let mut noise = || rng.random_range(-0.4..0.4);
                // Every twentieth is somewhere else in the second photo.
                let wrong = if k % 20 == 0 && image == 1 { 9.0 } else { 0.0 };
                members[image] = Some(features[image].positions_px.len() as u32);
                features[image].positions_px.push([u + noise() + wrong, v + noise()]);
            }
            for (images, matches) in &mut matches {
                if let [Some(a), Some(b)] = images.map(|image: u32| members[image as usize]) {
                    matches.push([a, b]);
                }
            }
            points.push((members, point, k % 20 == 0));
        }
        let counts: Vec<usize> = features.iter().map(|of| of.positions_px.len()).collect();
        let tracks = Tracks::join(&counts, matches.iter().map(|(i, m)| (*i, m.as_slice())));
        let mut block = photos(&features, &tracks, &cameras);
        let mut wrong = Vec::new();
        for track in 0..tracks.count() {
            let member = tracks.of(track)[0];
            let of = |(members, ..): &&([Option<u32>; IMAGES], [f64; 3], bool)| {
                members[member.image as usize] == Some(member.feature)
            };
            let (_, point, is_wrong) = points.iter().find(of).unwrap();
            block.points[track] = Some(*point);
            block.used[tracks.places(track)].fill(true);
            if *is_wrong {
                wrong.push(track);
            }
        }
        assert!(tracks.count() > 120 && wrong.len() > 4);
        let pictures: Vec<GrayImage> = (0..IMAGES)
            .map(|image| {
                GrayImage::from_fn(400, 300, |u, v| {
                    let [x, y, _] = place(&bare, image, [f64::from(u), f64::from(v)]);
                    // Every photo in its own light.
                    let light = (1.0 - 0.1 * image as f64) * ground(x, y) + 9.0 * image as f64;
                    image::Luma([light.round().clamp(0.0, 255.0) as u8])
                })
            })
            .collect();
        let read = |image: usize| Ok::<_, String>(pictures[image].clone());
        let found = refine_tie_points(&block, &[], &read, &|| ()).unwrap();
        let (mut before, mut after) = (Vec::new(), Vec::new());
        for PairMatches { images: [a, b], matches } in &found.matches {
            for &[i, j] in matches {
                let ends = [(*a as usize, i as usize), (*b as usize, j as usize)];
                let [first, second] = ends.map(|(k, i)| found.features[k].positions_px[i]);
                // One of them is at a whole pixel: that is the place.
                let ahead = first == first.map(f64::round);
                let (from, at, to, seen) = if ahead {
                    (*a as usize, first, *b as usize, second)
                } else {
                    (*b as usize, second, *a as usize, first)
                };
                assert_eq!(at, at.map(f64::round));
                let truth = seen_at(&bare, to, place(&bare, from, at)).unwrap();
                after.push((seen[0] - truth[0]).powi(2) + (seen[1] - truth[1]).powi(2));
                let [was_first, was_second] = ends.map(|(k, i)| features[k].positions_px[i]);
                let (was_at, was_seen) =
                    if ahead { (was_first, was_second) } else { (was_second, was_first) };
                let truth = seen_at(&bare, to, place(&bare, from, was_at)).unwrap();
                before.push((was_seen[0] - truth[0]).powi(2) + (was_seen[1] - truth[1]).powi(2));
            }
        }
        let rms = |squares: &[f64]| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        assert!(
            10 * after.len() > 9 * (found.asked - wrong.len()),
            "{} {}",
            after.len(),
            found.asked
        );
        assert!(rms(&before) > 0.4 && rms(&after) < 0.03, "{} {}", rms(&before), rms(&after));
        // Where the second photo was wrong, nothing of it is left.
        let second = |track: &usize| tracks.of(*track).iter().find(|m| m.image == 1).copied();
        for member in wrong.iter().filter_map(second) {
            for pair in found.matches.iter().filter(|pair| pair.images.contains(&1)) {
                let side = usize::from(pair.images[1] == 1);
                let kept = pair.matches.iter().any(|m| m[side] == member.feature);
                let first = found.features[1].positions_px[member.feature as usize];
                assert!(!kept || first == first.map(f64::round), "{pair:?}");
            }
        }
        assert_eq!(found.kept, []);
        // A photo that shows nothing keeps its key points, and is named.
        let blank = |image: usize| {
            let grey = if image == 2 {
                GrayImage::from_pixel(400, 300, image::Luma([90]))
            } else {
                pictures[image].clone()
            };
            Ok::<_, String>(grey)
        };
        let without = refine_tie_points(&block, &[], &blank, &|| ()).unwrap();
        let [(2, kept)] = without.kept[..] else { panic!("{:?}", without.kept) };
        assert!(kept > 10 && without.found < found.found);
        let of_blank = without.matches.iter().filter(|pair| pair.images[1] == 2);
        assert!(of_blank.map(|pair| pair.matches.len()).sum::<usize>() >= kept);
        let broken =
            |image: usize| if image == 2 { Err("gone") } else { Ok(pictures[image].clone()) };
        assert_eq!(refine_tie_points(&block, &[], &broken, &|| ()), Err("gone"));
    }
}
