//! Places that the orthomosaics of two dates both show: features of what does not grow.
//!
//! A tile of each map gives features ([`crate::features`]); those whose surroundings show leaf or nothing are left out, because leaves
//! are elsewhere on the next date. What looks alike on both maps is a tie where it agrees with most of the others: of similarities
//! `T` through two ties each, drawn at random, the one with the most ties `|T(x) - y|` below the tolerance, metres on the map.
//!
//! Reference: M. A. Fischler, R. C. Bolles, "Random sample consensus", Commun. ACM 24, 1981.

use crate::{
    features::{
        self, Descriptors, FeatureOptions, Upscale,
        matching::{MatchOptions, match_descriptors},
    },
    problems::map_transform::MapTie,
};
use image::RgbImage;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram_raster::georeference::Georeference;

/// Features of a piece of a map.
#[derive(Debug, Clone, Default)]
pub struct MapFeatures {
    /// Where they are, metres on the map.
    pub at_m: Vec<[f64; 2]>,
    /// What they look like.
    pub descriptors: Descriptors,
}

/// A feature's surroundings, in multiples of its blur.
const SURROUNDINGS: f32 = 2.0;
/// Least contrast of a feature, half of what photos are asked for: soil is weak in texture, and between two dates most of it changes.
const MIN_CONTRAST: f32 = 0.02;
/// Of two dates next to no feature stands out from the others as it does in two photos of one flight. One similarity of the whole map,
/// which wrong ties agree with by chance less than one time in a thousand, tells the right ones instead.
const RATIO: f32 = 0.95;
/// Draws of the consensus: of ties one fifth of which are right, a pair of right ones is missed once in 10,000 runs.
const DRAWS: usize = 230;
/// Two ties nearer to each other than this share of the map say too little about rotation and scale.
const MIN_BASE: f64 = 0.2;
/// A similarity between two dates of one field changes scale and direction by no more than this: the heights of two flights'
/// receivers and their compasses agree that well.
const MAX_CHANGE: f64 = 0.15;

/// The features of a piece of a map, `place` being that of the piece; `usable` says (row by row) which pixels show what does not
/// grow.
pub fn features(
    picture: &RgbImage,
    usable: &[bool],
    place: &Georeference,
    most: usize,
) -> MapFeatures {
    let options = FeatureOptions {
        max_features: 0,
        upscale: Upscale::Precise,
        contrast_threshold: MIN_CONTRAST,
        ..FeatureOptions::default()
    };
    let found = features::detect(&features::grey(picture), &options);
    let (width, height) = (picture.width() as i64, picture.height() as i64);
    let is_usable = |u: f32, v: f32, reach: f32| {
        let range = |x: f32, size: i64| {
            ((x - reach).floor() as i64).max(0)..=((x + reach).ceil() as i64).min(size - 1)
        };
        range(v, height)
            .all(|row| range(u, width).all(|column| usable[(row * width + column) as usize]))
    };
    let mut chosen: Vec<usize> = (0..found.key_points.len())
        .filter(|&k| {
            let point = &found.key_points[k];
            is_usable(point.u_px, point.v_px, SURROUNDINGS * point.sigma_px)
        })
        .collect();
    chosen.sort_by(|&a, &b| {
        let response = |k: usize| found.key_points[k].response;
        response(b).total_cmp(&response(a)).then(a.cmp(&b))
    });
    chosen.truncate(most);
    chosen.sort_unstable();
    let at = |k: usize| {
        let point = &found.key_points[k];
        place.map([f64::from(point.u_px), f64::from(point.v_px)])
    };
    MapFeatures {
        at_m: chosen.iter().map(|&k| at(k)).collect(),
        descriptors: found.descriptors.select(&chosen),
    }
}

/// Places of two pieces that look alike.
pub fn alike(from: &MapFeatures, to: &MapFeatures) -> Vec<MapTie> {
    let options = MatchOptions { ratio: RATIO, ..MatchOptions::default() };
    let matches = match_descriptors(&from.descriptors, &to.descriptors, &options);
    let tie = |first: u32, second: u32| MapTie {
        from_m: from.at_m[first as usize],
        to_m: to.at_m[second as usize],
    };
    matches.iter().map(|m| tie(m.first, m.second)).collect()
}

/// The ties that agree with one similarity within a tolerance, metres: as many as possible.
pub fn consistent(ties: &[MapTie], tolerance_m: f64, seed: u64) -> Vec<MapTie> {
    if ties.len() < 3 {
        return Vec::new();
    }
    let origin = ties[0].from_m;
    let local = |at: [f64; 2]| [at[0] - origin[0], at[1] - origin[1]];
    let places: Vec<([f64; 2], [f64; 2])> =
        ties.iter().map(|tie| (local(tie.from_m), local(tie.to_m))).collect();
    let reach = places.iter().map(|(p, _)| p[0].hypot(p[1])).fold(0.0, f64::max);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut best: Vec<usize> = Vec::new();
    let mut draws = 0;
    // A draw that cannot be a similarity of two dates costs next to nothing, so it does not count in full.
    for _ in 0..40 * DRAWS {
        if draws == DRAWS {
            break;
        }
        let pair = [0; 2].map(|_| rng.random_range(0..places.len()));
        let [(p, q), (p2, q2)] = pair.map(|k| places[k]);
        let (d, e) = ([p2[0] - p[0], p2[1] - p[1]], [q2[0] - q[0], q2[1] - q[1]]);
        let square = d[0] * d[0] + d[1] * d[1];
        if square.sqrt() < MIN_BASE * reach {
            continue;
        }
        // e = [a -b; b a] d
        let a = (d[0] * e[0] + d[1] * e[1]) / square;
        let b = (d[0] * e[1] - d[1] * e[0]) / square;
        if (a - 1.0).hypot(b) > MAX_CHANGE {
            continue;
        }
        draws += 1;
        let agrees = |(x, y): &([f64; 2], [f64; 2])| {
            let [dx, dy] = [x[0] - p[0], x[1] - p[1]];
            let off = [q[0] + a * dx - b * dy - y[0], q[1] + b * dx + a * dy - y[1]];
            off[0] * off[0] + off[1] * off[1] < tolerance_m * tolerance_m
        };
        let count = places.iter().filter(|place| agrees(place)).count();
        if count > best.len() {
            best = (0..places.len()).filter(|&k| agrees(&places[k])).collect();
        }
    }
    best.into_iter().map(|k| ties[k]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problems::map_transform;
    use rowgram_raster::georeference::Crs;

    /// Uneven soil, shifted by whole pixels.
    fn soil(shift: [i64; 2], size: u32) -> RgbImage {
        RgbImage::from_fn(size, size, |u, v| {
            let at = [i64::from(u) + shift[0], i64::from(v) + shift[1]];
            let mut sum = 0.0;
            for (k, cell) in [3.0, 5.0, 9.0, 17.0].into_iter().enumerate() {
                let node = |x: i64, y: i64| {
                    let mut rng = ChaCha8Rng::seed_from_u64(
                        (x as u64).wrapping_mul(0x9e37)
                            ^ (y as u64).wrapping_mul(0x85eb_ca6b)
                            ^ k as u64,
                    );
                    rng.random::<f64>()
                };
                let [x, y] = at.map(|a| a as f64 / cell);
                let (i, j) = (x.floor(), y.floor());
                let (s, t) = (x - i, y - j);
                let (i, j) = (i as i64, j as i64);
                sum += (1.0 - t) * ((1.0 - s) * node(i, j) + s * node(i + 1, j))
                    + t * ((1.0 - s) * node(i, j + 1) + s * node(i + 1, j + 1));
            }
            let value = (60.0 * sum) as u8;
            image::Rgb([value, value, value])
        })
    }

    #[test]
    fn a_shift_between_two_maps_is_found_where_nothing_grows() {
        let size = 240;
        // The second map begins 7 pixels further right and 4 further down.
        let (first, second) = (soil([0, 0], size), soil([7, 4], size));
        let place = Georeference::north_up([1000.0, 2000.0], 0.01, Crs::LOCAL);
        let mut usable = vec![true; (size * size) as usize];
        usable[..(60 * size) as usize].fill(false);
        let [from, to] = [&first, &second].map(|map| features(map, &usable, &place, 2000));
        assert!(from.at_m.iter().all(|at| at[1] < 2000.0 - 0.6), "leaf has no features");
        let ties = consistent(&alike(&from, &to), 0.02, 1);
        let fit = map_transform::fit(&ties).unwrap();
        let shift = fit.transform.shift_m;
        assert!((shift[0] + 0.07).abs() < 0.002 && (shift[1] - 0.04).abs() < 0.002, "{fit:?}");
    }

    #[test]
    fn wrong_ties_do_not_agree() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut at = || [20.0 * rng.random::<f64>(), 20.0 * rng.random::<f64>()];
        let mut ties: Vec<MapTie> = (0..200).map(|_| MapTie { from_m: at(), to_m: at() }).collect();
        for k in 0..60 {
            let from_m = at();
            let to_m = [1.01 * from_m[0] + 0.3 + 0.002 * f64::from(k % 5), 1.01 * from_m[1] - 0.2];
            ties.push(MapTie { from_m, to_m });
        }
        let kept = consistent(&ties, 0.03, 1);
        assert!((58..64).contains(&kept.len()), "{}", kept.len());
        assert!(consistent(&ties[..2], 0.03, 1).is_empty());
    }
}
