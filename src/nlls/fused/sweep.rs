//! The two sweeps over the points of one share: elimination, and substitution with the trial cost.

use super::{
    Moved, Settings,
    groups::{Records, chunk_cost, chunks, coordinates},
    layout::{Layout, ShareWork, point_record},
    linearize::{apply_chunk, linearize_chunk},
    point::eliminate_point,
    small::Small,
};
use crate::nlls::{cholesky::NotPositiveDefinite, pairs::PairFactor};
use pulp::{Arch, Simd, WithSimd};
use std::marker::PhantomData;

struct Eliminate<
    'a,
    F,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> {
    layout: &'a Layout<K, S, D>,
    share: &'a mut ShareWork<P>,
    prepared: &'a Records,
    x: &'a [f64],
    settings: Settings,
    factor: PhantomData<F>,
}

/// Eliminates the points of one share; returns the largest `|g_k| / sqrt(D_k)` of them.
pub(super) fn eliminate_share<
    F: PairFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    share: &mut ShareWork<P>,
    prepared: &Records,
    x: &[f64],
    settings: Settings,
) -> Result<f64, NotPositiveDefinite> {
    let factor = PhantomData::<F>;
    Arch::new().dispatch(Eliminate::<F, R, K, S, P, Q, D> {
        layout,
        share,
        prepared,
        x,
        settings,
        factor,
    })
}

impl<
    F: PairFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> WithSimd for Eliminate<'_, F, R, K, S, P, Q, D>
{
    type Output = Result<f64, NotPositiveDefinite>;

    #[inline(always)]
    fn with_simd<V: Simd>(self, simd: V) -> Self::Output {
        let Eliminate { layout, share, prepared, x, settings, .. } = self;
        share.clear();
        let mut buffers = std::mem::take(&mut share.buffers);
        let (mut largest, mut failed) = (0.0, None);
        'sweep: for chunk in chunks(layout, share.range.clone()) {
            linearize_chunk::<V, F, R, K, S, P, Q, D>(
                simd,
                layout,
                chunk.clone(),
                prepared,
                x,
                &settings,
                &mut buffers,
            );
            let origin = layout.points[chunk.start].first as usize;
            for e in chunk {
                match eliminate_point::<V, R, K, S, P, D>(
                    simd,
                    layout,
                    share,
                    &mut buffers,
                    (e, origin),
                    settings.lambda,
                ) {
                    Ok(slope) => largest = f64::max(largest, slope),
                    Err(error) => {
                        failed = Some(error);
                        break 'sweep;
                    }
                }
            }
        }
        share.buffers = buffers;
        failed.map_or(Ok(largest), Err)
    }
}

struct Substitute<
    'a,
    F,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> {
    layout: &'a Layout<K, S, D>,
    share: &'a mut ShareWork<P>,
    /// At the current and at the trial values.
    prepared: (&'a Records, &'a Records),
    x: &'a [f64],
    settings: Settings,
    factor: PhantomData<F>,
}

/// Moves the points of one share into [`ShareWork::moved`] and evaluates the trial cost;
/// `prepared` are the cameras at the current and at the trial values.
pub(super) fn substitute_share<
    F: PairFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    share: &mut ShareWork<P>,
    prepared: (&Records, &Records),
    x: &[f64],
    settings: Settings,
) -> Moved {
    let factor = PhantomData::<F>;
    Arch::new().dispatch(Substitute::<F, R, K, S, P, Q, D> {
        layout,
        share,
        prepared,
        x,
        settings,
        factor,
    })
}

impl<
    F: PairFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> WithSimd for Substitute<'_, F, R, K, S, P, Q, D>
{
    type Output = Moved;

    #[inline(always)]
    fn with_simd<V: Simd>(self, simd: V) -> Moved {
        let Substitute { layout, share, prepared: (prepared, trial), x, settings, .. } = self;
        let range = share.range.clone();
        let (buffers, moved) = (&mut share.buffers, &mut share.moved);
        let mut total = Moved::default();
        for chunk in chunks(layout, range.clone()) {
            apply_chunk::<V, F, R, K, S, P, Q, D>(
                simd,
                layout,
                chunk.clone(),
                prepared,
                x,
                &settings,
                buffers,
            );
            let origin = layout.points[chunk.start].first as usize;
            for e in chunk.clone() {
                let point = layout.points[e];
                let (first, end) =
                    (point.first as usize - origin, layout.points[e + 1].first as usize - origin);
                let records =
                    &buffers.by_point[first * point_record(R, P)..end * point_record(R, P)];
                let mut small = Small::<P>::new::<R>(records);
                let mut h = small.g;
                let along = &buffers.along[first * R..end * R];
                for (record, along) in
                    records.chunks_exact(point_record(R, P)).zip(along.chunks_exact(R))
                {
                    for row in 0..R {
                        for k in 0..P {
                            h[k] += record[row * (P + 1) + k] * along[row];
                        }
                    }
                }
                // Elimination has factorised the same matrix already.
                let definite = small.factorize(settings.lambda, point.frozen);
                debug_assert!(definite);
                for (k, h) in h.iter_mut().enumerate() {
                    if point.frozen >> k & 1 == 1 {
                        *h = 0.0;
                    }
                }
                let step = small.backward(small.forward(h));
                let at = coordinates::<P>(x, point.at);
                for k in 0..P {
                    let d = -step[k];
                    total.predicted += 0.5 * d * (small.damped[k] * d - small.g[k]);
                    total.squared_length += d * d * small.diagonal[k];
                    total.movement = total.movement.max(d.abs());
                    moved[e - range.start][k] = at[k] + d;
                }
            }
            let value = |e: usize| moved[e - range.start];
            let cost = chunk_cost::<V, F, R, K, S, P, Q, D>(
                simd,
                layout,
                chunk,
                trial,
                value,
                settings.loss,
            );
            total.cost += cost;
        }
        total
    }
}
