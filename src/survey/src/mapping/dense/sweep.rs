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

use std::ops::Range;

/// Half the side of the census window.
pub(super) const REACH: usize = 2;
/// Neighbours compared by the census.
const NEIGHBOURS: u8 = 24;
/// Greatest matching cost: three photos with nothing in common.
pub(super) const WORST: u8 = 3 * NEIGHBOURS;
/// Pixels whose distances are found together.
const RUN: usize = 64;
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

/// Positions along one axis of another photo: whole places and weights of the next, of 128; and the ranges in which whole places follow
/// each other.
struct Positions {
    first: Vec<i32>,
    weight: Vec<u8>,
    runs: Vec<Range<usize>>,
}

impl Positions {
    fn new(scale: f64, offset: f64, count: usize) -> Positions {
        let (mut first, mut weight) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for k in 0..count {
            let at = ((scale * k as f64 + offset) * 128.0).round() as i32;
            first.push(at >> 7);
            weight.push((at & 127) as u8);
        }
        let ends = first.windows(2).enumerate().filter(|(_, pair)| pair[1] != pair[0] + 1);
        let ends: Vec<usize> = ends.map(|(k, _)| k + 1).chain([count]).collect();
        let starts = std::iter::once(0).chain(ends.iter().copied());
        let runs = starts.zip(ends.iter()).map(|(start, &end)| start..end).collect();
        Positions { first, weight, runs }
    }
}

/// The matching costs of all layers: layer by layer, row by row; `WORST` within `REACH` of the border.
pub fn costs(reference: &Rectified, others: &[Rectified], heights_m: &[f64]) -> Vec<u8> {
    let cells = reference.width * reference.height;
    let mut volume = vec![WORST; cells * heights_m.len()];
    let mut work = Work::new(reference, others.len());
    let [Some(&lowest_m), Some(&highest_m)] = [heights_m.first(), heights_m.last()] else {
        return volume;
    };
    // A photo that shows a pixel at some heights only would speak for those: it has no say there. What it shows of the lowest
    // and the highest layer it shows of all between, since photos are convex.
    let mut shown = vec![vec![u8::MAX; cells]; others.len()];
    for height_m in [lowest_m, highest_m] {
        for (k, other) in others.iter().enumerate() {
            resample(reference, other, height_m, &mut work.line, &mut work.sampled[k]);
            for (shown, &value) in shown[k].iter_mut().zip(&work.sampled[k]) {
                *shown = if value == 0 { 0 } else { *shown };
            }
        }
    }
    for (&height_m, layer) in heights_m.iter().zip(volume.chunks_exact_mut(cells)) {
        for (k, other) in others.iter().enumerate() {
            let sampled = &mut work.sampled[k];
            resample(reference, other, height_m, &mut work.line, sampled);
            sampled.iter_mut().zip(&shown[k]).for_each(|(value, shown)| *value &= shown);
        }
        pulp::Arch::new().dispatch(Distances {
            reference,
            sampled: &work.sampled,
            distances: &mut work.distances,
            out: layer,
        });
    }
    volume
}

/// A photo at one height, as the reference would see it.
fn resample(
    reference: &Rectified,
    other: &Rectified,
    height_m: f64,
    line: &mut Vec<u8>,
    out: &mut [u8],
) {
    let (scale, offset) = transfer(reference, other, height_m);
    let at = |k: usize| offset[k] - other.origin[k] as f64;
    let across = Positions::new(scale, at(0), reference.width);
    let down = Positions::new(scale, at(1), reference.height);
    let (across, down, width) = (&across, &down, reference.width);
    pulp::Arch::new().dispatch(Resample { other, across, down, line, out, width });
}

/// Memory that the layers use in turn.
struct Work {
    sampled: Vec<Vec<u8>>,
    distances: Vec<Vec<u8>>,
    line: Vec<u8>,
}

impl Work {
    fn new(reference: &Rectified, others: usize) -> Work {
        Work {
            sampled: vec![vec![0; reference.width * reference.height]; others],
            distances: vec![vec![0; reference.width]; others],
            line: Vec::new(),
        }
    }
}

/// Positions and memory of [`resample`].
struct Resample<'a> {
    other: &'a Rectified,
    across: &'a Positions,
    down: &'a Positions,
    line: &'a mut Vec<u8>,
    out: &'a mut [u8],
    width: usize,
}

impl pulp::WithSimd for Resample<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Resample { other, across, down, line, out, width } = self;
        line.resize(other.width, 0);
        for (y, out) in out.chunks_exact_mut(width).enumerate() {
            let row = down.first[y];
            if row < 0 || row as usize + 1 >= other.height {
                out.fill(0);
                continue;
            }
            let at = row as usize * other.width;
            let (upper, rest) = other.values[at..at + 2 * other.width].split_at(other.width);
            mix(upper, rest, u16::from(down.weight[y]), line);
            for &Range { start: x, end } in &across.runs {
                let from = across.first[x];
                if from < 0 || from as usize + (end - x) >= other.width {
                    // Rare: at the border of what was rectified.
                    for k in x..end {
                        let first = across.first[k];
                        let inside = first >= 0 && (first as usize) + 1 < other.width;
                        out[k] = if inside {
                            let pair = &line[first as usize..first as usize + 2];
                            blend(pair[0], pair[1], u16::from(across.weight[k]))
                        } else {
                            0
                        };
                    }
                } else {
                    let from = from as usize;
                    let (left, right) = (&line[from..][..end - x], &line[from + 1..][..end - x]);
                    mix_each(left, right, &across.weight[x..end], &mut out[x..end]);
                }
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

/// The cost of a layer.
struct Distances<'a> {
    reference: &'a Rectified,
    sampled: &'a [Vec<u8>],
    distances: &'a mut [Vec<u8>],
    out: &'a mut [u8],
}

impl pulp::WithSimd for Distances<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Distances { reference, sampled, distances, out } = self;
        let (width, height) = (reference.width, reference.height);
        if width <= 2 * REACH || height <= 2 * REACH || sampled.is_empty() {
            return;
        }
        let n = width - 2 * REACH;
        for y in REACH..height - REACH {
            for (sampled, distance) in sampled.iter().zip(distances.iter_mut()) {
                let mut start = 0;
                while start < n {
                    // The last columns overlap those before, so that every run has the same length.
                    let from = if n >= RUN { start.min(n - RUN) } else { 0 };
                    let run = RUN.min(n);
                    let at = (y - REACH) * width + from;
                    let out = &mut distance[from..from + run];
                    match <&mut [u8; RUN]>::try_from(&mut *out) {
                        Ok(out) => census(&reference.values[at..], &sampled[at..], width, out),
                        Err(_) => census(&reference.values[at..], &sampled[at..], width, out),
                    }
                    start += RUN;
                }
            }
            best(distances, &mut out[y * width + REACH..][..n]);
        }
    }
}

/// Census distances of a run of pixels, whose windows begin at the first value of either picture.
#[inline(always)]
fn census<O: AsMut<[u8]> + ?Sized>(reference: &[u8], other: &[u8], width: usize, out: &mut O) {
    let out = out.as_mut();
    let n = out.len().min(RUN);
    let centre = REACH * width + REACH;
    let (r, o) = (&reference[centre..][..n], &other[centre..][..n]);
    let mut distance = [0u8; RUN];
    for dy in 0..=2 * REACH {
        for dx in 0..=2 * REACH {
            if dx == REACH && dy == REACH {
                continue;
            }
            let (rn, on) = (&reference[dy * width + dx..][..n], &other[dy * width + dx..][..n]);
            for k in 0..n {
                let differs = u8::from(rn[k] > r[k]) ^ u8::from(on[k] > o[k]);
                distance[k] = distance[k].wrapping_add(differs);
            }
        }
    }
    for k in 0..n {
        // Nothing is known where a photo shows nothing.
        out[k] = if o[k] == 0 { NEIGHBOURS } else { distance[k] };
    }
}

/// The sum over the three best photos; over all, scaled to three, where there are fewer.
#[inline(always)]
fn best(distances: &[Vec<u8>], out: &mut [u8]) {
    let n = out.len();
    for start in (0..n).step_by(64) {
        let m = 64.min(n - start);
        let out = &mut out[start..start + m];
        // Sorted as they come: a is the least.
        let (mut a, mut b, mut c) = ([NEIGHBOURS; 64], [NEIGHBOURS; 64], [NEIGHBOURS; 64]);
        for distance in distances {
            let distance = &distance[start..start + m];
            for k in 0..m {
                let (low, rest) = (a[k].min(distance[k]), a[k].max(distance[k]));
                let (middle, high) = (b[k].min(rest), b[k].max(rest));
                (a[k], b[k], c[k]) = (low, middle, c[k].min(high));
            }
        }
        for k in 0..m {
            let two = a[k].wrapping_add(b[k]);
            out[k] = match distances.len() {
                1 => a[k].wrapping_mul(3),
                2 => two.wrapping_add(two / 2),
                _ => two.wrapping_add(c[k]),
            };
        }
    }
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
        let volume = costs(&reference, std::slice::from_ref(&other), &heights_m);
        for at in [20 * width + 30, 10 * width + 75, 33 * width + 120] {
            let of = |layer: usize| volume[layer * width * height + at];
            let best = (0..21).min_by_key(|&layer| of(layer)).unwrap();
            assert_eq!(best, 10, "{at}: {:?}", (0..21).map(of).collect::<Vec<_>>());
            assert!(of(10) <= 6 && of(0) > 15);
        }
    }

    #[test]
    fn the_three_best_photos_count() {
        let distances = [[10u8; 70], [3; 70], [24; 70], [5; 70], [0; 70]].map(Vec::from);
        let mut out = [0; 70];
        best(&distances, &mut out);
        assert_eq!(out, [8; 70]);
        best(&distances[..2], &mut out);
        assert_eq!(out, [19; 70]);
        best(&distances[..1], &mut out);
        assert_eq!(out, [30; 70]);
    }
}
