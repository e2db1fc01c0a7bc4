//! Correspondences: nearest neighbours in both directions that pass the ratio test.
//!
//! Of descriptor `a` the nearest is `b` with the smallest `|a|^2 + |b|^2 - 2 a.b`. All products of two sets
//! are computed, in blocks that stay in the cache and registers, with whole numbers where the machine multiplies
//! those in pairs; all are below 2^24, so single precision holds them exactly too and the result is the same on any
//! machine. A match is
//! kept where each is the other's nearest and each is nearer than `ratio` times the second nearest.

use super::{DESCRIPTOR_LENGTH, Descriptors};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Descriptors of the first set in one task.
const TASK: usize = 96;
/// Descriptors of the first set that are compared together.
const ROWS: usize = 6;
/// Registers of the second set that they are compared with.
const COLUMNS: usize = 2;

/// Squared length of a descriptor that is not there, beyond the 128 * 255^2 of any that is.
const ABSENT: f32 = 8_388_608.0;

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
    /// Its squared distance.
    pub distance_squared: u32,
    /// Squared distance of the second nearest, `u32::MAX` where there is none.
    pub second_distance_squared: u32,
}

impl Nearest {
    fn passes(&self, options: &MatchOptions) -> bool {
        let nearest = f64::from(self.distance_squared);
        let ratio = f64::from(options.ratio);
        let limit = 512.0 * f64::from(options.max_distance);
        (ratio >= 1.0 || nearest < ratio * ratio * f64::from(self.second_distance_squared))
            && nearest <= limit * limit
    }
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
    let mut matches: Vec<Match> = forward
        .iter()
        .enumerate()
        .filter(|(_, nearest)| nearest.passes(options))
        .map(|(index, nearest)| Match {
            first: index as u32,
            second: nearest.index,
            distance_squared: nearest.distance_squared,
        })
        .collect();
    if options.mutual && !matches.is_empty() {
        // Only those that somebody is nearest to need to be asked.
        let mut asked: Vec<usize> = matches.iter().map(|m| m.second as usize).collect();
        asked.sort_unstable();
        asked.dedup();
        let backward = nearest_prepared(&second.descriptors.select(&asked), first);
        matches.retain(|m| {
            let at = asked.partition_point(|&index| index < m.second as usize);
            backward
                .get(at)
                .is_some_and(|nearest| nearest.index == m.first && nearest.passes(options))
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
    let found: Vec<Vec<Nearest>> = first
        .as_bytes()
        .par_chunks(TASK * DESCRIPTOR_LENGTH)
        .map(|bytes| match &second.panels {
            Panels::Floats(panels) => {
                pulp::Arch::new().dispatch(Compare { bytes, panels, squares: &second.squares })
            }
            #[cfg(target_arch = "x86_64")]
            Panels::Words(simd, panels) => {
                let (simd, squares) = (*simd, second.squares.as_slice());
                simd.vectorize(words::Compare { simd, bytes, panels, squares })
            }
        })
        .collect();
    found.concat()
}

/// A set that others are compared with, laid out for it.
#[derive(Debug, Clone)]
pub struct Prepared<'a> {
    descriptors: &'a Descriptors,
    panels: Panels,
    /// Squared lengths, panel by panel; what fills the last panel up is farther than anything.
    squares: Vec<f32>,
}

/// Panels of some descriptors each, in which the numbers of some dimensions are contiguous.
#[derive(Debug, Clone)]
enum Panels {
    /// One dimension after the other.
    Floats(Vec<f32>),
    /// Pairs of dimensions, for multiplications that add two products.
    #[cfg(target_arch = "x86_64")]
    Words(pulp::x86::V3, Vec<i16>),
}

impl<'a> Prepared<'a> {
    /// Lays out a set; costs at most four bytes for each of its bytes.
    pub fn new(descriptors: &'a Descriptors) -> Prepared<'a> {
        #[cfg(target_arch = "x86_64")]
        if let Some(simd) = pulp::x86::V3::try_new() {
            let (panels, squares) = lay_out::<pulp::x86::V3, words::Words>(descriptors);
            return Prepared { descriptors, panels: Panels::Words(simd, panels), squares };
        }
        Prepared::in_floats(descriptors, pulp::Arch::new())
    }

    fn in_floats(descriptors: &'a Descriptors, arch: pulp::Arch) -> Prepared<'a> {
        let (panels, squares) = arch.dispatch(Prepare { descriptors });
        Prepared { descriptors, panels: Panels::Floats(panels), squares }
    }

    /// The set.
    pub fn descriptors(&self) -> &'a Descriptors {
        self.descriptors
    }
}

/// How a group of rows is multiplied with a panel.
trait Kernel<S: Simd> {
    /// What is multiplied.
    type Number: Copy + Default + From<u8>;
    /// Dimensions whose numbers are contiguous.
    const DEEP: usize;

    /// The products of [`ROWS`] descriptors with the [`COLUMNS`] registers of a panel.
    fn products(
        simd: S,
        rows: &[Self::Number],
        panel: &[Self::Number],
    ) -> [[S::f32s; COLUMNS]; ROWS];
}

/// Where the number of one dimension of a descriptor is, in a group of `width` of them.
#[inline(always)]
fn place(width: usize, deep: usize, descriptor: usize, dimension: usize) -> usize {
    (dimension / deep * width + descriptor) * deep + dimension % deep
}

/// The panels of a set and the squared lengths.
#[inline(always)]
fn lay_out<S: Simd, K: Kernel<S>>(descriptors: &Descriptors) -> (Vec<K::Number>, Vec<f32>) {
    let width = COLUMNS * S::F32_LANES;
    let count = descriptors.len().div_ceil(width);
    let mut panels = vec![K::Number::default(); count * width * DESCRIPTOR_LENGTH];
    let mut squares = vec![ABSENT; count * width];
    for (index, descriptor) in descriptors.iter().enumerate() {
        let panel = &mut panels[index / width * width * DESCRIPTOR_LENGTH..];
        let mut square = 0;
        for (dimension, &byte) in descriptor.iter().enumerate() {
            panel[place(width, K::DEEP, index % width, dimension)] = byte.into();
            square += u32::from(byte) * u32::from(byte);
        }
        squares[index] = square as f32;
    }
    (panels, squares)
}

struct Prepare<'a> {
    descriptors: &'a Descriptors,
}

impl WithSimd for Prepare<'_> {
    type Output = (Vec<f32>, Vec<f32>);

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        lay_out::<S, Floats>(self.descriptors)
    }
}

/// Compares one task's descriptors with all of a set.
struct Compare<'a> {
    bytes: &'a [u8],
    panels: &'a [f32],
    squares: &'a [f32],
}

impl WithSimd for Compare<'_> {
    type Output = Vec<Nearest>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<Nearest> {
        compare::<S, Floats>(simd, self.bytes, self.panels, self.squares)
    }
}

/// The best of the columns that a lane has seen; closeness is `2 a.b - |b|^2`.
#[derive(Clone, Copy)]
struct Best<S: Simd> {
    closeness: S::f32s,
    runner_up: S::f32s,
    register: S::f32s,
}

/// The two nearest of each of one task's descriptors.
#[inline(always)]
fn compare<S: Simd, K: Kernel<S>>(
    simd: S,
    bytes: &[u8],
    panels: &[K::Number],
    squares: &[f32],
) -> Vec<Nearest> {
    let (descriptors, _) = bytes.as_chunks::<DESCRIPTOR_LENGTH>();
    let groups = descriptors.len().div_ceil(ROWS);
    // By groups of rows, laid out as the panels are; rows that are not there are zero.
    let mut rows = vec![K::Number::default(); groups * ROWS * DESCRIPTOR_LENGTH];
    for (index, descriptor) in descriptors.iter().enumerate() {
        let group = &mut rows[index / ROWS * ROWS * DESCRIPTOR_LENGTH..];
        for (dimension, &byte) in descriptor.iter().enumerate() {
            group[place(ROWS, K::DEEP, index % ROWS, dimension)] = byte.into();
        }
    }
    let lowest = simd.splat_f32s(f32::MIN);
    let start = Best::<S> { closeness: lowest, runner_up: lowest, register: simd.splat_f32s(0.0) };
    let mut best = vec![[start; ROWS]; groups];
    let width = COLUMNS * S::F32_LANES;
    let panels = panels.chunks_exact(width * DESCRIPTOR_LENGTH);
    let squares = squares.chunks_exact(width);
    for (panel, (numbers, squares)) in panels.zip(squares).enumerate() {
        for (rows, best) in rows.chunks_exact(ROWS * DESCRIPTOR_LENGTH).zip(&mut best) {
            let products = K::products(simd, rows, numbers);
            keep_best(simd, &products, squares, panel, best);
        }
    }
    let mut found = Vec::with_capacity(descriptors.len());
    for (index, descriptor) in descriptors.iter().enumerate() {
        let square: u32 = descriptor.iter().map(|&b| u32::from(b) * u32::from(b)).sum();
        found.push(reduce(&best[index / ROWS][index % ROWS], square));
    }
    found
}

/// One dimension at a time, in any instruction set.
struct Floats;

impl<S: Simd> Kernel<S> for Floats {
    type Number = f32;
    const DEEP: usize = 1;

    #[inline(always)]
    fn products(simd: S, rows: &[f32], panel: &[f32]) -> [[S::f32s; COLUMNS]; ROWS] {
        let (rows, _) = rows.as_chunks::<ROWS>();
        let (panel, _) = S::as_simd_f32s(panel);
        let (panel, _) = panel.as_chunks::<COLUMNS>();
        let mut products = [[simd.splat_f32s(0.0); COLUMNS]; ROWS];
        for (numbers, columns) in rows.iter().zip(panel) {
            for row in 0..ROWS {
                let number = simd.splat_f32s(numbers[row]);
                for column in 0..COLUMNS {
                    products[row][column] =
                        simd.mul_add_e_f32s(number, columns[column], products[row][column]);
                }
            }
        }
        products
    }
}

/// Two dimensions at a time, with the multiplication of x86 that adds pairs of products.
#[cfg(target_arch = "x86_64")]
mod words {
    use super::{COLUMNS, Kernel, Nearest, ROWS, compare};
    use pulp::{NullaryFnOnce, Simd, cast, f32x8, x86::V3};
    use std::arch::x86_64::__m256i;

    pub(super) struct Words;

    impl Kernel<V3> for Words {
        type Number = i16;
        const DEEP: usize = 2;

        #[inline(always)]
        fn products(simd: V3, rows: &[i16], panel: &[i16]) -> [[f32x8; COLUMNS]; ROWS] {
            let (avx, avx2) = (simd.avx, simd.avx2);
            let (rows, _) = rows.as_chunks::<2>();
            let (rows, _) = rows.as_chunks::<ROWS>();
            let (panel, _) = panel.as_chunks::<16>();
            let (panel, _) = panel.as_chunks::<COLUMNS>();
            let mut products = [[avx._mm256_setzero_si256(); COLUMNS]; ROWS];
            for (numbers, columns) in rows.iter().zip(panel) {
                let columns: [__m256i; COLUMNS] = [cast(columns[0]), cast(columns[1])];
                for row in 0..ROWS {
                    let number = avx._mm256_set1_epi32(cast(numbers[row]));
                    for column in 0..COLUMNS {
                        let both = avx2._mm256_madd_epi16(number, columns[column]);
                        products[row][column] = avx2._mm256_add_epi32(products[row][column], both);
                    }
                }
            }
            let mut sums = [[simd.splat_f32s(0.0); COLUMNS]; ROWS];
            for row in 0..ROWS {
                for column in 0..COLUMNS {
                    // Below 2^24.
                    sums[row][column] = cast(avx._mm256_cvtepi32_ps(products[row][column]));
                }
            }
            sums
        }
    }

    /// Compares one task's descriptors with all of a set.
    pub(super) struct Compare<'a> {
        pub(super) simd: V3,
        pub(super) bytes: &'a [u8],
        pub(super) panels: &'a [i16],
        pub(super) squares: &'a [f32],
    }

    impl NullaryFnOnce for Compare<'_> {
        type Output = Vec<Nearest>;

        #[inline(always)]
        fn call(self) -> Vec<Nearest> {
            compare::<V3, Words>(self.simd, self.bytes, self.panels, self.squares)
        }
    }
}

/// Keeps the best of what a group of rows and one panel come to.
#[inline(always)]
fn keep_best<S: Simd>(
    simd: S,
    products: &[[S::f32s; COLUMNS]; ROWS],
    squares: &[f32],
    panel: usize,
    best: &mut [Best<S>; ROWS],
) {
    let (squares, _) = S::as_simd_f32s(squares);
    for row in 0..ROWS {
        let state = &mut best[row];
        for column in 0..COLUMNS {
            let twice = simd.add_f32s(products[row][column], products[row][column]);
            let closeness = simd.sub_f32s(twice, squares[column]);
            let register = simd.splat_f32s((panel * COLUMNS + column) as f32);
            let better = simd.less_than_f32s(state.closeness, closeness);
            let loser = simd.min_f32s(state.closeness, closeness);
            state.runner_up = simd.max_f32s(state.runner_up, loser);
            state.closeness = simd.max_f32s(state.closeness, closeness);
            state.register = simd.select_f32s(better, register, state.register);
        }
    }
}

/// The best over the lanes; `square` is the descriptor's own squared length.
#[inline(always)]
fn reduce<S: Simd>(best: &Best<S>, square: u32) -> Nearest {
    let closeness = lanes::<S>(&best.closeness);
    let runner_up = lanes::<S>(&best.runner_up);
    let register = lanes::<S>(&best.register);
    let (mut first, mut second, mut index) = (f32::MIN, f32::MIN, u32::MAX);
    for lane in 0..S::F32_LANES {
        let own = register[lane] as u32 * S::F32_LANES as u32 + lane as u32;
        if closeness[lane] > first || closeness[lane] == first && own < index {
            second = second.max(first);
            (first, index) = (closeness[lane], own);
        } else {
            second = second.max(closeness[lane]);
        }
        second = second.max(runner_up[lane]);
    }
    let distance = |closeness: f32| {
        if closeness <= -ABSENT { u32::MAX } else { (square as f32 - closeness) as u32 }
    };
    Nearest { index, distance_squared: distance(first), second_distance_squared: distance(second) }
}

#[inline(always)]
fn lanes<S: Simd>(register: &S::f32s) -> &[f32] {
    pulp::bytemuck::cast_slice(std::slice::from_ref(register))
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

    fn distance_squared(a: &[u8], b: &[u8]) -> u32 {
        a.iter().zip(b).map(|(&a, &b)| u32::from(a.abs_diff(b)).pow(2)).sum()
    }

    /// The definition, pair by pair.
    fn by_definition(first: &Descriptors, second: &Descriptors) -> Vec<Nearest> {
        let of = |a: &[u8; DESCRIPTOR_LENGTH]| {
            let mut all: Vec<(u32, u32)> = second
                .iter()
                .enumerate()
                .map(|(index, b)| (distance_squared(a, b), index as u32))
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

    #[test]
    fn the_nearest_are_those_of_the_definition() {
        let mut source = ChaCha8Rng::seed_from_u64(1);
        for (rows, columns) in [(1, 1), (5, 2), (97, 31), (130, 67), (7, 300)] {
            let (first, second) = (random(&mut source, rows), random(&mut source, columns));
            assert_eq!(nearest(&first, &second), by_definition(&first, &second));
        }
    }

    #[test]
    fn the_largest_and_equal_numbers_are_exact() {
        let of = |values: &[u8]| {
            let bytes = values.iter().flat_map(|&value| [value; DESCRIPTOR_LENGTH]).collect();
            Descriptors::from_bytes(bytes).unwrap()
        };
        let (first, second) = (of(&[0, 255, 254]), of(&[255, 0, 255, 0]));
        assert_eq!(nearest(&first, &second), by_definition(&first, &second));
        let far = nearest(&of(&[0]), &of(&[255]));
        assert_eq!(far[0].distance_squared, 128 * 255 * 255);
        assert_eq!(far[0].second_distance_squared, u32::MAX);
    }

    #[test]
    fn every_instruction_set_gives_the_same() {
        let mut source = ChaCha8Rng::seed_from_u64(2);
        let (first, second) = (random(&mut source, 40), random(&mut source, 90));
        let own = nearest(&first, &second);
        assert_eq!(own, by_definition(&first, &second));
        for arch in [pulp::Arch::Scalar, pulp::Arch::new()] {
            let prepared = Prepared::in_floats(&second, arch);
            let Panels::Floats(panels) = &prepared.panels else { panic!("asked for floats") };
            let job = Compare { bytes: first.as_bytes(), panels, squares: &prepared.squares };
            assert_eq!(arch.dispatch(job), own);
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
            let distance = distance_squared(
                &first.as_bytes()[a * DESCRIPTOR_LENGTH..][..DESCRIPTOR_LENGTH],
                &second.as_bytes()[b * DESCRIPTOR_LENGTH..][..DESCRIPTOR_LENGTH],
            );
            assert_eq!(m.distance_squared, distance);
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
