//! Products in sixteen bits, with the multiplication of x86 that adds pairs of products of bytes.
//!
//! Every sum starts from `-|b|^2 / 2`. In between it may leave the sixteen bits and wrap around, but it comes
//! back: `a.b - |b|^2 / 2` is at most `|a|^2 / 2` and at least `-|b|^2 / 2`, and both fit where no squared
//! length is above [`LONGEST`]. Descriptors of the usual length, 512 before halving, are; sets with others are
//! left to [`super::floats`].

use super::{COLUMNS, DESCRIPTOR_LENGTH, Descriptors, Nearest, ROWS, best_of, half, square};
use pulp::{NullaryFnOnce, cast, x86::V3};
use std::arch::x86_64::__m256i;

/// Largest squared length, and with it twice the largest number of sixteen bits.
const LONGEST: u32 = 2 * i16::MAX as u32;
/// Descriptors in a register, each with two dimensions.
const LANES: usize = 16;
/// Descriptors in a panel.
const WIDTH: usize = COLUMNS * LANES;
/// Pairs of dimensions.
const PAIRS: usize = DESCRIPTOR_LENGTH / 2;

/// Two dimensions of the descriptors of a panel.
type Columns = [[[u8; 2]; LANES]; COLUMNS];
/// Two dimensions of a group of rows, each twice so that four bytes can be spread over a register.
type Rows = [[[u8; 2]; 2]; ROWS];

/// A set in panels of [`WIDTH`] descriptors, in which pairs of dimensions are contiguous.
#[derive(Debug, Clone)]
pub(super) struct Panels {
    simd: V3,
    among: usize,
    panels: Vec<[Columns; PAIRS]>,
    /// `-|b|^2 / 2`, rounded down; the smallest number where there is no descriptor.
    starts: Vec<[[i16; LANES]; COLUMNS]>,
}

impl Panels {
    /// `None` where the machine cannot do it or the set does not fit.
    pub(super) fn new(descriptors: &Descriptors) -> Option<Panels> {
        let simd = V3::try_new()?;
        let count = descriptors.len().div_ceil(WIDTH);
        if count * COLUMNS > usize::from(u16::MAX) {
            return None;
        }
        let mut panels = vec![[[[[0; 2]; LANES]; COLUMNS]; PAIRS]; count];
        let mut starts = vec![[[i16::MIN; LANES]; COLUMNS]; count];
        for (index, descriptor) in descriptors.iter().enumerate() {
            let (panel, column, lane) =
                (index / WIDTH, index % WIDTH / LANES, index % WIDTH % LANES);
            let square = square(descriptor);
            if square > LONGEST {
                return None;
            }
            starts[panel][column][lane] = -(square.div_ceil(2) as i16);
            let (pairs, _) = descriptor.as_chunks::<2>();
            for (pair, columns) in pairs.iter().zip(&mut panels[panel]) {
                columns[column][lane] = pair.map(half);
            }
        }
        Some(Panels { simd, among: descriptors.len(), panels, starts })
    }

    /// The two nearest of each of one task's descriptors; `set` is what the panels were made of.
    pub(super) fn nearest(
        &self,
        descriptors: &[[u8; DESCRIPTOR_LENGTH]],
        set: &Descriptors,
    ) -> Vec<Nearest> {
        let mut found = self.simd.vectorize(Compare { descriptors, set: self });
        for (descriptor, nearest) in descriptors.iter().zip(&mut found) {
            let square = square(descriptor);
            if square > LONGEST {
                *nearest = one_by_one(descriptor, square, set);
            }
        }
        found
    }
}

/// The two nearest of a descriptor that is too long for sixteen bits.
fn one_by_one(descriptor: &[u8; DESCRIPTOR_LENGTH], length: u32, set: &Descriptors) -> Nearest {
    let closeness = set.iter().enumerate().map(|(index, other)| {
        let both = descriptor.iter().zip(other);
        let product: u32 = both.map(|(&a, &b)| u32::from(half(a)) * u32::from(half(b))).sum();
        let closeness = 2 * product as i32 - square(other).next_multiple_of(2) as i32;
        (closeness, index as u32, i32::MIN)
    });
    best_of(closeness, length, set.len())
}

/// Compares one task's descriptors with all of a set.
struct Compare<'a> {
    descriptors: &'a [[u8; DESCRIPTOR_LENGTH]],
    set: &'a Panels,
}

/// The best of the columns that a lane has seen; closeness is `a.b - |b|^2 / 2`.
#[derive(Clone, Copy)]
struct Best {
    closeness: __m256i,
    runner_up: __m256i,
    register: __m256i,
}

impl NullaryFnOnce for Compare<'_> {
    type Output = Vec<Nearest>;

    #[inline(always)]
    fn call(self) -> Vec<Nearest> {
        let Panels { simd, among, ref panels, ref starts } = *self.set;
        let groups = self.descriptors.len().div_ceil(ROWS);
        // Rows that are not there are zero.
        let mut rows: Vec<[Rows; PAIRS]> = vec![[[[[0; 2]; 2]; ROWS]; PAIRS]; groups];
        for (index, descriptor) in self.descriptors.iter().enumerate() {
            let (pairs, _) = descriptor.as_chunks::<2>();
            for (pair, group) in pairs.iter().zip(&mut rows[index / ROWS]) {
                group[index % ROWS] = [pair.map(half); 2];
            }
        }
        let lowest = simd.avx._mm256_set1_epi16(i16::MIN);
        let register = simd.avx._mm256_setzero_si256();
        let start = Best { closeness: lowest, runner_up: lowest, register };
        let mut best = vec![[start; ROWS]; groups];
        for (panel, (numbers, starts)) in panels.iter().zip(starts).enumerate() {
            for (rows, best) in rows.iter().zip(&mut best) {
                let closeness = multiply(simd, rows, numbers, starts);
                keep_best(simd, &closeness, panel, best);
            }
        }
        let nearest = |(index, descriptor): (usize, &[u8; DESCRIPTOR_LENGTH])| {
            let best = best[index / ROWS][index % ROWS];
            let closeness: [i16; LANES] = cast(best.closeness);
            let runner_up: [i16; LANES] = cast(best.runner_up);
            let register: [u16; LANES] = cast(best.register);
            let seen = (0..LANES).map(|lane| {
                let own = u32::from(register[lane]) * LANES as u32 + lane as u32;
                (2 * i32::from(closeness[lane]), own, 2 * i32::from(runner_up[lane]))
            });
            best_of(seen, square(descriptor), among)
        };
        self.descriptors.iter().enumerate().map(nearest).collect()
    }
}

/// The products of a group of rows with a panel, on top of `starts`.
#[inline(always)]
fn multiply(
    simd: V3,
    rows: &[Rows; PAIRS],
    panel: &[Columns; PAIRS],
    starts: &[[i16; LANES]; COLUMNS],
) -> [[__m256i; COLUMNS]; ROWS] {
    let (avx, avx2) = (simd.avx, simd.avx2);
    let starts: [__m256i; COLUMNS] = cast(*starts);
    let mut sums = [starts; ROWS];
    for (numbers, columns) in rows.iter().zip(panel) {
        let columns: [__m256i; COLUMNS] = cast(*columns);
        for row in 0..ROWS {
            let number = avx._mm256_set1_epi32(cast(numbers[row]));
            for column in 0..COLUMNS {
                let both = avx2._mm256_maddubs_epi16(number, columns[column]);
                sums[row][column] = avx2._mm256_add_epi16(sums[row][column], both);
            }
        }
    }
    sums
}

/// Keeps the best of what a group of rows and one panel come to.
#[inline(always)]
fn keep_best(simd: V3, sums: &[[__m256i; COLUMNS]; ROWS], panel: usize, best: &mut [Best; ROWS]) {
    let (avx, avx2) = (simd.avx, simd.avx2);
    for row in 0..ROWS {
        let state = &mut best[row];
        for column in 0..COLUMNS {
            let closeness = sums[row][column];
            let register = avx._mm256_set1_epi16((panel * COLUMNS + column) as u16 as i16);
            let better = avx2._mm256_cmpgt_epi16(closeness, state.closeness);
            let loser = avx2._mm256_min_epi16(state.closeness, closeness);
            state.runner_up = avx2._mm256_max_epi16(state.runner_up, loser);
            state.closeness = avx2._mm256_max_epi16(state.closeness, closeness);
            state.register = avx2._mm256_blendv_epi8(state.register, register, better);
        }
    }
}
