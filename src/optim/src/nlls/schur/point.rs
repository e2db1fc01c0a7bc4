//! Elimination of one point from the Jacobians of its observations.

use super::{
    Settings,
    layout::{Buffers, ChunkSums, Layout, MAX_RETAINED, block_len, padded, point_record},
    point_system::{PointSystem, PriorSums},
    product::store_jacobians,
    shared_block::add_shared,
};
use crate::nlls::{cholesky::NotPositiveDefinite, structure::NONE};
use pulp::Simd;

/// Eliminates point `e`, whose tile begins with observation `origin`; returns its largest
/// `|g_k| / sqrt(D_k)`.
#[inline(always)]
pub(super) fn eliminate_point<
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
    (e, origin): (usize, usize),
    settings: &Settings<'_>,
    priors: &[PriorSums<P>],
) -> Result<f64, NotPositiveDefinite> {
    let point = layout.points[e];
    let chunk_origin = layout.points[chunk.range.start].first as usize;
    let first = point.first as usize - origin;
    let end = layout.points[e + 1].first as usize - origin;
    let length = point_record(R, P);
    if point.frozen != 0 {
        for record in buffers.jacobian_point[first * length..end * length].chunks_exact_mut(length)
        {
            for row in 0..R {
                for k in 0..P {
                    record[row * (P + 1) + k] *= f64::from(u8::from(point.frozen >> k & 1 == 0));
                }
            }
        }
    }
    let jacobian_point = &buffers.jacobian_point[first * length..end * length];
    let prior = priors.get(point.prior as usize);
    let mut system = PointSystem::<P>::new::<R>(jacobian_point, prior);
    let slope = system.slope();
    if !system.factorize(settings.lambda, point.frozen) {
        return Err(NotPositiveDefinite(Some(point.block as usize)));
    }
    let u = system.forward(system.g);
    let whitened = &mut buffers.whitened[..(end - first) * R * P];
    let along = &mut buffers.along[..(end - first) * R];
    whiten::<R, P>(&system, &u, jacobian_point, whitened, along);
    if S > 0 {
        add_shared::<V, R, K, S, P, D>(simd, layout, chunk, buffers, (first, end), origin, &u);
    }
    if !chunk.stored_jacobians.is_empty() {
        store_jacobians::<R, K, P>(chunk, buffers, (first, end), origin - chunk_origin);
    }
    add_cameras::<V, R, K, S, P, D>(simd, layout, chunk, buffers, (first, end), origin);
    Ok(slope)
}

/// `Q_i` row by row, and what the point takes from each residual, `Q_i u`.
#[inline(always)]
fn whiten<const R: usize, const P: usize>(
    system: &PointSystem<P>,
    u: &[f64; P],
    records: &[f64],
    whitened: &mut [f64],
    along: &mut [f64],
) {
    for ((record, q), along) in records
        .chunks_exact(point_record(R, P))
        .zip(whitened.chunks_exact_mut(R * P))
        .zip(along.chunks_exact_mut(R))
    {
        for row in 0..R {
            let mut y = [0.0; P];
            y.copy_from_slice(&record[row * (P + 1)..row * (P + 1) + P]);
            let y = system.forward(y);
            q[row * P..(row + 1) * P].copy_from_slice(&y);
            along[row] = 0.0;
            for k in 0..P {
                along[row] += y[k] * u[k];
            }
        }
    }
}

/// Adds the point with observations `first..end` of the tile to the blocks of the cameras that see it.
#[inline(always)]
fn add_cameras<
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
    buffers: &Buffers,
    (first, end): (usize, usize),
    origin: usize,
) {
    let length = point_record(R, P);
    let stride = R * padded(K);
    for i in 0..end - first {
        let local = chunk.local[layout.observed_by[origin + first + i] as usize];
        if local == NONE {
            // Cameras are sorted by place: the fixed ones come last.
            break;
        }
        let local = local as usize;
        let jacobian = &buffers.jacobian_camera[(first + i) * stride..(first + i + 1) * stride];
        let record = &buffers.jacobian_point[(first + i) * length..(first + i + 1) * length];
        let along = &buffers.along[i * R..(i + 1) * R];
        add_vectors::<V, R, K, P>(simd, jacobian, record, along, chunk, local);
        let q_i = &buffers.whitened[i * R * P..(i + 1) * R * P];
        let row = chunk.table.row(local);
        // Where only diagonal blocks are wanted, nothing but the camera's own measurements of the point.
        let from = if chunk.stored_jacobians.is_empty() {
            0
        } else {
            own_first(layout, origin + first, i)
        };
        for j in from..=i {
            let other = chunk.local[layout.observed_by[origin + first + j] as usize] as usize;
            let q_j = &buffers.whitened[j * R * P..(j + 1) * R * P];
            let middle = middle::<R, P>(q_i, q_j, i == j);
            let at = row.get(other) as usize * block_len(K);
            let block = &mut chunk.values[at..at + block_len(K)];
            let column = &buffers.jacobian_camera[(first + j) * stride..(first + j + 1) * stride];
            add_product::<V, R, K>(simd, block, jacobian, &middle, column);
            if i != j && local == other {
                // One camera has measured the point twice: its diagonal block gets both halves.
                let turned = self::middle::<R, P>(q_j, q_i, false);
                add_product::<V, R, K>(simd, block, column, &turned, jacobian);
            }
        }
    }
}

/// The first of the observations up to `i` of a point that are by the camera of `i`; they follow each other.
#[inline(always)]
fn own_first<const K: usize, const S: usize, const D: usize>(
    layout: &Layout<K, S, D>,
    first: usize,
    i: usize,
) -> usize {
    let mut own = i;
    while own > 0 && layout.observed_by[first + own - 1] == layout.observed_by[first + i] {
        own -= 1;
    }
    own
}

/// `-Q_i Q_j^T`, and `I` added where they are one observation.
#[inline(always)]
fn middle<const R: usize, const P: usize>(q_i: &[f64], q_j: &[f64], same: bool) -> [[f64; R]; R] {
    let mut middle = [[0.0; R]; R];
    for (a, row) in middle.iter_mut().enumerate() {
        for (b, entry) in row.iter_mut().enumerate() {
            let mut left = if same && a == b { 1.0 } else { 0.0 };
            for k in 0..P {
                left -= q_i[a * P + k] * q_j[b * P + k];
            }
            *entry = left;
        }
    }
    middle
}

/// `g += J^T r`, `b -= J^T (Q u)`, `D += diag(J^T J)` for one observation.
#[inline(always)]
fn add_vectors<V: Simd, const R: usize, const K: usize, const P: usize>(
    simd: V,
    jacobian: &[f64],
    record: &[f64],
    along: &[f64],
    chunk: &mut ChunkSums<P>,
    local: usize,
) {
    let range = local * padded(K)..(local + 1) * padded(K);
    let gradient = V::as_mut_simd_f64s(&mut chunk.gradient[range.clone()]).0;
    let correction = V::as_mut_simd_f64s(&mut chunk.correction[range.clone()]).0;
    let diagonal = V::as_mut_simd_f64s(&mut chunk.diagonal[range]).0;
    for row in 0..R {
        let line = V::as_simd_f64s(&jacobian[row * padded(K)..(row + 1) * padded(K)]).0;
        let r = simd.splat_f64s(record[row * (P + 1) + P]);
        let a = simd.splat_f64s(-along[row]);
        for k in 0..line.len() {
            gradient[k] = simd.mul_add_e_f64s(line[k], r, gradient[k]);
            correction[k] = simd.mul_add_e_f64s(line[k], a, correction[k]);
            diagonal[k] = simd.mul_add_e_f64s(line[k], line[k], diagonal[k]);
        }
    }
}

/// `block += J_row^T M J_column`, in the layout of [`block_len`].
#[inline(always)]
fn add_product<V: Simd, const R: usize, const K: usize>(
    simd: V,
    block: &mut [f64],
    row: &[f64],
    middle: &[[f64; R]; R],
    column: &[f64],
) {
    // M J_column in registers, as many as there are; the rest of the array costs nothing.
    let mut product = [[simd.splat_f64s(0.0); MAX_RETAINED]; R];
    let columns = padded(K) / V::F64_LANES;
    let column: &[V::f64s] = V::as_simd_f64s(&column[..R * padded(K)]).0;
    for a in 0..R {
        for b in 0..R {
            let m = simd.splat_f64s(middle[a][b]);
            for k in 0..columns {
                let from = column[b * columns + k];
                product[a][k] = if b == 0 {
                    simd.mul_f64s(m, from)
                } else {
                    simd.mul_add_e_f64s(m, from, product[a][k])
                };
            }
        }
    }
    let whole = K / 8 * 8;
    let (main, rest) = block.split_at_mut(K * whole);
    if whole > 0 {
        for i in 0..K {
            let to = V::as_mut_simd_f64s(&mut main[i * whole..(i + 1) * whole]).0;
            for k in 0..whole / V::F64_LANES {
                let mut sum = to[k];
                for a in 0..R {
                    let factor = simd.splat_f64s(row[a * padded(K) + i]);
                    sum = simd.mul_add_e_f64s(factor, product[a][k], sum);
                }
                to[k] = sum;
            }
        }
    }
    // The columns that are left over, as vectors over the rows.
    let row: &[V::f64s] = V::as_simd_f64s(&row[..R * padded(K)]).0;
    let mut factors = [[0.0; 8]; R];
    for a in 0..R {
        let last = &product[a][whole / V::F64_LANES..columns];
        for (to, from) in V::as_mut_simd_f64s(&mut factors[a]).0.iter_mut().zip(last) {
            *to = *from;
        }
    }
    for j in 0..K - whole {
        let to = &mut rest[j * padded(K)..(j + 1) * padded(K)];
        let to = V::as_mut_simd_f64s(to).0;
        for k in 0..columns {
            let mut sum = to[k];
            for a in 0..R {
                let factor = simd.splat_f64s(factors[a][j]);
                sum = simd.mul_add_e_f64s(factor, row[a * columns + k], sum);
            }
            to[k] = sum;
        }
    }
}
