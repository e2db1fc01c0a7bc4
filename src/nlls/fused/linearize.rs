//! Linearisation of one chunk, laid out one observation after the other, loss included.

use super::{
    Settings, fold_loss,
    groups::{Groups, Stage, coordinates},
    layout::{Buffers, Layout, padded},
};
use crate::{
    lanes::{Lane, MAX_WIDTH, Register},
    nlls::{loss::Loss, pairs::PairFactor},
};
use pulp::Simd;
use std::ops::Range;

/// Writes the lanes of `value` to `to`, `stride` apart. All of them, also those without an
/// observation: the next group writes over them, and the buffers have room behind the last.
#[inline(always)]
fn scatter<V: Simd>(value: Register<V>, to: &mut [f64], stride: usize) {
    let mut lanes = [0.0; MAX_WIDTH];
    value.store(&mut lanes);
    let to = &mut to[..(Register::<V>::WIDTH - 1) * stride + 1];
    for lane in 0..Register::<V>::WIDTH {
        to[lane * stride] = lanes[lane];
    }
}

/// Linearises the observations of `chunk` into the buffers.
#[inline(always)]
pub(super) fn linearize_chunk<
    V: Simd,
    F: PairFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    chunk: Range<usize>,
    prepared: &[[f64; Q]],
    x: &[f64],
    settings: &Settings,
    buffers: &mut Buffers,
) {
    let origin = layout.points[chunk.start].first as usize;
    let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
    let (mut stage, mut groups) = (Stage::<P, Q, D>::new(), Groups::new(layout, &chunk));
    let width = Register::<V>::WIDTH;
    while let Some((first, count)) = groups.fill(&mut stage, layout, width, prepared, value) {
        let (prepared, point, data) = stage.load(simd);
        let found = F::linearize(&prepared, &point, &data);
        for row in 0..R {
            let at = first * R + row;
            scatter(found.residual[row], &mut buffers.residual[at..], R);
            let (to, stride) = (&mut buffers.by_kept[at * padded(K)..], R * padded(K));
            for k in 0..K {
                scatter(found.by_kept[row][k], &mut to[k..], stride);
            }
            for k in 0..S {
                let to = &mut buffers.by_shared[at * S + k..];
                scatter(found.by_shared[row][k], to, R * S);
            }
            for k in 0..P {
                let to = &mut buffers.by_point[at * P + k..];
                scatter(found.by_point[row][k], to, R * P);
            }
        }
        if settings.loss != Loss::Trivial {
            for o in first..first + count {
                weigh::<R, K, S, P>(settings, buffers, o);
            }
        }
        if !layout.camera_mask.is_empty() {
            for o in first..first + count {
                freeze::<R, K, S, D>(layout, buffers, origin, o);
            }
        }
    }
}

/// `J~ = weight (J - shift r (r^T J))` for `count` columns of rows `stride` apart.
#[inline(always)]
fn fold<const R: usize>(
    values: &mut [f64],
    stride: usize,
    count: usize,
    (weight, shift, residual): (f64, f64, &[f64; R]),
) {
    for k in 0..count {
        let along: f64 = (0..R).map(|row| residual[row] * values[row * stride + k]).sum();
        for row in 0..R {
            let entry = &mut values[row * stride + k];
            *entry = weight * (*entry - shift * along * residual[row]);
        }
    }
}

/// Folds the loss into one linearised observation.
fn weigh<const R: usize, const K: usize, const S: usize, const P: usize>(
    settings: &Settings,
    buffers: &mut Buffers,
    o: usize,
) {
    let mut residual: [f64; R] = std::array::from_fn(|row| buffers.residual[o * R + row]);
    fold_loss(settings, &mut residual, |weight, shift, residual| {
        let weights = (weight, shift, residual);
        fold(&mut buffers.by_kept[o * R * padded(K)..], padded(K), K, weights);
        fold(&mut buffers.by_shared[o * R * S..], S, S, weights);
        fold(&mut buffers.by_point[o * R * P..], P, P, weights);
    });
    buffers.residual[o * R..(o + 1) * R].copy_from_slice(&residual);
}

/// Clears the columns of one observation that must not move.
fn freeze<const R: usize, const K: usize, const S: usize, const D: usize>(
    layout: &Layout<K, S, D>,
    buffers: &mut Buffers,
    origin: usize,
    o: usize,
) {
    let camera = layout.observed_by[origin + o] as usize;
    for row in 0..R {
        let at = (o * R + row) * padded(K);
        for (v, mask) in buffers.by_kept[at..at + K].iter_mut().zip(&layout.camera_mask[camera]) {
            *v *= mask;
        }
        if S > 0 {
            let at = (o * R + row) * S;
            let mask = &layout.lens_mask[layout.cameras[camera].lens as usize];
            for (v, mask) in buffers.by_shared[at..at + S].iter_mut().zip(mask) {
                *v *= mask;
            }
        }
    }
}

/// For each observation of `chunk` its residual, Jacobian by the point, and `Jc d_c + Js d_s`.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "one loop, called in one place")]
pub(super) fn apply_chunk<
    V: Simd,
    F: PairFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    chunk: Range<usize>,
    prepared: &[[f64; Q]],
    steps: &[([f64; K], [f64; S])],
    x: &[f64],
    settings: &Settings,
    buffers: &mut Buffers,
) {
    let origin = layout.points[chunk.start].first as usize;
    let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
    let mut kept = [[0.0; MAX_WIDTH]; K];
    let mut shared = [[0.0; MAX_WIDTH]; S];
    let (mut stage, mut groups) = (Stage::<P, Q, D>::new(), Groups::new(layout, &chunk));
    let width = Register::<V>::WIDTH;
    while let Some((first, count)) = groups.fill(&mut stage, layout, width, prepared, value) {
        for lane in 0..count {
            let step = &steps[layout.observed_by[origin + first + lane] as usize];
            for k in 0..K {
                kept[k][lane] = step.0[k];
            }
            for k in 0..S {
                shared[k][lane] = step.1[k];
            }
        }
        let (prepared, point, data) = stage.load(simd);
        let found = F::linearize(&prepared, &point, &data);
        for row in 0..R {
            let at = first * R + row;
            scatter(found.residual[row], &mut buffers.residual[at..], R);
            for k in 0..P {
                let to = &mut buffers.by_point[at * P + k..];
                scatter(found.by_point[row][k], to, R * P);
            }
            let mut along = found.by_kept[row][0] * Register::load(simd, &kept[0]);
            for k in 1..K {
                let d = Register::load(simd, &kept[k]);
                along = found.by_kept[row][k].mul_add(d, along);
            }
            for k in 0..S {
                let d = Register::load(simd, &shared[k]);
                along = found.by_shared[row][k].mul_add(d, along);
            }
            scatter(along, &mut buffers.along[at..], R);
        }
        if settings.loss != Loss::Trivial {
            for o in first..first + count {
                weigh_applied::<R, P>(settings, buffers, o);
            }
        }
    }
}

/// Folds the loss into one observation that [`apply_chunk`] made.
fn weigh_applied<const R: usize, const P: usize>(
    settings: &Settings,
    buffers: &mut Buffers,
    o: usize,
) {
    let mut residual: [f64; R] = std::array::from_fn(|row| buffers.residual[o * R + row]);
    fold_loss(settings, &mut residual, |weight, shift, residual| {
        let weights = (weight, shift, residual);
        fold(&mut buffers.by_point[o * R * P..], P, P, weights);
        fold(&mut buffers.along[o * R..], 1, 1, weights);
    });
    buffers.residual[o * R..(o + 1) * R].copy_from_slice(&residual);
}
