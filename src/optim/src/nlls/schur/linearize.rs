//! Linearisation of one tile, laid out one observation after the other, loss included.

use super::{
    Settings,
    lanes::{CameraCache, LaneBuffer, LaneGroups, coordinates, load_all},
    layout::{Buffers, Layout, MAX_CAMERA_RECORD, MAX_RECORD, padded, point_record},
};
use crate::{
    lanes::{Lane, MAX_WIDTH, Register, scatter},
    nlls::{factor::robust_weights, projection::SizedFactor},
};
use pulp::Simd;
use std::ops::Range;

/// Writes the rows of Jacobians by the point and the residuals as records.
#[inline(always)]
fn scatter_points<V: Simd, const R: usize, const P: usize>(
    simd: V,
    jacobian_point: &[[Register<V>; P]; R],
    residual: &[Register<V>; R],
    to: &mut [f64],
) {
    let mut record = [residual[0]; MAX_RECORD];
    for row in 0..R {
        for k in 0..P {
            record[row * (P + 1) + k] = jacobian_point[row][k];
        }
        record[row * (P + 1) + P] = residual[row];
    }
    scatter(simd, &record[..R * (P + 1)], to, point_record(R, P));
}

/// Linearises the observations of `tile` into the buffers.
#[inline(always)]
pub(super) fn linearize_tile<
    V: Simd,
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    tile: Range<usize>,
    prepared: &CameraCache,
    x: &[f64],
    settings: &Settings<'_>,
    buffers: &mut Buffers,
) {
    let origin = layout.points[tile.start].first as usize;
    let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
    let (mut buffer, mut groups) = (LaneBuffer::<P, D>::new(), LaneGroups::new(layout, &tile));
    let width = Register::<V>::WIDTH;
    while let Some((first, count)) = groups.fill(&mut buffer, layout, width, value) {
        let (point, data) = buffer.load(simd);
        let prepared = load_all(simd, &buffer.cameras::<V, Q>(simd, prepared));
        let found = F::linearize(&prepared, &point, &data);
        let to = &mut buffers.jacobian_point[first * point_record(R, P)..];
        scatter_points(simd, &found.jacobian_point, &found.residual, to);
        for row in 0..R {
            let to = &mut buffers.jacobian_camera[(first * R + row) * padded(K)..];
            scatter(simd, &found.jacobian_camera[row], to, R * padded(K));
            if S > 0 && !layout.lens_columns.is_empty() {
                let mut free = [found.residual[0]; S];
                for (to, &k) in free.iter_mut().zip(&layout.lens_columns) {
                    *to = found.jacobian_shared[row][k];
                }
                let to = &mut buffers.jacobian_shared[(first * R + row) * layout.lens_width()..];
                let count = layout.lens_columns.len();
                scatter(simd, &free[..count], to, R * layout.lens_width());
            }
        }
        if !settings.loss.is_trivial() {
            for o in first..first + count {
                weigh::<V, R, K, P>(simd, settings, buffers, layout.lens_width(), o);
            }
        }
        if !layout.camera_mask.is_empty() || !layout.lens_mask.is_empty() {
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

/// The same for `R` rows of whole registers.
#[inline(always)]
fn fold_rows<V: Simd, const R: usize>(
    simd: V,
    values: &mut [f64],
    &(weight, shift, residual): &(f64, f64, [f64; R]),
) {
    let registers = V::as_mut_simd_f64s(values).0;
    let width = registers.len() / R;
    let weight = simd.splat_f64s(weight);
    for k in 0..width {
        let mut along = simd.splat_f64s(0.0);
        for row in 0..R {
            let r = simd.splat_f64s(residual[row]);
            along = simd.mul_add_e_f64s(r, registers[row * width + k], along);
        }
        for row in 0..R {
            let r = simd.splat_f64s(-shift * residual[row]);
            let left = simd.mul_add_e_f64s(r, along, registers[row * width + k]);
            registers[row * width + k] = simd.mul_f64s(weight, left);
        }
    }
}

/// Folds the loss into one linearised observation.
#[inline(always)]
fn weigh<V: Simd, const R: usize, const K: usize, const P: usize>(
    simd: V,
    settings: &Settings<'_>,
    buffers: &mut Buffers,
    lens_width: usize,
    o: usize,
) {
    let record = &mut buffers.jacobian_point[o * point_record(R, P)..(o + 1) * point_record(R, P)];
    let weights = weigh_point::<R, P>(settings, record);
    let (retained, shared) = (R * padded(K), R * lens_width);
    fold_rows(simd, &mut buffers.jacobian_camera[o * retained..(o + 1) * retained], &weights);
    fold_rows(simd, &mut buffers.jacobian_shared[o * shared..(o + 1) * shared], &weights);
}

/// Folds the loss into the residual and the Jacobian by the point; returns `(weight, shift, r)`.
#[inline(always)]
fn weigh_point<const R: usize, const P: usize>(
    settings: &Settings<'_>,
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
    if let Some(mask) = layout.camera_mask.get(camera) {
        for row in buffers.jacobian_camera[o * R * padded(K)..].chunks_exact_mut(padded(K)).take(R)
        {
            row.iter_mut().zip(mask).for_each(|(v, mask)| *v *= mask);
        }
    }
    if let Some(mask) = layout.lens_mask.get(layout.cameras[camera].lens as usize) {
        let width = layout.lens_width();
        for row in buffers.jacobian_shared[o * R * width..].chunks_exact_mut(width).take(R) {
            row.iter_mut().zip(mask).for_each(|(v, mask)| *v *= mask);
        }
    }
}

/// For each observation of `tile` its residual, Jacobian by the point, and `Jc d_c + Js d_s`.
#[inline(always)]
pub(super) fn apply_tile<
    V: Simd,
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    tile: Range<usize>,
    prepared: &CameraCache,
    x: &[f64],
    settings: &Settings<'_>,
    buffers: &mut Buffers,
) {
    let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
    let (mut buffer, mut groups) = (LaneBuffer::<P, D>::new(), LaneGroups::new(layout, &tile));
    let width = Register::<V>::WIDTH;
    while let Some((first, count)) = groups.fill(&mut buffer, layout, width, value) {
        let (point, data) = buffer.load(simd);
        let mut records = [[0.0; MAX_WIDTH]; MAX_CAMERA_RECORD];
        buffer.gather(simd, prepared, &mut records[..Q + K + S]);
        let mut camera = [Register::load(simd, &records[0]); Q];
        for k in 0..Q {
            camera[k] = Register::load(simd, &records[k]);
        }
        let found = F::linearize(&camera, &point, &data);
        let to = &mut buffers.jacobian_point[first * point_record(R, P)..];
        scatter_points(simd, &found.jacobian_point, &found.residual, to);
        let mut along = found.residual;
        for row in 0..R {
            along[row] = found.jacobian_camera[row][0] * Register::load(simd, &records[Q]);
            for k in 1..K {
                let d = Register::load(simd, &records[Q + k]);
                along[row] = found.jacobian_camera[row][k].mul_add(d, along[row]);
            }
            for k in 0..S {
                let d = Register::load(simd, &records[Q + K + k]);
                along[row] = found.jacobian_shared[row][k].mul_add(d, along[row]);
            }
        }
        scatter(simd, &along, &mut buffers.along[first * R..], R);
        if !settings.loss.is_trivial() {
            for o in first..first + count {
                let record = &mut buffers.jacobian_point[o * point_record(R, P)..];
                let weights = weigh_point::<R, P>(settings, record);
                fold(&mut buffers.along[o * R..], 1, 1, &weights);
            }
        }
    }
}
