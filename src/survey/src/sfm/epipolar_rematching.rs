//! Matches that looks alone cannot tell: in a crop every leaf looks like the next, and few features pass a
//! test of the nearest against the second nearest of a whole photo. Where a few matches have told how two
//! photos stand to each other and how far the ground is, each feature is looked for again along the short
//! piece of its epipolar line on which the ground lies, and only what is near it competes.
//!
//! ```text
//! 1/depth = a + b x + c y            the ground plane, in a camera: from matches that are right
//! u2(d) = pi(R d r1 + t),  d = depth (1 - s) .. depth (1 + s)      s: how far points stand off the plane
//! ```
//!
//! A match must lie within a tolerance of that piece; the competition is what lies within a wider one.

use super::{
    block::{Features, Pair},
    relative::{Correspondence, Ray, RelativePose, vector},
    verify::{GeometricVerificationOptions, PairMatches, all_rays, finer_px, orient_matched},
};
use crate::{
    camera::Camera,
    features::{DESCRIPTOR_LENGTH, DescriptorSource, Descriptors, matching::distance_squared},
};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use rowgram_optim::robust::sigma_of_errors;

/// Pairs with as many matches are not matched again.
const WEAK_PAIR_MATCHES: usize = 150;
/// Distance from its piece of line up to which a feature may match, pixels, in each round.
const TOLERANCES_PX: [f64; 2] = [12.0, 6.0];
/// Distance up to which features compete, pixels.
pub(super) const CONTEXT_PX: f64 = 40.0;
/// Largest distance of descriptors relative to that of the next competitor.
const MAX_DISTANCE_RATIO: f64 = 0.8;
/// Largest distance of two descriptors, their length taken as 1.
const MAX_DISTANCE: f64 = 0.8;
/// The least and the greatest half length of the piece of an epipolar line that is searched, as a share of the depth.
const HALF_LENGTHS: [f64; 2] = [0.03, 0.25];
/// Features of one feature's surroundings that are the same again, pixels: one place with two orientations.
pub(super) const SAME_PX: f64 = 2.0;
/// Side of a bucket, in distances up to which features compete.
pub(super) const BUCKET: f64 = 2.0;

/// The inverse depth over an image, and how far points are off it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ground {
    /// `1/depth = a + b x + c y`, in units of the baseline.
    pub plane: [f64; 3],
    /// Half of the range of depths, as a share of the depth.
    pub slack: f64,
}

impl Ground {
    /// The ground under the first image of a pair by its matches; `None` where they do not tell.
    pub fn of(pose: &RelativePose, matches: &[Correspondence], slack: [f64; 2]) -> Option<Ground> {
        let points: Vec<[f64; 3]> = matches
            .iter()
            .filter_map(|c| {
                let [depth, other] = pose.depths(c)?;
                (depth > 0.0 && other > 0.0).then(|| [c.first[0], c.first[1], 1.0 / depth])
            })
            .collect();
        Ground::through(&points, slack)
    }

    /// The ground through points: rays free of distortion and inverse depths; `None` where they do not tell.
    pub(super) fn through(points: &[[f64; 3]], slack: [f64; 2]) -> Option<Ground> {
        if points.len() < 6 {
            return None;
        }
        let mut weights = vec![1.0; points.len()];
        let mut plane = [0.0; 3];
        let mut spread = 0.0;
        for _ in 0..6 {
            plane = fit(points, &weights)?;
            let off: Vec<f64> = points
                .iter()
                .map(|[x, y, inverse]| inverse / at(&plane, [*x, *y]).max(1e-12) - 1.0)
                .collect();
            spread = sigma_of_errors(off.iter().copied())?;
            let scale = 2.0 * spread.max(1e-6);
            for (weight, off) in weights.iter_mut().zip(&off) {
                *weight = 1.0 / (1.0 + (off / scale).powi(2)).powi(2);
            }
        }
        Some(Ground { plane, slack: (4.0 * spread).clamp(slack[0], slack[1]) })
    }

    fn inverse_depth(&self, ray: Ray) -> f64 {
        at(&self.plane, ray)
    }
}

fn at(plane: &[f64; 3], ray: Ray) -> f64 {
    plane[0] + plane[1] * ray[0] + plane[2] * ray[1]
}

fn fit(points: &[[f64; 3]], weights: &[f64]) -> Option<[f64; 3]> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for ([x, y, inverse], weight) in points.iter().zip(weights) {
        let row = Vector3::new(1.0, *x, *y);
        normal += *weight * row * row.transpose();
        right += *weight * *inverse * row;
    }
    // A narrow band of points tells no slope across it: hold that at nothing.
    let ridge = 1e-6 * normal.trace();
    normal[(1, 1)] += ridge;
    normal[(2, 2)] += ridge;
    Some((normal.cholesky()?.solve(&right)).into())
}

/// What a photo is known by: where its features look, and how they look.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'a> {
    /// Rays free of distortion.
    pub rays: &'a [Option<Ray>],
    /// One for each of them.
    pub descriptors: &'a Descriptors,
}

/// Places in a plane by buckets.
pub(super) struct Buckets {
    from: Ray,
    side: f64,
    columns: usize,
    rows: usize,
    starts: Vec<u32>,
    members: Vec<u32>,
}

impl Buckets {
    pub(super) fn new(rays: &[Option<Ray>], side: f64) -> Buckets {
        let mut from = [f64::INFINITY; 2];
        let mut to = [f64::NEG_INFINITY; 2];
        for ray in rays.iter().flatten() {
            for k in 0..2 {
                from[k] = from[k].min(ray[k]);
                to[k] = to[k].max(ray[k]);
            }
        }
        if rays.iter().flatten().next().is_none() {
            (from, to) = ([0.0; 2], [0.0; 2]);
        }
        // A lens that looks nearly sideways would ask for very many.
        let side = side.max((to[0] - from[0]).max(to[1] - from[1]) / 2000.0);
        let count = |k: usize| ((to[k] - from[k]) / side) as usize + 1;
        let (columns, rows) = (count(0), count(1));
        let mut buckets = Buckets {
            from,
            side,
            columns,
            rows,
            starts: vec![0; columns * rows + 1],
            members: Vec::new(),
        };
        let places: Vec<Option<usize>> = rays
            .iter()
            .map(|ray| ray.map(|ray| buckets.column(ray[0]) + columns * buckets.row(ray[1])))
            .collect();
        places.iter().flatten().for_each(|&place| buckets.starts[place + 1] += 1);
        for k in 0..columns * rows {
            buckets.starts[k + 1] += buckets.starts[k];
        }
        let mut next = buckets.starts.clone();
        buckets.members = vec![0; places.iter().flatten().count()];
        for (index, place) in places.iter().enumerate() {
            if let Some(place) = *place {
                buckets.members[next[place] as usize] = index as u32;
                next[place] += 1;
            }
        }
        buckets
    }

    fn column(&self, x: f64) -> usize {
        (((x - self.from[0]) / self.side).max(0.0) as usize).min(self.columns - 1)
    }

    fn row(&self, y: f64) -> usize {
        (((y - self.from[1]) / self.side).max(0.0) as usize).min(self.rows - 1)
    }

    /// Calls `visit` for all members that may be within `reach` of a piece of line.
    pub(super) fn near(&self, [a, b]: [Ray; 2], reach: f64, mut visit: impl FnMut(u32)) {
        let low = |k: usize| a[k].min(b[k]) - reach;
        let high = |k: usize| a[k].max(b[k]) + reach;
        let beyond = |k: usize, count: usize| {
            high(k) < self.from[k] || low(k) > self.from[k] + self.side * count as f64
        };
        if beyond(0, self.columns) || beyond(1, self.rows) {
            return;
        }
        for row in self.row(low(1))..=self.row(high(1)) {
            let place = |x: f64| self.column(x) + self.columns * row;
            let (first, last) = (place(low(0)), place(high(0)));
            let range = self.starts[first] as usize..self.starts[last + 1] as usize;
            self.members[range].iter().for_each(|&member| visit(member));
        }
    }
}

/// Distance from a piece of line.
pub(super) fn distance([a, b]: [Ray; 2], p: Ray) -> f64 {
    let d = [b[0] - a[0], b[1] - a[1]];
    let square = d[0] * d[0] + d[1] * d[1];
    let along = if square > 0.0 {
        (((p[0] - a[0]) * d[0] + (p[1] - a[1]) * d[1]) / square).clamp(0.0, 1.0)
    } else {
        0.0
    };
    length([p[0] - a[0] - along * d[0], p[1] - a[1] - along * d[1]])
}

/// The length of a difference of rays, whose squares cannot overflow; `hypot` takes ten times as long.
fn length([x, y]: Ray) -> f64 {
    (x * x + y * y).sqrt()
}

/// The features of two photos that match where the ground has them; no feature is in two matches.
pub fn rematch(
    [first, second]: [Seen<'_>; 2],
    pose: &RelativePose,
    ground: &Ground,
    principal_distance_px: f64,
    tolerance_px: f64,
) -> Vec<[u32; 2]> {
    let tolerance = tolerance_px / principal_distance_px;
    let context = (CONTEXT_PX / principal_distance_px).max(tolerance);
    let buckets = Buckets::new(second.rays, BUCKET * context);
    let piece = |index: usize| {
        let ray = first.rays[index]?;
        let inverse = ground.inverse_depth(ray);
        if inverse <= 1e-9 {
            return None;
        }
        let [from, to] = [1.0 - ground.slack, 1.0 + ground.slack].map(|part| {
            let p = pose.rotation * vector(ray) * (part / inverse) + pose.translation;
            (p.z < -1e-6).then(|| [p.x / -p.z, p.y / -p.z])
        });
        Some([from?, to?])
    };
    let reach = Reach { tolerance, context, same: SAME_PX / principal_distance_px };
    compete(first.descriptors, second, &buckets, &piece, &reach)
}

/// Distances in the second photo, in the unit of its places.
pub(super) struct Reach {
    /// From its piece of line up to which a feature may match.
    pub(super) tolerance: f64,
    /// Up to which features compete.
    pub(super) context: f64,
    /// Up to which two are the same place.
    pub(super) same: f64,
}

/// Every feature of a first photo against those of a second one near the `piece` of line that is its own; no
/// feature is in two matches.
pub(super) fn compete(
    first: &Descriptors,
    second: Seen<'_>,
    buckets: &Buckets,
    piece: &dyn Fn(usize) -> Option<[Ray; 2]>,
    reach: &Reach,
) -> Vec<[u32; 2]> {
    let most = (512.0 * MAX_DISTANCE).powi(2);
    let theirs = second.descriptors.as_bytes().as_chunks::<DESCRIPTOR_LENGTH>().0;
    // For each of the second photo's features: who of the first looks most like it.
    let mut liked = vec![(u32::MAX, u32::MAX); second.rays.len()];
    let mut chosen: Vec<[u32; 2]> = Vec::new();
    let mut seen: Vec<(u32, u32, bool)> = Vec::new();
    for (index, descriptor) in first.iter().enumerate() {
        let Some(piece) = piece(index) else { continue };
        seen.clear();
        buckets.near(piece, reach.context, |other| {
            let Some(at) = second.rays[other as usize] else { return };
            let off = distance(piece, at);
            if off <= reach.context {
                let apart = distance_squared(descriptor, &theirs[other as usize]);
                seen.push((apart, other, off <= reach.tolerance));
            }
        });
        for &(apart, other, inside) in &seen {
            if inside {
                let best = &mut liked[other as usize];
                *best = (*best).min((apart, index as u32));
            }
        }
        let Some(&(apart, best, _)) = seen.iter().filter(|(_, _, inside)| *inside).min() else {
            continue;
        };
        let Some(at) = second.rays[best as usize] else { continue };
        let next = seen
            .iter()
            .filter(|(_, other, _)| {
                let away = |p: Ray| length([p[0] - at[0], p[1] - at[1]]);
                second.rays[*other as usize].is_some_and(|p| away(p) > reach.same)
            })
            .map(|(apart, _, _)| *apart)
            .min()
            // Alone, it must be like its partner as such.
            .unwrap_or(most as u32);
        let square = f64::from(apart);
        if square <= most && square < MAX_DISTANCE_RATIO * MAX_DISTANCE_RATIO * f64::from(next) {
            chosen.push([index as u32, best]);
        }
    }
    chosen.retain(|[index, other]| liked[*other as usize].1 == *index);
    chosen
}

/// Looks again at the pairs that have few matches; each becomes what it was or better. `tell` is called for
/// each pair.
pub fn rematch_weak_pairs(
    features: &[Features],
    descriptors: &dyn DescriptorSource,
    cameras: &[Camera],
    pairs: &[Pair],
    verifying: &GeometricVerificationOptions,
    tell: &(dyn Fn() + Sync),
) -> Vec<Pair> {
    let all = all_rays(features, cameras);
    in_parts(pairs, |pair| {
        let mut best = pair.clone();
        for tolerance_px in TOLERANCES_PX {
            if best.matches.len() >= WEAK_PAIR_MATCHES {
                break;
            }
            let of = best.images.map(|k| k as usize);
            let looks = of.map(|k| descriptors.descriptors(k));
            let c = finer_px(of.map(|k| &cameras[features[k].camera]));
            let right: Vec<Correspondence> = best
                .matches
                .iter()
                .filter_map(|[a, b]| {
                    let first = all[of[0]][*a as usize]?;
                    Some(Correspondence { first, second: all[of[1]][*b as usize]? })
                })
                .collect();
            let Some(ground) = Ground::of(&best.pose, &right, HALF_LENGTHS) else { break };
            let seen = [0, 1].map(|k| Seen { rays: &all[of[k]], descriptors: &looks[k] });
            let mut matches = rematch(seen, &best.pose, &ground, c, tolerance_px);
            join(&mut matches, &best.matches);
            let matched = PairMatches { images: best.images, matches };
            let again = orient_matched(&matched, of.map(|k| all[k].as_slice()), c, verifying);
            match again {
                Some(again) if again.matches.len() > best.matches.len() => best = again,
                _ => break,
            }
        }
        tell();
        best
    })
}

/// Pairs that are looked at together: neighbours in the list have photos in common, whose descriptors then are in memory.
const TOGETHER: usize = 512;

/// Does the same with every pair, one part of the list after the other.
pub(super) fn in_parts<P: Sync, T: Send>(pairs: &[P], each: impl Fn(&P) -> T + Sync) -> Vec<T> {
    let mut found = Vec::with_capacity(pairs.len());
    for part in pairs.chunks(TOGETHER) {
        found.par_extend(part.par_iter().map(&each));
    }
    found
}

/// Adds the matches of `known` whose features are free.
pub(super) fn join(matches: &mut Vec<[u32; 2]>, known: &[[u32; 2]]) {
    let mut taken: [std::collections::BTreeSet<u32>; 2] = Default::default();
    for found in matches.iter() {
        (0..2).for_each(|k| {
            taken[k].insert(found[k]);
        });
    }
    matches.extend(known.iter().filter(|m| (0..2).all(|k| !taken[k].contains(&m[k]))));
    matches.sort_unstable();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::matching::{MatchOptions, match_descriptors};
    use rand::{Rng, RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Two cameras above a slope on which every leaf looks like some twenty others: rays, looks, and which
    /// of the second photo's features is which of the first's.
    type Pictures = ([Vec<Option<Ray>>; 2], [Descriptors; 2], RelativePose);

    const C_PX: f64 = 1000.0;

    fn crop(count: usize) -> Pictures {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let kinds: Vec<Vec<u8>> = (0..25)
            .map(|_| {
                let mut bytes = vec![0; DESCRIPTOR_LENGTH];
                rng.fill_bytes(&mut bytes);
                bytes.iter().map(|byte| byte / 4).collect()
            })
            .collect();
        let turn = nalgebra::Rotation3::from_euler_angles(0.04, -0.03, 0.1).into_inner();
        let pose = RelativePose {
            rotation: turn,
            translation: Vector3::new(-0.98, 0.17, 0.1).normalize(),
        };
        let mut rays: [Vec<Option<Ray>>; 2] = Default::default();
        let mut looks: [Vec<u8>; 2] = Default::default();
        for index in 0..count {
            let first = [rng.random_range(-0.8..0.8), rng.random_range(-0.6..0.6)];
            let depth = (1.0 + 0.02 * rng.random_range(-1.0..1.0)) / (0.4 + 0.03 * first[0]);
            let p = pose.rotation * vector(first) * depth + pose.translation;
            let mut noise = || rng.random_range(-0.5..0.5) / C_PX;
            rays[0].push(Some(first));
            rays[1].push(Some([p.x / -p.z + noise(), p.y / -p.z + noise()]));
            for looks in &mut looks {
                let kind = &kinds[index % kinds.len()];
                looks.extend(kind.iter().map(|byte| byte + rng.random_range(0..16u8)));
            }
        }
        let looks = looks.map(|bytes| Descriptors::from_bytes(bytes).unwrap());
        (rays, looks, pose)
    }

    #[test]
    fn leaves_that_look_alike_are_told_apart_by_where_the_ground_is() {
        let count = 800;
        let (rays, looks, pose) = crop(count);
        let by_looks = match_descriptors(&looks[0], &looks[1], &MatchOptions::default());
        let right = by_looks.iter().filter(|m| m.first == m.second).count();
        assert!(right < count / 20, "{right}: by their looks alone they can be told apart");
        let few: Vec<Correspondence> = (0..30)
            .map(|k| Correspondence {
                first: rays[0][17 * k].unwrap(),
                second: rays[1][17 * k].unwrap(),
            })
            .collect();
        let ground = Ground::of(&pose, &few, HALF_LENGTHS).unwrap();
        assert!((ground.plane[0] - 0.4).abs() < 0.01, "{ground:?}");
        assert!(ground.slack <= 0.1, "{ground:?}");
        let seen = [0, 1].map(|k| Seen { rays: &rays[k], descriptors: &looks[k] });
        let found = rematch(seen, &pose, &ground, C_PX, 6.0);
        let right = found.iter().filter(|[a, b]| a == b).count();
        assert!(right > count / 2, "{right} of {count}");
        assert!(20 * right > 19 * found.len(), "{right} of {} are right", found.len());
        for side in 0..2 {
            let mut own: Vec<u32> = found.iter().map(|m| m[side]).collect();
            own.sort_unstable();
            own.dedup();
            assert_eq!(own.len(), found.len(), "no feature is in two matches");
        }
    }

    #[test]
    fn nothing_to_see_gives_nothing() {
        let (rays, looks, pose) = crop(40);
        assert_eq!(Ground::of(&pose, &[], HALF_LENGTHS), None);
        let ground = Ground { plane: [0.4, 0.0, 0.0], slack: 0.1 };
        let none = Descriptors::default();
        let (empty, blind) = (Vec::new(), vec![None; 40]);
        for other in [
            Seen { rays: &empty, descriptors: &none },
            Seen { rays: &blind, descriptors: &looks[1] },
        ] {
            let own = Seen { rays: &rays[0], descriptors: &looks[0] };
            assert_eq!(rematch([own, other], &pose, &ground, C_PX, 6.0), [[0u32; 2]; 0]);
            assert_eq!(rematch([other, own], &pose, &ground, C_PX, 6.0), [[0u32; 2]; 0]);
        }
    }
}
