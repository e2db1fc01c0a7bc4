//! Products in single precision, in any instruction set; all are below 2^24, so they are exact whole numbers.

use super::{COLUMNS, DESCRIPTOR_LENGTH, Descriptors, Nearest, ROWS, best_of, half, square};
use pulp::{Arch, Simd, WithSimd};

/// Squared length of a descriptor that is not there, beyond the 128 * 127^2 of any that is.
const ABSENT: f32 = 8_388_608.0;

/// A set in panels of some descriptors each, in which the numbers of one dimension are contiguous.
#[derive(Debug, Clone)]
pub(super) struct Panels {
    arch: Arch,
    among: usize,
    panels: Vec<f32>,
    /// Squared lengths, panel by panel; what fills the last panel up is farther than anything.
    squares: Vec<f32>,
}

impl Panels {
    pub(super) fn new(descriptors: &Descriptors, arch: Arch) -> Panels {
        let (panels, squares) = arch.dispatch(LayOut { descriptors });
        Panels { arch, among: descriptors.len(), panels, squares }
    }

    /// The two nearest of each of one task's descriptors.
    pub(super) fn nearest(&self, descriptors: &[[u8; DESCRIPTOR_LENGTH]]) -> Vec<Nearest> {
        self.arch.dispatch(Compare { descriptors, set: self })
    }
}

struct LayOut<'a> {
    descriptors: &'a Descriptors,
}

impl WithSimd for LayOut<'_> {
    type Output = (Vec<f32>, Vec<f32>);

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        let width = COLUMNS * S::F32_LANES;
        let count = self.descriptors.len().div_ceil(width);
        let mut panels = vec![0.0; count * width * DESCRIPTOR_LENGTH];
        let mut squares = vec![ABSENT; count * width];
        for (index, descriptor) in self.descriptors.iter().enumerate() {
            let panel = &mut panels[index / width * width * DESCRIPTOR_LENGTH..];
            for (dimension, &byte) in descriptor.iter().enumerate() {
                panel[dimension * width + index % width] = half(byte).into();
            }
            squares[index] = square(descriptor).next_multiple_of(2) as f32;
        }
        (panels, squares)
    }
}

/// Compares one task's descriptors with all of a set.
struct Compare<'a> {
    descriptors: &'a [[u8; DESCRIPTOR_LENGTH]],
    set: &'a Panels,
}

impl WithSimd for Compare<'_> {
    type Output = Vec<Nearest>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<Nearest> {
        let groups = self.descriptors.len().div_ceil(ROWS);
        // By groups of rows, laid out as the panels are; rows that are not there are zero.
        let mut rows = vec![0.0; groups * ROWS * DESCRIPTOR_LENGTH];
        for (index, descriptor) in self.descriptors.iter().enumerate() {
            let group = &mut rows[index / ROWS * ROWS * DESCRIPTOR_LENGTH..];
            for (dimension, &byte) in descriptor.iter().enumerate() {
                group[dimension * ROWS + index % ROWS] = half(byte).into();
            }
        }
        let lowest = simd.splat_f32s(f32::MIN);
        let start =
            Best::<S> { closeness: lowest, runner_up: lowest, register: simd.splat_f32s(0.0) };
        let mut best = vec![[start; ROWS]; groups];
        let width = COLUMNS * S::F32_LANES;
        let panels = self.set.panels.chunks_exact(width * DESCRIPTOR_LENGTH);
        let squares = self.set.squares.chunks_exact(width);
        for (panel, (numbers, squares)) in panels.zip(squares).enumerate() {
            for (rows, best) in rows.chunks_exact(ROWS * DESCRIPTOR_LENGTH).zip(&mut best) {
                let products = multiply(simd, rows, numbers);
                keep_best(simd, &products, squares, panel, best);
            }
        }
        let nearest = |(index, descriptor): (usize, &[u8; DESCRIPTOR_LENGTH])| {
            let best = &best[index / ROWS][index % ROWS];
            let closeness = lanes::<S>(&best.closeness);
            let runner_up = lanes::<S>(&best.runner_up);
            let register = lanes::<S>(&best.register);
            let seen = (0..S::F32_LANES).map(|lane| {
                let own = register[lane] as u32 * S::F32_LANES as u32 + lane as u32;
                (closeness[lane] as i32, own, runner_up[lane] as i32)
            });
            best_of(seen, square(descriptor), self.set.among)
        };
        self.descriptors.iter().enumerate().map(nearest).collect()
    }
}

/// The best of the columns that a lane has seen; closeness is `2 a.b - |b|^2`.
#[derive(Clone, Copy)]
struct Best<S: Simd> {
    closeness: S::f32s,
    runner_up: S::f32s,
    register: S::f32s,
}

/// The products of [`ROWS`] descriptors with the [`COLUMNS`] registers of a panel.
#[inline(always)]
fn multiply<S: Simd>(simd: S, rows: &[f32], panel: &[f32]) -> [[S::f32s; COLUMNS]; ROWS] {
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

#[inline(always)]
fn lanes<S: Simd>(register: &S::f32s) -> &[f32] {
    pulp::bytemuck::cast_slice(std::slice::from_ref(register))
}
