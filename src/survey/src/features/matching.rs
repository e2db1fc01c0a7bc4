//! Correspondences: nearest neighbours in both directions that pass the ratio test.
//!
//! Of descriptor `a` the nearest is `b` with the smallest `|a|^2 + |b|^2 - 2 a.b`, where the numbers of both are
//! halved and rounded down, and `|b|^2` is rounded up to an even number: seven bits hold all that tells two features
//! apart, and with them a product of two descriptors of the usual length fits into sixteen bits. All products
//! of two sets are computed, in blocks that stay in the cache and registers, by `bytes` where the machine and the
//! set allow it and by `floats` elsewhere; both are exact, so the result is the same on any machine. A match is
//! kept where each is the other's nearest and each is nearer than `ratio` times the second nearest.

#[cfg(target_arch = "x86_64")]
mod bytes;
mod floats;

use super::{DESCRIPTOR_LENGTH, Descriptors};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Descriptors of the first set in one task.
const TASK: usize = 96;
/// Descriptors of the first set that are compared together.
const ROWS: usize = 6;
/// Registers of the second set that they are compared with.
const COLUMNS: usize = 2;

/// Which correspondences are kept.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MatchOptions {
    /// Largest distance relative to that of the second nearest; 1 and above accept everything.
    pub ratio: f32,
    /// Largest distance of two descriptors, their length taken as 1 (so at most the root of 2).
    pub max_distance: f32,
    /// Whether nearest and ratio must hold from the second set to the first as well.
    pub mutual: bool,
}

impl Default for MatchOptions {
    fn default() -> MatchOptions {
        MatchOptions { ratio: 0.8, max_distance: 0.8, mutual: true }
    }
}

/// Two features that look alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Match {
    /// Index in the first set.
    pub first: u32,
    /// Index in the second set.
    pub second: u32,
    /// Squared distance of the descriptors, whose length is about 512.
    pub distance_squared: u32,
}

/// The nearest and the second nearest descriptor of another set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Nearest {
    /// Index of the nearest; of several, the lowest.
    pub index: u32,
    /// Its squared distance, from numbers rounded down to even ones.
    pub distance_squared: u32,
    /// Likewise of the second nearest, `u32::MAX` where there is none.
    pub second_distance_squared: u32,
}

impl Nearest {
    fn passes_ratio_test(&self, ratio: f32) -> bool {
        let (nearest, ratio) = (f64::from(self.distance_squared), f64::from(ratio));
        ratio >= 1.0 || nearest < ratio * ratio * f64::from(self.second_distance_squared)
    }
}

/// Squared distance of two descriptors.
pub(crate) fn distance_squared(a: &[u8; DESCRIPTOR_LENGTH], b: &[u8; DESCRIPTOR_LENGTH]) -> u32 {
    a.iter().zip(b).map(|(&a, &b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

/// The correspondences of two sets, by rising index in the first.
///
/// With `mutual` no feature is in two of them, and exchanging the sets exchanges the indices only.
pub fn match_descriptors(
    first: &Descriptors,
    second: &Descriptors,
    options: &MatchOptions,
) -> Vec<Match> {
    match_prepared(&Prepared::new(first), &Prepared::new(second), options)
}

/// As [`match_descriptors`], with sets that are used several times prepared once.
pub fn match_prepared(
    first: &Prepared<'_>,
    second: &Prepared<'_>,
    options: &MatchOptions,
) -> Vec<Match> {
    let forward = nearest_prepared(first.descriptors, second);
    let [(all, _), (others, _)] =
        [first, second].map(|set| set.descriptors.as_bytes().as_chunks::<DESCRIPTOR_LENGTH>());
    let limit = (512.0 * f64::from(options.max_distance)).powi(2);
    let pairs = forward.iter().zip(all).enumerate();
    let mut matches: Vec<Match> = pairs
        .filter(|(_, (nearest, _))| nearest.passes_ratio_test(options.ratio))
        .map(|(index, (nearest, descriptor))| Match {
            first: index as u32,
            second: nearest.index,
            distance_squared: distance_squared(descriptor, &others[nearest.index as usize]),
        })
        .filter(|m| f64::from(m.distance_squared) <= limit)
        .collect();
    if options.mutual && !matches.is_empty() {
        // Only those that somebody is nearest to need to be asked.
        let mut asked: Vec<usize> = matches.iter().map(|m| m.second as usize).collect();
        asked.sort_unstable();
        asked.dedup();
        let backward = nearest_prepared(&second.descriptors.select(&asked), first);
        matches.retain(|m| {
            let at = asked.partition_point(|&index| index < m.second as usize);
            backward.get(at).is_some_and(|nearest| {
                nearest.index == m.first && nearest.passes_ratio_test(options.ratio)
            })
        });
    }
    matches
}

/// For each descriptor of `first` the two nearest in `second`; empty where `second` is.
pub fn nearest(first: &Descriptors, second: &Descriptors) -> Vec<Nearest> {
    nearest_prepared(first, &Prepared::new(second))
}

/// As [`nearest`], with the second set prepared.
pub fn nearest_prepared(first: &Descriptors, second: &Prepared<'_>) -> Vec<Nearest> {
    if second.descriptors.is_empty() {
        return Vec::new();
    }
    let (all, _) = first.as_bytes().as_chunks::<DESCRIPTOR_LENGTH>();
    let found: Vec<Vec<Nearest>> = all
        .par_chunks(TASK)
        .map(|task| match &second.panels {
            Panels::Floats(panels) => panels.nearest(task),
            #[cfg(target_arch = "x86_64")]
            Panels::Bytes(panels) => panels.nearest(task, second.descriptors),
        })
        .collect();
    found.concat()
}

/// A set that others are compared with, laid out for it.
#[derive(Debug, Clone)]
pub struct Prepared<'a> {
    descriptors: &'a Descriptors,
    panels: Panels,
}

#[derive(Debug, Clone)]
enum Panels {
    Floats(floats::Panels),
    #[cfg(target_arch = "x86_64")]
    Bytes(bytes::Panels),
}

impl<'a> Prepared<'a> {
    /// Lays out a set; costs at most five bytes for each of its bytes.
    pub fn new(descriptors: &'a Descriptors) -> Prepared<'a> {
        #[cfg(target_arch = "x86_64")]
        if let Some(panels) = bytes::Panels::new(descriptors) {
            return Prepared { descriptors, panels: Panels::Bytes(panels) };
        }
        let panels = floats::Panels::new(descriptors, pulp::Arch::new());
        Prepared { descriptors, panels: Panels::Floats(panels) }
    }

    /// The set.
    pub fn descriptors(&self) -> &'a Descriptors {
        self.descriptors
    }
}

/// A number of a descriptor as it is compared.
#[inline(always)]
fn half(byte: u8) -> u8 {
    byte >> 1
}

/// Squared length of a descriptor as it is compared.
#[inline(always)]
fn square(descriptor: &[u8; DESCRIPTOR_LENGTH]) -> u32 {
    descriptor.iter().map(|&byte| u32::from(half(byte)) * u32::from(half(byte))).sum()
}

/// The best over the lanes, each of which has seen every so many-th descriptor: its nearest, by how close it is
/// and its index, and how close the runner-up is. Closeness is `2 a.b - |b|^2`; `square` is `|a|^2`.
#[inline(always)]
fn best_of(lanes: impl Iterator<Item = (i32, u32, i32)>, square: u32, among: usize) -> Nearest {
    let (mut first, mut second, mut index) = (i32::MIN, i32::MIN, u32::MAX);
    for (closeness, own, runner_up) in lanes {
        if closeness > first || closeness == first && own < index {
            second = second.max(first);
            (first, index) = (closeness, own);
        } else {
            second = second.max(closeness);
        }
        second = second.max(runner_up);
    }
    // Twice as long as what was compared, as the descriptors are.
    let distance = |closeness: i32| (4 * (i64::from(square) - i64::from(closeness))) as u32;
    Nearest {
        index,
        distance_squared: distance(first),
        second_distance_squared: if among > 1 { distance(second) } else { u32::MAX },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random(random: &mut ChaCha8Rng, count: usize) -> Descriptors {
        let mut bytes = vec![0; count * DESCRIPTOR_LENGTH];
        random.fill_bytes(&mut bytes);
        Descriptors::from_bytes(bytes).unwrap()
    }

    /// Descriptors of about the length of real ones.
    fn usual(random: &mut ChaCha8Rng, count: usize) -> Descriptors {
        let bytes = self::random(random, count).as_bytes().to_vec();
        Descriptors::from_bytes(bytes.iter().map(|&b| (u32::from(b) * 75 / 255) as u8).collect())
            .unwrap()
    }

    /// The definition, pair by pair.
    fn by_definition(first: &Descriptors, second: &Descriptors) -> Vec<Nearest> {
        let of = |a: &[u8; DESCRIPTOR_LENGTH]| {
            let mut all: Vec<(u32, u32)> = second
                .iter()
                .enumerate()
                .map(|(index, b)| {
                    let odd: u32 = b.iter().map(|&b| u32::from(b / 2).pow(2)).sum::<u32>() % 2;
                    let distance = distance_squared(&a.map(|a| a / 2), &b.map(|b| b / 2));
                    (4 * (distance + odd), index as u32)
                })
                .collect();
            all.sort_unstable();
            Nearest {
                index: all[0].1,
                distance_squared: all[0].0,
                second_distance_squared: all.get(1).map_or(u32::MAX, |second| second.0),
            }
        };
        first.iter().map(of).collect()
    }

    const SIZES: [(usize, usize); 6] = [(1, 1), (5, 2), (97, 31), (130, 67), (7, 300), (3, 32)];

    #[test]
    fn the_nearest_are_those_of_the_definition() {
        let mut source = ChaCha8Rng::seed_from_u64(1);
        for (rows, columns) in SIZES {
            let sets = [random, usual].map(|of| (of(&mut source, rows), of(&mut source, columns)));
            for (first, second) in [
                (&sets[0].0, &sets[0].1),
                (&sets[1].0, &sets[1].1),
                (&sets[0].0, &sets[1].1),
                (&sets[1].0, &sets[0].1),
            ] {
                assert_eq!(nearest(first, second), by_definition(first, second));
            }
        }
    }

    /// One descriptor for each value, which all its numbers have.
    fn flat(values: &[u8]) -> Descriptors {
        let bytes = values.iter().flat_map(|&value| [value; DESCRIPTOR_LENGTH]).collect();
        Descriptors::from_bytes(bytes).unwrap()
    }

    #[test]
    fn the_largest_and_equal_numbers_are_exact() {
        let (first, second) = (flat(&[0, 255, 254, 45]), flat(&[255, 0, 255, 0]));
        assert_eq!(nearest(&first, &second), by_definition(&first, &second));
        // Of the length 508 all, where sixteen bits are nearly full.
        let mut spikes = flat(&[44, 44]).as_bytes().to_vec();
        spikes.extend((0..DESCRIPTOR_LENGTH).map(|at| if at < 4 { 254 } else { 0 }));
        spikes.extend((0..DESCRIPTOR_LENGTH).map(|at| if at > 123 { 254 } else { 0 }));
        let spikes = Descriptors::from_bytes(spikes).unwrap();
        assert_eq!(nearest(&spikes, &spikes), by_definition(&spikes, &spikes));
        let far = nearest(&flat(&[0]), &flat(&[255]));
        assert_eq!(far[0].distance_squared, 128 * 254 * 254);
        assert_eq!(far[0].second_distance_squared, u32::MAX);
    }

    #[test]
    fn every_instruction_set_gives_the_same() {
        let mut source = ChaCha8Rng::seed_from_u64(2);
        let (first, second) = (usual(&mut source, 40), usual(&mut source, 90));
        let own = nearest(&first, &second);
        let (rows, _) = first.as_bytes().as_chunks::<DESCRIPTOR_LENGTH>();
        for arch in [pulp::Arch::Scalar, pulp::Arch::new()] {
            assert_eq!(floats::Panels::new(&second, arch).nearest(rows), own);
        }
    }

    /// A second set that holds noisy copies of some of the first in another order.
    fn two_views(seed: u64) -> (Descriptors, Descriptors) {
        let mut source = ChaCha8Rng::seed_from_u64(seed);
        let first = random(&mut source, 200);
        let mut bytes = random(&mut source, 50).as_bytes().to_vec();
        for index in (0..200).rev().step_by(2) {
            let copy = &first.as_bytes()[index * DESCRIPTOR_LENGTH..][..DESCRIPTOR_LENGTH];
            bytes.extend(copy.iter().map(|&b| b.saturating_add(source.random_range(0..9))));
        }
        (first, Descriptors::from_bytes(bytes).unwrap())
    }

    #[test]
    fn copies_are_found_and_nothing_else() {
        let (first, second) = two_views(3);
        let options = MatchOptions { max_distance: 10.0, ..MatchOptions::default() };
        let matches = match_descriptors(&first, &second, &options);
        assert_eq!(matches.len(), 100);
        for m in &matches {
            assert_eq!(m.second, 50 + (199 - m.first) / 2, "copies stand in reverse order");
            let (a, b) = (m.first as usize, m.second as usize);
            let of = |set: &Descriptors, at: usize| *set.iter().nth(at).unwrap();
            assert_eq!(m.distance_squared, distance_squared(&of(&first, a), &of(&second, b)));
        }
        let near = MatchOptions { max_distance: 0.05, ..options };
        let near = match_descriptors(&first, &second, &near);
        assert!(near.iter().all(|m| m.distance_squared <= 655) && near.len() < 100);
    }

    #[test]
    fn exchanging_the_sets_exchanges_the_indices() {
        let (first, second) = two_views(4);
        let options = MatchOptions { ratio: 0.97, max_distance: 10.0, mutual: true };
        let forward = match_descriptors(&first, &second, &options);
        let mut backward: Vec<Match> = match_descriptors(&second, &first, &options)
            .into_iter()
            .map(|m| Match { first: m.second, second: m.first, ..m })
            .collect();
        backward.sort_unstable_by_key(|m| m.first);
        assert_eq!(forward, backward);
        let one_way = MatchOptions { mutual: false, ..options };
        assert!(match_descriptors(&first, &second, &one_way).len() >= forward.len());
    }

    #[test]
    fn nothing_matches_nothing() {
        let some = two_views(5).0;
        let none = Descriptors::default();
        let options = MatchOptions::default();
        assert_eq!(match_descriptors(&none, &none, &options), []);
        assert_eq!(match_descriptors(&some, &none, &options), []);
        assert_eq!(match_descriptors(&none, &some, &options), []);
    }
}
