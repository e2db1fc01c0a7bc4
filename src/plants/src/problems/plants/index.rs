//! Leaf pixels in an order in which neighbours in the picture are neighbours in memory.
//!
//! The pixels are sorted along a Hilbert curve and cut into leaves of 32; a packed tree over the
//! leaves holds bounding boxes. A [`Reach`] hangs one number per node on that tree (the largest
//! squared distance from a pixel to its plant, say), so that "all pixels that a plant could win"
//! is a walk that opens only nodes closer to the plant than their number.
//!
//! Positions are pixels in the image, centre of the top-left pixel at (0, 0). Integer positions
//! are exact in the `f32` arrays up to 2^24.

use std::ops::Range;

/// Pixels in one leaf of the tree.
pub const LEAF: usize = 32;
/// Children of one inner node.
const FAN: usize = 8;

/// A bounding box of pixel centres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Smallest column, in pixels.
    pub u_min: f32,
    /// Largest column, in pixels.
    pub u_max: f32,
    /// Smallest row, in pixels.
    pub v_min: f32,
    /// Largest row, in pixels.
    pub v_max: f32,
}

impl Bounds {
    const EMPTY: Bounds = Bounds {
        u_min: f32::INFINITY,
        u_max: f32::NEG_INFINITY,
        v_min: f32::INFINITY,
        v_max: f32::NEG_INFINITY,
    };

    fn join(self, other: Bounds) -> Bounds {
        Bounds {
            u_min: self.u_min.min(other.u_min),
            u_max: self.u_max.max(other.u_max),
            v_min: self.v_min.min(other.v_min),
            v_max: self.v_max.max(other.v_max),
        }
    }

    /// Squared distance from a position to the box, in square pixels; 0 inside.
    #[inline]
    pub fn distance2(&self, at: [f64; 2]) -> f64 {
        let du = (f64::from(self.u_min) - at[0]).max(at[0] - f64::from(self.u_max)).max(0.0);
        let dv = (f64::from(self.v_min) - at[1]).max(at[1] - f64::from(self.v_max)).max(0.0);
        du * du + dv * dv
    }

    /// The middle of the box and half its diagonal, in pixels.
    pub fn circle(&self) -> ([f64; 2], f64) {
        let half_u = (f64::from(self.u_max) - f64::from(self.u_min)) / 2.0;
        let half_v = (f64::from(self.v_max) - f64::from(self.v_min)) / 2.0;
        let middle = [f64::from(self.u_min) + half_u, f64::from(self.v_min) + half_v];
        (middle, half_u.hypot(half_v))
    }
}

/// Pixels sorted along a Hilbert curve, under a tree of bounding boxes.
#[derive(Debug, Clone)]
pub struct PixelIndex {
    u_px: Vec<f32>,
    v_px: Vec<f32>,
    /// `levels[0]` are the leaves; every level but an empty one ends in a single root.
    levels: Vec<Vec<Bounds>>,
}

impl PixelIndex {
    /// Sorts pixels given as (column, row).
    pub fn new(pixels: &[[u32; 2]]) -> PixelIndex {
        let order = hilbert_order(pixels.iter().map(|p| p[0].max(p[1])).max().unwrap_or(0));
        let mut keyed: Vec<(u64, [u32; 2])> =
            pixels.iter().map(|&p| (hilbert(order, p), p)).collect();
        keyed.sort_unstable();
        let (mut u_px, mut v_px) =
            (Vec::with_capacity(keyed.len()), Vec::with_capacity(keyed.len()));
        for (_, [u, v]) in keyed {
            u_px.push(u as f32);
            v_px.push(v as f32);
        }
        let leaves = u_px.chunks(LEAF).zip(v_px.chunks(LEAF)).map(|(us, vs)| {
            us.iter().zip(vs).fold(Bounds::EMPTY, |bounds, (&u, &v)| {
                bounds.join(Bounds { u_min: u, u_max: u, v_min: v, v_max: v })
            })
        });
        let mut levels = vec![leaves.collect::<Vec<_>>()];
        while let Some(top) = levels.last().filter(|top| top.len() > 1) {
            let parents =
                top.chunks(FAN).map(|c| c.iter().copied().fold(Bounds::EMPTY, Bounds::join));
            levels.push(parents.collect());
        }
        PixelIndex { u_px, v_px, levels }
    }

    /// Sorts the non-zero pixels of a mask, row by row of `width`.
    pub fn from_mask(width: usize, data: &[u8]) -> PixelIndex {
        let position = |index: usize| [(index % width) as u32, (index / width) as u32];
        let set = data.iter().enumerate().filter(|(_, value)| **value != 0);
        PixelIndex::new(&set.map(|(index, _)| position(index)).collect::<Vec<_>>())
    }

    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.u_px.len()
    }

    /// Whether there is no pixel.
    pub fn is_empty(&self) -> bool {
        self.u_px.is_empty()
    }

    /// Number of leaves.
    pub fn leaves(&self) -> usize {
        self.levels[0].len()
    }

    /// The pixels of a leaf.
    #[inline]
    pub fn pixels_of(&self, leaf: usize) -> Range<usize> {
        leaf * LEAF..((leaf + 1) * LEAF).min(self.u_px.len())
    }

    /// Bounding box of a leaf.
    #[inline]
    pub fn bounds(&self, leaf: usize) -> &Bounds {
        &self.levels[0][leaf]
    }

    /// Bounding box of all pixels, if there are any.
    pub fn extent(&self) -> Option<Bounds> {
        self.levels.last().and_then(|top| top.first()).copied()
    }

    /// Columns of the pixels.
    pub fn u_px(&self) -> &[f32] {
        &self.u_px
    }

    /// Rows of the pixels.
    pub fn v_px(&self) -> &[f32] {
        &self.v_px
    }

    /// One pixel.
    #[inline]
    pub fn position(&self, pixel: usize) -> [f64; 2] {
        [f64::from(self.u_px[pixel]), f64::from(self.v_px[pixel])]
    }

    /// Lists in `found`, ascending, the leaves that hold a pixel within its reach of one of `at`.
    ///
    /// A hundred-thousandth is added to every reach, more than `f32` rounding can take away.
    pub fn within_reach(&self, reach: &Reach, at: &[[f64; 2]], walk: &mut Walk) {
        walk.found.clear();
        walk.stack.clear();
        let top = self.levels.len() - 1;
        if !self.levels[top].is_empty() {
            walk.stack.push((top as u32, 0));
        }
        while let Some((level, node)) = walk.stack.pop() {
            let (level, node) = (level as usize, node as usize);
            let limit = f64::from(reach.levels[level][node]) * 1.000_01;
            let bounds = &self.levels[level][node];
            if !at.iter().any(|&at| bounds.distance2(at) <= limit) {
                continue;
            }
            if level == 0 {
                walk.found.push(node as u32);
            } else {
                let last = ((node + 1) * FAN).min(self.levels[level - 1].len());
                walk.stack.extend((node * FAN..last).rev().map(|c| (level as u32 - 1, c as u32)));
            }
        }
    }

    /// Repairs the inner nodes of `reach` above these leaves (ascending).
    pub fn repair(&self, reach: &mut Reach, leaves: &[u32], scratch: &mut Vec<u32>) {
        scratch.clear();
        scratch.extend_from_slice(leaves);
        for level in 1..reach.levels.len() {
            for node in scratch.iter_mut() {
                *node /= FAN as u32;
            }
            scratch.dedup();
            let (below, here) = reach.levels.split_at_mut(level);
            let (below, here) = (&below[level - 1], &mut here[0]);
            scratch.retain(|&node| {
                let first = node as usize * FAN;
                let last = (first + FAN).min(below.len());
                let largest = below[first..last].iter().copied().fold(f32::NEG_INFINITY, f32::max);
                let changed = here[node as usize].to_bits() != largest.to_bits();
                here[node as usize] = largest;
                changed
            });
        }
    }
}

/// The working memory of a walk down the tree.
#[derive(Debug, Clone, Default)]
pub struct Walk {
    stack: Vec<(u32, u32)>,
    /// Leaves found by the last walk, ascending.
    pub found: Vec<u32>,
}

/// One number per node of the tree: the largest value of any pixel below it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reach {
    levels: Vec<Vec<f32>>,
}

impl Reach {
    /// The maxima of `values`, one per pixel.
    pub fn new(index: &PixelIndex, values: &[f32]) -> Reach {
        let mut levels = vec![values.chunks(LEAF).map(largest).collect::<Vec<_>>()];
        for bounds in &index.levels[1..] {
            let below = &levels[levels.len() - 1];
            let next: Vec<f32> = below.chunks(FAN).map(largest).collect();
            debug_assert_eq!(next.len(), bounds.len());
            levels.push(next);
        }
        Reach { levels }
    }

    /// Replaces the number of one leaf; [`PixelIndex::repair`] must follow.
    #[inline]
    pub fn set(&mut self, leaf: usize, value: f32) {
        self.levels[0][leaf] = value;
    }
}

/// The largest of some numbers.
#[inline]
pub(super) fn largest(values: &[f32]) -> f32 {
    values.iter().copied().fold(f32::NEG_INFINITY, |a, b| if b > a { b } else { a })
}

/// Order of the curve through cells of at most this column and row.
pub(crate) fn hilbert_order(largest: u32) -> u32 {
    u32::BITS - largest.leading_zeros()
}

/// Place of a cell on the Hilbert curve through a square of side `2^order`.
pub(crate) fn hilbert(order: u32, [mut x, mut y]: [u32; 2]) -> u64 {
    let mut place = 0_u64;
    for bit in (0..order).rev() {
        let (rx, ry) = (x >> bit & 1, y >> bit & 1);
        place = place << 2 | u64::from((3 * rx) ^ ry);
        if ry == 0 {
            if rx == 1 {
                x = !x;
                y = !y;
            }
            std::mem::swap(&mut x, &mut y);
        }
    }
    place
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_visits_every_cell_once_and_only_steps_to_neighbours() {
        let cells: Vec<[u32; 2]> = (0..256).map(|i| [i % 16, i / 16]).collect();
        let mut sorted: Vec<(u64, [u32; 2])> = cells.iter().map(|&c| (hilbert(4, c), c)).collect();
        sorted.sort_unstable();
        for (place, pair) in sorted.windows(2).enumerate() {
            assert_eq!(pair[0].0, place as u64);
            let ([a, b], [c, d]) = (pair[0].1, pair[1].1);
            assert_eq!(a.abs_diff(c) + b.abs_diff(d), 1);
        }
    }

    #[test]
    fn a_walk_finds_every_pixel_within_reach_and_repair_keeps_it_so() {
        let pixels: Vec<[u32; 2]> =
            (0..3000_u32).map(|i| [i * 7919 % 400, i * 104_729 % 90]).collect();
        let index = PixelIndex::new(&pixels);
        assert_eq!(index.leaves(), 3000_usize.div_ceil(LEAF));
        let mut values: Vec<f32> = (0..3000).map(|i| ((i * 31) % 97) as f32).collect();
        let mut reach = Reach::new(&index, &values);
        let (mut walk, mut scratch) = (Walk::default(), vec![]);
        for round in 0..20_usize {
            let at = [(round * 23 % 420) as f64 - 10.3, (round * 17 % 100) as f64];
            index.within_reach(&reach, &[at], &mut walk);
            assert!(walk.found.is_sorted());
            for (n, &value) in values.iter().enumerate() {
                let [u, v] = index.position(n);
                if (u - at[0]).powi(2) + (v - at[1]).powi(2) <= f64::from(value) {
                    assert!(walk.found.contains(&((n / LEAF) as u32)));
                }
            }
            let active = [round as u32, round as u32 + 40];
            for leaf in active {
                for n in index.pixels_of(leaf as usize) {
                    values[n] = if round % 2 == 0 { 0.0 } else { 500.0 };
                }
                reach.set(leaf as usize, largest(&values[index.pixels_of(leaf as usize)]));
            }
            index.repair(&mut reach, &active, &mut scratch);
            assert_eq!(reach, Reach::new(&index, &values));
        }
    }

    #[test]
    fn a_mask_becomes_its_pixels_and_an_empty_one_has_no_extent() {
        let index = PixelIndex::from_mask(3, &[0, 1, 0, 0, 0, 9]);
        let mut pixels: Vec<[f64; 2]> = (0..index.len()).map(|n| index.position(n)).collect();
        pixels.sort_by(|a, b| a[0].total_cmp(&b[0]));
        assert_eq!(pixels, [[1.0, 0.0], [2.0, 1.0]]);
        let empty = PixelIndex::from_mask(0, &[]);
        assert!(empty.is_empty() && empty.extent().is_none());
        empty.within_reach(&Reach::new(&empty, &[]), &[[0.0; 2]], &mut Walk::default());
    }
}
