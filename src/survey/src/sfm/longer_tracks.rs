//! Longer tracks: tie points that see the same ground become one, and points are looked for in the further photos that
//! show their place.
//!
//! ```text
//! A and B are one    |u_i(X_A) - m_i(B)| <= d  in all images i of B,  |u_j(X_B) - m_j(A)| <= d  in all images j of A
//! A is sought in k   u_k(X_A) inside image k, and no measurement of any point within d of it
//! ```
//!
//! with `u_k` the projection into image `k` and `m` what was measured, pixels. A feature that is found in one photo and not in
//! the next (half of those of a field) ends a track there, although the block tells to a pixel where to look for it. What is
//! sought is no measurement yet: it becomes one where least-squares matching finds the point's surroundings
//! ([`super::refinement`]), and is forgotten where it does not.

use super::{
    Features,
    block::Block,
    epipolar_rematching::{BUCKET, Buckets},
    guided_matching::seen_at,
    relative::Ray,
    tracks::Tracks,
};
use crate::features::least_squares::HALF;
use rayon::prelude::*;

/// Up to which distance two places are the same, pixels.
const SAME_PLACE_PX: f64 = 1.5;
/// Rays of a point from which on further photos are not searched. Further rays add little, the standard deviation falls with the root of
/// their number, and each takes time in all adjustments to come.
pub const MAX_RAYS: usize = 6;
/// Images that share fewer points are no neighbours.
const MIN_SHARED: u32 = 10;
/// What is nearer to an edge has no whole window, pixels.
const EDGE_PX: f64 = HALF as f64 + 3.0;

/// The tracks of a block, made longer.
#[derive(Debug, Clone, PartialEq)]
pub struct LongerTracks {
    /// The features of each image that belong to points, measured ones first.
    pub features: Vec<Features>,
    /// How many of them are measured; where the others should be is predicted by the block.
    pub measured: Vec<usize>,
    /// What belongs together.
    pub tracks: Tracks,
    /// By how many there are fewer because they are one.
    pub joined: usize,
    /// How many places were predicted.
    pub predicted: usize,
}

/// What an image says.
#[derive(Default)]
struct InImage {
    /// Two tracks that may be one, and how far apart they are here.
    same: Vec<(f64, [u32; 2])>,
    /// Where tracks should be that it does not have.
    sought: Vec<(u32, [f64; 2])>,
}

/// The members of a block that belong to points, as tracks that are joined and reach into further photos; a point with
/// `max_rays` rays or more is not searched for in further photos.
pub fn lengthen(block: &Block<'_>, max_rays: usize) -> LongerTracks {
    let images = 0..block.poses.len();
    let found: Vec<InImage> = images.into_par_iter().map(|image| look_into(block, image)).collect();
    let mut same: Vec<(f64, [u32; 2])> =
        found.iter().flat_map(|image| image.same.iter().copied()).collect();
    same.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    // Several images say it of the same two.
    same.dedup();
    let (mut features, numbers) = features_of_points(block);
    let measured: Vec<usize> = features.iter().map(|of| of.positions_px.len()).collect();
    let mut links: Vec<([u32; 2], [[u32; 2]; 1])> = Vec::new();
    let mut heads: Vec<Option<[u32; 2]>> = vec![None; block.tracks.count()];
    for (track, head) in heads.iter_mut().enumerate() {
        let members: Vec<[u32; 2]> = used(block, track)
            .map(|place| [block.tracks.member(place).image, numbers[place]])
            .collect();
        *head = members.first().copied().filter(|_| members.len() >= 2);
        links.extend(members.windows(2).map(|two| link(two[0], two[1])));
    }
    for (_, tracks) in &same {
        if let [Some(a), Some(b)] = tracks.map(|track| heads[track as usize]) {
            links.push(link(a, b));
        }
    }
    let mut sought: Vec<Vec<(usize, [f64; 2])>> = vec![Vec::new(); heads.len()];
    for (image, of) in found.iter().enumerate() {
        of.sought.iter().for_each(|&(track, at)| sought[track as usize].push((image, at)));
    }
    let mut predicted = 0;
    for (track, places) in sought.iter().enumerate() {
        let Some(head) = heads[track] else { continue };
        let wanted = max_rays.saturating_sub(used(block, track).count());
        for &(image, at) in evenly(places, wanted) {
            predicted += 1;
            let feature = features[image].positions_px.len() as u32;
            features[image].positions_px.push(at);
            let colour = features[head[0] as usize].colours.get(head[1] as usize).copied();
            if let (Some(colour), false) = (colour, features[image].colours.is_empty()) {
                features[image].colours.push(colour);
            }
            links.push(link(head, [image as u32, feature]));
        }
    }
    let counts: Vec<usize> = features.iter().map(|of| of.positions_px.len()).collect();
    let tracks = Tracks::join(&counts, links.iter().map(|(images, of)| (*images, of.as_slice())));
    let joined = heads.iter().flatten().count() - tracks.count();
    LongerTracks { features, measured, joined, tracks, predicted }
}

/// The features that belong to points, in the order of all features, and for each member of a track the new number of its feature. In a large block, whose
/// tracks are thinned, these are a small part of all features.
fn features_of_points(block: &Block<'_>) -> (Vec<Features>, Vec<u32>) {
    let mut places: Vec<Vec<usize>> = vec![Vec::new(); block.features.len()];
    for place in (0..block.tracks.count()).flat_map(|track| used(block, track)) {
        places[block.tracks.member(place).image as usize].push(place);
    }
    let mut numbers = vec![u32::MAX; block.tracks.member_count()];
    let mut of_image = |(all, mut places): (&Features, Vec<usize>)| {
        let feature = |place: usize| block.tracks.member(place).feature as usize;
        places.sort_unstable_by_key(|&place| feature(place));
        for (number, &place) in places.iter().enumerate() {
            numbers[place] = number as u32;
        }
        let own = places.iter().map(|&place| feature(place));
        Features {
            name: all.name.clone(),
            camera: all.camera,
            positions_px: own.clone().map(|k| all.positions_px[k]).collect(),
            colours: own.filter_map(|k| all.colours.get(k).copied()).collect(),
        }
    };
    let features = block.features.iter().zip(places).map(&mut of_image).collect();
    (features, numbers)
}

/// So many of some, spread over all of them.
fn evenly<T>(of: &[T], wanted: usize) -> impl Iterator<Item = &T> {
    let count = wanted.min(of.len());
    (0..count).map(move |k| &of[(2 * k + 1) * of.len() / (2 * count)])
}

/// A match, as tracks are joined by.
fn link(a: [u32; 2], b: [u32; 2]) -> ([u32; 2], [[u32; 2]; 1]) {
    if a[0] < b[0] { ([a[0], b[0]], [[a[1], b[1]]]) } else { ([b[0], a[0]], [[b[1], a[1]]]) }
}

/// Places of the members that belong to the point of a track.
fn used<'b>(block: &'b Block<'_>, track: usize) -> impl Iterator<Item = usize> + 'b {
    let has_point = block.points[track].is_some();
    block.tracks.places(track).filter(move |&place| {
        let image = block.tracks.member(place).image as usize;
        has_point && block.used[place] && block.poses[image].is_some()
    })
}

/// The tracks that images with much in common with this one have, and it has not.
fn tracks_around(block: &Block<'_>, image: usize) -> Vec<u32> {
    let mut shared = vec![0u32; block.poses.len()];
    let mut here = vec![false; block.tracks.count()];
    for &(track, place) in block.tracks.in_image(image) {
        if !block.used[place as usize] {
            continue;
        }
        here[track as usize] = true;
        for other in used(block, track as usize) {
            shared[block.tracks.member(other).image as usize] += 1;
        }
    }
    shared[image] = 0;
    let mut around = Vec::new();
    for (other, _) in shared.iter().enumerate().filter(|(_, count)| **count >= MIN_SHARED) {
        for &(track, place) in block.tracks.in_image(other) {
            if block.used[place as usize]
                && block.points[track as usize].is_some()
                && !std::mem::replace(&mut here[track as usize], true)
            {
                around.push(track);
            }
        }
    }
    around.sort_unstable();
    around
}

fn look_into(block: &Block<'_>, image: usize) -> InImage {
    let mut found = InImage::default();
    if block.poses[image].is_none() {
        return found;
    }
    let own: Vec<(u32, usize)> = block
        .tracks
        .in_image(image)
        .iter()
        .map(|&(track, place)| (track, place as usize))
        .filter(|&(track, place)| block.used[place] && block.points[track as usize].is_some())
        .collect();
    let places: Vec<Option<Ray>> =
        own.iter().map(|&(_, place)| Some(block.position_px(place))).collect();
    let buckets = Buckets::new(&places, BUCKET * SAME_PLACE_PX);
    let [width, height] = block.lens(image).size_px().map(f64::from);
    let inside = |[u, v]: [f64; 2]| {
        u >= EDGE_PX && v >= EDGE_PX && u <= width - 1.0 - EDGE_PX && v <= height - 1.0 - EDGE_PX
    };
    for track in tracks_around(block, image) {
        let Some(point) = block.points[track as usize] else { continue };
        let Some(at) = seen_at(block, image, point).filter(|&at| inside(at)) else { continue };
        let mut is_there = false;
        buckets.near([at, at], SAME_PLACE_PX, |k| {
            let (other, place) = own[k as usize];
            if apart(at, block.position_px(place)) <= SAME_PLACE_PX {
                is_there = true;
                let two = [track.min(other), track.max(other)];
                found.same.extend(distance(block, two).map(|d| (d, two)));
            }
        });
        if !is_there {
            found.sought.push((track, at));
        }
    }
    found
}

fn apart(a: [f64; 2], b: [f64; 2]) -> f64 {
    ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt()
}

/// How far apart two tracks are where that is most, if they may be the same point: no image has both, and each lies in all
/// images of the other where that was measured.
fn distance(block: &Block<'_>, [a, b]: [u32; 2]) -> Option<f64> {
    let image = |place: usize| block.tracks.member(place).image;
    let [of_a, of_b] = [a, b].map(|track| used(block, track as usize).collect::<Vec<usize>>());
    if of_a.iter().any(|&p| of_b.iter().any(|&q| image(p) == image(q))) {
        return None;
    }
    let mut farthest = 0.0_f64;
    for (track, places) in [(a, &of_b), (b, &of_a)] {
        let point = block.points[track as usize]?;
        for &place in places {
            let at = seen_at(block, image(place) as usize, point)?;
            farthest = farthest.max(apart(at, block.position_px(place)));
        }
    }
    (farthest <= SAME_PLACE_PX).then_some(farthest)
}
