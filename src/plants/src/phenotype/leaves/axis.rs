//! The axis of a set of pixels: a polyline from one end to the other, with the width along it.
//!
//! Distances within the set (steps of 5 sideways and 7 diagonally, in fifths of a pixel) from one of its
//! two ends cut it into fronts across the leaf; the axis goes through their centroids. Unlike a main
//! direction this follows a leaf around any bend.

use super::{
    part::Local,
    segments::{Across, NONE},
};
use std::{cmp::Reverse, collections::BinaryHeap};

/// Pixels along the leaf that make one front.
const FRONT_PX: f64 = 2.0;

/// A polyline in local pixels with the full width at each of its points, pixels.
#[derive(Debug, Clone, Default)]
pub(super) struct Axis {
    pub(super) points: Vec<[f64; 2]>,
    pub(super) widths: Vec<f64>,
}

/// One end of an axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct End {
    pub(super) at: [f64; 2],
    /// Unit vector that leaves the leaf.
    pub(super) outward: [f64; 2],
    /// Width near the end, pixels.
    pub(super) width: f64,
    /// How much narrower the end is than the widest place within the next six widths, in halvings; 0 where it is
    /// as wide or wider.
    pub(super) narrows: f64,
}

impl Axis {
    /// The axis of a connected set of pixels.
    pub(super) fn of(local: &Local, across: &Across, number: &[u32], pixels: &[u32]) -> Axis {
        let Some(&any) = pixels.first() else { return Axis::default() };
        let mut distances = Distances::new(local, pixels);
        let one_end = distances.farthest(any);
        let other_end = distances.farthest(one_end);
        let longest = f64::from(distances.of[distances.place(other_end)]) / 5.0;
        let fronts = ((longest / FRONT_PX).round() as usize).max(1);
        let mut sums = vec![[0.0; 5]; fronts];
        for (&pixel, &distance) in pixels.iter().zip(&distances.of) {
            if distance == NONE {
                continue;
            }
            let q = f64::from(distance) / 5.0 / longest.max(1e-9);
            let front = ((q * fronts as f64) as usize).min(fronts - 1);
            let [u, v] = local.at(pixel);
            let width = f64::from(across.width[number[pixel as usize] as usize]);
            let known = f64::from(u8::from(!width.is_nan()));
            let terms = [u, v, 1.0, if known > 0.0 { width } else { 0.0 }, known];
            sums[front].iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
        }
        let mut axis = Axis::default();
        for sum in sums.iter().filter(|sum| sum[2] > 0.0) {
            axis.points.push([sum[0] / sum[2], sum[1] / sum[2]]);
            // Without a slice the front's own pixels tell its width.
            let area = sum[2] / FRONT_PX;
            axis.widths.push(if sum[4] > 0.0 { sum[3] / sum[4] } else { area });
        }
        axis.smooth();
        let reach = 0.5 * (longest / fronts as f64).max(1.0);
        axis.reach_out(reach);
        axis
    }

    fn smooth(&mut self) {
        if self.points.len() < 4 {
            return;
        }
        let (points, widths) = (self.points.clone(), self.widths.clone());
        for i in 1..points.len() - 1 {
            for k in 0..2 {
                self.points[i][k] =
                    0.25 * points[i - 1][k] + 0.5 * points[i][k] + 0.25 * points[i + 1][k];
            }
            self.widths[i] = 0.25 * widths[i - 1] + 0.5 * widths[i] + 0.25 * widths[i + 1];
        }
    }

    /// Both ends stand in the middle of their fronts: moves them out by `reach` pixels.
    fn reach_out(&mut self, reach: f64) {
        let last = self.points.len() - 1;
        if last == 0 {
            return;
        }
        let ends = [self.end(false), self.end(true)];
        for (index, end) in [0, last].into_iter().zip(ends) {
            for k in 0..2 {
                self.points[index][k] += reach * end.outward[k];
            }
        }
    }

    /// Length of the polyline, pixels; a single point counts as one pixel.
    pub(super) fn length(&self) -> f64 {
        let steps = self.points.windows(2).map(|pair| distance(pair[0], pair[1]));
        steps.sum::<f64>().max(1.0)
    }

    /// Mean width, pixels.
    pub(super) fn mean_width(&self) -> f64 {
        self.widths.iter().sum::<f64>() / self.widths.len().max(1) as f64
    }

    /// The end at the last point, or at the first.
    pub(super) fn end(&self, last: bool) -> End {
        let count = self.points.len();
        let order = |i: usize| if last { count - 1 - i } else { i };
        let at = self.points[order(0)];
        // The direction is that from three widths to one before the end: nearer to it the leaf that crosses bends
        // the outline, farther away is another bend. A short segment gives what it has.
        let usual = self.mean_width();
        let (mut near, mut inner) = (at, at);
        let (mut width, mut taken) = (0.0, 0);
        for i in 0..count {
            let point = self.points[order(i)];
            let d = distance(at, point);
            if i == 0 || d <= usual {
                near = point;
                width += self.widths[order(i)];
                taken += 1;
            }
            inner = point;
            if i > 0 && d >= (3.0 * usual).max(5.0) {
                break;
            }
        }
        if distance(near, inner) < usual {
            near = at;
        }
        let d = distance(near, inner);
        let outward =
            if d > 0.0 { [(near[0] - inner[0]) / d, (near[1] - inner[1]) / d] } else { [1.0, 0.0] };
        let reach = distance(at, near);
        let at = [near[0] + reach * outward[0], near[1] + reach * outward[1]];
        let width = width / f64::from(taken.max(1));
        let within = |&i: &usize| distance(at, self.points[order(i)]) < 6.0 * width;
        let widest =
            (0..count).take_while(within).map(|i| self.widths[order(i)]).fold(width, f64::max);
        End { at, outward, width, narrows: (widest / width).log2() }
    }

    /// Moves both ends out as far as the leaf's pixels reach: those ahead of an end, not farther aside than the leaf is
    /// wide and not farther ahead than three widths.
    pub(super) fn reach_to(&mut self, pixels: impl Iterator<Item = [f64; 2]> + Clone) {
        if self.points.len() < 2 {
            return;
        }
        for last in [false, true] {
            let end = self.end(last);
            let ahead = |p: [f64; 2]| {
                let d = [p[0] - end.at[0], p[1] - end.at[1]];
                let s = d[0] * end.outward[0] + d[1] * end.outward[1];
                let t = d[1] * end.outward[0] - d[0] * end.outward[1];
                let near = t.abs() <= end.width.max(1.0) && s <= 3.0 * end.width.max(1.0);
                if near { s } else { 0.0 }
            };
            // Half a pixel: from its centre to its border.
            let reach = pixels.clone().map(ahead).fold(0.0, f64::max);
            if reach > 0.5 {
                let index = if last { self.points.len() - 1 } else { 0 };
                for k in 0..2 {
                    self.points[index][k] += (reach + 0.5) * end.outward[k];
                }
            }
        }
    }

    /// Adds another axis behind the last point.
    pub(super) fn append(&mut self, other: &Axis, reversed: bool) {
        let take = |i: usize| if reversed { other.points.len() - 1 - i } else { i };
        for i in 0..other.points.len() {
            self.points.push(other.points[take(i)]);
            self.widths.push(other.widths[take(i)]);
        }
    }
}

pub(super) fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Distances within a set of pixels, in fifths of a pixel.
struct Distances<'a> {
    local: &'a Local,
    pixels: &'a [u32],
    of: Vec<u32>,
}

impl<'a> Distances<'a> {
    fn new(local: &'a Local, pixels: &'a [u32]) -> Distances<'a> {
        Distances { local, pixels, of: vec![NONE; pixels.len()] }
    }

    fn place(&self, pixel: u32) -> usize {
        self.pixels.binary_search(&pixel).unwrap_or(0)
    }

    /// Measures from a pixel and gives the farthest one (of several, the first).
    fn farthest(&mut self, from: u32) -> u32 {
        self.of.fill(NONE);
        let start = self.place(from);
        self.of[start] = 0;
        let mut heap = BinaryHeap::from([Reverse((0, start as u32))]);
        while let Some(Reverse((distance, place))) = heap.pop() {
            if distance > self.of[place as usize] {
                continue;
            }
            let around = self.local.neighbours(self.pixels[place as usize]);
            for (neighbour, step) in around.into_iter().zip([7, 5, 7, 5, 5, 7, 5, 7]) {
                if let Ok(next) = self.pixels.binary_search(&neighbour)
                    && distance + step < self.of[next]
                {
                    self.of[next] = distance + step;
                    heap.push(Reverse((distance + step, next as u32)));
                }
            }
        }
        let mut farthest = (0, from);
        for (&pixel, &distance) in self.pixels.iter().zip(&self.of) {
            if distance != NONE && distance > farthest.0 {
                farthest = (distance, pixel);
            }
        }
        farthest.1
    }
}
