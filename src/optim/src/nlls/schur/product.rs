//! Products with the reduced system that is never formed.
//!
//! With the Jacobians `J_i` and the whitened `Q_i` of the observations of each point ([`super`])
//!
//! ```text
//! a_i = J_i x_c(i)      t = sum_i Q_i^T a_i      y_c(i) += J_i^T (a_i - Q_i t)
//! ```
//!
//! which is `y = S x` in time proportional to the observations, whatever their number per point. `J` and `Q` are stored
//! from the elimination in single precision, which halves what a product reads; sums are in double precision.
//! Rounding them changes `S` by a share of 6e-8: the step solves a system next to the one that was posed.

use super::{
    layout::{Buffers, ChunkSums, Layout, padded},
    plan::FusedPlan,
};
use crate::nlls::{projection::SizedFactor, structure::NONE};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// A number of a Jacobian that is stored.
pub(super) type StoredNumber = f32;

/// Numbers that are added to four sums in turn.
const LANES: usize = 4;

/// `k` rounded up to whole groups of [`LANES`].
pub(super) const fn whole(k: usize) -> usize {
    k.div_ceil(LANES) * LANES
}

/// Numbers per observation: `rows` of `J`, padded, then `Q`.
pub(super) const fn stored_record(rows: usize, k: usize, p: usize) -> usize {
    rows * (whole(k) + p)
}

/// Keeps the observations `first..end` of a tile that begins with observation `origin` of its chunk.
#[inline(always)]
pub(super) fn store_jacobians<const R: usize, const K: usize, const P: usize>(
    chunk: &mut ChunkSums<P>,
    buffers: &Buffers,
    (first, end): (usize, usize),
    origin: usize,
) {
    let length = stored_record(R, K, P);
    let records = &mut chunk.stored_jacobians[(origin + first) * length..(origin + end) * length];
    for (i, record) in records.chunks_exact_mut(length).enumerate() {
        for row in 0..R {
            let from = &buffers.jacobian_camera[((first + i) * R + row) * padded(K)..][..K];
            let to = &mut record[row * whole(K)..row * whole(K) + K];
            for (to, from) in to.iter_mut().zip(from) {
                *to = *from as StoredNumber;
            }
        }
        let from = &buffers.whitened[i * R * P..(i + 1) * R * P];
        for (to, from) in record[R * whole(K)..].iter_mut().zip(from) {
            *to = *from as StoredNumber;
        }
    }
}

struct Multiply<'a, const K: usize, const R: usize, const S: usize, const P: usize, const D: usize>
{
    layout: &'a Layout<K, S, D>,
    chunk: &'a mut ChunkSums<P>,
    directions: &'a [f64],
}

impl<const K: usize, const R: usize, const S: usize, const P: usize, const D: usize> WithSimd
    for Multiply<'_, K, R, S, P, D>
{
    type Output = ();

    #[inline(always)]
    fn with_simd<V: Simd>(self, _: V) {
        let Multiply { layout, chunk, directions } = self;
        let (stored, local, product) = (&chunk.stored_jacobians, &chunk.local, &mut chunk.product);
        let along = &mut chunk.buffers.along;
        let (length, k) = (stored_record(R, K, P), whole(K));
        product.fill(0.0);
        let origin = layout.points[chunk.range.start].first as usize;
        for e in chunk.range.clone() {
            let (first, end) =
                (layout.points[e].first as usize, layout.points[e + 1].first as usize);
            let records = &stored[(first - origin) * length..(end - origin) * length];
            let cameras = &layout.observed_by[first..end];
            let mut t = [0.0; P];
            for ((record, &camera), along) in
                records.chunks_exact(length).zip(cameras).zip(along.chunks_exact_mut(R))
            {
                let x = &directions[camera as usize * k..(camera as usize + 1) * k];
                let q = &record[R * k..];
                for row in 0..R {
                    let j = &record[row * k..(row + 1) * k];
                    let mut sums = [0.0; LANES];
                    for (j, x) in j.chunks_exact(LANES).zip(x.chunks_exact(LANES)) {
                        for lane in 0..LANES {
                            sums[lane] += f64::from(j[lane]) * x[lane];
                        }
                    }
                    let a = (sums[0] + sums[2]) + (sums[1] + sums[3]);
                    along[row] = a;
                    for p in 0..P {
                        t[p] += f64::from(q[row * P + p]) * a;
                    }
                }
            }
            for ((record, &camera), along) in
                records.chunks_exact(length).zip(cameras).zip(along.chunks_exact(R))
            {
                let local = local[camera as usize];
                if local == NONE {
                    // Cameras are sorted by place: the fixed ones come last.
                    break;
                }
                let y = &mut product[local as usize * k..(local as usize + 1) * k];
                let q = &record[R * k..];
                for row in 0..R {
                    let mut left = along[row];
                    for p in 0..P {
                        left -= f64::from(q[row * P + p]) * t[p];
                    }
                    let j = &record[row * k..(row + 1) * k];
                    for (y, j) in y.iter_mut().zip(j) {
                        *y += f64::from(*j) * left;
                    }
                }
            }
        }
    }
}

impl<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> FusedPlan<F, R, K, S, P, Q, D>
{
    /// `y += S x` over the reduced system, whose blocks begin at `starts`.
    pub(super) fn multiply_reduced(&mut self, starts: &[usize], x: &[f64], y: &mut [f64]) {
        let (layout, directions) = (&self.layout, &mut self.directions);
        for (camera, to) in layout.cameras.iter().zip(directions.chunks_exact_mut(whole(K))) {
            if camera.place != NONE {
                let start = starts[camera.place as usize];
                to[..K].copy_from_slice(&x[start..start + K]);
            }
        }
        let directions = &self.directions;
        self.chunks.par_iter_mut().for_each(|chunk| {
            Arch::new().dispatch(Multiply::<K, R, S, P, D> { layout, chunk, directions });
        });
        for chunk in &self.chunks {
            for (&camera, from) in chunk.members.iter().zip(chunk.product.chunks_exact(whole(K))) {
                let start = starts[layout.cameras[camera as usize].place as usize];
                for (to, from) in y[start..start + K].iter_mut().zip(from) {
                    *to += from;
                }
            }
        }
    }
}
