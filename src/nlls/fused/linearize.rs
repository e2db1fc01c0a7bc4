//! Linearisation of one chunk, laid out one observation after the other, loss included.

use super::{
    Settings,
    groups::{Groups, Records, Stage, coordinates, load_all},
    layout::{Buffers, Layout, MAX_CAMERA_RECORD, MAX_RECORD, padded, point_record},
};
use crate::{
    lanes::{Lane, MAX_WIDTH, Register, scatter},
    nlls::{factor::robust_weights, loss::Loss, pairs::PairFactor},
};
use pulp::Simd;
use std::ops::Range;

/// Writes the rows of Jacobians by the point and the residuals as records.
#[inline(always)]
fn scatter_points<V: Simd, const R: usize, const P: usize>(
    simd: V,
    by_point: &[[Register<V>; P]; R],
    residual: &[Register<V>; R],
    to: &mut [f64],
) {
    let mut record = [residual[0]; MAX_RECORD];
    for row in 0..R {
        for k in 0..P {
            record[row * (P + 1) + k] = by_point[row][k];
        }
        record[row * (P + 1) + P] = residual[row];
    }
    scatter(simd, &record[..R * (P + 1)], to, point_record(R, P));
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
    prepared: &Records,
    x: &[f64],
    settings: &Settings,
    buffers: &mut Buffers,
) {
    let origin = layout.points[chunk.start].first as usize;
    let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
    let (mut stage, mut groups) = (Stage::<P, D>::new(), Groups::new(layout, &chunk));
    let width = Register::<V>::WIDTH;
    while let Some((first, count)) = groups.fill(&mut stage, layout, width, value) {
        let (point, data) = stage.load(simd);
        let prepared = load_all(simd, &stage.cameras::<V, Q>(simd, prepared));
        let found = F::linearize(&prepared, &point, &data);
        let to = &mut buffers.by_point[first * point_record(R, P)..];
        scatter_points(simd, &found.by_point, &found.residual, to);
        for row in 0..R {
            let to = &mut buffers.by_kept[(first * R + row) * padded(K)..];
            scatter(simd, &found.by_kept[row], to, R * padded(K));
            if S > 0 {
                let to = &mut buffers.by_shared[first * padded(R * S) + row * S..];
                scatter(simd, &found.by_shared[row], to, padded(R * S));
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
    &(weight, shift, residual): &(f64, f64, [f64; R]),
) {
    for k in 0..count {
        let mut along = 0.0;
        for row in 0..R {
            along += residual[row] * values[row * stride + k];
        }
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
    let record = &mut buffers.by_point[o * point_record(R, P)..];
    let weights = weigh_point::<R, P>(settings, record);
    fold(&mut buffers.by_kept[o * R * padded(K)..], padded(K), K, &weights);
    fold(&mut buffers.by_shared[o * padded(R * S)..], S, S, &weights);
}

/// Folds the loss into the residual and the Jacobian by the point; returns `(weight, shift, r)`.
#[inline(always)]
fn weigh_point<const R: usize, const P: usize>(
    settings: &Settings,
    record: &mut [f64],
) -> (f64, f64, [f64; R]) {
    let mut residual = [0.0; R];
    let mut square = 0.0;
    for row in 0..R {
        residual[row] = record[row * (P + 1) + P];
        square += residual[row] * residual[row];
    }
    let found = robust_weights(settings.loss, settings.curvature_share, square);
    let weights = (found.jacobian, found.shift, residual);
    fold(record, P + 1, P, &weights);
    for row in 0..R {
        record[row * (P + 1) + P] *= found.residual;
    }
    weights
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
            let at = o * padded(R * S) + row * S;
            let mask = &layout.lens_mask[layout.cameras[camera].lens as usize];
            for (v, mask) in buffers.by_shared[at..at + S].iter_mut().zip(mask) {
                *v *= mask;
            }
        }
    }
}

/// For each observation of `chunk` its residual, Jacobian by the point, and `Jc d_c + Js d_s`.
#[inline(always)]
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
    prepared: &Records,
    x: &[f64],
    settings: &Settings,
    buffers: &mut Buffers,
) {
    let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
    let (mut stage, mut groups) = (Stage::<P, D>::new(), Groups::new(layout, &chunk));
    let width = Register::<V>::WIDTH;
    while let Some((first, count)) = groups.fill(&mut stage, layout, width, value) {
        let (point, data) = stage.load(simd);
        let mut records = [[0.0; MAX_WIDTH]; MAX_CAMERA_RECORD];
        stage.gather(simd, prepared, &mut records[..Q + K + S]);
        let mut camera = [Register::load(simd, &records[0]); Q];
        for k in 0..Q {
            camera[k] = Register::load(simd, &records[k]);
        }
        let found = F::linearize(&camera, &point, &data);
        let to = &mut buffers.by_point[first * point_record(R, P)..];
        scatter_points(simd, &found.by_point, &found.residual, to);
        let mut along = found.residual;
        for row in 0..R {
            along[row] = found.by_kept[row][0] * Register::load(simd, &records[Q]);
            for k in 1..K {
                let d = Register::load(simd, &records[Q + k]);
                along[row] = found.by_kept[row][k].mul_add(d, along[row]);
            }
            for k in 0..S {
                let d = Register::load(simd, &records[Q + K + k]);
                along[row] = found.by_shared[row][k].mul_add(d, along[row]);
            }
        }
        scatter(simd, &along, &mut buffers.along[first * R..], R);
        if settings.loss != Loss::Trivial {
            for o in first..first + count {
                let record = &mut buffers.by_point[o * point_record(R, P)..];
                let weights = weigh_point::<R, P>(settings, record);
                fold(&mut buffers.along[o * R..], 1, 1, &weights);
            }
        }
    }
}
