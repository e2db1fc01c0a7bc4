//! Where stalks may be: leaf pixels vote along the axes of their leaves.
//!
//! The axis of the leaf at a pixel is the direction in which the mask changes least, from the
//! structure tensor `S = G_i * (grad m grad m^T)`, `m` the mask smoothed by a Gaussian of scale
//! `GRADIENT_PX` and `G_i` one of scale `TENSOR_PX`. With `xx`, `xy`, `yy` its entries, the axis at
//! angle `theta` and its coherence are
//!
//! `(cos 2 theta, sin 2 theta) = -(xx - yy, 2 xy) / n`, `n = |(xx - yy, 2 xy)|`, `c = n / (xx + yy)`.
//!
//! Every pixel votes with weight `c` for all places both ways along its axis, as far as the straight
//! walk stays on the mask (one missing pixel is stepped over) and at most `REACH_PX`. Many leaves
//! cross where a stalk is. Votes are kept apart by the angle between leaf and row, because leaves
//! along the row cross it everywhere and say least, and each part saturates so that no single broad
//! leaf outweighs several narrow ones:
//!
//! `E = sum_b w_b v_b / (1 + v_b / ``SATURATION``)`.
//!
//! A mask of broad leaves is first reduced by the whole factor that makes its strokes about
//! `STROKE_PX` wide, by more where plants stand far apart, by less where they are close together. Positions in pixels of the given mask, centre of the top-left pixel at (0, 0).

use rayon::prelude::*;
use rowgram_raster::Mask;
use std::{f64::consts::FRAC_2_PI, ops::Range};

/// Scale of the gradient, in reduced pixels.
const GRADIENT_PX: f64 = 0.7;
/// Scale over which the tensor is averaged, in reduced pixels.
const TENSOR_PX: f64 = 1.3;
/// Scale by which votes are blurred, in reduced pixels.
const VOTE_PX: f64 = 0.8;
/// How far a vote walks, in reduced pixels.
const REACH_PX: usize = 20;
/// Where votes saturate.
const SATURATION: f32 = 60.0;
/// Weight of leaves within 30, 60 and 90 degrees of the row.
const WEIGHTS: [f32; 3] = [0.3, 0.7, 1.0];
/// Width of a stroke that votes work best with.
const STROKE_PX: f64 = 3.0;
/// Runs of leaf that are longer are counted as of this length, in pixels.
const LONGEST_RUN: usize = 4096;
/// Rows of one stripe: stripes are fixed, so sums do not depend on the threads.
const STRIPE: usize = 128;
/// Rows beyond a stripe that its votes and filters can reach.
const HALO: usize = REACH_PX + 12;

/// The votes for a stalk at every pixel of the reduced mask, in one byte each: a map of a field has many. The share of leaf and the axes of leaves
/// are computed from the mask where they are asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Evidence<'m> {
    mask: &'m Mask,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels of the mask per pixel of this grid, along each axis.
    pub factor: usize,
    /// Square roots of the votes, row by row, in 255ths of that of `most`.
    roots: Vec<u8>,
    /// No place can have more votes.
    most: f32,
}

/// The leaves of some rows of the grid.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LeafAxes {
    /// These rows.
    pub(super) rows: Range<usize>,
    /// Share of each pixel that is leaf, row by row.
    pub(super) share: Vec<f32>,
    /// The axis of the leaf there, `c (cos 2 theta, sin 2 theta)` in 127ths, `c` its coherence.
    pub(super) axis: Vec<[i8; 2]>,
}

/// The whole factor by which a mask is reduced whose leaves are so wide.
pub(super) fn factor(stroke_px: f64) -> usize {
    (stroke_px / STROKE_PX).max(1.0) as usize
}

impl<'m> Evidence<'m> {
    /// Votes of a mask whose rows have this heading (from `u` towards `v`), on a grid reduced by `factor`.
    pub fn new(mask: &'m Mask, heading_rad: f64, factor: usize) -> Evidence<'m> {
        let (width, height) = (mask.width.div_ceil(factor), mask.height.div_ceil(factor));
        let most = SATURATION * WEIGHTS.iter().sum::<f32>();
        let mut found = Evidence { mask, width, height, factor, roots: vec![], most };
        let mut roots = vec![0; width * height];
        if width > 0 {
            roots.par_chunks_mut(STRIPE * width).enumerate().for_each(|(number, roots)| {
                let (around, stripe, leaf) = found.stripe(number);
                let axes = stripe.tensor_axes(&leaf);
                let mut votes = vec![0.0; roots.len()];
                let skip = number * STRIPE - around.start;
                stripe.vote(&leaf, &axes, heading_rad, skip, &mut votes);
                keep_roots(&votes, most, roots);
            });
        }
        found.roots = roots;
        found
    }

    /// The number of the stripe in which a row is.
    pub(super) fn stripe_of(row: usize) -> usize {
        row / STRIPE
    }

    /// The leaves of a stripe and of at least [`LeafAxes::REACH`] rows on either side, where there are any.
    pub(super) fn leaf_axes(&self, stripe: usize) -> LeafAxes {
        let (rows, stripe, share) = self.stripe(stripe);
        let in_127ths = |a: f32| (127.0 * a).round() as i8;
        let axis = stripe.tensor_axes(&share).into_iter().map(|axis| axis.map(in_127ths)).collect();
        LeafAxes { rows, share, axis }
    }

    /// The rows of a stripe with those around it, and their leaf.
    fn stripe(&self, number: usize) -> (Range<usize>, Stripe, Vec<f32>) {
        let first = number * STRIPE;
        let rows = first.saturating_sub(HALO)..(first + STRIPE + HALO).min(self.height);
        let leaf = reduce(self.mask, self.factor, rows.clone());
        (rows.clone(), Stripe { width: self.width, height: rows.len() }, leaf)
    }

    /// Votes of a pixel of the grid, row by row.
    #[inline]
    pub fn votes(&self, pixel: usize) -> f32 {
        let root = f32::from(self.roots[pixel]) / f32::from(u8::MAX);
        self.most * root * root
    }

    /// Share of a pixel of the grid that is leaf.
    #[inline]
    fn leaf_share(&self, column: usize, row: usize) -> f32 {
        let (mask, factor) = (self.mask, self.factor);
        let columns = column * factor..((column + 1) * factor).min(mask.width);
        let rows = row * factor..((row + 1) * factor).min(mask.height);
        let leaf: usize = rows
            .map(|v| mask.row(v)[columns.clone()].iter().filter(|pixel| **pixel != 0).count())
            .sum();
        leaf as f32 / (factor * factor) as f32
    }

    /// Leaf of the whole mask, in pixels of the grid.
    pub fn leaf_area(&self) -> f64 {
        self.mask.count() as f64 / (self.factor * self.factor) as f64
    }

    /// A position of the mask in this grid.
    pub fn reduced(&self, at_px: [f64; 2]) -> [f64; 2] {
        at_px.map(|x| (x + 0.5) / self.factor as f64 - 0.5)
    }

    /// A position of this grid in the mask.
    pub fn full(&self, at: [f64; 2]) -> [f64; 2] {
        at.map(|x| (x + 0.5) * self.factor as f64 - 0.5)
    }

    /// Votes between pixel centres, bilinear; 0 outside.
    pub fn at(&self, [x, y]: [f64; 2]) -> f64 {
        // Cut to whole numbers where it is 0 or more.
        let (left, top) = (x as usize, y as usize);
        let inside = x >= 0.0 && y >= 0.0 && left + 1 < self.width && top + 1 < self.height;
        if !inside {
            return 0.0;
        }
        let upper = top * self.width + left;
        let lower = upper + self.width;
        let (a, b) = ((x - left as f64) as f32, (y - top as f64) as f32);
        let between = |from: f32, to: f32, part: f32| from + part * (to - from);
        let above = between(self.votes(upper), self.votes(upper + 1), a);
        let below = between(self.votes(lower), self.votes(lower + 1), a);
        f64::from(between(above, below, b))
    }

    /// Share of leaf in the pixel around a place; 0 outside.
    pub fn leaf_at(&self, at: [f64; 2]) -> f64 {
        let [x, y] = at.map(f64::round);
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        if inside { f64::from(self.leaf_share(x as usize, y as usize)) } else { 0.0 }
    }
}

impl LeafAxes {
    /// Rows around a stripe in which axes are the same as those of the whole mask, at least.
    pub(super) const REACH: usize = REACH_PX;
}

/// Width of the strokes from the lengths of their runs, along rows and columns. A line that crosses a strip of width `w` in any direction is in
/// it for `pi w / 2` on average, and for at most `2 w / sqrt(3)` in half of all cases. Where leaves have grown together the mean says too much, where plants
/// are round the median does, so the smaller one counts.
pub(super) fn stroke_px(mask: &Mask) -> f64 {
    let mut runs = vec![0_u64; LONGEST_RUN + 1];
    let mut end = |length: &mut usize| {
        runs[(*length).min(LONGEST_RUN)] += u64::from(*length > 0);
        *length = 0;
    };
    let mut columns = vec![0; mask.width];
    for v in 0..mask.height {
        let mut along = 0;
        for (&pixel, down) in mask.row(v).iter().zip(&mut columns) {
            for length in [&mut along, down] {
                match pixel {
                    0 => end(length),
                    _ => *length += 1,
                }
            }
        }
        end(&mut along);
    }
    columns.iter_mut().for_each(end);
    let number = runs.iter().sum::<u64>() as f64;
    let mut before = 0.0;
    for (length, &of_length) in runs.iter().enumerate() {
        let of_length = of_length as f64;
        if of_length > 0.0 && before + of_length >= 0.5 * number {
            // Runs of a length are spread over half a pixel to either side.
            let median = length as f64 - 0.5 + (0.5 * number - before) / of_length;
            let mean = 2.0 * mask.count() as f64 / number;
            return f64::min(FRAC_2_PI * mean, 0.5 * 3.0_f64.sqrt() * median);
        }
        before += of_length;
    }
    0.0
}

/// Shares of leaf in blocks of `factor` by `factor` pixels, of some rows of blocks.
fn reduce(mask: &Mask, factor: usize, rows: Range<usize>) -> Vec<f32> {
    let width = mask.width.div_ceil(factor);
    let mut leaf = vec![0.0_f32; width * rows.len()];
    let share = 1.0 / (factor * factor) as f32;
    for v in rows.start * factor..(rows.end * factor).min(mask.height) {
        let out = &mut leaf[(v / factor - rows.start) * width..][..width];
        for (u, &pixel) in mask.row(v).iter().enumerate() {
            if pixel != 0 {
                out[u / factor] += share;
            }
        }
    }
    leaf
}

/// Square roots of votes in 255ths of that of `most`.
fn keep_roots(votes: &[f32], most: f32, to: &mut [u8]) {
    let root = |votes: f32| (f32::from(u8::MAX) * (votes / most).sqrt()).round() as u8;
    to.iter_mut().zip(votes).for_each(|(to, &votes)| *to = root(votes));
}

/// One stripe of the picture and its surroundings.
#[derive(Clone, Copy)]
struct Stripe {
    width: usize,
    height: usize,
}

impl Stripe {
    /// The axis at each leaf pixel as `c (cos 2 theta, sin 2 theta)`, from the structure tensor.
    fn tensor_axes(self, leaf: &[f32]) -> Vec<[f32; 2]> {
        let [xx, xy, yy] = self.tensor(leaf);
        let entries = xx.iter().zip(&xy).zip(&yy);
        entries
            .map(|((xx, xy), yy)| {
                let sum = xx + yy + 1e-4;
                [(yy - xx) / sum, -2.0 * xy / sum]
            })
            .collect()
    }

    /// Votes into the rows of `out`, the first of which is row `skip` of the stripe.
    fn vote(self, leaf: &[f32], axes: &[[f32; 2]], heading_rad: f64, skip: usize, out: &mut [f32]) {
        let Stripe { width, height } = self;
        let (turn_sin, turn_cos) = (2.0 * heading_rad).sin_cos();
        let (turn_cos, turn_sin) = (turn_cos as f32, turn_sin as f32);
        let mut parts = [(); 3].map(|()| vec![0.0_f32; width * height]);
        for y in 0..height {
            for x in 0..width {
                let at = y * width + x;
                if leaf[at] < 0.5 {
                    continue;
                }
                let [cos2, sin2] = axes[at];
                let coherence = cos2.hypot(sin2);
                if coherence < 0.05 {
                    continue;
                }
                let (cos2, sin2) = (cos2 / coherence, sin2 / coherence);
                let from_row = cos2 * turn_cos + sin2 * turn_sin;
                let part = usize::from(from_row < 0.5) + usize::from(from_row < -0.5);
                let cos = ((1.0 + cos2) / 2.0).max(0.0).sqrt();
                let sin = ((1.0 - cos2) / 2.0).max(0.0).sqrt().copysign(sin2);
                self.walk(leaf, &mut parts[part], [x, y], [cos, sin], coherence);
            }
        }
        out.fill(0.0);
        for (part, weight) in parts.into_iter().zip(WEIGHTS) {
            let part = self.blur(part, VOTE_PX);
            for (sum, &votes) in out.iter_mut().zip(&part[skip * width..]) {
                *sum += weight * votes / (1.0 + votes / SATURATION);
            }
        }
    }

    /// One pixel votes both ways along its axis.
    fn walk(
        self,
        leaf: &[f32],
        votes: &mut [f32],
        [x, y]: [usize; 2],
        [cos, sin]: [f32; 2],
        weight: f32,
    ) {
        let (width, height) = (self.width as f32, self.height as f32);
        // One cell per step along the longer axis; longer steps weigh more.
        let longer = cos.abs().max(sin.abs());
        let (dx, dy) = (cos / longer, sin / longer);
        let steps = (REACH_PX as f32 * longer) as usize;
        let weight = weight / longer;
        for (dx, dy) in [(dx, dy), (-dx, -dy)] {
            // Half a pixel more, so that truncation rounds.
            let (mut px, mut py) = (x as f32 + 0.5, y as f32 + 0.5);
            let mut missing = 0;
            for _ in 0..steps {
                px += dx;
                py += dy;
                if !(px >= 0.0 && py >= 0.0 && px < width && py < height) {
                    break;
                }
                let at = py as usize * self.width + px as usize;
                if leaf[at] < 0.5 {
                    missing += 1;
                    if missing > 1 {
                        break;
                    }
                } else {
                    missing = 0;
                }
                votes[at] += weight;
            }
        }
    }

    /// The entries `xx`, `xy`, `yy` of the structure tensor (gradients by Scharr's filter).
    fn tensor(self, leaf: &[f32]) -> [Vec<f32>; 3] {
        let Stripe { width, height } = self;
        let smooth = self.blur(leaf.to_vec(), GRADIENT_PX);
        let mut entries = [(); 3].map(|()| vec![0.0_f32; width * height]);
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                let at = y * width + x;
                let value = |dx: usize, dy: usize| smooth[at + dx - 1 + dy * width - width];
                let du = 3.0 * (value(2, 0) - value(0, 0) + value(2, 2) - value(0, 2))
                    + 10.0 * (value(2, 1) - value(0, 1));
                let dv = 3.0 * (value(0, 2) - value(0, 0) + value(2, 2) - value(2, 0))
                    + 10.0 * (value(1, 2) - value(1, 0));
                let (du, dv) = (du / 32.0, dv / 32.0);
                entries[0][at] = du * du;
                entries[1][at] = du * dv;
                entries[2][at] = dv * dv;
            }
        }
        entries.map(|entry| self.blur(entry, TENSOR_PX))
    }

    /// A Gaussian filter; beyond the edges is nothing.
    fn blur(self, picture: Vec<f32>, scale_px: f64) -> Vec<f32> {
        let Stripe { width, height } = self;
        let radius = (3.0 * scale_px).ceil() as usize;
        let raw: Vec<f64> = (0..=2 * radius)
            .map(|k| (-0.5 * ((k as f64 - radius as f64) / scale_px).powi(2)).exp())
            .collect();
        let sum: f64 = raw.iter().sum();
        let kernel: Vec<f32> = raw.iter().map(|k| (k / sum) as f32).collect();
        let mut across = vec![0.0_f32; width * height];
        let mut padded = vec![0.0_f32; width + 2 * radius];
        for (row, out) in picture.chunks(width).zip(across.chunks_mut(width)) {
            padded[radius..radius + width].copy_from_slice(row);
            for (k, &weight) in kernel.iter().enumerate() {
                for (sum, value) in out.iter_mut().zip(&padded[k..]) {
                    *sum += weight * value;
                }
            }
        }
        let mut both = picture;
        both.fill(0.0);
        for y in 0..height {
            let out = &mut both[y * width..][..width];
            for (k, &weight) in kernel.iter().enumerate() {
                if let Some(from) = (y + k).checked_sub(radius).filter(|&from| from < height) {
                    for (sum, value) in out.iter_mut().zip(&across[from * width..][..width]) {
                        *sum += weight * value;
                    }
                }
            }
        }
        both
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four bars, two pixels wide, through a point.
    fn star(centre: [f64; 2], turn_rad: f64, side: usize, scale: f64) -> Mask {
        Mask::from_fn(side, side, |u, v| {
            let (x, y) = (u as f64 - centre[0], v as f64 - centre[1]);
            (0..4).any(|k| {
                let (s, c) = (turn_rad + f64::from(k) * std::f64::consts::FRAC_PI_4).sin_cos();
                (c * y - s * x).abs() < 1.2 * scale && (c * x + s * y).abs() < 14.0 * scale
            })
        })
    }

    fn seen(mask: &Mask, heading_rad: f64) -> Evidence<'_> {
        Evidence::new(mask, heading_rad, factor(stroke_px(mask)))
    }

    #[test]
    fn strokes_that_grow_together_are_not_broader() {
        // Strips of 6 pixels in nine directions, without and with a third of the picture solid leaf.
        for solid in [false, true] {
            let mask = Mask::from_fn(9 * 120, 360, |u, v| {
                let block = u / 120;
                let (s, c) = (5.0 + 10.0 * block as f64).to_radians().sin_cos();
                let across = (c * v as f64 - s * (u % 120) as f64).rem_euclid(30.0);
                across < 6.0 || (solid && v > 240)
            });
            let found = stroke_px(&mask);
            assert!((found - 6.0).abs() < 0.6, "{solid}: {found}");
        }
        assert_eq!(stroke_px(&Mask::from_fn(0, 0, |_, _| true)), 0.0);
        assert_eq!(factor(stroke_px(&Mask::from_fn(9, 9, |_, _| false))), 1);
    }

    #[test]
    fn leaves_that_cross_vote_for_the_crossing() {
        for (turn, scale, side) in [(0.1, 1.0, 60), (0.35, 1.0, 60), (0.2, 4.0, 240)] {
            let centre = [29.3 * scale, 31.0 * scale];
            let mask = star(centre, turn, side, scale);
            let evidence = seen(&mask, 0.0);
            let best = (0..evidence.width * evidence.height)
                .max_by(|&a, &b| evidence.votes(a).total_cmp(&evidence.votes(b)))
                .unwrap();
            let (x, y) = (best % evidence.width, best / evidence.width);
            let found = evidence.full([x as f64, y as f64]);
            let error = (found[0] - centre[0]).hypot(found[1] - centre[1]);
            assert!(error < 2.0 * scale, "{turn} {scale}: {error}");
            assert_eq!(evidence.factor > 1, scale > 1.0);
        }
    }

    #[test]
    fn mirrored_masks_give_mirrored_votes_and_stripes_do_not_show() {
        // Long enough for three stripes.
        let mask = Mask::from_fn(40, 300, |u, v| (u + v / 2) % 9 < 2 || (v + 400 - u) % 31 < 3);
        let mirrored = Mask::from_fn(40, 300, |u, v| mask.get(u, 299 - v));
        let (a, b) = (seen(&mask, 0.3), seen(&mirrored, -0.3));
        // Away from the edges, where one walk can leave the mask just before the other.
        for v in 0..300 {
            for u in 0..40 {
                let (one, two) = (a.votes(v * 40 + u), b.votes((299 - v) * 40 + u));
                assert!((one - two).abs() <= 0.35 * one.max(two).max(1.0), "{u} {v}: {one} {two}");
            }
        }
        let mean = |e: &Evidence| (0..40 * 300).map(|k| e.votes(k)).sum::<f32>();
        assert!((mean(&a) / mean(&b) - 1.0).abs() < 0.01);
    }

    #[test]
    fn degenerate_masks_have_no_votes() {
        for mask in [Mask::empty(0, 0), Mask::empty(1, 1), Mask::empty(9, 200)] {
            let evidence = seen(&mask, 0.0);
            assert!((0..mask.data.len()).all(|k| evidence.votes(k) == 0.0));
        }
        let dot = Mask::from_fn(1, 1, |_, _| true);
        assert_eq!(seen(&dot, 0.0).leaf_at([0.0; 2]), 1.0);
    }

    #[test]
    fn votes_are_kept_closely_and_shares_exactly() {
        let votes: Vec<f32> = (0..=1000).map(|k| 120.0 * (k as f32 / 1000.0).powi(3)).collect();
        let mut roots = vec![0; votes.len()];
        keep_roots(&votes, 120.0, &mut roots);
        let empty = Mask::empty(1, 1);
        let evidence = Evidence { roots, most: 120.0, ..Evidence::new(&empty, 0.0, 1) };
        for (k, votes) in votes.iter().enumerate() {
            // Half a step of the root.
            let most = 1.01 * ((120.0 * votes).sqrt() / 255.0 + 120.0 / 510_f32.powi(2));
            assert!((evidence.votes(k) - votes).abs() <= most, "{votes}: {}", evidence.votes(k));
        }
        let mask = Mask::from_fn(3, 2, |u, _| u != 1);
        let halves = Evidence::new(&mask, 0.0, 2);
        assert_eq!([0.0, 1.0].map(|x| halves.leaf_at([x, 0.0])), [0.5; 2]);
        assert_eq!(halves.leaf_area(), 1.0);
        assert_eq!(halves.leaf_axes(0).share, [0.5; 2]);
    }

    #[test]
    fn positions_turn_there_and_back() {
        let empty = Mask::empty(1, 1);
        let evidence = Evidence::new(&empty, 0.0, 3);
        let at = [7.25, -3.0];
        let back = evidence.full(evidence.reduced(at));
        approx::assert_relative_eq!(back[0], at[0], epsilon = 1e-12);
        approx::assert_relative_eq!(back[1], at[1], epsilon = 1e-12);
        assert_eq!(evidence.full([0.0, 0.0]), [1.0, 1.0]);
    }
}
