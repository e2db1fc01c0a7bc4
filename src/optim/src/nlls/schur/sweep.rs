//! The two sweeps over the points of one chunk: elimination, and substitution with the trial cost.

use super::{
    BackSubstitution, Settings,
    lanes::{CameraCache, coordinates, tile_cost, tiles},
    layout::{ChunkSums, Layout, point_record},
    linearize::{apply_tile, linearize_tile},
    point::eliminate_point,
    point_system::{PointSystem, PriorSums},
    stray::LonePoint,
};
use crate::nlls::{cholesky::NotPositiveDefinite, projection::SizedFactor, sight, structure::NONE};
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
    chunk: &'a mut ChunkSums<P>,
    prepared: &'a CameraCache,
    priors: &'a [PriorSums<P>],
    x: &'a [f64],
    settings: Settings<'a>,
    factor: PhantomData<F>,
}

/// Eliminates the points of one chunk; returns the largest `|g_k| / sqrt(D_k)` of them.
pub(super) fn eliminate_chunk<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    chunk: &mut ChunkSums<P>,
    prepared: &CameraCache,
    priors: &[PriorSums<P>],
    x: &[f64],
    settings: Settings<'_>,
) -> Result<f64, NotPositiveDefinite> {
    let factor = PhantomData::<F>;
    Arch::new().dispatch(Eliminate::<F, R, K, S, P, Q, D> {
        layout,
        chunk,
        prepared,
        priors,
        x,
        settings,
        factor,
    })
}

impl<
    F: SizedFactor<R, K, S, P, Q, D>,
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
        let Eliminate { layout, chunk, prepared, priors, x, settings, .. } = self;
        chunk.clear();
        let mut buffers = std::mem::take(&mut chunk.buffers);
        let (mut largest, mut failed) = (0.0, None);
        'sweep: for tile in tiles(layout, chunk.range.clone()) {
            linearize_tile::<V, F, R, K, S, P, Q, D>(
                simd,
                layout,
                tile.clone(),
                prepared,
                x,
                &settings,
                &mut buffers,
            );
            let origin = layout.points[tile.start].first as usize;
            for e in tile {
                match eliminate_point::<V, R, K, S, P, D>(
                    simd,
                    layout,
                    chunk,
                    &mut buffers,
                    (e, origin),
                    &settings,
                    priors,
                ) {
                    Ok(slope) => largest = f64::max(largest, slope),
                    Err(error) => {
                        failed = Some(error);
                        break 'sweep;
                    }
                }
            }
        }
        chunk.buffers = buffers;
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
    chunk: &'a mut ChunkSums<P>,
    /// At the current and at the trial values.
    prepared: (&'a CameraCache, &'a CameraCache),
    priors: &'a [PriorSums<P>],
    x: &'a [f64],
    settings: Settings<'a>,
    /// A point that costs more than this an observation is looked at again.
    stray: f64,
    factor: PhantomData<F>,
}

/// Moves the points of one chunk into [`ChunkSums::moved`] and evaluates the trial cost;
/// `prepared` are the cameras at the current and at the trial values.
pub(super) fn back_substitute_chunk<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    chunk: &mut ChunkSums<P>,
    prepared: (&CameraCache, &CameraCache),
    priors: &[PriorSums<P>],
    x: &[f64],
    (settings, stray): (Settings<'_>, f64),
) -> BackSubstitution {
    let factor = PhantomData::<F>;
    Arch::new().dispatch(Substitute::<F, R, K, S, P, Q, D> {
        layout,
        chunk,
        prepared,
        priors,
        x,
        settings,
        stray,
        factor,
    })
}

impl<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> WithSimd for Substitute<'_, F, R, K, S, P, Q, D>
{
    type Output = BackSubstitution;

    #[inline(always)]
    fn with_simd<V: Simd>(self, simd: V) -> BackSubstitution {
        let Substitute { layout, chunk, prepared, priors, x, settings, stray, .. } = self;
        let (prepared, trial) = prepared;
        let range = chunk.range.clone();
        let (buffers, moved) = (&mut chunk.buffers, &mut chunk.moved);
        let sights = &chunk.sights;
        let mut total = BackSubstitution::default();
        for tile in tiles(layout, range.clone()) {
            apply_tile::<V, F, R, K, S, P, Q, D>(
                simd,
                layout,
                tile.clone(),
                prepared,
                x,
                &settings,
                buffers,
            );
            let origin = layout.points[tile.start].first as usize;
            for e in tile.clone() {
                let point = layout.points[e];
                let (first, end) =
                    (point.first as usize - origin, layout.points[e + 1].first as usize - origin);
                let records =
                    &buffers.jacobian_point[first * point_record(R, P)..end * point_record(R, P)];
                let prior = priors.get(point.prior as usize);
                let mut system = PointSystem::<P>::new::<R>(records, prior);
                let mut h = system.g;
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
                let definite = system.factorize(settings.lambda, point.frozen);
                debug_assert!(definite);
                for (k, h) in h.iter_mut().enumerate() {
                    if point.frozen >> k & 1 == 1 {
                        *h = 0.0;
                    }
                }
                let step = system.backward(system.forward(h));
                let at = coordinates::<P>(x, point.at);
                let mut d = [0.0; P];
                for k in 0..P {
                    d[k] = -step[k];
                }
                let to = &mut moved[e - range.start];
                if let Some(from) = sights.get(e - range.start).filter(|_| point.frozen == 0) {
                    *to = sight::moved(from, &at, &d);
                } else {
                    for k in 0..P {
                        to[k] = at[k] + d[k];
                    }
                }
                for k in 0..P {
                    let d = d[k];
                    total.predicted += 0.5 * d * (system.damped[k] * d - system.g[k]);
                    total.squared_length += d * d * system.diagonal[k];
                    total.step_norm = total.step_norm.max(d.abs());
                }
            }
            let value = |e: usize| moved[e - range.start];
            let mut cost = tile_cost::<V, F, R, K, S, P, Q, D>(
                simd,
                layout,
                tile.clone(),
                trial,
                value,
                settings.loss,
            );
            let observations = |e: usize| layout.points[e + 1].first - layout.points[e].first;
            let fewest = tile.clone().map(observations).min().unwrap_or(0);
            if cost.is_nan() || cost > stray * f64::from(fewest) {
                cost = 0.0;
                for e in tile {
                    let (k, point) = (e - range.start, layout.points[e]);
                    let alone =
                        LonePoint { layout, point: e, prepared: trial, loss: settings.loss };
                    let mut own = alone.cost::<F, R, P, Q>(&moved[k]);
                    let is_free = point.frozen == 0 && point.prior == NONE;
                    if is_free && own > stray * f64::from(observations(e)) {
                        let before = coordinates::<P>(x, point.at);
                        (moved[k], own) =
                            alone.best::<F, R, P, Q>((moved[k], own), before, sights.get(k));
                    }
                    cost += own;
                }
            }
            total.cost += cost;
        }
        total
    }
}
