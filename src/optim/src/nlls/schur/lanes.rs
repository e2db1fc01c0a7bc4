//! Observations gathered into registers, tile by tile, and their cost.
//!
//! A tile is a run of whole points whose observations stay in the nearest cache; it is worked on
//! a register's width of observations at a time, whatever points they belong to.

use super::layout::{ChunkSums, Layout, TILE, padded};
use crate::{
    lanes::{MAX_WIDTH, Register, gather},
    nlls::{loss::BatchLoss, projection::SizedFactor},
};
use pulp::{Arch, Simd, WithSimd};
use std::{marker::PhantomData, ops::Range};

/// The inputs of a few observations, one place per lane: `Q` numbers of their cameras, the points,
/// the data.
pub(super) struct LaneBuffer<const P: usize, const D: usize> {
    camera: [u32; MAX_WIDTH],
    point: [[f64; MAX_WIDTH]; P],
    data: [[f64; MAX_WIDTH]; D],
}

impl<const P: usize, const D: usize> LaneBuffer<P, D> {
    #[inline(always)]
    pub(super) fn new() -> Self {
        LaneBuffer {
            camera: [0; MAX_WIDTH],
            point: [[0.0; MAX_WIDTH]; P],
            data: [[0.0; MAX_WIDTH]; D],
        }
    }

    #[inline(always)]
    fn set(&mut self, lane: usize, camera: u32, point: &[f64; P], data: &[f64; D]) {
        self.camera[lane] = camera;
        for k in 0..P {
            self.point[k][lane] = point[k];
        }
        for k in 0..D {
            self.data[k][lane] = data[k];
        }
    }

    /// The registers of points and data.
    #[inline(always)]
    pub(super) fn load<V: Simd>(&self, simd: V) -> ([Register<V>; P], [Register<V>; D]) {
        (load_all(simd, &self.point), load_all(simd, &self.data))
    }

    /// The first `N` numbers of the cameras' records.
    #[inline(always)]
    pub(super) fn cameras<V: Simd, const N: usize>(
        &self,
        simd: V,
        records: &CameraCache,
    ) -> [[f64; MAX_WIDTH]; N] {
        let mut out = [[0.0; MAX_WIDTH]; N];
        self.gather(simd, records, &mut out);
        out
    }

    /// The same into memory.
    #[inline(always)]
    pub(super) fn gather<V: Simd>(
        &self,
        simd: V,
        records: &CameraCache,
        out: &mut [[f64; MAX_WIDTH]],
    ) {
        gather(simd, &records.values, records.stride, &self.camera, out);
    }
}

/// One register for each row of memory.
#[inline(always)]
pub(super) fn load_all<V: Simd, const N: usize>(
    simd: V,
    rows: &[[f64; MAX_WIDTH]; N],
) -> [Register<V>; N] {
    let mut out = [Register::load(simd, &[0.0; MAX_WIDTH]); N];
    for k in 0..N {
        out[k] = Register::load(simd, &rows[k]);
    }
    out
}

/// Numbers per camera, one record after the other, each of whole registers.
#[derive(Debug, Default)]
pub(super) struct CameraCache {
    pub(super) values: Vec<f64>,
    pub(super) stride: usize,
}

impl CameraCache {
    /// Zeros for `count` records of `len` numbers.
    pub(super) fn new(count: usize, len: usize) -> CameraCache {
        let stride = padded(len);
        CameraCache { values: vec![0.0; count * stride], stride }
    }

    pub(super) fn each(&mut self) -> impl Iterator<Item = &mut [f64]> {
        self.values.chunks_exact_mut(self.stride.max(1))
    }
}

/// Walks over the observations of a tile, a register's width at a time.
pub(super) struct LaneGroups {
    point: usize,
    last_point: usize,
    observation: usize,
    origin: usize,
}

impl LaneGroups {
    #[inline(always)]
    pub(super) fn new<const K: usize, const S: usize, const D: usize>(
        layout: &Layout<K, S, D>,
        tile: &Range<usize>,
    ) -> Self {
        let origin = layout.points[tile.start].first as usize;
        LaneGroups { point: tile.start, last_point: tile.end, observation: origin, origin }
    }

    /// Puts the next `width` observations, or what is left of them, into `buffer`, with the points'
    /// coordinates from `value`; returns the place of the first, counted from the tile's first,
    /// and their number.
    #[inline(always)]
    pub(super) fn fill<const K: usize, const S: usize, const P: usize, const D: usize>(
        &mut self,
        buffer: &mut LaneBuffer<P, D>,
        layout: &Layout<K, S, D>,
        width: usize,
        value: impl Fn(usize) -> [f64; P],
    ) -> Option<(usize, usize)> {
        let first = self.observation - self.origin;
        let mut count = 0;
        while count < width && self.point < self.last_point {
            let end = layout.points[self.point + 1].first as usize;
            let point = value(self.point);
            while count < width && self.observation < end {
                let camera = layout.observed_by[self.observation];
                buffer.set(count, camera, &point, &layout.data[self.observation]);
                self.observation += 1;
                count += 1;
            }
            if self.observation == end {
                self.point += 1;
            }
        }
        (count > 0).then_some((first, count))
    }
}

/// The points of `range` in tiles of whole points with at most [`TILE`] observations, or one
/// point with more.
pub(super) fn tiles<const K: usize, const S: usize, const D: usize>(
    layout: &Layout<K, S, D>,
    range: Range<usize>,
) -> impl Iterator<Item = Range<usize>> + '_ {
    let mut next = range.start;
    std::iter::from_fn(move || {
        if next >= range.end {
            return None;
        }
        let first = layout.points[next].first as usize;
        let mut end = next + 1;
        while end < range.end && layout.points[end + 1].first as usize - first <= TILE {
            end += 1;
        }
        let tile = next..end;
        next = end;
        Some(tile)
    })
}

/// The values of a point that begin at `at`.
#[inline(always)]
pub(super) fn coordinates<const P: usize>(x: &[f64], at: u32) -> [f64; P] {
    let at = at as usize;
    std::array::from_fn(|k| x[at + k])
}

/// The cost of the observations of `tile`.
#[inline(always)]
pub(super) fn tile_cost<
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
    value: impl Fn(usize) -> [f64; P],
    loss: &BatchLoss,
) -> f64 {
    let mut total = 0.0;
    let (mut buffer, mut groups) = (LaneBuffer::<P, D>::new(), LaneGroups::new(layout, &tile));
    let width = Register::<V>::WIDTH;
    while let Some((_, count)) = groups.fill(&mut buffer, layout, width, &value) {
        let (point, data) = buffer.load(simd);
        let prepared = load_all(simd, &buffer.cameras::<V, Q>(simd, prepared));
        let residual = F::residual(&prepared, &point, &data);
        let mut square = residual[0] * residual[0];
        for r in &residual[1..] {
            square = square + *r * *r;
        }
        let mut squares = [0.0; MAX_WIDTH];
        square.store(&mut squares);
        for square in &squares[..count] {
            total += if loss.is_trivial() { *square } else { loss.evaluate(*square).value };
        }
    }
    0.5 * total
}

struct Cost<
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
    chunk: &'a ChunkSums<P>,
    prepared: &'a CameraCache,
    x: &'a [f64],
    loss: &'a BatchLoss,
    factor: PhantomData<F>,
}

impl<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> WithSimd for Cost<'_, F, R, K, S, P, Q, D>
{
    type Output = f64;

    #[inline(always)]
    fn with_simd<V: Simd>(self, simd: V) -> f64 {
        let Cost { layout, chunk, prepared, x, loss, .. } = self;
        let value = |e: usize| coordinates::<P>(x, layout.points[e].at);
        let mut total = 0.0;
        for tile in tiles(layout, chunk.range.clone()) {
            total += tile_cost::<V, F, R, K, S, P, Q, D>(simd, layout, tile, prepared, value, loss);
        }
        total
    }
}

/// The cost of one chunk at `x`; not finite where an observation is infeasible.
pub(super) fn chunk_cost<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    chunk: &ChunkSums<P>,
    prepared: &CameraCache,
    x: &[f64],
    loss: &BatchLoss,
) -> f64 {
    let factor = PhantomData::<F>;
    Arch::new().dispatch(Cost::<F, R, K, S, P, Q, D> { layout, chunk, prepared, x, loss, factor })
}
