//! What points add to blocks that many cameras share: the arrow of the reduced system.

use super::layout::{Buffers, ChunkSums, Layout, padded, point_record};
use crate::nlls::structure::NONE;
use pulp::Simd;

/// Adds a point with observations `first..end` of the tile that begins with `origin`, and
/// `u = L^-1 g`.
#[inline(always)]
pub(super) fn add_shared<
    V: Simd,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    chunk: &mut ChunkSums<P>,
    buffers: &mut Buffers,
    (first, end): (usize, usize),
    origin: usize,
    u: &[f64; P],
) {
    if layout.lens_width() == 0 {
        return;
    }
    sum_observations::<V, R, K, S, P, D>(simd, layout, chunk, buffers, (first, end), origin);
    add_shared_pairs::<V, K, S, P, D>(simd, layout, chunk, buffers, u);
    add_camera_pairs::<V, R, K, S, P, D>(simd, layout, chunk, buffers, (first, end), origin);
}

/// `T_l = sum Q_i^T Js_i` over the observations through shared block `l`, and what needs no `T`: gradient, diagonal,
/// `Js^T Js`.
#[inline(always)]
fn sum_observations<
    V: Simd,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    chunk: &mut ChunkSums<P>,
    buffers: &mut Buffers,
    (first, end): (usize, usize),
    origin: usize,
) {
    let (lenses, width) = (layout.shared.len(), layout.lens_width());
    let columns = layout.lens_columns.len();
    buffers.lens_sums.fill(0.0);
    for i in 0..end - first {
        let camera = layout.observed_by[origin + first + i] as usize;
        let lens = layout.cameras[camera].lens as usize;
        let js = &buffers.jacobian_shared[(first + i) * R * width..(first + i + 1) * R * width];
        let own = lens * width..(lens + 1) * width;
        let gradient = V::as_mut_simd_f64s(&mut chunk.lens_gradient[own.clone()]).0;
        let diagonal = V::as_mut_simd_f64s(&mut chunk.lens_diagonal[own]).0;
        let own = lens * P * width..(lens + 1) * P * width;
        let sums = V::as_mut_simd_f64s(&mut buffers.lens_sums[own]).0;
        let registers = gradient.len();
        for row in 0..R {
            let line = V::as_simd_f64s(&js[row * width..(row + 1) * width]).0;
            let q = &buffers.whitened[(i * R + row) * P..(i * R + row + 1) * P];
            let r = buffers.jacobian_point[(first + i) * point_record(R, P) + row * (P + 1) + P];
            let r = simd.splat_f64s(r);
            for k in 0..registers {
                gradient[k] = simd.mul_add_e_f64s(line[k], r, gradient[k]);
                diagonal[k] = simd.mul_add_e_f64s(line[k], line[k], diagonal[k]);
            }
            for p in 0..P {
                let q = simd.splat_f64s(q[p]);
                for k in 0..registers {
                    let sum = &mut sums[p * registers + k];
                    *sum = simd.mul_add_e_f64s(q, line[k], *sum);
                }
            }
        }
        let at = (lens * lenses + lens) * width * width;
        let block = &mut chunk.lens_lens[at..at + width * width];
        add_products::<V, R>(simd, block, (js, width), js, (columns, 1.0));
    }
}

/// `-T^T T` of each pair of shared blocks, and `-T^T u`.
#[inline(always)]
fn add_shared_pairs<V: Simd, const K: usize, const S: usize, const P: usize, const D: usize>(
    simd: V,
    layout: &Layout<K, S, D>,
    chunk: &mut ChunkSums<P>,
    buffers: &mut Buffers,
    u: &[f64; P],
) {
    let (lenses, width) = (layout.shared.len(), layout.lens_width());
    let columns = layout.lens_columns.len();
    for l in 0..lenses {
        let own = &buffers.lens_sums[l * P * width..(l + 1) * P * width];
        let to = &mut chunk.lens_correction[l * width..(l + 1) * width];
        let to = V::as_mut_simd_f64s(to).0;
        for p in 0..P {
            let u = simd.splat_f64s(-u[p]);
            let line = V::as_simd_f64s(&own[p * width..(p + 1) * width]).0;
            for k in 0..to.len() {
                to[k] = simd.mul_add_e_f64s(line[k], u, to[k]);
            }
        }
        for m in 0..=l {
            let other = &buffers.lens_sums[m * P * width..(m + 1) * P * width];
            let at = (l * lenses + m) * width * width;
            let block = &mut chunk.lens_lens[at..at + width * width];
            add_products::<V, P>(simd, block, (own, width), other, (columns, -1.0));
        }
    }
}

/// `Jc_i^T (Js_i - Q_i T)` of each camera and shared block.
#[inline(always)]
fn add_camera_pairs<
    V: Simd,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const D: usize,
>(
    simd: V,
    layout: &Layout<K, S, D>,
    chunk: &mut ChunkSums<P>,
    buffers: &mut Buffers,
    (first, end): (usize, usize),
    origin: usize,
) {
    let (lenses, width) = (layout.shared.len(), layout.lens_width());
    for i in 0..end - first {
        let camera = layout.observed_by[origin + first + i] as usize;
        let local = chunk.local[camera];
        if local == NONE {
            break;
        }
        let own = layout.cameras[camera].lens as usize;
        let js = &buffers.jacobian_shared[(first + i) * R * width..(first + i + 1) * R * width];
        let stride = R * padded(K);
        let jacobian = &buffers.jacobian_camera[(first + i) * stride..(first + i + 1) * stride];
        for l in 0..lenses {
            let sums = &buffers.lens_sums[l * P * width..(l + 1) * P * width];
            let sums = V::as_simd_f64s(sums).0;
            // A row of Js_i - Q_i T.
            for row in 0..R {
                let q = &buffers.whitened[(i * R + row) * P..(i * R + row + 1) * P];
                let line = V::as_simd_f64s(&js[row * width..(row + 1) * width]).0;
                let left = &mut buffers.lens_left[row * width..(row + 1) * width];
                let left = V::as_mut_simd_f64s(left).0;
                let registers = left.len();
                for k in 0..registers {
                    let mut rest = if l == own { line[k] } else { simd.splat_f64s(0.0) };
                    for p in 0..P {
                        let q = simd.splat_f64s(-q[p]);
                        rest = simd.mul_add_e_f64s(q, sums[p * registers + k], rest);
                    }
                    left[k] = rest;
                }
            }
            let at = (local as usize * lenses + l) * K * width;
            let block = &mut chunk.camera_lens[at..at + K * width];
            add_products::<V, R>(simd, block, (jacobian, padded(K)), &buffers.lens_left, (K, 1.0));
        }
    }
}

/// `block += sign A^T B` with `N` rows each, of which those of `A` have `stride` numbers and those of `B` as many as
/// the block's; `rows` of the block are there.
#[inline(always)]
fn add_products<V: Simd, const N: usize>(
    simd: V,
    block: &mut [f64],
    (a, stride): (&[f64], usize),
    b: &[f64],
    (rows, sign): (usize, f64),
) {
    let b = V::as_simd_f64s(b).0;
    let registers = b.len() / N;
    let block = V::as_mut_simd_f64s(block).0;
    for (i, to) in block.chunks_exact_mut(registers).enumerate().take(rows) {
        for k in 0..registers {
            let mut sum = to[k];
            for n in 0..N {
                let factor = simd.splat_f64s(sign * a[n * stride + i]);
                sum = simd.mul_add_e_f64s(factor, b[n * registers + k], sum);
            }
            to[k] = sum;
        }
    }
}
