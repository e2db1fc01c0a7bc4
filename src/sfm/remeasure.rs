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

use super::{Features, again::seen_at, block::Block, guided::Ground, verify::Matched};
use crate::{
    camera::Lens,
    features::least_squares::{Placed, Smooth, Template, Window},
    geometry::rotation,
};
use image::GrayImage;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// What counts as found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Remeasuring {
    /// The least correlation of grey values.
    pub correlation: f64,
    /// The farthest that it may be from the key point, pixels.
    pub farthest_px: f64,
}

impl Default for Remeasuring {
    fn default() -> Remeasuring {
        Remeasuring { correlation: 0.7, farthest_px: 1.5 }
    }
}

/// Where the photos have their points.
#[derive(Debug, Clone, PartialEq)]
pub struct Remeasured {
    /// As those of the block, at other places.
    pub features: Vec<Features>,
    /// What was found again, by images.
    pub matches: Vec<Matched>,
    /// How many image positions were looked for, besides those of the first photos.
    pub asked: usize,
}

/// Half of the way over which the shape of a window is taken, pixels.
const REACH_PX: f64 = 6.0;
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

/// Measures the points of a block again in the photos that `read` yields, each of which is asked for twice; `tell` is
/// called for each.
///
/// # Errors
/// What `read` says.
pub fn remeasure<E: Send>(
    block: &Block<'_>,
    read: &(dyn Fn(usize) -> Result<GrayImage, E> + Sync),
    demands: &Remeasuring,
    tell: &(dyn Fn() + Sync),
) -> Result<Remeasured, E> {
    let firsts = &firsts(block, read, tell)?;
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
    let find = |image: usize| -> Result<Vec<Found>, E> {
        tell();
        if other(image).next().is_none() {
            return Ok(Vec::new());
        }
        let picture = Smooth::new(&read(image)?);
        let found = other(image).filter_map(|(first, track, place)| {
            let key_point = block.position_px(place);
            let point = block.points[track]?;
            let start = start(block, first, planes[first.image], point, image, key_point)?;
            let found = template.find(&first.window, &picture, start)?;
            let at_px = found.placed.at_px;
            let off = [0, 1].map(|k| at_px[k] - start.at_px[k]);
            let far = (off[0] * off[0] + off[1] * off[1]).sqrt();
            (found.correlation >= demands.correlation && far <= demands.farthest_px)
                .then_some(Found { track, place, at_px })
        });
        Ok(found.collect())
    };
    let images = 0..block.poses.len();
    let found: Vec<Vec<Found>> =
        images.clone().into_par_iter().map(find).collect::<Result<_, E>>()?;
    let asked = images.map(|image| other(image).count()).sum();
    Ok(gather(block, firsts, &found, asked))
}

/// The first photo of each point, and its window there.
fn firsts<E: Send>(
    block: &Block<'_>,
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
        let used = block.tracks.places(track).filter(|&place| block.used[place]);
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
) -> Option<Placed> {
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
        seen_at(block, image, rotation::rotate(rotation::inverse(pose.rotation), off))
    };
    let slope = |from: [f64; 2], to: [f64; 2]| [0, 1].map(|k| (to[k] - from[k]) / (2.0 * REACH_PX));
    let shape = [
        slope(seen(-REACH_PX, 0.0)?, seen(REACH_PX, 0.0)?),
        slope(seen(0.0, -REACH_PX)?, seen(0.0, REACH_PX)?),
    ];
    let by = carried(first, &shape);
    Some(Placed { at_px: [key_point[0] + by[0], key_point[1] + by[1]], shape })
}

/// How far the window's middle is from the key point of the first photo, as another photo has it.
fn carried(first: &First, shape: &[[f64; 2]; 2]) -> [f64; 2] {
    let [x, y] = [0, 1].map(|k| first.at_px[k] - first.key_point[k]);
    [0, 1].map(|k| shape[0][k] * x + shape[1][k] * y)
}

/// What was found, as features and matches between the first photo of a point and the others.
fn gather(
    block: &Block<'_>,
    firsts: &[Option<First>],
    found: &[Vec<Found>],
    asked: usize,
) -> Remeasured {
    let mut features = block.features.to_vec();
    let mut of_pairs: BTreeMap<[u32; 2], Vec<[u32; 2]>> = BTreeMap::new();
    for &Found { track, place, at_px } in found.iter().flatten() {
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
    let matches = of_pairs.into_iter().map(|(images, matches)| Matched { images, matches });
    Remeasured { features, matches: matches.collect(), asked }
}
