//! Matching costs of a block: how little the photos agree, for every pixel of the reference and every height.
//!
//! All photos of a block are rectified onto one plane, which may be inclined. Let `F` be the height of a
//! projection centre above that plane (along the vertical) and `C` its place in plan. A point at the
//! height `h` above the plane and the place `X` is seen by the photo at the place
//!
//! ```text
//! q = C + (X - C) / (1 - h/F)
//! ```
//!
//! of its rectified picture (the ray through `X` meets the plane there; this is exact, since heights above a plane
//! change linearly along a ray). A pixel `p` of the reference (index `r`) at the height `h` is the point
//! `X = p + (C_r - p) h/F_r`, and another photo (index `j`) shows it at
//!
//! ```text
//! q = s p + o,   s = (1 - h/F_r) / (1 - h/F_j),   o = (C_r h/F_r - C_j h/F_j) / (1 - h/F_j)
//! ```
//!
//! a similarity without rotation: rows stay rows. So each layer of heights is read by two linear interpolations along whole rows,
//! without gathers, in bytes. The cost is the census distance: of the 24 neighbours in 5 x 5 pixels, how many are brighter
//! than the centre in one photo and not in the other; summed over the best photos but one, so that one may be hidden.
//! Reference: R. Zabih, J. Woodfill, *Non-parametric local transforms for computing visual correspondence*, 1994.

use super::cost_volume::{CostVolume, LANES};
use std::ops::Range;

/// Half the side of the census window.
pub(super) const REACH: usize = 2;
/// Neighbours compared by the census.
const NEIGHBOURS: usize = 24;
/// Distance of a photo that has nothing in common with the reference, or shows nothing.
const MAX_DISTANCE: u8 = NEIGHBOURS as u8;
/// Greatest matching cost: three photos with nothing in common.
pub(super) const WORST: u8 = 3 * MAX_DISTANCE;
/// Rows that are compared together, so that the comparisons of the reference (24 bytes a pixel) stay in the second cache: 120 kB of a usual block. Not
/// measured against other numbers.
const ROWS: usize = 16;
/// The most photos beside the reference.
pub(super) const MAX_OTHERS: usize = 8;

/// A photo rectified onto the plane of a block: one byte for a pixel, 0 where the photo shows nothing.
#[derive(Debug, Clone)]
pub struct Rectified {
    /// Row by row.
    pub values: Vec<u8>,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Where its first pixel is in the grid of the reference, cells.
    pub origin: [isize; 2],
    /// The projection centre in plan, cells of the reference's grid.
    pub centre: [f64; 2],
    /// Height of the projection centre above the plane, metres.
    pub above_m: f64,
}

impl Rectified {
    /// One whose first pixel is at `origin` of the reference's grid, from one in a grid of its own.
    pub fn placed(mut self, origin: [isize; 2]) -> Rectified {
        self.origin = origin;
        (0..2).for_each(|k| self.centre[k] += origin[k] as f64);
        self
    }

    /// The value at a cell of the reference's grid; 0 beyond its own.
    pub fn at(&self, cell: [usize; 2]) -> u8 {
        let [u, v] = [0, 1].map(|k| cell[k].wrapping_add_signed(-self.origin[k]));
        if u < self.width && v < self.height { self.values[v * self.width + u] } else { 0 }
    }
}

/// Scale and offset by which pixels of the reference are found in another photo at a height.
pub fn transfer(reference: &Rectified, other: &Rectified, height_m: f64) -> (f64, [f64; 2]) {
    let (kr, kj) = (height_m / reference.above_m, height_m / other.above_m);
    let scale = (1.0 - kr) / (1.0 - kj);
    let offset = [0, 1].map(|k| (reference.centre[k] * kr - other.centre[k] * kj) / (1.0 - kj));
    (scale, offset)
}

/// Where the columns of the reference are in another photo: whole places and weights of the next, of 128, and the ranges in which whole places
/// follow each other, with the first of each.
struct Columns {
    weight: Vec<u8>,
    runs: Vec<(Range<usize>, i32)>,
}

/// A position in 128ths.
#[inline(always)]
fn position_128ths(scale: f64, offset: f64, at: usize) -> i32 {
    ((scale * at as f64 + offset) * 128.0).round() as i32
}

impl Columns {
    fn new(scale: f64, offset: f64, count: usize) -> Columns {
        let (mut weight, mut runs) = (Vec::with_capacity(count), Vec::<(Range<usize>, i32)>::new());
        for k in 0..count {
            let at = position_128ths(scale, offset, k);
            weight.push((at & 127) as u8);
            let first = at >> 7;
            match runs.last_mut() {
                Some((run, start)) if *start + (k - run.start) as i32 == first => run.end = k + 1,
                _ => runs.push((k..k + 1, first)),
            }
        }
        Columns { weight, runs }
    }
}

/// Where the pixels of the reference are in another photo at one height.
struct LayerMapping {
    across: Columns,
    /// Scale and offset of its rows.
    down: [f64; 2],
}

impl LayerMapping {
    fn new(reference: &Rectified, other: &Rectified, height_m: f64) -> LayerMapping {
        let (scale, offset) = transfer(reference, other, height_m);
        let at = |k: usize| offset[k] - other.origin[k] as f64;
        LayerMapping { across: Columns::new(scale, at(0), reference.width), down: [scale, at(1)] }
    }
}

/// The matching costs of all layers; `WORST` within `REACH` of the border.
pub fn costs(
    reference: &Rectified,
    others: &[Rectified],
    heights_m: &[f64],
    volume: &mut CostVolume,
) {
    let size = [reference.width, reference.height];
    volume.begin(size, heights_m.len());
    let of = |&height_m: &f64| -> Vec<LayerMapping> {
        others.iter().map(|other| LayerMapping::new(reference, other, height_m)).collect()
    };
    let mappings: Vec<Vec<LayerMapping>> = heights_m.iter().map(of).collect();
    pulp::Arch::new().dispatch(Costs { reference, others, mappings: &mappings, volume });
    for row in 0..size[1] {
        let whole =
            row < REACH || row + REACH >= size[1] || size[0] <= 2 * REACH || others.is_empty();
        for column in 0..size[0] {
            if whole || column < REACH || column + REACH >= size[0] {
                (0..heights_m.len()).for_each(|layer| *volume.at_mut([column, row], layer) = WORST);
            }
        }
    }
}

/// [`costs`] with the machine's SIMD.
struct Costs<'a> {
    reference: &'a Rectified,
    others: &'a [Rectified],
    mappings: &'a [Vec<LayerMapping>],
    volume: &'a mut CostVolume,
}

impl pulp::WithSimd for Costs<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Costs { reference, others, mappings, volume } = self;
        let (width, height) = (reference.width, reference.height);
        if width == 0 || height <= 2 * REACH || others.is_empty() {
            return;
        }
        let chunks = volume.chunks();
        // Zeros beside the picture, so that registers need not end with it.
        let room = chunks * LANES + 2 * REACH;
        let mut own = vec![0; room * (ROWS + 2 * REACH)];
        let mut sampled = own.clone();
        let mut brighter = vec![[[0; LANES]; NEIGHBOURS]; ROWS * chunks];
        let mut shown = vec![own.clone(); others.len()];
        let mut distances = vec![vec![[0; LANES]; ROWS * chunks]; others.len()];
        let mut line = Vec::new();
        for first in (REACH..height - REACH).step_by(ROWS) {
            let rows = ROWS.min(height - REACH - first);
            let top = first - REACH;
            let all = rows + 2 * REACH;
            for (row, own) in own.chunks_exact_mut(room).take(all).enumerate() {
                let from = &reference.values[(top + row) * width..][..width];
                own[REACH..][..width].copy_from_slice(from);
            }
            compare(&own, room, &mut brighter[..rows * chunks]);
            // A photo that shows a pixel at some heights only would speak for those: it has no say there. What it shows of the lowest
            // and the highest layer it shows of all between, since photos are convex.
            for (k, (other, shown)) in others.iter().zip(&mut shown).enumerate() {
                shown.fill(u8::MAX);
                for mappings in [mappings.first(), mappings.last()].into_iter().flatten() {
                    resample(
                        (other, &mappings[k]),
                        [top, width],
                        &mut line,
                        (&mut sampled, room, all),
                    );
                    for (shown, &value) in shown.iter_mut().zip(&sampled) {
                        *shown &= 0u8.wrapping_sub(u8::from(value != 0));
                    }
                }
            }
            for (layer, mappings) in mappings.iter().enumerate() {
                for (k, other) in others.iter().enumerate() {
                    resample(
                        (other, &mappings[k]),
                        [top, width],
                        &mut line,
                        (&mut sampled, room, all),
                    );
                    for (value, shown) in sampled[..all * room].iter_mut().zip(&shown[k]) {
                        *value &= shown;
                    }
                    census(&sampled, room, &brighter[..rows * chunks], &mut distances[k]);
                }
                for row in 0..rows {
                    for chunk in 0..chunks {
                        volume.chunk_mut(first + row, chunk)[layer] =
                            best(&distances, row * chunks + chunk);
                    }
                }
            }
        }
        // Columns beyond the picture cost nothing, as paths expect.
        let there = width - (chunks - 1) * LANES;
        for row in 0..height {
            for costs in volume.chunk_mut(row, chunks - 1) {
                costs[there..].fill(0);
            }
        }
    }
}

/// Rows of a photo from `first` on as the reference sees them, into a grid with lines of `room`.
#[inline(always)]
fn resample(
    (other, mapping): (&Rectified, &LayerMapping),
    [first, width]: [usize; 2],
    line: &mut Vec<u8>,
    (out, room, rows): (&mut [u8], usize, usize),
) {
    line.resize(other.width, 0);
    let weight = &mapping.across.weight;
    for (row, out) in out.chunks_exact_mut(room).take(rows).enumerate() {
        let out = &mut out[REACH..][..width];
        let at = position_128ths(mapping.down[0], mapping.down[1], first + row);
        let above = at >> 7;
        if above < 0 || above as usize + 1 >= other.height {
            out.fill(0);
            continue;
        }
        let from = above as usize * other.width;
        let (upper, lower) = other.values[from..from + 2 * other.width].split_at(other.width);
        // What of the line is read.
        let mut read = [usize::MAX, 0];
        for (run, start) in &mapping.across.runs {
            let end = (*start + (run.end - run.start) as i32 + 1).clamp(0, other.width as i32);
            read = [read[0].min((*start).clamp(0, end) as usize), read[1].max(end as usize)];
        }
        let read = read[0].min(read[1])..read[1];
        mix(&upper[read.clone()], &lower[read.clone()], (at & 127) as u16, &mut line[read]);
        for (Range { start: x, end }, from) in &mapping.across.runs {
            let (x, end, from) = (*x, *end, *from);
            if from < 0 || from as usize + (end - x) >= other.width {
                // Rare: at the border of what was rectified.
                for k in x..end {
                    let first = from + (k - x) as i32;
                    let inside = first >= 0 && (first as usize) + 1 < other.width;
                    out[k] = if inside {
                        let pair = &line[first as usize..first as usize + 2];
                        blend(pair[0], pair[1], u16::from(weight[k]))
                    } else {
                        0
                    };
                }
            } else {
                let from = from as usize;
                let (left, right) = (&line[from..][..end - x], &line[from + 1..][..end - x]);
                mix_each(left, right, &weight[x..end], &mut out[x..end]);
            }
        }
    }
}

#[inline(always)]
fn blend(a: u8, b: u8, weight: u16) -> u8 {
    // At most 255 times 128, so nothing wraps; said so because checks would keep loops out of registers.
    let sum = u16::from(a).wrapping_mul(128u16.wrapping_sub(weight));
    (sum.wrapping_add(u16::from(b).wrapping_mul(weight)).wrapping_add(64) >> 7) as u8
}

#[inline(always)]
fn mix(a: &[u8], b: &[u8], weight: u16, out: &mut [u8]) {
    let n = out.len();
    let (a, b) = (&a[..n], &b[..n]);
    for k in 0..n {
        out[k] = blend(a[k], b[k], weight);
    }
}

#[inline(always)]
fn mix_each(a: &[u8], b: &[u8], weights: &[u8], out: &mut [u8]) {
    let n = out.len();
    let (a, b, weights) = (&a[..n], &b[..n], &weights[..n]);
    for k in 0..n {
        out[k] = blend(a[k], b[k], u16::from(weights[k]));
    }
}

/// The rows of the windows of as many pixels as are computed together.
#[derive(Clone, Copy)]
struct CensusWindows<'a>([&'a [u8; LANES + 2 * REACH]; 2 * REACH + 1]);

impl<'a> CensusWindows<'a> {
    #[inline(always)]
    fn new(values: &'a [u8], room: usize) -> CensusWindows<'a> {
        let mut rows = [const { &[0; LANES + 2 * REACH] }; 2 * REACH + 1];
        for (k, row) in rows.iter_mut().enumerate() {
            let found = values[k * room..].first_chunk();
            debug_assert!(found.is_some(), "a window reaches beyond the last row");
            if let Some(found) = found {
                *row = found;
            }
        }
        CensusWindows(rows)
    }

    /// 255 where the neighbour at a row and column of the window is brighter than the centre, else 0.
    #[inline(always)]
    fn brighter<const ROW: usize, const COLUMN: usize>(self) -> [u8; LANES] {
        let (neighbour, centre) = (self.0[ROW], self.0[REACH]);
        let mut out = [0; LANES];
        for k in 0..LANES {
            out[k] = if centre[k + REACH] >= neighbour[k + COLUMN] { 0 } else { u8::MAX };
        }
        out
    }

    /// All comparisons.
    #[inline(always)]
    fn compared(self) -> CensusBits {
        [
            self.brighter::<0, 0>(),
            self.brighter::<0, 1>(),
            self.brighter::<0, 2>(),
            self.brighter::<0, 3>(),
            self.brighter::<0, 4>(),
            self.brighter::<1, 0>(),
            self.brighter::<1, 1>(),
            self.brighter::<1, 2>(),
            self.brighter::<1, 3>(),
            self.brighter::<1, 4>(),
            self.brighter::<2, 0>(),
            self.brighter::<2, 1>(),
            self.brighter::<2, 3>(),
            self.brighter::<2, 4>(),
            self.brighter::<3, 0>(),
            self.brighter::<3, 1>(),
            self.brighter::<3, 2>(),
            self.brighter::<3, 3>(),
            self.brighter::<3, 4>(),
            self.brighter::<4, 0>(),
            self.brighter::<4, 1>(),
            self.brighter::<4, 2>(),
            self.brighter::<4, 3>(),
            self.brighter::<4, 4>(),
        ]
    }

    /// How many comparisons come out otherwise than those of the reference, in costs.
    #[inline(always)]
    fn differing(self, own: &CensusBits) -> [u8; LANES] {
        let theirs = self.compared();
        let mut distance = [0u8; LANES];
        for neighbour in 0..NEIGHBOURS {
            for k in 0..LANES {
                distance[k] = distance[k].wrapping_sub(theirs[neighbour][k] ^ own[neighbour][k]);
            }
        }
        let centre = self.0[REACH];
        for k in 0..LANES {
            // Nothing is known where a photo shows nothing.
            distance[k] = if centre[k + REACH] == 0 { MAX_DISTANCE } else { distance[k] };
        }
        distance
    }
}

/// For each neighbour of 32 pixels, 255 where it is brighter than its centre, else 0.
type CensusBits = [[u8; LANES]; NEIGHBOURS];

/// The comparisons of the reference, of 32 columns after the other.
#[inline(always)]
fn compare(values: &[u8], room: usize, out: &mut [CensusBits]) {
    for (row, out) in out.chunks_exact_mut(room / LANES).enumerate() {
        for (chunk, out) in out.iter_mut().enumerate() {
            *out = CensusWindows::new(&values[row * room + chunk * LANES..], room).compared();
        }
    }
}

/// How many comparisons come out otherwise in another photo.
#[inline(always)]
fn census(values: &[u8], room: usize, own: &[CensusBits], out: &mut [[u8; LANES]]) {
    let chunks = room / LANES;
    let rows = own.chunks_exact(chunks).zip(out.chunks_exact_mut(chunks));
    for (row, (own, out)) in rows.enumerate() {
        for (chunk, (own, out)) in own.iter().zip(out).enumerate() {
            let from = row * room + chunk * LANES;
            *out = CensusWindows::new(&values[from..], room).differing(own);
        }
    }
}

/// The sum over the three best photos; over all, scaled to three, where there are fewer.
#[inline(always)]
fn best(distances: &[Vec<[u8; LANES]>], at: usize) -> [u8; LANES] {
    // Sorted as they come: a is the least.
    let (mut a, mut b, mut c) =
        ([MAX_DISTANCE; LANES], [MAX_DISTANCE; LANES], [MAX_DISTANCE; LANES]);
    for distance in distances {
        let distance = &distance[at];
        for k in 0..LANES {
            let (low, rest) = (a[k].min(distance[k]), a[k].max(distance[k]));
            let (middle, high) = (b[k].min(rest), b[k].max(rest));
            (a[k], b[k], c[k]) = (low, middle, c[k].min(high));
        }
    }
    let mut out = [0; LANES];
    for k in 0..LANES {
        let two = a[k].wrapping_add(b[k]);
        out[k] = match distances.len() {
            1 => a[k].wrapping_mul(3),
            2 => two.wrapping_add(two / 2),
            _ => two.wrapping_add(c[k]),
        };
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: usize, height: usize, shift: f64) -> Vec<u8> {
        let at = |k: usize| ((k % width) as f64 + shift, (k / width) as f64);
        (0..width * height)
            .map(|k| {
                let (x, y) = at(k);
                (128.0 + 60.0 * (0.9 * x + 0.3 * y).sin() + 50.0 * (0.37 * x - 0.8 * y).cos()) as u8
            })
            .collect()
    }

    /// A level surface 1 m above the plane, two photos from 20 m whose centres are 200 cells apart.
    #[test]
    fn the_layer_at_the_true_height_costs_least() {
        let (width, height) = (150, 40);
        let of = |centre: f64, margin: usize, shift: f64| Rectified {
            values: picture(width + 2 * margin, height + 2 * margin, shift),
            width: width + 2 * margin,
            height: height + 2 * margin,
            origin: [-(margin as isize); 2],
            centre: [centre, 20.0],
            above_m: 20.0,
        };
        let reference = of(75.0, 0, 0.0);
        let heights_m: Vec<f64> = (0..21).map(|k| 0.1 * f64::from(k)).collect();
        // With equal heights of flight the whole picture moves by (C_r - C_j) k/(1 - k).
        let k = 1.0 / 20.0;
        let moved = -200.0 * k / (1.0 - k);
        let mut other = of(275.0, 30, 0.0);
        let (scale, offset) = transfer(&reference, &other, 1.0);
        assert!((scale - 1.0).abs() < 1e-12 && (offset[0] - moved).abs() < 1e-9);
        assert!(offset[1].abs() < 1e-9);
        // Rows of the other picture begin 30 above.
        for row in 0..height + 60 {
            for column in 0..width + 60 {
                let (x, y) = (column as f64 - 30.0 - moved, row as f64 - 30.0);
                let value =
                    128.0 + 60.0 * (0.9 * x + 0.3 * y).sin() + 50.0 * (0.37 * x - 0.8 * y).cos();
                other.values[row * (width + 60) + column] = value as u8;
            }
        }
        let mut volume = CostVolume::default();
        costs(&reference, std::slice::from_ref(&other), &heights_m, &mut volume);
        for at in [[30, 20], [75, 10], [120, 33]] {
            let of = |layer: usize| volume.at(at, layer);
            let best = (0..21).min_by_key(|&layer| of(layer)).unwrap();
            assert_eq!(best, 10, "{at:?}: {:?}", (0..21).map(of).collect::<Vec<_>>());
            assert!(of(10) <= 6 && of(0) > 15);
        }
    }

    #[test]
    fn the_three_best_photos_count() {
        let distances = [10, 3, 24, 5, 0].map(|distance| vec![[distance; LANES]]);
        assert_eq!(best(&distances, 0), [8; LANES]);
        assert_eq!(best(&distances[..2], 0), [19; LANES]);
        assert_eq!(best(&distances[..1], 0), [30; LANES]);
    }
}
