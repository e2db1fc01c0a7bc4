//! Which photos are worth matching: `n (n - 1) / 2` pairs are too many where each overlaps with a few.
//!
//! From where the photos were taken ([`nearest`], [`within`]), from their order ([`in_sequence`]), or, where neither is known, from what they
//! show ([`similar`](super::retrieval::similar)); and of these those of which a few features match ([`coarse`]). Pairs are `[i, j]` with
//! `i < j`, without repetition, in rising order.

use super::{
    Descriptors, Features,
    matching::{MatchOptions, Prepared, match_prepared},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Two photos by their indices, the smaller first.
pub type Pair = [usize; 2];

/// Each photo with the `count` nearest others, as far as they are within `max_distance_m`.
///
/// `positions_m` are horizontal positions in the mapping frame. A photo without one (NaN or infinite)
/// is in no pair. Equally near ones are taken in their order.
pub fn nearest(positions_m: &[[f64; 2]], count: usize, max_distance_m: f64) -> Vec<Pair> {
    let pairs = (0..positions_m.len()).into_par_iter().flat_map_iter(|one| {
        let mut others: Vec<(f64, usize)> = (0..positions_m.len())
            .filter(|&other| other != one)
            .map(|other| (distance(positions_m[one], positions_m[other]), other))
            .filter(|&(distance, _)| distance <= max_distance_m)
            .collect();
        others.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        others.truncate(count);
        others.into_iter().map(move |(_, other)| [one.min(other), one.max(other)])
    });
    unique(pairs.collect())
}

/// All photos that are at most `max_distance_m` apart: the sum of two footprint radii finds all
/// that can overlap.
pub fn within(positions_m: &[[f64; 2]], max_distance_m: f64) -> Vec<Pair> {
    nearest(positions_m, usize::MAX, max_distance_m)
}

/// Each photo with the `reach` that follow it.
pub fn in_sequence(photos: usize, reach: usize) -> Vec<Pair> {
    let after = |one: usize| one + 1..photos.min(one.saturating_add(reach).saturating_add(1));
    (0..photos).flat_map(|one| after(one).map(move |other| [one, other])).collect()
}

/// Every photo with every other.
pub fn all(photos: usize) -> Vec<Pair> {
    in_sequence(photos, photos)
}

/// Joins several lists of pairs.
pub fn join(lists: &[Vec<Pair>]) -> Vec<Pair> {
    unique(lists.concat())
}

/// How [`coarse`] judges.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CoarseOptions {
    /// Features of each photo that are looked at, those of the largest scales.
    pub features: usize,
    /// Least number of matches of a pair.
    pub min_matches: usize,
    /// Pairs that each photo may ask for, those with the most matches.
    pub per_photo: usize,
    /// Which matches count.
    pub matching: MatchOptions,
}

impl Default for CoarseOptions {
    fn default() -> CoarseOptions {
        CoarseOptions {
            features: 768,
            min_matches: 4,
            per_photo: 16,
            matching: MatchOptions::default(),
        }
    }
}

/// The descriptors of the features with the largest scales.
pub fn largest(photo: &Features, count: usize) -> Descriptors {
    let mut order: Vec<usize> = (0..photo.key_points.len()).collect();
    order.sort_unstable_by(|&a, &b| {
        let (one, other) = (&photo.key_points[a], &photo.key_points[b]);
        other.sigma_px.total_cmp(&one.sigma_px).then(a.cmp(&b))
    });
    order.truncate(count);
    photo.descriptors.select(&order)
}

/// Of each photo the candidates of which most features match, of a few ([`largest`]); a pair stays if one of its photos asks for it.
/// `matched` is called after each candidate.
pub fn coarse(
    photos: &[Descriptors],
    candidates: &[Pair],
    options: &CoarseOptions,
    matched: &(dyn Fn() + Sync),
) -> Vec<Pair> {
    let prepared: Vec<Prepared<'_>> = photos.par_iter().map(Prepared::new).collect();
    let mut best_first: Vec<(usize, Pair)> = candidates
        .par_iter()
        .map(|&pair| {
            let [one, other] = pair.map(|index| &prepared[index]);
            let found = match_prepared(one, other, &options.matching).len();
            matched();
            (found, pair)
        })
        .filter(|(found, _)| *found >= options.min_matches.max(1))
        .collect();
    // The most matches first, so that a photo's first are its best.
    best_first.sort_unstable_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut asked = vec![0; photos.len()];
    best_first.retain(|(_, pair)| {
        let wanted = pair.iter().any(|&photo| asked[photo] < options.per_photo);
        if wanted {
            pair.iter().for_each(|&photo| asked[photo] += 1);
        }
        wanted
    });
    unique(best_first.into_iter().map(|(_, pair)| pair).collect())
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn unique(mut pairs: Vec<Pair>) -> Vec<Pair> {
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::{DESCRIPTOR_LENGTH, KeyPoint};

    #[test]
    fn neighbours_on_a_grid_of_photos() {
        let grid: Vec<[f64; 2]> =
            (0..12).map(|k| [f64::from(k % 4) * 10.0, f64::from(k / 4) * 20.0]).collect();
        let strip = nearest(&grid, 2, 15.0);
        assert!(strip.contains(&[0, 1]) && strip.contains(&[1, 2]));
        assert!(strip.iter().all(|[a, b]| a / 4 == b / 4), "15 m stay in the strip");
        assert_eq!(within(&grid, 10.0).len(), 9);
        assert_eq!(within(&grid, 20.0).len(), 9 + 6 + 8, "neighbours, next but one, next strip");
        assert_eq!(within(&grid, 1e3), all(12));
        assert_eq!(nearest(&[[0.0; 2], [f64::NAN; 2], [1.0; 2]], 9, 1e9), [[0, 2]]);
        assert_eq!(nearest(&[], 3, 1.0), Vec::<Pair>::new());
    }

    #[test]
    fn sequences() {
        assert_eq!(in_sequence(4, 1), [[0, 1], [1, 2], [2, 3]]);
        assert_eq!(in_sequence(4, 2), [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]);
        assert_eq!(all(4).len(), 6);
        assert_eq!((in_sequence(0, 3), in_sequence(1, 3)), (vec![], vec![]));
        assert_eq!(join(&[in_sequence(3, 1), vec![[0, 2], [0, 1]]]), all(3));
    }

    /// Photos along a line; photo `k` sees things `10 k .. 10 k + 30`, coarse ones every other.
    fn line(photos: usize) -> Vec<Features> {
        let thing = |index: usize| {
            std::array::from_fn::<u8, DESCRIPTOR_LENGTH, _>(|k| {
                // Different things have different bytes in most places.
                ((index + 1) * (k * k + 3 * k + 7) % 251) as u8
            })
        };
        (0..photos)
            .map(|photo| {
                let seen = 10 * photo..10 * photo + 30;
                let key_points = seen.clone().map(|index| KeyPoint {
                    u_px: 0.0,
                    v_px: 0.0,
                    sigma_px: if index % 2 == 0 { 20.0 } else { 2.0 },
                    angle_rad: 0.0,
                    response: 0.1,
                });
                Features {
                    width_px: 1,
                    height_px: 1,
                    key_points: key_points.collect(),
                    descriptors: Descriptors::from_bytes(seen.flat_map(thing).collect()).unwrap(),
                }
            })
            .collect()
    }

    #[test]
    fn few_features_tell_who_overlaps() {
        let photos = line(6);
        let options = CoarseOptions { min_matches: 3, ..CoarseOptions::default() };
        let photos: Vec<Descriptors> = photos.iter().map(|photo| largest(photo, 15)).collect();
        let found = coarse(&photos, &all(6), &options, &|| ());
        assert_eq!(found, in_sequence(6, 2));
        assert_eq!(coarse(&photos, &[[0, 1], [0, 5]], &options, &|| ()), [[0, 1]]);
        let few = coarse(&photos, &all(6), &CoarseOptions { per_photo: 1, ..options }, &|| ());
        assert_eq!(few, in_sequence(6, 1), "neighbours, of which most matches");
    }
}
